"""The layers of a frame on a GPU: the host code of ``layers.cu``, whose comments have the formulas.

Tensors are float32, contiguous and on one device. ``B`` items have ``C`` channels. With kernels of ``E = C`` colours,
each colour is an item of one channel, which shares its places and weights with the item's other colours.
"""

import ctypes
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from . import loader
from .loader import Launch, pointer

MOST_SURFACES = 4  # of a pixel

_LAYERS = 16  # most layers of a launch
_TILE_ROWS, _TILE_COLUMNS, _ROWS = 16, 32, 4  # as in frame.h
_MOST_VALUES = 2**27  # most values of a launch's terms, 512 MB; larger: fewer launches, more memory

Surface = tuple[Tensor, Tensor, Tensor | None]
"""Light ``[B, C, H, W]``, place on the blur axis and weight (None: 1), ``[B, 1, H, W]``."""

_MAPS = ("light", "place", "weight")  # of a surface


class Frame(NamedTuple):
    """A padded frame without its surfaces, as :class:`torchdof.render.surfaces.frame.PaddedFrame`."""

    ramps: Tensor  # [1 or B, 2, n + 1]
    kernels: Sequence[Tensor]  # of n layers, near to far: [E, k, k] or [B, E, k, k]
    scales: Sequence[int]  # pixels of the frame in one of the layer, in both directions
    before_focus: Sequence[bool]
    margin: int
    area: tuple[int, int]
    stacked: bool
    backed: bool  # whether there is light behind all surfaces


class Group(NamedTuple):
    """Layers of one launch, far to near, and their canvas in pixels of their resolution."""

    layers: Sequence[int]
    scale: int
    height: int
    width: int
    more: int  # pixels around the picture: 1 in a coarse resolution
    inset: int

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of the grid: the canvas, and the pixels around it that kernels reach."""
        return self.height + 2 * self.inset, self.width + 2 * self.inset


class Over(NamedTuple):
    """The canvas of coarse layers, laid over the picture."""

    scale: int


class StandIns(NamedTuple):
    """Stand-ins for the background, laid over the picture."""


Step = Group | Over | StandIns


class Kept(NamedTuple):
    """What the gradients of a step need: the canvas before it, a coarse canvas, and the tables of tiles."""

    before: Tensor | None
    coarse: Tensor | None = None
    tables: Sequence[Tensor] = ()


@functools.cache
def module(channels: int, surfaces: int, stacked: bool, device: int) -> Launch:
    """The kernels for light of a number of channels and pixels of a number of surfaces, compiled for a CUDA device."""
    return loader.on_device(loader.text("layers.cu"), options(channels, surfaces, stacked), device)


def options(channels: int, surfaces: int, stacked: bool) -> list[str]:
    """The compiler's options for the kernels of :func:`module`."""
    numbers = {"CHANNELS": channels, "SURFACES": surfaces, "STACKED": int(stacked), "LAYERS": _LAYERS}
    return [f"-D{name}={number}" for name, number in numbers.items()]


@functools.cache
def argument_type(surfaces: int) -> type[ctypes.Structure]:
    """The structure that all kernels take, as ``frame.h`` defines it."""
    return loader.structure(loader.text("frame.h"), {"SURFACES": surfaces, "LAYERS": _LAYERS})


