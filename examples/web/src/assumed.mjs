// What `torchdof render` assumes where no option says more: the kind of a depth map, the subject, the opening of the lens.
// The rules are those of torchdof/depth/guess.py and torchdof/cli/lens.py; a test compares their results.

import { withoutSentinels } from './sentinels.mjs'

const MOST_SAMPLES = 65_536
const LARGEST_8_BIT = 255
const SMALLEST_16_BIT = 60_000
const LEAST_LEVELS = 16 // fewer different whole numbers may be floating-point numbers by chance
const NEAR_ZERO = 0.05
const NEAR_SHARE = 0.1 // the same as a share of the largest number
const EMPTY_GAP = 0.1 // smallest number over the largest from which a 0 is no number of the map
const NO_METRES = 100 // m; a picture whose nearest surface is farther away has no depth of field
const KITTI_ASPECTS = [3.1, 3.7] // width over height of KITTI's pictures, whose maps hold metres * 256
const KITTI_EMPTY = 0.6 // share of zeros from which whole numbers are a lidar's, as in KITTI's maps
const CLEAR_CORRELATION = 0.35
const CLEAR_DIFFERENCE = 0.3 // of mean ranks between the bottom's middle and the upper corners

const BINS = 64
const REACH_BINS = 3
const MIDDLE_SIGMA = 1 / 6
const OUTLIERS = 0.01
const SUBJECT_SHARE = 0.2

const BLUR_SHARE = 0.02 // largest blur radius over the width of the picture
const PER_OUTLIER = 1000 // one pixel in 1000 is ignored as an outlier

/**
 * The likely meaning of the numbers of a depth map.
 *
 * Whole numbers are relative depth if the largest is at most 255 or at least 60,000, else millimetres; in maps of KITTI's
 * shape, or if most are 0, metres times 256. Other numbers are relative depth if they lie in [0, 1] and come near 0, or if
 * some are negative, else metres; from 100 on millimetres, or relative depth if a person is larger. Relative depth is larger for nearer surfaces, unless it clearly shrinks downwards, because
 * the ground is nearer than the sky; or, where this is unclear, is smaller in the middle of the bottom than in the upper
 * corners, because a person is nearer than the background.
 *
 * @param {DepthMap} map
 * @returns {{kind: 'disparity' | 'depth' | 'metres', scale: number}} as `metresOf` takes them.
 */
export function guessMeaning(map) {
  const { width, height } = map
  const values = withoutSentinels(map.values)
  const isHole = holeTest(values)
  let [low, high, positive] = [Infinity, -Infinity, Infinity]
  for (const value of values) {
    if (!Number.isFinite(value) || isHole(value)) continue
    low = Math.min(low, value)
    high = Math.max(high, value)
    if (value > 0) positive = Math.min(positive, value)
  }
  if (low === 0 && positive > EMPTY_GAP * high) low = positive // 0 means "not measured"
  const isWhole = holdsWholeNumbers(map, values)
  const downwards = growthDownwards(values, width, height, isHole)
  const isRelative = isWhole
    ? high <= LARGEST_8_BIT || high >= SMALLEST_16_BIT
    : low < 0 || (high <= 1 && low < Math.max(NEAR_ZERO, NEAR_SHARE * high))
  if (isRelative) {
    const isClear = Math.abs(downwards) > CLEAR_CORRELATION
    const isFarther = isClear ? downwards < 0 : growthToPerson(values, width, height, isHole) < -CLEAR_DIFFERENCE
    return { kind: isFarther ? 'depth' : 'disparity', scale: 1 }
  }
  if (downwards > CLEAR_CORRELATION) return { kind: 'disparity', scale: 1 }
  if (!isWhole && low < NO_METRES) return { kind: 'metres', scale: 1 }
  if (!isWhole) {
    const isNearer = growthToPerson(values, width, height, isHole) > CLEAR_DIFFERENCE
    return isNearer ? { kind: 'disparity', scale: 1 } : { kind: 'metres', scale: 0.001 }
  }
  const [aspect, empty] = [width / height, values.filter((value) => value === 0).length / values.length]
  const isOfKitti = (KITTI_ASPECTS[0] < aspect && aspect < KITTI_ASPECTS[1]) || empty > KITTI_EMPTY
  return { kind: 'metres', scale: isOfKitti ? 1 / 256 : 0.001 }
}

