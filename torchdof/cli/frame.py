"""Reads, renders and writes one frame for ``torchdof render``; other commands use parts of it."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from ..depth.holes import resolve_holes
from ..depth.inspect import coc_colours, depth_colours, tint_focus
from ..depth.kinds import depth_from_values
from ..depth.relative import from_relative
from ..depth.sanity import Mistake, coc_mistakes, depth_mistakes
from ..io.highlights import expand_highlights
from ..io.images import Picture, read_image, read_values, write_image
from ..io.sheet import shrunk, write_sheet
from ..module import blur_by_coc
from ..optics.blur_table import BlurTable
from ..optics.camera import CAMERA_NUMBERS, Camera
from ..options import Options
from ..render.resample import at_size_of
from ..validation import coc_of_lens, same_aspect, stretch
from .options import make_folder_of, pick_device
from .printed import Bar, WarnOnce, note, tell
from .scene import Scene

if TYPE_CHECKING:
    from .render import Render

__all__ = ["Frame", "Rendered", "Renderer", "coc_of", "facts_of_camera", "read_frame"]

_HARDLY_PX = 2.0  # px; a note advises more blur if the largest radius is below
_LARGE_PX = 8_000_000  # pixels of an image; the bar shows the expected time of larger ones
_STRIPS = 16  # number of strips of an image, of which one is timed
_PANEL_PX = 800  # px; longer side of a panel on a sheet


@dataclasses.dataclass(frozen=True)
class Frame:
    """An image and its depth, as read."""

    name: str  # file with the depth
    scene: Scene  # the options, with the guess in the place of "auto"
    picture: Picture
    values: Tensor  # [1, 1, H, W], depth in metres, or signed radius in pixels for coc
    holes: int  # number of filled pixels
    seconds: float  # time of reading
    stretch: float  # relative stretch of the depth along one axis to the aspect of the image
    guess: str  # message about the guessed kind of depth, or empty

    def mistakes(self, camera: Camera) -> list[Mistake]:
        """Likely mistakes in the depth, given the camera."""
        said = self.scene.depth_map
        kind: Any = said.depth_kind
        return depth_mistakes(self.values, camera, kind, said.depth_scale)

    @property
    def remarks(self) -> list[str]:
        """Changes of the depth, and assumptions about it, that no option states."""
        said, remarks = self.scene.depth_map, [f"depth stretched by {self.stretch:.1%}"] if self.stretch else []
        if said.depth_kind == "relative" and None in (said.near_m, said.far_m):
            remarks.append("depth from {:g} to {:g} m assumed".format(*said.ends_m))
        return remarks


def read_frame(image: Path, depth: Path | None, scene: Scene, holes: bool = False, **encoding: Any) -> Frame:
    """Reads an image, as :func:`torchdof.io.images.read_image` does, and its depth, which may be a channel of it.

    A depth of the kind "auto" is guessed. Holes are filled as the options state. Without that option they stay NaN
    if ``holes`` is true; otherwise they are filled as the guess proposes, or raise ``ValueError``.
    """
    start, source, guess = time.perf_counter(), depth or image, ""
    picture, filled = read_image(image, **encoding), 0
    if depth is not None or scene.depth_map.depth_channel is not None:
        values = read_values(source, scene.depth_map.depth_channel)
    elif picture.depth is not None:
        values = picture.depth
    else:
        raise ValueError(f"{image}: has no depth channel; name a depth file after it: IMAGE DEPTH")
    if scene.depth_map.depth_kind == "auto":
        said, guess = scene.depth_map.guessed(values, source, scene.lens.speaks_of_metres)
        fill = scene.depth_map.fill_depth if holes else said.fill_depth
        scene = dataclasses.replace(scene, depth_map=dataclasses.replace(said, fill_depth=fill))
    values, stretched = _metres(values, str(source), picture, scene)
    said, fill = scene.depth_map, cast(Any, scene.depth_map.fill_depth)
    if fill is not None or not holes:
        values, filled = resolve_holes(values, str(source), fill, said.depth_kind == "relative")
    return Frame(str(source), scene, picture, values, filled, time.perf_counter() - start, stretched, guess)


def _metres(values: Tensor, name: str, picture: Picture, scene: Scene) -> tuple[Tensor, float]:
    """Depth in metres (signed pixels for coc), ``[1, 1, H, W]`` at the image's size, NaN in holes; and its stretch."""
    said, pixels = scene.depth_map, picture.pixels
    kind: Any = said.depth_kind
    sizes = [f"{t.shape[-1]} x {t.shape[-2]}" for t in (values, pixels)]
    if kind == "coc" and sizes[0] != sizes[1]:
        raise ValueError(f"{name}: coc is {sizes[0]} pixels but the image is {sizes[1]}; they must be the same")
    try:
        same_aspect(pixels, values)
        stretched = stretch(pixels, values)
        if kind == "relative":
            options: dict[str, Any] = {"value_range": said.value_range, "unknown": said.depth_unknown}
            values = from_relative(values, *said.ends_m, said.relative_kind or "disparity", **options)
            return at_size_of(pixels, values), stretched
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    height, width = pixels.shape[-2:]
    view_deg = scene.lens.view_deg(picture.metadata, width, height) if kind == "distance" else None
    metres = depth_from_values(
        values, kind, scale=said.depth_scale, offset=said.depth_offset, unknown=said.depth_unknown, fov_x_deg=view_deg
    )
    return (metres if kind == "coc" else at_size_of(pixels, metres)), stretched


