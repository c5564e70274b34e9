"""Whatever depth people have, as metres along the optical axis: kinds of numbers, holes, files, sanity."""

from .holes import fill_holes
from .kinds import depth_from_values
from .reading import read_depth
from .relative import Scale, from_relative, solve_scale
from .sanity import DepthWarning, check

__all__ = [
    "DepthWarning",
    "Scale",
    "check",
    "depth_from_values",
    "fill_holes",
    "from_relative",
    "read_depth",
    "solve_scale",
]
