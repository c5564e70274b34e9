// Runs the modules of examples/embed/javascript on small inputs: node modules.mjs FOLDER prints the results as JSON.
import { readFileSync } from 'node:fs'
import { join, resolve } from 'node:path'
import { pathToFileURL } from 'node:url'

const folder = process.argv[2]
const embed = resolve('examples/embed/javascript')
const load = (name) => import(pathToFileURL(join(embed, name)).href)
const { depthAtSize, fillHoles, metresOf, readDepthMap } = await load('depth.mjs')
const { linearLight, srgbBytes } = await load('light.mjs')
const { decodePng, encodePng } = await load('png.mjs')

const rgba = new Uint8Array(readFileSync(join(folder, 'rgba.bin')))
const map = await readDepthMap(readFileSync(join(folder, 'depth.npy')))
const holes = Float32Array.of(NaN, NaN, NaN, 2, NaN, 5, 1, NaN, NaN, NaN, NaN, NaN)
const share = fillHoles(holes, 3)
const codes = Uint8Array.from({ length: 1024 }, (_, i) => i >> 2)
const message = async (act) => {
  try {
    return await act()
  } catch (error) {
    return error.message
  }
}

console.log(
  JSON.stringify({
    light: [...linearLight(rgba, 10, 6)],
    smaller: [...linearLight(rgba, 10, 6, 4, 3)],
    codes: [...srgbBytes(linearLight(codes, 16, 16))],
    beyond: [...srgbBytes(Float32Array.of(-1, 2, NaN))],
    values: [...map.values],
    size: [map.width, map.height],
    disparity: [...metresOf(map, { kind: 'disparity', nearM: 1, farM: 5 })],
    depth: [...metresOf(map, { kind: 'depth', nearM: 1, farM: 5 })],
    resized: [...depthAtSize(Float32Array.of(1, 2, 3, 4), 2, 2, 4, 3)],
    holes: [...holes],
    share,
    png: [...(await decodePng(await encodePng(rgba, 10, 6, 4))).samples],
    wrongWay: await message(() => metresOf(map, { kind: 'depth', nearM: 5, farM: 1 })),
    noFile: await message(() => readDepthMap(new Uint8Array(40))),
    cut: await message(() => readDepthMap(readFileSync(join(folder, 'depth.npy')).subarray(0, 140))),
  }),
)
