"""Reads, renders and writes one frame for ``torchdof render``; other commands use parts of it."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from ..depth.guess import looks_relative
from ..depth.holes import resolve_holes
from ..depth.inspect import coc_colours, depth_colours, tint_focus
from ..depth.kinds import depth_from_values
from ..depth.relative import from_relative
from ..depth.sanity import Mistake, coc_mistakes, depth_mistakes, whole_numbers
from ..depth.sentinels import without_sentinels
from ..io.colour import stated_primaries
from ..io.estimates import Estimate, estimate_of
from ..io.highlights import expand_highlights
from ..io.images import Picture, read_image, read_map, write_image
from ..io.matte import matte_of_size, read_matte
from ..io.picture import can_state_transfer, keeps_profile
from ..io.sheet import shrunk, write_sheet
from ..module import blur_by_coc
from ..optics.aperture import Aperture
from ..optics.blur_table import BlurTable
from ..optics.camera import Camera
from ..options import Options
from ..render.surfaces.resample import resampled
from ..validation import one_channel, stretched, upright
from .command import refuse
from .lens import Area, Lens
from .options import INTEGER_TYPES, LIKE_RELATIVE, Scene
from .output import Notices, print_result, rounded

if TYPE_CHECKING:
    from .render import Render

_VISIBLE_PX = 2.0  # px; a note advises more blur if the largest radius is below
_WITHOUT_EXIF = (".hdr", ".pfm")  # types in which OpenImageIO writes no EXIF data
_OPTIONS = {  # first words of an assumption: options that change it
    "focus": "--focus-at, --focus-m",
    "focal length": "--focal-length-mm, --equivalent",
    "f-number": "--blur, --f-number",
    "sensor width": "--sensor-width-mm, --equivalent",
    "depth": "--near-m, --far-m",
}
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
    fov_x_deg: float | None = None  # horizontal field of view that the depth file states
    matte: Tensor | None = None  # [1, 1, H, W], coverage by a subject

    def mistakes(self, camera: Camera) -> list[Mistake]:
        """Likely mistakes in the depth, given the camera."""
        kind: Any = self.scene.depth_kind
        meant = ["blur"] * (self.scene.blur is not None)  # --blur states it, so that no unit is wrong
        meant += ["gap"] * (len(self.scene.focus_m or []) > 1)  # a focus pull passes between surfaces
        mistakes = depth_mistakes(self.values, camera, kind, self.scene.depth_scale)
        return [mistake for mistake in mistakes if mistake.name not in meant]


def read_frame(
    image: Path | Picture,
    depth: Path | Tensor | None,
    scene: Scene,
    holes: bool = False,
    place: tuple[int, int] | None = None,
    **encoding: Any,
) -> Frame:
    """Reads an image, with arguments of ``read_image``, and its depth; ``holes`` that no option fills stay NaN.

    Both may be in memory already; depth is then the numbers of a map.
    ``place`` is the index of the image in its sequence, and their number, for a file with a map for each of them.
    """
    picture = image if isinstance(image, Picture) else read_image(image, **encoding)
    image = Path("image") if isinstance(image, Picture) else image
    values, depth = (depth.detach().cpu(), Path("depth")) if isinstance(depth, Tensor) else (None, depth)
    source, meaning = depth or image, cast(Mapping[str, Any], {})
    height, width = picture.pixels.shape[-2:]
    is_exr = image.suffix.lower() == ".exr"
    x, y, full_x, full_y, *size = (picture.window if is_exr else None) or (0, 0, 0, 0, width, height)
    area = Area(x - full_x, y - full_y, *size)
    if values is not None:
        one_channel("depth", values, whole=True)
        values = values.float()
    elif depth is not None or scene.depth_channel is not None:
        values, meaning = read_map(source, scene.depth_channel, place, picture)
    elif picture.depth is not None:
        values, meaning = picture.depth, picture.depth_meaning
    elif picture.depth_problem:
        raise ValueError(f"{image}: {picture.depth_problem}")
    elif is_exr and picture.other_layers:
        values, meaning = read_map(image)  # whose error lists the channels
    else:
        hint = "" if is_exr else ", which a network such as Depth Anything makes of it"
        raise ValueError(f"{image}: has no depth channel; name a depth file after it: IMAGE DEPTH{hint}")
    is_file = depth is not None and depth.is_file()
    estimate = estimate_of(source, values.shape[-1], place) if is_file else Estimate()
    scene, guess = scene.with_meaning(meaning) if meaning else (scene, "")
    known = values if scene.depth_unknown is None else values.masked_fill(values == scene.depth_unknown, math.nan)
    known, sentinels = without_sentinels(known)
    if scene.depth_kind == "auto":
        is_metric = bool(scene.given(Lens) & {"focus_m", "focus_range", "aperture_radius_m"})
        stated_fill = scene.fill_depth
        scene, guess = scene.guessed(known, source, is_metric)
        scene = dataclasses.replace(scene, fill_depth=stated_fill) if holes else scene
        if estimate.metric_scale is not None and scene.depth_kind == "z" and scene.depth_scale is None:
            guess += f"; of the metric model of Depth Anything 3: --depth-scale {estimate.metric_scale:.4g}"
    kind: Any = scene.depth_kind
    is_whole = source.suffix.lower() in INTEGER_TYPES or whole_numbers(known[known.isfinite()])
    is_sky = kind in ("z", "distance") and not is_whole  # a renderer writes a large distance where nothing is
    if not sentinels or is_sky or kind == "coc" or scene.value_range is not None:
        sentinels = ""
    else:
        values = known
        scene = scene if holes or scene.strict else dataclasses.replace(scene, fill_depth=scene.fill_depth or "far")
    if kind == "relative" and scene.relative_kind == "depth":  # -inf is too near to be measured
        values = torch.where(values == -math.inf, torch.where(known.isfinite(), known, math.inf).min(), values)
    rows, columns = values.shape[-2:]
    try:
        if kind == "coc" and (rows, columns) != (height, width):
            sizes = f"{columns} x {rows} pixels but the image is {width} x {height}"
            raise ValueError(f"coc is {sizes}; they must be the same")
        upright(picture.pixels, values)
        remarks = list(filter(None, [sentinels, stretched(picture.pixels, values)]))
        given: dict[str, Any] = {"unknown": scene.depth_unknown}
        part: Any = (...,)
        is_along_ray = kind == "distance" or (kind == "relative" and "along_ray" in meaning)
        if is_along_ray:
            centred_width = width + abs(area.width - 2 * area.x - width)
            given["fov_x_deg"] = scene.view_deg(picture.metadata, centred_width, area, estimate.fov_x_deg)
            values, part = area.centred(values, (height, width))
        if kind == "relative":
            given["value_range"] = scene.value_range
            fov_x_deg = given.pop("fov_x_deg", None)
            values = from_relative(values, *scene.ends_m, scene.relative_kind or "disparity", **given)
            if is_along_ray:
                values = depth_from_values(values, "distance", fov_x_deg=fov_x_deg)
        else:
            values = depth_from_values(values, kind, scale=scene.depth_scale, offset=scene.depth_offset, **given)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None
    values, filled = values if kind == "coc" else resampled(picture.pixels, values[part]), 0
    fill_by: Any = scene.fill_depth
    if fill_by is not None or not holes:
        values, filled = resolve_holes(values, str(source), fill_by, kind in ("relative", "coc"))
    if kind == "relative" and None in (scene.near_m, scene.far_m):
        remarks.append("depth from {:g} to {:g} m assumed".format(*scene.ends_m))
    return Frame(str(source), scene, picture, area, values, filled, remarks, guess, estimate.fov_x_deg)


def coc_of(
    frame: Frame, notices: Notices, number: int = 0, is_still: bool = True
) -> tuple[Tensor, Camera | None, list[str]]:
    """Signed radius ``[1, 1, H, W]`` in pixels, the camera (None for ``--depth-kind coc``), and remarks on both."""
    scene, values = frame.scene, frame.values
    if scene.depth_kind == "coc":
        notices.warn(frame.name, coc_mistakes(values))
        return values, None, []
    camera, remarks = scene.camera(frame, number, is_still)
    coc_px = frame.area.coc_px(camera, values)
    camera.refuse_overflow(coc_px, values)
    if frame.guess:
        notices.note("guess", f"{frame.name}: {frame.guess}")
    notices.warn(frame.name, frame.mistakes(camera))
    return coc_px, camera, remarks + frame.remarks


class Renderer:
    """Reads, renders and writes the frames of ``torchdof render``."""

    def __init__(self, command: "Render", is_still: bool, is_assumed: bool = False) -> None:
        """``is_assumed``: no option states that depth is in metres."""
        self.command, self.is_still = command, is_still
        self.has_table = False  # whether assumptions are a table below the line of a picture
        self.table, self.device = command.blur_table(), _device(command.device)
        self.notices, self.is_assumed = Notices(command.strict), is_assumed

    def read(
        self,
        image: Path | Picture,
        depth: Path | Tensor | None,
        place: tuple[int, int] | None = None,
        matte: Path | None = None,
    ) -> Frame:
        """Reads a frame as :func:`read_frame`, with the transfer curve and layers of the options.

        ``matte`` is the file of this frame, if the option names a sequence or a folder.
        """
        names = ("transfer", "layer", "keep_layers")
        encoding: Any = {name: getattr(self.command, name) for name in names}
        frame = read_frame(image, depth, self.command, place=place, **encoding)
        return dataclasses.replace(frame, matte=self._matte(frame.picture, matte))

    def _matte(self, picture: Picture, of_frame: Path | None) -> Tensor | None:
        """The coverage by a subject that the options name, or that the picture brings along."""
        given: Any = of_frame or self.command.matte
        if given is None:
            return None if self.command.no_occlusion else picture.matte
        if isinstance(given, Tensor):
            one_channel("matte", given)
            return matte_of_size(given.detach().cpu().float(), picture.pixels.shape[-2:])
        if str(given) == "none":
            return None
        return read_matte(given, picture.pixels.shape[-2:], picture.window)

    def render(self, frame: Frame, out: Path, number: int) -> Callable[[], None]:
        """Renders a frame of a number; returns the function that writes it to ``out``."""
        start = time.perf_counter()
        rendered = self.rendered(frame, number)
        return functools.partial(self.write, out, *rendered, seconds=time.perf_counter() - start)

    def rendered(self, frame: Frame, number: int = 0) -> tuple[Frame, Picture, Tensor, Camera | None]:
        """The frame with all remarks, its picture after rendering, the signed blur radius in pixels, and the camera."""
        picture, command = frame.picture, self.command
        frame = dataclasses.replace(frame, values=frame.values.to(self.device))
        if self.is_assumed and looks_relative(frame.values):
            message = f"taken for metres, as in every sequence without --depth-kind, but {LIKE_RELATIVE}"
            self.notices.warn(frame.name, [Mistake("relative", message)])
        coc_px, camera, remarks = coc_of(frame, self.notices, number, self.is_still)
        pixels, colours = picture.pixels.to(self.device), picture.light.shape[1]
        if command.show_focus:
            pixels = tint_focus(pixels, coc_px, picture.has_alpha)
            picture = dataclasses.replace(picture, channels=("R", "G", "B", "A")[: pixels.shape[1]])
        else:
            if command.lights:
                is_float, sample = picture.sample in ("half", "float"), picture.sample
                refuse((is_float, f"--lights is for photographs of 8 or 16 bits; leave it out for {sample} numbers"))
                pixels = torch.cat([expand_highlights(pixels[:, :colours], command.lights), pixels[:, colours:]], 1)
            attention = command.attention
            if attention is not None:
                attention = (attention[0] - frame.area.x, attention[1] - frame.area.y, attention[2])
            table = _with_alpha(self.table) if picture.has_alpha else self.table
            with torch.no_grad():
                given: Any = {"table": table, "attention": attention, **command.arguments()}
                matte = None if frame.matte is None else frame.matte.to(self.device)
                pixels = blur_by_coc(pixels, coc_px, matte=matte, **given)
        picture = dataclasses.replace(picture, pixels=pixels)
        return dataclasses.replace(frame, remarks=remarks), picture, coc_px, camera

    def write(
        self, out: Path, frame: Frame, picture: Picture, coc_px: Tensor, camera: Camera | None, seconds: float
    ) -> None:
        """Writes the picture, whole or not at all, and its sheet, and prints notes and one line."""
        command, note = self.command, self.notices.note
        write_image(out, picture, command.out_transfer, command.bits)
        if command.sheet is not None:
            caption, colours = "depth: near is bright", depth_colours(frame.values)
            if camera is None:
                caption, colours = "blur radius: near orange, far blue", coc_colours(coc_px)
            panels = {"before": frame.picture.light, caption: colours, "after": picture.light}
            small = {name: shrunk(p.cpu(), _PANEL_PX).expand(-1, 3, -1, -1) for name, p in panels.items()}
            write_sheet(command.sheet, small)
        (height, width), largest_px = coc_px.shape[-2:], float(coc_px.abs().max())
        if camera is not None and largest_px < _VISIBLE_PX:
            wider = "open the lens wider, with a smaller --f-number, a larger --blur, or a larger --aperture-radius-m"
            little = f"the largest blur radius is {largest_px:.1f} px, which is hardly seen; {wider}"
            none = "nothing is blurred, for all depth is in focus; focus elsewhere, or look at the depth"
            note("little blur", f"{out}: {little if largest_px else none}")
        has_exif, suffix = any(name.startswith("Exif:") for name in frame.picture.metadata), out.suffix.lower()
        if has_exif and suffix in _WITHOUT_EXIF:
            note("exif", f"{out}: EXIF data are lost in a {suffix} file; write .jpg, .png or .tif to keep them")
        if frame.picture.matte is not None and frame.matte is not None and command.matte is None:
            note("matte", f"{out}: the own matte of the portrait decides where the subject ends (else --matte)")
        if frame.picture.other_layers and suffix == ".exr" and not command.keep_layers:
            layers = ", ".join(frame.picture.other_layers)
            note("layers", f"{out}: is without the other layers of the image: {layers} (--keep-layers)")
        if picture.is_stated:
            is_kept = can_state_transfer(picture, suffix) and command.out_transfer is None
            kept = picture.transfer if is_kept else "another encoding"
            stated = f"{command.image}: states that it is encoded as {picture.transfer}, and is decoded so"
            note("transfer", f"{stated} (else --transfer); {out} has {kept}")
        has_profile = keeps_profile(picture, suffix) and command.out_transfer is None
        if stated_primaries(picture.metadata) is not None and not has_profile:
            is_kept = suffix == ".exr" or (suffix == ".png" and "CICP" in picture.metadata)
            kept = "keeps the primaries of the image" if is_kept else "has the primaries of sRGB, converted"
            note("primaries", f"{out}: {kept}; the image states others than those of sRGB")
        options, table = Options(**command.arguments()), self.table
        facts = {
            "out": str(out),
            "camera": camera and vars(camera),
            "largest_coc_px": largest_px,
            "filled_px": frame.filled,
            "device": str(self.device),
            "table": table.name or table.family,
            "aperture": table.aperture and table.aperture.to_dict(),
            **{name: getattr(options, name) for name in ("method", "occlusion", "tolerance")},
            **{name: getattr(command, name) for name in ("attention", "lights", "show_focus")},
            "assumed": frame.remarks,
            **{"width": width, "height": height, "seconds": seconds},
        }
        shown = "focus shown: near orange, sharp green, far blue"
        words = [
            rounded(_inside(camera)),
            f"blur radius up to {largest_px:.1f} px",
            shown if command.show_focus else f"{facts['table']}, {options.method}",
            _inside(table.aperture),
            "" if options.occlusion else "no occlusion",
            f"lights up to {command.lights:g} stops above white" if command.lights else "",
            f"{frame.filled} px of depth filled ({frame.scene.fill_depth})" if frame.filled else "",
            f"sheet {command.sheet}" if command.sheet else "",
            f"{width} x {height}",
            f"{seconds:.2f} s on {self.device}",
        ]
        remarks = f" [{', '.join(frame.remarks)}]" if frame.remarks else ""
        if self.has_table and frame.remarks:
            remarks = "\n" + _table(frame.remarks, camera)
        print_result(command.as_json, facts, f"{out}: {'; '.join(filter(None, words))}{remarks}")


def _inside(value: Camera | Aperture | None) -> str:
    """The text of a camera or an opening without its brackets; "" for None."""
    return repr(value).partition("(")[2].removesuffix(")")


def _table(remarks: list[str], camera: Camera | None) -> str:
    """Assumptions as lines of three columns: a number, its source, and the options that change it."""
    numbers = (
        {}
        if camera is None
        else {
            "focus": f"{float(camera.focus_m)} m",
            "focal length": f"{float(camera.focal_length_mm)} mm",
            "f-number": f"f/{float(camera.f_number)}",
            "sensor width": f"{float(camera.sensor_width_mm)} mm",
        }
    )
    rows = []
    for remark in remarks:
        name = next((name for name in _OPTIONS if remark.startswith(name)), "")
        source = remark.removeprefix(name).strip()
        options = "" if "stretched" in source else _OPTIONS.get(name, "")
        rows.append((name, rounded(", ".join(filter(None, (numbers.get(name, ""), source)))), options))
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    return "\n".join(f"  {a:{widths[0]}}  {b:{widths[1]}}  {c}".rstrip() for a, b, c in rows)


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


def _with_alpha(table: BlurTable) -> BlurTable:
    """The table with a channel for alpha, which is blurred like green."""
    if table.channels == 1:
        return table
    params = {name: torch.cat([v, v[1:2]]) for name, v in table.node_params.items()}
    field = table.field
    if field is not None:
        field = dataclasses.replace(field, light=torch.cat([field.light, field.light[1:2]]))
    return table.replace(params=params, field=field)