def coc_of(
    frame: Frame, warned: WarnOnce, number: int = 0, is_still: bool = True
) -> tuple[Tensor, Camera | None, list[str]]:
    """Signed radius ``[1, 1, H, W]`` in pixels, the camera (None for ``--depth-kind coc``), and remarks on both.

    ``number`` is the frame number, at which the focus is interpolated between keyframes.

    Raises:
        ValueError: If the lens is impossible, or a mistake is likely and ``warned`` is strict.
    """
    said, lens, values = frame.scene.depth_map, frame.scene.lens, frame.values
    if said.depth_kind == "coc":
        warned.warn(frame.name, coc_mistakes(values))
        return values, None, []
    camera, remarks = lens.camera(frame.picture.metadata, values, number, is_still, said.is_to_scale)
    remarks += frame.remarks
    coc_px = camera.coc_px(values, values.shape[-1])
    coc_of_lens(coc_px, values, lens.stated(camera))
    warned.warn(frame.name, frame.mistakes(camera))
    return coc_px, camera, remarks


def facts_of_camera(camera: Camera) -> dict[str, Any]:
    """The numbers of a camera, as data for JSON."""
    return {name: float(getattr(camera, name)) for name in CAMERA_NUMBERS}


@dataclasses.dataclass(frozen=True)
class Rendered:
    """A rendered picture with its report."""

    out: Path  # file to write
    picture: Picture
    panels: dict[str, Tensor]  # caption -> panel of the sheet
    notes: dict[str, str]  # kind -> note; each kind is printed once
    words: list[str]  # parts of the printed line
    facts: dict[str, Any]  # the same as data for JSON
    seconds: float  # time of reading and rendering


class Renderer:
    """Reads, renders and writes the frames of ``torchdof render``."""

    def __init__(self, command: "Render", scene: Scene, is_still: bool = True) -> None:
        self.command, self.scene, self.is_still = command, scene, is_still
        self.table, self._noted = command.blur.chosen(), set[str]()
        self.device, self.warned = pick_device(command.device), WarnOnce(command.scene.depth_map.strict)

    def read(self, image: Path, depth: Path | None) -> Frame:
        """Reads a frame as :func:`read_frame`, with the transfer curve and layer of the options."""
        files = self.command.files
        return read_frame(image, depth, self.scene, transfer=files.transfer, layer=files.layer)

    def render(self, frame: Frame, out: Path, number: int = 0, bar: Bar | None = None) -> Rendered:
        """Renders a frame; ``bar`` shows the expected time of a large one. Raises as :func:`coc_of`."""
        start, picture, command = time.perf_counter(), frame.picture, self.command
        frame = dataclasses.replace(frame, values=frame.values.to(self.device))
        coc_px, camera, remarks = coc_of(frame, self.warned, number, self.is_still)
        pixels = picture.pixels.to(self.device)
        if command.show_focus:
            pixels = tint_focus(pixels, coc_px, picture.has_alpha)
            picture = dataclasses.replace(picture, channels=("R", "G", "B", "A")[: pixels.shape[1]])
        else:
            table = _with_alpha(self.table) if picture.has_alpha else self.table
            options: dict[str, Any] = command.accuracy.options() | {
                "depth_edges": command.depth_edges.replace("-", " ")
            }
            blur: Callable[..., Tensor] = functools.partial(blur_by_coc, table=table, **options)
            with torch.no_grad():
                if command.lights:
                    pixels = _with_lights(picture, pixels, command.lights)
                if bar is not None and bar.is_seen and coc_px.numel() > _LARGE_PX:
                    bar.update(f"rendering {out.name}, about {_seconds(blur, pixels, coc_px):.0f} s")
                pixels = blur(pixels, coc_px, attention=command.attention)
        largest_px, notes = float(coc_px.abs().max()), dict[str, str]()
        if frame.guess:
            notes["guess"] = f"{frame.name}: {frame.guess}"
        if camera is not None and largest_px < _HARDLY_PX:
            notes["blur"] = f"{out}: {command.scene.lens.more_blur(largest_px, self.is_still)}"
        words, facts = self._told(camera, largest_px, frame)
        facts |= {"assumed": remarks, "width": pixels.shape[-1], "height": pixels.shape[-2]}
        seconds = frame.seconds + time.perf_counter() - start
        picture = dataclasses.replace(picture, pixels=pixels)
        panels = _panels(frame, coc_px, picture) if command.files.sheet else {}
        return Rendered(out, picture, panels, notes, words, facts, seconds)

    def write(self, rendered: Rendered) -> None:
        """Writes the picture, whole or not at all, and its sheet, and prints one line."""
        start, files = time.perf_counter(), self.command.files
        make_folder_of(rendered.out)
        write_image(rendered.out, rendered.picture, files.out_transfer, files.bits)
        if rendered.panels and files.sheet is not None:
            make_folder_of(files.sheet)
            write_sheet(files.sheet, rendered.panels)
            rendered.words.append(f"sheet {files.sheet}")
        seconds = rendered.seconds + time.perf_counter() - start
        facts = {"out": str(rendered.out), **rendered.facts, "seconds": seconds}
        remarks = f" [{', '.join(facts['assumed'])}]" if facts["assumed"] else ""
        note(*(line for name, line in rendered.notes.items() if name not in self._noted))
        self._noted |= set(rendered.notes)
        words = [*rendered.words, f"{facts['width']} x {facts['height']}", f"{seconds:.2f} s on {facts['device']}"]
        tell(self.command.as_json, facts, f"{rendered.out}: {'; '.join(words)}{remarks}")

    def _told(self, camera: Camera | None, largest_px: float, frame: Frame) -> tuple[list[str], dict[str, Any]]:
        """Parts of the printed line about a frame, and the same as data for JSON."""
        command, table, words = self.command, self.table, list[str]()
        facts: dict[str, Any] = {"camera": None, "largest_coc_px": largest_px, "filled_px": frame.holes}
        facts |= {"show_focus": command.show_focus, "device": str(self.device)}
        if camera is not None:
            ends, angles = camera.focus_range_m, {"tilt": camera.tilt_deg, "swing": camera.swing_deg}
            facts["camera"] = facts_of_camera(camera) | {f"{name}_deg": float(a) for name, a in angles.items()}
            facts["camera"]["focus_range_m"] = None if ends is None else [float(end) for end in ends]
            focus = " to ".join(f"{end:.4g}" for end in ends or (camera.focus_m,))
            lens = f"{camera.focal_length_mm:.4g} mm on {camera.sensor_width_mm:.4g} mm"
            words.append(f"focus {focus} m, f/{camera.f_number:.3g}, {lens}")
            words += [f"{name} {angle:.4g} degrees" for name, angle in angles.items() if angle != 0.0]
        words.append(f"blur radius up to {largest_px:.1f} px")
        if command.show_focus:
            words.append("focus shown: near orange, sharp green, far blue")
        else:
            name, aperture = table.name or table.family, table.aperture
            options = Options.of(**command.accuracy.options())
            words.append(f"{name}, {options.method}")
            words += [] if aperture is None else [repr(aperture).removeprefix("Aperture(").removesuffix(")")]
            words += [] if options.occlusion else ["no occlusion"]
            facts |= {"table": name, "aperture": None if aperture is None else aperture.to_dict()}
            facts |= {name: getattr(options, name) for name in ("method", "occlusion", "tolerance")}
            facts |= {"attention": command.attention, "lights": command.lights}
            words += [f"lights up to {command.lights:g} stops above white"] if command.lights else []
        words += [f"{frame.holes} px of depth filled ({frame.scene.depth_map.fill_depth})"] if frame.holes else []
        return words, facts


