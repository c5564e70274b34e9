"""Whether pictures of a dot are in linear light, and the sharp one in focus: noise, edge and residual tell."""

from __future__ import annotations

import numpy as np
import torch

from torchdof.io.transfer import decode, encode

from ..problems import warn
from ..result import Array
from .diagnostics import left_open, unexplained
from .dot import Dot, inner_pixels
from .forward import Forward, Solution
from .noise import fine_variance, noise_of, rounding_of
from .source import UNFOCUSED_PX, Edge, soft_edge

__all__ = ["EXPLAINED", "check_focus", "check_levels", "check_linearity", "check_noise"]

EXPLAINED = 1.15
"""Misfit of an ideal dot, over the noise, up to which it explains a sharp picture."""

_SENSOR_BLUR_PX = 0.7  # sigma of the edge that demosaicing, a filter before the sensor or a good lens leave in focus
_MATTERS = 0.02  # share of the kernel's size
_ENCODED = 0.7
_STEEP, _CERTAIN = 0.03, 4.0  # an S-curve's least share of the dot's level, and in standard errors
_TOGETHER = 1.9  # neighbouring second differences share pixels: their mean square is as uncertain as of so many fewer
_MIDDLING, _FEWEST, _LOUDER = (0.3, 0.7), 60, 1.3
_DRAWN = 1e-3  # of the level; less is left of pictures without noise, whose edges were drawn in another way
_BENT, _BENT_CHI = 0.075, 30.0  # of a curve of 20 %, what the fit does not take up; chi squared of two parameters
_STEEP_TOO, _BENT_CHI_TOO = 0.008, 18.0  # the same where the sharp dot's edge agrees
_CURVED, _CURVED_CHI = 0.03, 11.0  # half of what a curve of 20 % leaves at the expected size; once in 2000 by chance
_RESIZED = 0.015  # another magnification than that by so much is not a weak tone curve, which makes it 1.002 to 1.006
_CLEARER = 4.0  # chi squared by which a curve explains more than another magnification of the dot


def check_linearity(still: Array, dot: Dot, edge: Edge, file: str | None) -> bool:
    """Whether a sharp picture seems to be in linear light, by its noise and its dot's edge; warns where it does not."""
    text, number = "", 0.0
    inside = inner_pixels(still, dot)
    if inside is not None:
        bright = fine_variance(still, inside)
        rounding = rounding_of(still[still > dot.background + 0.5 * dot.peak])
        # light only makes noise grow with the level; 4 standard errors of the noise's own estimate are allowed
        most = (1 + 4 / np.sqrt(int(inside.sum() / _TOGETHER))) * np.sqrt(bright + rounding)
        if dot.noise > max(most, 1e-4 * dot.peak):
            number = dot.noise / max(float(np.sqrt(bright)), 1e-9 * dot.peak)
            text = (
                f"the dark paper has {number:.1f} times the noise of the white dot, as in a picture that is left sRGB "
                "encoded; is the image linear? Decode it first"
            )
    if not text and edge.steepness > max(_STEEP, _CERTAIN * edge.steepness_error):
        number = edge.steepness
        text = (
            f"the dot's edge is steeper than pixels can be, by {100 * number:.0f} % of its level: a tone curve "
            "(an S-curve, a picture style) or sharpening was applied. The kernel comes out too small; develop without "
            "them"
        )
    if not text and edge.misfit >= EXPLAINED:
        bent = soft_edge(still, dot, fit_exponent=True)
        if bent.exponent < _ENCODED and bent.rms < 0.75 * edge.rms:
            number = bent.exponent
            text = (
                f"the dot's edge is that of light to the power {number:.2f}, as in a picture that is left sRGB "
                "encoded (about 0.45); is the image linear? Decode it first"
            )
    if text:
        warn(text, "not linear", file=file, number=number)
    return not text


def check_noise(pair: Forward, solution: Solution, level: float, file: str | None) -> bool:
    """Whether the noise is not largest at middling levels; warns where it is, as light's grows along a straight line.

    `level` is that of the sharp dot.
    """
    residual = np.where(pair.used, pair.data - np.nan_to_num(solution.model), 0.0)
    share = _light(solution, level)
    middling = (share > _MIDDLING[0]) & (share < _MIDDLING[1]) & pair.used
    count = int(middling.sum())
    if count < _FEWEST:
        return True
    found = fine_variance(residual, middling)
    expected = noise_of(pair.data) ** 2 + pair.shot_noise * solution.gain * level * float(share[middling].mean())
    if not expected > 0:  # a file of few levels, which hide the paper's noise
        return True
    expected += rounding_of(pair.data[middling])
    # second differences of neighbours go together: a third of them is independent
    most = _LOUDER * (1 + 4 * np.sqrt(2 * 3 / count))
    if found > most * expected and found > (_DRAWN * level) ** 2:
        louder = float(np.sqrt(found / expected))
        text = (
            f"the noise at middling levels is {louder:.1f} times what paper and dot have: "
            "a tone curve (an S-curve, a picture style), or compression. The kernel's size may be off by 15 %; develop "
            "without them"
        )
        warn(text, "not linear", file=file, number=louder)
        return False
    return True


