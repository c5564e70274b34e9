// The page: turns files and controls into a scene and a lens, and shows the results.

import { depthAtSize, extremes, fillHoles, metresOf } from './depth.mjs'
import { kindOf, readDepth, readPhoto } from './files.mjs'
import { cocPx, depthPicture, distanceAt } from './optics.mjs'
import { encodePng } from './png.mjs'
import { Renderer } from './renderer.mjs'
import { Stage } from './stage.mjs'

const $ = (id) => document.getElementById(id)
const HORIZON_M = 1000 // farther is all the same to a lens
const NEEDS_DEPTH =
  'Now add its depth map: a grey picture of distances, from an estimator such as Depth Anything, a depth camera or a renderer.'
const SETTLED_MS = 250 // time without a change of the controls after which the size of the scene is rendered
const MOST_STRETCH = 0.03 // between the shapes of photo and depth map: estimators round sizes to multiples of 14 or 64

let camera
let photo = null // {name, rgba, width, height}
let depthFile = null // {name, map}
let isSample = false
let scene = null // {photo, depth: {metres, width, height}, width, height, nearM, farM}
let focusM = 2
let result = null // the picture of what the controls say, at the size of the scene
let settling

const fNumberOf = (position) => 2 ** (-position / 6) // six steps: one f-stop of half the diameter
const fNumber = () => fNumberOf(Number($('aperture').value))
const stage = new Stage($('frame'), focusAt)
const renderer = new Renderer({
  onSharp: (picture) => stage.showSharp(picture),
  onBegin: (expectedMs, size, isReady) => {
    stage.beginProgress(expectedMs)
    if (!isReady) say('Loading the lens…')
    if (size !== 'shown' || !isReady) return
    const about = expectedMs === null ? '' : ` about ${seconds(expectedMs)}`
    say(`Rendering ${scene.width} × ${scene.height}…${about}`)
  },
  onTile: ({ done, count }) => {
    say(`Rendering ${photo.width} × ${photo.height} for the file, part ${done + 1} of ${count}…`)
  },
  onPicture: (picture) => {
    stage.endProgress()
    if (picture.size === 'full') {
      download(picture)
      return
    }
    stage.showResult(picture)
    if (picture.size === 'half' || settling !== null) return
    result = picture
    $('save').disabled = false
    say(`${picture.width} × ${picture.height} in ${seconds(picture.ms)}. Click what should be sharp.`)
  },
  onFailed: (message) => {
    stage.endProgress()
    const isMemory = /memory|alloc|bad_alloc/i.test(message)
    complain(
      isMemory
        ? `The browser ran out of memory at ${scene.width} × ${scene.height}. Choose a smaller size of the result.`
        : `The picture could not be rendered: ${message}. Reload the page; a smaller size may help.`,
    )
  },
})

/* Files -------------------------------------------------------------------------------------------------------- */

async function take(files, slot = null) {
  if (!files.length) return
  complain(null)
  try {
    const earlierDepth = depthFile
    const opened = { photo: null, depth: null }
    for (const file of files) {
      const kind = slot ?? (await kindOf(file))
      opened[kind] = kind === 'photo' ? await readPhoto(file) : await readDepth(file)
    }
    // the depth of the photo that goes; not one that was chosen while the new photo was read
    if (depthFile === earlierDepth && (isSample || (opened.photo && photo))) depthFile = null
    if (isSample) photo = null
    isSample = false
    photo = opened.photo ?? photo
    depthFile = opened.depth ?? depthFile
    if (opened.depth) guessMeaning(depthFile.map)
    arrange()
  } catch (error) {
    complain(error.message)
  }
}

async function takeSample() {
  complain(null)
  try {
    const [photoFile, depth] = await Promise.all(
      ['motorcycle.png', 'motorcycle_depth.png'].map(async (name) => {
        const response = await fetch(`sample/${name}`)
        if (!response.ok) throw new Error(`the sample cannot be loaded (${response.status})`)
        return new File([await response.blob()], name)
      }),
    )
    photo = await readPhoto(photoFile)
    depthFile = await readDepth(depth)
    isSample = true
    guessMeaning(depthFile.map)
    arrange({ u: 0.6, v: 0.5 })
  } catch (error) {
    complain(error.message)
  }
}

