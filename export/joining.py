"""Joins a depth estimator and a module, with the conversions between them, in one graph."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import onnx
import onnx.compose
import onnx.inliner
import onnx.version_converter

from torchdof.io.atomic import atomic_file
from torchdof.validation import choice

from . import bridge
from .graph import INPUTS, OUTPUT
from .metadata import UNITS, facts_of, load, write_facts
from .verification import TOLERANCE, check_format, session

__all__ = ["chain"]

Estimate = Literal["metric", "inverse", "relative-inverse"]
Model = str | os.PathLike[str] | onnx.ModelProto
_RESULTS = ("encoded", "estimate", "depth", OUTPUT)  # of the parts in turn; the estimator's input is the first one


def chain(
    depth_model: Model,
    dof_model: Model,
    path: str | os.PathLike[str],
    *,
    estimate: Estimate,
    scale: float = 1.0,
    shift: float = 0.0,
    size: tuple[int, int] | None = None,
    mean: Sequence[float] = (0.0, 0.0, 0.0),
    std: Sequence[float] = (1.0, 1.0, 1.0),
) -> None:
    """Joins a depth estimator's ONNX file and a file of :func:`to_onnx`: the result renders from an image alone.

    The joint graph takes ``image [B, 3, H, W]`` in linear light, ``focus_m [B]`` and ``f_number [B]``, and returns
    ``out`` and the estimated ``depth [B, 1, H, W]`` in metres. The estimator's input is the image clipped to [0, 1] and
    encoded as sRGB, then ``(x - mean) / std``, resized to the estimator's size.

    Args:
        depth_model: The estimator, a file or a loaded model, with one float32 input ``[B, 3, h, w]`` and one output
            ``[B, h, w]`` or ``[B, 1, h, w]``.
        dof_model: A file written by :func:`to_onnx`, or the loaded model; its input must be depth.
        path: The file to write. It is verified against its parts run one after another, and moved into place.
        estimate: Meaning of the estimator's output. ``"metric"``: depth, in units of ``1 / scale`` metres.
            ``"inverse"``: inverse depth, ``1 / z = scale * estimate + shift``; at infinity where that is not positive.
            ``"relative-inverse"``: inverse depth up to an unknown scale and shift (as MiDaS and Depth Anything give).
            The graph then has two more inputs, ``near_m [B]`` and ``far_m [B]``, the depths of the nearest and the
            farthest pixel.
        scale: See ``estimate``.
        shift: See ``estimate``.
        size: Input size ``(h, w)`` of the estimator; None uses the size that it declares or, if that is free, the
            image's size.
        mean: Subtracted from the estimator's display-encoded input, for each channel.
        std: Divisor of the result, for each channel.

    Raises:
        ValueError: If the models do not fit together, or the joint graph is invalid or differs from its parts.
        FileNotFoundError: If a file is missing.
    """
    choice("estimate", estimate, get_args(Estimate))
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: there is no folder {path.parent}")
    dof = dof_model if isinstance(dof_model, onnx.ModelProto) else load(dof_model)
    facts = facts_of(dof, "dof_model")
    if set(facts["inputs"]) != set(INPUTS["depth"]) or dof.graph.input[0].type.tensor_type.shape.dim[1].dim_value != 3:
        raise ValueError(f"dof_model must take a depth and an image of 3 channels, it takes {facts['inputs']}")
    if facts["size"] is not None:
        raise ValueError(f"dof_model takes only frames of {facts['size']}; export it without a size")
    estimator, declared_size = _prepare(depth_model, _opset(dof))
    size = size or declared_size
    parts = [bridge.encode(size, mean, std), estimator, bridge.decode(estimate, scale, shift), dof]
    joint = _join(parts)
    facts["inputs"] = {value.name: UNITS[value.name].format(channels=3) for value in joint.graph.input}
    facts["output"]["depth"] = UNITS["depth"]
    facts["chain"] = {"estimate": estimate, "scale": scale, "shift": shift, "size": size}
    facts["chain"] |= {"mean": list(mean), "std": list(std)}
    write_facts(joint, facts)
    with atomic_file(path) as temporary:
        onnx.save_model(joint, temporary, format="protobuf")
        check_format(joint, str(temporary))
        _compare(joint, str(temporary), parts, size or (42, 56))


def _prepare(depth_model: Model, opset: int) -> tuple[onnx.ModelProto, tuple[int, int] | None]:
    """The estimator in the module's version of ONNX, and the input size it declares."""
    model = depth_model if isinstance(depth_model, onnx.ModelProto) else load(depth_model)
    weights = {tensor.name for tensor in model.graph.initializer}
    inputs = [value for value in model.graph.input if value.name not in weights]
    if len(inputs) != 1 or len(model.graph.output) != 1:
        raise ValueError(
            f"depth_model must have one input and one output, it has {[v.name for v in inputs]} and "
            f"{[v.name for v in model.graph.output]}; cut it down with onnx.utils.extract_model"
        )
    if _opset(model) > opset:
        raise ValueError(
            f"depth_model uses opset {_opset(model)}, dof_model {opset}: export that with opset={_opset(model)}"
        )
    shape = [d.dim_value for d in inputs[0].type.tensor_type.shape.dim]
    rank = len(model.graph.output[0].type.tensor_type.shape.dim)
    if len(shape) != 4 or shape[1] not in (0, 3) or rank not in (3, 4):
        raise ValueError(
            f"depth_model must map [B, 3, h, w] to [B, h, w] or [B, 1, h, w], it takes {shape} and gives rank {rank}"
        )
    if _opset(model) < opset:
        model = onnx.version_converter.convert_version(model, opset)
    return model, (shape[2], shape[3]) if shape[2] and shape[3] else None


