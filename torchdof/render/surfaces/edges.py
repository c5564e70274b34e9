"""Moves the edges of a depth map to the edges of the image.

Measured or estimated depth has its edges a few pixels beside those of the image, or ramps instead of steps. Both draw
outlines around blurred objects. This module decides for each pixel near a depth edge which of the two surfaces it
shows. It compares the pixel's colour with pixels that clearly lie on one surface, and combines this with a prior: the
share of wrong pixels that the map has at similar places of the same frame. So systematic errors (a foreground a pixel
too thin, edges displaced to the right, ramps four pixels wide) are learnt from the frame, and a map with exact edges
stays unchanged.

All computations use nearness, a measure linear in 1 / depth: planes are linear in it, and resampling and depth
estimation turn an edge into averages of it.
"""

import functools
from typing import NamedTuple

import torch
import torch.nn.functional as functional
from torch import Tensor

from ... import native, pixels, validation
from ...optics.kernel_cache import kept
from ...options import DepthEdges
from ...tensors import is_differentiated, is_empty, is_traced
from ...validation import ends, engine_reads
from ..engines.compiled_steps import by_items
from ..engines.on_gpu import calibrate, find_edges, judge
from ..engines.ops import EAGER, Ops
from ..engines.traced import is_compiled, one_operator
from ..layers.convolution import widest_float
from ..layers.downsampling import downsampled, upsampled
from ..rules import active
from . import edge_search
from .coverage import is_near_edge
from .doubt import blurred_in_doubt, doubt_of
from .edge_colours import (
    SHARPNESS,
    SOFT_SHARPNESS,
    Looks,
    Shown,
    finite_light,
    more_blurred,
)
from .edge_prior import PRIOR_COUNT, weight_of
from .edge_search import DIRECTIONS, REACH, RINGS, Edges
from .missed import completed
from .registration import EDITS, Repaired, edits_of, registered
from .soft_maps import Softness, lift_lamps, sigma_of, without_ringing
from .windows import LARGEST, highest

__all__ = ["STEP_PX", "judged", "mended", "repair", "repair_edges"]

STEP_PX = 1.0
"""Smallest difference in coc, in pixels, between two surfaces whose edge is repaired."""

_LEAST_STEP_PX = 0.5 * STEP_PX  # smallest range of coc in a map that is repaired; half a step, as for lamps
_STEP = 0.1  # step of :func:`repair_edges`, as a fraction of the largest nearness around; larger: fewer edges
_NOISES = 12.0  # smallest step, in standard deviations of the noise; larger: fewer edges in noisy maps

# Sample of the frame, from which the errors of its map are learnt
_SAMPLED = 12_000  # sqrt(_SAMPLED * pixels of the frame) pixels are sampled, in blocks; larger: more exact, slower
_BLOCK = 8  # px; side of a block

# Decision, with "auto"
_CLEAR_LEVEL = 0.3  # distance from the middle of a ramp, in steps, from which its pixels are clear
_RELATED = 0.8  # smallest agreement of colours with the clear pixels of one side of edges at which colours are used
_EXACT = 0.025  # largest share of wrong pixels at which the steps of a map count as exact
_DOUBTFUL = 0.05  # share of wrong pixels of a kind above which these pixels are decided again
_LEAN = 2.0  # log-odds by which a far surface must win: foreground left behind is the more visible error
_TO_BLURRED = 3.0  # log-odds for a soft map's near surface that is more blurred; larger: fewer specks, less detail
_SCORED = 2.0  # inverse of a score at which colours alone decide about dilated foregrounds; larger: narrower ones
_BESIDE, _DIAGONAL = 1.3, 0.8  # log-odds of a neighbour's surface in soft maps; larger: smoother edges, less detail

# Soft maps: blurred by resampling, antialiased, or written by a network. Where an edge crosses a row of pixels, values
# are means over some width in pixels, and about half of that width is far from both surfaces. The artefacts of
# compression are ramps too, whose pixels lie close to one of the surfaces.
_SOFT = 0.32  # sum of :func:`_mixture` on ramps, per pixel of edge; with means over each pixel it is 0.35 to 0.5
_WIDE = 13.0  # this sum over _SOFT; maps of a quarter of the resolution have up to 12, of an eighth 15 to 20
_HALVINGS = 2  # most halvings of a map with wider ramps

