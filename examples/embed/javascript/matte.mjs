// Masks of a subject: coverage, 0 to 1.

import { greyValues } from './depth.mjs'

/**
 * The coverage that an image states: by its transparency if it has any, else by its shades of grey.
 *
 * @param image {samples, width, height, channels, bits}, as decodePng returns it.
 * @returns {{values: Float32Array, width, height}}
 */
export function coverageOf({ samples, width, height, channels, bits }) {
  const fullScale = 2 ** bits - 1
  const alpha = channels % 2 === 0 && Float32Array.from({ length: width * height }, (_, i) => samples[(i + 1) * channels - 1])
  const isTransparent = alpha && alpha.some((value) => value < fullScale)
  const values = isTransparent ? alpha : greyValues(samples, width * height, channels)
  if (values === null) {
    throw new Error('the mask is in colour. Save it as shades of grey, white where the subject is, or as transparency.')
  }
  const most = !isTransparent && values.every((value) => value <= 1) ? 1 : fullScale // programs also write 0 and 1
  return { values: values.map((value) => value / most), width, height }
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