def check_levels(pair: Forward, solution: Solution, held: Solution, edge: Edge, file: str | None) -> None:
    """Warn where a tone curve would explain what a fit leaves.

    No kernel makes all places of one level brighter, and all of another darker. A tone curve does, also one so weak
    that the residual hardly grows. What the fit's own parameters could have taken up is left out. In a JPEG less shows
    it; there the sharp dot's edge, a little steeper than pixels can be, is a second witness. And a fitted
    magnification takes up most of it: so what the dot leaves at its expected size is looked at, too. Where a curve
    explains more of that than another size does, it is said.

    `held` is the solution with the magnification that was expected, `edge` that of the sharp dot.
    """
    curves = _curves(pair, solution, edge.level)
    found, spread = unexplained(pair, solution, curves)
    seen = left_open(pair, solution, curves)
    bend = np.linalg.lstsq(seen.T @ seen, found, rcond=None)[0]
    chi_squared = float(found @ np.linalg.pinv(spread) @ found)
    steep = edge.steepness / max(edge.steepness_error, np.finfo(float).tiny)
    agrees = edge.steepness > _STEEP_TOO and steep > 1 and chi_squared + steep**2 > _BENT_CHI_TOO
    resized = abs(solution.moves["magnification"] / held.moves["magnification"] - 1) > _RESIZED
    bent = float(np.linalg.norm(bend)) > _BENT and (chi_squared > _BENT_CHI or agrees)
    if bent or (not resized and _curved(pair, held, edge.level, steep)):
        text = (
            "what the fit leaves goes with the level, "
            + ("" if bent else "were the dot as large as expected, ")
            + "as under a tone curve (an S-curve, a picture style): then the kernel is 5 % too small and more; develop "
            "without it. Colours that are blurred unlike each other leave as much (colours = 'each'), and a blur that "
            f"is not of family {solution.family!r}"
        )
        warn(text, "not linear", file=file, number=float(bend[1]))


def _curved(pair: Forward, held: Solution, level: float, steep: float) -> bool:
    """Whether an S-curve explains what the expected magnification leaves, and better than another one does.

    The sharp dot's edge, so many standard errors steeper than pixels can be, speaks for the curve, too.
    """
    larger = held.gain * pair.move_columns(held.moves, ("magnification",), pair.kernel(held))[0]
    basis = np.stack([_curves(pair, held, level)[:, 1], larger], axis=1)
    found, spread = unexplained(pair, held, basis)
    contrast, size = np.sign(found) * found**2 / np.maximum(np.diag(spread), np.finfo(float).tiny)
    strength = found[0] / np.sum(left_open(pair, held, basis)[:, 0] ** 2)
    clearer = contrast + steep * abs(steep) - abs(size) > _CLEARER
    return bool(strength > _CURVED and contrast > _CURVED_CHI and clearer)


def _curves(pair: Forward, solution: Solution, level: float) -> Array:
    """What a weak tone curve adds to a fit's pixels `[pixels used, 2]`: brighter all over, an S-curve's contrast."""
    light = np.clip(_light(solution, level)[pair.used], 0.0, 1.0)
    encoded = encode(torch.from_numpy(light)[None, None, None], "srgb", False, False)
    step = 1e-3  # of the encoded level
    steeper = (decode(encoded + step, "srgb", False, False) - decode(encoded - step, "srgb", False, False)) / (2 * step)
    e, slope = encoded.flatten().numpy(), solution.gain * level * steeper.flatten().numpy()
    return np.stack([slope * e * (1 - e), -slope * e * (1 - e) * (1 - 2 * e)], axis=1)


def _light(solution: Solution, level: float) -> Array:
    """What a fit draws, over the level of the sharp dot `[H, W]`: 0 is the paper; 0 and less where nothing is drawn."""
    return np.asarray((np.nan_to_num(solution.model) - solution.background) / (solution.gain * level))


def check_focus(edge: Edge, radius_px: float, deconvolved: bool, file: str | None) -> None:
    """Warn where the sharp picture is softer than a camera in focus leaves it, and the kernel's size feels it.

    `deconvolved` is whether the kernel, of this radius, was fitted to the dot as it would be in focus.
    """
    if edge.softness <= _SENSOR_BLUR_PX or edge.radius <= 2 * edge.softness:
        return
    # along an axis a disc of radius R has a variance of R^2 / 4
    excess = edge.softness**2 - _SENSOR_BLUR_PX**2
    share = 1 - 1 / np.sqrt(1 + 4 * excess / max(radius_px, 1e-9) ** 2)
    if share < _MATTERS:
        return
    text = f"the sharp picture is soft: its dot's edge has a width of {edge.softness:.1f} px"
    if edge.softness > UNFOCUSED_PX and deconvolved:
        text += (
            ", as out of focus; the dot was fitted as it would be in focus. If its printed edge is that soft, the "
            f"kernel is too large by {100 * share:.0f} %. Better focus again"
        )
    elif edge.softness > UNFOCUSED_PX:
        text += f", as out of focus; the kernel is too small by {100 * share:.0f} %: focus again"
    else:
        text += f"; if the printed dot's edge is sharp, the kernel is too small by {100 * share:.0f} %"
    warn(text, "not in focus", file=file, number=edge.softness)