_MISSES_NOTHING = 0.5  # how far foregrounds are dilated from which they never grow

# With a matte
_MATTE_REACH = 30  # px; distance from its edge up to which foregrounds neither grow nor blur their surroundings


def repair_edges(image: Tensor, depth: Tensor, edges: DepthEdges = "repair") -> Tensor:
    """Moves and sharpens the edges of a depth map to where the image has them.

    Ramps become steps between their two surfaces. Pixels that show one surface and have the depth of the other are
    corrected. Slopes stay slopes, and a step between two surfaces of the same colour stays unchanged.

    Args:
        image: ``[B, C, H, W]``, linear light, floating point; its scale does not matter.
        depth: ``[B, 1, H, W]`` or ``[1, 1, H, W]``, metres, > 0, ``inf`` allowed; NaN, zero and negative values stay.
        edges: "repair" decides at each edge; "auto" returns a map with exact edges unchanged to the bit; "as
            given" does nothing.

    Returns:
        ``[B, 1, H, W]``, metres. Gradients flow to the depth of unchanged pixels; repaired pixels are constant.

    Raises:
        ValueError: If shapes or types are not as described.

    Example:
        >>> image = torch.zeros(1, 3, 24, 24)
        >>> image[..., 12:] = 1.0
        >>> depth = torch.full((1, 1, 24, 24), 2.0)
        >>> depth[..., 13:] = 1.0  # a pixel too far to the right
        >>> bool((repair_edges(image, depth)[..., 12:] == 1.0).all())
        True
    """
    validation.image_and_depth(image, depth, values=False)
    validation.choice("depth_edges", edges, ("auto", "repair", "as given"))
    if edges == "as given":
        return depth
    depth = depth.expand(image.shape[0], -1, -1, -1)
    nearness = torch.where(depth > 0, 1.0 / depth.detach(), torch.nan)
    high = highest(torch.where(depth > 0, nearness, 0.0).float(), REACH)
    repaired, _ = repair(image, nearness, _STEP * high, edges == "auto")
    changed = (repaired != nearness) & (depth > 0)
    return torch.where(changed, 1.0 / repaired.clamp_min(0.0), depth)


def mended(image: Tensor, coc_px: Tensor, edges: DepthEdges, ops: Ops = EAGER, matte: Tensor | None = None) -> Tensor:
    """Repairs the edges of a map of the coc: the first step of the pipeline.

    Pixels at edges get the surface that they show, blurred foregrounds get what the map misses of them, and edges that
    are still in doubt are blurred. Near edges of a matte only the first step is done: a matte states coverage.

    Args:
        image: ``[B, C, H, W]``, linear light.
        coc_px: ``[B or 1, 1, H, W]``, signed.
        edges: As for :func:`repair_edges`.
        ops: Skips frames without edges, and processes lists of pixels in parts.
        matte: Coverage by the subject ``[B or 1, 1, H, W]``, in [0, 1].

    Returns:
        The map, ``[B, 1, H, W]`` if it is repaired. Gradients flow to unchanged pixels.
    """
    if edges == "as given" or not active().edges:
        return coc_px
    if not is_traced():
        low, high = ends(coc_px)
        if high - low < _LEAST_STEP_PX:
            return coc_px
    given = coc_px.detach()
    repaired, doubt = repair(image, given, STEP_PX, auto=edges == "auto", of_coc=True, ops=ops)
    if repaired is given:
        return coc_px
    may_grow = doubt > -_MISSES_NOTHING  # else the map's foregrounds are too wide and miss nothing
    grown, missed = completed(image, repaired, torch.where(may_grow, given, repaired), ops)
    blurred = blurred_in_doubt(given, grown, torch.maximum(doubt, missed), ops)
    if matte is None:
        repaired = blurred
    else:
        repaired = torch.where(is_near_edge(matte.detach(), _MATTE_REACH), repaired, blurred)
    repaired = ops.equal_unless(lambda: _has_steps(coc_px), repaired, coc_px)
    return torch.where(repaired == coc_px, coc_px, repaired) if is_differentiated(coc_px) else repaired


def _has_steps(coc_px: Tensor) -> Tensor:
    """Whether the range of a map reaches :data:`_LEAST_STEP_PX` or contains NaN: a bool ``[]``."""
    low, high = torch.aminmax(coc_px)
    return ~(high - low < _LEAST_STEP_PX)


