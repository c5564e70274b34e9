"""Makes one shard of a data set, whose contents depend only on its row, its input files and the settings."""

import dataclasses
import hashlib
import importlib.metadata
import importlib.util
import inspect
import io
import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ..augmentation import RandomDepthOfField
from ..depth.read import read_depth
from ..extras import missing
from ..io.atomic import atomic_file, write_text
from ..io.images import Picture, read_image, write_image
from ..io.matte import read_matte
from ..io.transfer import Transfer
from ..module import depth_of_field
from ..render.surfaces.resample import at_size_of
from ..validation import choice, number, show, whole

Format = Literal["webdataset", "parquet"]

SUFFIXES = {"webdataset": ".tar", "parquet": ".parquet"}
_FILES = ("blurred", "sharp", "depth")


@dataclasses.dataclass(frozen=True)
class Pair:
    """An image file, its depth file, and perhaps a subject's mask.

    A depth of None uses the image's depth channel, a matte of None that of a portrait, if it has one. Other values of
    None are drawn.

    Raises:
        ValueError: If a number is not positive.

    Example:
        >>> Pair("a.png", "a.npy", focus_m=2.0).f_number is None
        True
    """

    image: str
    depth: str | None = None
    focus_m: float | None = None
    f_number: float | None = None
    matte: str | None = None

    def __post_init__(self) -> None:
        for name in ("focus_m", "f_number"):
            if getattr(self, name) is not None:
                number(name, getattr(self, name), low=0.0, infinite=name == "focus_m")


def shard_rows(pairs: Sequence[Pair], per_shard: int = 64, copies: int = 1) -> list[dict[str, Any]]:
    """Rows for ``ray.data.from_items``, one for each shard: its number, and its samples (pair and key) as JSON.

    Args:
        pairs: Images and depths.
        per_shard: Samples in a shard.
        copies: Number of samples of each image, each with another camera.

    Example:
        >>> [row["shard"] for row in shard_rows([Pair("a.png"), Pair("b.png")], per_shard=3, copies=2)]
        [0, 1]
    """
    if not isinstance(pairs, Sequence) or not pairs or not all(isinstance(pair, Pair) for pair in pairs):
        raise ValueError(f"pairs must be at least one Pair in a list, as pairs_in() returns, got {show(pairs)}")
    whole("per_shard", per_shard, 1, 10**9)
    whole("copies", copies, 1, 10**9)
    repeated = (dataclasses.asdict(pair) for pair in pairs for _ in range(copies))
    samples = [{"key": f"{n:08d}", **sample} for n, sample in enumerate(repeated)]
    parts = [samples[start : start + per_shard] for start in range(0, len(samples), per_shard)]
    return [{"shard": number, "samples": json.dumps(part)} for number, part in enumerate(parts)]


def samples_of(shard: Path, source: str | None = None) -> list[dict[str, Any]] | None:
    """Notes about the samples of a shard; None if it is missing, incomplete, or of another ``source`` than given."""
    try:
        notes = json.loads(shard.with_suffix(".json").read_bytes())
        is_complete = notes["bytes"] == shard.stat().st_size and source in (None, notes.get("source"))
        return list(notes["samples"]) if is_complete else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


