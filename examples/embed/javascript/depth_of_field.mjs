// Depth of field by a file of `torchdof export`, in onnxruntime-web. The same module serves Node and the browser.

/** An exported file, ready to render. */
export class DepthOfField {
  /**
   * @param ort The runtime: `import * as ort from 'onnxruntime-web'`.
   * @param {Uint8Array} file The bytes of the ONNX file, which takes depth, focus and f-number.
   * @returns {Promise<DepthOfField>}
   */
  static async load(ort, file) {
    const session = await ort.InferenceSession.create(file, { executionProviders: ['wasm'], logSeverityLevel: 3 })
    const missing = ['image', 'depth', 'focus_m', 'f_number'].filter((name) => !session.inputNames.includes(name))
    if (missing.length) {
      throw new Error(`the file must take image, depth, focus_m and f_number; it takes ${session.inputNames.join(', ')}`)
    }
    return new DepthOfField(ort, session)
  }

  constructor(ort, session) {
    this.ort = ort
    this.session = session
  }

  /**
   * Render depth of field.
   *
   * @param {Float32Array} light Linear light, [3, height, width]: all red values, then green, then blue.
   * @param {Float32Array} depth Metres along the optical axis, [height, width]; NaN, zero and negative stay sharp.
   * @param {number} focusM Focus distance in metres.
   * @param {number} fNumber Focal length over aperture diameter: smaller blurs more.
   * @param {Float32Array | null} matte Coverage by the subject, 0 to 1, [height, width], for a file that takes one.
   * @returns {Promise<Float32Array>} Linear light, [3, height, width].
   */
  async render(light, depth, width, height, focusM, fNumber, matte = null) {
    if (light.length !== 3 * width * height || depth.length !== width * height) {
      throw new Error(
        `${width} x ${height} pixels need ${3 * width * height} values of light and ${width * height} of depth, ` +
          `got ${light.length} and ${depth.length}`,
      )
    }
    const tensor = (values, dims) => new this.ort.Tensor('float32', values, dims)
    const takesMatte = this.session.inputNames.includes('matte')
    if (matte !== null && (!takesMatte || matte.length !== width * height)) {
      throw new Error(
        takesMatte
          ? `${width} x ${height} pixels need ${width * height} values of the matte, got ${matte.length}`
          : 'the file takes no matte: write it with torchdof export --inputs depth+matte',
      )
    }
    const { out } = await this.session.run({
      image: tensor(light, [1, 3, height, width]),
      depth: tensor(depth, [1, 1, height, width]),
      focus_m: tensor(Float32Array.of(focusM), [1]),
      f_number: tensor(Float32Array.of(fNumber), [1]),
      ...(takesMatte && { matte: tensor(matte ?? new Float32Array(width * height), [1, 1, height, width]) }),
    })
    return out.data
  }
}
