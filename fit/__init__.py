"""Capture to radial profile to fitted kernel to blur table: lengths in, lengths out, in the caller's unit."""

from .capture import Capture, Captures, read_captures, read_pair
from .choose import natural_psnr
from .gaussian import fit_profile
from .pair import fit_pair
from .problems import FitError, FitWarning
from .profile import blur_strength, polar_samples
from .result import BlurFit
from .scale import check_reach
from .table import TableFit, fit_captures, fit_table
from .trace import trace_table

__all__ = [
    "BlurFit",
    "Capture",
    "Captures",
    "FitError",
    "FitWarning",
    "TableFit",
    "blur_strength",
    "check_reach",
    "fit_captures",
    "fit_pair",
    "fit_profile",
    "fit_table",
    "natural_psnr",
    "polar_samples",
    "read_captures",
    "read_pair",
    "trace_table",
]
