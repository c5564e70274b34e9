// Seconds from a click to the picture, in headless Chromium: node measure.mjs [WIDTHxHEIGHT [DIST [CHROMIUM]]]
//
// The sample is enlarged and cropped to that size. Also prints the processor time of all processes of Chromium (Linux),
// on which other programs have less influence. Needs playwright-core, here or in TORCHDOF_NODE_FOLDER.

import { execFileSync, spawn } from 'node:child_process'
import { readFileSync } from 'node:fs'
import { createRequire } from 'node:module'
import { dirname, join } from 'node:path'
import { fileURLToPath } from 'node:url'

const here = dirname(fileURLToPath(import.meta.url))
const [size = '960x540', dist = join(here, 'dist'), executablePath = '/usr/bin/chromium-headless-shell'] = process.argv.slice(2)
const [width, height] = size.split('x').map(Number)
const require = createRequire(join(process.env.TORCHDOF_NODE_FOLDER ?? here, 'package.json'))
const { chromium } = require('playwright-core')

const server = spawn('node', [join(here, 'serve.mjs'), dist, '0'])
const address = await new Promise((resolve) => server.stdout.once('data', (text) => resolve(String(text).trim())))
const browser = await chromium.launch({ executablePath, args: ['--no-sandbox'] })
const page = await browser.newPage({ viewport: { width: 1280, height: 860 } })

/** Processor time in seconds of this process's descendants. */
function processorTime() {
  const lines = execFileSync('ps', ['-eo', 'pid=,ppid='], { encoding: 'utf8' }).trim().split('\n')
  const parents = new Map(lines.map((line) => line.trim().split(/\s+/).map(Number)))
  const isOurs = (pid) => pid === process.pid || (parents.has(pid) && isOurs(parents.get(pid)))
  let ticks = 0
  for (const pid of parents.keys()) {
    if (pid === process.pid || !isOurs(pid)) continue
    try {
      const fields = readFileSync(`/proc/${pid}/stat`, 'utf8').split(') ')[1].split(' ')
      ticks += Number(fields[11]) + Number(fields[12])
    } catch {
      // it has ended meanwhile
    }
  }
  return ticks / 100
}

async function timed(what, act) {
  const [clock, processor] = [performance.now(), processorTime()]
  await act()
  const isDone = () => document.querySelector('#status').textContent.includes('Click what should be sharp')
  await page.waitForFunction(isDone, null, { timeout: 600_000 })
  const seconds = ((performance.now() - clock) / 1000).toFixed(1)
  console.log(`${what}: ${seconds} s, ${(processorTime() - processor).toFixed(1)} s of the processor`)
}

try {
  await timed('opened, the sample rendered', () => page.goto(address))
  const files = await page.evaluateHandle(async ([width, height]) => {
    const enlarged = async (name, smooth) => {
      const bitmap = await createImageBitmap(await (await fetch(`sample/${name}`)).blob())
      const canvas = document.createElement('canvas')
      canvas.width = width
      canvas.height = height
      const context = canvas.getContext('2d')
      context.imageSmoothingEnabled = smooth
      context.drawImage(bitmap, 0, 0, bitmap.width, (bitmap.width * height) / width, 0, 0, width, height)
      return new File([await new Promise((resolve) => canvas.toBlob(resolve))], name)
    }
    const transfer = new DataTransfer()
    transfer.items.add(await enlarged('motorcycle.png', true))
    transfer.items.add(await enlarged('motorcycle_depth.png', false))
    return transfer
  }, [width, height])
  await page.selectOption('#size', String(Math.max(width, height)))
  await timed(`${width} x ${height} dropped`, async () => {
    await page.dispatchEvent('#frame', 'drop', { dataTransfer: files })
    await page.waitForFunction((width) => document.querySelector('#status').textContent.includes(String(width)), width)
    await page.selectOption('#kind', 'depth')
    await page.fill('#near', '2.1')
    await page.fill('#far', '5')
  })
  const box = await page.locator('#frame').boundingBox()
  for (const [u, v] of [[0.55, 0.7], [0.3, 0.2], [0.55, 0.7], [0.3, 0.2], [0.55, 0.7]]) {
    await timed('click', () => page.mouse.click(box.x + u * box.width, box.y + v * box.height))
    console.log(`  ${await page.locator('#status').innerText()} ${await page.locator('#blur-note').innerText()}`)
  }
} finally {
  await browser.close()
  server.kill()
}
