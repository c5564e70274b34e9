// Depth of field without PyTorch: a file of `torchdof export`, run by onnxruntime-web under Node 18 or newer.
//
// Usage: node run_onnx.mjs dof.onnx photo.png depth.png out.png --focus-m 2.3 --f-number 0.6 --scale 0.001
//        node run_onnx.mjs dof.onnx photo.png depth.npy out.png --focus-m 2.3 --f-number 0.6 --near-m 1 --far-m 8
//
// The photograph is an 8-bit PNG in sRGB. Depth is a grey PNG of 8 or 16 bits or a NumPy array: values times --scale are
// metres (1 if not given), or, with --near-m and --far-m, relative disparity as estimators give it.

import { readFileSync, writeFileSync } from 'node:fs'
import { parseArgs } from 'node:util'
import * as ort from 'onnxruntime-web'
import { depthAtSize, metresOf, readDepthMap } from './depth.mjs'
import { DepthOfField } from './depth_of_field.mjs'
import { linearLight, srgbBytes } from './light.mjs'
import { decodePng, encodePng } from './png.mjs'

const number = { type: 'string' }
const { values: options, positionals } = parseArgs({
  allowPositionals: true,
  options: { 'focus-m': number, 'f-number': number, scale: number, 'near-m': number, 'far-m': number },
})
if (positionals.length !== 4 || !options['focus-m'] || !options['f-number']) {
  console.error('usage: node run_onnx.mjs MODEL PHOTO.png DEPTH OUT.png --focus-m METRES --f-number NUMBER [--scale ...]')
  process.exit(2)
}
const [model, photoFile, depthFile, outFile] = positionals

const photo = await decodePng(readFileSync(photoFile))
if (photo.bits !== 8 || photo.channels < 3) {
  throw new Error(`the photograph must be an 8-bit PNG in colour, got ${photo.bits} bits, ${photo.channels} channels`)
}
const { width, height, channels } = photo
const rgba = new Uint8Array(4 * width * height)
for (let i = 0; i < width * height; i++) {
  for (let c = 0; c < 3; c++) rgba[4 * i + c] = photo.samples[channels * i + c]
}

const meaning = options['near-m']
  ? { kind: 'disparity', nearM: Number(options['near-m']), farM: Number(options['far-m']) }
  : { kind: 'metres', scale: Number(options.scale ?? 1) }
const map = await readDepthMap(readFileSync(depthFile))
const depth = depthAtSize(metresOf(map, meaning), map.width, map.height, width, height)

const dof = await DepthOfField.load(ort, readFileSync(model))
const begin = performance.now()
const light = await dof.render(
  linearLight(rgba, width, height), depth, width, height, Number(options['focus-m']), Number(options['f-number']),
)
console.log(`${width} x ${height}: ${((performance.now() - begin) / 1000).toFixed(2)} s`)
writeFileSync(outFile, await encodePng(srgbBytes(light), width, height, 4))
