// Runs an ONNX file in onnxruntime-web (WebAssembly): node web.mjs MODEL FEED.json OUT.json
// FEED.json: {name: {dims, data: base64 of float32}}; OUT.json: {version, dims, data}.
import { readFileSync, writeFileSync } from 'node:fs'
import { createRequire } from 'node:module'
import { dirname, join } from 'node:path'
import { pathToFileURL } from 'node:url'

const [model, feedFile, outFile] = process.argv.slice(2)
const require = createRequire(join(process.env.TORCHDOF_NODE_FOLDER, 'package.json'))
const entry = require.resolve('onnxruntime-web')
const ort = await import(pathToFileURL(join(dirname(entry), 'ort.wasm.min.mjs')))
const runtime = ort.default ?? ort
runtime.env.wasm.numThreads = 1
runtime.env.wasm.wasmPaths = pathToFileURL(dirname(entry)).href + '/'
runtime.env.logLevel = 'error'

const floats = (text) => {
  const bytes = Uint8Array.from(Buffer.from(text, 'base64'))
  return new Float32Array(bytes.buffer)
}
const feed = {}
for (const [name, { dims, data }] of Object.entries(JSON.parse(readFileSync(feedFile, 'utf8')))) {
  feed[name] = new runtime.Tensor('float32', floats(data), dims)
}
const session = await runtime.InferenceSession.create(new Uint8Array(readFileSync(model)), {
  executionProviders: ['wasm'],
})
const { out } = await session.run(feed)
const data = Buffer.from(out.data.buffer, out.data.byteOffset, out.data.byteLength).toString('base64')
const version = runtime.env.versions.web ?? runtime.env.versions.common
writeFileSync(outFile, JSON.stringify({ version, dims: out.dims, data }))
