"""Capture to radial profile to fitted kernel to blur table: lengths in, lengths out, in the caller's unit."""

from .gaussian import fit_profile
from .pair import fit_pair
from .result import BlurFit

__all__ = ["BlurFit", "fit_pair", "fit_profile"]
