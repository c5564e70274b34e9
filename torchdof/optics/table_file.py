"""Blur tables as JSON files: the schema, its checks, and the shipped tables."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..validation import fields, show

__all__ = ["SCHEMA", "VERSION", "fields_of", "find", "shipped"]

SCHEMA = "torchdof/blur-table"
VERSION = 3
READABLE = (1, 2, 3)  # versions that are read; 2 added "aperture", 3 added "field"
_FOLDER = Path(__file__).parent / "tables"
_REQUIRED = ("family", "unit", "coc", "params")
_OPTIONAL = ("name", "sensor_width_mm", "strength", "residual", "provenance", "aperture", "field")


def find(source: str | os.PathLike[str]) -> Path:
    """The file of a table: a path, or the name of a shipped table such as ``"sato_j15"``."""
    if not isinstance(source, str | os.PathLike):
        raise ValueError(f"source must be the name or the path of a blur table, got {show(source)}")
    path = Path(source)
    if not path.suffix and not path.exists():
        path = _FOLDER / f"{path}.json"
    if not path.is_file():
        names = ", ".join(shipped())
        raise FileNotFoundError(
            f"no blur table {str(source)!r}: neither a file nor one of the shipped ({names}); "
            "ideal lenses are BlurTable.disc() and BlurTable.gaussian()"
        )
    return path


def shipped() -> list[str]:
    """Names of the tables that come with torchdof, sorted."""
    return sorted(path.stem for path in _FOLDER.glob("*.json"))


def fields_of(data: Any) -> dict[str, Any]:
    """The fields in a file's data, as arguments of :class:`torchdof.BlurTable`."""
    if not isinstance(data, Mapping):
        raise ValueError(f"a blur table must be a dict, got {show(data)}")
    if not isinstance(data.get("schema"), str) or data["schema"] != SCHEMA:
        raise ValueError(f"schema must be {SCHEMA!r}, got {show(data.get('schema'))}; is this a blur table?")
    if not isinstance(data.get("version"), int) or data["version"] not in READABLE:
        readable = " or ".join(map(str, READABLE))
        raise ValueError(f"version must be {readable}, got {show(data.get('version'))}; update torchdof to read it")
    given = {name: value for name, value in data.items() if name not in ("schema", "version")}
    return fields("a blur table", given, _REQUIRED, _OPTIONAL)
