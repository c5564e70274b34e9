// The page's side of the worker: renders one picture at a time, always the last one requested, and estimates its time.

export class Renderer {
  /**
   * @param handlers.onSharp ({rgba, width, height}): the photograph at the size of the result.
   * @param handlers.onBegin (expectedMs or null, size, isReady): a picture was started, or waits for loading. Its size is
   *   'half' or 'shown', that of the scene, or 'full', that of the photograph, which is rendered in tiles.
   * @param handlers.onTile ({done, count}): as many tiles of the full size are done.
   * @param handlers.onPicture ({rgba, width, height, size, ms}): the picture is finished.
   * @param handlers.onFailed (message).
   */
  constructor(handlers) {
    this.handlers = handlers
    this.msPerPixel = null
    this.loadMs = Infinity
    this.sceneId = 0
    this.#start()
  }

  /** Set the scene: {photo, depth, matte or null, width, height, file}; the exported file is loaded first. */
  setScene(scene) {
    this.scene = { ...scene, sceneId: ++this.sceneId }
    this.wanted = null
    if (this.#isWorthStartingAgain()) this.#start()
    else this.worker.postMessage({ type: 'scene', ...this.scene })
  }

  /** Request a picture; replaces an earlier request that has not been started. */
  request(wanted) {
    this.wanted = wanted
    if (!this.running) this.#next()
    else if (this.running.size !== 'half' && this.#isWorthStartingAgain()) this.#start()
  }

  #start() {
    this.worker?.terminate()
    this.running = null
    this.isReady = false
    this.began = performance.now()
    const worker = new Worker(new URL('worker.mjs', import.meta.url), { type: 'module' })
    worker.onmessage = ({ data }) => worker === this.worker && this.#take(data)
    worker.onerror = (event) => this.#fail(event.message ?? 'the renderer cannot be loaded')
    this.worker = worker
    if (this.scene) this.worker.postMessage({ type: 'scene', ...this.scene })
    if (this.wanted) this.#next()
  }

  #next() {
    this.running = { ...this.wanted, sceneId: this.sceneId, began: performance.now() }
    this.wanted = null
    const { size } = this.running
    this.handlers.onBegin(this.isReady ? this.#expectedMs(size) : null, size, this.isReady)
    this.worker.postMessage({ type: 'render', ...this.running })
  }

  #take(data) {
    if (data.type === 'ready') {
      this.isReady = true
      this.loadMs = performance.now() - this.began
      if (this.running) this.running.began = performance.now()
    } else if (data.type === 'sharp') {
      this.handlers.onSharp(data)
    } else if (data.type === 'tile') {
      this.handlers.onTile(data)
    } else if (data.type === 'picture') {
      const ms = performance.now() - this.running.began
      if (data.size !== 'full') this.msPerPixel = ms / (data.width * data.height) // tiles overlap
      const isOfThisScene = this.running.sceneId === this.sceneId
      this.running = null
      if (isOfThisScene) this.handlers.onPicture({ ...data, ms })
      if (this.wanted) this.#next()
    } else {
      this.#fail(data.message)
    }
  }

  #fail(message) {
    this.running = null
    this.wanted = null
    this.handlers.onFailed(message)
  }

  #expectedMs(size) {
    if (this.msPerPixel === null) return null
    const { width, height } = size === 'full' ? this.scene.photo : this.scene
    return (this.msPerPixel * width * height) / (size === 'half' ? 4 : 1)
  }

  /** Stops a picture in progress by ending its worker, if starting another worker is quicker than waiting. */
  #isWorthStartingAgain() {
    const expected = this.running && this.#expectedMs(this.running.size)
    return expected !== null && expected - (performance.now() - this.running.began) > this.loadMs
  }
}
