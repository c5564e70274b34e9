// Renders in a worker, so that the page stays responsive.
//
// Takes {type: 'scene', photo, depth, matte or null, width, height, file}, then {type: 'render', size, file, focus, fNumber, tilePx, reachPx}, where
// size is 'half' or 'shown', that of the scene, or 'full', that of the photograph, and focus is {nearM, farM}.
// Gives {type: 'ready'}, {type: 'sharp', rgba, width, height}, {type: 'tile', done, count},
// {type: 'picture', size, rgba, width, height} or {type: 'failed', message}.

import * as ort from './ort.wasm.min.mjs'
import { depthAtSize } from './depth.mjs'
import { DepthOfField } from './depth_of_field.mjs'
import { linearLight, srgbBytes } from './light.mjs'
import { coverageAtSize } from './matte.mjs'
import { withoutRange } from './optics.mjs'

ort.env.wasm.wasmPaths = new URL('./', import.meta.url).href
ort.env.wasm.numThreads = self.crossOriginIsolated ? Math.min(8, navigator.hardwareConcurrency) : 1

let scene
const loaded = new Map() // file -> promise of its DepthOfField
const sizes = new Map() // 'half' or 'shown' -> light, depth and matte at that size

function lensOf(file) {
  if (!loaded.has(file)) loaded.set(file, load(file))
  return loaded.get(file)
}

async function load(file) {
  const response = await fetch(new URL(file, import.meta.url))
  if (!response.ok) throw new Error(`${file} cannot be loaded (${response.status})`)
  const dof = await DepthOfField.load(ort, new Uint8Array(await response.arrayBuffer()))
  self.postMessage({ type: 'ready' })
  return dof
}

function atSize(size) {
  if (!sizes.has(size)) {
    const { photo, depth, matte } = scene
    const width = size === 'half' ? Math.ceil(scene.width / 2) : scene.width
    const height = size === 'half' ? Math.ceil(scene.height / 2) : scene.height
    sizes.set(size, {
      width,
      height,
      light: linearLight(photo.rgba, photo.width, photo.height, width, height),
      depth: depthAtSize(depth.metres, depth.width, depth.height, width, height),
      matte: matte && coverageAtSize(matte, width, height),
    })
  }
  return sizes.get(size)
}

async function render({ size, file, focus, fNumber }) {
  const dof = await lensOf(file)
  const { light, depth, matte, width, height } = atSize(size)
  const out = await dof.render(light, withoutRange(depth, focus), width, height, focus.nearM, fNumber, matte)
  const rgba = srgbBytes(out)
  self.postMessage({ type: 'picture', size, rgba, width, height }, [rgba.buffer])
}

/**
 * Renders the photograph at its full size in square tiles, because a browser's memory does not hold a whole one.
 *
 * Each tile is rendered with a margin that blur and hidden surfaces do not cross. The file computes the blur from the
 * width of its image, so the f-number is scaled by the tile's share of the whole width.
 */
async function renderTiles({ file, focus, fNumber, tilePx, reachPx }) {
  const dof = await lensOf(file)
  const { rgba: photo, width, height } = scene.photo
  const { depth: map } = scene
  const depth = withoutRange(depthAtSize(map.metres, map.width, map.height, width, height), focus)
  const matte = scene.matte && coverageAtSize(scene.matte, width, height)
  const margin = 2 * Math.ceil(reachPx) + 32
  const rgba = new Uint8ClampedArray(4 * width * height)
  const count = Math.ceil(width / tilePx) * Math.ceil(height / tilePx)
  let done = 0
  for (let top = 0; top < height; top += tilePx) {
    for (let left = 0; left < width; left += tilePx) {
      self.postMessage({ type: 'tile', done: done++, count })
      const [x0, x1] = [Math.max(0, left - margin), Math.min(width, left + tilePx + margin)]
      const [y0, y1] = [Math.max(0, top - margin), Math.min(height, top + tilePx + margin)]
      const [w, h] = [x1 - x0, y1 - y0]
      const light = linearLight(part(photo, 4 * width, 4 * x0, 4 * x1, y0, y1), w, h)
      const metres = part(depth, width, x0, x1, y0, y1)
      const cover = matte && part(matte, width, x0, x1, y0, y1)
      const out = await dof.render(light, metres, w, h, focus.nearM, (fNumber * w) / width, cover)
      const tile = srgbBytes(out)
      for (let y = top; y < Math.min(height, top + tilePx); y++) {
        const row = 4 * w * (y - y0)
        const inner = tile.subarray(row + 4 * (left - x0), row + 4 * (Math.min(width, left + tilePx) - x0))
        rgba.set(inner, 4 * (width * y + left))
      }
    }
  }
  self.postMessage({ type: 'picture', size: 'full', rgba, width, height }, [rgba.buffer])
}

/** Columns x0 to x1 and rows y0 to y1 of an image, a typed array of `across` values a row. */
function part(values, across, x0, x1, y0, y1) {
  const cut = new values.constructor((x1 - x0) * (y1 - y0))
  for (let y = y0; y < y1; y++) cut.set(values.subarray(across * y + x0, across * y + x1), (x1 - x0) * (y - y0))
  return cut
}

self.onmessage = async ({ data }) => {
  try {
    if (data.type === 'scene') {
      scene = data
      sizes.clear()
      const { light, width, height } = atSize('shown')
      const rgba = srgbBytes(light)
      self.postMessage({ type: 'sharp', rgba, width, height }, [rgba.buffer])
      await lensOf(data.file) // last, because the runtime keeps this worker busy for seconds
    } else {
      await (data.size === 'full' ? renderTiles(data) : render(data))
    }
  } catch (error) {
    self.postMessage({ type: 'failed', message: String(error?.message ?? error) })
  }
}
