"""Compares a file with its module: names, types, shapes, values and time."""

import dataclasses
import os
import time
from collections.abc import Callable, Iterator

import numpy as np
import onnx
import onnxruntime
import torch
import torch.nn.functional as functional
from torch import Tensor

from torchdof import DepthOfField
from torchdof.reference import metrics

from .cases import Case, cases
from .graph import INPUTS, ITEMS, LENS, OUTPUT, Portable
from .metadata import facts_of, load, settings

__all__ = ["TOLERANCE", "CaseComparison", "Verification", "check_format", "session", "verify"]

TOLERANCE = 1e-5
"""Accepted difference from eager PyTorch, relative to the largest light within a kernel's reach."""


@dataclasses.dataclass(frozen=True)
class CaseComparison:
    """Result of one case.

    Args:
        name: Short description.
        shape: Shape of the image, ``[B, C, H, W]``.
        max_error: Largest difference, relative to the local range of light, also from each item rendered alone.
        mean_error: Mean difference.
        called_db: PSNR in dB of the file against a normal call of the module, with layers chosen for the scene, its own
            highlights and edge repair; display-encoded, infinite if both are equal.
        torch_s: Seconds in eager PyTorch.
        onnxruntime_s: Seconds in onnxruntime.
    """

    name: str
    shape: tuple[int, ...]
    max_error: float
    mean_error: float
    called_db: float
    torch_s: float
    onnxruntime_s: float


@dataclasses.dataclass(frozen=True)
class Verification:
    """Result of comparing a file with its module; ``str`` is a table.

    Args:
        title: Description of the file.
        cases: One row for each call.
        bytes: Size of the file.
    """

    title: str
    cases: tuple[CaseComparison, ...]
    bytes: int

    @property
    def max_error(self) -> float:
        """Largest difference over all cases, relative to the local range."""
        return max(row.max_error for row in self.cases)

    @property
    def passed(self) -> bool:
        """Whether every case is within :data:`TOLERANCE`."""
        return all(row.max_error <= TOLERANCE for row in self.cases)

    def __str__(self) -> str:
        lines = [
            f"{self.title}: {self.bytes / 1000:.0f} kB, "
            f"{'verified' if self.passed else 'DIFFERS'} (largest error {self.max_error:.1e} of the local range)",
            f"{'case':27} {'B x C x H x W':>17} {'max error':>9} {'mean':>9} {'as called dB':>12} "
            f"{'torch ms':>8} {'onnx ms':>8}",
        ]
        for row in self.cases:
            shape = " x ".join(map(str, row.shape))
            lines.append(
                f"{row.name:27} {shape:>17} {row.max_error:9.1e} {row.mean_error:9.1e} {row.called_db:12.1f} "
                f"{1000 * row.torch_s:8.1f} {1000 * row.onnxruntime_s:8.1f}"
            )
        return "\n".join(lines)


def verify(
    path: str | os.PathLike[str],
    dof: DepthOfField,
    *,
    progress: Callable[[str], object] = lambda _: None,
) -> Verification:
    """Compares a file with the module from which it was made.

    Checks that the file passes ``onnx.checker`` in full and strict shape inference, uses standard operators only and
    contains its weights; that its inputs and output have the names, types and free sizes described at :func:`to_onnx`;
    and that onnxruntime gives the result of eager PyTorch (with the same layers and ``check=False``) within 1e-5 of the
    largest light in the reach of a kernel, for sizes, batches, focus distances and scenes other than the traced ones.
    Items of a batch are compared with those that the module renders alone too. The report also has the difference from
    a normal call of the module.

    Args:
        path: The file.
        dof: The module.
        progress: Called with the name of each case.

    Returns:
        The comparison, case by case.

    Raises:
        ValueError: If the file is invalid, was made from another module, or gives another result; the message contains
        the table.
        FileNotFoundError: If the file is missing.
    """
    model = load(path, external=False)
    facts = facts_of(model, str(path))
    inputs = next((kind for kind, names in INPUTS.items() if set(names) == set(facts["inputs"])), "depth")
    size = None if facts["size"] is None else tuple(facts["size"])
    portable = Portable(dof, inputs, facts["width"], facts["depth_edges"], facts["layout"], size)
    check_format(model, os.fspath(path))
    _check_origin(facts, dof)
    channels = _check_interface(model, portable)
    runner = session(path)
    rows = []
    for case in cases(portable, channels):
        progress(f"verifying: {case.name}")
        rows.append(_compare(runner, portable, case))
    options = facts["options"]
    title = f"{facts['table']['name'] or 'unnamed'} ({facts['table']['family']}), {options['method']}"
    title += f", {facts['layers']} layers up to {options['max_coc_px']:g} px"
    report = Verification(title, tuple(rows), os.path.getsize(path))
    if not report.passed:
        raise ValueError(f"{path} differs from the module by more than {TOLERANCE:g} of the local range\n{report}")
    return report


