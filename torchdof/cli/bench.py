"""``torchdof bench``: speed against error on a scene, or accuracy of renderers where the truth is known."""

import dataclasses
from pathlib import Path

import click

from ..io.atomic import check_writable
from .command import Command, Group, argument, option
from .options import Blur, Scene, check_files
from .output import Notices, json_line


class _Speed(Group):
    """Speed."""

    repeat: int = option("Cameras that each setting is timed with.", 5, type=click.IntRange(min=1), basic=True)
    onnx: bool = option("Also export and time the file in onnxruntime; takes minutes.", False)
    compiled: bool = option("Also time torch.compile; takes minutes.", False, names=("--compile",))
    scan: bool = option("Also show how cost grows with radius and frame size.", False)


class _Accuracy(Group):
    """Accuracy."""

    truth: Path | None = option("Folder with scenes, at any depth: meta.json, sharp.exr, depth.exr and truth_K.exr.")
    views: tuple[int, ...] = option(
        "Points on the lens for the reference renderer; repeat it to see how it converges.",
        (),
        type=click.IntRange(min=1),
    )
    degrade: bool = option("Instead, measure the cost of soft, displaced, coarse or noisy depth.", False)
    without: tuple[str, ...] = option(
        "Instead, render without this rule of the picture, and show the change in dB; may be repeated.", ()
    )
    ablation: bool = option("The same for every rule, one after the other; takes long.", False)
    peer: tuple[Path, ...] = option("A Python file with another renderer, blur(image, coc_px); may be repeated.", ())


class Bench(Scene, Blur, _Speed, _Accuracy, Command):
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
    out: Path | None = option("Folder for tables (.csv, .md; --truth: and a picture); is made.", names=("--out", "-o"))

    def run(self) -> None:
        """Measures accuracy where the truth is known, else speed against error."""
        if self.truth is None:
            return self._measure_speed()
        if self.image is not None or self.given(Scene, Blur, _Speed) - {"repeat"}:
            problem = "--truth measures scenes with their own lens and depth"
            raise ValueError(
                f"{problem}; leave IMAGE and DEPTH out, --onnx, --compile and --scan, and the other options"
            )
        if self.as_json or self.out is None:
            raise ValueError("--truth writes tables and pictures; give a folder with --out, and leave --json out")
        if self.degrade and self.views:
            raise ValueError("--degrade compares without the reference; leave --views out")
        if self.without or self.ablation:
            return self._measure_rules(self.truth, self.out)
        from ..bench import accuracy

        check_writable(self.out / "accuracy.csv")
        accuracy.compare(self.truth, self.out, [] if self.degrade else self.views or [256], self.degrade, self.peer)

    def _measure_rules(self, truth: Path, out: Path) -> None:
        """Measures the change in dB without each of the named rules, or of all rules."""
        if self.views or self.peer:
            raise ValueError("--without and --ablation compare torchdof with itself; leave --views and --peer out")
        if self.without and self.ablation:
            raise ValueError("--ablation measures every rule; leave --without out")
        from ..bench import ablation
        from ..render.rules import RULES, refuse_unknown

        refuse_unknown(self.without, "--without: ")
        check_writable(out / "ablation.csv")
        ablation.compare(truth, out, self.degrade, self.without or list(RULES))

    def _measure_speed(self) -> None:
        """Checks the options, and measures speed against error on the user's scene or on the built-in one."""
        if self.given(_Accuracy):
            raise ValueError(
                "--views, --degrade, --without, --ablation and --peer need a truth; name its folder with --truth"
            )
        if self.image is None and self.given(Scene):
            raise ValueError("the built-in scene has its own camera and depth; name an IMAGE for these options")
        self.refuse_keyframes()
        if self.out is not None:
            check_writable(self.out / "speed.csv")
        if self.image is not None:
            check_files(self.image, self.depth)
        from rich.console import Console

        from ..bench import speed
        from ..bench.measurement import BenchScene, shipped
        from .frame import coc_of, read_frame

        table = self.blur_table()
        if self.image is None:
            scene = dataclasses.replace(shipped(), table=table)
        else:
            frame = read_frame(self.image, self.depth, self)
            coc_px, camera, remarks = coc_of(frame, Notices(self.strict))
            remarks = ["focus as stated"] * self.has_focus + remarks + [f"depth {frame.guess}"] * bool(frame.guess)
            remark = "blur as given" if camera is None else f"{camera!r}; {', '.join(remarks)}"
            scene = BenchScene(self.image.name, frame.picture.light, coc_px, remark, table)
        runtimes = ["onnxruntime"] * self.onnx + ["compiled"] * self.compiled
        rows = speed.compare(scene, self.repeat, Console(stderr=True), runtimes, self.scan)
        if self.as_json:
            facts = {"scene": scene.name, "remark": scene.remark, "table": repr(scene.table)}
            click.echo(json_line({**facts, "settings": rows}))
        speed.report(rows, scene, self.out, quiet=self.as_json)
