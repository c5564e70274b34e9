"""Decides by colour which of the two surfaces at an edge of depth a pixel shows."""

from typing import NamedTuple

import torch
from torch import Tensor

from ... import pixels
from ...optics.kernel_cache import kept
from ..engines.ops import Ops
from ..rules import active
from .edge_search import REACH, Edges
from .windows import gaussian

__all__ = [
    *("SHARPNESS", "SOFT_SHARPNESS"),
    *("Looks", "Shown", "falloff", "finite_light", "judge", "more_blurred"),
]

_SAMPLED_GAP = 0.2537  # a sample shows a surface up to this part of the step from it; larger: more samples
_FALLOFF_PX = 2.5  # standard deviation of the Gaussian weights of samples
_SURE = (0.0, 0.02, 0.06, 0.2, 1.0)  # weight of a sample, by ring: beside a step its depth may be wrong
_CLEAR = 0.1  # sum of these weights from which samples beside a step count in full; larger: thin strands stay
_CLEAR_IN_PRIOR = 0.25  # the same where the share of wrong pixels is estimated; larger: soft pictures stay
_LIKELY = 0.01  # likelihood from which a ramp's pixel shows one of both surfaces; larger: more pixels stay between them
_LEAST_SEEN = 1e-3  # sum of the weights of samples from which a surface is known
_UNLIKE = 1e-3  # weight of samples that do not resemble a pixel, in the nearness of its surfaces
_INSEPARABLE = 0.1  # contrast, over contrast and variance, up to which colours do not separate two surfaces
_MOST_ODDS, _MOST_SCORE = 8.0, 6.0  # limits of the log-odds of a pixel, and of its score, which averages them
_COLOUR_NOISE = 2.25e-4  # (1.5 %)^2: variance of a colour, over its square, that a surface has at least
_MIXTURE = 0.05  # likelihood of a mixed colour on a more blurred near surface; larger: fewer outlines, less detail
_MORE_BLURRED_PX = 2.0  # difference in blur of two surfaces from which the near one is clearly the more blurred one
_SPREAD = 0.3  # variance, over that of both surfaces, by which a sample resembles a pixel; larger: more do
_SIMILAR = 0.0225  # (15 %)^2: squared difference, over the square, at which a neighbour counts by half
SHARPNESS = 1.6  # factor on scores, which samples on the wrong side reduce; larger: colour outweighs the map
SOFT_SHARPNESS = 0.7  # the same in soft maps, where samples near the edge are rarely wrong
_BRIGHTEST = 1e30  # upper limit for light; products of a few such values overflow float32


