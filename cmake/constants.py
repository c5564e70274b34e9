"""Writes C++ headers of the constants that the Python modules define: ``constants.py FOLDER``.

A constant has one definition, in the Python module whose comment gives its meaning and unit. C++ includes
``constants/disocclusion.h`` and reads ``_FALL`` of ``render/surfaces/disocclusion.py`` as
``constants::disocclusion::FALL``. The build runs this file, which reads the sources without importing them. A checksum
of ``native/api.h`` identifies the interface with which the engine was compiled.
"""

import ast
import contextlib
import math
import operator
import re
import sys
import zlib
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).parents[1] / "torchdof"
MODULES = (
    "native/__init__",
    *(f"optics/{name}" for name in ("kernel_bank", "placed_kernels", "psf")),
    *(f"render/{name}" for name in ("exposure", "highlights", "pipeline")),
    *(f"render/surfaces/{name}" for name in ("border", "disocclusion", "doubt", "edge_colours", "edge_prior")),
    *(f"render/surfaces/{name}" for name in ("edge_search", "edges", "emitters", "frame", "matting", "missed")),
    *(f"render/surfaces/{name}" for name in ("registration", "soft_maps", "windows")),
    *(f"render/layers/{name}" for name in ("composite", "convolution", "downsampling", "field")),
    *(f"render/layers/{name}" for name in ("layer_cocs", "layer_weights", "plan")),
)
"""Modules whose constants C++ may read; a header and its namespace have the name of their module."""

SINGLE = (
    *("composite", "disocclusion", "doubt", "edge_colours", "edge_prior", "edge_search", "edges"),
    *("emitters", "frame", "highlights", "matting", "missed", "pipeline", "registration", "soft_maps", "windows"),
)
"""Modules whose C++ computes with single precision alone: their constants are ``float``, the others' ``double``."""

Value = int | float | tuple[int | float, ...]

_OPERATORS: dict[type[ast.AST], Any] = {
    **{ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv},
    **{ast.FloorDiv: operator.floordiv, ast.Pow: operator.pow, ast.USub: operator.neg},
}


def constants_of(module: str) -> dict[str, Value]:
    """Numbers, and tuples of numbers, that a module such as ``render/layers/plan`` assigns to names in capitals.

    Their expressions may have arithmetic, ``math`` and names of constants above them; others are left out.
    """
    source = (PACKAGE / f"{module}.py").read_text(encoding="utf-8")
    constants: dict[str, Value] = {}
    for node in ast.parse(source).body:
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        target, value = node.targets[0] if isinstance(node, ast.Assign) else node.target, node.value
        pairs: list[tuple[ast.AST, ast.AST | None]] = [(target, value)]
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = [*zip(target.elts, value.elts, strict=True)]
        for name, number in pairs:
            if isinstance(name, ast.Name) and re.fullmatch("_?[A-Z][A-Z0-9_]*", name.id):
                with contextlib.suppress(KeyError, TypeError, ArithmeticError):  # not a number
                    constants[name.id] = _value(number, constants)
    return constants


def _value(node: ast.AST | None, constants: dict[str, Value]) -> Any:
    """The value of an expression; ``KeyError`` or ``TypeError`` if it is not a number or a tuple of numbers."""
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return node.value
    if isinstance(node, ast.Name):
        return constants[node.id]
    if isinstance(node, ast.Tuple) and node.elts:
        return tuple(_value(item, constants) for item in node.elts)
    if isinstance(node, ast.UnaryOp):
        return _OPERATORS[type(node.op)](_value(node.operand, constants))
    if isinstance(node, ast.BinOp):
        return _OPERATORS[type(node.op)](_value(node.left, constants), _value(node.right, constants))
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "math":
        return getattr(math, node.attr)
    if isinstance(node, ast.Call) and not node.keywords:
        return _value(node.func, constants)(*(_value(item, constants) for item in node.args))
    raise TypeError


def headers() -> dict[str, str]:
    """The text of each header by its name.

    ``checksum`` has a number that changes with any constant, and one that changes with the C interface.
    """
    texts = {}
    for module in MODULES:
        name = module.removesuffix("/__init__").rpartition("/")[2]
        real = "float" if name in SINGLE else "double"
        texts[name] = _header(name, [_line(*item, real) for item in constants_of(module).items()])
    interface = (PACKAGE / "native" / "api.h").read_text(encoding="utf-8")
    checked = {"ALL": "".join(texts.values()), "INTERFACE": interface}
    lines = [f"constexpr uint32_t {name} = {zlib.crc32(text.encode())}u;" for name, text in checked.items()]
    return texts | {"checksum": _header("checksum", lines)}


def _header(name: str, lines: list[str]) -> str:
    start = ["// Written by cmake/constants.py from the Python module, which gives meanings and units.", "#pragma once"]
    space = f"namespace torchdof::constants::{name} {{"
    return "\n".join(
        [*start, "#include <cstdint>", "", space, *lines, f"}}  // namespace torchdof::constants::{name}", ""]
    )


def _line(name: str, value: Value, real: str) -> str:
    """Definition of a constant, of type ``real`` if it is not whole; a tuple becomes an array."""
    items = value if isinstance(value, tuple) else (value,)
    kind = real if any(isinstance(item, float) for item in items) else "int"
    if kind == "int" and max(map(abs, items)) >= 2**31:
        kind = "int64_t"
    shown = ", ".join(map(repr, items))
    return f"constexpr {kind} {name.lstrip('_')}" + (
        f"[] = {{{shown}}};" if isinstance(value, tuple) else f" = {shown};"
    )


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in headers().items():
        file = folder / f"{name}.h"
        if not file.exists() or file.read_text(encoding="utf-8") != text:  # else what includes it is compiled anew
            file.write_text(text, encoding="utf-8")
