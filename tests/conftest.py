import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, settings

from tests import exported, on_cpu
from torchdof import native
from torchdof.kernels import edges, layers, loader, matting, rays
from torchdof.render.engines import on_gpu
from torchdof.tensors import TRACEABLE

settings.register_profile("local", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", parent=settings.get_profile("local"), derandomize=True, print_blob=True)
settings.register_profile("many", parent=settings.get_profile("local"), max_examples=5000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE") or ("ci" if os.environ.get("CI") else "local"))


if "PYTEST_XDIST_WORKER" in os.environ:  # one core for each worker and its subprocesses
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)


# Folders and files with long tests. They start first: a worker without tests then takes short ones from the other.
LONG = ("tests/export/", "tests/fit/")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sorts long tests to the front, so that no worker waits for one at the end of a run."""
    items.sort(key=lambda item: [not item.nodeid.startswith(name) for name in LONG])


@pytest.fixture(autouse=True)
def _same_random_numbers() -> None:
    torch.manual_seed(0)


@pytest.fixture(params=["torch", "native"])
def engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The engine that renders: a test that asks for it runs with each."""
    monkeypatch.delenv("TORCHDOF_ENGINE", raising=False)
    if request.param == "native" and not native.chosen():
        pytest.skip("the compiled engine is not built")
    monkeypatch.setenv("TORCHDOF_ENGINE", request.param)
    return str(request.param)


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the kernels that were launched; tensors on the CPU are rendered as those on a GPU are."""
    if on_cpu.COMPILER is None:
        pytest.skip("there is no C++ compiler")
    names: list[str] = []

    def recording(module: Callable[..., loader.Launch]) -> Callable[..., loader.Launch]:
        def with_record(*variant: Any) -> loader.Launch:
            launch = module(*variant)

            def recorded(kernel: str, *arguments: Any) -> None:
                names.append(kernel)
                launch(kernel, *arguments)

            return recorded

        return with_record

    monkeypatch.setattr(on_gpu, "DEVICE", "cpu")
    monkeypatch.setattr(layers, "module", recording(on_cpu.layers_module))
    monkeypatch.setattr(matting, "module", recording(on_cpu.matting_module))
    monkeypatch.setattr(edges, "module", recording(on_cpu.edges_module))
    monkeypatch.setattr(rays, "module", recording(on_cpu.rays_module))
    monkeypatch.setenv("TORCHDOF_ENGINE", "gpu")
    for cached in (on_gpu.why_missing, on_gpu._warn):
        cached.cache_clear()
    yield names
    for cached in (on_gpu.why_missing, on_gpu._warn):
        cached.cache_clear()


@pytest.fixture(scope="session")
def simulator() -> ModuleType:
    """The module `tests/fit/simulator.py`: a simulated camera that photographs dots."""
    return importlib.import_module("tests.fit.simulator")


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder shared by all workers of this run."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def _exporter() -> None:
    if not TRACEABLE:
        pytest.skip("needs PyTorch 2.13 to export")


def _exported(name: str) -> Any:
    """A fixture: a module of :data:`tests.exported.MODULES` and its file."""

    @pytest.fixture(scope="session", name=name.replace(" ", "_"))
    def fixture(shared_folder: Path, _exporter: None) -> Any:
        return exported.export_once(name, shared_folder)

    return fixture


layered, whole, plain, fold, fold_with_occlusion = map(_exported, exported.MODULES)


@pytest.fixture(scope="session")
def exported_by_command(shared_folder: Path, _exporter: None) -> tuple[Path, str]:
    """A file with blur radii as input, written by ``torchdof export``, and the output of the command."""
    return exported.command_once(shared_folder)
