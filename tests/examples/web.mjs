// Clicks, drags and types in the page, in headless Chromium: node web.mjs DIST OUT CHROMIUM
// Leaves OUT/results.json, the saved files and screenshots. DIST is the page, as examples/web/build.mjs writes it.
import { spawn } from 'node:child_process'
import { readFileSync, writeFileSync } from 'node:fs'
import { createRequire } from 'node:module'
import { dirname, join } from 'node:path'
import { fileURLToPath } from 'node:url'

const [dist, out, executablePath] = process.argv.slice(2)
const require = createRequire(join(process.env.TORCHDOF_NODE_FOLDER, 'package.json'))
const { chromium } = require('playwright-core')
// tiles of 256 px, so that the sample has several
const settings = JSON.parse(readFileSync(join(dist, 'dof.json')))
writeFileSync(join(dist, 'dof.json'), JSON.stringify({ ...settings, tile_px: 256, takes_matte: true }))
const root = join(dirname(fileURLToPath(import.meta.url)), '..', '..')
const server = spawn('node', [join(root, 'examples', 'web', 'serve.mjs'), dist, '0'])
const address = await new Promise((resolve) => server.stdout.once('data', (text) => resolve(String(text).trim())))
const browser = await chromium.launch({ executablePath, args: ['--no-sandbox'] })
const results = { console: [], elsewhere: [], problems: {} }

const context = await browser.newContext({ viewport: { width: 1280, height: 860 }, acceptDownloads: true })
await context.addInitScript(() => {
  window.asked = []
  const post = Worker.prototype.postMessage
  Worker.prototype.postMessage = function (message, ...rest) {
    window.asked.push({ type: message.type, size: message.size, matte: message.matte })
    return post.call(this, message, ...rest)
  }
})
const page = await context.newPage()
page.on('console', (message) => ['error', 'warning'].includes(message.type()) && results.console.push(message.text()))
page.on('pageerror', (error) => results.console.push(String(error)))
page.on('request', (request) => {
  if (!request.url().startsWith(address) && !/^(blob|data):/.test(request.url())) results.elsewhere.push(request.url())
})

const isDone = () => document.querySelector('#status').textContent.includes('Click what should be sharp')
const done = () => page.waitForFunction(isDone, null, { timeout: 120_000 })
const text = (selector) => page.locator(selector).innerText()
const asked = () => page.evaluate(() => window.asked.splice(0))
async function clickAt(u, v) {
  const box = await page.locator('#frame').boundingBox()
  const begin = Date.now()
  await page.mouse.click(box.x + u * box.width, box.y + v * box.height)
  await done()
  return (Date.now() - begin) / 1000
}
async function save(name) {
  const [download] = await Promise.all([page.waitForEvent('download'), page.click('#save')])
  await download.saveAs(join(out, name))
  return download.suggestedFilename()
}
async function problemOf(input, name, mimeType, buffer) {
  await page.setInputFiles(input, { name, mimeType, buffer })
  await page.waitForSelector('#problem:not([hidden])')
  return text('#problem')
}

