// The picture: before and after with a divider between them, the depth map, and the point of focus.

const clamp = (value, low, high) => Math.min(high, Math.max(low, value))

export class Stage {
  /** @param onFocus (u, v, isDone): a point of the picture, 0 to 1 from its top left corner, was pointed at. */
  constructor(frame, onFocus) {
    this.frame = frame
    this.before = frame.querySelector('#before')
    this.after = frame.querySelector('#after')
    this.depthView = frame.querySelector('#depth-view')
    this.divider = frame.querySelector('#divider')
    this.reticle = frame.querySelector('#reticle')
    this.progress = frame.querySelector('#progress')
    this.point = { u: 0.5, v: 0.5 }
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

  /** Move the mark to a point; it is paler if the focus was not set there. */
  mark(u, v, isFocus) {
    this.point = { u, v }
    this.reticle.style.setProperty('--x', `${100 * u}%`)
    this.reticle.style.setProperty('--y', `${100 * v}%`)
    this.reticle.classList.toggle('set-by-distance', !isFocus)
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

  #pointAt(event) {
    const box = this.frame.getBoundingClientRect()
    return [clamp((event.clientX - box.left) / box.width, 0, 1), clamp((event.clientY - box.top) / box.height, 0, 1)]
  }

  #listenForFocus(onFocus) {
    let isScanning = false
    this.frame.addEventListener('pointerdown', (event) => {
      if (event.pointerType !== 'mouse' || event.button !== 0 || this.divider.contains(event.target)) return
      isScanning = true
      this.frame.setPointerCapture(event.pointerId)
      onFocus(...this.#pointAt(event), false)
    })
    this.frame.addEventListener('pointermove', (event) => {
      if (isScanning) onFocus(...this.#pointAt(event), false)
    })
    this.frame.addEventListener('pointerup', () => (isScanning = false))
    this.frame.addEventListener('pointercancel', () => (isScanning = false))
    this.frame.addEventListener('click', (event) => {
      const isByKeyboard = event.target === this.reticle && event.detail === 0
      if (isByKeyboard) onFocus(this.point.u, this.point.v, true)
      else if (!this.divider.contains(event.target)) onFocus(...this.#pointAt(event), true)
    })
    this.reticle.addEventListener('keydown', (event) => {
      const step = event.shiftKey ? 0.1 : 0.02
      const [right, down] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] ?? []
      if (right === undefined) return
      event.preventDefault()
      onFocus(clamp(this.point.u + right * step, 0, 1), clamp(this.point.v + down * step, 0, 1), false)
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