class Looks(NamedTuple):
    """Maps by which the surface of a pixel is decided, as :func:`torchdof.pixels.rows`."""

    maps: Tensor
    """``[C + 5, B * H * W]``: square roots of light, nearness, weight as a sample, both surfaces, whether on a ramp."""

    @classmethod
    def of(cls, light: Tensor, nearness: Tensor, valid: Tensor, edges: Edges) -> "Looks":
        """From maps ``[B, C, H, W]`` of light and ``[B, 1, H, W]`` of the others."""
        weight = _sure(nearness.dtype, nearness.device)[edges.ring] * (valid & ~edges.is_ramp)
        maps = [light.sqrt(), nearness, weight, edges.near, edges.far, edges.is_ramp.to(nearness.dtype)]
        return cls(pixels.rows(torch.cat(maps, 1)))

    @property
    def colour(self) -> Tensor:
        """``[C, B * H * W]``."""
        return self.maps[:-5]

    @property
    def ends(self) -> Tensor:
        """Nearness of the near and of the far surface around each pixel, ``[2, B * H * W]``."""
        return self.maps[-3:-1]

    def samples(self, window: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Colour ``[C, n, P]``, nearness and weight ``[n, P]`` of pixels ``[n, P]``."""
        picked = pixels.pick(self.maps[:-3], window)
        return picked[:-2], picked[-2], picked[-1]

    def own(self, part: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Colour ``[C, P]``, both surfaces ``[2, P]`` and whether it is on a ramp, ``[P]``, of each pixel."""
        picked = pixels.pick(self.maps, part)
        return picked[:-5], picked[-3:-1], picked[-1]


class Shown(NamedTuple):
    """Which surface pixels show, ``[P]`` each."""

    score: Tensor  # log-likelihood ratio, positive for the near surface
    evidence: Tensor  # 0 to 1, that the pixel shows one of both, not a third one between them, such as a lamp
    near: Tensor  # nearness of the near surface, as the mean of the samples that resemble the pixel
    far: Tensor  # the same of the far surface


@kept
def _sure(dtype: torch.dtype, device: torch.device) -> Tensor:
    """:data:`_SURE`, made once for a device."""
    return torch.tensor(_SURE, dtype=dtype, device=device)


@kept
def falloff(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Weights of samples by their distance, as :func:`.windows.gaussian`; a pixel is not its own sample."""
    weights = gaussian(REACH, _FALLOFF_PX, dtype, device)
    return torch.where(weights < 1.0, weights, 0.0)


def finite_light(image: Tensor, brightest: float = _BRIGHTEST) -> Tensor:
    """Light from 0 to ``brightest``, and 0 where it is not finite."""
    return torch.where(torch.isfinite(image), image, 0.0).clamp(0.0, brightest)


def judge(
    looks: Looks, like: Tensor, edge_pixels: Tensor, sharpness: Tensor, in_prior: bool, mixtures: bool, ops: Ops
) -> Shown:
    """Scores by colour which of two surfaces pixels ``[P]`` show.

    1. Take samples of both surfaces from a window around each pixel, weighted by distance and by how sure they are.
    2. Compute mean and spread of both colours, and how well these separate the surfaces, in [0, 1].
    3. Compute the likelihood of each surface: the share of its samples that resemble the pixel. A surface of several
       colours has no useful mean. Beside a step, few samples prove little: in a photograph, whose edges are soft, a
       strand of a pixel has mostly the colour of its background.
    4. With ``mixtures``, which needs maps of the coc, add the likelihood of a mixture of both colours to a more blurred
       near surface. Such a pixel resembles neither surface; left in the sharper far one it would be a sharp outline.
    5. Average scores over neighbours of similar colour.

    Args:
        looks: What the pixels look like.
        like: A map of the frame.
        edge_pixels: Indices of the pixels.
        sharpness: The factor on the scores of each item, ``[B]``.
        in_prior: Whether more samples are needed for full scores, for the shares of wrong pixels.
        mixtures: Whether step 4 is done.
        ops: Processes the list in parts.
    """
    weights, clear = falloff(like.dtype, like.device), _CLEAR_IN_PRIOR if in_prior else _CLEAR

    def look(part: Tensor) -> Tensor:
        others, values, trusted = looks.samples(pixels.around(part, like, REACH))
        own, ends, is_ramp = looks.own(part)
        most_off = _SAMPLED_GAP * (ends[0] - ends[1]).clamp_min(1e-12)
        side = weights * trusted * ((values - ends[:, None]).abs() < most_off)  # [2, n, P]

        # mean colours of both surfaces, and the variance around them
        seen = side.sum(1)
        least, total = seen.amin(0), seen + 1e-9
        known = least > _LEAST_SEEN
        mean = (others[:, None] * side).sum(2) / total  # [C, 2, P]
        # a sum over both axes at once takes onnxruntime 35 times as long
        spread = ((others[:, None] - mean[:, :, None]).square() * side).sum(2).sum(0) / total
        noise = _COLOUR_NOISE * mean.sum(1).square().sum(0)
        spread = 0.5 * spread.sum(0) + noise + 1e-12
        contrast = (mean[:, 0] - mean[:, 1]).square().sum(0)
        separation = (contrast / (contrast + 0.5 * spread) - _INSEPARABLE).clamp_min(0.0) / (1.0 - _INSEPARABLE)
        separation = torch.where(known, separation, 1.0)  # no samples in the middle of a wide ramp: neighbours decide

        # likelihoods
        apart = (others - own[:, None]).square().sum(0)
        alike = (1.0 + apart / (_SPREAD * spread)).square().reciprocal()
        likelihood = (side * alike).sum(1) / total + 1e-9
        if mixtures and active().mixtures:
            off, along = own - mean[:, 1], mean[:, 0] - mean[:, 1]
            share = ((off * along).sum(0) / contrast.clamp_min(1e-12)).clamp(0.0, 1.0)
            mixed = (1.0 + (off - share * along).square().sum(0) / spread).square().reciprocal()
            mixed = _MIXTURE * mixed * more_blurred(ends)
            likelihood = torch.stack([likelihood[0] + mixed, likelihood[1]])
        score = torch.where(known, torch.log(likelihood[0] / likelihood[1]), 0.0).clamp(-_MOST_ODDS, _MOST_ODDS)
        if active().few_samples:
            score = torch.where(is_ramp > 0, score, score * (least / clear).clamp(max=1.0))
        share = side * (alike + _UNLIKE)
        surfaces = torch.where(known, (share * values).sum(1) / share.sum(1).clamp_min(1e-12), ends)
        likeliest = torch.where(known, likelihood.amax(0), 1.0)
        return torch.cat([torch.stack([score, separation, likeliest]), surfaces])

    score, separation, likeliest, near, far = ops.by_parts(look, edge_pixels).unbind(0)

    # neighbours of similar colour decide together
    scores = pixels.put(torch.full_like(like, torch.nan), edge_pixels, score)
    window = pixels.around(edge_pixels, like, 1)
    own, others = pixels.pick(looks.colour, edge_pixels), pixels.pick(looks.colour, window)
    scores = pixels.pick(scores, window)[0]
    alike = 1.0 / (1.0 + (others - own[:, None]).square().sum(0) / (_SIMILAR * own.square().sum(0) + 1e-12))
    if not active().like_scores:
        alike = (torch.arange(len(alike), device=alike.device) == len(alike) // 2).to(alike.dtype)[:, None]
    is_edge = ~scores.isnan()
    alike, scores = torch.where(is_edge, alike, 0.0), torch.where(is_edge, scores, 0.0)
    score = separation * (alike * scores).sum(0) / alike.sum(0).clamp_min(1e-12)
    score = (sharpness.index_select(0, edge_pixels // like[0].numel()) * score).clamp(-_MOST_SCORE, _MOST_SCORE)
    evidence = torch.maximum(2.0 * separation * scores.abs().amax(0) - 1.0, likeliest / _LIKELY).clamp(0.0, 1.0)
    return Shown(score, evidence, near, far)


def more_blurred(surfaces: Tensor) -> Tensor:
    """How clearly the near one of two surfaces, of cocs ``[2, P]``, is the more blurred one, 0 to 1."""
    blur = surfaces.abs()
    return ((blur[0] - blur[1]) / _MORE_BLURRED_PX).clamp(0.0, 1.0)