/** Likely kind of a map: floats are metres, 16 bits millimetres unless they fill their range, 8 bits relative. */
function guessMeaning({ values, fullScale }) {
  const [low, high] = extremes(values)
  const fillsRange = fullScale !== null && low < 0.1 * fullScale && high > 0.9 * fullScale
  const isRelative = fullScale === 255 || fillsRange
  $('kind').value = isRelative ? 'disparity' : 'metres'
  $('scale').value = fullScale === null ? '1' : '0.001'
}

/** Makes a scene from photo, depth map and its kind; shows a message if one is missing or does not fit. */
function arrange(point = { u: 0.5, v: 0.5 }) {
  showTiles()
  scene = null
  result = null
  $('save').disabled = true
  $('lens').disabled = true
  stage.setActive(false)
  $('meaning').disabled = depthFile === null
  for (const group of document.querySelectorAll('[data-for]')) {
    group.hidden = !group.dataset.for.includes($('kind').value)
  }
  if (!photo || !depthFile) {
    stage.endProgress()
    stage.showDepth(null)
    if (photo) stage.showSharp(photo)
    say(photo ? NEEDS_DEPTH : 'Now add the photo of this depth map.')
    return
  }
  const { map } = depthFile
  const [ours, theirs] = [photo.width / photo.height, map.width / map.height]
  const stretch = Math.abs(Math.log(ours / theirs))
  if (stretch > MOST_STRETCH) {
    throw new Error(
      `The photo is ${photo.width} × ${photo.height}, its depth map ${map.width} × ${map.height}: they must show the same ` +
        'frame. Choose the depth map of this photo, not cropped and not turned.',
    )
  }
  const metres = metresOf(map, {
    kind: $('kind').value,
    scale: Number($('scale').value),
    nearM: Number($('near').value),
    farM: Number($('far').value),
  })
  const holes = fillHoles(metres, map.width)
  const [nearM, farM] = extremes(metres)
  const shrink = Math.min(1, Number($('size').value) / Math.max(photo.width, photo.height))
  scene = {
    photo,
    depth: { metres, width: map.width, height: map.height },
    width: Math.max(1, Math.round(photo.width * shrink)),
    height: Math.max(1, Math.round(photo.height * shrink)),
    nearM,
    farM: Math.min(Math.max(farM, nearM * 1.001), Math.max(HORIZON_M, 2 * nearM)),
  }
  noteDepth(holes, stretch)
  $('lens').disabled = false
  stage.setActive(true)
  renderer.setScene({ photo, depth: scene.depth, width: scene.width, height: scene.height, file: $('shape').value })
  focusAt(point.u, point.v, true)
}

/** Arrange again after a control has changed. */
function rearrange() {
  complain(null)
  try {
    arrange(stage.point)
  } catch (error) {
    complain(error.message)
  }
}

function noteDepth(holes, stretch) {
  const notes = [`${metresText(scene.nearM)} to ${metresText(scene.farM)} away.`]
  if (holes > 0.001) notes.push(`${Math.ceil(100 * holes)} % had no depth and was filled from behind.`)
  if (stretch > 0.002) notes.push(`Its shape differs by ${(100 * stretch).toFixed(1)} %; it is stretched to the photo.`)
  const isStrange = scene.nearM > 300 || scene.farM < 0.03
  if (isStrange) notes.push('That is not what a photo shows: choose another unit or meaning.')
  $('depth-note').textContent = notes.join(' ')
}

function showTiles() {
  const pictures = {
    photo: photo && { name: photo.name, image: new ImageData(photo.rgba, photo.width, photo.height) },
    depth: depthFile && { name: depthFile.name, image: greyImage(depthFile.map) },
  }
  for (const [slot, shown] of Object.entries(pictures)) {
    const tile = document.querySelector(`[data-slot=${slot}]`)
    tile.classList.toggle('missing', !shown)
    tile.querySelector('small').textContent = shown ? shown.name : 'choose or drop a file'
    const canvas = tile.querySelector('canvas')
    canvas.getContext('2d').clearRect(0, 0, canvas.width, canvas.height)
    if (shown) drawCovering(canvas, shown.image)
  }
}

