"""Time and distance from the truth, of torchdof and of other tools, in one run.

    python examples/benchmarks/peers.py SCENES --out results

A peer is a Python file in a folder (``tools`` beside this file)::

    NAME = "my blur"                                 # may be left out, like NOTE and version()
    NOTE = "float32. Time: the whole call."
    def available() -> str | None: ...               # None, or what to install
    def version() -> str: ...
    def blur(image, coc_px) -> Tensor: ...         # or (Tensor, seconds), where the tool times itself

``image`` is ``[1, 3, H, W]``, linear light, float32; ``coc_px`` ``[1, 1, H, W]``, signed radius of the disc in pixels.
Files that start with an underscore are left alone.
"""

import dataclasses
import functools
import importlib.util
import math
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Annotated

import torch
import typer
from rich.console import Console
from rich.progress import track
from torch import Tensor

from torchdof.bench.report import Report, ReportTable, csv_of, existing_folder, machine
from torchdof.bench.timer import in_turns, median_and_spread, timed
from torchdof.cli.errors import told_in_one_sentence
from torchdof.module import blur_by_coc
from torchdof.reference import metrics
from torchdof.reference.scenes import Scene, read_scenes
from torchdof.validation import whole

__all__ = ["Peer", "CaseTiming", "check", "compare", "measure_case", "ours", "read_peers", "ratios"]

_LEVELS = (8.0, 4.0, 1.0)  # of 255
_STRIP_PX = 65
_PEERS = Path(__file__).parent / "tools"
_DOT = 8.0


@dataclasses.dataclass(frozen=True)
class Peer:
    """A renderer to compare.

    Args:
        name: For the tables.
        blur: The rendering of ``image`` ``[1, 3, H, W]`` by ``coc_px`` ``[1, 1, H, W]``; and, where the tool timed
            itself, seconds.
        note: What it was given, and what its time holds.
        missing: What to install; None: nothing is missing.
        version: Its version.
    """

    name: str
    blur: Callable[[Tensor, Tensor], Tensor | tuple[Tensor, float]]
    note: str = ""
    missing: str | None = None
    version: str = ""


@dataclasses.dataclass(frozen=True)
class CaseTiming:
    """What one renderer took on one case, in seconds (spread: interquartile range), and reached, display-encoded."""

    case: str
    name: str
    median_s: float
    spread_s: float
    psnr_db: float


def ours() -> list[Peer]:
    """Torchdof, from coarse to its default tolerance.

    Example:
        >>> [peer.name for peer in ours()]
        ['ours 8/255', 'ours 4/255', 'ours 1/255']
    """
    note = "float32. Time: the whole call, from the circle of confusion."
    return [
        Peer(f"ours {level:g}/255", functools.partial(blur_by_coc, tolerance=level / 255), note) for level in _LEVELS
    ]


def read_peers(folder: Path) -> list[Peer]:
    """The peers of a folder, by file name.

    Raises:
        FileNotFoundError: If there is no such folder, or no peer in it.
        ValueError: If a file has no ``blur`` or ``available``.
    """
    files = sorted(path for path in folder.glob("*.py") if not path.name.startswith("_"))
    if not files:
        raise FileNotFoundError(
            f"{folder}: there are no peers here; a peer is a Python file, see examples/benchmarks/tools/README.md"
        )
    return [_read_peer(path) for path in files]


def _read_peer(path: Path) -> Peer:
    """The peer that one Python file defines; one whose imports are missing is listed as not installed."""
    spec = importlib.util.spec_from_file_location(f"torchdof_peer_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path}: cannot be read as Python")
    module: ModuleType = importlib.util.module_from_spec(spec)
    name, note, missing, version = path.stem, "", None, ""
    try:
        spec.loader.exec_module(module)
    except ModuleNotFoundError as error:
        return Peer(name, lambda image, coc_px: image, missing=f"pip install {error.name}")
    if not callable(getattr(module, "blur", None)) or not callable(getattr(module, "available", None)):
        raise ValueError(f"{path}: a peer defines available() and blur(image, coc_px)")
    name, note, missing = getattr(module, "NAME", name), getattr(module, "NOTE", note), module.available()
    if missing is None and hasattr(module, "version"):
        version = module.version()
    return Peer(name, module.blur, note, missing, version)


