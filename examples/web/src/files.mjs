// Opens files as pictures and depth maps; errors state the remedy.

import { extremes, greyDepthMap, readDepthMap } from './depth.mjs'
import { coverageOf } from './matte.mjs'
import { decodePng, isPng } from './png.mjs'

const MOST_PIXELS = 16e6 // what phones' browsers draw at once

/** Kind of a file, 'photo', 'depth' or 'matte', by its name, then by its content. */
export async function kindOf(file) {
  if (/depth|disp|\.npy$/i.test(file.name)) return 'depth'
  if (/(^|[^a-z])(matte|mask|alpha)([^a-z]|$)/i.test(file.name)) return 'matte'
  const start = new Uint8Array(await file.slice(0, 33).arrayBuffer())
  const isGrey = isPng(start) && (start[25] === 0 || start[25] === 4)
  return isGrey ? 'depth' : 'photo'
}

/** @returns {Promise<{name, rgba: Uint8ClampedArray, width, height}>} in sRGB, upright. */
export const readPhoto = (file) => named(file, () => pixelsOf(file))

/** @returns {Promise<{name, map: DepthMap}>} */
export const readDepth = (file) => named(file, async () => ({ map: await depthMapOf(file) }))

/** @returns {Promise<{name, map: {values: Float32Array, width, height}}>} coverage by the subject, 0 to 1. */
export const readMatte = (file) =>
  named(file, async () => {
    const bytes = new Uint8Array(await file.arrayBuffer())
    if (isPng(bytes)) return { map: coverageOf(await decodePng(bytes)) }
    const { rgba, width, height } = await pixelsOf(file)
    return { map: coverageOf({ samples: rgba, width, height, channels: 4, bits: 8 }) }
  })

/** What a file holds, with its name, which also stands before the message of an error. */
async function named(file, read) {
  try {
    return { name: file.name, ...(await read()) }
  } catch (error) {
    throw new Error(`${file.name}: ${error.message}`)
  }
}

async function depthMapOf(file) {
  const map = await decodedMap(file)
  const [low, high] = extremes(map.values)
  if (!(low < high)) throw new Error('it has one value everywhere: nothing tells near from far. Choose another file.')
  return map
}

async function decodedMap(file) {
  const bytes = new Uint8Array(await file.arrayBuffer())
  if (isPng(bytes) || bytes[0] === 0x93) return readDepthMap(bytes)
  const { rgba, width, height } = await pixelsOf(file)
  return greyDepthMap(rgba, width, height, 4, 255)
}

async function pixelsOf(file) {
  let bitmap
  try {
    bitmap = await createImageBitmap(file)
  } catch {
    throw new Error('this browser cannot open it as a picture. Save it as JPEG or PNG and choose that.')
  }
  const shrink = Math.min(1, Math.sqrt(MOST_PIXELS / (bitmap.width * bitmap.height)))
  const width = Math.max(1, Math.round(bitmap.width * shrink))
  const height = Math.max(1, Math.round(bitmap.height * shrink))
  const canvas = document.createElement('canvas')
  canvas.width = width
  canvas.height = height
  const context = canvas.getContext('2d', { willReadFrequently: true, colorSpace: 'srgb' })
  context.fillStyle = '#fff' // what is transparent lies on white
  context.fillRect(0, 0, width, height)
  context.imageSmoothingQuality = 'high'
  context.drawImage(bitmap, 0, 0, width, height)
  bitmap.close()
  return { rgba: context.getImageData(0, 0, width, height).data, width, height }
}
