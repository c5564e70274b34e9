// Depth maps of any kind to metres along the optical axis, as the exported file takes them.

import { decodePng, isPng } from './png.mjs'

const LEAST_LEVELS = 64 // levels that a map of 8 bits spans at least; with fewer, a step of one level may be an edge
const REACHES_PX = [4, 2, 1] // distances over which steps of one level are smoothed

/** A depth map: one number a pixel, row by row. */
export class DepthMap {
  constructor(values, width, height, fullScale = null) {
    this.values = values // Float32Array
    this.width = width
    this.height = height
    this.fullScale = fullScale // the largest number that the file could hold, null for floating point
  }
}

/**
 * Numbers of a depth map to metres; pixels without depth become NaN.
 *
 * kind         metres                                                    for
 * -----------  --------------------------------------------------------  ----------------------------------------
 * 'metres'     scale * value; zero and less are holes                    renderers, depth cameras (scale 0.001: mm)
 * 'disparity'  1 / metres is linear, the largest value lies at nearM     MiDaS, DPT, Depth Anything
 * 'depth'      metres are linear, the largest value lies at farM         Marigold
 *
 * Relative maps of 8 bits have steps on smooth surfaces, which in a strong blur would appear as fine lines. They become
 * ramps: a value changes by at most half a level.
 *
 * @param {DepthMap} map
 * @param {{kind: string, scale?: number, nearM?: number, farM?: number}} meaning
 * @returns {Float32Array} height * width
 */
export function metresOf(map, { kind, scale = 1, nearM, farM }) {
  if (kind === 'metres') {
    if (!(scale > 0)) throw new Error(`the scale must be a number of metres, greater than 0, got ${scale}`)
    return map.values.map((value) => (value > 0 ? scale * value : NaN))
  }
  if (kind !== 'disparity' && kind !== 'depth') {
    throw new Error(`the kind of depth must be metres, disparity or depth, got ${kind}`)
  }
  if (!(nearM > 0 && farM > nearM)) {
    throw new Error(`the farthest distance must be greater than the nearest, got ${nearM} m to ${farM} m`)
  }
  const [low, high] = extremes(map.values)
  if (!(low < high)) {
    throw new Error('the depth map has one value everywhere: nothing tells near from far. Choose another file.')
  }
  return withoutSteps(map, low, high).map((value) => {
    if (!Number.isFinite(value)) return NaN
    const share = Math.min(1, Math.max(0, (value - low) / (high - low)))
    return kind === 'depth' ? nearM + (farM - nearM) * share : 1 / (share / nearM + (1 - share) / farM)
  })
}

/** The values of a map whose extremes are low and high; if it is of 8 bits, steps of one level are ramps. */
function withoutSteps({ values, width, height }, low, high) {
  const level = high > 1 ? 1 : 1 / 255
  const isWhole = (value) => !Number.isFinite(value) || Math.abs(value / level - Math.round(value / level)) < 1e-3
  const isOf8Bits = high - low > LEAST_LEVELS * level && low >= 0 && high <= 255 * level && values.every(isWhole)
  if (!isOf8Bits) return values
  const smooth = Float32Array.from(values)
  for (const reach of REACHES_PX) {
    for (const [across, down] of [[reach, 0], [0, reach]]) {
      const now = smooth.slice()
      for (let i = 0, y = 0; y < height; y++) {
        const rows = [width * Math.max(0, y - down), width * Math.min(height - 1, y + down)]
        for (let x = 0; x < width; x++, i++) {
          const before = rows[0] + Math.max(0, x - across)
          const after = rows[1] + Math.min(width - 1, x + across)
          if (Math.abs(values[before] - values[i]) < 1.5 * level) smooth[i] += (now[before] - now[i]) / 4
          if (Math.abs(values[after] - values[i]) < 1.5 * level) smooth[i] += (now[after] - now[i]) / 4
        }
      }
    }
  }
  return smooth.map((value, i) => Math.min(values[i] + level / 2, Math.max(values[i] - level / 2, value)))
}

/** The smallest and the largest finite value; [Infinity, -Infinity] without finite values. */
export function extremes(values) {
  let low = Infinity
  let high = -Infinity
  for (const value of values) {
    if (Number.isFinite(value)) {
      if (value < low) low = value
      if (value > high) high = value
    }
  }
  return [low, high]
}

/**
 * Fill holes (NaN) with the farther of the nearest known pixels to the left and right.
 *
 * A pixel without depth would stay sharp inside blurred surroundings.
 *
 * @param {Float32Array} metres height * width; changed.
 * @returns {number} the share of pixels that had no depth.
 */
