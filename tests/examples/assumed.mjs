// What the page assumes about depth maps: node assumed.mjs FOLDER, with maps as FOLDER/*.npy, prints the results as JSON.
import { readFileSync, readdirSync } from 'node:fs'
import { join, resolve } from 'node:path'
import { pathToFileURL } from 'node:url'

const load = (path) => import(pathToFileURL(resolve('examples', path)).href)
const { fillHoles, metresOf, readDepthMap } = await load('embed/javascript/depth.mjs')
const { fNumberFor, guessMeaning, inOrder, knownMap, subjectOf } = await load('web/src/assumed.mjs')
const { cocPx, withoutRange } = await load('web/src/optics.mjs')

const folder = process.argv[2]
const camera = { focal_length_mm: 50, sensor_width_mm: 36 }
const results = {}
for (const name of readdirSync(folder).filter((name) => name.endsWith('.npy'))) {
  const map = await readDepthMap(readFileSync(join(folder, name)))
  const meaning = guessMeaning(map)
  const metres = metresOf(knownMap(map, meaning.kind), { ...meaning, nearM: 1, farM: 8 })
  fillHoles(metres, map.width)
  const subject = subjectOf(metres, map.width, map.height, meaning.kind)
  const focus = { nearM: subject.distanceM, farM: subject.distanceM }
  const fNumber = fNumberFor(inOrder(metres), (depthM) => cocPx(camera, 1, focus, 1, depthM))
  const at = Math.floor(subject.v * map.height) * map.width + Math.floor(subject.u * map.width)
  results[name] = { ...meaning, ...subject, fNumber, shownM: metres[at] }
}
const depths = Float32Array.of(1, 2, 3, 4, Infinity)
const range = { nearM: 2, farM: 3 }
const moved = withoutRange(depths, range)
const one = { nearM: 2, farM: 2 }
results.range = Array.from(depths, (depthM, i) => [cocPx(camera, 100, range, 2, depthM), cocPx(camera, 100, one, 2, moved[i])])
results.unmoved = withoutRange(depths, one) === depths
console.log(JSON.stringify(results, (_, value) => (value === Infinity ? 'inf' : value)))