function greyImage({ values, width, height }) {
  const [low, high] = extremes(values)
  const image = new ImageData(width, height)
  values.forEach((value, i) => image.data.fill((255 * (value - low)) / (high - low || 1), 4 * i, 4 * i + 3))
  for (let i = 3; i < image.data.length; i += 4) image.data[i] = 255
  return image
}

/** Draw an image so that it covers a canvas. */
async function drawCovering(canvas, image) {
  const bitmap = await createImageBitmap(image)
  const scale = Math.max(canvas.width / image.width, canvas.height / image.height)
  const [width, height] = [image.width * scale, image.height * scale]
  const context = canvas.getContext('2d')
  context.imageSmoothingQuality = 'high'
  context.drawImage(bitmap, (canvas.width - width) / 2, (canvas.height - height) / 2, width, height)
  bitmap.close()
}

/* Lens --------------------------------------------------------------------------------------------------------- */

function focusAt(u, v, isDone) {
  if (!scene) return
  const { metres, width, height } = scene.depth
  stage.mark(u, v, true)
  setFocus(distanceAt(metres, width, height, u, v), isDone)
}

function setFocus(distanceM, isDone) {
  focusM = Math.min(scene.farM, Math.max(scene.nearM, distanceM))
  $('focus').value = (1000 * Math.log(focusM / scene.nearM)) / Math.log(scene.farM / scene.nearM)
  update(isDone)
}

/** After a change of the controls: render at half the size now, at full size when they have settled. */
function update(isDone) {
  result = null
  $('save').disabled = true
  say(`Focus at ${metresText(focusM)}, ${stopText()}`)
  describeLens()
  clearTimeout(settling)
  settling = setTimeout(finish, isDone ? 0 : SETTLED_MS)
  if (!isDone) request('half')
}

function finish() {
  settling = null
  if (scene) request('shown')
}

function request(size) {
  const reachPx = Math.min(camera.max_coc_px, largestRadius(photo.width))
  renderer.request({ size, file: $('shape').value, focusM, fNumber: fNumber(), tilePx: camera.tile_px, reachPx })
}

/** Largest blur radius of the scene in pixels of a picture of that width. */
function largestRadius(width) {
  const radius = (depthM) => Math.abs(cocPx(camera, width, focusM, fNumber(), depthM))
  return Math.max(radius(scene.nearM), radius(scene.farM))
}

function describeLens() {
  $('focus-value').textContent = metresText(focusM)
  $('focus').setAttribute('aria-valuetext', metresText(focusM))
  $('aperture-value').textContent = stopText()
  $('aperture').setAttribute('aria-valuetext', stopText())
  document.querySelector('[data-side=after]').textContent = stopText()
  const opening = Math.min(1, 0.12 + 0.88 * Math.sqrt(0.5 / fNumber()))
  const corners = Array.from({ length: 7 }, (_, i) => {
    const angle = (2 * Math.PI * i) / 7 + 1.2 * (1 - opening)
    return `${(10 * opening * Math.cos(angle)).toFixed(2)},${(10 * opening * Math.sin(angle)).toFixed(2)}`
  })
  $('iris').setAttribute('points', corners.join(' '))
  const largest = largestRadius($('full').checked ? photo.width : scene.width)
  $('blur-note').textContent =
    largest > camera.max_coc_px
      ? `Blur of up to ${largest.toFixed(0)} pixels in radius; this page renders ${camera.max_coc_px} at most.`
      : `Blur of up to ${largest.toFixed(largest < 10 ? 1 : 0)} pixels in radius.`
  showView()
}

function showView() {
  const isDepth = scene && document.querySelector('[name=view]:checked').value === 'depth'
  if (!isDepth) {
    stage.showDepth(null)
    return
  }
  const { width, height, depth, nearM, farM } = scene
  const metres = depthAtSize(depth.metres, depth.width, depth.height, width, height)
  const coc = (depthM) => cocPx(camera, width, focusM, fNumber(), depthM)
  stage.showDepth(depthPicture(metres, width, height, nearM, farM, coc))
}

