// The picture: before and after with a divider between them, the depth map, and the point of focus.

const clamp = (value, low, high) => Math.min(high, Math.max(low, value))

export class Stage {
  /**
   * @param onFocus (point, how, isDone): a point {u, v} of the picture, 0 to 1 from its top left corner, was pointed at.
   *   how is 'set' for the only point, 'add' for one more (with shift), 'move' for another place of the last one.
   */
  constructor(frame, onFocus) {
    this.frame = frame
    this.before = frame.querySelector('#before')
    this.after = frame.querySelector('#after')
    this.depthView = frame.querySelector('#depth-view')
    this.divider = frame.querySelector('#divider')
    this.reticle = frame.querySelector('#reticle')
    this.progress = frame.querySelector('#progress')
    this.points = [{ u: 0.5, v: 0.5 }]
    this.#listenForFocus(onFocus)
    this.#listenForDivider()
  }

  /** Show the sharp photograph, and its size. */
  showSharp({ rgba, width, height }) {
    this.frame.style.setProperty('--aspect', width / height)
    for (const canvas of [this.before, this.after]) {
      canvas.width = width
      canvas.height = height
      canvas.getContext('2d').putImageData(new ImageData(rgba, width, height), 0, 0)
    }
  }

  /** Show a result; one of half the size is enlarged. */
  showResult({ rgba, width, height }) {
    const context = this.after.getContext('2d')
    const image = new ImageData(rgba, width, height)
    if (width === this.after.width && height === this.after.height) {
      context.putImageData(image, 0, 0)
      return
    }
    const small = document.createElement('canvas')
    small.width = width
    small.height = height
    small.getContext('2d').putImageData(image, 0, 0)
    context.drawImage(small, 0, 0, this.after.width, this.after.height)
  }

  /** Whether there is a picture to focus and compare. */
  setActive(isActive) {
    this.frame.classList.toggle('idle', !isActive)
  }

  /** Show the picture of a depth map; null shows the photograph again. */
  showDepth(image) {
    this.depthView.hidden = image === null
    if (image === null) return
    this.depthView.width = image.width
    this.depthView.height = image.height
    this.depthView.getContext('2d').putImageData(image, 0, 0)
  }

  /** Mark the points of focus; the marks are paler if the focus was not set there. */
  mark(points, isFocus) {
    this.points = points
    for (const other of this.frame.querySelectorAll('.reticle.other')) other.remove()
    for (const { u, v } of points.slice(0, -1)) {
      const mark = document.createElement('span')
      mark.className = 'reticle other'
      mark.style.setProperty('--x', `${100 * u}%`)
      mark.style.setProperty('--y', `${100 * v}%`)
      this.reticle.before(mark)
    }
    const { u, v } = this.#last()
    this.reticle.style.setProperty('--x', `${100 * u}%`)
    this.reticle.style.setProperty('--y', `${100 * v}%`)
    for (const mark of this.frame.querySelectorAll('.reticle')) mark.classList.toggle('set-by-distance', !isFocus)
  }

  /** Show the progress of work that takes about this many ms; null means unknown. */
  beginProgress(expectedMs) {
    clearInterval(this.ticking)
    this.progress.hidden = false
    this.progress.removeAttribute('value')
    if (expectedMs === null) return
    const began = performance.now()
    const tick = () => {
      this.progress.value = Math.min(0.97, (performance.now() - began) / expectedMs)
    }
    tick()
    this.ticking = setInterval(tick, 60)
  }

  endProgress() {
    clearInterval(this.ticking)
    this.progress.hidden = true
  }

  setDivider(percent) {
    const share = Math.round(clamp(percent, 0, 100))
    this.frame.style.setProperty('--divider', `${share}%`)
    this.frame.classList.toggle('comparing', share > 0)
    this.divider.setAttribute('aria-valuenow', share)
  }

  #last() {
    return this.points.at(-1)
  }

  #pointAt(event) {
    const box = this.frame.getBoundingClientRect()
    return {
      u: clamp((event.clientX - box.left) / box.width, 0, 1),
      v: clamp((event.clientY - box.top) / box.height, 0, 1),
    }
  }

  #listenForFocus(onFocus) {
    let isScanning = false
    let isPlaced = false // the mouse button has set or added the point that the click confirms
    const howOf = (event) => (event.shiftKey ? 'add' : 'set')
    this.frame.addEventListener('pointerdown', (event) => {
      if (event.pointerType !== 'mouse' || event.button !== 0 || this.divider.contains(event.target)) return
      isScanning = isPlaced = true
      this.frame.setPointerCapture(event.pointerId)
      onFocus(this.#pointAt(event), howOf(event), false)
    })
    this.frame.addEventListener('pointermove', (event) => {
      if (isScanning) onFocus(this.#pointAt(event), 'move', false)
    })
    this.frame.addEventListener('pointerup', () => (isScanning = false))
    this.frame.addEventListener('pointercancel', () => (isScanning = isPlaced = false))
    this.frame.addEventListener('click', (event) => {
      const isByKeyboard = event.target === this.reticle && event.detail === 0
      if (isByKeyboard) onFocus(this.#last(), howOf(event), true)
      else if (!this.divider.contains(event.target)) onFocus(this.#pointAt(event), isPlaced ? 'move' : howOf(event), true)
      isPlaced = false
    })
    this.reticle.addEventListener('keydown', (event) => {
      const step = event.shiftKey ? 0.1 : 0.02
      const [right, down] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] ?? []
      if (right === undefined) return
      event.preventDefault()
      const { u, v } = this.#last()
      onFocus({ u: clamp(u + right * step, 0, 1), v: clamp(v + down * step, 0, 1) }, 'move', false)
    })
  }

  #listenForDivider() {
    const { divider } = this
    divider.addEventListener('pointerdown', (event) => {
      divider.setPointerCapture(event.pointerId)
      divider.focus({ focusVisible: false })
      event.preventDefault()
    })
    divider.addEventListener('pointermove', (event) => {
      if (divider.hasPointerCapture(event.pointerId)) this.setDivider(100 * this.#pointAt(event)[0])
    })
    divider.addEventListener('keydown', (event) => {
      const now = Number(divider.getAttribute('aria-valuenow'))
      const step = event.shiftKey ? 20 : 5
      const next = {
        ArrowLeft: now - step,
        ArrowDown: now - step,
        ArrowRight: now + step,
        ArrowUp: now + step,
        Home: 0,
        End: 100,
      }[event.key]
      if (next === undefined) return
      event.preventDefault()
      this.setDivider(next)
    })
  }
}
