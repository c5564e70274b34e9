"""Metadata of a file: producer, units of its inputs, camera, table, options."""

import hashlib
import json
import os
from importlib.metadata import version
from typing import Any

import onnx

from torchdof import DepthOfField
from torchdof.io.memory import free_bytes
from torchdof.optics.camera import Camera

from .graph import OUTPUT, Portable

__all__ = ["UNITS", "describe", "facts_of", "label", "load", "settings", "shown", "write_facts"]

PREFIX = "torchdof."
_MAX_CHARACTERS, _MAX_VALUES = 2**16, 100  # limits: characters of one value, number of values
_MAX_PRINTED = 300  # characters of a text that are printed
_MEMORY_PER_BYTE = 3  # memory needed to read a file, in file sizes
UNITS = {
    "image": "[B, {channels}, H, W] float32, linear light, >= 0, any range",
    "depth": "[B, 1, H, W] float32, metres along the optical axis, inf allowed; NaN, zero and negative pass sharp",
    "coc_px": "[B, 1, H, W] float32, radius in pixels, negative in front of the focus plane; NaN passes sharp",
    "matte": "[B, 1, H, W] float32, coverage by a subject in [0, 1]; 0 everywhere changes nothing",
    "focus_m": "[B] float32, metres, inf allowed; NaN, and where the lens cannot focus, give NaN in their item",
    "f_number": "[B] float32, focal length over aperture diameter; NaN, inf, zero and negative give NaN in their item",
    "near_m": "[B] float32, metres at which the nearest pixel is put",
    "far_m": "[B] float32, metres at which the farthest pixel is put",
}


def label(model: onnx.ModelProto, dof: DepthOfField, portable: Portable, channels: int, opset: int) -> None:
    """Writes producer and metadata into a model."""
    model.producer_name, model.producer_version = "torchdof", version("torchdof")
    model.doc_string = "Depth of field: an all-in-focus image and its depth in, the photograph of a real lens out."
    model.graph.name = "depth_of_field"
    facts: dict[str, Any] = {
        "version": model.producer_version,
        "inputs": {v.name: UNITS[v.name].format(channels=channels) for v in model.graph.input},
        "output": {OUTPUT: UNITS["image"].format(channels=channels)},
        **settings(dof),
        "depth_edges": portable.dof.options.depth_edges,
        "width": portable.width,
        "layout": portable.layout,
        "size": portable.size,
        "layers": len(portable.plan.nodes),
        "opset": opset,
    }
    write_facts(model, facts)


def settings(dof: DepthOfField) -> dict[str, dict[str, Any]]:
    """Camera, table and options of a module, of those that are fixed in a file."""
    table, options = dof.options.table, dof.options.arguments()
    hashed = hashlib.sha256(json.dumps(table.to_dict(), sort_keys=True).encode()).hexdigest()
    return {
        "camera": {name: getattr(dof.camera, name) for name in Camera.__dataclass_fields__},
        "table": {"name": table.name, "family": table.family, "unit": table.unit, "sha256": hashed},
        "options": {name: v for name, v in options.items() if name not in ("table", "check", "depth_edges")},
    }


def write_facts(model: onnx.ModelProto, facts: dict[str, Any]) -> None:
    """Replaces a model's metadata."""
    del model.metadata_props[:]
    for key, value in facts.items():
        model.metadata_props.add(key=PREFIX + key, value=json.dumps(value))


def describe(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Reads the metadata of a file written by :func:`to_onnx` or :func:`chain`.

    Args:
        path: The file.

    Returns:
        ``version``, ``inputs`` and ``output`` (name to shape, type and unit), ``camera`` (the module's; its focus and
        f-number are inputs of the graph), ``table`` (name, family, unit and SHA-256 of its JSON), ``options``,
        ``depth_edges``, ``width`` (of a table with lengths, or None), ``layout``, ``size`` (height and width of the
        only frame, or None), ``layers`` and ``opset``.

    Raises:
        ValueError: If the file was not written by them.
        FileNotFoundError: If the file is missing.
    """
    return facts_of(load(path, external=False), str(path))


def load(path: str | os.PathLike[str], external: bool = True) -> onnx.ModelProto:
    """Reads an ONNX file, which must not be larger than the memory.

    ``external`` reads tensors stored in other files too; in untrusted files these may be any files.
    """
    if not os.path.isfile(path):
        raise FileNotFoundError(f"there is no file {path}")
    size = os.path.getsize(path)
    if _MEMORY_PER_BYTE * size > free_bytes():
        raise ValueError(f"{path} takes {size / 2**30:.3g} GiB, more than there is memory for")
    try:
        model = onnx.load(path, load_external_data=external)
    except Exception as error:  # protobuf raises several types for invalid bytes
        raise ValueError(f"{path} is not an ONNX file: {shown(str(error))}") from error
    if not model.graph.output:
        raise ValueError(f"{path} is not an ONNX file: it has no outputs")
    return model


def facts_of(model: onnx.ModelProto, name: str) -> dict[str, Any]:
    """The metadata of a loaded model that an export has written; ``name`` is used in messages."""
    facts: dict[str, Any] = {}
    for entry in model.metadata_props:
        key, value = entry.key, entry.value
        if not isinstance(key, str) or not isinstance(value, str):  # other bytes are not decoded
            raise ValueError(f"{name}: its metadata have bytes that are not text")
        if not key.startswith(PREFIX):
            continue
        if len(value) > _MAX_CHARACTERS or len(facts) == _MAX_VALUES:
            raise ValueError(f"{name}: its metadata {shown(key)} are more than torchdof.export writes")
        try:
            facts[key.removeprefix(PREFIX)] = json.loads(value)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{name}: its metadata {shown(key)} are not JSON: {shown(str(error))}") from None
    if "options" not in facts:
        raise ValueError(f"{name} was not written by torchdof.export: it lacks the metadata {PREFIX}options")
    return facts


def shown(text: str) -> str:
    """Untrusted text on one line: control characters escaped, and cut if it is long."""
    line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text[:_MAX_PRINTED])
    return line if len(text) <= _MAX_PRINTED else f"{line}... ({len(text)} characters)"