/* Words -------------------------------------------------------------------------------------------------------- */

const stopText = () => `f/${fNumber() < 9.5 ? fNumber().toFixed(1) : fNumber().toFixed(0)}`
const seconds = (ms) => `${(ms / 1000).toFixed(ms < 9500 ? 1 : 0)} s`

function metresText(metres) {
  if (metres >= HORIZON_M) return 'infinity'
  return metres < 1 ? `${Math.round(100 * metres)} cm` : `${metres.toFixed(metres < 10 ? 2 : 0)} m`
}

function say(text) {
  $('status').textContent = text
}

function complain(message) {
  $('problem').hidden = message === null
  $('problem').textContent = message ?? ''
  if (message === null) return
  say('')
  $('problem').scrollIntoView({ block: 'nearest' })
}

/* Controls ----------------------------------------------------------------------------------------------------- */

function save() {
  const isSmaller = result.width < photo.width || result.height < photo.height
  if (isSmaller && $('full').checked) request('full')
  else download(result)
}

async function download({ rgba, width, height }) {
  const file = await encoded(rgba, width, height, $('format').value)
  const link = document.createElement('a')
  link.href = URL.createObjectURL(file)
  const ending = file.type === 'image/jpeg' ? 'jpg' : file.type.replace('image/', '')
  link.download = `${photo.name.replace(/\.[^.]*$/, '')}_f${fNumber().toFixed(1)}_${focusM.toFixed(2)}m.${ending}`
  link.click()
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000)
  say(`Saved ${link.download}.`)
}

/** A file of the type, or a PNG file where the browser cannot write that type. */
async function encoded(rgba, width, height, type) {
  if (type === 'image/png') return new Blob([await encodePng(rgba, width, height, 4)], { type })
  const canvas = document.createElement('canvas')
  canvas.width = width
  canvas.height = height
  canvas.getContext('2d').putImageData(new ImageData(rgba, width, height), 0, 0)
  return new Promise((resolve) => canvas.toBlob(resolve, type, 0.93))
}

function listen() {
  $('panel').addEventListener('submit', (event) => event.preventDefault())
  $('focus').addEventListener('input', () => {
    stage.mark(stage.point.u, stage.point.v, false)
    setFocus(scene.nearM * (scene.farM / scene.nearM) ** ($('focus').value / 1000), false)
  })
  $('aperture').addEventListener('input', () => update(false))
  for (const name of ['focus', 'aperture']) $(name).addEventListener('change', () => scene && update(true))
  for (const name of ['kind', 'scale', 'near', 'far', 'size']) $(name).addEventListener('change', rearrange)
  $('shape').addEventListener('change', () => scene && update(true))
  $('full').addEventListener('change', () => scene && describeLens())
  for (const radio of document.querySelectorAll('[name=view]')) radio.addEventListener('change', showView)
  for (const slot of ['photo', 'depth']) {
    $(`${slot}-file`).addEventListener('change', ({ target }) => {
      const files = [...target.files]
      target.value = '' // so that the same file, mended, can be chosen again
      take(files, slot)
    })
  }
  $('sample').addEventListener('click', takeSample)
  $('save').addEventListener('click', save)
  document.addEventListener('dragover', (event) => {
    event.preventDefault()
    document.body.classList.add('dropping')
  })
  document.addEventListener('dragleave', (event) => {
    if (event.relatedTarget === null) document.body.classList.remove('dropping')
  })
  document.addEventListener('drop', (event) => {
    event.preventDefault()
    document.body.classList.remove('dropping')
    take(event.dataTransfer.files, event.target.closest?.('[data-slot]')?.dataset.slot)
  })
}

camera = await (await fetch('dof.json')).json()
$('shape').append(...camera.shapes.map(({ name, file }) => new Option(name, file)))
$('shape').closest('.pair').hidden = camera.shapes.length < 2
listen()
await takeSample()