def _panels(frame: Frame, coc_px: Tensor, after: Picture) -> dict[str, Tensor]:
    """Panels of a sheet: caption -> ``[1, 3, H, W]`` in linear light."""
    if frame.scene.depth_map.depth_kind == "coc":
        middle = {"blur radius: near orange, far blue": coc_colours(coc_px)}
    else:
        middle = {"depth: near is bright": depth_colours(frame.values)}
    panels = {"before": frame.picture.light, **middle, "after": after.light}
    return {name: shrunk(panel.cpu(), _PANEL_PX).expand(-1, 3, -1, -1) for name, panel in panels.items()}


def _seconds(blur: Callable[..., Tensor], pixels: Tensor, coc_px: Tensor) -> float:
    """Expected time of ``blur`` in seconds, extrapolated from a strip across the middle of the image."""
    start, height = time.perf_counter(), pixels.shape[-2]
    strip = (..., slice(height // 2, height // 2 + math.ceil(height / _STRIPS)), slice(None))
    blur(pixels[strip], coc_px[strip])
    return _STRIPS * (time.perf_counter() - start)


def _with_lights(picture: Picture, pixels: Tensor, stops: float) -> Tensor:
    """Pixels with the light of clipped lamps restored; alpha is unchanged. Refuses floats, which do not clip."""
    if picture.sample in ("half", "float"):
        raise ValueError(
            f"--lights is for photographs of 8 or 16 bits, which clip at white; this image holds {picture.sample} "
            "numbers, light above white included: leave --lights out"
        )
    colours = picture.light.shape[1]
    return torch.cat([expand_highlights(pixels[:, :colours], stops), pixels[:, colours:]], 1)


def _with_alpha(table: BlurTable) -> BlurTable:
    """The table with a channel for alpha, which is blurred like green."""
    if table.channels == 1:
        return table
    params = {name: torch.cat([v, v[1:2]]) for name, v in table.node_params.items()}
    field = table.field
    if field is not None:
        field = dataclasses.replace(field, light=torch.cat([field.light, field.light[1:2]]))
    return table.replace(params=params, field=field)