def steps_of(frame: Frame, items: int, values: int) -> list[Step]:
    """The steps of a composite, far to near, for ``items`` whose layers have ``values`` terms."""
    steps: list[Step] = []
    has_stand_ins, layers = True, list(range(len(frame.scales)))[::-1]
    while layers:
        run = [k for k in layers if _run_of(frame, k) == _run_of(frame, layers[0])]
        layers = layers[len(run) :]
        scale, is_before_focus = _run_of(frame, run[0])
        if is_before_focus and has_stand_ins:
            has_stand_ins = False
            steps.append(StandIns())
        more = int(scale > 1)
        height, width = (n // scale + 2 * more for n in frame.area)
        while run:
            halves = [frame.kernels[k].shape[-1] // 2 for k in run]
            inset = -(-max(halves) // _TILE_COLUMNS) * _TILE_COLUMNS
            group = Group(run, scale, height, width, more, inset)
            count = min(_LAYERS, max(1, _MOST_VALUES // (items * values * group.grid[0] * group.grid[1])))
            steps.append(group._replace(layers=run[:count]))
            run = run[count:]
        if more:
            steps.append(Over(scale))
    return steps


def _run_of(frame: Frame, layer: int) -> tuple[int, bool]:
    return frame.scales[layer], frame.before_focus[layer]


class Composite:
    """Computes the layers of a frame, and the gradients by its surfaces.

    Args:
        frame: The frame.
        surfaces: Its surfaces.
    """

    def __init__(self, frame: Frame, surfaces: Sequence[Surface]) -> None:
        batch, channels, rows, columns = surfaces[0][0].shape
        self._colours = frame.kernels[0].shape[-3]
        self._items, self._channels = batch * self._colours, channels // self._colours
        self._frame, self._surfaces = frame, surfaces
        self._kernels = [kernel.contiguous() for kernel in frame.kernels]
        device = surfaces[0][0].device
        self._launch = module(self._channels, len(surfaces), frame.stacked, device.index or 0)
        self.steps = steps_of(frame, self._items, self._channels + 2)
        self._common = argument_type(len(surfaces))(
            ramps=frame.ramps.data_ptr(),
            colours=self._colours,
            plans=len(frame.ramps),
            sets=frame.kernels[0].numel() // frame.kernels[0].shape[-1] ** 2,
            all_layers=len(frame.scales),
            frame_rows=rows,
            frame_columns=columns,
            margin=frame.margin,
            backed=frame.backed,
        )
        for i, name in enumerate(_MAPS):
            getattr(self._common, name)[:] = [pointer(maps[i]) for maps in surfaces]

    def picture(self, kept: list[Kept] | None = None) -> Tensor:
        """Light, then its weight of each colour, ``[B, C + E, h, w]``; ``kept`` collects what the gradients need."""
        picture: Tensor | None = None
        coarse: Tensor | None = None
        for step in self.steps:
            if isinstance(step, Group):
                of_step = Kept(coarse if step.more else picture, None, self._tables(step))
                after = self._empty(step.height, step.width)
                self._lay_over(step, of_step, after=after)
                picture, coarse = (picture, after) if step.more else (after, coarse)
            else:
                of_step, after = Kept(picture, coarse), self._empty(*self._frame.area)
                kernel = "upsample" if isinstance(step, Over) else "stand_ins"
                self._run(kernel, self._frame.area, self._over_picture(step, of_step, after=after))
                picture, coarse = after, None
            if kept is not None:
                kept.append(of_step)
        assert picture is not None
        if self._colours == 1:
            return picture
        return picture.unflatten(0, (-1, self._colours)).transpose(1, 2).flatten(1, 2)

    def gradients(self, of_picture: Tensor, kept: Sequence[Kept]) -> list[Tensor | None]:
        """The gradients by light, place and weight of each surface, from that of :meth:`picture`.

        Each group of layers is blurred again, so that only one group at a time takes memory for its blurred terms.
        """
        sums = [None if t is None else self._zeros_of_items(t) for maps in self._surfaces for t in maps]
        pointers = {f"of_{name}": [pointer(t) for t in sums[i::3]] for i, name in enumerate(_MAPS)}
        if self._colours == 1:
            slopes = of_picture.clone(memory_format=torch.contiguous_format)
        else:
            slopes = of_picture.unflatten(1, (-1, self._colours)).transpose(1, 2).flatten(0, 1).contiguous()
        of_coarse: Tensor | None = None
        for step, of_step in zip(self.steps[::-1], kept[::-1], strict=True):
            if isinstance(step, Group):
                of_canvas = of_coarse if step.more else slopes
                assert of_canvas is not None  # coarse layers come before their canvas, which has a gradient by now
                self._lay_over_back(step, of_step, of_canvas, pointers)
                continue
            argument = self._over_picture(step, of_step, of_after=slopes, **pointers)
            if isinstance(step, StandIns):
                self._run("stand_ins_back", self._frame.area, argument)
            else:
                assert of_step.coarse is not None
                of_coarse = torch.empty_like(of_step.coarse)
                argument.of_coarse = of_coarse.data_ptr()
                self._run("upsample_back", of_coarse.shape[-2:], argument)
                self._run("pass_back", self._frame.area, argument)
        if self._colours == 1:
            return sums
        of_colours = [None if t is None else t.unflatten(0, (-1, self._colours)) for t in sums]
        return [t if t is None else t[:, :, 0] if i % 3 == 0 else t.sum(1) for i, t in enumerate(of_colours)]

    def _tables(self, group: Group) -> list[Tensor]:
        """Tiles with pixels in a layer, tiles of the canvas that its light reaches, tiles whose terms these need."""
        tiles = [-(-n // side) for n, side in zip(group.grid, (_TILE_ROWS, _TILE_COLUMNS), strict=True)]
        batch, count = self._items // self._colours, len(group.layers)
        tables = [*self._surfaces[0][0].new_zeros(3, batch, count, *tiles, dtype=torch.int8)]
        argument = self._of_group(group, tables)
        self._run("mark", group.grid, argument, batch)
        self._run("find_lit", tiles, argument, batch * count)
        self._run("find_read", tiles, argument, batch * count)
        return tables

    def _lay_over(self, group: Group, of_group: Kept, **pointers: Tensor) -> Tensor:
        """Lays a group of layers over a canvas; returns the memory of its terms."""
        terms = self._empty(*group.grid, planes=len(group.layers) * (self._channels + 2))
        argument = self._of_group(group, of_group.tables, before=of_group.before, terms=terms, **pointers)
        self._run("terms", group.grid, argument)
        self._run("composite", (group.height, group.width), argument, rows=_ROWS)
        return terms

    def _lay_over_back(self, group: Group, of_group: Kept, of_after: Tensor, pointers: Any) -> None:
        """Adds the gradients by the surfaces of a group's pixels; ``of_after`` becomes that of the canvas before."""
        count = len(group.layers)
        blurred = self._empty(*group.grid, planes=count * (self._channels + 3)).zero_()
        terms = self._lay_over(group, of_group, kept=blurred, of_after=of_after)
        argument = self._of_group(group, of_group.tables, terms=terms, kept=blurred, of_after=of_after, **pointers)
        self._run("walk_back", (group.height, group.width), argument)
        self._run("convolve_back", group.grid, argument, self._items * count, rows=_ROWS)
        self._run("terms_back", [n * group.scale for n in group.grid], argument)

    def _of_group(self, group: Group, tables: Sequence[Tensor], **pointers: Any) -> Any:
        """The argument for a group of layers."""
        (height, width), grid = (group.height, group.width), group.grid
        tiles = tables[0].shape[-2:]
        argument = self._argument(**dict(zip(("occupied", "lit", "read"), tables, strict=True)), **pointers)
        for i, k in enumerate(group.layers):
            argument.kernel[i], argument.half[i] = self._kernels[k].data_ptr(), self._kernels[k].shape[-1] // 2
        numbers = {"layers": len(group.layers), "farthest": group.layers[0], "scale": group.scale, "inset": group.inset}
        numbers |= {"height": height, "width": width, "rows": grid[0], "columns": grid[1]}
        numbers |= {"tile_rows": tiles[0], "tile_columns": tiles[1]}
        numbers["start"] = self._frame.margin - (group.inset + group.more) * group.scale
        return _with_numbers(argument, numbers)

    def _over_picture(self, step: Step, kept: Kept, **pointers: Any) -> Any:
        """The argument for a step that lays one canvas over the picture."""
        argument = self._argument(before=kept.before, **pointers)
        numbers = {"height": self._frame.area[0], "width": self._frame.area[1]}
        if isinstance(step, Over) and kept.coarse is not None:
            argument.coarse = kept.coarse.data_ptr()
            size = kept.coarse.shape[-2:]
            numbers |= {"scale": step.scale, "coarse_height": size[0], "coarse_width": size[1]}
        return _with_numbers(argument, numbers)

    def _argument(self, **pointers: Any) -> Any:
        """A copy of what all arguments have, with pointers to tensors, or lists of pointers."""
        argument = type(self._common).from_buffer_copy(self._common)
        for name, value in pointers.items():
            if isinstance(value, list):
                getattr(argument, name)[:] = value
            else:
                setattr(argument, name, pointer(value))
        return argument

    def _run(
        self, kernel: str, size: Sequence[int], argument: ctypes.Structure, depth: int | None = None, rows: int = 1
    ) -> None:
        """Launches a kernel for ``depth`` (by default, the items) times ``size`` pixels; a thread has some rows."""
        grid = (-(-size[1] // _TILE_COLUMNS), -(-size[0] // _TILE_ROWS), depth or self._items)
        self._launch(kernel, grid, (_TILE_COLUMNS, _TILE_ROWS // rows, 1), argument)

    def _empty(self, height: int, width: int, planes: int | None = None) -> Tensor:
        like = self._surfaces[0][0]
        return like.new_empty(self._items, planes or self._channels + 1, height, width)

    def _zeros_of_items(self, values: Tensor) -> Tensor:
        """Zeros for the gradient by a map of each item."""
        return values.new_zeros(self._items, -(-values.shape[1] // self._colours), *values.shape[-2:])


def _with_numbers(argument: Any, numbers: dict[str, int]) -> Any:
    for name, number in numbers.items():
        setattr(argument, name, number)
    return argument
