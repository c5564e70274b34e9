// The page: turns files and controls into a scene and a lens, and shows the results.

import { fNumberFor, guessMeaning, inOrder, knownMap, subjectOf } from './assumed.mjs'
import { depthAtSize, extremes, fillHoles, metresOf } from './depth.mjs'
import { kindOf, readDepth, readMatte, readPhoto } from './files.mjs'
import { cocPx, depthPicture, distanceAt } from './optics.mjs'
import { encodePng } from './png.mjs'
import { Renderer } from './renderer.mjs'
import { Stage } from './stage.mjs'

const $ = (id) => document.getElementById(id)
const HORIZON_M = 1000 // farther is all the same to a lens
const NEEDS_DEPTH =
  'Now add its depth map: a grey picture of distances, from an estimator such as Depth Anything, a depth camera or a renderer.'
const SETTLED_MS = 250 // time without a change of the controls after which the size of the scene is rendered
const SAME_SHAPE = 0.03 // largest difference between shapes that are meant to be equal

let camera
let photo = null // {name, rgba, width, height}
let depthFile = null // {name, map}
let matteFile = null // {name, map}, whose values are coverage by the subject
let isSample = false
let scene = null // {photo, depth: {metres, width, height}, distances, width, height, nearM, farM}
let focus = { nearM: 2, farM: 2 } // all between these distances is in focus
let isFocusChosen = false // by a point or the slider; until then the subject is in focus
let fNumber = 1
let result = null // the picture of what the controls say, at the size of the scene
let settling

const fNumberOf = (position) => 2 ** (-position / 6) // six steps: half the diameter
const positionOf = (number) => -6 * Math.log2(number)
const stage = new Stage($('frame'), pointAt)
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
    say(`${picture.width} × ${picture.height} in ${seconds(picture.ms)}. Click what should be sharp; with shift, what else.`)
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
    const earlier = { depthFile, matteFile }
    const opened = { photo: null, depth: null, matte: null }
    for (const file of files) {
      const kind = slot ?? (await kindOf(file))
      opened[kind] = await { photo: readPhoto, depth: readDepth, matte: readMatte }[kind](file)
    }
    // depth and mask of the photo that goes; not those that were chosen while the new photo was read
    const isOther = isSample ? opened.photo || opened.depth : opened.photo && photo
    if (isOther && depthFile === earlier.depthFile) depthFile = null
    if (isOther && matteFile === earlier.matteFile) matteFile = null
    if (isSample && isOther) photo = null
    isSample &&= !isOther
    photo = opened.photo ?? photo
    depthFile = opened.depth ?? depthFile
    matteFile = opened.matte ?? matteFile
    if (opened.photo || opened.depth) {
      isFocusChosen = false
      $('automatic').checked = true
    }
    if (opened.depth) setMeaning(guessMeaning(depthFile.map))
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
    matteFile = null
    isSample = true
    isFocusChosen = false
    $('automatic').checked = true
    setMeaning(guessMeaning(depthFile.map))
    arrange()
  } catch (error) {
    complain(error.message)
  }
}

function setMeaning({ kind, scale }) {
  $('kind').value = kind
  $('scale').value = String(scale)
}