def repair(
    image: Tensor,
    nearness: Tensor,
    step: Tensor | float,
    auto: bool,
    of_coc: bool = False,
    ops: Ops = EAGER,
    halvings: int = _HALVINGS,
) -> tuple[Tensor, Tensor]:
    """Repairs a map of nearness, of any scale and offset.

    Values that are not finite, or above 1e15 in magnitude, stay unchanged and affect no other pixel. Maps that were
    enlarged have ramps wider than the window in which edges are found: these maps are repaired at half the size first.

    Args:
        image: ``[B, C, H, W]``, linear light.
        nearness: ``[B or 1, 1, H, W]``, linear in 1 / depth, larger is nearer; constant to autograd.
        step: Smallest difference in nearness between two surfaces, ``[B, 1, H, W]`` or a number.
        auto: Whether exact edges stay unchanged.
        of_coc: Whether ``nearness`` is a map of the coc instead, in which a larger value is farther. With
            ``auto``, undecided pixels of a soft map then go to a near surface that is more blurred.
        ops: Processes lists of pixels in parts.
        halvings: How many times the size of a map with wider ramps may be halved.

    Returns:
        ``[B, 1, H, W]``, constant to autograd; unchanged pixels keep their values to the bit. ``nearness`` itself if
        the compiled engine leaves all of it unchanged. And how much the map, registered, is in doubt, 0 to 1, less how
        far its foregrounds are dilated, 0 to 1, ``[B, 1, 1, 1]``, of :func:`.doubt.doubt_of` and
        :func:`.registration.edits_of`, in soft maps.
    """
    device = image.device.type
    if torch.is_autocast_enabled(device):  # which would compute in half precision
        with torch.autocast(device, enabled=False):
            return repair(image, nearness, step, auto, of_coc, ops, halvings)
    image = image.detach()
    light, given = image.float(), nearness.float().expand(image.shape[0], -1, -1, -1)
    step = torch.as_tensor(step, dtype=given.dtype, device=given.device)
    if is_compiled():
        repaired, doubt = _operator(light, given, step, auto, of_coc)
    elif engine_reads(light, given):
        steps = step.expand(light.shape[0], 1, *given.shape[-2:]) if step.ndim else step.expand(light.shape[0], 1)
        repair_item = functools.partial(_repair_item, auto=auto, of_coc=of_coc, halvings=halvings)
        repaired, doubt = by_items(repair_item, given, light, steps[:, 0])
        if repaired is given:
            return nearness, doubt
    else:
        repaired, doubt = registered(
            lambda edited, eroded, _: _repair(light, edited, step, auto, of_coc, ops, halvings, eroded),
            given,
            of_coc,
            ops,
        )
    if nearness.dtype == torch.float32:
        return repaired, doubt
    return torch.where(repaired == given, nearness, repaired.to(nearness.dtype)), doubt


def _repair_item(
    light: Tensor, nearness: Tensor, step: Tensor, auto: bool, of_coc: bool, halvings: int
) -> tuple[Tensor, float]:
    """:func:`repair` by the compiled engine, for one item: ``[C, H, W]``, ``[H, W]``, and ``[H, W]`` or ``[]``."""

    def once(given: Tensor, eroded: Tensor, following: Tensor | None) -> Repaired:
        stops = 0 if following is None else sum(1 << k for k, edit in enumerate(following.flatten()) if edit)
        repair = functools.partial(native.repair_edges, light, stops=stops, eroded=bool(eroded))
        flat = given[0, 0]
        repaired, doubt, is_wide, edits = repair(flat, step, auto, of_coc, stops_if_wide=halvings > 0)
        if is_wide:
            narrow = _narrowed(light[None], given, step[None, None], auto, of_coc, halvings)
            is_related = bool(_differs(narrow, given))
            repaired, doubt, _, edits = repair(narrow[0, 0], step, auto, of_coc, is_related=is_related)
        bits = [edits >> k & 1 for k in range(EDITS)]
        its_doubt, asked = (given.new_tensor(found).view(1, -1, 1, 1) for found in ([doubt], bits))
        return given if repaired is flat else repaired[None, None], its_doubt, asked

    given = nearness[None, None]
    repaired, doubt = registered(once, given, of_coc)
    return nearness if repaired is given else repaired[0, 0], float(doubt)


