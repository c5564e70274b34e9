"""Reads, renders and writes one frame for ``torchdof render``; other commands use parts of it."""

import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from ..optics.aperture import Aperture
from ..optics.blur_table import BlurTable
from ..optics.camera import Camera
from ..options import Options
from ..render.resample import at_size_of
from ..validation import same_aspect, stretch
from .lens import Area
from .options import Scene, make_folder_of
from .output import Notices, print_result

if TYPE_CHECKING:
    from .render import Render

_VISIBLE_PX = 2.0  # px; a note advises more blur if the largest radius is below
_WITHOUT_EXIF = (".hdr", ".pfm")  # types in which OpenImageIO writes no EXIF data
_PANEL_PX = 800  # px; longer side of a panel on a sheet


@dataclasses.dataclass(frozen=True)
class Frame:
    """An image and its depth, as read."""

    name: str  # file with the depth
    scene: Scene  # the options, with the guess in the place of "auto"
    picture: Picture
    area: Area  # place of the picture in the frame to which lens and points refer
    values: Tensor  # [1, 1, H, W], depth in metres, or signed radius in pixels for coc
    filled: int  # number of filled holes, in pixels
    remarks: list[str]  # changes of the depth, and assumptions about it, that no option states
    guess: str  # message about the guessed kind of depth, or empty

    def mistakes(self, camera: Camera) -> list[Mistake]:
        """Likely mistakes in the depth, given the camera."""
        kind: Any = self.scene.depth_map.depth_kind
        mistakes = depth_mistakes(self.values, camera, kind, self.scene.depth_map.depth_scale)
        meant = ["blur"] * (self.scene.lens.blur_share is not None)  # --blur states it, so that no unit is wrong
        meant += ["gap"] * (len(self.scene.lens.focus_m or []) > 1)  # a focus pull passes between surfaces
        return [mistake for mistake in mistakes if mistake.name not in meant]


def read_frame(image: Path, depth: Path | None, scene: Scene, holes: bool = False, **encoding: Any) -> Frame:
    """Reads an image, as :func:`torchdof.io.images.read_image` does, and its depth, which may be a channel of it.

    A depth of the kind "auto" is guessed. Holes are filled as the options state. Without that option they stay NaN
    if ``holes`` is true; otherwise they are filled as the guess proposes, or raise ``ValueError``.
    """
    source, guess = depth or image, ""
    picture, depth_map = read_image(image, **encoding), scene.depth_map
    height, width = picture.pixels.shape[-2:]
    area = Area(0, 0, width, height)
    if picture.window is not None and image.suffix.lower() == ".exr":
        x, y, full_x, full_y, *size = picture.window
        area = Area(x - full_x, y - full_y, *size)
    if depth is not None or depth_map.depth_channel is not None:
        values = read_values(source, depth_map.depth_channel)
    elif picture.depth is not None:
        values = picture.depth
    else:
        hint = "" if image.suffix.lower() == ".exr" else ", which a network such as Depth Anything makes of it"
        raise ValueError(f"{image}: has no depth channel; name a depth file after it: IMAGE DEPTH{hint}")
    fill: Any = depth_map.fill_depth
    if depth_map.depth_kind == "auto":
        depth_map, guess = depth_map.guessed(values, source, scene.lens.states_metres)
        fill = fill if holes else depth_map.fill_depth
    kind: Any = depth_map.depth_kind
    rows, columns = values.shape[-2:]
    if kind == "coc" and (rows, columns) != (height, width):
        problem = f"coc is {columns} x {rows} pixels but the image is {width} x {height}; they must be the same"
        raise ValueError(f"{source}: {problem}")
    unknown, filled, place, view_deg = depth_map.depth_unknown, 0, (...,), None
    if kind == "distance":
        centred_width = width + abs(area.width - 2 * area.x - width)
        view_deg = scene.lens.view_deg(picture.metadata, centred_width, area)
    try:
        same_aspect(picture.pixels, values)
        stretched = stretch(picture.pixels, values)
        if kind == "relative":
            value_kind, value_range = depth_map.relative_kind or "disparity", depth_map.value_range
            values = from_relative(values, *depth_map.ends_m, value_kind, value_range=value_range, unknown=unknown)
        else:
            scale, offset = depth_map.depth_scale, depth_map.depth_offset
            if kind == "distance":
                values, place = area.centred(values, (height, width))
            values = depth_from_values(values, kind, scale=scale, offset=offset, unknown=unknown, fov_x_deg=view_deg)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    values = values if kind == "coc" else at_size_of(picture.pixels, values[place])
    if fill is not None or not holes:
        values, filled = resolve_holes(values, str(source), fill, kind in ("relative", "coc"))
    remarks = [f"depth stretched by {stretched:.1%}"] if stretched else []
    if kind == "relative" and None in (depth_map.near_m, depth_map.far_m):
        remarks.append("depth from {:g} to {:g} m assumed".format(*depth_map.ends_m))
    scene = dataclasses.replace(scene, depth_map=dataclasses.replace(depth_map, fill_depth=fill))
    return Frame(str(source), scene, picture, area, values, filled, remarks, guess)


