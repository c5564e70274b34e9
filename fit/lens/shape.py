"""A named kernel shape fitted to a spot by least squares in the frequency domain."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.special import j0, j1

from torchdof.optics.psf import FAMILIES, LENGTHS, profile

from ..result import Array

__all__ = ["fit_shape"]

_RANGES = {"radius": (0.02, 1.3), "sigma": (0.01, 1.0), "r_c": (0.0, 1.3), "b": (-1.0, 20.0), "m": (0.5, 12.0)}
"""Where parameters may lie; lengths relative to the spot's outermost ray."""

_STEPS, _REACH = 400, 2.0  # the profile's samples, up to this many times the outermost ray
_KEEP = 1e-3  # weight of staying like the neighbour, so that parameters that hardly matter do not jump
_TRIES = 100


def fit_shape(
    family: str,
    frequency: Array,
    weight: Array,
    spot_transfer: Array,
    r: Array,
    light: Array,
    before: tuple[dict[str, float], float] | None = None,
) -> tuple[dict[str, float], float]:
    """Parameters of a named shape whose transfer function is nearest to a spot's.

    Args:
        family: A key of :data:`torchdof.optics.psf.FAMILIES` other than ``"radial"``.
        frequency: Frequencies ``[F]`` in cycles a pixel, > 0.
        weight: Weight of each.
        spot_transfer: The spot's transfer function there.
        r: Distances of its hits from the centre ``[R]``, in pixels.
        light: Share of the light of each hit.
        before: A neighbour's parameters and outermost radius: the start, scaled to this spot's radius, and a weak pull.

    Returns:
        Parameters, lengths in pixels, and the weighted squared error.

    Raises:
        ValueError: If the family is not a named shape.

    Example:
        >>> r = 5.0 * np.sqrt((np.arange(2000) + 0.5) / 2000)  # a disc of radius 5
        >>> frequency, light = np.linspace(0.01, 0.5, 50), np.full(2000, 1 / 2000)
        >>> spot_transfer = j0(2 * np.pi * np.outer(frequency, r)) @ light
        >>> params, _ = fit_shape("disc", frequency, np.ones(50), spot_transfer, r, light)
        >>> round(params["radius"], 2)
        5.0
    """
    if family not in FAMILIES or family == "radial":
        raise ValueError(f"family must be one of {', '.join(f for f in FAMILIES if f != 'radial')}, got {family!r}")
    names = FAMILIES[family]
    outermost, rms = float(r.max()), math.sqrt(float(light @ (r * r)))
    spans = np.array([outermost if name in LENGTHS else 1.0 for name in names])
    low, high = (np.array([_RANGES[name][side] for name in names]) for side in (0, 1))
    if family == "softm":  # a small radius with a wide edge and a large tilt would be a second branch
        low[0] = 0.5
    geometry = {"radius": math.sqrt(2) * rms, "sigma": 0.05 * rms, "r_c": 0.7 * rms, "b": 0.0, "m": 2.0}
    if family in ("gaussian", "ring"):
        geometry["sigma"] = rms / (math.sqrt(2) if family == "gaussian" else 2.0)
    starts = [np.array([geometry[name] for name in names]) / spans]
    if before is not None:  # lengths relative to the outermost ray carry over
        scaled = np.array([before[0][name] / (before[1] if name in LENGTHS else 1.0) for name in names])
        starts.insert(0, scaled)
    fine = (np.arange(_STEPS) + 0.5) * (_REACH * outermost / _STEPS)
    waves = j0(2.0 * np.pi * np.outer(frequency, fine))

    def transfer(scaled: Array) -> Array:
        params = dict(zip(names, scaled * spans, strict=True))
        if family == "gaussian":
            return np.asarray(np.exp(-2.0 * (np.pi * params["sigma"] * frequency) ** 2))
        if family == "disc":
            phase = 2.0 * np.pi * params["radius"] * frequency
            return np.asarray(2.0 * j1(phase) / phase)
        ring_light = profile(family, torch.from_numpy(fine), params).numpy() * fine
        return np.asarray(waves @ (ring_light / ring_light.sum()))

    def difference(scaled: Array) -> Array:
        misfit = weight * (transfer(scaled) - spot_transfer)
        return misfit if before is None else np.concatenate([misfit, _KEEP * (scaled - starts[0])])

    margin = 1e-6 * (high - low)
    fits = [
        least_squares(difference, np.clip(start, low + margin, high - margin), bounds=(low, high), max_nfev=_TRIES)
        for start in starts
    ]
    best = min(fits, key=lambda fit: fit.cost).x
    error = float(((weight * (transfer(best) - spot_transfer)) ** 2).sum())
    return {name: float(value) for name, value in zip(names, best * spans, strict=True)}, error