def _narrowed(
    light: Tensor, given: Tensor, step: Tensor, auto: bool, of_coc: bool, halvings: int, ops: Ops = EAGER
) -> Tensor:
    """A map ``[B, 1, H, W]`` plus what the repair changes at half the size: narrower ramps. Invalid values stay.

    If this changes something, the colours are related to the map.
    """
    height, width = given.shape[-2:]

    def halved(values: Tensor) -> Tensor:
        return downsampled(functional.pad(values, (0, width % 2, 0, height % 2), mode="replicate"), 2)

    valid = given.abs() <= LARGEST
    share = halved(valid.to(given.dtype))
    half = torch.where(share > 0, halved(torch.where(valid, given, 0.0)) / share.clamp_min(0.25), torch.nan)
    if step.ndim == 4:
        step = halved(step)
    sign = -1.0 if of_coc else 1.0
    if of_coc:  # in pixels of the smaller frame; undecided pixels wait for the full size to go to the more blurred side
        step = 2.0 * step
    repaired, _ = repair(halved(finite_light(light)), sign * half, step, auto, ops=ops, halvings=halvings - 1)
    change = torch.where(share > 0, repaired - sign * half, 0.0)
    return given + sign * upsampled(change, 2)[..., :height, :width]


def _differs(one: Tensor, other: Tensor) -> Tensor:
    """Whether valid values of two maps differ, ``[B, 1, 1, 1]``."""
    return ((one - other).abs() > 0).flatten(1).any(1)[:, None, None, None]


