// Time of a file in onnxruntime-web: node exported_speed.mjs MODEL FEED.json RUNS, with one thread, under Node.
//
// FEED.json is {name: {dims, data: base64 of float32}}. Prints seconds a run, of the processor, after one to warm up.
// exported_speed.py --web FOLDER calls it; FOLDER has node_modules/onnxruntime-web.

import { readFileSync } from 'node:fs'
import { createRequire } from 'node:module'
import { dirname, join } from 'node:path'
import { pathToFileURL } from 'node:url'

const [model, feedFile, runs] = process.argv.slice(2)
const require = createRequire(join(process.env.TORCHDOF_NODE_FOLDER, 'package.json'))
const folder = dirname(require.resolve('onnxruntime-web'))
const loaded = await import(pathToFileURL(join(folder, 'ort.wasm.min.mjs')))
const ort = loaded.default ?? loaded
ort.env.wasm.numThreads = 1
ort.env.wasm.wasmPaths = `${pathToFileURL(folder).href}/`
ort.env.logLevel = 'error'

const feed = {}
for (const [name, { dims, data }] of Object.entries(JSON.parse(readFileSync(feedFile, 'utf8')))) {
  const bytes = Uint8Array.from(Buffer.from(data, 'base64'))
  feed[name] = new ort.Tensor('float32', new Float32Array(bytes.buffer), dims)
}
const session = await ort.InferenceSession.create(new Uint8Array(readFileSync(model)), { executionProviders: ['wasm'] })
const seconds = []
for (let run = 0; run <= Number(runs); run += 1) {
  const start = process.cpuUsage()
  await session.run(feed)
  const { user, system } = process.cpuUsage(start)
  if (run > 0) seconds.push((user + system) / 1e6)
}
console.log(JSON.stringify(seconds))
