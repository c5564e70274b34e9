"""The conversions before and after a depth estimator, as two small graphs in ONNX's text format.

``encode`` converts linear light to an estimator's input: clipped, sRGB-encoded, normalized, resized. ``decode``
converts the estimator's output to depth in metres at the image's size. It resizes inverse depth linearly, because in
inverse depth planes stay planes.
"""

from collections.abc import Sequence

import onnx
import onnx.parser

__all__ = ["decode", "encode"]

_ENCODE = """
<ir_version: {ir}, opset_import: ["": {opset}]>
encode (float[B,3,H,W] image) => (float[b,3,h,w] encoded, float[B,3,H,W] light) {{
    light = Identity(image)
    zero = Constant<value_float = 0.0>()
    one = Constant<value_float = 1.0>()
    low = Constant<value_float = 0.0031308>()
    slope = Constant<value_float = 12.92>()
    power = Constant<value_float = 0.41666666>()
    gain = Constant<value_float = 1.055>()
    offset = Constant<value_float = 0.055>()
    mean = Constant<value = float[1,3,1,1] {{{mean}}}>()
    std = Constant<value = float[1,3,1,1] {{{std}}}>()
    clipped = Clip(image, zero, one)
    is_low = LessOrEqual(clipped, low)
    line = Mul(clipped, slope)
    powered = Pow(clipped, power)
    gained = Mul(powered, gain)
    curve = Sub(gained, offset)
    display = Where(is_low, line, curve)
    centred = Sub(display, mean)
    normal = Div(centred, std)
    {resize}
}}
"""

_KEEP_SIZE = "encoded = Identity(normal)"

_FIXED_SIZE = """
    batch = Shape<start = 0, end = 2>(image)
    frame = Constant<value_ints = [{height}, {width}]>()
    size = Concat<axis = 0>(batch, frame)
    encoded = Resize<mode = "linear", antialias = 1>(normal, , , size)
"""

_DECODE = """
<ir_version: {ir}, opset_import: ["": {opset}]>
decode (float[{shape}] estimate, float[B,3,H,W] light{ends}) => (float[B,1,H,W] depth, float[B,3,H,W] image) {{
    image = Identity(light)
    zero = Constant<value_float = 0.0>()
    scale = Constant<value_float = {scale}>()
    shift = Constant<value_float = {shift}>()
    {channel}
    {inverse}
    batch = Shape<start = 0, end = 2>(inverse)
    frame = Shape<start = 2, end = 4>(light)
    size = Concat<axis = 0>(batch, frame)
    resized = Resize<mode = "linear">(inverse, , , size)
    farthest = Constant<value_float = 0.0>()
    behind = Less(resized, farthest)
    positive = Where(behind, farthest, resized)
    depth = Reciprocal(positive)
}}
"""

_ADD_CHANNEL = """
    axis = Constant<value_ints = [1]>()
    values = Unsqueeze(estimate, axis)
"""

_INVERSE = {
    "metric": """
    metres = Mul(values, scale)
    inverse = Reciprocal(metres)
""",
    "inverse": """
    scaled = Mul(values, scale)
    inverse = Add(scaled, shift)
""",
    "relative-inverse": """
    axes = Constant<value_ints = [1, 2, 3]>()
    least = ReduceMin(values, axes)
    most = ReduceMax(values, axes)
    range = Sub(most, least)
    tiny = Constant<value_float = 1e-12>()
    positive_range = Max(range, tiny)
    above = Sub(values, least)
    fraction = Div(above, positive_range)
    near_column = Unsqueeze(near_m, axes)
    far_column = Unsqueeze(far_m, axes)
    near_inverse = Reciprocal(near_column)
    far_inverse = Reciprocal(far_column)
    span = Sub(near_inverse, far_inverse)
    climbed = Mul(fraction, span)
    inverse = Add(climbed, far_inverse)
""",
}


def encode(
    opset: int, ir: int, size: tuple[int, int] | None, mean: Sequence[float], std: Sequence[float]
) -> onnx.ModelProto:
    """A graph that converts linear light ``[B, 3, H, W]`` to an estimator's input, and also returns the light."""
    resize = _KEEP_SIZE if size is None else _FIXED_SIZE.format(height=size[0], width=size[1])
    text = _ENCODE.format(ir=ir, opset=opset, resize=resize, mean=_numbers(mean), std=_numbers(std))
    return onnx.parser.parse_model(text)


def decode(opset: int, ir: int, kind: str, rank: int, scale: float, shift: float) -> onnx.ModelProto:
    """A graph that converts an estimator's output (``[B, h, w]`` or ``[B, 1, h, w]``) to depth in metres."""
    text = _DECODE.format(
        ir=ir,
        opset=opset,
        shape="b,h,w" if rank == 3 else "b,1,h,w",
        ends=", float[B] near_m, float[B] far_m" if kind == "relative-inverse" else "",
        scale=float(scale),
        shift=float(shift),
        channel=_ADD_CHANNEL if rank == 3 else "values = Identity(estimate)",
        inverse=_INVERSE[kind],
    )
    return onnx.parser.parse_model(text)


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(str(float(v)) for v in values)
