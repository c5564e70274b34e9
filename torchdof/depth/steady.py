"""Removing flicker from depth: a temporal filter where neither the image nor the depth moved."""

import itertools
from collections import defaultdict
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from ..validation import image_and_map

__all__ = ["Steady", "SteadyFrames", "motion_between", "shifted"]

# Inverse depths are one surface if their relative difference is at most _NOISES times the noise, clamped to _TOLERANCE.
_NOISES = 4.0  # larger: more depths count as the same surface
_TOLERANCE = (0.02, 0.15)
_VOTE_DECAY = 0.96  # share of the votes kept from frame to frame; larger: slower changes between the two surfaces
_GAIN = 1 / 8  # smallest weight of a new depth in the running mean; larger: less smoothing, less lag
_CHANGE = (0.02, 0.08)  # smallest and largest threshold on the change of the image (square root of light over its mean)
_CUT_SHARE = 0.25  # share of unchanged pixels below which a frame starts a new shot
_MOVED_PX = 5  # px; depth that differs over a square of this side has moved; jittering edges are thinner
_SWAP_MARGIN = (1.5, 1.0)  # the second surface takes over with more than 1.5 times the votes of the first, plus 1

# Optical flow by block matching from coarse to fine
_COARSEST_PX = 24  # px; smallest side of the coarsest level; smaller: larger motion is found
_LEVELS = 5  # largest number of levels; more find larger motion
_BLOCK = 7  # px; side of the compared blocks; larger ones are more robust and less detailed
_SUBPIXEL_GAIN = 0.05  # share of the squared difference that a subpixel shift must remove; larger: fewer shifts
_NOISE = 1e-4  # squared difference of noise, for the same test
_STILL_SHARE = 1e-3  # share of changed pixels below which motion is not searched


class Steady:
    """Filters the depth of a shot, frame by frame.

    Each pixel stores two surfaces, each with votes: the current one, as the running mean of its inverse depth, and
    another one that appeared there recently.

    * A new depth near the first surface is averaged into it, which reduces noise.
    * Another depth is a vote for the second surface, which becomes the first when it has clearly more votes. So an edge
      that jitters by a pixel stays at its most frequent position.
    * Where the image moves, the stored surfaces move with it, by block matching in whole pixels. Noise is reduced
      there too; differing depths are used unchanged, so that edges keep their place.
    * Where the image changes in another way, or the depth changes over a larger area than a jittering edge, the new
      depth is used unchanged, so that cuts and moving objects are not smeared.

    If the depth drifts while the image stands still, the result lags by about eight frames as long as the difference is
    below four times the noise of the map (2 % at least); a larger difference is followed at once.

    Memory is that of a few frames, however long the shot. The depth of a frame depends on all earlier frames; to render
    a shot in parts, use :class:`SteadyFrames`.

    Example:
        >>> steady, image = Steady(), torch.rand(1, 3, 12, 16)
        >>> for noise in (0.99, 1.01, 0.98, 1.02):
        ...     depth = steady(image, torch.full((1, 1, 12, 16), 2.0 * noise))
        >>> round(float(depth.mean()), 2)
        2.0
    """

    def __init__(self) -> None:
        self._last: tuple[Tensor, Tensor] | None = None  # image and memory

    @torch.no_grad()
    def __call__(self, image: Tensor, depth: Tensor) -> Tensor:
        """The depth of the next frame.

        Args:
            image: ``[B, C, H, W]``, linear light, at any exposure.
            depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres, ``inf`` allowed; NaN, zero and negative ones are holes,
                which are filled with the stored depth.

        Returns:
            ``[B, 1, H, W]`` in metres in the dtype of ``depth``, without gradient; NaN in holes without stored depth. A
            frame of another size than the previous one starts anew.

        Raises:
            ValueError: If an argument is not as described.
        """
        image_and_map(image, "depth", depth, "in metres")
        now = image.float()
        inverse = torch.where(depth > 0, 1.0 / depth.float(), torch.nan).expand(image.shape[0], -1, -1, -1)
        if self._last is None or self._last[0].shape != now.shape:
            memory = _first_memory(inverse)
        else:
            memory = _next_memory(now, *self._last, inverse)
        self._last = now, memory
        return (1.0 / memory[:, :1]).to(depth.dtype)


