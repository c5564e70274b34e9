"""Accuracy of the fits on simulated captures and on real stars, as a table: `python tests/fit/report.py`."""

import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from simulator import Simulator  # noqa: E402

from torchdof.fit import fit_pair, fit_profile  # noqa: E402

SEEDS = 8


def row(what, camera, family, true, seeds=SEEDS, **options):
    """One line: bias and spread over seeds in percent, the stated error, and the warnings."""
    found, errors, said = [], [], set()
    for seed in range(seeds):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                fit = fit_pair(*camera.pair(family, true, seed), family, **options)
            except ValueError as error:
                said.add(type(error).__name__)
                continue
        said |= {type(w.message).__name__ for w in caught}
        found.append([float(fit.params[n]) for n in true])
        errors.append([float(fit.stderr[n]) for n in true])
    text = f"{what:34s}"
    for i, (name, value) in enumerate(true.items()):
        if found:
            values = np.array(found)[:, i] / value - 1
            text += f" {name}: bias {100 * values.mean():+.2f} % spread {100 * values.std():.2f} %"
            text += f" stated {100 * np.mean(errors, axis=0)[i] / value:.2f} % worst {100 * np.abs(values).max():.2f} %"
    print(text + ("  " + ", ".join(sorted(said)) if said else ""), flush=True)


def main():
    """Print everything."""
    n, r_c, sigma = 5.8116e-1, 4.2853e-4, np.sqrt(5.5114e-6)
    for r_max in (2e-3, 4e-3, 8e-3):
        r = np.linspace(0, r_max, 50)
        p = fit_profile(r, n * np.exp(-((r - r_c) ** 2) / (2 * sigma**2))).params
        off = max(abs(p["N"] / n - 1), abs(p["r_c"] / r_c - 1), abs(p["sigma"] / sigma - 1))
        print(f"Table 1, r to {1000 * r_max:g} mm: worst relative error {off:.1e}")
    for s in (0.5, 1.0, 2.0, 4.0, 8.0):
        row(f"gaussian {s:g} px at 40 dB", Simulator(), "gaussian", {"sigma": s})
    for s in (2.0, 4.0, 8.0):
        row(f"gaussian {s:g} px at 30 dB", Simulator(snr_db=30), "gaussian", {"sigma": s})
    ring = {"sigma": 4.0, "r_c": 1.5}
    row("ring at 40 dB (of the dot)", Simulator(), "ring", ring)
    row("ring at 40 dB (of the window's rms)", Simulator(snr_db=53.5), "ring", ring)
    row("ring without noise", Simulator(snr_db=None), "ring", ring, seeds=1)
    four = {"sigma": 4.0}
    for what, harm in {
        "exposure 0.6": {"exposure": 0.6},
        "offset 0.05": {"offset": 0.05},
        "shift 2 px": {"shift": (2.0, 0.0)},
        "magnification 1.05": {"magnification": 1.05},
        "JPEG q60, no other noise": {"jpeg": 60, "level": 0.7, "black": 0.02, "snr_db": None},
        "JPEG q60 at 40 dB": {"jpeg": 60, "level": 0.7, "black": 0.05},
        "8 bit": {"bits": 8, "level": 0.7, "black": 0.05},
        "sRGB left encoded": {"srgb": True, "level": 0.7},
        "clipped at 0.9": {"clip": 0.9},
    }.items():
        row(f"gaussian 4 px, {what}", Simulator(**harm), "gaussian", four)
    stars = Path(__file__).parents[1] / "data" / "defocused_stars"
    for file in sorted(stars.glob("*.npy")):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fits = {f: fit_pair(None, np.load(file, allow_pickle=False), f) for f in ("ring", "gaussian")}
        said = {type(w.message).__name__ for w in caught}
        text = ", ".join(f"{f} residual {100 * fit.residual:.1f} %" for f, fit in fits.items())
        print(f"{file.name[:26]}: {text}, asymmetry {fits['ring'].asymmetry:.2f}  {', '.join(sorted(said))}")


if __name__ == "__main__":
    main()
