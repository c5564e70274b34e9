"""Makes blur tables of lens prescriptions by tracing rays."""

from .lens import Lens
from .trace import trace_table

__all__ = ["Lens", "trace_table"]
