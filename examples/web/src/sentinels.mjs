// Numbers of a depth map that mark pixels without depth: found by their distance from all others.
// The rule is that of torchdof/depth/sentinels.py; a test compares the results.

const LIMITS = [32767, 32768, 65472, 65504, 65534, 65535, 2 ** 31, 2 ** 32] // largest numbers of types; 255 is white
const LIMIT_RATIO = 1.25 // of such a number over the next smaller one
const OTHER_RATIO = 50 // of another number over the next smaller one
const MOST = 4 // different sentinels of a map

/**
 * A map with NaN for numbers that mark pixels without depth.
 *
 * The largest number is such a mark if it is that of a type, such as 65535, and 1.25 times the next smaller number, or if
 * it is 50 times the next one, such as 1e10. The only negative number is one if it is whole, such as -1.
 *
 * @param {Float32Array} values
 * @returns {Float32Array} the same one without such numbers.
 */
export function withoutSentinels(values) {
  const below = (limit) => values.reduce((most, value) => (value < limit && value > most ? value : most), -Infinity)
  const above = (limit) => values.reduce((least, value) => (value > limit && value < least ? value : least), Infinity)
  const sentinels = new Set()
  let [largest, next] = [below(Infinity), NaN]
  for (; sentinels.size < MOST; largest = next) {
    next = below(largest)
    if (!(next > 0) || below(next) === -Infinity) break // of fewer than three numbers none is far from all others
    if (largest <= (LIMITS.includes(largest) ? LIMIT_RATIO : OTHER_RATIO) * next) break
    sentinels.add(largest)
  }
  const lowest = above(-Infinity)
  const following = above(lowest)
  if (lowest < 0 && following >= 0 && following < largest && Number.isInteger(lowest)) sentinels.add(lowest)
  return sentinels.size ? values.map((value) => (sentinels.has(value) ? NaN : value)) : values
}
