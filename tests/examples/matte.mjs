// What the page reads as a mask: node matte.mjs FOLDER, with masks as FOLDER/*.png, prints the coverage as JSON, at its own
// size and at others.
import { readFileSync, readdirSync } from 'node:fs'
import { join, resolve } from 'node:path'
import { pathToFileURL } from 'node:url'

const { decodePng } = await import(pathToFileURL(resolve('examples/embed/javascript/png.mjs')).href)
const { coverageAtSize, coverageOf } = await import(pathToFileURL(resolve('examples/embed/javascript/matte.mjs')).href)
const { DepthOfField } = await import(pathToFileURL(resolve('examples/embed/javascript/depth_of_field.mjs')).href)

const folder = process.argv[2]
const results = {}
for (const name of readdirSync(folder).filter((name) => name.endsWith('.png'))) {
  try {
    const mask = coverageOf(await decodePng(readFileSync(join(folder, name))))
    const sizes = [[mask.width, mask.height], [5, 4], [37, 23]]
    results[name] = sizes.map(([width, height]) => ({ width, height, values: [...coverageAtSize(mask, width, height)] }))
  } catch (error) {
    results[name] = error.message
  }
}

// what a file is given, with a session that returns its inputs
const ort = { Tensor: function (type, data, dims) { Object.assign(this, { type, data, dims }) } }
for (const inputNames of [['image', 'matte'], ['image']]) {
  const dof = new DepthOfField(ort, { inputNames, run: async (inputs) => ({ out: { data: inputs.matte?.data } }) })
  const fed = async (matte) => {
    try {
      return [...((await dof.render(new Float32Array(6), new Float32Array(2), 2, 1, 1, 1, matte)) ?? [])]
    } catch (error) {
      return error.message
    }
  }
  results[inputNames.join(' ')] = [await fed(null), await fed(Float32Array.of(0.25, 1)), await fed(Float32Array.of(1))]
}
console.log(JSON.stringify(results))
