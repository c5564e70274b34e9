"""Depth that does not flicker: filtered along time where neither the image nor the depth moved."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from ..validation import image_and_map
from .motion import motion_between, sample, shifted

__all__ = ["Steady", "SteadyFrames"]

_FORGET = 0.96  # of the votes stay in each frame
_GAIN = 1 / 8  # least share of a new depth in the mean
_ALIKE = (0.02, 0.15)  # relative difference of inverse depths that are one surface: at least, at most
_NOISES = 4.0  # and between these, times the noise of the map
_CHANGE = (0.02, 0.08)  # difference of images that is no noise: at least, at most
_CUT = 0.25  # share of pixels that must have been there before
_MOVED_PX = 5  # depth that differs over a square of this side has moved; jittering edges are thinner
_MARGIN = (1.5, 1.0)  # factor and votes by which the second surface must win


class Steady:
    """Steadies the depth of a shot, frame by frame.

    Each pixel remembers two surfaces: the one it shows, as the running mean of its inverse depths, and another that was
    seen there lately. A new depth that is like the first is averaged into it, so that noise sinks; one that is not is a
    vote for the second, which takes over when it has clearly more: an edge that jitters by a pixel stands still where
    it mostly is. Where the image moves, what is remembered moves along, by block matching: noise sinks there too, but
    edges are taken as they come, since a memory that moves by whole pixels knows them no better. Where the image
    changed otherwise, or the depth over an area that no jitter of edges explains, the new depth is taken as it is: cuts
    and motion pass. A depth that changes evenly while the image stands still is followed about eight frames late, until
    it differs by four times the map's noise (2 % at least), and at once from there.

    What is kept has the size of a few frames, however long the shot. A frame's depth depends on those before it: see
    :class:`SteadyFrames` where a shot is worked on in parts.

    Example:
        >>> steady, image = Steady(), torch.rand(1, 3, 12, 16)
        >>> for noise in (0.99, 1.01, 0.98, 1.02):
        ...     depth = steady(image, torch.full((1, 1, 12, 16), 2.0 * noise))
        >>> round(float(depth.mean()), 2)
        2.0
    """

    def __init__(self) -> None:
        self._before: Tensor | None = None
        self._memory: Tensor | None = None

    def reset(self) -> None:
        """Forgets the frames before, as a cut does."""
        self._before = self._memory = None

    @torch.no_grad()
    def __call__(self, image: Tensor, depth: Tensor) -> Tensor:
        """The depth of the next frame.

        Args:
            image: ``[B, C, H, W]``, linear light, at any exposure.
            depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres, ``inf`` allowed; NaN, zero and negative ones are holes,
                which take what was remembered.

        Returns:
            ``[B, 1, H, W]`` in metres in the dtype of ``depth``, without gradient; NaN in holes of which nothing is
            remembered.

        Raises:
            ValueError: If an argument is not as described. Frames of another size than the one before start anew.
        """
        image_and_map(image, "depth", depth, "in metres")
        now = image.float()
        inverse = torch.where(depth > 0, 1.0 / depth.float(), torch.nan).expand(image.shape[0], -1, -1, -1)
        if self._before is None or self._memory is None or self._before.shape != now.shape:
            memory = _forgotten(inverse)
        else:
            memory = _remembered(now, self._before, self._memory, inverse)
        self._before, self._memory = now, memory
        steady = 1.0 / memory[:, :1]
        return steady.to(depth.dtype)


class SteadyFrames:
    """Steady depth of the frames of a shot, the same whichever part of it is worked on.

    A filter starts anew every 48 frames, and 16 frames before its depth is used, counted from the shot's first frame:
    so each frame depends on at most the 63 before it, which are read first where work starts in the middle. Frames are
    read once where they are asked for in order, and nothing of them is kept but two filters.

    Args:
        read: Gives image and depth of a frame, by its place in the shot from 0, as :class:`Steady` takes them.

    Example:
        >>> image = torch.rand(1, 3, 12, 16)
        >>> def read(place: int) -> tuple[Tensor, Tensor]:
        ...     return image, torch.full((1, 1, 12, 16), 2.0 + 0.01 * (-1) ** place)
        >>> whole, part = SteadyFrames(read), SteadyFrames(read)
        >>> depths = [whole.depth(place) for place in range(6)]
        >>> bool(torch.equal(part.depth(5), depths[5]))
        True
    """

    _SPAN, _LEAD = 48, 16

    def __init__(self, read: Callable[[int], tuple[Tensor, Tensor]]) -> None:
        self._read = read
        self._filters: dict[int, Steady] = {}  # by the place they started at
        self._next = 0

    def depth(self, place: int) -> Tensor:
        """Steady depth ``[B, 1, H, W]`` of the frame at a place in the shot, from 0.

        Raises:
            ValueError: If what is read is not as :class:`Steady` takes it.
        """
        start = self._start(place)
        if self._next > place or start not in self._filters:
            self._filters, self._next = {}, start
        steady: Tensor | None = None
        while self._next <= place:
            image, depth = self._read(self._next)
            for begin in {start, self._start(self._next + self._LEAD)}:
                if begin == self._next:
                    self._filters[begin] = Steady()
                if begin in self._filters:
                    filtered = self._filters[begin](image, depth)
                    steady = filtered if begin == start else steady
            self._next += 1
        self._filters = {begin: kept for begin, kept in self._filters.items() if begin >= start}
        assert steady is not None  # the loop ran: place was ahead
        return steady

    def _start(self, place: int) -> int:
        """Where the filter begins that a frame's depth comes from."""
        return max(0, place // self._SPAN * self._SPAN - self._LEAD)


def _forgotten(inverse: Tensor) -> Tensor:
    """Memory of this frame alone, ``[B, 4, H, W]``: inverse depth of the first and the second surface, their votes."""
    return torch.cat([inverse, inverse, inverse.isfinite().float(), torch.zeros_like(inverse)], dim=1)


def _remembered(now: Tensor, before: Tensor, memory: Tensor, inverse: Tensor) -> Tensor:
    """Memory after one more frame."""
    level = before.clamp(min=0).sqrt().mean((1, 2, 3), keepdim=True).clamp(min=1e-12)
    now, before = (frame.clamp(min=0).sqrt() / level for frame in (now, before))
    flow = motion_between(
        now.clamp(max=3), before.clamp(max=3), (now - before).abs().amax(1, keepdim=True) > _CHANGE[0]
    )
    change = F.avg_pool2d((now - sample(before, flow)).abs().mean(1, keepdim=True), 3, 1, 1, count_include_pad=False)
    noise = change.flatten(1).median(dim=1).values.reshape(-1, 1, 1, 1)
    is_kept = change <= (3.0 * noise).clamp(*_CHANGE)
    is_kept = is_kept & (is_kept.float().mean((1, 2, 3), keepdim=True) >= _CUT)
    first, second, votes, second_votes = shifted(memory, flow).split(1, dim=1)

    is_seen, is_known = inverse.isfinite(), is_kept & (votes > 0)
    difference = (inverse - first).abs() / torch.maximum(inverse, first).clamp(min=1e-30)
    both = is_seen & is_known
    typical = torch.where(both, difference, torch.nan).flatten(1).nanmedian(dim=1).values.nan_to_num()
    alike = (_NOISES * 1.48 * typical).clamp(*_ALIKE).reshape(-1, 1, 1, 1)
    is_first = both & (difference <= alike)
    differs = both & ~is_first
    core = F.avg_pool2d(differs.float(), _MOVED_PX, 1, _MOVED_PX // 2) > 0.99
    has_moved = differs & (F.max_pool2d(core.float(), _MOVED_PX + 2, 1, _MOVED_PX // 2 + 1) > 0)
    has_moved = has_moved | (differs & (flow.abs().amax(1, keepdim=True) > 0))
    is_known = is_known & ~has_moved

    votes, second_votes = _FORGET * votes + is_first, _FORGET * second_votes
    first = torch.where(is_first, first + (inverse - first) * (1.0 / votes.clamp(min=1.0)).clamp(min=_GAIN), first)
    is_second = differs & (second_votes > 0) & ((inverse - second).abs() <= alike * torch.maximum(inverse, second))
    second_votes = torch.where(differs, torch.where(is_second, second_votes, 0.0) + 1.0, second_votes)
    second = torch.where(is_second, second + (inverse - second) / second_votes, torch.where(differs, inverse, second))
    wins = differs & (second_votes > _MARGIN[0] * votes + _MARGIN[1])
    first, second = torch.where(wins, second, first), torch.where(wins, first, second)
    votes, second_votes = torch.where(wins, second_votes, votes), torch.where(wins, votes, second_votes)
    return torch.where(is_known, torch.cat([first, second, votes, second_votes], dim=1), _forgotten(inverse))
