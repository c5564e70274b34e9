"""Depth maps of any kind to metres along the optical axis: units, holes, files, reports, warnings, shots."""

from ..render.surfaces.edges import repair_edges
from ..render.surfaces.resample import at_size_of
from .holes import fill_holes
from .inspect import DepthReport, inspect_depth
from .kinds import depth_from_values
from .read import read_depth
from .relative import Scale, from_relative, solve_scale
from .sanity import DepthWarning, check
from .steady import Steady, SteadyFrames

__all__ = [
    "DepthReport",
    "DepthWarning",
    "Scale",
    "Steady",
    "SteadyFrames",
    "at_size_of",
    "check",
    "depth_from_values",
    "fill_holes",
    "from_relative",
    "inspect_depth",
    "read_depth",
    "repair_edges",
    "solve_scale",
]
