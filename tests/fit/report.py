"""Prints a table of the accuracy of the fits under camera faults: ``python tests/fit/report.py --draws 60``.

Columns: mean and standard deviation of the error of the fitted blur radius, the mean standard error that the fit
states, the share of draws whose error is below it (68 % is right), the residual over the noise, and warnings.
"""

import argparse
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from simulator import Simulator, result_and_warnings

from torchdof.fit import FitError, fit_pair
from torchdof.optics.psf import LENGTHS, pixel_kernels

FAMILIES = {
    "gaussian": {"sigma": 3.0},
    "disc": {"radius": 6.0},
    "ring": {"sigma": 3.0, "r_c": 4.0},
    "softm": {"radius": 7.0, "sigma": 0.8, "b": 0.8, "m": 3.0},
}
GOOD = {
    "40 dB": {},
    "30 dB": {"snr_db": 30},
    "JPEG 90": {"jpeg": 90, "level": 0.7, "black": 0.02},
    "Bayer mosaic": {"bayer": True},
    "dot of 4 px": {"dot_radius": 4.0},
}
FAULTY = {
    "tone curve": {"tone": 0.5, "level": 0.8},
    "weak tone curve": {"tone": 0.2, "level": 0.8},
    "left sRGB encoded": {"srgb": True, "level": 0.7},
    "misfocus 1.4 px": {"misfocus": 1.4},
    "clipped at 0.9": {"clip": 0.9},
}


def size_of(family, params):
    """Radius in px of the uniform disc with the second moment of a PSF, measured on an eightfold enlarged kernel."""
    drawn = {k: torch.tensor((8.0 if k in LENGTHS else 1.0) * v, dtype=torch.float64) for k, v in params.items()}
    kernel = pixel_kernels(family, drawn).numpy()
    away = np.arange(kernel.shape[-1]) - kernel.shape[-1] // 2
    return float(np.sqrt(2 * (kernel * (away[:, None] ** 2 + away**2)).sum())) / 8.0


def row(camera, family, draws):
    """The numbers of one condition as text, and the number of warnings of each kind."""
    true, found, kinds = size_of(family, FAMILIES[family]), [], Counter()
    for seed in range(draws):
        # the error depends on the dot's place among a mosaic's pixels, so that each draw gets another place
        camera = replace(camera, place=tuple(np.random.default_rng(900 + seed).uniform(-1, 1, 2)))
        fit, problems = result_and_warnings(partial(fit_pair, *camera.pair(family, FAMILIES[family], seed), family))
        kinds.update({problem.kind for problem in [*problems, *([fit] if isinstance(fit, FitError) else [])]})
        if not isinstance(fit, FitError):
            found.append((fit.radius / true - 1, fit.radius_stderr / true, fit.residual_over_noise))
    error, stated, noise = np.array(found).reshape(-1, 3).T
    numbers = (100 * error.mean(), 100 * error.std(), 100 * stated.mean(), 100 * np.mean(np.abs(error) < stated))
    return "{:+6.2f} | {:5.2f} | {:5.2f} | {:3.0f} | {:4.2f}".format(*numbers, noise.mean()), dict(kinds)


def main():
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=4, help="captures of a condition without faults")
    parser.add_argument("--families", default=",".join(FAMILIES), help="families of the blur, separated by commas")
    arguments = parser.parse_args()
    print("| condition | off, % | spread, % | stated, % | within, % | x noise | warnings |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for family in arguments.families.split(","):
        for condition, harm in (GOOD | FAULTY).items():
            draws = arguments.draws if condition in GOOD else max(arguments.draws // 10, 4)
            numbers, kinds = row(Simulator(**{"size": 91, **harm}), family, draws)
            print(f"| {family}, {condition} | {numbers} | {kinds} |", flush=True)


if __name__ == "__main__":
    main()