def coc_of(
    frame: Frame, notices: Notices, number: int = 0, is_still: bool = True
) -> tuple[Tensor, Camera | None, list[str]]:
    """Signed radius ``[1, 1, H, W]`` in pixels, the camera (None for ``--depth-kind coc``), and remarks on both.

    ``number`` is the frame number, at which the focus is interpolated between keyframes.
    """
    depth_map, values = frame.scene.depth_map, frame.values
    if depth_map.depth_kind == "coc":
        notices.warn(frame.name, coc_mistakes(values))
        return values, None, []
    metadata, is_to_scale = frame.picture.metadata, depth_map.is_to_scale
    camera, remarks = frame.scene.lens.camera(metadata, values, frame.area, number, is_still, is_to_scale)
    coc_px = frame.area.coc_px(camera, values)
    camera.refuse_overflow(coc_px, values)
    notices.warn(frame.name, frame.mistakes(camera))
    return coc_px, camera, remarks + frame.remarks


def facts_of_camera(camera: Camera) -> dict[str, Any]:
    """The numbers of a camera, as data for JSON."""
    return {name: value for name, value in vars(camera).items() if name != "focus_breathing"}


@dataclasses.dataclass(frozen=True)
class Rendered:
    """A rendered picture, and what its report needs."""

    out: Path  # file to write
    frame: Frame  # with all remarks
    picture: Picture
    coc_px: Tensor
    camera: Camera | None
    seconds: float


