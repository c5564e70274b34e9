// Serves a folder on this machine: node serve.mjs FOLDER PORT
//
// Any server of static files works. This one also sends the two headers that a page needs for more than one thread.

import { createReadStream, statSync } from 'node:fs'
import { createServer } from 'node:http'
import { extname, join, normalize, resolve } from 'node:path'

const TYPES = {
  '.css': 'text/css',
  '.html': 'text/html; charset=utf-8',
  '.json': 'application/json',
  '.mjs': 'text/javascript',
  '.png': 'image/png',
  '.svg': 'image/svg+xml',
  '.wasm': 'application/wasm',
}
const HEADERS = { 'Cross-Origin-Opener-Policy': 'same-origin', 'Cross-Origin-Embedder-Policy': 'require-corp' }

const folder = resolve(process.argv[2] ?? 'dist')
const server = createServer((request, response) => {
  const asked = normalize(decodeURIComponent(new URL(request.url, 'http://localhost').pathname))
  const path = join(folder, asked.endsWith('/') ? join(asked, 'index.html') : asked)
  const isFile = statSync(path, { throwIfNoEntry: false })?.isFile()
  response.writeHead(isFile ? 200 : 404, { ...HEADERS, 'Content-Type': TYPES[extname(path)] ?? 'application/octet-stream' })
  if (isFile) createReadStream(path).pipe(response)
  else response.end('not found')
})
server.listen(Number(process.argv[3] ?? 8000), '127.0.0.1', () => {
  console.log(`http://127.0.0.1:${server.address().port}/`)
})