def check(peer: Peer, radius_px: float = 6.0) -> str | None:
    """Whether a peer blurs each of three dots by the circle of confusion it has: in focus, behind and in front.

    A dot must keep its light within 3 %, stay in its place within 0.75 px, and become as wide as a disc of its radius
    (by second moments), within 5 %; or within 1 px in focus.

    Returns:
        None, or what is wrong.
    """
    radii = (0.0, radius_px, -radius_px)
    n = _STRIP_PX
    image, coc = torch.zeros(1, 3, n, n * len(radii)), torch.zeros(1, 1, n, n * len(radii))
    for k, radius in enumerate(radii):
        image[..., n // 2, n * k + n // 2] = _DOT
        coc[..., n * k : n * (k + 1)] = radius
    out, _ = _timed(peer, image, coc)
    if out.shape != image.shape or not bool(torch.isfinite(out).all()):
        return f"returned {list(out.shape)}, not finite numbers {list(image.shape)}"
    place = torch.arange(n, dtype=torch.float64) - n // 2
    for k, radius in enumerate(radii):
        dot = out[0, :, :, n * k : n * (k + 1)].double().mean(0) / _DOT
        light = float(dot.sum())
        if not abs(light - 1.0) < 0.03:
            return f"a dot at {radius:g} px keeps {light:.3f} of its light"
        y, x = (float((dot.sum(axis) * place).sum()) / light for axis in (1, 0))
        if max(abs(x), abs(y)) > 0.75:
            return f"a dot at {radius:g} px moves by {x:.2f}, {y:.2f} px"
        square = float((dot * ((place[:, None] - y) ** 2 + (place - x) ** 2)).sum()) / light
        disc_radius = math.sqrt(max(2.0 * (square - 1.0 / 6.0), 0.0))  # a pixel itself has 1 / 6
        if abs(disc_radius - abs(radius)) > (0.05 * abs(radius) or 1.0):
            return f"a dot at {radius:g} px is blurred as by a disc of {disc_radius:.2f} px"
    return None


def measure_case(scene: Scene, compared: Sequence[Peer], repeat: int) -> list[CaseTiming]:
    """Each renderer on one case: once for the error and to warm up, then ``repeat`` times, in turns."""
    truth = metrics.display(scene.truth)
    errors: dict[str, float] = {}

    def seconds_of(peer: Peer) -> float:
        image, seconds = _timed(peer, scene.image, scene.coc_px)
        if peer.name not in errors:
            errors[peer.name] = metrics.psnr(metrics.display(image), truth)
        return seconds

    works = {peer.name: functools.partial(seconds_of, peer) for peer in compared}
    seconds = in_turns(works, repeat, seconds_of=lambda work: work())
    return [CaseTiming(scene.name, name, *median_and_spread(taken), errors[name]) for name, taken in seconds.items()]


def ratios(rows: Sequence[CaseTiming], name: str, base: str) -> tuple[list[float], list[float]]:
    """Of each case, the time of ``name`` over that of ``base``, and by how many dB ``base`` is nearer the truth."""
    timings = {(row.case, row.name): row for row in rows}
    pairs = [(timings[case, name], timings[case, base]) for case in dict.fromkeys(row.case for row in rows)]
    return [a.median_s / b.median_s for a, b in pairs], [b.psnr_db - a.psnr_db for a, b in pairs]


def compare(scenes: Path, folder: Path, out: Path | None, repeat: int) -> None:
    """Measures torchdof and each peer of a folder on each case of a folder of scenes, prints and writes the tables.

    Args:
        scenes: As :func:`torchdof.reference.scenes.read_scenes` takes it.
        folder: The peers, as :func:`read_peers` takes it.
        out: Folder for ``peers.csv`` and ``peers.md``; None: they are printed only.
        repeat: How often each is timed.

    Raises:
        ValueError: If torchdof fails its own check, or input is wrong.
        OSError: If there are no scenes or peers, or a tool fails.
    """
    whole("--repeat", repeat, 1, 10000)
    progress, others = Console(stderr=True), read_peers(folder)
    cases = list(read_scenes(scenes))
    problems = {peer.name: _wrong(peer) for peer in others}
    own_settings = ours()
    for peer in own_settings:
        if (failed := check(peer)) is not None:
            raise ValueError(f"{peer.name}: {failed}")
    compared = [*own_settings, *(peer for peer in others if problems[peer.name] is None)]
    rows: list[CaseTiming] = []
    for scene in track(cases, "cases", console=progress, transient=True, disable=not progress.is_terminal):
        rows += measure_case(scene, compared, repeat)
    absent = {name: reason for name, reason in problems.items() if reason is not None}
    tables = _tables(rows)
    for table in (tables[1], tables[2], tables[0]):  # the summary is what remains on the screen
        table.show()
    hardware = machine(f"threads for each renderer: {torch.get_num_threads()}")
    remarks = [f"{hardware}. Timed renderings of each, in turns, after one more: {repeat}."]
    remarks += [f"{peer.name}{peer.version and f' ({peer.version})'}: {peer.note}" for peer in compared]
    remarks += [f"{name}: {reason}" for name, reason in absent.items()]
    for line in remarks:
        Console().print(line, markup=False, highlight=False)
    if out is not None:
        notes = "\n".join(f"- {line}" for line in remarks[1:])
        Report("peers", "Beside other tools", [remarks[0], notes, *tables], csv_of(rows)).write(out)


def _wrong(peer: Peer) -> str | None:
    """Why a peer is not measured."""
    if peer.missing is not None:
        return f"not installed: {peer.missing}"
    failed = check(peer)
    return None if failed is None else f"left out, as it fails its check: {failed}"


def _timed(peer: Peer, image: Tensor, coc_px: Tensor) -> tuple[Tensor, float]:
    """A peer's picture and its seconds: its own, where the tool times itself."""
    with torch.inference_mode():
        result, seconds = timed(functools.partial(peer.blur, image, coc_px))
    return result if isinstance(result, tuple) else (result, seconds)


def _names(rows: Sequence[CaseTiming]) -> list[str]:
    return list(dict.fromkeys(row.name for row in rows))


def _times(rows: Sequence[CaseTiming]) -> list[list[str]]:
    """Lines of the table of times: a case each."""
    lines: dict[str, list[str]] = {}
    for row in rows:
        digits = 0 if row.median_s >= 0.1 else 1
        cell = f"{1e3 * row.median_s:.{digits}f} ± {1e3 * row.spread_s:.{digits}f}"
        lines.setdefault(row.case, [row.case]).append(cell)
    return list(lines.values())


def _errors(rows: Sequence[CaseTiming]) -> list[list[str]]:
    """Lines of the table of errors: a case each, and their mean."""
    lines: dict[str, list[str]] = {}
    for row in rows:
        lines.setdefault(row.case, [row.case]).append(f"{row.psnr_db:.2f}")
    means = [statistics.mean(row.psnr_db for row in rows if row.name == name) for name in _names(rows)]
    return [*lines.values(), ["mean", *(f"{mean:.2f}" for mean in means)]]


def _summary(rows: Sequence[CaseTiming]) -> list[list[str]]:
    """Lines of the summary: for each peer its time over ours, and how much nearer we are."""
    base, lines = f"ours {_LEVELS[-1]:g}/255", []
    for name in _names(rows):
        if name == base:
            continue
        times, gains = ratios(rows, name, base)
        cells = [
            f"{statistics.median(v):{f}} ({min(v):{f}} to {max(v):{f}})" for v, f in ((times, ".3g"), (gains, "+.2f"))
        ]
        faster, nearer = sum(t > 1 for t in times), sum(g > 0 for g in gains)
        lines.append([name, *cells, f"{faster} of {len(times)}", f"{nearer} of {len(gains)}"])
    return lines


_SUMMARY = ("", "time over ours", "ours nearer by dB", "ours faster", "ours nearer")
_TIMES = "Milliseconds: median and spread (interquartile range)"
_ERRORS = "PSNR in dB against the truth: display-encoded (clipped to [0, 1], sRGB curve), peak 1, whole frame"
_RATIOS = f"Against ours at {_LEVELS[-1]:g}/255: median over the cases (least to greatest)"


def _tables(rows: Sequence[CaseTiming]) -> list[ReportTable]:
    """Summary, times and errors."""
    head = ["case", *_names(rows)]
    return [
        ReportTable(_RATIOS, [_SUMMARY, *_summary(rows)], words=("",)),
        ReportTable(_TIMES, [head, *_times(rows)], words=("case",)),
        ReportTable(_ERRORS, [head, *_errors(rows)], words=("case",)),
    ]


def main(
    scenes: Annotated[Path, typer.Argument(help="Folder with scenes, as for torchdof bench --truth.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for peers.csv and peers.md.")] = None,
    repeat: Annotated[int, typer.Option(help="Timed renderings of each tool.", min=1)] = 5,
    folder: Annotated[
        Path, typer.Option("--peers-folder", help="Where the other tools are described, a Python file each.")
    ] = _PEERS,
) -> None:
    """Torchdof and what else is installed, GEGL, FFmpeg or Blender, in one run on the same scenes."""
    with told_in_one_sentence():
        compare(scenes, folder, existing_folder(out), repeat)


if __name__ == "__main__":
    typer.run(main)
