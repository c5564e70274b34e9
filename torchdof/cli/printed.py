"""What commands print for programs: one JSON object a line."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

__all__ = ["json_line"]


def json_line(facts: Mapping[str, Any]) -> str:
    """Facts as JSON on one line. JSON has no infinity: numbers that are not finite are the texts inf, -inf and nan.

    Example:
        >>> json_line({"focus_m": float("inf"), "size": (3, 2)})
        '{"focus_m": "inf", "size": [3, 2]}'
    """
    return json.dumps(_finite(facts), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _finite(part) for name, part in value.items()}
    if hasattr(value, "tolist"):  # numpy's numbers and arrays
        return _finite(value.tolist())
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
