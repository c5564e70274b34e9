"""One shard of a data set: images read, blurred by random or given cameras, and written whole or not at all.

A shard is named by its number and what is in it depends on nothing but its row and the seed. So a run that was stopped
goes on with the shards that are missing, and ends with the files that it would have ended with undisturbed.
"""

import dataclasses
import hashlib
import importlib.metadata
import io
import json
import os
import tarfile
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from ..augmentation import RandomDepthOfField
from ..depth.holes import resolve_holes
from ..depth.reading import read_depth
from ..depth.relative import from_relative
from ..depth.size import at_size_of
from ..io.atomic import whole_file
from ..io.images import Picture, read_image, read_values, write_image
from ..io.transfer import Transfer
from ..validation import show, whole
from .pairs import Pair

__all__ = ["Format", "RenderShards", "shard_name", "shard_rows"]

Format = Literal["webdataset", "parquet"]

_SUFFIXES: dict[str, str] = {"webdataset": ".tar", "parquet": ".parquet"}
_METRIC = ("kind", "scale", "offset", "unknown", "fov_x_deg", "fill", "channel")
_RELATIVE = ("kind", "near_m", "far_m", "relative_kind", "value_range", "unknown", "fill", "channel")
_KEPT = ("blurred", "sharp", "depth")


def shard_name(shard: int, format: Format) -> str:
    """File name of a shard.

    Example:
        >>> shard_name(12, "webdataset")
        'shard-000012.tar'
    """
    return f"shard-{shard:06d}{_SUFFIXES[format]}"


def shard_rows(pairs: Sequence[Pair], per_shard: int = 64, copies: int = 1) -> list[dict[str, Any]]:
    """Rows for ``ray.data.from_items``, one for each shard.

    Args:
        pairs: Images and depths.
        per_shard: Samples in a shard.
        copies: How often each image is blurred, each time by another camera.

    Returns:
        ``{"shard": number, "samples": JSON}``; a sample is a pair and its key.

    Raises:
        ValueError: If there are no pairs, or a number is not at least 1.

    Example:
        >>> [row["shard"] for row in shard_rows([Pair("a.png"), Pair("b.png")], per_shard=3, copies=2)]
        [0, 1]
    """
    if not pairs:
        raise ValueError("pairs must be at least one Pair, got none")
    whole("per_shard", per_shard, 1, 10**9)
    whole("copies", copies, 1, 10**9)
    samples = [
        {"key": f"{n * copies + copy:08d}", **dataclasses.asdict(pair)}
        for n, pair in enumerate(pairs)
        for copy in range(copies)
    ]
    parts = [samples[start : start + per_shard] for start in range(0, len(samples), per_shard)]
    return [{"shard": number, "samples": json.dumps(part)} for number, part in enumerate(parts)]


