"""Depth of field without PyTorch: a file of ``torchdof export``, run by onnxruntime.

Usage: python examples/embed/run_onnx.py dof.onnx photo.png depth.npz out.png --focus-m 2.3 --f-number 0.6 \
           --disparity-scale 192.03 --disparity-offset 31.086

The image is decoded to linear light, and the result encoded as sRGB. Depth is an array in metres (``.npy``, or the only
one in an ``.npz``), or disparity if its scale (baseline in metres times focal length in pixels) is given. Pixels
without depth (0, NaN or infinite disparity) stay sharp.
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
    parser.add_argument("depth", help=".npy or .npz")
    parser.add_argument("out")
    parser.add_argument("--focus-m", type=float, required=True)
    parser.add_argument("--f-number", type=float, required=True)
    parser.add_argument("--disparity-scale", type=float, help="metres = scale / (value + offset)")
    parser.add_argument("--disparity-offset", type=float, default=0.0)
    arguments = parser.parse_args()

    session = onnxruntime.InferenceSession(arguments.model, providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    print(f"table {json.loads(metadata['torchdof.table'])}, options {json.loads(metadata['torchdof.options'])}")

    light = read_image(arguments.image)
    depth = read_depth(arguments.depth, arguments.disparity_scale, arguments.disparity_offset)
    if light.shape[-2:] != depth.shape[-2:]:
        raise SystemExit(f"the image is {light.shape[-2:]}, its depth {depth.shape[-2:]}")
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


def read_depth(path: str, scale: float | None, offset: float) -> np.ndarray:
    """Metres, ``[1, 1, H, W]`` float32; NaN without depth."""
    loaded = np.load(path)
    values = np.asarray(loaded[loaded.files[0]] if hasattr(loaded, "files") else loaded, dtype=np.float32)
    if scale is not None:
        values = np.where(np.isfinite(values) & (values > 0), scale / (values + offset), np.nan)
    return np.ascontiguousarray(values[None, None], dtype=np.float32)


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
