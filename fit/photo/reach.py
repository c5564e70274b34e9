"""How far a table that was measured at one focus and f-number reaches."""

from __future__ import annotations

import math

import torch

from torchdof.optics.blur_table import BlurTable
from torchdof.optics.camera import Camera
from torchdof.validation import show

from ..problems import FitError, warn
from ..validation import a_number

__all__ = ["check_reach"]


def check_reach(
    table: BlurTable, camera: Camera, near_m: float, far_m: float, width_px: int = 1920
) -> dict[str, float]:
    """Whether a table measured at one focus and f-number says anything about another use of it.

    A kernel is looked up by its signed circle of confusion, so a thin lens's table serves any focus and f-number. A
    real lens's aberrations change with both: the farther from what was measured, the less a table knows.

    Args:
        table: with the provenance that `fit_table` and `trace_table` write.
        camera: to render with.
        near_m: nearest depth of the scene, m.
        far_m: farthest depth of the scene, m; `inf` allowed.
        width_px: width of the image.

    Returns:
        Each over what was measured: "coc" (the largest circle of confusion of the scene over the largest measured on
        its side), "f_number" and "focus_m" (1 where the table does not know).

    Raises:
        FitError: the depths are not 0 < near <= far.

    Warns:
        FitWarning: of kind "outside measured", for each of the three that lies outside what was measured.

    Example:
        >>> table = BlurTable("disc", [-0.1, 0.1], {"radius": [0.1, 0.1]}, unit="mm", sensor_width_mm=36.0)
        >>> factors = check_reach(table, Camera(f_number=8.0), near_m=1.5, far_m=3.0)
        >>> factors["coc"] < 1
        True
    """
    for what, value, kind in (("table", table, BlurTable), ("camera", camera, Camera)):
        if not isinstance(value, kind):
            raise FitError(f"{what} must be a torchdof.{kind.__name__}, got {show(value)}")
    if any(isinstance(getattr(camera, name), torch.Tensor) for name in Camera.__dataclass_fields__):
        raise FitError("camera must hold plain numbers, got tensors; check one item of a batch at a time")
    a_number("width_px", width_px, 0, unit="pixels")
    plain = all(isinstance(z, int | float) and not isinstance(z, bool) for z in (near_m, far_m))
    if not plain or not 0 < near_m <= far_m or near_m > 1e300:
        raise FitError(f"depths must be 0 < near_m <= far_m, got {show(near_m)} and {show(far_m)}")
    factors = {"coc": 0.0, "f_number": 1.0, "focus_m": 1.0}
    if table.unit != "relative":
        ends = [float(near_m), math.inf if far_m > 1e300 else float(far_m)]
        depth = torch.tensor(ends, dtype=torch.float64)[None, None, None]
        for coc in (camera.coc_px(depth, width=width_px) / table.px_per_unit(width_px)).flatten().tolist():
            measured = max((abs(c) for c in table.coc.tolist() if c * coc > 0), default=0.0)
            factors["coc"] = max(factors["coc"], abs(coc) / measured if measured else math.inf if coc else 0.0)
    if factors["coc"] > 1.0001:
        largest = "the other side of focus" if math.isinf(factors["coc"]) else f"{factors['coc']:.2g} times the largest"
        text = f"the scene's blur is {largest} that was measured; beyond it kernels are scaled as a thin lens would"
        warn(text, "outside measured", number=factors["coc"])
    for name, most in (("f_number", 1.05), ("focus_m", 1.25)):
        measured_at, used_at = table.provenance.get(name), float(getattr(camera, name))
        known = isinstance(measured_at, int | float) and not isinstance(measured_at, bool)
        if not known or not 0 < measured_at < math.inf or math.isinf(used_at):
            continue
        factors[name] = used_at / measured_at
        if max(factors[name], 1 / factors[name]) > most:
            text = (
                f"the table was measured at {name} {measured_at:g} and is used at {used_at:g}; the size of the blur is "
                "right, its shape is that of the measured one"
            )
            warn(text, "outside measured", number=factors[name])
    return factors
