"""From a lens prescription, by tracing rays, to a blur table."""

from .lens import Lens
from .trace import trace_table

__all__ = ["Lens", "trace_table"]
