"""``torchdof bench``: speed against error on a scene, or accuracy of renderers where the truth is known."""

import dataclasses
import importlib.util
import os
import shutil
from pathlib import Path

import click

from ..io.atomic import check_writable
from .command import argument, option
from .options import Blur, Scene, check_files, json_option, make_folder_of
from .output import Notices, json_line


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Speed:
    """Speed."""

    repeat: int = option("Cameras that each setting is timed with.", 5, type=click.IntRange(min=1), basic=True)
    onnx: bool = option("Also export and time the file in onnxruntime; takes minutes.", False)
    compiled: bool = option("Also time torch.compile; takes minutes.", False, names=("--compile",))
    scan: bool = option("Also show how cost grows with radius and frame size.", False)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Accuracy:
    """Accuracy."""

    truth: Path | None = option("Folder with scenes, at any depth: meta.json, sharp.exr, depth.exr and truth_K.exr.")
    views: tuple[int, ...] = option(
        "Points on the lens for the reference renderer; repeat it to see how it converges.",
        (),
        type=click.IntRange(min=1),
    )
    degrade: bool = option("Instead, measure the cost of soft, displaced, coarse or noisy depth.", False)
    peer: tuple[Path, ...] = option("A Python file with another renderer, blur(image, coc_px); may be repeated.", ())


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure speed against error on your own scene, or accuracy where the truth is known.

    Compares each tolerance with the exact rendering on the CPU: time, memory, RMS error, PSNR and SSIM. The options
    for camera, depth and blur are those of torchdof render.

        torchdof bench photo.png depth.exr --f-number 1.8 --out results

    Compare torchdof, simpler renderers and GEGL on scenes whose depth of field is known:

        torchdof bench --truth scenes --peer examples/benchmarks/tools/gegl.py --out results
    """

    image: Path | None = argument(
        "Image to measure the speed on; without one, a scene that is built in.", "[IMAGE]", None
    )
    depth: Path | None = argument("Its depth; not needed if IMAGE has a Z channel.", "[DEPTH]", None)
    out: Path | None = option("Folder for tables (.csv, .md) and a picture; is made.", names=("--out", "-o"))
    scene: Scene
    blur: Blur
    speed: _Speed
    accuracy: _Accuracy
    as_json: bool = json_option()

    def run(self) -> None:
        """Measures accuracy or speed."""
        if self.accuracy.truth is not None:
            self._measure_accuracy(self.accuracy.truth)
        else:
            self._measure_speed()

    def _measure_accuracy(self, truth: Path) -> None:
        """Checks the options, and measures accuracy on the scenes in a folder."""
        degrade, views = self.accuracy.degrade, self.accuracy.views
        others = (self.image, self.scene, self.blur, dataclasses.replace(self.speed, repeat=5))
        if others != (None, Scene(), Blur(), _Speed()):
            raise ValueError(
                "--truth measures the scenes of its folder with their own lens and depth; leave IMAGE and DEPTH out, "
                "--onnx, --compile and --scan, and options of lens, depth and blur"
            )
        if self.as_json or self.out is None:
            raise ValueError("--truth writes tables and pictures; give a folder with --out, and leave --json out")
        if degrade and views:
            raise ValueError("--degrade compares without the reference; leave --views out")
        from ..bench import accuracy

        make_folder_of(self.out / "accuracy.csv")
        accuracy.compare(truth, self.out, [] if degrade else views or [256], degrade, self.accuracy.peer)

    def _measure_speed(self) -> None:
        """Checks the options, and measures speed against error on the user's scene or on the built-in one."""
        options, lens = self.speed, self.scene.lens
        if self.accuracy != _Accuracy():
            raise ValueError("--views, --degrade and --peer compare with a truth; name its folder with --truth")
        if self.image is None and self.scene != Scene():
            raise ValueError("the built-in scene has its own camera and depth; name an IMAGE for these options")
        lens.refuse_keyframes()
        if self.out is not None:
            check_writable(self.out / "speed.csv")
        if self.image is not None:
            check_files(self.image, self.depth)
        for package, is_needed in {"matplotlib": self.out is not None, "onnxruntime": options.onnx}.items():
            if is_needed and importlib.util.find_spec(package) is None:  # check before measuring for minutes
                raise ModuleNotFoundError(f"no {package}", name=package)
        if options.compiled and not any(map(shutil.which, (os.environ.get("CXX", ""), "g++", "clang++", "c++"))):
            raise FileNotFoundError(
                "torch.compile needs a C++ compiler, and none was found; install g++ or leave --compile out"
            )
        from rich.console import Console

        from ..bench import speed
        from ..bench.measurement import BenchScene, shipped
        from ..tensors import TRACEABLE
        from .frame import coc_of, read_frame

        if options.compiled and not TRACEABLE:
            raise ValueError("torch.compile needs PyTorch 2.13 or newer here; leave --compile out")
        table = self.blur.table_of(self.blur.table)
        if (options.onnx or options.compiled) and table.depends_on_place:
            raise ValueError("compiled and exported graphs have one kernel a layer; leave --onnx and --compile out")
        if self.image is None:
            scene = dataclasses.replace(shipped(), table=table)
        else:
            frame = read_frame(self.image, self.depth, self.scene)
            coc_px, camera, remarks = coc_of(frame, Notices(self.scene.depth_map.strict))
            remarks = ["focus as stated"] * lens.has_focus + remarks + [f"depth {frame.guess}"] * bool(frame.guess)
            remark = "blur as given" if camera is None else f"{camera!r}; {', '.join(remarks)}"
            scene = BenchScene(self.image.name, frame.picture.light, coc_px, remark, table)
        if self.out is not None:
            make_folder_of(self.out / "speed.csv")
        chosen: dict[speed.Runtime, bool] = {"onnxruntime": options.onnx, "compiled": options.compiled}
        runtimes = [runtime for runtime, is_chosen in chosen.items() if is_chosen]
        rows = speed.compare(scene, options.repeat, Console(stderr=True), runtimes, options.scan)
        if self.as_json:
            facts = {"scene": scene.name, "remark": scene.remark, "table": repr(scene.table)}
            click.echo(json_line({**facts, "settings": rows}))
        speed.report(rows, scene, self.out, quiet=self.as_json)
