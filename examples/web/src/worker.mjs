// Renders away from the page, which stays quick meanwhile.
//
// Takes {type: 'scene', photo, depth, width, height}, then {type: 'render', id, half, focusM, fNumber}.
// Gives {type: 'ready'}, {type: 'sharp', rgba, width, height}, {type: 'picture', id, half, rgba, width, height} or {type: 'failed', message}.

import * as ort from './ort.wasm.min.mjs'
import { depthAtSize } from './depth.mjs'
import { DepthOfField } from './depth_of_field.mjs'
import { linearLight, srgbBytes } from './light.mjs'

ort.env.wasm.wasmPaths = new URL('./', import.meta.url).href
ort.env.wasm.numThreads = self.crossOriginIsolated ? Math.min(8, navigator.hardwareConcurrency) : 1

const loading = load()
let scene
const sizes = new Map() // half or not -> light and depth at that size

async function load() {
  const response = await fetch(new URL('dof.onnx', import.meta.url))
  if (!response.ok) throw new Error(`dof.onnx cannot be loaded (${response.status})`)
  return DepthOfField.load(ort, new Uint8Array(await response.arrayBuffer()))
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

async function render({ id, half, focusM, fNumber }) {
  const dof = await loading
  const { light, depth, width, height } = atSize(half)
  const rgba = srgbBytes(await dof.render(light, depth, width, height, focusM, fNumber))
  self.postMessage({ type: 'picture', id, half, rgba, width, height }, [rgba.buffer])
}

self.onmessage = async ({ data }) => {
  try {
    if (data.type === 'scene') {
      scene = data
      sizes.clear()
      const { light, width, height } = atSize(false)
      const rgba = srgbBytes(light)
      self.postMessage({ type: 'sharp', rgba, width, height }, [rgba.buffer])
    } else {
      await render(data)
    }
  } catch (error) {
    self.postMessage({ type: 'failed', message: String(error?.message ?? error) })
  }
}

loading.then(
  () => self.postMessage({ type: 'ready' }),
  (error) => self.postMessage({ type: 'failed', message: String(error?.message ?? error) }),
)