/** A map in which pixels without depth are NaN. In renderings in metres, a huge number is the distance of the sky. */
export function knownMap(map, kind) {
  const values = withoutSentinels(map.values)
  return kind === 'metres' && !holdsWholeNumbers(map, values) ? map : { ...map, values }
}

/** Whether a map holds whole numbers, by its file or by its values. */
function holdsWholeNumbers({ fullScale }, values) {
  if (fullScale !== null) return true
  const isHole = holeTest(values)
  const levels = new Set() // the first different values
  for (const value of values) {
    if (!Number.isFinite(value) || isHole(value)) continue
    if (!Number.isInteger(value)) return false
    if (levels.size < LEAST_LEVELS) levels.add(value)
  }
  return levels.size === LEAST_LEVELS
}

/** Whether a value marks pixels without depth: the negative number, if all negative numbers are the same. */
function holeTest(values) {
  const negative = values.filter((value) => value < 0)
  const isMark = negative.length > 1 && negative.every((value) => value === negative[0])
  return (value) => isMark && value < 0
}

/** The samples with a value, in the order of their values. */
function knownInOrder(samples, values, isHole) {
  const known = samples.filter(({ i }) => Number.isFinite(values[i]) && values[i] !== 0 && !isHole(values[i]))
  return known.sort((a, b) => values[a.i] - values[b.i])
}

/** Mean rank, in [0, 1], in the middle of the bottom less that in the upper corners; positive if it is larger. */
function growthToPerson(values, width, height, isHole) {
  const samples = sampled(width, height)
  const [columns, rows] = [samples.at(-1).x, samples.at(-1).y]
  const sums = { bottom: [0, 0], corners: [0, 0] } // of ranks, and their number
  let rank = 0 // the number of smaller values
  knownInOrder(samples, values, isHole).forEach(({ i, x, y }, place, known) => {
    if (place === 0 || values[i] !== values[known[place - 1].i]) rank = place
    const fromMiddle = Math.abs(x / columns - 0.5)
    const area = y / rows > 0.6 && fromMiddle < 0.2 ? 'bottom' : y / rows < 0.4 && fromMiddle > 0.25 ? 'corners' : null
    if (area === null) return
    sums[area][0] += rank / known.length
    sums[area][1]++
  })
  const { bottom, corners } = sums
  return bottom[1] && corners[1] ? bottom[0] / bottom[1] - corners[0] / corners[1] : 0
}

/** Correlation of the ranks of the values with their rows, in [-1, 1]; positive if values grow downwards. */
function growthDownwards(values, width, height, isHole) {
  const known = knownInOrder(sampled(width, height), values, isHole)
  const ranks = new Float64Array(known.length)
  for (let begin = 0; begin < known.length; ) {
    let end = begin
    while (end < known.length && values[known[end].i] === values[known[begin].i]) end++
    ranks.fill((begin + end) / 2, begin, end) // equal values have equal ranks
    begin = end
  }
  const rows = known.map(({ y }) => y)
  const mean = (numbers) => numbers.reduce((sum, number) => sum + number, 0) / numbers.length
  const [meanRow, meanRank] = [mean(rows), mean(ranks)]
  let [both, ofRows, ofRanks] = [0, 0, 0]
  rows.forEach((row, k) => {
    both += (row - meanRow) * (ranks[k] - meanRank)
    ofRows += (row - meanRow) ** 2
    ofRanks += (ranks[k] - meanRank) ** 2
  })
  return both / Math.max(Math.sqrt(ofRows * ofRanks), 1e-12) || 0
}

/** Every n-th pixel of every n-th row, so that about 65,536 remain: {i: index, x, y: place among the samples}. */
function sampled(width, height) {
  const step = Math.ceil(Math.sqrt((width * height) / MOST_SAMPLES))
  const samples = []
  for (let y = 0, row = step >> 1; row < height; y++, row += step) {
    for (let x = 0, column = step >> 1; column < width; x++, column += step) samples.push({ i: row * width + column, x, y })
  }
  return samples
}

