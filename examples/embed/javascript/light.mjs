// Pixels of a screen (8-bit sRGB) to linear light and back.
//
// Only linear light may be averaged: pixels are decoded before they are resized or blurred, and encoded once at the end.
// Images of light are planar, [3, height, width], as the exported file takes them.

/** sRGB, 0 to 1, to linear light (IEC 61966-2-1). */
export const decoded = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4)

const LIGHT_OF_CODE = Float32Array.from({ length: 256 }, (_, code) => decoded(code / 255))

// Thresholds of light between neighbouring 8-bit codes, and the code at the beginning of each cell of a fine grid.
const NEXT_CODE_AT = Float32Array.from({ length: 255 }, (_, code) => decoded((code + 0.5) / 255))
const CELLS = 4096
const CODE_OF_CELL = Uint8Array.from({ length: CELLS + 1 }, (_, cell) => {
  const code = NEXT_CODE_AT.findIndex((light) => light > cell / CELLS)
  return code < 0 ? 255 : code
})

/**
 * Linear light of an 8-bit sRGB image, at that size or a smaller one.
 *
 * Smaller images are means of light over the area of each new pixel.
 *
 * @param {Uint8Array | Uint8ClampedArray} rgba width * height * 4 bytes; alpha is not read.
 * @returns {Float32Array} [3, newHeight, newWidth]
 */
export function linearLight(rgba, width, height, newWidth = width, newHeight = height) {
  const light = new Float32Array(3 * newWidth * newHeight)
  const plane = newWidth * newHeight
  if (newWidth === width && newHeight === height) {
    for (let i = 0; i < plane; i++) {
      for (let c = 0; c < 3; c++) light[c * plane + i] = LIGHT_OF_CODE[rgba[4 * i + c]]
    }
    return light
  }
  const columns = shares(width, newWidth)
  const rows = shares(height, newHeight)
  for (let y = 0; y < newHeight; y++) {
    for (let j = 0; j < rows[y].weights.length; j++) {
      const row = 4 * width * (rows[y].first + j)
      for (let x = 0; x < newWidth; x++) {
        const { first, weights } = columns[x]
        const out = y * newWidth + x
        for (let i = 0; i < weights.length; i++) {
          const pixel = row + 4 * (first + i)
          const weight = weights[i] * rows[y].weights[j]
          light[out] += weight * LIGHT_OF_CODE[rgba[pixel]]
          light[out + plane] += weight * LIGHT_OF_CODE[rgba[pixel + 1]]
          light[out + 2 * plane] += weight * LIGHT_OF_CODE[rgba[pixel + 2]]
        }
      }
    }
  }
  return light
}

/** For each of `count` new pixels along a line of `length` old ones: the old pixels that it covers, and their weights. */
function shares(length, count) {
  return Array.from({ length: count }, (_, index) => {
    const begin = (index * length) / count
    const end = ((index + 1) * length) / count
    const first = Math.floor(begin)
    const weights = []
    for (let i = first; i < end && i < length; i++) {
      weights.push((Math.min(end, i + 1) - Math.max(begin, i)) / (end - begin))
    }
    return { first, weights }
  })
}

/**
 * Linear light to opaque 8-bit sRGB, rounded to the nearest code; light above white becomes white, NaN black.
 *
 * @param {Float32Array} light [3, height, width]
 * @returns {Uint8ClampedArray} height * width * 4 bytes, as ImageData takes them.
 */
export function srgbBytes(light) {
  const plane = light.length / 3
  const rgba = new Uint8ClampedArray(4 * plane)
  for (let i = 0; i < plane; i++) {
    for (let c = 0; c < 3; c++) {
      const value = light[c * plane + i]
      let code = value >= 1 ? 255 : (CODE_OF_CELL[Math.max(0, Math.floor(value * CELLS))] ?? 0)
      while (code < 255 && value >= NEXT_CODE_AT[code]) code++
      rgba[4 * i + c] = code
    }
    rgba[4 * i + 3] = 255
  }
  return rgba
}