class RenderShards:
    """Makes shards: a callable for ``ray.data.Dataset.map_batches``, which needs nothing of Ray itself.

    Each row of a batch is a shard of :func:`shard_rows`. A shard that is there already is not made again. An input that
    cannot be read or rendered is left out and listed in ``shard-NNNNNN.json`` beside the shard, with its error.

    A WebDataset shard holds for each key ``KEY.blurred.png``, ``KEY.sharp.png``, ``KEY.depth.npy`` (metres, float32)
    and ``KEY.json`` with all parameters; a Parquet shard the same as columns, pictures as the bytes of their files.

    Args:
        out: Folder of the shards; it must be there.
        blur: Draws focus, f-number and lens, and renders; its ``p`` does not count, every sample is blurred.
        depth: How to read depth maps: keyword arguments of :func:`torchdof.depth.reading.read_depth`; or, of depth
            without a scale, ``{"kind": "relative", "near_m": 1.0, "far_m": 8.0}``, with ``relative_kind``,
            ``value_range`` and ``unknown`` as in :func:`torchdof.depth.from_relative`, and ``fill`` and ``channel``.
        format: "webdataset" or "parquet" (which needs pyarrow).
        keep: What is written of each sample: of "blurred", "sharp" and "depth".
        seed: Of the draws; a sample's own draw depends on it and on its key alone.
        transfer: How images are encoded; None takes integers as sRGB and floats as linear.
        picture: Suffix of the pictures: ".png" (8 bits, sRGB) or ".exr" (half, linear).
        threads: Threads of one process; Ray gives each process a core.

    Raises:
        ValueError: If an argument is not as described.
        FileNotFoundError: If there is no such folder.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(folder + "/a.png", Picture(torch.rand(1, 3, 8, 12)))
        ...     np.save(folder + "/a.npy", np.full((8, 12), 2.0))
        ...     (row,) = shard_rows([Pair(folder + "/a.png", folder + "/a.npy")])
        ...     made = RenderShards(folder)({name: np.array([value]) for name, value in row.items()})
        ...     made["error"].tolist(), sorted(os.listdir(folder))
        ([''], ['a.npy', 'a.png', 'shard-000000.json', 'shard-000000.tar'])
    """

    def __init__(
        self,
        out: str | os.PathLike[str],
        blur: RandomDepthOfField | None = None,
        *,
        depth: Mapping[str, Any] | None = None,
        format: Format = "webdataset",
        keep: Sequence[str] = _KEPT,
        seed: int = 0,
        transfer: Transfer | None = None,
        picture: Literal[".png", ".exr"] = ".png",
        threads: int | None = None,
    ) -> None:
        self.out = Path(out)
        if not self.out.is_dir():
            raise FileNotFoundError(f"{out}: there is no such folder; make it first")
        if format not in _SUFFIXES:
            raise ValueError(f"format must be 'webdataset' or 'parquet', got {show(format)}")
        if not keep or isinstance(keep, str) or not set(keep) <= set(_KEPT):
            raise ValueError(f"keep must be some of {', '.join(_KEPT)}, got {show(keep)}")
        if picture not in (".png", ".exr"):
            raise ValueError(f"picture must be '.png' or '.exr', got {show(picture)}")
        self.blur = RandomDepthOfField() if blur is None else blur
        if not isinstance(self.blur, RandomDepthOfField):
            raise ValueError(f"blur must be a RandomDepthOfField, got {show(blur)}")
        self.depth = dict(depth or {})
        known = _RELATIVE if self.depth.get("kind") == "relative" else _METRIC
        if not set(self.depth) <= {*known} or (known is _RELATIVE and not {"near_m", "far_m"} <= set(self.depth)):
            needed = ", with near_m and far_m" if known is _RELATIVE else ""
            raise ValueError(f"depth must be some of {', '.join(known)}{needed}, got {', '.join(map(str, self.depth))}")
        self.format: Format = format
        self.keep = tuple(keep)
        self.seed = whole("seed", seed, 0, 2**62)
        self.transfer, self.picture = transfer, picture
        if threads is not None:
            torch.set_num_threads(whole("threads", threads, 1, 4096))

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Make the shards of a batch.

        Args:
            batch: Columns ``shard`` and ``samples``.

        Returns:
            Columns ``shard``, ``key``, ``image``, ``error`` ("" where there is none) and ``seconds`` of the processor:
            a row for each sample.

        Raises:
            OSError: If a shard cannot be written.
        """
        rows: list[dict[str, Any]] = []
        for shard, samples in zip(batch["shard"], batch["samples"], strict=True):
            rows += self._make(int(shard), json.loads(str(samples)))
        columns = {"shard": np.int64, "key": object, "image": object, "error": object, "seconds": np.float64}
        return {name: np.array([row[name] for row in rows], dtype=kind) for name, kind in columns.items()}

    def settings(self) -> dict[str, Any]:
        """All that the shards depend on beside their rows, as JSON holds it."""
        tables = {item.table.fingerprint(): item.table.name or item.table.family for item in self.blur.renderings}
        options = self.blur.renderings[0].arguments()
        return {
            "format": self.format,
            "keep": [*self.keep],
            "picture": self.picture,
            "transfer": self.transfer,
            "seed": self.seed,
            "focus_m": [*self.blur.focus_m],
            "f_number": [*self.blur.f_number],
            "camera": repr(self.blur.camera),
            "tables": [*tables.values()],
            "table_fingerprints": [*tables],
            "options": {name: value for name, value in options.items() if name != "table"},
            "depth": self.depth,
        }

    def _make(self, shard: int, samples: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
        """Render one shard and write it, or read what was written of it."""
        path = self.out / shard_name(shard, self.format)
        notes = path.with_suffix(".json")
        if path.is_file() and notes.is_file():
            return list(json.loads(notes.read_text(encoding="utf-8")))
        records, rows = [], []
        for sample in samples:
            start = time.process_time()
            error = ""
            try:
                records.append(self._sample(sample))
            except (OSError, ValueError, MemoryError) as broken:
                error = str(broken) or type(broken).__name__
            seconds = time.process_time() - start
            rows.append({"shard": shard, "key": sample["key"], "image": sample["image"], "error": error})
            rows[-1]["seconds"] = round(seconds, 4)
        with whole_file(notes) as part:
            part.write_text(json.dumps(rows, indent=1), encoding="utf-8")
        with whole_file(path) as part:  # last: a shard that is there is complete
            (_write_tar if self.format == "webdataset" else _write_parquet)(part, records)
        return rows

    def _sample(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """One sample by the names of its files, beside its parameters."""
        source = read_image(sample["image"], self.transfer)
        depth = at_size_of(source.pixels, self._metres(sample["depth"] or sample["image"]))
        drawn = self._drawn(sample, tuple(source.pixels.shape))
        with torch.no_grad():
            blurred = self.blur(source.pixels, depth, params=drawn, transfer="linear")
        camera = self.blur.camera.replace(focus_m=drawn["focus_m"], f_number=drawn["f_number"])
        options = self.blur.renderings[int(drawn["table"])]
        record: dict[str, Any] = {"key": sample["key"]}
        pictures = {"blurred": blurred, "sharp": source.pixels}
        for name in (name for name in self.keep if name in pictures):
            record[name + self.picture] = self._encoded(pictures[name], source.channels)
        if "depth" in self.keep:
            file = io.BytesIO()
            np.save(file, depth[0, 0].numpy())
            record["depth.npy"] = file.getvalue()
        record["json"] = {
            "image": sample["image"],
            "depth": sample["depth"],
            "height": blurred.shape[-2],
            "width": blurred.shape[-1],
            "focus_m": float(drawn["focus_m"]),
            "f_number": float(drawn["f_number"]),
            "focal_length_mm": float(camera.focal_length_mm),
            "sensor_width_mm": float(camera.sensor_width_mm),
            "focus_breathing": camera.focus_breathing,
            "table": options.table.name or options.table.family,
            "table_fingerprint": options.table.fingerprint(),
            "aperture": None if options.table.aperture is None else repr(options.table.aperture),
            "camera": repr(camera),
            "tolerance": options.tolerance,
            "occlusion": options.occlusion,
            "method": options.method,
            "depth_edges": options.depth_edges,
            "largest_coc_px": float(camera.coc_px(depth, blurred.shape[-1]).abs().nan_to_num().max()),
            "seed": self.seed,
            "torchdof": importlib.metadata.version("torchdof"),
        }
        return record

    def _metres(self, path: str) -> Tensor:
        """Depth from a file, ``[1, 1, h, w]``, without holes."""
        how = dict(self.depth)
        if how.get("kind") != "relative":
            return read_depth(path, **how)
        fill, channel = how.pop("fill", None), how.pop("channel", None)
        how["kind"] = how.pop("relative_kind", "disparity")
        return resolve_holes(from_relative(read_values(path, channel), **how), path, fill)[0]

    def _drawn(self, sample: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, Tensor]:
        """The parameters of a sample: its own draw, with what is given put in its place."""
        own = hashlib.sha256(f"{self.seed} {sample['key']}".encode()).digest()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int.from_bytes(own[:8], "little") >> 1)
            drawn = self.blur.generate_parameters(shape)
        for name in ("focus_m", "f_number"):
            if sample[name] is not None:
                drawn[name] = torch.tensor([sample[name]])
        return {**drawn, "batch_prob": torch.ones(1)}

    def _encoded(self, pixels: Tensor, channels: tuple[str, ...]) -> bytes:
        """The bytes of a picture's file."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"picture{self.picture}"
            write_image(path, Picture(pixels, channels))
            return path.read_bytes()


def _write_tar(path: Path, records: Sequence[dict[str, Any]]) -> None:
    """A WebDataset shard; the same records give the same bytes."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for record in records:
            for name, value in record.items():
                if name == "key":
                    continue
                data = json.dumps(value).encode() if name == "json" else value
                member = tarfile.TarInfo(f"{record['key']}.{name}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))


def _write_parquet(path: Path, records: Sequence[dict[str, Any]]) -> None:
    """A Parquet shard: pictures as bytes, each parameter a column."""
    import pyarrow
    import pyarrow.parquet

    rows = [{**{k: v for k, v in record.items() if k != "json"}, **record["json"]} for record in records]
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), path)
