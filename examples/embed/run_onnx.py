"""Depth of field without PyTorch: a file of ``torchdof export``, run by onnxruntime.

Usage: python examples/embed/run_onnx.py dof.onnx photo.png depth.npz out.png --focus-m 2.3 --f-number 0.6 \
           --disparity-scale 192.03 --disparity-offset 31.086
       python examples/embed/run_onnx.py dof.onnx photo.png depth.png out.png --focus-m 2.3 --f-number 0.6 --scale 0.001

The image is decoded to linear light, and the result encoded as sRGB. Depth is an array (``.npy``, or the only one in an
``.npz``) or a grey PNG of 8 or 16 bits: values times ``--scale`` are metres. With ``--near-m`` and ``--far-m`` they are
relative disparity, as estimators give it; with its scale (baseline in metres times focal length in pixels) they are
disparity. Pixels without depth (0, NaN or infinite disparity) stay sharp.
"""

import argparse
import json
import time

import numpy as np
import onnxruntime
import OpenImageIO as oiio


def main() -> None:
    """Read, run, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("model", help="file written by torchdof export")
    parser.add_argument("image")
    parser.add_argument("depth", help=".npy, .npz or a grey .png")
    parser.add_argument("out")
    parser.add_argument("--focus-m", type=float, required=True)
    parser.add_argument("--f-number", type=float, required=True)
    parser.add_argument("--scale", type=float, default=1.0, help="metres = scale * value; 0.001 for millimetres")
    parser.add_argument("--near-m", type=float, help="metres of the largest value of relative disparity")
    parser.add_argument("--far-m", type=float, help="metres of its smallest value")
    parser.add_argument("--disparity-scale", type=float, help="metres = scale / (value + offset)")
    parser.add_argument("--disparity-offset", type=float, default=0.0)
    arguments = parser.parse_args()

    session = onnxruntime.InferenceSession(arguments.model, providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    print(f"table {json.loads(metadata['torchdof.table'])}, options {json.loads(metadata['torchdof.options'])}")

    light = read_image(arguments.image)
    depth = at_size_of(light, metres_of(read_values(arguments.depth), arguments))
    lens = {name: np.full(1, getattr(arguments, name), np.float32) for name in ("focus_m", "f_number")}
    start = time.perf_counter()
    (out,) = session.run(None, {"image": light, "depth": depth, **lens})
    print(f"{light.shape[-1]} x {light.shape[-2]}: {time.perf_counter() - start:.2f} s")
    write_image(arguments.out, out)


def read_image(path: str) -> np.ndarray:
    """Linear light, ``[1, 3, H, W]`` float32."""
    buffer = oiio.ImageBuf(path)
    if buffer.has_error:
        raise SystemExit(f"cannot read {path}: {buffer.geterror()}")
    values = np.asarray(buffer.get_pixels(oiio.FLOAT))[..., :3]
    if buffer.spec().format.basetype in (oiio.UINT8, oiio.UINT16):
        values = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return np.ascontiguousarray(values.transpose(2, 0, 1)[None], dtype=np.float32)


def read_values(path: str) -> np.ndarray:
    """Numbers of a depth map, ``[H, W]`` float32; of a PNG the stored whole numbers."""
    if path.lower().endswith((".npy", ".npz")):
        loaded = np.load(path)
        return np.squeeze(np.asarray(loaded[loaded.files[0]] if hasattr(loaded, "files") else loaded, np.float32))
    buffer = oiio.ImageBuf(path)
    if buffer.has_error or buffer.spec().format.basetype not in (oiio.UINT8, oiio.UINT16):
        raise SystemExit(f"{path}: a depth map must be a grey PNG of 8 or 16 bits, .npy or .npz")
    values = np.asarray(buffer.get_pixels(oiio.FLOAT))
    if values.shape[-1] > 2 and np.ptp(values[..., :3], axis=-1).max() > 8 / 255:
        raise SystemExit(f"{path}: is in colour, which is made for eyes; save the depth itself, as shades of grey")
    largest = 255 if buffer.spec().format.basetype == oiio.UINT8 else 65535
    return np.rint(largest * values[..., 0]).astype(np.float32)


def metres_of(values: np.ndarray, meaning: argparse.Namespace) -> np.ndarray:
    """Metres, ``[H, W]``; NaN without depth."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if meaning.near_m is not None or meaning.far_m is not None:
            if not (meaning.near_m and meaning.far_m and 0 < meaning.near_m < meaning.far_m):
                raise SystemExit("relative disparity needs both --near-m and --far-m, the smaller one first")
            low, high = np.nanmin(values), np.nanmax(values)
            if not low < high:
                raise SystemExit("the depth map has one value everywhere: nothing tells near from far")
            share = (values - low) / (high - low)
            return 1 / (share / meaning.near_m + (1 - share) / meaning.far_m)
        if meaning.disparity_scale is None:
            return np.where(values > 0, meaning.scale * values, np.nan)
        metres = meaning.disparity_scale / (values + meaning.disparity_offset)
        return np.where(np.isfinite(values) & (values > 0), metres, np.nan)


def at_size_of(light: np.ndarray, metres: np.ndarray) -> np.ndarray:
    """Metres ``[1, 1, H, W]`` float32 at the size of ``[1, 3, H, W]``, by nearest neighbour: no depth is invented."""
    places = [((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(light.shape[-2:], metres.shape, strict=True)]
    return np.ascontiguousarray(metres[np.ix_(*places)][None, None], dtype=np.float32)


def write_image(path: str, light: np.ndarray) -> None:
    """Writes linear light ``[1, 3, H, W]`` to an 8-bit sRGB file, or to a float file (.exr, .hdr, .pfm)."""
    values = light[0].transpose(1, 2, 0)
    if not path.endswith((".exr", ".hdr", ".pfm")):
        values = np.clip(values, 0.0, 1.0)
        values = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
    buffer = oiio.ImageBuf(np.ascontiguousarray(values, dtype=np.float32))
    if not buffer.write(path, oiio.FLOAT if path.endswith((".exr", ".hdr", ".pfm")) else oiio.UINT8):
        raise SystemExit(f"cannot write {path}: {buffer.geterror()}")


if __name__ == "__main__":
    main()
