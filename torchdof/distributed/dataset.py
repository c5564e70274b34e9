"""Makes a whole data set on a Ray cluster: missing shards, and a list of broken inputs."""

import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .. import extras
from ..io.atomic import write_text
from ..io.paths import IMAGE_SUFFIXES, MAP_SUFFIXES
from ..validation import whole
from .shards import SUFFIXES, Pair, RenderShards, samples_of, shard_rows


class Summary(NamedTuple):
    """Contents of a data set: number of samples and shards, and image and error of each broken input."""

    samples: int
    shards: int
    broken: list[tuple[str, str]]
    seconds: float  # processor time for all samples


def pairs_in(
    images: str | os.PathLike[str],
    depths: str | os.PathLike[str] | None = None,
    mattes: str | os.PathLike[str] | None = None,
) -> list[Pair]:
    """Pairs each image of a folder with the depth file of the same name in another folder; full paths.

    Args:
        images: Folder of images.
        depths: Folder of depth maps; None uses the depth channels of the images.
        mattes: Folder of subjects' masks of the same names for :func:`torchdof.io.matte.read_matte`, or None.

    Raises:
        FileNotFoundError: If a folder is missing or has no image.
        ValueError: If an image has no depth file or mask, or several.
    """
    photographs = _by_stem(images, IMAGE_SUFFIXES)
    if not photographs:
        raise FileNotFoundError(f"{images}: no images here ({' '.join(IMAGE_SUFFIXES)})")
    maps = dict[str, dict[str, Path]]()
    for name, folder in (("depth map", depths), ("mask", mattes)):
        maps[name] = {} if folder is None else _by_stem(folder, MAP_SUFFIXES)
        if folder is not None and (missing := [stem for stem in photographs if stem not in maps[name]]):
            raise ValueError(f"{photographs[missing[0]]}: needs a {name} {missing[0]}.* in {folder}, found none")
    files = {stem: [str(found[stem]) if found else None for found in maps.values()] for stem in photographs}
    return [Pair(str(image), files[stem][0], matte=files[stem][1]) for stem, image in photographs.items()]


def _by_stem(folder: str | os.PathLike[str], suffixes: tuple[str, ...]) -> dict[str, Path]:
    """The files of a folder with one of some suffixes, by their name without suffix; refuses two of one name."""
    by_stem: dict[str, Path] = {}
    for path in sorted(Path(folder).absolute().iterdir()):
        if path.suffix.lower() in suffixes and not path.name.startswith("."):
            if (other := by_stem.setdefault(path.stem, path)) is not path:
                raise ValueError(f"{other}: there is {path.name} of the same name; keep one of them")
    return by_stem


def make_dataset(
    pairs: Sequence[Pair],
    out: str | os.PathLike[str],
    blur: Any = None,
    *,
    workers: int = 2,
    per_shard: int = 64,
    copies: int = 1,
    say: Callable[[str], object] = print,
    **render: Any,
) -> Summary:
    """Makes the missing shards of a data set with Ray, on the cluster in use or on this machine.

    Shards that are complete, and whose settings and input files have not changed, are kept; so a call with the same
    arguments continues after an interruption.

    Args:
        pairs: Images and depths.
        out: Folder of the data set; made if it is missing. All machines of a cluster must see it.
        blur: A :class:`torchdof.augmentation.RandomDepthOfField`; None uses its defaults.
        workers: Processes, each on one core.
        per_shard: Samples in a shard.
        copies: Number of blurred samples of each image.
        say: Gets lines of text: the shards that exist, the throughput, the contents, the inputs that were left out.
        **render: Further arguments of :class:`RenderShards`, such as ``format``.

    Returns:
        Contents of the folder. All settings are written to ``plan.json``, broken inputs to ``broken.txt``.

    Raises:
        ValueError: If an argument is invalid, or the folder has the shards of another data set.
        ModuleNotFoundError: If Ray is not installed.
    """
    try:
        import ray.data
    except ModuleNotFoundError as error:
        raise extras.missing("a data set", "ray") or error from error
    whole("workers", workers, 1, 100_000)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    rows = shard_rows(pairs, per_shard, copies)
    renderer = RenderShards(out, blur, **render)  # validates the arguments before Ray starts
    digest = hashlib.sha256(json.dumps(rows).encode()).hexdigest()
    settings = {"images": len(pairs), "copies": copies, "per_shard": per_shard, "sha256_of_samples": digest}
    settings = json.loads(json.dumps(settings | renderer.settings()))  # tuples become lists
    plan = out / "plan.json"
    if not plan.is_file():
        write_text(plan, json.dumps(settings, indent=1))
    recorded = json.loads(plan.read_bytes())
    if differing := [name for name, value in settings.items() if recorded.get(name) != value]:
        begun = f"{out}: was begun with other settings ({', '.join(differing)})"
        raise ValueError(f"{begun}; go on with those in {plan.name}, or use another folder")
    missing = [row for row in rows if renderer.samples_of(**row) is None]
    say(f"{len(rows) - len(missing)} of {len(rows)} shards are there already")
    if missing:
        if not ray.is_initialized():
            ray.init(include_dashboard=False)
        cores = int(ray.cluster_resources().get("CPU", 0))
        if workers > cores:
            raise ValueError(f"workers must be at most the cores of the Ray cluster, {cores}, got {workers}")
        start = time.perf_counter()
        made = ray.data.from_items(missing, override_num_blocks=len(missing)).map_batches(
            RenderShards,
            fn_constructor_args=(str(out.resolve()), blur),
            fn_constructor_kwargs={"threads": 1, **render},
            batch_size=1,
            compute=ray.data.ActorPoolStrategy(size=min(workers, len(missing))),
            num_cpus=1,
        )
        count = sum(not row["error"] for row in made.iter_rows())
        seconds = time.perf_counter() - start
        say(f"{count} samples in {seconds:.1f} s: {count / seconds:.2f} images/s with {workers} workers")
    summary = summary_of(out)
    say(f"{summary.samples} samples in {summary.shards} shards; {len(summary.broken)} inputs left out")
    write_text(out / "broken.txt", "".join(f"{image}\t{problem}\n" for image, problem in summary.broken))
    for image, problem in summary.broken:
        say(f"left out: {problem}" if problem.startswith(image) else f"left out: {image}: {problem}")
    return summary


def summary_of(out: str | os.PathLike[str]) -> Summary:
    """Contents of the complete shards of a folder; ``FileNotFoundError`` if the folder is missing."""
    shards = [path for path in sorted(Path(out).iterdir()) if path.suffix in SUFFIXES.values()]
    noted = [notes for shard in shards if (notes := samples_of(shard)) is not None]
    rows = [row for notes in noted for row in notes]
    broken = [(row["image"], row["error"]) for row in rows if row["error"]]
    return Summary(len(rows) - len(broken), len(noted), broken, sum(row["seconds"] for row in rows))
