"""A depth estimator and a module in one graph, with everything between them spelled out."""

import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import onnx
import onnx.compose
import onnx.parser
import onnx.version_converter

from .metadata import PREFIX, facts_of, load
from .verification import check_format, session

__all__ = ["chain"]

Estimate = Literal["metric", "inverse", "relative-inverse"]

_ENCODE = """
<ir_version: {ir}, opset_import: ["": {opset}]>
encode (float[B,3,H,W] image) => (float[B,3,h,w] encoded, float[B,3,H,W] light) {{
    light = Identity(image)
    zero = Constant<value = float {{0.0}}>()
    one = Constant<value = float {{1.0}}>()
    low = Constant<value = float {{0.0031308}}>()
    slope = Constant<value = float {{12.92}}>()
    power = Constant<value = float {{0.41666666}}>()
    gain = Constant<value = float {{1.055}}>()
    offset = Constant<value = float {{0.055}}>()
    mean = Constant<value = float[1,3,1,1] {{{mean}}}>()
    std = Constant<value = float[1,3,1,1] {{{std}}}>()
    clipped = Clip(image, zero, one)
    is_low = LessOrEqual(clipped, low)
    line = Mul(clipped, slope)
    curved = Pow(clipped, power)
    raised = Mul(curved, gain)
    curve = Sub(raised, offset)
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
    encoded = Resize<mode = "linear", coordinate_transformation_mode = "half_pixel", antialias = 1>(normal, , , size)
"""

_DECODE = """
<ir_version: {ir}, opset_import: ["": {opset}]>
decode ({estimate} estimate, float[B,3,H,W] light) => (float[B,1,H,W] depth, float[B,3,H,W] image) {{
    image = Identity(light)
    zero = Constant<value = int64 {{0}}>()
    estimate_shape = Shape(estimate)
    one = Constant<value_ints = [1]>()
    inner = Constant<value_ints = [-2]>()
    batch_part = Shape<start = 0, end = 1>(estimate)
    frame_part = Slice(estimate_shape, inner, far_end)
    far_end = Constant<value_ints = [9223372036854775807]>()
}}
"""
