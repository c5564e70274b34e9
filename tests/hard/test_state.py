"""A call leaves the state of the process as it was: after a result, after an error, and after Ctrl-C in the middle."""

import contextlib
import inspect
import locale
import logging
import os
import random
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchdof.fit
from tests.kernels import kernel_of
from torchdof import BlurTable, Camera, DepthOfField, blur_by_coc
from torchdof.augmentation import RandomDepthOfField
from torchdof.cli.main import app
from torchdof.depth import from_relative, repair_edges
from torchdof.distributed import Pair, RenderShards, shard_rows
from torchdof.fit import fit_pair, fit_profile
from torchdof.functional import splat
from torchdof.io.images import Picture, read_image, write_image

pytestmark = pytest.mark.hard

PACKAGES = tuple(str(Path(str(package.__file__)).parent) for package in (torchdof, torchdof.fit))
ERRORS = (KeyboardInterrupt, RuntimeError, OSError, ValueError, SystemExit)
STOPS = 6  # places at which a call is interrupted
COC = torch.linspace(-9.0, 9.0, 40).expand(1, 1, 30, 40)
DEPTH = 2.0 + COC / 9.0
DOF = DepthOfField(Camera(focus_m=2.0, sensor_width_mm=6.0))


def differentiated(render: Callable[[Tensor, Tensor], Tensor], map_: Tensor) -> list[Tensor]:
    """The picture and its gradients by image and map."""
    image = torch.rand(1, 3, 30, 40, generator=torch.Generator().manual_seed(3)).float() ** 6
    inputs = [image.requires_grad_(), map_.clone().requires_grad_()]
    out = render(*inputs)
    return [out, *torch.autograd.grad(out.square().sum(), inputs)]


def augmented() -> Tensor:
    blur = RandomDepthOfField(camera=Camera(sensor_width_mm=6.0), p=1.0)
    known = {"batch_prob": torch.ones(1), "forward_input_shape": torch.tensor([1, 3, 30, 40])}
    params = blur.draw(torch.Generator().manual_seed(1)) | known
    return torch.as_tensor(blur(COC.new_full((1, 3, 30, 40), 0.5), DEPTH, params))


def files() -> Tensor:
    write_image("a.png", Picture(COC.new_full((1, 3, 30, 40), 0.5)))
    np.save("a.npy", DEPTH[0, 0].numpy())
    return read_image("a.png").pixels


def shards() -> None:
    files()
    for path in Path().glob("shard-*"):
        path.unlink()
    (row,) = shard_rows([Pair("a.png", "a.npy")])
    RenderShards(".")({name: np.array([value]) for name, value in row.items()})


def commanded(*options: str) -> Tensor:
    files()
    app(["render", "a.png", "a.npy", "-o", "out.png", "--focus-m", "2", *options], standalone_mode=False)
    return read_image("out.png").pixels


def fitted() -> None:
    dot = torch.zeros(1, 1, 31, 31)
    dot[..., 13:18, 13:18] = 1.0
    blurred = torch.nn.functional.conv2d(dot, kernel_of("gaussian", 2.0, size=15).to(dot)[None, None], padding=7)
    fit_pair(dot[0, 0].numpy(), blurred[0, 0].numpy(), "gaussian")
    r = np.linspace(0.0, 5.0, 40)
    fit_profile(r, np.exp(-((r - 1) ** 2)), family="ring")


CALLS: dict[str, Callable[[], Any]] = {
    "blur_by_coc": lambda: differentiated(blur_by_coc, COC),
    "DepthOfField": lambda: differentiated(DOF, DEPTH),
    "fold": lambda: differentiated(lambda image, coc: blur_by_coc(image, coc, method="fold"), COC / 4),
    "field": lambda: blur_by_coc(COC.new_ones(1, 1, 30, 40), COC, table=BlurTable.polygon(5, vignetting=0.4)),
    "layers": lambda: DOF.layers(COC.new_full((1, 2, 4, 30, 40), 0.5), COC.new_tensor([1.0, 3.0])),
    "repair_edges": lambda: repair_edges(COC.new_ones(1, 3, 30, 40), from_relative(COC, 1.0, 3.0)),
    "splat": lambda: differentiated(splat, COC),
    "augmentation": augmented,
    "files": files,
    "shards": shards,
    "render": commanded,
    "render, a strange unit": lambda: commanded("--depth-kind", "z", "--depth-scale", "0.001"),
    "fit": fitted,
}


def state() -> dict[str, Any]:
    generators = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # type: ignore[index]  # noqa: NPY002
    return {
        "generators": generators,
        "gradients": (torch.is_grad_enabled(), torch.is_inference_mode_enabled(), torch.is_anomaly_enabled()),
        "autocast": (torch.is_autocast_enabled("cpu"), torch.get_autocast_dtype("cpu")),
        "threads": (torch.get_num_threads(), torch.get_num_interop_threads()),
        "defaults": (torch.get_default_dtype(), torch.get_default_device(), torch.get_float32_matmul_precision()),
        "deterministic": torch.get_deterministic_debug_mode(),
        "warnings": (list(warnings.filters), warnings.showwarning, np.geterr()),
        "process": (Path.cwd(), dict(os.environ), locale.setlocale(locale.LC_ALL), sys.getrecursionlimit()),
        "streams": (sys.stdin, sys.stdout, sys.stderr, logging.root.level, logging.root.handlers[:]),
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)],
    }


@contextlib.contextmanager
def entries(stop: int, error: BaseException | None) -> Iterator[list[str]]:
    """Lists the functions of the package that are entered, and raises ``error`` in the one with number ``stop``.

    Generators are not listed: ``finally`` blocks resume them, and Ctrl-C in this block leaves its work incomplete.
    """
    names: list[str] = []

    def enter(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGES) and not code.co_flags & inspect.CO_GENERATOR:
            names.append(code.co_name)
            if len(names) == stop and error is not None:
                raise error

    sys.setprofile(enter)
    try:
        yield names
    finally:
        sys.setprofile(None)


@pytest.fixture(autouse=True)
def _unusual_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Starts from unusual values, so that a call that restores the usual ones instead fails its test."""
    monkeypatch.chdir(tmp_path)
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    torch.set_default_dtype(torch.float64)
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.set_default_dtype(torch.float32)
        torch.use_deterministic_algorithms(False)


@pytest.mark.filterwarnings("ignore::torchdof.fit.FitWarning")
@pytest.mark.parametrize("name", CALLS)
def test_a_call_leaves_the_state_of_the_process_as_it_was(name: str, engine: str) -> None:
    """Compares the state after a result, and after errors and Ctrl-C at some places in the package's functions."""
    call = CALLS[name]
    with entries(0, None) as names:
        first = call()  # imports packages, which may have state of their own
    before = state()
    again = call()
    assert state() == before
    if isinstance(first, list | Tensor):
        torch.testing.assert_close(again, first, rtol=0.0, atol=0.0)
    count = len(names)
    for i in range(STOPS):
        error = RuntimeError("a test") if i % 2 else KeyboardInterrupt()
        with contextlib.suppress(*ERRORS), entries(1 + (2 * i + 1) * count // (2 * STOPS), error) as names:
            call()
        assert state() == before, f"{error!r} in {names[-1]}"
    if isinstance(first, list | Tensor):
        torch.testing.assert_close(call(), first, rtol=0.0, atol=0.0)
