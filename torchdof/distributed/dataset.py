"""A whole data set on a Ray cluster: the shards that are missing, what was left out, the card that describes it."""

import dataclasses
import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..io.atomic import whole_file
from ..validation import whole
from .pairs import Pair
from .shards import Format, RenderShards, shard_name, shard_rows

__all__ = ["Summary", "make_dataset", "summary_of"]


@dataclasses.dataclass(frozen=True)
class Summary:
    """What is in a data set.

    Args:
        samples: Samples that were written.
        shards: Shards that hold them.
        broken: Image file and error of each sample that could not be made.
        seconds: Of the processor, over all samples.
    """

    samples: int
    shards: int
    broken: list[tuple[str, str]]
    seconds: float


def make_dataset(
    pairs: Sequence[Pair],
    out: str | os.PathLike[str],
    blur: Any = None,
    *,
    workers: int = 2,
    per_shard: int = 64,
    copies: int = 1,
    format: Format = "webdataset",
    say: Callable[[str], object] = print,
    **render: Any,
) -> Summary:
    """Makes the shards of a data set that are missing, on the Ray cluster in use, or on this machine.

    Stopped at any moment, it goes on from the shards that are complete when it is called again with the same arguments.

    Args:
        pairs: Images and depths.
        out: Folder of the data set; made if it is not there. On a cluster all machines must see it.
        blur: A :class:`torchdof.augmentation.RandomDepthOfField`; None takes its defaults.
        workers: Processes, each on one core.
        per_shard: Samples in a shard.
        copies: How often each image is blurred.
        format: "webdataset" or "parquet".
        say: Told how it goes: a line for each shard, and the throughput at the end.
        **render: Further arguments of :class:`RenderShards`.

    Returns:
        What is in the folder now: also as ``README.md``, and the broken inputs as ``broken.txt``.

    Raises:
        ValueError: If an argument is not as described, or the folder holds the shards of another data set.
        ModuleNotFoundError: If Ray is not installed.
    """
    try:
        import ray
        import ray.data
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("data sets need Ray; install it with: pip install 'torchdof[ray]'") from error
    whole("workers", workers, 1, 100_000)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    rows = shard_rows(pairs, per_shard, copies)
    settings = RenderShards(
        out, blur, format=format, **render
    ).settings()  # wrong ones are refused here, not in a worker
    listed = hashlib.sha256(json.dumps(rows).encode()).hexdigest()
    settings = {"images": len(pairs), "copies": copies, "per_shard": per_shard, "sha256_of_samples": listed, **settings}
    _same_as_before(out / "plan.json", settings)
    missing = [row for row in rows if not (out / shard_name(row["shard"], format)).is_file()]
    say(f"{len(rows) - len(missing)} of {len(rows)} shards are there already")
    made, seconds = 0, 0.0
    if missing:
        if not ray.is_initialized():
            ray.init(include_dashboard=False)
        cores = int(ray.cluster_resources().get("CPU", 0))
        if workers > cores:
            raise ValueError(f"workers must be at most the cores of the Ray cluster, {cores}, got {workers}")
        start = time.perf_counter()
        made = _run(ray, missing, out, blur, workers, format, say, render)
        seconds = time.perf_counter() - start
    summary = summary_of(out)
    _describe(out, summary, settings)
    if made:
        say(
            f"{made} samples in {seconds:.1f} s: {made / seconds:.2f} images/s, {made / seconds / workers:.2f} a worker"
        )
    for image, problem in summary.broken:
        say(f"left out: {problem}" if problem.startswith(image) else f"left out: {image}: {problem}")
    return summary


def _run(
    ray: Any,
    missing: list[dict[str, Any]],
    out: Path,
    blur: Any,
    workers: int,
    format: Format,
    say: Callable[[str], object],
    render: dict[str, Any],
) -> int:
    """Has Ray make shards; the number of samples written."""
    ray.data.DataContext.get_current().enable_progress_bars = False  # each shard is told instead
    arguments = {"format": format, "threads": 1, **render}
    rows = ray.data.from_items(missing, override_num_blocks=len(missing)).map_batches(
        RenderShards,
        fn_constructor_args=(str(out.resolve()), blur),
        fn_constructor_kwargs=arguments,
        batch_size=1,
        compute=ray.data.ActorPoolStrategy(size=min(workers, len(missing))),
        num_cpus=1,
    )
    made, left = 0, {row["shard"]: len(json.loads(row["samples"])) for row in missing}
    for row in rows.iter_rows():
        made += not row["error"]
        left[row["shard"]] -= 1
        if not left[row["shard"]]:
            say(f"{shard_name(row['shard'], format)} is complete")
    return made


def summary_of(out: str | os.PathLike[str]) -> Summary:
    """What is in the folder of a data set, complete or not.

    Raises:
        FileNotFoundError: If there is no such folder.
    """
    if not Path(out).is_dir():
        raise FileNotFoundError(f"{out}: there is no such folder")
    shards = [path for path in sorted(Path(out).glob("shard-*")) if path.suffix in (".tar", ".parquet")]
    rows = [row for path in shards for row in json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))]
    broken = [(row["image"], row["error"]) for row in rows if row["error"]]
    return Summary(len(rows) - len(broken), len(shards), broken, sum(row["seconds"] for row in rows))


def _same_as_before(path: Path, plan: dict[str, Any]) -> None:
    """Refuse to go on in a folder that was begun with other settings, or note them."""
    text = json.dumps(plan, indent=1)
    if path.is_file():
        before = json.loads(path.read_text(encoding="utf-8"))
        differing = [name for name in plan if before.get(name) != json.loads(text)[name]]
        if differing:
            raise ValueError(
                f"{path.parent}: was begun with other settings ({', '.join(differing)}); go on with those in "
                f"{path.name}, or use another folder"
            )
        return
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def _describe(out: Path, summary: Summary, settings: dict[str, Any]) -> None:
    """The data set's card, and the list of what was left out."""
    with whole_file(out / "broken.txt") as part:
        part.write_text("".join(f"{image}\t{error}\n" for image, error in summary.broken), encoding="utf-8")
    pace = f"{summary.seconds / summary.samples:.3f} s" if summary.samples else "no time"
    focus, opening = settings["focus_m"], settings["f_number"]
    text = f"""# Defocus data set

Sharp photographs, their depth, and the same photographs as a lens with a random focus and opening would have taken
them.

| what | how much |
| --- | --- |
| samples | {summary.samples}, {settings["copies"]} of each image |
| shards | {summary.shards}, {settings["format"]} |
| inputs left out | {len(summary.broken)}, listed in broken.txt |
| time | {pace} of one core a sample |
| focus | {focus[0]:g} to {focus[1]:g} m, evenly in 1 / metres |
| opening | f/{opening[0]:g} to f/{opening[1]:g}, evenly in stops |
| camera | {settings["camera"]}, but for focus and opening |
| lenses | {", ".join(settings["tables"])} |
| seed | {settings["seed"]} |

Each sample has its parameters (focus, f-number, focal length, sensor, lens, tolerance, seed, version) in its `json`
{"file" if settings["format"] == "webdataset" else "columns"}. Depth is in metres along the optical axis.
Made by torchdof.
"""
    with whole_file(out / "README.md") as part:
        part.write_text(text, encoding="utf-8")
