"""Rules of the picture that can be switched off, to measure what each of them is worth.

Only the plain engine reads these switches, so a block :func:`without` a rule runs it. ``torchdof bench --ablation``
renders scenes whose depth of field is known without one rule after the other; docs/accuracy.md has its table.
"""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from contextvars import ContextVar

import torch

from .. import native

__all__ = ["RULES", "Rules", "active", "refuse_unknown", "without"]


def _rule(does: str) -> bool:
    return dataclasses.field(default=True, metadata={"does": does})


@dataclasses.dataclass(frozen=True)
class Rules:
    """Which rules of the picture apply."""

    matting: bool = _rule("splits mixed pixels between two surfaces")
    mixed_neighbours: bool = _rule("takes the other surface's light out of mixed neighbours")
    alike_colours: bool = _rule("splits pixels of two surfaces of like colours by their place")
    sharper_surface: bool = _rule("keeps what two colours do not explain out of a less blurred surface")
    emitters: bool = _rule("gives a highlight's light to the surface of its emitter")
    own_emitters: bool = _rule("the same where the emitter lies on the pixel's own surface")
    filling: bool = _rule("fills hidden surfaces behind blurred foregrounds")
    small_shares: bool = _rule("lets hidden samples take the place of small shares of a pixel")
    light_behind: bool = _rule("puts light behind the hidden surface")
    own_slope: bool = _rule("takes a slightly farther sample for the same, sloping surface")
    one_side: bool = _rule("fades hidden samples that mix both sides of the focus")
    continuation: bool = _rule("continues a mixed pixel's far surface behind the near one")
    stand_ins: bool = _rule("lets barely blurred surfaces be their own background")
    rays: bool = _rule("splats highlights ray by ray")
    occluders: bool = _rule("lets surfaces stop these rays")
    whole_highlights: bool = _rule("sends a mixed pixel's whole highlight from its far surface")
    fewer_rays: bool = _rule("splats fewer highlights by rays in frames of noisy depth")
    border: bool = _rule("smooths the light that continues beyond the frame's border")
    border_surfaces: bool = _rule("keeps nearer surfaces out of it")
    edges: bool = _rule("repairs depth edges")
    directions: bool = _rule("learns the errors of a map for each direction of an edge")
    far_lead: bool = _rule("asks for a lead from far surfaces")
    more_blurred: bool = _rule("gives undecided pixels of soft maps to a more blurred near surface")
    registration: bool = _rule("resizes foregrounds that a map draws too thin or too wide, and shifts the map")
    dilated: bool = _rule("gives undecided pixels to either surface where foregrounds are too wide")
    neighbours: bool = _rule("lets neighbours decide together in soft maps")
    like_scores: bool = _rule("averages scores over neighbours of similar colour")
    few_samples: bool = _rule("trusts colours less where a surface has few samples")
    mixtures: bool = _rule("gives mixed colours to a more blurred near surface")
    third_surfaces: bool = _rule("keeps a ramp's pixel that shows neither surface between them")
    ringing: bool = _rule("removes rims of interpolation from soft maps")
    soft_lamps: bool = _rule("restores lamps that a soft map has averaged away")
    in_doubt: bool = _rule("blurs the edges of soft maps that the image contradicts")
    missed_parts: bool = _rule("lets blurred foregrounds grow by what the map misses of them")
    rounding: bool = _rule("takes the rounding of a file for noise")


RULES = {field.name: str(field.metadata["does"]) for field in dataclasses.fields(Rules)}
"""Description of each rule, by its name."""

_ALL = Rules()
_active: ContextVar[Rules] = ContextVar("rules", default=_ALL)


def active() -> Rules:
    """The rules that apply in this block; all in compiled code, which cannot read a context variable."""
    return _ALL if torch.compiler.is_compiling() else _active.get()


def refuse_unknown(rules: Sequence[str], option: str = "") -> None:
    """Refuse names that :data:`RULES` does not have; the message begins with the option that has them."""
    for name in rules:
        if name not in RULES:
            raise ValueError(f"{option}there is no rule {name!r}; the rules are {', '.join(RULES)}")


@contextlib.contextmanager
def without(rules: Sequence[str]) -> Iterator[None]:
    """Render without these rules in this block, by the plain engine.

    Raises:
        ValueError: If there is no rule of a name.
    """
    refuse_unknown(rules)
    token = _active.set(dataclasses.replace(_active.get(), **dict.fromkeys(rules, False)))
    try:
        with native.engine_off():
            yield
    finally:
        _active.reset(token)
