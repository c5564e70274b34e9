"""Checks the installed torchdof, outside the repository: ``python installed.py ENGINE``, native or torch."""

import os
import subprocess
import sys
import sysconfig
from importlib import resources
from pathlib import Path

import torch

from torchdof.kernels import loader

PICTURE = """
import sys, torch, torchdof
image = torch.rand(1, 3, 60, 90, generator=torch.Generator().manual_seed(0))
depth = torch.linspace(1.0, 6.0, 90).expand(1, 1, 60, 90)
camera = torchdof.Camera(focal_length_mm=50.0, f_number=1.4, focus_m=2.0, sensor_width_mm=4.0)
torch.save(torchdof.DepthOfField(camera)(image, depth) - image, sys.argv[1])
"""


def rendered(engine: str) -> torch.Tensor:
    """Difference of the picture of an engine and the image, computed in a new process."""
    path = Path(f"difference_{engine}.pt")
    environment = {**os.environ, "TORCHDOF_ENGINE": engine}
    subprocess.run([sys.executable, "-W", "error", "-c", PICTURE, str(path)], env=environment, check=True)
    difference = torch.load(path)
    path.unlink()
    return difference


def main(engine: str) -> None:
    """Checks the files, the command and a picture, and prints the version."""
    files = resources.files("torchdof")
    modules = ("py.typed", "fit/__init__.py", "export/__init__.py", "native/__init__.py", "native/api.h")
    for name in (*modules, *(f"kernels/{source}" for source in ("layers.cu", "matting.cu", *loader.HEADERS))):
        assert files.joinpath(name).is_file(), f"{name} is not installed"
    names = [str(path.relative_to(str(files))) for path in Path(str(files)).rglob("*")]
    for suffix in ("/sato_j15.json", "/double_gauss_50mm.txt"):
        assert any(name.endswith(suffix) for name in names), f"{suffix[1:]} is not installed"
    kept = {"native/api.h", *(f"kernels/{name}" for name in loader.HEADERS)}
    sources = {Path(name).as_posix() for name in names if name.endswith((".cpp", ".h", ".o"))} - kept
    assert not sources, f"sources are installed: {sources}"
    assert any(Path(name).stem == "_engine" for name in names) == (engine == "native")

    command = Path(sysconfig.get_path("scripts")) / "torchdof"
    version = subprocess.run([command, "--version"], capture_output=True, text=True, check=True).stdout
    print(version, end="")
    assert f"engine {engine} (" in version

    difference = rendered("auto")
    assert float(difference.abs().max()) > 0.01
    torch.testing.assert_close(difference, rendered("torch"), rtol=0.0, atol=2e-5)
    print("rendered")


if __name__ == "__main__":
    main(sys.argv[1])
