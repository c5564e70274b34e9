"""What a file says about itself: producer, units of its inputs, camera, table, options."""

import hashlib
import json
import os
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import onnx

from torchdof import BlurTable, DepthOfField
from torchdof.optics.camera import Camera

from .graph import OUTPUT, Portable

__all__ = ["UNITS", "describe", "facts_of", "label", "load", "table_hash", "write_facts"]

PREFIX = "torchdof."
UNITS = {
    "image": "[B, {channels}, H, W] float32, linear light, >= 0, any range",
    "depth": "[B, 1, H, W] float32, metres along the optical axis, inf allowed; NaN, zero and negative pass sharp",
    "coc_px": "[B, 1, H, W] float32, radius in pixels, negative in front of the focus plane; NaN passes sharp",
    "focus_m": "[B] float32, metres",
    "f_number": "[B] float32, focal length over aperture diameter",
    "near_m": "[B] float32, metres at which the nearest pixel is put",
    "far_m": "[B] float32, metres at which the farthest pixel is put",
}


def label(model: onnx.ModelProto, dof: DepthOfField, portable: Portable, channels: int, opset: int) -> None:
    """Write producer and metadata into a model."""
    model.producer_name, model.producer_version = "torchdof", _version()
    model.doc_string = "Depth of field: an all-in-focus image and its depth in, the photograph of a real lens out."
    model.graph.name = "depth_of_field"
    options = {k: v for k, v in dof.options.arguments().items() if k not in ("table", "check", "depth_edges")}
    facts: dict[str, Any] = {
        "version": _version(),
        "inputs": {v.name: UNITS[v.name].format(channels=channels) for v in model.graph.input},
        "output": {OUTPUT: UNITS["image"].format(channels=channels)},
        "camera": {k: getattr(dof.camera, k) for k in Camera.__dataclass_fields__},
        "table": {"name": dof.options.table.name, "family": dof.options.table.family, "unit": dof.options.table.unit}
        | {"sha256": table_hash(dof.options.table)},
        "options": options,
        "width": portable.width,
        "layers": len(portable.plan.nodes),
        "opset": opset,
    }
    write_facts(model, facts)


def write_facts(model: onnx.ModelProto, facts: dict[str, Any]) -> None:
    """Replace a model's metadata."""
    del model.metadata_props[:]
    for key, value in facts.items():
        model.metadata_props.add(key=PREFIX + key, value=json.dumps(value))


def describe(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What a file written by :func:`to_onnx` or :func:`chain` says about itself.

    Args:
        path: The file.

    Returns:
        ``version``, ``inputs`` and ``output`` (name to shape, type and unit), ``camera`` (its focus and f-number are
        those of the module; the graph takes them as inputs), ``table`` (name, family, unit and SHA-256 of its JSON),
        ``options``, ``width`` (that a table was pinned to, or None), ``layers`` and ``opset``.

    Raises:
        ValueError: If it is not such a file.
        FileNotFoundError: If there is no file.
    """
    return facts_of(load(path), str(path))


def load(path: str | os.PathLike[str]) -> onnx.ModelProto:
    """Read an ONNX file.

    Raises:
        ValueError: If it is not one.
        FileNotFoundError: If there is none.
    """
    if not os.path.isfile(path):
        raise FileNotFoundError(f"there is no file {path}")
    try:
        model = onnx.load(path)
    except Exception as error:  # protobuf has several ways to fail on bytes that are none
        raise ValueError(f"{path} is not an ONNX file: {error}") from error
    if not model.graph.output:
        raise ValueError(f"{path} is not an ONNX file: it has no outputs")
    return model


def facts_of(model: onnx.ModelProto, name: str) -> dict[str, Any]:
    """The metadata of a model that has been read."""
    facts = {p.key.removeprefix(PREFIX): p.value for p in model.metadata_props if p.key.startswith(PREFIX)}
    if "options" not in facts:
        raise ValueError(f"{name} was not written by torchdof.export: it lacks the metadata {PREFIX}options")
    return {key: json.loads(value) for key, value in facts.items()}


def table_hash(table: BlurTable) -> str:
    """SHA-256 of a table's content."""
    return hashlib.sha256(json.dumps(table.to_dict(), sort_keys=True).encode()).hexdigest()


def _version() -> str:
    try:
        return version("torchdof")
    except PackageNotFoundError:
        return "unknown"
