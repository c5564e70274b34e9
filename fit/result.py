"""The result of a fit: parameters with calibrated errors, and residuals."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torchdof.optics.aperture import Aperture

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class BlurFit:
    """A fitted kernel, its errors and its residual.

    Attributes:
        family: "gaussian", "ring", "disc", "softm" or "radial"; or, where the blur is not round, "polygon" or "image":
            a disc of `params["radius"]` seen through the `aperture`.
        params: the family's parameters (see `torchdof.optics.psf.FAMILIES`), lengths in the caller's unit (pixels for
            `fit_pair`). Floats, except the array "values" [P] of `radial`. A profile fit also has the strength "N".
        stderr: one standard error for each parameter, calibrated against repeated simulated captures.
        radius: of the uniform disc with the same second moment as the PSF (forward model), px; NaN for a profile.
        radius_stderr: its standard error. The radius is well determined even if single parameters are correlated.
        residual: norm of (data - model) over norm of (data above background): 0 is a perfect fit.
        noise: the expected noise in the data, relative to the same norm. NaN if unknown.
        covariance: covariance of the parameters in `names` [n, n].
        names: the order of `covariance`; also includes other fitted parameters ("dx", "dy", "magnification").
        model: "forward", "ratio" or "profile".
        gain: the fitted exposure ratio between the pictures (forward model), else 1.
        background: the fitted level under the blurred dot (forward model), else 0.
        shift: the fitted displacement (x, y) of the blurred dot against the sharp one, px.
        centre: (x, y) of the blurred dot in its picture, px from the centre of pixel (0, 0).
        magnification: the fitted size of the dot in the blurred picture over its size in the sharp one.
        aperture: the lens's opening as seen in the defocused picture; None for a round kernel.
        asymmetry: share of the blur's light that depends on the angle but is not in the kernel; NaN if unknown.
        why: one sentence on the choice of the family.
        samples: radii and strengths [2, n], for plotting; curve: the fit at radii [2, m].
    """

    family: str
    params: dict[str, float | Array]
    stderr: dict[str, float | Array]
    residual: float
    noise: float
    covariance: Array
    names: tuple[str, ...]
    model: str
    gain: float = 1.0
    background: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    centre: tuple[float, float] = (0.0, 0.0)
    magnification: float = 1.0
    asymmetry: float = math.nan
    radius: float = math.nan
    radius_stderr: float = math.nan
    why: str = ""
    aperture: Aperture | None = None
    samples: Array = field(default_factory=lambda: np.zeros((2, 0)), repr=False)
    curve: Array = field(default_factory=lambda: np.zeros((2, 0)), repr=False)

    @property
    def residual_over_noise(self) -> float:
        """Residual over noise: about 1 if the model explains everything."""
        return self.residual / self.noise if self.noise > 0 else math.nan

    def kernel_params(self) -> dict[str, float | Array]:
        """Parameters for `torchdof.optics.psf`, that is, without the strength N and the aperture's parameters."""
        return {name: value for name, value in self.params.items() if name not in ("N", "rotation_deg", "curvature")}

    def summary(self) -> str:
        """A few lines of text: each parameter with its error, the residual against the noise, why the family."""
        lines = [f"{self.family} ({self.model})"]
        for name, value in self.params.items():
            array_text = f"  {name}: {np.size(value)} numbers, largest {np.max(value):.4g}"
            lines.append(array_text if np.ndim(value) else f"  {name} = {value:.6g} ± {self.stderr[name]:.2g}")
        lines.append(f"  residual {100 * self.residual:.2f} %, {self.residual_over_noise:.2f} x the noise")
        if self.model == "forward":
            (x, y), size = self.shift, self.magnification
            lines.append(f"  gain {self.gain:.4g}, shift ({x:+.2f}, {y:+.2f}) px, magnification {size:.4f}")
        return "\n".join([*lines, f"  {self.why}"]).rstrip()
