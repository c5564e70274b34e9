"""The public functions and classes refuse values of a wrong type."""

import contextlib
import functools
import importlib
import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.refused import refuses
from torchdof.augmentation import RandomDepthOfField
from torchdof.distributed import shard_rows
from torchdof.io.images import Picture, write_image
from torchdof.io.sheet import shrunk, write_sheet

IMAGE, DEPTH = torch.rand(1, 3, 8, 8), torch.full((1, 1, 8, 8), 2.0)

MODULES = (  # of the API pages
    *("", ".augmentation", ".depth", ".distributed", ".export", ".fit", ".functional", ".io.highlights", ".io.images"),
    *(".io.sheet", ".optics.aperture", ".reference.lens_views", ".reference.metrics"),
)
NOT_CHECKED = ("DepthAugmentationSequential", "make_dataset")  # checked by Kornia; needs Ray


def public_callables() -> Iterator[Any]:
    """Public functions and classes with an argument."""
    for name in MODULES:
        module = importlib.import_module(f"torchdof{name}")
        for public in sorted(set(module.__all__) - set(NOT_CHECKED)):
            value = getattr(module, public)
            if inspect.isfunction(value) or (inspect.isclass(value) and not issubclass(value, BaseException)):
                yield pytest.param(value, id=f"torchdof{name}.{public}")


@pytest.mark.parametrize("call", list(public_callables()))
def test_a_first_argument_of_a_wrong_type_is_refused_as_such(
    call: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An AttributeError or a RuntimeError would come from the first line that uses the value."""
    monkeypatch.chdir(tmp_path)  # some accept a string as the name of a file to write
    parameters = inspect.signature(call).parameters.values()
    places = [p for p in parameters if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    for wrong in (None, "no such file", 3, object()):
        with contextlib.suppress(TypeError, ValueError, OSError):
            call(wrong, *[DEPTH] * (len(places) - 1))


aug = RandomDepthOfField(p=1.0)
partial: Any = functools.partial  # for wrong types
test_a_wrong_type_is_named = refuses(
    *((partial(aug, wrong), "image must be floating point") for wrong in (None, "photo.png", 3)),
    *((partial(aug, IMAGE, wrong), "depth must be a tensor .* in metres.*got") for wrong in ("depth.png", 3, [2.0])),
    (lambda: aug({"image": IMAGE, "depth": "depth.png"}), "depth must be a tensor"),
    (partial(aug.label, IMAGE, 3), "depth must be a tensor"),
    (partial(aug.draw, None), "generator must be a torch.Generator, got None"),
    (partial(RandomDepthOfField, None), "focus_m must be two numbers"),
    (partial(write_image, "out.png", IMAGE), r"expected a Picture, such as Picture\(tensor .*, got"),
    (partial(write_sheet, "out.png", None), "panels must be a dict"),
    (partial(write_sheet, "out.png", {"before": Picture(IMAGE)}), "a panel must be a tensor"),
    (partial(shrunk, None, 8), "pixels must be a tensor"),
    (partial(shard_rows, [("a.png", "a.npy")]), "pairs must be at least one Pair in a list, as pairs_in"),
)