class Renderer:
    """Reads, renders and writes the frames of ``torchdof render``."""

    def __init__(self, command: "Render", scene: Scene, is_still: bool, is_animation: bool) -> None:
        self.command, self.scene, self.is_still, self.is_animation = command, scene, is_still, is_animation
        self.table, self.device = command.blur.table_of(command.blur.table), _device(command.device)
        self.notices = Notices(scene.depth_map.strict)

    def read(self, image: Path, depth: Path | None) -> Frame:
        """Reads a frame as :func:`read_frame`, with the transfer curve and layer of the options."""
        files = self.command.files
        return read_frame(image, depth, self.scene, transfer=files.transfer, layer=files.layer)

    def render(self, frame: Frame, out: Path, number: int) -> Rendered:
        """Renders a frame of a number, to be written to ``out``."""
        start, picture, command = time.perf_counter(), frame.picture, self.command
        frame = dataclasses.replace(frame, values=frame.values.to(self.device))
        coc_px, camera, remarks = coc_of(frame, self.notices, number, self.is_still)
        pixels = picture.pixels.to(self.device)
        if command.show_focus:
            pixels = tint_focus(pixels, coc_px, picture.has_alpha)
            picture = dataclasses.replace(picture, channels=("R", "G", "B", "A")[: pixels.shape[1]])
        else:
            table = _with_alpha(self.table) if picture.has_alpha else self.table
            attention = command.attention
            if attention is not None:
                attention = (attention[0] - frame.area.x, attention[1] - frame.area.y, attention[2])
            if command.lights:
                pixels = _with_lights(picture, pixels, command.lights)
            with torch.no_grad():
                pixels = blur_by_coc(pixels, coc_px, table=table, attention=attention, **command.accuracy.arguments())
        frame, picture = dataclasses.replace(frame, remarks=remarks), dataclasses.replace(picture, pixels=pixels)
        return Rendered(out, frame, picture, coc_px, camera, time.perf_counter() - start)

    def write(self, rendered: Rendered) -> None:
        """Writes the picture, whole or not at all, and its sheet, and prints notes and one line."""
        command, files, seconds = self.command, self.command.files, rendered.seconds
        out, frame, camera, table = rendered.out, rendered.frame, rendered.camera, self.table
        make_folder_of(out)
        write_image(out, rendered.picture, files.out_transfer, files.bits)
        out = command.out if self.is_animation else out
        if files.sheet is not None:
            make_folder_of(files.sheet)
            write_sheet(files.sheet, _panels(rendered))
        (height, width), largest_px = rendered.coc_px.shape[-2:], float(rendered.coc_px.abs().max())
        if frame.guess:
            self.notices.note("guess", f"{frame.name}: {frame.guess}")
        if camera is not None and largest_px < _VISIBLE_PX:
            advice = "nothing is blurred, for all depth is in focus; focus elsewhere, or look at the depth"
            if largest_px:
                advice = f"the largest blur radius is {largest_px:.1f} px, which is hardly seen; open the lens wider, "
                advice += "with a smaller --f-number, a larger --blur, or a larger --aperture-radius-m"
            self.notices.note("little blur", f"{out}: {advice}")
        has_exif = any(name.startswith("Exif:") for name in frame.picture.metadata)
        if has_exif and out.suffix.lower() in _WITHOUT_EXIF:
            lost = f"EXIF data are lost in a {out.suffix} file; write .jpg, .png or .tif to keep them"
            self.notices.note("exif", f"{out}: {lost}")
        layers = ", ".join(frame.picture.other_layers)
        if layers and out.suffix.lower() == ".exr":
            self.notices.note("layers", f"{out}: is without the other layers of the image: {layers}")
        options = Options(**command.accuracy.arguments())
        facts = {
            "out": str(out),
            "camera": camera and facts_of_camera(camera),
            "largest_coc_px": largest_px,
            "filled_px": frame.filled,
            "show_focus": command.show_focus,
            "device": str(self.device),
            "table": table.name or table.family,
            "aperture": table.aperture and table.aperture.to_dict(),
            **{name: getattr(options, name) for name in ("method", "occlusion", "tolerance")},
            "attention": command.attention,
            "lights": command.lights,
            "assumed": frame.remarks,
            **{"width": width, "height": height, "seconds": seconds},
        }
        blur = f"{facts['table']}, {options.method}"
        words = [
            _inside(camera),
            f"blur radius up to {largest_px:.1f} px",
            "focus shown: near orange, sharp green, far blue" if command.show_focus else blur,
            _inside(table.aperture),
            "" if options.occlusion else "no occlusion",
            f"lights up to {command.lights:g} stops above white" if command.lights else "",
            f"{frame.filled} px of depth filled ({frame.scene.depth_map.fill_depth})" if frame.filled else "",
            f"sheet {files.sheet}" if files.sheet else "",
            f"{width} x {height}",
            f"{seconds:.2f} s on {self.device}",
        ]
        remarks = f" [{', '.join(frame.remarks)}]" if frame.remarks else ""
        print_result(command.as_json, facts, f"{out}: {'; '.join(filter(None, words))}{remarks}")


def _inside(value: Camera | Aperture | None) -> str:
    """The text of a camera or an opening without its brackets; "" for None."""
    return repr(value).partition("(")[2].removesuffix(")")


def _device(name: str) -> torch.device:
    """A device by name; "auto" is CUDA if available, else the CPU."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        torch.empty(1, device=device).sum().item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(f"--device {name}: there is no such device here; use cpu") from None
    return device


def _panels(rendered: Rendered) -> dict[str, Tensor]:
    """Panels of a sheet: caption -> ``[1, 3, H, W]`` in linear light."""
    frame = rendered.frame
    if rendered.camera is None:
        middle = {"blur radius: near orange, far blue": coc_colours(rendered.coc_px)}
    else:
        middle = {"depth: near is bright": depth_colours(frame.values)}
    panels = {"before": frame.picture.light, **middle, "after": rendered.picture.light}
    return {name: shrunk(panel.cpu(), _PANEL_PX).expand(-1, 3, -1, -1) for name, panel in panels.items()}


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
