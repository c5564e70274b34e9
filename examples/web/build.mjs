// Builds the page: node build.mjs [--out FOLDER] [--model FILE.onnx]
//
// Copies the files of the page, the modules of ../embed/javascript and two files of onnxruntime-web. Python writes the
// exported file and the sample; --model uses an existing file. PYTHON names an interpreter with torchdof; the default is
// that of the repository.

import { spawnSync } from 'node:child_process'
import { cpSync, existsSync, mkdirSync, rmSync } from 'node:fs'
import { createRequire } from 'node:module'
import { dirname, join } from 'node:path'
import { fileURLToPath } from 'node:url'
import { parseArgs } from 'node:util'

const here = dirname(fileURLToPath(import.meta.url))
const { values: options } = parseArgs({
  options: { out: { type: 'string', default: join(here, 'dist') }, model: { type: 'string' } },
})
const require = createRequire(join(process.env.TORCHDOF_NODE_FOLDER ?? here, 'package.json'))
let runtime
try {
  runtime = dirname(require.resolve('onnxruntime-web'))
} catch {
  fail('onnxruntime-web is not installed: npm run build --prefix examples/web installs it')
}
const ownPython = join(here, '..', '..', '.venv', 'bin', 'python')
const python = process.env.PYTHON ?? (existsSync(ownPython) ? ownPython : 'python3')

rmSync(options.out, { recursive: true, force: true })
mkdirSync(options.out, { recursive: true })
cpSync(join(here, 'src'), options.out, { recursive: true })
for (const name of ['depth.mjs', 'depth_of_field.mjs', 'light.mjs', 'matte.mjs', 'png.mjs']) {
  cpSync(join(here, '..', 'embed', 'javascript', name), join(options.out, name))
}
for (const name of ['ort.wasm.min.mjs', 'ort-wasm-simd-threaded.mjs', 'ort-wasm-simd-threaded.wasm']) {
  cpSync(join(runtime, name), join(options.out, name))
}
const model = options.model ? ['--model', options.model] : []
const { error, status } = spawnSync(python, [join(here, 'write_files.py'), '--out', options.out, ...model], { stdio: 'inherit' })
if (error) fail(`${python} cannot be run (${error.code}): run make install, or name a Python: PYTHON=/path/to/python`)
if (status !== 0) process.exit(status ?? 1) // Python has said why
console.log(`the page is in ${options.out}; npm start serves it`)

function fail(message) {
  console.error(message)
  process.exit(1)
}