class RenderShards:
    """Makes shards: a callable for ``ray.data.Dataset.map_batches``; works without Ray.

    Each row of a batch is a shard of :func:`shard_rows`. Complete shards are not made again, unless the settings, the
    row, or size or time of an input file have changed. An input that cannot be read or rendered is skipped and listed
    with its error in ``shard-NNNNNN.json`` beside the shard.

    A WebDataset shard has for each key ``KEY.blurred.png``, ``KEY.sharp.png``, ``KEY.depth.npy`` (metres, float32) and
    ``KEY.json`` with all parameters. A Parquet shard has the same as columns; pictures are the bytes of their files.

    Args:
        out: Folder of the shards; it must exist.
        blur: Draws focus, f-number and lens, and renders. Its ``p`` is ignored: every sample is blurred.
        depth: How to read depth maps: keyword arguments of :func:`torchdof.depth.read_depth`, for example
            ``{"kind": "relative", "near_m": 1.0, "far_m": 8.0}``.
        format: "webdataset" or "parquet"; requires the package webdataset or pyarrow.
        keep: Files written for each sample: any of "blurred", "sharp" and "depth".
        seed: Seed of the draws; a sample's draw depends only on the seed and its key.
        transfer: Encoding of the images; None reads integers as sRGB and floats as linear.
        picture: Suffix of the pictures: ".png" (8 bits, sRGB) or ".exr" (half, linear).
        threads: Threads of each process; Ray gives each process a core.

    Raises:
        ValueError: If an argument is invalid; an ``OSError`` if the folder is missing.
        ModuleNotFoundError: If the package that writes the format is not installed.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(folder + "/a.png", Picture(torch.rand(1, 3, 8, 12)))
        ...     np.save(folder + "/a.npy", np.full((8, 12), 2.0))
        ...     (row,) = shard_rows([Pair(folder + "/a.png", folder + "/a.npy")])
        ...     made = RenderShards(folder)({name: np.array([value]) for name, value in row.items()})
        ...     made["error"].tolist()
        ['']
    """

    def __init__(
        self,
        out: str | os.PathLike[str],
        blur: RandomDepthOfField | None = None,
        *,
        depth: Mapping[str, Any] | None = None,
        format: Format = "webdataset",
        keep: Sequence[str] = _FILES,
        seed: int = 0,
        transfer: Transfer | None = None,
        picture: Literal[".png", ".exr"] = ".png",
        threads: int | None = None,
    ) -> None:
        self.out, self.depth = Path(out), dict(depth or {})
        self.blur = RandomDepthOfField() if blur is None else blur
        self.format, self.keep, self.transfer, self.picture = format, tuple(keep), transfer, picture
        self.seed = whole("seed", seed, 0, 2**62)
        if not self.out.is_dir():
            raise FileNotFoundError(f"{out}: there is no such folder; make it first")
        choice("format", format, tuple(SUFFIXES))
        choice("picture", picture, (".png", ".exr"))
        writer = {"webdataset": "webdataset", "parquet": "pyarrow"}[format]
        if importlib.util.find_spec(writer) is None:
            raise missing(format, writer) or ModuleNotFoundError(writer)
        if not keep or not set(keep) <= set(_FILES):
            raise ValueError(f"keep must be some of {', '.join(_FILES)}, got {show(keep)}")
        if not isinstance(self.blur, RandomDepthOfField):
            raise ValueError(f"blur must be a RandomDepthOfField, got {show(blur)}")
        signature = inspect.signature(read_depth)
        try:
            signature.bind("", **self.depth)
        except TypeError as error:
            raise ValueError(f"depth must be some of {', '.join([*signature.parameters][1:])}: {error}") from None
        if self.depth.get("kind") == "relative" and not {"near_m", "far_m"} <= self.depth.keys():
            raise ValueError(f"depth of kind 'relative' needs near_m and far_m in metres, got {show(self.depth)}")
        if threads is not None:
            torch.set_num_threads(whole("threads", threads, 1, 4096))

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Makes the shards of a batch; returns shard, key, image, error and processor seconds of each sample."""
        rows: list[dict[str, Any]] = []
        for shard, samples in zip(batch["shard"], batch["samples"], strict=True):
            notes = self.samples_of(shard, samples) or self._make(shard, samples)
            rows += [{"shard": int(shard), **row} for row in notes]
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}

    def _path_of(self, shard: int) -> Path:
        return self.out / f"shard-{int(shard):06d}{SUFFIXES[self.format]}"

    def samples_of(self, shard: int, samples: str) -> list[dict[str, Any]] | None:
        """Notes about the samples of a shard; None if it has to be made."""
        return samples_of(self._path_of(shard), self._source(samples))

    def settings(self) -> dict[str, Any]:
        """Everything except the rows that determines the shards, as JSON values."""
        own = {name: getattr(self, name) for name in ("format", "keep", "picture", "transfer", "seed", "depth")}
        lenses = [rendering.table.fingerprint() for rendering in self.blur.renderings]
        return {**own, "blur": repr(self.blur), "lenses": lenses}

    def _source(self, samples: str) -> str:
        """Digest of all that determines a shard: settings, samples, and size and time of their files."""
        files = {
            sample[name] for sample in json.loads(str(samples)) for name in ("image", "depth", "matte") if sample[name]
        }
        found = [os.stat(file) for file in sorted(files) if os.path.exists(file)]
        facts = [self.settings(), str(samples), [(file.st_size, file.st_mtime_ns) for file in found]]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()

    def _make(self, shard: int, samples: str) -> list[dict[str, Any]]:
        """Renders and writes one shard, which counts as incomplete without its notes; returns these."""
        path, source, records, rows = self._path_of(shard), self._source(samples), [], []
        for sample in json.loads(str(samples)):
            start, error = time.process_time(), ""
            try:
                records.append(self._record(**sample))
            except (OSError, ValueError, MemoryError, RuntimeError) as failure:  # torch's allocator raises RuntimeError
                error = str(failure) or type(failure).__name__
            row = {"key": sample["key"], "image": _text(sample["image"]), "error": _text(error)}
            rows.append({**row, "seconds": round(time.process_time() - start, 4)})
        with atomic_file(path) as temporary:
            if self.format == "webdataset":
                import webdataset

                with webdataset.TarWriter(str(temporary), mtime=0) as tar:  # the same records give the same bytes
                    for record in records:
                        tar.write(record)
            else:
                import pyarrow
                import pyarrow.parquet

                columns = [{"key": r.pop("__key__"), **r.pop("json"), **r} for r in records]
                pyarrow.parquet.write_table(pyarrow.Table.from_pylist(columns), temporary)
            path.with_suffix(".json").unlink(missing_ok=True)
        notes = {"bytes": path.stat().st_size, "source": source, "samples": rows}
        write_text(path.with_suffix(".json"), json.dumps(notes, indent=1))
        return rows

    def _record(
        self, key: str, image: str, depth: str | None, focus_m: float | None, f_number: float | None, matte: str | None
    ) -> dict[str, Any]:
        """One sample as WebDataset takes it: its key, the contents of its files by name, its parameters as ``json``."""
        source = read_image(image, self.transfer)
        metres = at_size_of(source.pixels, read_depth(depth or image, image=source, **self.depth))
        digest = hashlib.sha256(f"{self.seed} {key}".encode()).digest()
        drawn = self.blur.draw(torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1))
        camera = self.blur.camera.replace(
            focus_m=float(drawn["focus_m"]) if focus_m is None else focus_m,
            f_number=float(drawn["f_number"]) if f_number is None else f_number,
        )
        options = self.blur.renderings[int(drawn["table"])]
        cover = read_matte(matte, source.pixels.shape[-2:], source.window) if matte else source.matte
        with torch.no_grad():
            blurred = depth_of_field(source.pixels, metres, camera, matte=cover, **options.arguments())
        record: dict[str, Any] = {"__key__": key}
        with tempfile.TemporaryDirectory() as folder:
            for name, pixels in (("blurred", blurred), ("sharp", source.pixels)):
                if name in self.keep:
                    path = Path(folder, name + self.picture)
                    write_image(path, Picture(pixels, source.channels))
                    record[path.name] = path.read_bytes()
        if "depth" in self.keep:
            np.save(array := io.BytesIO(), metres[0, 0].numpy())
            record["depth.npy"] = array.getvalue()
        table, (height, width) = options.table, blurred.shape[-2:]
        numbers = {name: value for name, value in (vars(camera) | options.arguments()).items() if name != "table"}
        record["json"] = {
            **{name: float(value) if isinstance(value, Tensor) else value for name, value in numbers.items()},
            **{"table": table.name or table.family, "table_fingerprint": table.fingerprint()},
            "aperture": None if table.aperture is None else repr(table.aperture),
            **{
                "image": _text(image),
                "depth": depth and _text(depth),
                "matte": matte and _text(matte),
                "height": height,
                "width": width,
            },
            "largest_coc_px": float(camera.coc_px(metres, width).abs().nan_to_num().max()),
            **{"seed": self.seed, "torchdof": importlib.metadata.version("torchdof")},
        }
        return record


def _text(name: str) -> str:
    """A file name that UTF-8 can encode: other bytes become escapes."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
