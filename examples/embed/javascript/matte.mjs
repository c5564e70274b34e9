// Masks of a subject: coverage, 0 to 1.

import { decodePng, isPng } from './png.mjs'

const EQUAL = 8 // largest difference between codes of a grey pixel

/**
 * The coverage that a PNG states: by its transparency if it has any, else by its shades of grey.
 *
 * @param {Uint8Array} bytes
 * @param pixelsOf Decodes another file to {rgba, width, height}.
 * @returns {Promise<{values: Float32Array, width, height}>}
 */
export async function readCoverage(bytes, pixelsOf) {
  const ofBrowser = async () => {
    const { rgba, width, height } = await pixelsOf()
    return { samples: rgba, width, height, channels: 4, bits: 8 }
  }
  const { samples, width, height, channels, bits } = isPng(bytes) ? await decodePng(bytes) : await ofBrowser()
  const [alpha, count, most] = [channels - 1, width * height, 2 ** bits - 1]
  const hasAlpha = channels % 2 === 0 && samples.some((value, i) => i % channels === alpha && value < most)
  const isOfBits = !hasAlpha && samples.every((value, i) => value <= 1 || (channels % 2 === 0 && i % channels === alpha))
  const fullScale = isOfBits ? 1 : most // programs also write 0 and 1
  const values = new Float32Array(count)
  for (let i = 0; i < count; i++) {
    const [red, green, blue] = [0, 1, 2].map((c) => samples[i * channels + c])
    if (!hasAlpha && channels > 2 && Math.max(Math.abs(green - red), Math.abs(blue - red)) > EQUAL) {
      throw new Error('the mask is in colour. Save it as shades of grey, white where the subject is, or as transparency.')
    }
    values[i] = (hasAlpha ? samples[i * channels + alpha] : red) / fullScale
  }
  return { values, width, height }
}

/** Coverage at another size: each new pixel is a mean weighted by a triangle, as wide as two old or two new pixels. */
export function coverageAtSize({ values, width, height }, newWidth, newHeight) {
  if (newWidth === width && newHeight === height) return values
  const [columns, rows] = [triangles(width, newWidth), triangles(height, newHeight)]
  const narrow = new Float32Array(newWidth * height)
  for (let y = 0; y < height; y++) {
    columns.forEach(({ first, weights }, x) => {
      let sum = 0
      weights.forEach((weight, i) => (sum += weight * values[y * width + first + i]))
      narrow[y * newWidth + x] = sum
    })
  }
  const resized = new Float32Array(newWidth * newHeight)
  rows.forEach(({ first, weights }, y) => {
    weights.forEach((weight, i) => {
      for (let x = 0; x < newWidth; x++) resized[y * newWidth + x] += weight * narrow[(first + i) * newWidth + x]
    })
  })
  return resized
}

/** For each of `count` new pixels along a line of `length` old ones: the old pixels of its triangle, and their weights. */
function triangles(length, count) {
  const scale = length / count
  const reach = Math.max(1, scale)
  return Array.from({ length: count }, (_, index) => {
    const centre = (index + 0.5) * scale
    const first = Math.max(0, Math.floor(centre - reach + 0.5))
    const end = Math.min(length, Math.floor(centre + reach + 0.5))
    const weights = Array.from({ length: end - first }, (_, i) =>
      Math.max(0, 1 - Math.abs((first + i + 0.5 - centre) / reach)),
    )
    const total = weights.reduce((sum, weight) => sum + weight)
    return { first, weights: weights.map((weight) => weight / total) }
  })
}
