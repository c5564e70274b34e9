"""Renders and writes frames for ``torchdof render``."""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ..depth.guess import looks_relative
from ..depth.inspect import coc_colours, depth_colours, tint_focus
from ..depth.sanity import Mistake
from ..io.colour import stated_primaries
from ..io.highlights import expand_highlights
from ..io.images import Picture, write_image
from ..io.matte import matte_of_size, read_matte
from ..io.picture import can_state_transfer, keeps_profile
from ..io.sheet import shrunk, write_sheet
from ..module import blur_by_coc
from ..optics.aperture import Aperture
from ..optics.blur_table import BlurTable
from ..optics.camera import Camera
from ..options import Options
from ..validation import one_channel
from .command import refuse
from .frame import Frame, coc_of, read_frame
from .options import LIKE_RELATIVE
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
        command = self.command
        write_image(out, picture, command.out_transfer, command.bits)
        if command.sheet is not None:
            caption, colours = "depth: near is bright", depth_colours(frame.values)
            if camera is None:
                caption, colours = "blur radius: near orange, far blue", coc_colours(coc_px)
            panels = {"before": frame.picture.light, caption: colours, "after": picture.light}
            small = {name: shrunk(p.cpu(), _PANEL_PX).expand(-1, 3, -1, -1) for name, p in panels.items()}
            write_sheet(command.sheet, small)
        largest_px = float(coc_px.abs().max())
        self._note(out, frame, picture, largest_px, camera is not None)
        facts, words = self._facts(out, frame, coc_px, largest_px, camera, seconds)
        remarks = f" [{', '.join(frame.remarks)}]" if frame.remarks else ""
        if self.has_table and frame.remarks:
            remarks = "\n" + _table(frame.remarks, camera)
        print_result(command.as_json, facts, f"{out}: {'; '.join(filter(None, words))}{remarks}")

    def _note(self, out: Path, frame: Frame, picture: Picture, largest_px: float, has_camera: bool) -> None:
        """Notes on what a written picture has not, or has otherwise than its image."""
        command, note, suffix = self.command, self.notices.note, out.suffix.lower()
        if has_camera and largest_px < _VISIBLE_PX:
            wider = "open the lens wider, with a smaller --f-number, a larger --blur, or a larger --aperture-radius-m"
            little = f"the largest blur radius is {largest_px:.1f} px, which is hardly seen; {wider}"
            none = "nothing is blurred, for all depth is in focus; focus elsewhere, or look at the depth"
            note("little blur", f"{out}: {little if largest_px else none}")
        if suffix in _WITHOUT_EXIF and any(name.startswith("Exif:") for name in frame.picture.metadata):
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

    def _facts(
        self, out: Path, frame: Frame, coc_px: Tensor, largest_px: float, camera: Camera | None, seconds: float
    ) -> tuple[dict[str, Any], list[str]]:
        """What a frame was rendered with: for programs, and as words for people."""
        command, table, (height, width) = self.command, self.table, coc_px.shape[-2:]
        options = Options(**command.arguments())
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
        return facts, words


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
