"""The conversions before and after a depth estimator, as two small graphs.

``encode`` converts linear light to an estimator's input: clipped, sRGB-encoded, normalized, resized. ``decode``
converts the estimator's output to depth in metres at the image's size. It resizes inverse depth linearly, because in
inverse depth planes stay planes.
"""

# mypy: ignore-errors
# The functions below are not run as Python, and their types differ from those of Python.

from collections.abc import Sequence

import onnx
import onnxscript
from onnxscript import FLOAT
from onnxscript import opset20 as op

__all__ = ["decode", "encode"]

Floats, Items = FLOAT[...], FLOAT["B"]
Image, Depth = FLOAT["B", 3, "H", "W"], FLOAT["B", 1, "H", "W"]

script = onnxscript.script(onnxscript.values.Opset("torchdof", 1), default_opset=op)
"""Decorator of functions that :mod:`onnxscript` compiles to ONNX."""


def encode(size: tuple[int, int] | None, mean: Sequence[float], std: Sequence[float]) -> onnx.ModelProto:
    """A graph that converts linear light ``[B, 3, H, W]`` to an estimator's input."""
    means, divisors, target = list(map(float, mean)), list(map(float, std)), list(size or (0, 0))

    @script
    def encode(image: Image) -> Floats:
        per_channel = op.Constant(value_ints=[1, 3, 1, 1])
        clipped = op.Clip(image, 0.0, 1.0)
        display = op.Where(clipped <= 0.0031308, clipped * 12.92, 1.055 * op.Pow(clipped, 0.41666666) - 0.055)
        centred = display - op.Reshape(op.Constant(value_floats=means), per_channel)
        normal = centred / op.Reshape(op.Constant(value_floats=divisors), per_channel)
        wanted = op.Constant(value_ints=target)
        frame = op.Where(wanted > 0, wanted, op.Shape(image, start=2, end=4))
        sizes = op.Concat(op.Shape(image, start=0, end=2), frame, axis=0)
        return op.Resize(normal, None, None, sizes, mode="linear", antialias=1)

    return encode.to_model_proto()


@script
def depth_of(inverse: Floats, image: Floats) -> Floats:
    """Depth in metres at the size of the image; infinite where inverse depth is not positive."""
    size = op.Concat(op.Shape(inverse, start=0, end=2), op.Shape(image, start=2, end=4), axis=0)
    resized = op.Resize(inverse, None, None, size, mode="linear")
    return op.Reciprocal(op.Where(resized < 0.0, 0.0, resized))


@script
def maps_of(estimate: Floats) -> Floats:
    """``[B, h, w]`` or ``[B, 1, h, w]`` as ``[B, 1, h, w]``."""
    frame = op.Shape(estimate, start=-2)
    return op.Reshape(estimate, op.Concat(op.Constant(value_ints=[0, 1]), frame, axis=0))


def decode(kind: str, scale: float, shift: float) -> onnx.ModelProto:
    """A graph that converts an estimator's output ``[B, h, w]`` or ``[B, 1, h, w]`` to depth in metres."""
    scale, shift = float(scale), float(shift)

    @script
    def metric(estimate: Floats, image: Image) -> Depth:
        return depth_of(op.Reciprocal(maps_of(estimate) * scale), image)

    @script
    def inverse(estimate: Floats, image: Image) -> Depth:
        return depth_of(maps_of(estimate) * scale + shift, image)

    @script
    def relative(estimate: Floats, image: Image, near_m: Items, far_m: Items) -> Depth:
        axes = op.Constant(value_ints=[1, 2, 3])
        values = maps_of(estimate)
        least = op.ReduceMin(values, axes)
        fraction = (values - least) / op.Max(op.ReduceMax(values, axes) - least, 1e-12)
        farthest = op.Reciprocal(op.Unsqueeze(far_m, axes))
        return depth_of(fraction * (op.Reciprocal(op.Unsqueeze(near_m, axes)) - farthest) + farthest, image)

    return {"metric": metric, "inverse": inverse, "relative-inverse": relative}[kind].to_model_proto()
