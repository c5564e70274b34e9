"""Prints a table of the accuracy of the fits under camera faults: ``python tests/fit/report.py --draws 60``.

Each row is one condition, with these columns:

| column | meaning |
| --- | --- |
| bias, % | mean error of the fitted blur radius |
| spread, % | its standard deviation over the draws |
| stated, % | mean standard error that the fit states |
| within, % | share of draws whose error is below the stated one; 68 % is right |
| x noise | residual over the noise |
| warnings | kinds of warnings and errors, with their number |
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
    "50 dB": {"snr_db": 50},
    "shot noise": {"snr_db": 50, "full_well": 5000.0},
    "Bayer": {"bayer": True},
    "JPEG 90": {"jpeg": 90, "level": 0.7, "black": 0.02},
    "Bayer, JPEG 90": {"bayer": True, "jpeg": 90, "level": 0.7, "black": 0.02},
    "breathing 3 %": {"magnification": 1.03},
    "texture 2 %": {"texture": 0.02},
    "uneven light 20 %": {"uneven": 0.2},
    "soft lens 0.7 px": {"edge_sigma": 0.7},
    "dot 4 px": {"dot_radius": 4.0},
    "dot 20 px": {"dot_radius": 20.0, "size": 131},
    "Bayer, half the size": {"bayer": True, "magnification": 0.5},
}
FAULTY = {
    "tone curve": {"tone": 0.5, "level": 0.8},
    "weak tone curve": {"tone": 0.2, "level": 0.8},
    "weak tone curve, JPEG 90": {"tone": 0.2, "level": 0.8, "jpeg": 90, "black": 0.02},
    "weak tone curve, soft lens 0.6 px": {"tone": 0.2, "level": 0.8, "edge_sigma": 0.6},
    "tone curve, Bayer": {"tone": 0.5, "level": 0.8, "bayer": True},
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


def measure(camera, family, draws):
    """Relative errors, stated relative errors, residuals over noise `[draws, 3]`; and counts of warnings by kind."""
    true, found, kinds = size_of(family, FAMILIES[family]), [], Counter()
    for seed in range(draws):
        # the error depends on the dot's place among a mosaic's pixels, so that each draw gets another place
        camera = replace(camera, place=tuple(np.random.default_rng(900 + seed).uniform(-1, 1, 2)))
        # the fit must find breathing itself; a target at twice the distance is a known magnification
        known = camera.magnification if camera.magnification < 0.9 else 1.0
        pair = camera.pair(family, FAMILIES[family], seed)
        fit, problems = result_and_warnings(partial(fit_pair, *pair, family, magnification=known))
        refused = isinstance(fit, FitError)
        kinds.update({problem.kind for problem in [*problems, *([fit] if refused else [])]})
        if not refused:
            found.append((fit.radius / true - 1, fit.radius_stderr / true, fit.residual_over_noise))
    return np.array(found).reshape(-1, 3), kinds


def print_row(condition, found, kinds):
    """Prints one line of the table."""
    if len(found):
        error, stated, noise = found.T
        numbers = (100 * error.mean(), 100 * error.std(), 100 * stated.mean(), 100 * np.mean(np.abs(error) < stated))
        text = "{:34s} | {:+6.2f} | {:5.2f} | {:5.2f} | {:3.0f} | {:4.2f}".format(condition, *numbers, noise.mean())
    else:
        text = condition + 5 * " | "
    print("|", text, "|", ", ".join(f"{name} {count}" for name, count in sorted(kinds.items())), "|", flush=True)


def main():
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--draws",
        type=int,
        default=4,
        help="captures per condition, 60 for the column within; faulty conditions get a tenth, at least 4",
    )
    parser.add_argument("--families", default=",".join(FAMILIES), help="families of the blur, separated by commas")
    arguments = parser.parse_args()
    print("| condition | bias, % | spread, % | stated, % | within, % | x noise | warnings |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for family in arguments.families.split(","):
        few = max(arguments.draws // 10, 4)
        for condition, harm in (GOOD | FAULTY).items():
            camera, draws = Simulator(**{"size": 91, **harm}), arguments.draws if condition in GOOD else few
            print_row(f"{family}, {condition}", *measure(camera, family, draws))


if __name__ == "__main__":
    main()