export function fillHoles(metres, width) {
  const height = metres.length / width
  const rows = Array.from({ length: height }, (_, y) => metres.subarray(y * width, (y + 1) * width))
  let holes = 0
  for (const row of rows) {
    for (let x = 0; x < width; x++) {
      if (!Number.isNaN(row[x])) continue
      let end = x + 1
      while (end < width && Number.isNaN(row[end])) end++
      holes += end - x
      const isWholeRow = end - x === width
      if (!isWholeRow) row.fill(Math.max(x > 0 ? row[x - 1] : 0, end < width ? row[end] : 0), x, end)
      x = end
    }
  }
  const firstKnown = rows.findIndex((row) => !Number.isNaN(row[0]))
  if (firstKnown < 0) throw new Error('the depth map holds no depth at all. Choose another file.')
  for (let y = firstKnown - 1; y >= 0; y--) rows[y].set(rows[y + 1])
  for (let y = firstKnown; y < height; y++) if (Number.isNaN(rows[y][0])) rows[y].set(rows[y - 1])
  return holes / metres.length
}

/** Depth at another size, by nearest neighbour: a mean of two surfaces would be a depth where no surface is. */
export function depthAtSize(metres, width, height, newWidth, newHeight) {
  if (newWidth === width && newHeight === height) return metres
  const resized = new Float32Array(newWidth * newHeight)
  for (let y = 0; y < newHeight; y++) {
    const row = width * Math.floor(((y + 0.5) * height) / newHeight)
    for (let x = 0; x < newWidth; x++) {
      resized[y * newWidth + x] = metres[row + Math.floor(((x + 0.5) * width) / newWidth)]
    }
  }
  return resized
}

/**
 * Read a depth map from the bytes of a file: a PNG of 8 or 16 bits, or a NumPy array (.npy).
 *
 * @param {Uint8Array} bytes
 * @returns {Promise<DepthMap>}
 */
export async function readDepthMap(bytes) {
  if (isPng(bytes)) {
    const { samples, width, height, channels, bits } = await decodePng(bytes)
    return greyDepthMap(samples, width, height, channels, 2 ** bits - 1)
  }
  if (bytes[0] === 0x93 && String.fromCharCode(...bytes.subarray(1, 6)) === 'NUMPY') return depthOfNpy(bytes)
  throw new Error('a depth map must be a PNG file or a NumPy array (.npy)')
}

/** A depth map from a PNG with equal colour channels; the alpha of two or four channels is ignored. */
export function greyDepthMap(samples, width, height, channels, fullScale) {
  const values = greyValues(samples, width * height, channels)
  if (values === null) {
    throw new Error(
      'the depth map is in colour. Colours are made for eyes: save the depth itself, as shades of grey, and load that.',
    )
  }
  return new DepthMap(values, width, height, fullScale)
}

/** The shades of grey of an image, or null if its colour channels differ; alpha is ignored. */
export function greyValues(samples, count, channels) {
  const values = new Float32Array(count)
  for (let i = 0; i < count; i++) {
    const at = i * channels
    values[i] = samples[at]
    if (channels > 2 && (Math.abs(samples[at + 1] - samples[at]) > 8 || Math.abs(samples[at + 2] - samples[at]) > 8)) return null
  }
  return values
}

const NPY_TYPES = {
  '<f4': Float32Array,
  '<f8': Float64Array,
  '<u2': Uint16Array,
  '<i2': Int16Array,
  '<i4': Int32Array,
  '<u4': Uint32Array,
  '|u1': Uint8Array,
}

/** A depth map from a NumPy file, whose header is text after ten or twelve bytes. */
function depthOfNpy(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength)
  const begin = bytes[6] === 1 ? 10 : 12
  const end = begin + (begin === 10 ? view.getUint16(8, true) : view.getUint32(8, true))
  const header = new TextDecoder('latin1').decode(bytes.subarray(begin, end))
  const type = header.match(/'descr':\s*'([^']+)'/)?.[1]
  const shape = header.match(/'shape':\s*\(([^)]*)\)/)?.[1].split(',').filter((x) => x.trim()).map(Number)
  const Values = NPY_TYPES[type]
  if (!shape || !Values || header.includes("'fortran_order': True")) {
    throw new Error(`a NumPy file must hold an array of numbers in C order, this one holds ${type ?? 'something else'}`)
  }
  const sides = shape.filter((n) => n !== 1)
  if (sides.length !== 2) throw new Error(`a depth map has height and width, this NumPy file has the shape (${shape})`)
  const [height, width] = sides
  const size = width * height * Values.BYTES_PER_ELEMENT
  if (bytes.length < end + size) throw new Error('the NumPy file ends before its last number: it is damaged')
  const values = new Values(Uint8Array.from(bytes.subarray(end, end + size)).buffer)
  const fullScale = type[1] === 'f' ? null : 2 ** (8 * Values.BYTES_PER_ELEMENT) - 1
  return new DepthMap(Float32Array.from(values), width, height, fullScale)
}