try {
  await page.goto(address)
  await done()
  results.isolated = await page.evaluate(() => window.crossOriginIsolated)
  await page.screenshot({ path: join(out, 'opened.png') })
  results.opened = [await text('#focus-value'), await text('#blur-note')]
  await page.fill('#aperture', '3')
  await done()
  results.isAutomatic = await page.isChecked('#automatic')

  // By mouse: something near, then something far.
  await asked()
  results.nearSeconds = await clickAt(0.55, 0.6)
  results.nearFocus = await text('#focus-value')
  results.nearAsked = await asked()
  results.nearName = await save('near.png')
  await clickAt(0.2, 0.12)
  results.farFocus = await text('#focus-value')
  await save('far.png')

  // With shift, one more point: all between the nearest and the farthest of both is sharp.
  await clickAt(0.55, 0.6)
  await page.keyboard.down('Shift')
  await clickAt(0.2, 0.12)
  await page.keyboard.up('Shift')
  results.bothFocus = await text('#focus-value')
  results.bothMarks = await page.locator('.reticle').count()
  results.bothName = await save('both.png')

  // A smaller picture on the screen; the file has the size of the photograph and is rendered in tiles.
  await page.selectOption('#size', '640')
  await done()
  await clickAt(0.55, 0.6)
  results.fullFocus = await text('#focus-value')
  results.shownSize = await page.locator('#after').evaluate((canvas) => [canvas.width, canvas.height])
  results.fullName = await save('full.png')
  await page.uncheck('#full')
  await page.selectOption('#format', 'image/jpeg')
  results.jpegName = await save('small.jpg')
  await page.selectOption('#format', 'image/webp')
  results.webpName = await save('small.webp')
  await page.selectOption('#format', 'image/png')
  await page.check('#full')
  await page.selectOption('#size', '960')
  await done()

  // By keyboard: the lens, the point of focus, the divider, the view.
  await asked()
  await page.focus('#aperture')
  const before = await text('#aperture-value')
  for (let i = 0; i < 6; i++) await page.keyboard.press('ArrowLeft')
  await page.waitForFunction(() => window.asked.some((message) => message.size === 'shown'))
  await done()
  results.aperture = [before, await text('#aperture-value')]
  results.dragAsked = await asked()
  await page.focus('#reticle')
  const focusBefore = await text('#focus-value')
  for (let i = 0; i < 12; i++) await page.keyboard.press('Shift+ArrowDown')
  results.keyboardFocus = [focusBefore, await text('#focus-value')]
  await page.focus('#divider')
  await page.keyboard.press('End')
  await page.keyboard.press('Shift+ArrowLeft')
  results.divider = await page.getAttribute('#divider', 'aria-valuenow')
  await page.screenshot({ path: join(out, 'compared.png') })
  await page.keyboard.press('Home')
  await page.check('[name=view][value=depth]', { force: true })
  results.depthIsShown = await page.isVisible('#depth-view')
  await page.screenshot({ path: join(out, 'depth.png') })
  await page.check('[name=view][value=picture]', { force: true })
  await done()

  // Accessible names, for screen readers.
  results.unnamed = await page.evaluate(() =>
    [...document.querySelectorAll('button, input, select, [role=slider], canvas[role=img]')]
      .filter((e) => !(e.getAttribute('aria-label') || e.innerText?.trim() || [...(e.labels ?? [])].some((l) => l.innerText.trim())))
      .map((e) => e.outerHTML),
  )

  // Files that are no images, or whose sizes differ. The earlier pair stays until it is replaced.
  const png = (name) => page.evaluate(async (colours) => {
    const canvas = document.createElement('canvas')
    canvas.width = colours.width
    canvas.height = colours.height
    const context = canvas.getContext('2d')
    const gradient = context.createLinearGradient(0, 0, colours.width, 0)
    colours.stops.forEach((colour, i) => gradient.addColorStop(i / (colours.stops.length - 1), colour))
    context.fillStyle = gradient
    context.fillRect(0, 0, colours.width, colours.height)
    const blob = await new Promise((resolve) => canvas.toBlob(resolve, colours.type))
    return [...new Uint8Array(await blob.arrayBuffer())]
  }, name)
  const picture = async (width, height, stops, type = 'image/png') =>
    Buffer.from(await png({ width, height, stops, type }))
  const words = Buffer.from('this is no picture')
  results.problems.photo = await problemOf('#photo-file', 'notes.jpg', 'image/jpeg', words)
  results.problems.depth = await problemOf('#depth-file', 'notes.npy', 'image/png', Buffer.from(await picture(60, 40, ['red', 'blue'])))
  results.problems.flat = await problemOf('#depth-file', 'flat_depth.png', 'image/png', await picture(60, 40, ['#777', '#777']))
  results.problems.damaged = await problemOf('#depth-file', 'cut_depth.png', 'image/png', (await picture(60, 40, ['#000', '#fff'])).subarray(0, 60))

  // The user's own pair, dropped together: lighter is nearer.
  const photo = await picture(90, 60, ['#fff', '#000', '#fff', '#000', '#fff', '#000', '#fff'])
  const depth = await picture(90, 60, ['#fff', '#000'], 'image/jpeg')
  const transfer = await page.evaluateHandle(([photo, depth]) => {
    const transfer = new DataTransfer()
    transfer.items.add(new File([new Uint8Array(photo)], 'a.png', { type: 'image/png' }))
    transfer.items.add(new File([new Uint8Array(depth)], 'a_depth.jpg', { type: 'image/jpeg' }))
    return transfer
  }, [[...photo], [...depth]])
  await page.dispatchEvent('#frame', 'drop', { dataTransfer: transfer })
  await done()
  await clickAt(0.02, 0.2)
  results.ownNear = await text('#focus-value')
  results.ownKind = await page.inputValue('#kind')
  await page.selectOption('#kind', 'depth')
  await done()
  await clickAt(0.02, 0.2)
  results.ownTurned = await text('#focus-value')
  // A depth map that is chosen while the browser still decodes its photograph stays.
  await page.evaluate(() => {
    const decode = window.createImageBitmap
    window.createImageBitmap = async (...given) => {
      if (given[0].name === 'slow.png') await new Promise((resolve) => setTimeout(resolve, 500))
      return decode(...given)
    }
  })
  await page.setInputFiles('#photo-file', { name: 'slow.png', mimeType: 'image/png', buffer: photo })
  await page.setInputFiles('#depth-file', { name: 'slow_depth.png', mimeType: 'image/png', buffer: await picture(91, 60, ['#000', '#fff']) })
  await page.waitForFunction(() => document.querySelector('[data-slot=photo] small').textContent === 'slow.png')
  results.slowPair = [await text('[data-slot=depth] small'), await text('#depth-note')]
  await done()
  results.problems.frame = await problemOf('#depth-file', 'tall_depth.png', 'image/png', await picture(60, 90, ['#000', '#fff']))
  await page.setInputFiles('#depth-file', { name: 'square_depth.png', mimeType: 'image/png', buffer: await picture(60, 60, ['#000', '#fff']) })
  await done()
  results.squareNote = await text('#depth-note')

  // A mask of the subject, of any size in the shape of the photograph: it goes with the photograph.
  await asked()
  const mask = await picture(45, 30, ['#000', '#fff'])
  await page.setInputFiles('#depth-file', { name: 'own_depth.png', mimeType: 'image/png', buffer: await picture(90, 60, ['#fff', '#000']) })
  await page.setInputFiles('#matte-file', { name: 'own.png', mimeType: 'image/png', buffer: mask })
  await page.waitForFunction(() => window.asked.some((message) => message.matte))
  results.matte = (await asked()).filter((message) => message.matte).map(({ matte }) => [matte.width, matte.height, Object.values(matte.values)])
  results.matteName = await text('[data-slot=matte] small')
  results.problems.matte = await problemOf('#matte-file', 'square_mask.png', 'image/png', await picture(60, 60, ['#000', '#fff']))
  await done()
  results.matteLeftOut = await text('[data-slot=matte] small')
  await page.setInputFiles('#matte-file', { name: 'own.png', mimeType: 'image/png', buffer: mask })
  await page.waitForFunction(() => document.querySelector('[data-slot=matte] small').textContent === 'own.png')
  await page.click('#sample')
  await page.waitForFunction(() => document.querySelector('[data-slot=photo] small').textContent === 'motorcycle.png')
  results.matteOfSample = await text('[data-slot=matte] small')
  await done()
  // Depth and mask without their photograph do not belong to the sample's.
  const pair = await page.evaluateHandle(([depth, mask]) => {
    const transfer = new DataTransfer()
    transfer.items.add(new File([new Uint8Array(depth)], 'b_depth.png', { type: 'image/png' }))
    transfer.items.add(new File([new Uint8Array(mask)], 'b_mask.png', { type: 'image/png' }))
    return transfer
  }, [[...(await picture(90, 60, ['#fff', '#000']))], [...mask]])
  await page.dispatchEvent('#frame', 'drop', { dataTransfer: pair })
  await page.waitForFunction(() => document.querySelector('[data-slot=matte] small').textContent === 'b_mask.png')
  results.photoOfPair = await text('[data-slot=photo] small')
  await page.click('#sample')
  await done()
  for (const [name, width, height, colorScheme] of [
    ['desktop_light', 1280, 860, 'light'],
    ['desktop_dark', 1280, 860, 'dark'],
    ['phone_light', 390, 844, 'light'],
    ['phone_dark', 390, 844, 'dark'],
  ]) {
    await page.emulateMedia({ colorScheme })
    await page.setViewportSize({ width, height })
    await page.screenshot({ path: join(out, `${name}.png`), fullPage: width < 800 })
    const wide = await page.evaluate(() => document.documentElement.scrollWidth)
    results[`${name}_overflow`] = wide - width
  }
  writeFileSync(join(out, 'results.json'), JSON.stringify(results, null, 2))
} finally {
  await browser.close()
  server.kill()
}