/**
 * The subject in the middle of the picture: the nearest surface that fills at least a fifth of the middle.
 *
 * Surfaces are peaks in a histogram that is linear in the numbers of the map: over depth for the kind 'depth', over
 * 1 / depth otherwise.
 *
 * @param {Float32Array} metres height * width
 * @returns {{distanceM, u, v}} its distance, and a point of it near the middle, 0 to 1 from the top left corner.
 */
export function subjectOf(metres, width, height, kind) {
  const samples = sampled(width, height)
  const [columns, rows] = [samples.at(-1).x + 1, samples.at(-1).y + 1]
  const fromMiddle = (place, count) => (place + 1) / (count + 1) - 0.5
  const isLinear = kind === 'depth'
  for (const sample of samples) {
    const depth = metres[sample.i]
    const [x, y] = [fromMiddle(sample.x, columns), fromMiddle(sample.y, rows)]
    sample.nearness = isLinear ? -depth : 1 / depth
    sample.weight = Math.exp(-0.5 * ((y / MIDDLE_SIGMA) ** 2 + (x / MIDDLE_SIGMA) ** 2))
  }
  const known = samples.filter(({ i }) => metres[i] > 0 && (!isLinear || Number.isFinite(metres[i])))
  known.sort((a, b) => a.nearness - b.nearness)
  const [low, high] = [OUTLIERS, 1 - OUTLIERS].map((share) => known[Math.floor(share * (known.length - 1))].nearness)
  const binWidth = Math.max(high - low, 1e-9) / BINS
  const total = known.reduce((sum, { weight }) => sum + weight, 0)
  const shares = new Float64Array(BINS)
  for (const sample of known) {
    sample.bin = Math.floor(Math.min(BINS - 1, Math.max(0, (sample.nearness - low) / binWidth)))
    shares[sample.bin] += sample.weight / total
  }
  const windows = Array.from(shares, (_, bin) => shares.subarray(Math.max(0, bin - REACH_BINS), bin + REACH_BINS + 1))
  const windowShares = windows.map((window) => window.reduce((sum, share) => sum + share, 0))
  const least = Math.min(SUBJECT_SHARE, Math.max(...windowShares))
  const isSubject = (share, bin) => share > 0 && windowShares[bin] >= least && share === Math.max(...windows[bin])
  let peak = windowShares.indexOf(Math.max(...windowShares))
  shares.forEach((share, bin) => (peak = isSubject(share, bin) ? bin : peak))
  const surface = known.filter(({ bin }) => Math.abs(bin - peak) <= REACH_BINS)
  const half = surface.reduce((sum, { weight }) => sum + weight, 0) / 2
  let sum = 0
  const median = surface.find(({ weight }) => (sum += weight) >= half).nearness
  const shown = surface.filter(({ nearness }) => Math.abs(nearness - median) <= binWidth)
  const { x, y } = shown.reduce((best, sample) => (sample.weight > best.weight ? sample : best))
  const distanceM = isLinear ? -median : median > 0 ? 1 / median : Infinity
  return { distanceM, u: (x + 0.5) / columns, v: (y + 0.5) / rows }
}

/** The distances of a depth map in order, as `fNumberFor` takes them; at most about a million. */
export function inOrder(metres) {
  const step = 1 + Math.floor(metres.length / 2 ** 20)
  return Float32Array.from({ length: Math.ceil(metres.length / step) }, (_, i) => metres[i * step]).sort()
}

/**
 * The f-number with which the largest blur radius is 2 % of the width of the picture; null if nothing is blurred.
 *
 * @param {Float32Array} distances those of the scene, in order.
 * @param {(depthM: number) => number} radius the signed radius at f/1 over the width of the picture; it grows with depth.
 */
export function fNumberFor(distances, radius) {
  let [first, last] = [0, distances.length - 1]
  const size = (index) => Math.abs(radius(distances[index]))
  for (let outliers = Math.floor(distances.length / PER_OUTLIER); outliers > 0; outliers--) {
    if (size(first) > size(last)) first++
    else last--
  }
  const largest = Math.max(size(first), size(last))
  return largest > 0 ? largest / BLUR_SHARE : null
}
