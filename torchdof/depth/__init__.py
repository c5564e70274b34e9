"""Whatever depth people have, as metres along the optical axis: kinds of numbers, holes, files."""

from .edges import repair_edges
from .holes import fill_holes
from .kinds import depth_from_values
from .reading import read_depth
from .size import at_size_of

__all__ = ["at_size_of", "depth_from_values", "fill_holes", "read_depth", "repair_edges"]
