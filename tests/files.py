"""Pictures written with OpenImageIO alone, small ONNX files, and rights to write."""

import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import OpenImageIO as oiio


def spec_with(
    array: np.ndarray, sample: str, names: tuple[str, ...] | None = None, **attributes: Any
) -> oiio.ImageSpec:
    """A specification of a picture; `__` in the name of an attribute stands for `:`."""
    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], sample)
    if names is not None:
        spec.channelnames = names
        spec.alpha_channel = names.index("A") if "A" in names else -1
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    return spec


def store(path: Path, array: np.ndarray, sample: str, names: tuple[str, ...] | None = None, **attributes: Any) -> Path:
    """Writes stored numbers with OpenImageIO alone."""
    array = np.atleast_3d(array)
    return store_parts(path, [(spec_with(array, sample, names, **attributes), array)])


def store_parts(path: Path, parts: list[tuple[oiio.ImageSpec, np.ndarray]]) -> Path:
    """Writes the parts of an EXR, or one picture of any type."""
    output, specs = oiio.ImageOutput.create(str(path)), tuple(spec for spec, _ in parts)
    assert output is not None and output.open(str(path), specs if len(parts) > 1 else specs[0])
    for number, (spec, array) in enumerate(parts):
        assert not number or output.open(str(path), spec, "AppendSubimage")
        assert output.write_image(np.ascontiguousarray(array)), output.geterror()
    assert output.close()
    return path


def store_model(path: Path, facts: dict[str, str], external: str | None = None) -> None:
    """Writes an ONNX file with metadata and optionally a tensor stored in another file."""
    node = onnx.helper.make_node("Identity", ["image"], ["out"])
    values = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]) for name in ("image", "out")]
    graph = onnx.helper.make_graph([node], "g", values[:1], values[1:])
    if external is not None:
        tensor = graph.initializer.add(name="w", data_type=onnx.TensorProto.FLOAT, dims=[1])
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=external)
    model = onnx.helper.make_model(graph)
    for key, value in {"torchdof.options": "{}", **facts}.items():
        model.metadata_props.add(key=key, value=value)
    onnx.save_model(model, path)


def as_an_ordinary_user(path: str | os.PathLike[str], mode: int) -> bool:
    """In place of :func:`os.access`: whether a user without special rights may write, since root may everything."""
    assert mode == os.W_OK
    return bool(os.stat(path).st_mode & stat.S_IWUSR)
