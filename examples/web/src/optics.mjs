// The thin lens of the exported file, for the numbers and the depth view of the page.

/**
 * Signed radius in pixels of the circle of confusion: coc = (A / 2) F (1/s - 1/z), negative in front of the focus.
 *
 * All between `focus.nearM` and `focus.farM` is in focus: in front of this range s is nearM, behind it farM.
 */
export function cocPx(camera, width, focus, fNumber, depthM) {
  const apertureRadiusM = camera.focal_length_mm / 1000 / fNumber / 2
  const focalPx = (camera.focal_length_mm / camera.sensor_width_mm) * width
  const inFront = Math.min(0, 1 / focus.nearM - 1 / depthM)
  const behind = Math.max(0, 1 / focus.farM - 1 / depthM)
  return apertureRadiusM * focalPx * (inFront + behind)
}

/**
 * Depth with which a lens focused on `focus.nearM` blurs as one that keeps the whole range of `focus` sharp.
 *
 * The exported file focuses on one distance. So the range becomes that distance, and what lies behind it comes nearer by
 * as many dioptres (1 / depth) as the range spans.
 */
export function withoutRange(metres, { nearM, farM }) {
  if (nearM === farM) return metres
  const span = 1 / nearM - 1 / farM
  return metres.map((depthM) => (depthM <= nearM ? depthM : depthM <= farM ? nearM : 1 / (1 / depthM + span)))
}

/** A picture of depth: near is light; pixels with a blur radius below one pixel of the result are tinted. */
export function depthPicture(metres, width, height, near, far, coc) {
  const image = new ImageData(width, height)
  for (let i = 0; i < metres.length; i++) {
    const share = (1 / metres[i] - 1 / far) / (1 / near - 1 / far)
    const grey = 20 + 215 * Math.min(1, Math.max(0, share))
    const sharpness = Math.max(0, 1 - Math.abs(coc(metres[i])))
    image.data[4 * i] = grey + sharpness * (255 - grey)
    image.data[4 * i + 1] = grey + sharpness * (176 - grey)
    image.data[4 * i + 2] = grey + sharpness * (46 - grey)
    image.data[4 * i + 3] = 255
  }
  return image
}

/** Distance of the surface at a point of the picture: the median of a small patch of the depth map. */
export function distanceAt(metres, width, height, u, v) {
  const column = Math.min(width - 1, Math.floor(u * width))
  const row = Math.min(height - 1, Math.floor(v * height))
  const patch = []
  for (let y = Math.max(0, row - 2); y <= Math.min(height - 1, row + 2); y++) {
    for (let x = Math.max(0, column - 2); x <= Math.min(width - 1, column + 2); x++) patch.push(metres[y * width + x])
  }
  return patch.sort((a, b) => a - b)[patch.length >> 1]
}