/** Makes a scene from photo, depth map and its kind; shows a message if one is missing or does not fit. */
function arrange() {
  const map = depthFile && knownMap(depthFile.map, $('kind').value)
  showTiles(map)
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
  const [ours, theirs] = [photo.width / photo.height, map.width / map.height]
  const stretch = difference(ours, theirs)
  if (stretch > SAME_SHAPE && difference(ours, 1 / theirs) <= SAME_SHAPE) {
    throw new Error(
      `The photo is ${photo.width} × ${photo.height}, its depth map ${map.width} × ${map.height}: turned by 90 degrees it ` +
        'fits. It needs the orientation of the photo: turn one.',
    )
  }
  if (matteFile && difference(ours, matteFile.map.width / matteFile.map.height) > SAME_SHAPE) {
    const { width, height } = matteFile.map
    matteFile = null
    showTiles(map)
    complain(
      `The photo is ${photo.width} × ${photo.height}, its mask ${width} × ${height}: it must have the shape of the photo. The ` +
        'picture is rendered without it.',
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
    distances: inOrder(metres),
    width: Math.max(1, Math.round(photo.width * shrink)),
    height: Math.max(1, Math.round(photo.height * shrink)),
    nearM,
    farM: Math.min(Math.max(farM, nearM * 1.001), Math.max(HORIZON_M, 2 * nearM)),
  }
  noteDepth(holes, stretch)
  $('lens').disabled = false
  stage.setActive(true)
  renderer.setScene({ photo, depth: scene.depth, matte: matteFile?.map ?? null, width: scene.width, height: scene.height, file: $('shape').value })
  if (isFocusChosen) focusOnPoints(stage.points, true)
  else focusOnSubject()
}

/** Relative difference between two ratios of sides. */
const difference = (one, other) => Math.max(one / other, other / one) - 1

/** Arrange again after a control has changed. */
function rearrange() {
  complain(null)
  try {
    arrange()
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

function showTiles(map) {
  const pictures = {
    photo: photo && { name: photo.name, image: new ImageData(photo.rgba, photo.width, photo.height) },
    depth: depthFile && { name: depthFile.name, image: greyImage(map) },
    matte: matteFile && { name: matteFile.name, image: greyImage(matteFile.map) },
  }
  for (const [slot, shown] of Object.entries(pictures)) {
    const tile = document.querySelector(`[data-slot=${slot}]`)
    const isOptional = slot === 'matte'
    tile.classList.toggle('missing', !shown && !isOptional)
    tile.querySelector('small').textContent = shown?.name ?? (isOptional ? 'optional: where hair ends' : 'choose or drop a file')
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

/** A point of the picture was pointed at; see Stage. */
function pointAt(point, how, isDone) {
  if (!scene) return
  isFocusChosen = true
  const kept = { set: [], add: stage.points, move: stage.points.slice(0, -1) }[how]
  focusOnPoints([...kept, point], isDone)
}

/** Focus on all between the nearest and the farthest of the surfaces at some points. */
function focusOnPoints(points, isDone) {
  const { metres, width, height } = scene.depth
  stage.mark(points, true)
  const distances = points.map(({ u, v }) => distanceAt(metres, width, height, u, v))
  setFocus(Math.min(...distances), Math.max(...distances), isDone)
}

function focusOnSubject() {
  const { metres, width, height } = scene.depth
  const { distanceM, u, v } = subjectOf(metres, width, height, $('kind').value)
  stage.mark([{ u, v }], true)
  setFocus(distanceM, distanceM, true)
}

function setFocus(nearM, farM, isDone) {
  const inScene = (distanceM) => Math.min(scene.farM, Math.max(scene.nearM, distanceM))
  focus = { nearM: inScene(nearM), farM: inScene(farM) }
  const halfwayM = 2 / (1 / focus.nearM + 1 / focus.farM)
  $('focus').value = (1000 * Math.log(halfwayM / scene.nearM)) / Math.log(scene.farM / scene.nearM)
  update(isDone)
}

/** After a change of the controls: render at half the size now, at full size when they have settled. */
function update(isDone) {
  result = null
  $('save').disabled = true
  if ($('automatic').checked) {
    fNumber = fNumberFor(scene.distances, (depthM) => cocPx(camera, 1, focus, 1, depthM)) ?? fNumber
    $('aperture').value = positionOf(fNumber)
  }
  say(`Focus at ${focusText()}, ${stopText()}`)
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
  renderer.request({ size, file: $('shape').value, focus, fNumber, tilePx: camera.tile_px, reachPx })
}

/** Largest blur radius of the scene in pixels of a picture of that width. */
function largestRadius(width) {
  const radius = (depthM) => Math.abs(cocPx(camera, width, focus, fNumber, depthM))
  return Math.max(radius(scene.nearM), radius(scene.farM))
}

function describeLens() {
  $('focus-value').textContent = focusText()
  $('focus').setAttribute('aria-valuetext', focusText())
  $('aperture-value').textContent = stopText()
  $('aperture').setAttribute('aria-valuetext', stopText())
  document.querySelector('[data-side=after]').textContent = stopText()
  const opening = Math.min(1, 0.12 + 0.88 * Math.sqrt(0.5 / fNumber))
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
  const coc = (depthM) => cocPx(camera, width, focus, fNumber, depthM)
  stage.showDepth(depthPicture(metres, width, height, nearM, farM, coc))
}

/* Words -------------------------------------------------------------------------------------------------------- */

const stopText = () => `f/${fNumber.toFixed(fNumber < 9.5 ? 1 : 0)}`
const seconds = (ms) => `${(ms / 1000).toFixed(ms < 9500 ? 1 : 0)} s`

function focusText() {
  const [near, far] = [metresText(focus.nearM), metresText(focus.farM)]
  return near === far ? near : `${near} to ${far}`
}

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
  const distance = [...new Set([focus.nearM, focus.farM].map((metres) => metres.toFixed(2)))].join('-')
  const ending = file.type === 'image/jpeg' ? 'jpg' : file.type.replace('image/', '')
  link.download = `${photo.name.replace(/\.[^.]*$/, '')}_f${fNumber.toFixed(1)}_${distance}m.${ending}`
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
    isFocusChosen = true
    stage.mark(stage.points.slice(-1), false)
    const distanceM = scene.nearM * (scene.farM / scene.nearM) ** ($('focus').value / 1000)
    setFocus(distanceM, distanceM, false)
  })
  $('aperture').addEventListener('input', () => {
    $('automatic').checked = false
    fNumber = fNumberOf(Number($('aperture').value))
    update(false)
  })
  for (const name of ['focus', 'aperture', 'automatic']) $(name).addEventListener('change', () => scene && update(true))
  for (const name of ['kind', 'scale', 'near', 'far', 'size']) $(name).addEventListener('change', rearrange)
  $('shape').addEventListener('change', () => scene && update(true))
  $('full').addEventListener('change', () => scene && describeLens())
  for (const radio of document.querySelectorAll('[name=view]')) radio.addEventListener('change', showView)
  for (const slot of ['photo', 'depth', 'matte']) {
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
document.querySelector('[data-slot=matte]').hidden = !camera.takes_matte
listen()
await takeSample()