def session(path: str | os.PathLike[str] | bytes) -> onnxruntime.InferenceSession:
    """An onnxruntime session of a file, or of its bytes, on the CPU with as many threads as PyTorch uses."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(os.fspath(path), options, providers=["CPUExecutionProvider"])


def local_range(image: Tensor, reach: int) -> Tensor:
    """Largest light of all channels within ``reach`` pixels of each pixel, ``[B, 1, H, W]``."""
    largest = functional.pad(image.abs().amax(1, keepdim=True), (reach,) * 4)
    largest = functional.max_pool2d(largest, (2 * reach + 1, 1), stride=1)
    return functional.max_pool2d(largest, (1, 2 * reach + 1), stride=1)


def _compare(runner: onnxruntime.InferenceSession, portable: Portable, case: Case) -> CaseComparison:
    """Runs one case in eager PyTorch and in onnxruntime; returns errors and times."""
    start = time.perf_counter()
    with torch.no_grad():
        expected = portable(*case.tensors)
    between = time.perf_counter()
    feed = {name: t.numpy() for name, t in zip(INPUTS[portable.inputs], case.tensors, strict=True)}
    got = runner.run([OUTPUT], feed)[0]
    end = time.perf_counter()
    if got.dtype != np.float32 or got.shape != tuple(expected.shape):
        raise ValueError(f"{case.name}: expected float32 {list(expected.shape)}, got {got.dtype} {list(got.shape)}")
    # coarse layers average light over their pixels before blurring it
    options, size = portable.dof.options, (int(expected.shape[2]), int(expected.shape[3]))
    how = (torch.float32, torch.device("cpu"), options.method == "layered", portable.width)
    kernels = portable.plan.layer_kernels(options.table, size, *how)
    reach = max(kernel.halo + kernel.scale - 1 for kernel in kernels)
    light_range = local_range(case.tensors[0], min(reach, max(expected.shape[-2:])))
    error = (torch.from_numpy(got) - expected).abs()
    with torch.no_grad():  # each item of a batch must be rendered as it is alone
        items = list(zip(*(t.split(1) for t in case.tensors), strict=True))
        alone = torch.cat([portable(*item) for item in items]) if len(items) > 1 else expected
    error = torch.maximum(error, (torch.from_numpy(got) - alone).abs())
    error = error / light_range.clamp_min(torch.finfo(torch.float32).tiny)
    error = torch.where(torch.isfinite(error), error, torch.inf)
    with torch.no_grad():
        called = metrics.display(portable.as_called(*case.tensors).nan_to_num(0.0))
    called_db = metrics.psnr(metrics.display(torch.from_numpy(got).nan_to_num(0.0)), called)
    errors = float(error.max()), float(error.mean()), called_db
    return CaseComparison(case.name, tuple(got.shape), *errors, between - start, end - between)


def check_format(model: onnx.ModelProto, path: str) -> None:
    """Refuses a file that is invalid, needs non-standard operators, or keeps weights elsewhere.

    ``model`` is the file as loaded without weights from elsewhere.
    """
    if any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in _tensors(model.graph)):
        raise ValueError(f"{path} keeps weights in another file")
    try:
        onnx.checker.check_model(path, full_check=True)
        onnx.shape_inference.infer_shapes(model, check_type=True, strict_mode=True, data_prop=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        raise ValueError(f"{path} is not valid ONNX: {error}") from error
    domains = sorted({entry.domain for entry in model.opset_import} - {"", "ai.onnx"})
    if domains:
        raise ValueError(f"{path} needs operators of {', '.join(domains)}; only standard ones are portable")


def _tensors(graph: onnx.GraphProto) -> Iterator[onnx.TensorProto]:
    """All tensors of a graph and its subgraphs."""
    yield from graph.initializer
    for attribute in (attribute for node in graph.node for attribute in node.attribute):
        if attribute.HasField("t"):
            yield attribute.t
        if attribute.HasField("g"):
            yield from _tensors(attribute.g)


def _check_origin(facts: dict, dof: DepthOfField) -> None:
    """Raises an error if a file was made from another table, options or camera than the module's."""
    for kind, own in settings(dof).items():
        for name, value in facts[kind].items():
            if own[name] != value and name not in ("focus_m", "f_number"):  # which are inputs of the graph
                raise ValueError(f"the file was made with {kind} {name}={value!r}, the module has {own[name]!r}")


def _check_interface(model: onnx.ModelProto, portable: Portable) -> int:
    """Checks names, types and sizes; returns the number of channels."""
    channels = model.graph.output[0].type.tensor_type.shape.dim[1].dim_value
    batch, items, frame = ("B", ITEMS, ("H", "W")) if portable.size is None else (1, 1, portable.size)
    single, colours = (items, 1, *frame), (batch, channels, *frame)
    inputs = INPUTS[portable.inputs]
    shapes = {"image": colours, **dict.fromkeys(LENS, (items,))}
    expected = [*((name, shapes.get(name, single)) for name in inputs), (OUTPUT, colours)]
    actual = []
    for value in (*model.graph.input, *model.graph.output):
        kind = value.type.tensor_type
        actual.append((value.name, tuple(d.dim_param or d.dim_value for d in kind.shape.dim)))
        if kind.elem_type != onnx.TensorProto.FLOAT:
            raise ValueError(f"{value.name} must be float32, got {onnx.TensorProto.DataType.Name(kind.elem_type)}")
    if actual != expected:
        raise ValueError(f"the graph must take and give {expected}, got {actual}")
    return int(channels)