class SteadyFrames:
    """Steady depth of the frames of a shot, independent of the part of the shot that is rendered.

    Every 48 frames of the shot a new :class:`Steady` takes over, which has started 16 frames earlier. So a frame
    depends on at most the 63 frames before it; rendering that starts in the middle reads them first. In order, each
    frame is read once, and only two filters are kept in memory.

    Args:
        read: Function of the index of a frame, from 0, that returns its image and depth as :class:`Steady` takes them.

    Example:
        >>> image = torch.rand(1, 3, 12, 16)
        >>> def read(place: int) -> tuple[Tensor, Tensor]:
        ...     return image, torch.full((1, 1, 12, 16), 2.0 + 0.01 * (-1) ** place)
        >>> whole, part = SteadyFrames(read), SteadyFrames(read)
        >>> depths = [whole.depth(place) for place in range(6)]
        >>> bool(torch.equal(part.depth(5), depths[5]))
        True
    """

    _SPAN, _LEAD = 48, 16  # frames; a longer lead makes the switch to a new filter less visible

    def __init__(self, read: Callable[[int], tuple[Tensor, Tensor]]) -> None:
        self._read = read
        self._filters = defaultdict[int, Steady](Steady)  # first frame -> filter
        self._next = 0

    def depth(self, place: int) -> Tensor:
        """Steady depth ``[B, 1, H, W]`` of the frame with index ``place``, from 0.

        Raises:
            ValueError: If the image or depth of a frame is not as :class:`Steady` takes it.
        """
        start = self._start(place)
        if self._next > place or start not in self._filters:
            self._filters, self._next = defaultdict(Steady), start
        while self._next <= place:
            image, depth = self._read(self._next)
            used = {start, self._start(self._next + self._LEAD)}
            depths = {first: self._filters[first](image, depth) for first in used}
            self._next += 1
        for first in [first for first in self._filters if first < start]:
            del self._filters[first]
        return depths[start]

    def _start(self, place: int) -> int:
        """First frame of the filter that gives the depth of frame ``place``."""
        return max(0, place // self._SPAN * self._SPAN - self._LEAD)


def _first_memory(inverse: Tensor) -> Tensor:
    """Memory after a first frame, ``[B, 4, H, W]``: inverse depth of the first and second surface, votes of both."""
    return torch.cat([inverse, inverse, inverse.isfinite().float(), torch.zeros_like(inverse)], dim=1)


def _next_memory(now: Tensor, previous: Tensor, memory: Tensor, inverse: Tensor) -> Tensor:
    """Memory ``[B, 4, H, W]`` after one more frame, as :class:`Steady` describes it."""
    level = previous.clamp(min=0).sqrt().mean((1, 2, 3), keepdim=True).clamp(min=1e-12)
    now, previous = (frame.clamp(min=0).sqrt() / level for frame in (now, previous))
    is_changed = (now - previous).abs().amax(1, keepdim=True) > _CHANGE[0]
    flow = motion_between(now.clamp(max=3), previous.clamp(max=3), is_changed)
    change = F.avg_pool2d((now - sample(previous, flow)).abs().mean(1, keepdim=True), 3, 1, 1, count_include_pad=False)
    noise = change.flatten(1).median(dim=1).values.reshape(-1, 1, 1, 1)
    is_kept = change <= (3.0 * noise).clamp(*_CHANGE)
    is_kept = is_kept & (is_kept.float().mean((1, 2, 3), keepdim=True) >= _CUT_SHARE)
    first, second, votes, second_votes = shifted(memory, flow).split(1, dim=1)

    is_seen, is_known = inverse.isfinite(), is_kept & (votes > 0)
    difference = (inverse - first).abs() / torch.maximum(inverse, first).clamp(min=1e-30)
    both = is_seen & is_known
    typical = torch.where(both, difference, torch.nan).flatten(1).nanmedian(dim=1).values.nan_to_num()
    tolerance = (_NOISES * 1.48 * typical).clamp(*_TOLERANCE).reshape(-1, 1, 1, 1)
    is_first = both & (difference <= tolerance)
    differs = both & ~is_first
    moved_core = F.avg_pool2d(differs.float(), _MOVED_PX, 1, _MOVED_PX // 2) > 0.99
    has_moved = differs & (F.max_pool2d(moved_core.float(), _MOVED_PX + 2, 1, _MOVED_PX // 2 + 1) > 0)
    has_moved = has_moved | (differs & (flow.abs().amax(1, keepdim=True) > 0))
    is_known = is_known & ~has_moved

    votes, second_votes = _VOTE_DECAY * votes + is_first, _VOTE_DECAY * second_votes
    first = torch.where(is_first, first + (inverse - first) * (1.0 / votes.clamp(min=1.0)).clamp(min=_GAIN), first)
    is_second = differs & (second_votes > 0) & ((inverse - second).abs() <= tolerance * torch.maximum(inverse, second))
    second_votes = torch.where(differs, torch.where(is_second, second_votes, 0.0) + 1.0, second_votes)
    second = torch.where(is_second, second + (inverse - second) / second_votes, torch.where(differs, inverse, second))
    wins = differs & (second_votes > _SWAP_MARGIN[0] * votes + _SWAP_MARGIN[1])
    first, second = torch.where(wins, second, first), torch.where(wins, first, second)
    votes, second_votes = torch.where(wins, second_votes, votes), torch.where(wins, votes, second_votes)
    return torch.where(is_known, torch.cat([first, second, votes, second_votes], dim=1), _first_memory(inverse))


def motion_between(current_frame: Tensor, previous_frame: Tensor, is_changed: Tensor) -> Tensor:
    """Optical flow ``[B, 2, H, W]`` (x, y) in pixels from each pixel of a frame to its content in the previous one.

    Frames are ``[B, C, H, W]``. It has subpixel precision, and is computed at half the resolution. It is 0 if less than
    0.1 % of the pixels differ between both frames (``is_changed``).
    """
    batch, _, height, width = current_frame.shape
    if float(is_changed.float().mean()) <= _STILL_SHARE:
        return current_frame.new_zeros(batch, 2, height, width)
    levels = [(_halved(current_frame.mean(1, keepdim=True)), _halved(previous_frame.mean(1, keepdim=True)))]
    while min(levels[-1][0].shape[-2:]) >= 2 * _COARSEST_PX and len(levels) < _LEVELS:
        levels.append((_halved(levels[-1][0]), _halved(levels[-1][1])))
    flow = levels[-1][0].new_zeros(batch, 2, *levels[-1][0].shape[-2:])
    for level, (current, previous) in enumerate(reversed(levels)):
        if level:
            flow = 2.0 * F.interpolate(flow, size=current.shape[-2:], mode="nearest").round()
        flow = _matched(current, previous, flow, reach=2 if level == 0 else 1)
    return 2.0 * F.interpolate(_to_fractions(*levels[0], flow), size=(height, width), mode="nearest")


def sample(maps: Tensor, flow: Tensor, mode: str = "bilinear") -> Tensor:
    """The maps ``[B, C, H, W]`` of the previous frame at ``pixel + flow``, interpolated or of the nearest pixel."""
    size = maps.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(n, dtype=flow.dtype, device=flow.device) + 0.5 for n in size), indexing="ij")
    grid = torch.stack([(x + flow[:, 0]) * 2 / size[1] - 1, (y + flow[:, 1]) * 2 / size[0] - 1], dim=-1)
    return F.grid_sample(maps, grid, mode=mode, padding_mode="border", align_corners=False)


def shifted(maps: Tensor, flow: Tensor) -> Tensor:
    """The maps ``[B, K, H, W]`` of the previous frame at ``pixel + flow``, rounded to whole pixels."""
    return sample(maps, flow.round(), "nearest")


def _halved(picture: Tensor) -> Tensor:
    return F.avg_pool2d(picture, 2, ceil_mode=True)


def _block_mean(values: Tensor) -> Tensor:
    return F.avg_pool2d(values, _BLOCK, stride=1, padding=_BLOCK // 2, count_include_pad=False)


def _matched(current: Tensor, previous: Tensor, flow: Tensor, reach: int) -> Tensor:
    """Integer flow of least cost, among all displacements of up to ``reach`` pixels around the best of some guesses.

    The guesses are ``flow``, no motion, and those of the four neighbouring blocks.
    """
    best, best_cost = flow, torch.full_like(current, torch.inf)

    def compare(candidate: Tensor) -> None:
        nonlocal best, best_cost
        cost = _block_mean((current - shifted(previous, candidate)).abs())
        is_better = cost < best_cost - 1e-4  # nearly equal costs keep the earlier one, so flat areas keep the guess
        best_cost, best = torch.where(is_better, cost, best_cost), torch.where(is_better, candidate, best)

    compare(flow)
    compare(torch.zeros_like(flow))
    for dim, step in itertools.product((-2, -1), (-_BLOCK, _BLOCK)):
        compare(flow.roll(step, dims=dim))
    start = best
    for offset in itertools.product(range(-reach, reach + 1), repeat=2):
        if any(offset):
            compare(start + start.new_tensor(offset[::-1]).reshape(1, 2, 1, 1))
    return best


def _to_fractions(current: Tensor, previous: Tensor, flow: Tensor) -> Tensor:
    """Flow with subpixel precision, along each axis from the parabola through three squared differences."""
    middle = _block_mean((current - shifted(previous, flow)).square())
    fractions = []
    for step in ((1.0, 0.0), (0.0, 1.0)):
        offset = flow.new_tensor(step).reshape(1, 2, 1, 1)
        before, after = (_block_mean((current - shifted(previous, flow + sign * offset)).square()) for sign in (-1, 1))
        bend = (before + after - 2 * middle).clamp(min=1e-6)
        gain = (before - after).square() / (8 * bend)  # the middle value minus the minimum of the parabola
        fraction = (0.5 * (before - after) / bend).clamp(-0.5, 0.5)
        fractions.append(torch.where(gain > _SUBPIXEL_GAIN * middle.clamp(min=_NOISE), fraction, 0.0))
    return flow + torch.cat(fractions, dim=1)
