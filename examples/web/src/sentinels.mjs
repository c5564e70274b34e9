// Numbers of a depth map that mark pixels without depth: found by their distance from all others.
// The rule is that of torchdof/depth/sentinels.py; a test compares the results.

const LIMITS = [32767, 32768, 65472, 65504, 65534, 65535, 2 ** 31, 2 ** 32] // largest numbers of types; 255 is white
const [LIMIT_RATIO, HIGH_RATIO, OTHER_RATIO] = [1.25, 4, 50] // over the next smaller number: of a limit, if high, else
const HIGH = 60000 // smallest number that may be a mark of 16 bits, such as 65000
const MOST = 4 // different marks of a map, and negative ones

/**
 * A map with NaN for numbers that mark pixels without depth.
 *
 * Up to four of the largest numbers are such marks if the smallest of them is that of a type, such as 65535, and 1.25
 * times the next smaller number; is 60,000 or more, and 4 times the next one; or is 50 times the next one, such as 1e10.
 * Up to four negative numbers are marks if they are whole, such as -1; several only beside numbers that are not whole, or
 * that are larger than the distance of the lowest from 0.
 *
 * @param {Float32Array} values
 * @returns {Float32Array} the same one without such numbers.
 */
export function withoutSentinels(values) {
  const below = (limit) => values.reduce((most, value) => (value < limit && value > most ? value : most), -Infinity)
  const above = (limit) => values.reduce((least, value) => (value > limit && value < least ? value : least), Infinity)
  const firstOf = (next, start) => {
    const levels = []
    for (let level = next(start); levels.length < MOST + 2 && Number.isFinite(level); level = next(level)) levels.push(level)
    return levels
  }
  const top = firstOf(below, Infinity)
  let count = 0
  for (let k = 1; k <= MOST && k < top.length - 1; k++) { // two numbers at least are not marks
    const [number, next] = [top[k - 1], top[k]]
    const ratio = LIMITS.includes(number) ? LIMIT_RATIO : number >= HIGH ? HIGH_RATIO : OTHER_RATIO
    if (next > 0 && number > ratio * next) count = k
  }
  const marks = new Set(top.slice(0, count))
  const lowest = firstOf(above, -Infinity).filter((level) => !marks.has(level))
  const negative = lowest.filter((level) => level < 0)
  const least = above(0)
  const isMark = negative.length > 0 && negative.length <= MOST && Number.isFinite(least) && !marks.has(least)
  if (isMark && lowest.length > 2 && negative.every(Number.isInteger)) {
    const isWhole = () => values.every((value) => !Number.isFinite(value) || Number.isInteger(value))
    if (negative.length === 1 || least > -negative[0] || !isWhole()) negative.forEach((level) => marks.add(level))
  }
  return marks.size ? values.map((value) => (marks.has(value) ? NaN : value)) : values
}