def _join(parts: Sequence[onnx.ModelProto]) -> onnx.ModelProto:
    """Encoding, estimator, decoding and module as one graph; the names in each part get its result as a prefix."""
    nodes: list[Any] = []
    initializers: list[Any] = []
    inputs: dict[str, Any] = {}
    outputs: dict[str, Any] = {}
    for result, part in zip(_RESULTS, parts, strict=True):
        graph = onnx.compose.add_prefix(onnx.inliner.inline_local_functions(part), f"{result}/").graph
        weights = {tensor.name for tensor in graph.initializer}
        for value in (value for value in graph.input if value.name not in weights):
            source = "encoded" if result == "estimate" else value.name.removeprefix(f"{result}/")
            nodes.append(onnx.helper.make_node("Identity", [source], [value.name]))
            if source not in _RESULTS:
                inputs.setdefault(source, value)
        nodes += [*graph.node, onnx.helper.make_node("Identity", [graph.output[0].name], [result])]
        initializers += graph.initializer
        outputs[result] = graph.output[0]
    interface = {name: outputs[name] for name in (OUTPUT, "depth")}
    for name, value in (*inputs.items(), *interface.items()):
        value.name = name
    ends = [*inputs.values()], [*interface.values()]
    joint = onnx.helper.make_graph(nodes, "estimated_depth_of_field", *ends, initializers)
    dof = parts[-1]
    return onnx.helper.make_model(
        joint,
        opset_imports=[onnx.helper.make_opsetid("", _opset(dof))],
        ir_version=dof.ir_version,
        producer_name=dof.producer_name,
        producer_version=dof.producer_version,
    )


def _compare(joint: onnx.ModelProto, path: str, parts: Sequence[onnx.ModelProto], size: tuple[int, int]) -> None:
    """Compares the joint graph with its parts run in turn, on noise of another size than the estimator's."""
    frame = (size[0] + 14, 2 * size[1] - 28)
    values = {"image": np.random.default_rng(4).random((1, 3, *frame), dtype=np.float32)}
    for name, number in (("focus_m", 1.5), ("f_number", 4.0), ("near_m", 0.7), ("far_m", 30.0)):
        values[name] = np.full(1, number, dtype=np.float32)
    names = (OUTPUT, "depth")
    results = session(path).run([*names], {value.name: values[value.name] for value in joint.graph.input})
    for result, part in zip(_RESULTS, parts, strict=True):
        run = session(part.SerializeToString())
        sources = {v.name: "encoded" if result == "estimate" else v.name for v in run.get_inputs()}
        values[result] = run.run(None, {name: values[source] for name, source in sources.items()})[0]
    for name, got in zip(names, results, strict=True):
        expected = values[name]
        error = float(np.nanmax(np.abs(got - expected) / np.maximum(np.abs(expected), 1.0)))
        if got.shape != expected.shape or not error <= TOLERANCE:
            raise ValueError(f"the joint graph differs from its parts run in turn: {name} by {error:g}")


def _opset(model: onnx.ModelProto) -> int:
    return next(entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx"))
