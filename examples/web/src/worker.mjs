// Renders in a worker, so that the page stays responsive.
//
// Takes {type: 'scene', photo, depth, width, height}, then {type: 'render', half, focusM, fNumber}.
// Gives {type: 'ready'}, {type: 'sharp', rgba, width, height}, {type: 'picture', half, rgba, width, height} or {type: 'failed', message}.

import * as ort from './ort.wasm.min.mjs'
import { depthAtSize } from './depth.mjs'
import { DepthOfField } from './depth_of_field.mjs'
import { linearLight, srgbBytes } from './light.mjs'

ort.env.wasm.wasmPaths = new URL('./', import.meta.url).href
ort.env.wasm.numThreads = self.crossOriginIsolated ? Math.min(8, navigator.hardwareConcurrency) : 1

let loading = null // the runtime keeps this worker busy for seconds: the photograph is shown first
let scene
const sizes = new Map() // half or not -> light and depth at that size

async function load() {
  const response = await fetch(new URL('dof.onnx', import.meta.url))
  if (!response.ok) throw new Error(`dof.onnx cannot be loaded (${response.status})`)
  const dof = await DepthOfField.load(ort, new Uint8Array(await response.arrayBuffer()))
  self.postMessage({ type: 'ready' })
  return dof
}

function atSize(half) {
  if (!sizes.has(half)) {
    const { photo, depth } = scene
    const width = half ? Math.ceil(scene.width / 2) : scene.width
    const height = half ? Math.ceil(scene.height / 2) : scene.height
    sizes.set(half, {
      width,
      height,
      light: linearLight(photo.rgba, photo.width, photo.height, width, height),
      depth: depthAtSize(depth.metres, depth.width, depth.height, width, height),
    })
  }
  return sizes.get(half)
}

async function render({ half, focusM, fNumber }) {
  const dof = await loading
  const { light, depth, width, height } = atSize(half)
  const rgba = srgbBytes(await dof.render(light, depth, width, height, focusM, fNumber))
  self.postMessage({ type: 'picture', half, rgba, width, height }, [rgba.buffer])
}

self.onmessage = async ({ data }) => {
  try {
    if (data.type === 'scene') {
      scene = data
      sizes.clear()
      const { light, width, height } = atSize(false)
      const rgba = srgbBytes(light)
      self.postMessage({ type: 'sharp', rgba, width, height }, [rgba.buffer])
      loading ??= load()
      await loading
    } else {
      await render(data)
    }
  } catch (error) {
    self.postMessage({ type: 'failed', message: String(error?.message ?? error) })
  }
}
