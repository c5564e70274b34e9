"""What functions need that :mod:`onnxscript` compiles to ONNX: their operators, types and decorator."""

from typing import TYPE_CHECKING

import onnxscript

from .structure import DOMAIN

if TYPE_CHECKING:  # the functions are not run as Python, and types differ
    from typing import Any
    from typing import Any as Depth
    from typing import Any as Flag
    from typing import Any as Floats
    from typing import Any as Image
    from typing import Any as Ints
    from typing import Any as Items

    op: Any
else:
    from onnxscript import opset20 as op

    Flag, Floats, Ints = onnxscript.BOOL[...], onnxscript.FLOAT[...], onnxscript.INT64[...]
    Image, Depth = onnxscript.FLOAT["B", 3, "H", "W"], onnxscript.FLOAT["B", 1, "H", "W"]
    Items = onnxscript.FLOAT["B"]

__all__ = ["Depth", "Flag", "Floats", "Image", "Ints", "Items", "op", "script"]

script = onnxscript.script(onnxscript.values.Opset(DOMAIN, 1), default_opset=op)
"""Decorator of these functions."""