@torch.no_grad()
def judged(image: Tensor, coc_px: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Finds the pixels at the edges of a map of the coc, and what :func:`mended` makes of them with "auto".

    Args:
        image: As for :func:`mended`.
        coc_px: As for :func:`mended`.

    Returns:
        Whether a pixel is at an edge, whether it is on a ramp there, and the repaired map, ``[B, 1, H, W]`` each.
    """
    nearness = -coc_px.float().expand(image.shape[0], -1, -1, -1)
    edges = _Map.of(image, nearness, nearness.new_tensor(STEP_PX), True).edges
    return edges.is_edge, edges.is_edge & edges.is_ramp, mended(image, coc_px, "auto")


class _Map(NamedTuple):
    """A map whose edges are repaired, ``[B, 1, H, W]`` each."""

    light: Tensor  # finite, [B, C, H, W]
    nearness: Tensor  # 0 where it is invalid
    valid: Tensor
    step: Tensor  # smallest difference in nearness of two surfaces
    edges: Edges
    is_near: Tensor  # whether the map gives a pixel the near one of the two surfaces around it
    looks: Looks
    of_coc: bool

    @classmethod
    def of(cls, image: Tensor, nearness: Tensor, step: Tensor, of_coc: bool) -> "_Map":
        """From an image ``[B, C, H, W]`` and a map of its nearness: finds the edges."""
        valid = nearness.abs() <= LARGEST
        given, light = torch.where(valid, nearness, 0.0), finite_light(image)
        step = torch.maximum(step, _NOISES * edge_search.noise(given, valid))
        edges = find_edges(light, given, valid, step)
        is_near = 2.0 * given > edges.near + edges.far
        looks = Looks.of(light, given, valid, edges)
        return cls(light, given, valid, step, edges, is_near, looks, of_coc)

    def item_of(self, chosen: Tensor) -> Tensor:
        """The item of each pixel ``[P]``."""
        return chosen // self.nearness[0].numel()

    def of_item(self, values: Tensor, chosen: Tensor) -> Tensor:
        """Values ``[B, 1, 1, 1]`` of each pixel's item, ``[P]``."""
        return values.flatten().index_select(0, self.item_of(chosen))

    def sample(self) -> Tensor:
        """Indices of a sample of the edge pixels, those of some blocks of the frame: ``[P]``."""
        height, width = self.nearness.shape[-2:]
        area = torch.scalar_tensor(height * width, dtype=torch.float64, device="cpu")  # not a constant in graphs
        every = (area / _SAMPLED).sqrt().ceil().long()
        rows, columns = (_from_border(n, self.nearness.device) // _BLOCK for n in (height, width))
        return pixels.indices(self.edges.is_edge & ((rows[:, None] + columns) % every == 0))

    def sums(self, sampled: Tensor, *parts: Tensor, groups: int = 1, group: Tensor | int = 0) -> Tensor:
        """Sums of values ``[P]`` of sampled pixels over each item and group ``[P]``, ``[parts, B, groups, 1, 1]``."""
        items = self.nearness.shape[0]
        zeros = self.nearness.new_zeros(len(parts), items * groups, dtype=widest_float(self.nearness.device))
        found = zeros.index_add(1, self.item_of(sampled) * groups + group, torch.stack(parts).to(zeros.dtype))
        return found.view(-1, items, groups, 1, 1)


class _Sample(NamedTuple):
    """A sample of the frame, from which the errors of its map are learnt: ``[P]`` each, sums are ``[B, 1, 1, 1]``."""

    chosen: Tensor  # indices of edge pixels, those of some blocks
    level: Tensor
    is_ramp: Tensor
    ring: Tensor
    steps: Tensor  # number of the pixels at steps
    softness: Tensor  # a map is soft from 1

    @classmethod
    def of(cls, scene: _Map) -> "_Sample":
        """From the map whose edges are repaired."""
        edges, chosen = scene.edges, scene.sample()
        maps = [edges.level, edges.climb, edges.is_ramp, edges.ring]
        level, climb, is_ramp, ring = pixels.pick(torch.cat([t.to(edges.level.dtype) for t in maps], 1), chosen)
        mixed, length, steps = scene.sums(chosen, is_ramp * _mixture(level), climb, 1.0 - is_ramp).unbind()
        return cls(chosen, level, is_ramp, ring, steps, mixed / (_SOFT * length.clamp_min(1e-12)))


class _Errors(NamedTuple):
    """The errors of a map, estimated from a sample of the frame."""

    is_soft: Tensor  # [B, 1, 1, 1]
    sharpness: Tensor  # factor on scores, [B]
    prior: Tensor  # share of the pixels of each one's kind that show the near surface, [B, 1, H, W]
    doubtful: Tensor  # edge pixels that are decided, [B, 1, H, W]
    doubt: Tensor  # 0 to 1, how much the image contradicts the map, [B, 1, 1, 1]
    dilated: Tensor  # 0 to 1, how far a soft map's foregrounds are too wide, [B, 1, 1, 1]
    edits: Tensor  # which edits colours ask for, of :func:`.registration.edits_of`, [B, EDITS, 1, 1]


@torch.no_grad()
def _repair(
    image: Tensor,
    nearness: Tensor,
    step: Tensor,
    auto: bool,
    of_coc: bool = False,
    ops: Ops = EAGER,
    halvings: int = _HALVINGS,
    eroded: Tensor | None = None,
) -> Repaired:
    """One repair of a map as it is, or with eroded foregrounds.

    1. Find ramps and steps, and the nearness of both surfaces there; narrow the ramps of a map where they are too wide.
    2. From a sample of the edge pixels, detect soft maps, score the pixels by colour, and fit the prior of each kind of
       edge pixel. Select the pixels to decide: all edge pixels; with ``auto``, those of kinds that are often wrong.
    3. Decide which surface the selected pixels show, and give them its nearness, on ramps in proportion to evidence.
    4. In soft maps, remove the ringing of interpolation beside steps, and correct lamps of a few pixels.
    """
    signed = -nearness if of_coc else nearness
    scene = _Map.of(image, signed, step, of_coc)
    sample = _Sample.of(scene)
    is_wide, is_related = sample.softness > _WIDE, torch.zeros_like(sample.softness, dtype=torch.bool)
    if halvings and (is_traced() or is_wide.any()):
        narrow = torch.where(is_wide, _narrowed(image, nearness, step, auto, of_coc, halvings, ops), nearness)
        narrow = ops.equal_unless(is_wide.any, narrow, nearness)
        is_related = is_wide & _differs(narrow, nearness)
        nearness = narrow
        signed = -nearness if of_coc else nearness
        scene = _Map.of(image, signed, step, of_coc)
        sample = _Sample.of(scene)
    errors = _errors_of(scene, sample, auto, is_related, eroded, ops)
    chosen = pixels.indices(errors.doubtful)
    if auto and is_empty(chosen):  # nor lamps: a soft map has ramps, which are selected
        return nearness, torch.zeros_like(errors.doubt), errors.edits
    shown = judge(scene.looks, scene.nearness, chosen, errors.sharpness, False, of_coc, ops)
    shows_near = _decided(scene, errors, shown.score, chosen, auto)
    repaired = _moved(scene, errors, shown, shows_near, chosen)
    if active().ringing:
        repaired = torch.where(errors.is_soft, without_ringing(repaired, scene.valid, scene.step), repaired)
    if active().soft_lamps:
        label = pixels.put(scene.is_near.to(repaired.dtype), chosen, shows_near.to(repaired.dtype))
        length = scene.edges.climb.sum((1, 2, 3), keepdim=True).clamp_min(1e-12)
        lost = torch.where(scene.edges.is_edge, label - scene.edges.level, 0.0).sum((1, 2, 3), keepdim=True)
        soft = Softness(errors.is_soft, sigma_of(scene.edges), lost / length, errors.doubt)
        repaired = lift_lamps(scene.light, scene.nearness, repaired, scene.step, soft, ops)
    repaired = torch.where(scene.valid, repaired, signed)
    return -repaired if of_coc else repaired, errors.doubt - errors.dilated, errors.edits


def _errors_of(
    scene: _Map, sample: _Sample, auto: bool, is_related: Tensor, eroded: Tensor | None, ops: Ops
) -> _Errors:
    """Step 2 of :func:`_repair`; ``is_related``: items whose colours are known to be related to the map."""
    edges, dtype, (sampled, level, is_ramp, ring, steps, softness) = scene.edges, scene.nearness.dtype, sample
    is_soft = softness > 1.0
    sharpness = torch.where(is_soft, SOFT_SHARPNESS, SHARPNESS).flatten().to(dtype)

    kind = edge_search.kinds(edges)
    score = judge(scene.looks, scene.nearness, sampled, sharpness, True, False, ops).score
    kinds_sampled = pixels.pick(kind, sampled)[0]
    shares = calibrate(scene.light, kinds_sampled, score)
    prior = shares[kind]
    none = scene.nearness.new_zeros(scene.nearness.shape[0], 1, 1, 1)
    if not auto:
        return _Errors(is_soft, sharpness, prior, edges.is_edge, none, none, none.expand(-1, EDITS, -1, -1))

    # colour agrees with the map at clear pixels: in the outermost ring of a step, or near a ramp's ends; on one side of
    # the edges only where the map's foreground is too thin, and at half of them where it has no relation
    wrong = torch.where(scene.is_near, 1.0 - prior, prior)
    weight = weight_of(score) * torch.where(is_ramp > 0, (level - 0.5).abs() > _CLEAR_LEVEL, ring == RINGS)
    is_clear = weight * torch.stack([level > 0.5, level <= 0.5])  # of the near and of the far surface
    agrees = is_clear * ((score > 0) == (level > 0.5))
    doubts = (1.0 - is_ramp) * pixels.pick(wrong, sampled)[0]
    directions = scene.sums(sampled, doubts, *is_clear, *agrees, groups=DIRECTIONS, group=kinds_sampled % DIRECTIONS)
    doubts, clear, agreed = directions.sum(2, keepdim=True).split([1, 2, 2])
    assumed = 0.5 * PRIOR_COUNT  # pixels, half of which agree
    is_related = is_related | (agreed + 0.5 * assumed > _RELATED * (clear + assumed)).any(0)
    edits, dilated = edits_of(directions[1:3], directions[3:], shares, is_soft)
    if eroded is not None:
        dilated = torch.where(eroded, 1.0, dilated)
    if not active().dilated:
        dilated = none
    if not active().registration:
        edits = torch.zeros_like(edits)
    is_related = is_related | (edits > 0).any(1, keepdim=True)
    is_soft = is_soft & is_related
    is_inexact = is_related & (is_soft | (doubts[0] > _EXACT * steps))
    doubtful = edges.is_edge & is_inexact & torch.where(edges.is_ramp, is_soft, wrong > _DOUBTFUL)
    in_doubt, dilated = (torch.where(is_soft, t, 0.0) for t in ((1.0 - dilated) * doubt_of(clear, agreed), dilated))
    # ramps of a pixel are means over pixels, or artefacts of compression: there is little to doubt
    faded = in_doubt * (softness - 1.0).clamp(0.0, 1.0)
    doubt = faded.to(dtype) if active().in_doubt else none
    return _Errors(is_soft, sharpness, prior, doubtful, doubt, dilated.to(dtype), edits.to(dtype))


def _decided(scene: _Map, errors: _Errors, score: Tensor, chosen: Tensor, auto: bool) -> Tensor:
    """Which of the pixels ``[P]`` show the near surface: those where ``score + logit(prior) > 0``.

    With ``auto`` a far surface needs a lead. In soft maps the sum also has a term for a more blurred near surface, for
    a map of the coc, and one for the chances of its neighbours to show it, so that edges are smooth lines without
    single pixels beside them. If the map's foregrounds are dilated, lead and term do not count where colours say
    something: the foregrounds would stay too wide.
    """
    rules, of_soft = active(), scene.of_item(errors.is_soft, chosen)
    dilated = scene.of_item(errors.dilated, chosen)
    odds = score + torch.logit(pixels.pick(errors.prior, chosen)[0])
    if auto and rules.far_lead:  # without auto, correct steps are decided too, and the lead would move them
        odds = odds + (1.0 - dilated) * _LEAN * (score.abs() - 1.0).clamp(0.0, 1.0)
    surfaces = pixels.pick(scene.looks.ends, chosen)
    if auto and scene.of_coc and rules.more_blurred:
        to_blurred = _TO_BLURRED * (1.0 - dilated * (_SCORED * score.abs()).clamp(max=1.0))
        odds = torch.where(of_soft, odds + to_blurred * more_blurred(surfaces), odds)
    if not rules.neighbours:
        return odds > 0
    # pixels of a soft map that stick out of an edge are mostly background of a similar colour
    window = pixels.around(chosen, scene.nearness, 1)
    by_map = (pixels.pick(scene.nearness, window)[0] > surfaces.mean(0)).to(odds.dtype)
    chance = pixels.pick(pixels.put(torch.full_like(scene.nearness, -1.0), chosen, torch.sigmoid(odds)), window)[0]
    chance = torch.where(chance < 0, by_map, chance)
    together = odds + (_neighbours(odds.dtype, odds.device) * (2.0 * chance - 1.0)).sum(0)
    return torch.where(of_soft, together, odds) > 0


def _moved(scene: _Map, errors: _Errors, shown: Shown, shows_near: Tensor, chosen: Tensor) -> Tensor:
    """The map with the nearness of the surfaces that the pixels ``[P]`` show, on ramps by evidence or by doubt."""
    own, is_ramp, was_near = (pixels.pick(t, chosen)[0] for t in (scene.nearness, scene.edges.is_ramp, scene.is_near))
    evidence = torch.maximum(shown.evidence, scene.of_item(errors.doubt, chosen))
    if not active().third_surfaces:
        evidence = torch.ones_like(evidence)
    moved = torch.where(is_ramp, evidence, (shows_near != was_near).to(own.dtype))
    return pixels.put(scene.nearness, chosen, torch.lerp(own, torch.where(shows_near, shown.near, shown.far), moved))


def _mixture(level: Tensor) -> Tensor:
    """How far levels from 0 to 1 are from both ends, 1 in the middle. Its sum depends little on the edge's angle."""
    return (4.0 * level * (1.0 - level)) ** 3


@kept
def _neighbours(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Log-odds ``[9, 1]`` that a pixel takes from its neighbours, in the order of :func:`torchdof.pixels.around`."""
    odds = [_DIAGONAL, _BESIDE, _DIAGONAL, _BESIDE, 0.0, _BESIDE, _DIAGONAL, _BESIDE, _DIAGONAL]
    return torch.tensor(odds, dtype=dtype, device=device)[:, None]


def _from_border(size: int, device: torch.device) -> Tensor:
    """Distance of each pixel to the nearest border: selects the same pixels in a mirrored frame."""
    places = torch.arange(size, device=device)
    return torch.minimum(places, size - 1 - places)


def _empty(image: Tensor, nearness: Tensor, step: Tensor, auto: bool, of_coc: bool) -> tuple[Tensor, Tensor]:
    out = torch.empty_like(nearness, memory_format=torch.contiguous_format)
    return out, nearness.new_empty(nearness.shape[0], 1, 1, 1)


# The number of pixels to process depends on the data, which compiled graphs do not support.
@one_operator("torchdof::repair_edges", _empty)
def _operator(image: Tensor, nearness: Tensor, step: Tensor, auto: bool, of_coc: bool) -> tuple[Tensor, Tensor]:
    repaired, doubt = registered(
        lambda edited, eroded, _: _repair(image, edited, step, auto, of_coc, eroded=eroded), nearness, of_coc
    )
    return repaired.clone(), doubt
