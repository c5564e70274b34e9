// PNG files with all their bits; browsers would reduce 16-bit depth maps to 8 bits and apply colour profiles to them.
// For Node 18 and browsers, without dependencies.

const SIGNATURE = [137, 80, 78, 71, 13, 10, 26, 10]
const CHANNELS = { 0: 1, 2: 3, 3: 1, 4: 2, 6: 4 } // by colour type: grey, RGB, palette, grey + alpha, RGB + alpha

export const isPng = (bytes) => SIGNATURE.every((byte, i) => bytes[i] === byte)

/**
 * Decode a PNG file.
 *
 * @param {Uint8Array} bytes
 * @returns {Promise<{width, height, channels, bits, samples: Uint8Array | Uint16Array}>} bits is 8 or 16; samples are
 *   height * width * channels. A palette is resolved to RGB.
 */
export async function decodePng(bytes) {
  if (!isPng(bytes)) throw new Error('this is not a PNG file')
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength)
  const data = []
  let header
  let palette
  for (let at = 8; at + 12 <= bytes.length; ) {
    const length = view.getUint32(at)
    const name = String.fromCharCode(...bytes.subarray(at + 4, at + 8))
    const chunk = bytes.subarray(at + 8, at + 8 + length)
    if (name === 'IHDR') header = [view.getUint32(at + 8), view.getUint32(at + 12), ...chunk.subarray(8, 13)]
    if (name === 'PLTE') palette = chunk
    if (name === 'IDAT') data.push(chunk)
    if (name === 'IEND') break
    at += 12 + length
  }
  if (!header || !data.length) throw new Error('the PNG file is damaged: it holds no picture')
  const [width, height, bits, colour, , , interlaced] = header
  if (interlaced) throw new Error('the PNG file is interlaced: save it without interlacing')
  const channels = CHANNELS[colour]
  const rowBytes = Math.ceil((width * channels * bits) / 8)
  let packed
  try {
    packed = await through(new DecompressionStream('deflate'), data)
  } catch {
    throw new Error('the PNG file is damaged: its data cannot be decompressed')
  }
  if (packed.length < height * (rowBytes + 1)) throw new Error('the PNG file ends before its last row: it is damaged')
  const raw = unfiltered(packed, height, rowBytes, Math.max(1, (channels * bits) / 8))
  const samples = bits === 16 ? words(raw) : bits === 8 ? raw : unpacked(raw, width, height, rowBytes, bits, !palette)
  if (colour !== 3) return { width, height, channels, bits: Math.max(8, bits), samples }
  const rgb = new Uint8Array(3 * samples.length)
  samples.forEach((index, i) => rgb.set(palette.subarray(3 * index, 3 * index + 3), 3 * i))
  return { width, height, channels: 3, bits: 8, samples: rgb }
}

/**
 * Encode 8-bit samples as a PNG file, tagged as sRGB.
 *
 * @param {Uint8Array | Uint8ClampedArray} samples height * width * channels; 3 channels are RGB, 4 RGB and alpha.
 * @returns {Promise<Uint8Array>}
 */
export async function encodePng(samples, width, height, channels) {
  const row = width * channels
  const filtered = new Uint8Array(height * (row + 1))
  for (let y = 0; y < height; y++) {
    filtered[y * (row + 1)] = 2 // Up: the difference to the row above
    for (let i = 0; i < row; i++) {
      const above = y ? samples[(y - 1) * row + i] : 0
      filtered[y * (row + 1) + 1 + i] = samples[y * row + i] - above
    }
  }
  const header = new Uint8Array(13)
  new DataView(header.buffer).setUint32(0, width)
  new DataView(header.buffer).setUint32(4, height)
  header.set([8, channels === 3 ? 2 : 6], 8)
  const data = await through(new CompressionStream('deflate'), [filtered])
  const chunks = [chunkOf('IHDR', header), chunkOf('sRGB', [0]), chunkOf('IDAT', data), chunkOf('IEND', [])]
  return new Uint8Array(await new Blob([Uint8Array.from(SIGNATURE), ...chunks]).arrayBuffer())
}

async function through(transformation, parts) {
  return new Uint8Array(await new Response(new Blob(parts).stream().pipeThrough(transformation)).arrayBuffer())
}

/** Undo the filters of the PNG specification, section 9. */
function unfiltered(packed, height, rowBytes, step) {
  const raw = new Uint8Array(height * rowBytes)
  for (let y = 0; y < height; y++) {
    const filter = packed[y * (rowBytes + 1)]
    const from = y * (rowBytes + 1) + 1
    const row = y * rowBytes
    for (let i = 0; i < rowBytes; i++) {
      const left = i >= step ? raw[row + i - step] : 0
      const above = y ? raw[row + i - rowBytes] : 0
      let guess = 0
      if (filter === 1) guess = left
      else if (filter === 2) guess = above
      else if (filter === 3) guess = (left + above) >> 1
      else if (filter === 4) {
        const corner = y && i >= step ? raw[row + i - rowBytes - step] : 0
        const toLeft = Math.abs(above - corner)
        const toAbove = Math.abs(left - corner)
        const toCorner = Math.abs(left + above - 2 * corner)
        guess = toLeft <= toAbove && toLeft <= toCorner ? left : toAbove <= toCorner ? above : corner
      }
      raw[row + i] = packed[from + i] + guess
    }
  }
  return raw
}

function words(raw) {
  const values = new Uint16Array(raw.length / 2)
  for (let i = 0; i < values.length; i++) values[i] = (raw[2 * i] << 8) | raw[2 * i + 1]
  return values
}

/** Samples of 1, 2 or 4 bits to bytes; greys are spread over 0 to 255, indices of a palette are kept. */
function unpacked(raw, width, height, rowBytes, bits, spread) {
  const samples = new Uint8Array(width * height)
  const most = 2 ** bits - 1
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const place = x * bits
      const value = (raw[y * rowBytes + (place >> 3)] >> (8 - bits - (place & 7))) & most
      samples[y * width + x] = spread ? (value * 255) / most : value
    }
  }
  return samples
}

const CRC = Uint32Array.from({ length: 256 }, (_, n) => {
  for (let k = 0; k < 8; k++) n = n & 1 ? 0xedb88320 ^ (n >>> 1) : n >>> 1
  return n
})

function chunkOf(name, content) {
  const chunk = new Uint8Array(12 + content.length)
  const view = new DataView(chunk.buffer)
  view.setUint32(0, content.length)
  chunk.set([...name].map((letter) => letter.charCodeAt(0)), 4)
  chunk.set(content, 8)
  let crc = 0xffffffff
  for (const byte of chunk.subarray(4, 8 + content.length)) crc = CRC[(crc ^ byte) & 255] ^ (crc >>> 8)
  view.setUint32(8 + content.length, ~crc)
  return chunk
}
