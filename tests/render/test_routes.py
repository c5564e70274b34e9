"""The table of routes in :mod:`torchdof.render.routes` says what renders a call; each cell is tried."""

import functools
import logging
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.refused import refuses
from tests.scenes import CAMERA, lens_with_a_field
from torchdof import BlurTable, DepthOfField, blur_by_coc, native
from torchdof.export.graph import Portable
from torchdof.functional import splat
from torchdof.render import routes

HEIGHT, WIDTH = 20, 28
TURNED = BlurTable.polygon(6, rotation_deg=torch.tensor(10.0, requires_grad=True))
Call = Callable[[Tensor, Tensor], Any]


def table() -> Iterator[tuple[str, list[str]]]:
    """Rows of the table: the call, and what renders it in each column."""
    for line in (routes.__doc__ or "").splitlines():
        if line.startswith("| ") and not line.startswith(("| call", "| ---")):
            call, *cells = (cell.strip() for cell in line.strip("|").split("|"))
            yield call, cells


ROWS = dict(table())


def known_background(image: Tensor, coc: Tensor) -> Tensor:
    return blur_by_coc(image, coc, background=image.flip(-1), background_coc_px=coc.detach() + 3.0)


def layers(image: Tensor, coc: Tensor, count: int) -> Tensor:
    dof = DepthOfField(CAMERA)
    return dof.layers(
        torch.cat([image * 0.5, torch.full_like(coc, 0.5)], 1)[:, None].expand(-1, count, -1, -1, -1),
        coc[0, 0, 0, :count].abs() + 3,
    )


CALLS: dict[str, Call] = {
    "image": blur_by_coc,
    "image without occlusion": lambda image, coc: blur_by_coc(image, coc, occlusion=False),
    "a known background": known_background,
    "a matte": lambda image, coc: blur_by_coc(image, coc, matte=(coc.detach() < 1.0).to(coc.dtype)),
    "`attention`": lambda image, coc: blur_by_coc(image, coc, attention=(4.0, 5.0, 3.0)),
    "stack of up to 3 layers (`DepthOfField.layers`)": functools.partial(layers, count=3),
    "stack of more layers": functools.partial(layers, count=4),
    "a table whose blur depends on the place in the frame": lambda image, coc: blur_by_coc(
        image, coc, table=lens_with_a_field()
    ),
    '`method="fold"`': lambda image, coc: blur_by_coc(image, coc, method="fold"),
    "an aperture whose rotation or squeeze has a gradient": lambda image, coc: blur_by_coc(image, coc, table=TURNED),
    "kernels wider than 513 pixels of their layer": blur_by_coc,
    "`torchdof.functional.splat`": splat,
}
LOGGED = {cell: f"rendered by {routes._ENGINES[cell]}: " for cell in ("compiled", "steps", "kernels", "PyTorch")}


def scene(dtype: torch.dtype, gradients: bool) -> tuple[Tensor, Tensor]:
    image = torch.rand(1, 3, HEIGHT, WIDTH, dtype=dtype, generator=torch.Generator().manual_seed(0))
    coc = torch.linspace(-2.0, 5.0, WIDTH, dtype=dtype).repeat(1, 1, HEIGHT, 1)
    return image.requires_grad_(gradients), coc.requires_grad_(gradients)


def test_every_row_of_the_table_is_tried() -> None:
    assert [*ROWS] == [*CALLS]
    assert all(len(cells) == 6 for cells in ROWS.values())


def assert_rendered_as_the_table_says(
    call: str, column: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    if call == "kernels wider than 513 pixels of their layer":
        monkeypatch.setattr(native, "HALF_LARGEST", 3)
    caplog.set_level(logging.DEBUG, "torchdof")
    CALLS[call](*scene(torch.float64 if column == 3 else torch.float32, column == 1))
    if call == "`torchdof.functional.splat`":  # has no choice
        assert ROWS[call][column] == "PyTorch" and not caplog.messages
    else:
        assert caplog.messages
        assert all(message.startswith(LOGGED[ROWS[call][column]]) for message in caplog.messages), caplog.messages


@pytest.mark.skipif(not native.chosen(), reason="the compiled engine is not built")
@pytest.mark.parametrize("column", [0, 1, 3], ids=["float32", "gradients", "float64"])
@pytest.mark.parametrize("call", CALLS)
def test_eager_calls_are_rendered_by_the_engine_of_the_table(
    call: str, column: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "auto")
    assert_rendered_as_the_table_says(call, column, caplog, monkeypatch)


@pytest.mark.parametrize("call", CALLS)
def test_calls_with_tensors_of_a_gpu_are_rendered_by_the_engine_of_the_table(
    call: str, launched: list[str], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tensors on the CPU are taken for those of a GPU."""
    assert_rendered_as_the_table_says(call, 2, caplog, monkeypatch)
    assert bool(launched) == (ROWS[call][2] == "kernels")


@pytest.mark.parametrize("call", CALLS)
def test_calls_that_the_table_says_are_refused_in_a_graph_are_refused(
    call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(routes, "is_traced", lambda: True)
    tried = CALLS[call]
    if ROWS[call][4] == "refused":
        with pytest.raises(ValueError, match=r"cannot|take a table without"):
            tried(*scene(torch.float32, False))


FIELD, GRADIENT = (DepthOfField(CAMERA, table, depth_edges="as given") for table in (lens_with_a_field(), TURNED))

test_a_file_refuses_what_the_table_says = refuses(
    (lambda: Portable(FIELD, width=WIDTH), "take a table without vignetting or field"),
    (
        lambda: Portable(GRADIENT),
        "constant kernels, without a gradient to the aperture; detach its rotation and squeeze",
    ),
    (lambda: Portable(DepthOfField(CAMERA), layout="whole", depth_edges="auto"), "cannot repair depth edges"),
)


def test_without_the_compiled_engine_the_log_names_the_reason(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("TORCHDOF_ENGINE", "torch")
    caplog.set_level(logging.DEBUG, "torchdof")
    blur_by_coc(*scene(torch.float32, False))
    assert caplog.messages == ["rendered by PyTorch: torch (as TORCHDOF_ENGINE says)"]
