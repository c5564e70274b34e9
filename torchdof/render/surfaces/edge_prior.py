"""How often pixels of each kind show the near surface: the prior, which a frame teaches about its map of depth."""

import torch
from torch import Tensor

from ...optics.kernel_cache import kept
from .edge_search import DIRECTIONS, LEVELS, PLACES, RINGS

__all__ = ["PRIOR_COUNT", "calibrate", "weight_of"]

_TRUSTED = 0.05  # assumed share of wrong pixels beside steps
PRIOR_COUNT = 30.0  # weight of assumptions, in pixels; larger: the frame changes them less
_ROUNDS = 10  # iterations of the fit
_MOST_SHARE = 0.995  # largest share of one surface


def weight_of(score: Tensor) -> Tensor:
    """What a sample with a score counts, 0 to 1."""
    return (0.5 * score.abs()).clamp(max=1.0)


def calibrate(kinds: Tensor, score: Tensor, items: int) -> Tensor:
    """Share of pixels that show the near surface, for each kind: the prior, fitted to colour scores of samples ``[P]``.

    Expectation maximisation with an assumed share, which counts as :data:`PRIOR_COUNT` pixels. The first fit joins all
    directions; its shares are the assumption of the second fit, one direction at a time.
    """
    weight = weight_of(score)
    assumed, odds = _assumed(score.dtype, score.device).repeat(items), torch.exp(-score)

    def fit(groups: Tensor, start: Tensor, assumed: Tensor) -> Tensor:
        total = torch.full_like(assumed, PRIOR_COUNT).index_add(0, groups, weight)
        prior, share = PRIOR_COUNT * assumed / total, start
        # of a pixel that counts w of all, w sigmoid(score + logit(share)) = share / (share / w + (1 - share) odds / w)
        near = total[groups] / weight.clamp_min(1e-20)
        far = near * odds
        change = near - far
        for _ in range(_ROUNDS):
            own = share[groups]
            share = prior.index_add(0, groups, own / torch.addcmul(far, own, change))
            share = share.clamp(1.0 - _MOST_SHARE, _MOST_SHARE)
        return share

    is_step = (torch.arange(PLACES, device=score.device) < 2 * RINGS).repeat(items)
    places = kinds // DIRECTIONS
    together = fit(places, torch.where(is_step, 0.5, assumed), assumed).repeat_interleave(DIRECTIONS)
    return fit(kinds, torch.full_like(together, 0.5), together)


@kept
def _assumed(dtype: torch.dtype, device: torch.device) -> Tensor:
    """The assumed share of each place: ``[PLACES]``."""
    steps = [_TRUSTED] * RINGS + [1.0 - _TRUSTED] * RINGS
    return torch.tensor([*steps, *((level + 0.5) / LEVELS for level in range(LEVELS))], dtype=dtype, device=device)
