"""Fits kernels to photographs of a dot or traced lenses, and makes blur tables; lengths in the caller's unit."""

from torchdof.extras import missing

try:
    import scipy  # noqa: F401
    import threadpoolctl  # noqa: F401
except ModuleNotFoundError as error:
    raise missing("torchdof.fit", error.name) or error from None

from .lens.trace import trace_table
from .photo.across import table_of_dots
from .photo.captures import Capture, Captures
from .photo.family_choice import highlight_psnr, natural_psnr
from .photo.manifest import read_captures
from .photo.pair import fit_pair
from .photo.profile_fit import blur_strength, fit_profile
from .photo.table import TableFit, fit_captures, fit_table
from .problems import FitError, FitWarning
from .result import BlurFit

__all__ = [
    "BlurFit",
    "Capture",
    "Captures",
    "FitError",
    "FitWarning",
    "TableFit",
    "blur_strength",
    "fit_captures",
    "fit_pair",
    "fit_profile",
    "fit_table",
    "highlight_psnr",
    "natural_psnr",
    "read_captures",
    "table_of_dots",
    "trace_table",
]
