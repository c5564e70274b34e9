"""What the user of ``torchdof render`` said, checked: lens, depth map, blur and files."""

import contextlib
import dataclasses
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import torch

from ..depth.edges import DepthEdges
from ..depth.holes import Fill
from ..depth.kinds import DepthKind
from ..depth.relative import RelativeKind
from ..io.decode import PixelType
from ..io.images import read_image
from ..io.metadata import camera_facts
from ..io.sequence import focus_at_frame
from ..io.transfer import Transfer
from ..optics.aperture import Aperture
from ..optics.blur_table import BlurTable
from ..optics.camera import CAMERA_NUMBERS, Camera
from ..optics.table_file import shipped
from ..options import Method
from ..validation import number, show

__all__ = ["RenderSettings", "depth_edges_of", "load_aperture", "load_table", "pick_device"]

_OPTIONS = {
    "focal_length_mm": "--focal-length-mm",
    "f_number": "--f-number",
    "focus_m": "--focus-m",
    "sensor_width_mm": "--sensor-width-mm",
    "fov_x_deg": "--fov-deg",
    "aperture_radius_m": "--aperture-radius-m",
    "focus_range_m": "--focus-range",
    "tilt_deg": "--tilt",
    "swing_deg": "--swing",
}
_IDEAL = {"disc": BlurTable.disc, "gaussian": BlurTable.gaussian}
_ASSUMED = {"focal_length_mm": 50.0, "f_number": 2.8, "sensor_width_mm": 36.0}


@dataclasses.dataclass(frozen=True)
class RenderSettings:
    """What the user said; None where nothing was said.

    Args:
        focus: Keyframes (frame, metres); a plain distance is one keyframe.
        focus_at: Pixel (x, y) to focus on.
        focus_range: Nearest and farthest distance in focus.
        tilt_deg: Degrees by which the lens is tilted down.
        swing_deg: Degrees by which it is turned to the right.
        f_number: Focal length over aperture diameter.
        focal_length_mm: Focal length in millimetres.
        sensor_width_mm: Width of the sensor in millimetres.
        fov_x_deg: Horizontal field of view in degrees, of a rendered image.
        aperture_radius_m: Radius of the aperture in metres, with ``fov_x_deg``.
        depth_kind: What the numbers of the depth map are, see :func:`torchdof.depth.kinds.depth_from_values`, or
            "relative".
        depth_scale: Factor of the depth values.
        depth_offset: Added to the depth values first.
        depth_unknown: Value that means "not measured".
        depth_channel: Channel or array that holds depth.
        near_m: Distance of the nearest value of relative depth, in metres, see
            :func:`torchdof.depth.relative.from_relative`.
        far_m: Distance of the farthest.
        relative_kind: What relative depth is, "disparity" if nothing is said.
        value_range: The smallest and the largest value of relative depth.
        fill: How to fill holes in the depth; None refuses them.
        depth_edges: What is done to depth edges, as in :class:`torchdof.DepthOfField`.
        table: Blur table.
        tolerance: Accepted RMS error, as in :class:`torchdof.DepthOfField`.
        attention: Where the viewer looks, (x, y, radius) in pixels.
        occlusion: False for the paper's single pass without occlusion.
        method: "layered" or "fold".
        device: Where to compute.
        transfer: How the image is encoded.
        out_transfer: How the result is encoded.
        sample: What the result stores a pixel as.
        layer: Layer of an EXR file.
        show_focus: Tint the image by what is in focus instead of blurring it.
        strict: Refuse what looks like a mistake instead of warning of it.

    Raises:
        ValueError: If two of these contradict each other.
    """

    focus: list[tuple[int, float]] | None = None
    focus_at: tuple[float, float] | None = None
    focus_range: tuple[float, float] | None = None
    tilt_deg: float = 0.0
    swing_deg: float = 0.0
    f_number: float | None = None
    focal_length_mm: float | None = None
    sensor_width_mm: float | None = None
    fov_x_deg: float | None = None
    aperture_radius_m: float | None = None
    depth_kind: DepthKind | Literal["relative"] = "z"
    depth_scale: float | None = None
    depth_offset: float = 0.0
    depth_unknown: float | None = None
    depth_channel: str | None = None
    near_m: float | None = None
    far_m: float | None = None
    relative_kind: RelativeKind | None = None
    value_range: tuple[float, float] | None = None
    fill: Fill | None = None
    depth_edges: DepthEdges = "auto"
    table: BlurTable = dataclasses.field(default_factory=BlurTable.disc)
    tolerance: float = 1 / 255
    attention: tuple[float, float, float] | None = None
    occlusion: bool = True
    method: Method = "layered"
    device: torch.device = torch.device("cpu")
    transfer: Transfer | None = None
    out_transfer: Transfer | None = None
    sample: PixelType | None = None
    layer: str | None = None
    show_focus: bool = False
    strict: bool = False

    def __post_init__(self) -> None:
        places = {"--focus-m": self.focus, "--focus-at": self.focus_at, "--focus-range": self.focus_range}
        given = [option for option, place in places.items() if place is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} both say where to focus; give one of them")
        if self.depth_kind == "coc":
            camera = (
                "focus",
                "focus_at",
                "focus_range",
                "f_number",
                "focal_length_mm",
                "sensor_width_mm",
                "aperture_radius_m",
            )
            if self.tilt_deg or self.swing_deg or any(getattr(self, name) is not None for name in camera):
                raise ValueError(
                    "--depth-kind coc is the blur itself and takes no camera; leave focus and lens options out"
                )
        self._check_relative()
        if self.fov_x_deg is None:
            if self.aperture_radius_m is not None:
                raise ValueError("--aperture-radius-m goes with --fov-deg; a real lens has --f-number instead")
            return
        if self.focal_length_mm is not None or self.sensor_width_mm is not None:
            raise ValueError("--fov-deg and --focal-length-mm with --sensor-width-mm say the same; give one of them")
        number("--fov-deg", self.fov_x_deg, low=0, high=180, unit="degrees")
        if self.f_number is not None and self.aperture_radius_m is not None:
            raise ValueError("--f-number and --aperture-radius-m both say how wide the lens opens; give one of them")

    def _check_relative(self) -> None:
        """Refuse relative depth without its distances, and what belongs to another kind."""
        if self.depth_kind == "relative":
            if self.near_m is None or self.far_m is None:
                raise ValueError(
                    "--depth-kind relative needs --near-m and --far-m, the distances of the nearest and the farthest "
                    "value in metres (--far-m inf for a sky)"
                )
            if self.depth_scale is not None or self.depth_offset != 0.0:
                raise ValueError("--depth-kind relative has no --depth-scale and --depth-offset: near and far say it")
        elif any(value is not None for value in (self.near_m, self.far_m, self.relative_kind, self.value_range)):
            raise ValueError(
                "--near-m, --far-m, --relative-kind and --value-range are for relative depth: add --depth-kind relative"
            )

    def camera(self, metadata: Mapping[str, Any], width: int, frame: int) -> tuple[Camera, list[str]]:
        """The camera of one frame: what the user said, else the file's metadata, else 50 mm, f/2.8 and 36 mm.

        Returns:
            The camera (at a focus of infinity where that comes from a pixel) and remarks on what was not stated.
        """
        facts = camera_facts(metadata, width)
        remarks = []
        focus_m = math.inf
        if self.focus is not None:
            focus_m = focus_at_frame(self.focus, frame)
        elif self.focus_at is None and self.focus_range is None:
            if "focus_m" not in facts:
                raise ValueError("where is the focus? give --focus-m METRES or --focus-at X,Y (the file does not say)")
            focus_m = facts["focus_m"]
            remarks.append("focus from the file")
        if self.fov_x_deg is not None:
            radius_m = self.aperture_radius_m
            if radius_m is None and self.f_number is not None:  # on the equivalent sensor, 36 mm wide
                radius_m = 18.0 / math.tan(math.radians(self.fov_x_deg) / 2) / (2000.0 * self.f_number)
            if radius_m is None:
                raise ValueError("--fov-deg needs the opening of the lens: either --aperture-radius-m or --f-number")
            with _by_option(_OPTIONS):
                return Camera.from_fov(self.fov_x_deg, radius_m, focus_m).replace(**self._moved()), remarks
        lens: dict[str, float] = {}
        for name, assumed in _ASSUMED.items():
            stated = getattr(self, name)
            lens[name] = facts.get(name, assumed) if stated is None else stated
            if stated is None:
                words = name.rsplit("_", 1)[0].replace("_", " ") if name != "f_number" else "f-number"
                remarks.append(f"{words} {'from the file' if name in facts else 'assumed'}")
        names = {name: self._name_of(name) for name in _OPTIONS}
        with _by_option(names):
            camera = Camera(lens["focal_length_mm"], lens["f_number"], focus_m, lens["sensor_width_mm"])
            return camera.replace(**self._moved()), remarks

    def _moved(self) -> dict[str, Any]:
        """What of the camera is no number of its lens: the range in focus and how the lens is tilted."""
        return {"focus_range_m": self.focus_range, "tilt_deg": self.tilt_deg, "swing_deg": self.swing_deg}

    def stated(self, camera: Camera) -> dict[str, Any]:
        """The numbers of a camera by the options, or the file, that they are from."""
        if self.fov_x_deg is None:
            return {self._name_of(name): getattr(camera, name) for name in CAMERA_NUMBERS}
        opening = "aperture_radius_m" if self.f_number is None else "f_number"
        return {
            "--fov-deg": self.fov_x_deg,
            _OPTIONS[opening]: getattr(self, opening),
            self._name_of("focus_m"): camera.focus_m,
        }

    def _name_of(self, name: str) -> str:
        """What the user knows a number of the camera as: the option that states it, or the file's own."""
        if name == "focus_m":
            stated = any(place is not None for place in (self.focus, self.focus_at, self.focus_range))
            option = "--focus-at" if self.focus_at is not None else "--focus-m"
            option = option if self.focus_range is None else "--focus-range"
        else:
            stated, option = name == "focus_range_m" or getattr(self, name, None) is not None, _OPTIONS[name]
        return option if stated else f"{option} (not given)"


@contextlib.contextmanager
def _by_option(names: Mapping[str, str]) -> Iterator[None]:
    """Has a refusal of the camera say the option's name where it says its own."""
    try:
        yield
    except ValueError as error:
        pattern = re.compile(r"\b(" + "|".join(names) + r")\b")
        raise ValueError(pattern.sub(lambda found: names[found.group()], str(error))) from None


def depth_edges_of(name: Literal["auto", "repair", "as-given"]) -> DepthEdges:
    """What is done to depth edges, by the word of the option ``--depth-edges``."""
    return "as given" if name == "as-given" else name


def load_table(name: str, aperture: Aperture | None = None) -> BlurTable:
    """A blur table by name ("disc", "gaussian", a shipped one) or by the path of its JSON file.

    With an aperture, it takes the place of the table's own.

    Raises:
        ValueError: If it is not valid.
        FileNotFoundError: If there is no such table; the message lists those there are.
        OSError: If the file cannot be read.
    """
    try:
        table = _IDEAL[name]() if isinstance(name, str) and name in _IDEAL else BlurTable.load(name)
    except FileNotFoundError:
        names = ", ".join([*_IDEAL, *shipped()])
        raise FileNotFoundError(f"no blur table {show(name)}: neither a file nor one of {names}") from None
    return table if aperture is None else table.with_aperture(aperture)


def load_aperture(
    blades: int, rotation: float, curvature: float, squeeze: float, image: Path | None, vignetting: float = 0.0
) -> Aperture | None:
    """The opening that these options mean; None if they mean a round one.

    Raises:
        ValueError: If they contradict each other, or one is out of its range.
        OSError: If the image cannot be read.
    """
    if image is not None and (blades or curvature):
        raise ValueError("--aperture is the whole opening; leave --blades and --curvature out")
    if blades == 0 and image is None and curvature:
        raise ValueError("--curvature is that of blades; give --blades too")
    if blades == 0 and image is None and rotation:
        raise ValueError("--rotation turns blades or an image; give --blades or --aperture too")
    mask = None
    if image is not None:
        picture = read_image(image)
        light = picture.pixels[0, :-1] if picture.has_alpha else picture.pixels[0]
        mask = light.mean(0)
    with _by_option(
        {
            "blades": "--blades",
            "rotation_deg": "--rotation",
            "curvature": "--curvature",
            "squeeze": "--squeeze",
            "vignetting": "--vignetting",
        }
    ):
        aperture = Aperture(blades, rotation, curvature, squeeze, mask, vignetting)
    return None if aperture.is_round and squeeze == 1.0 and not aperture.depends_on_place else aperture


def pick_device(name: str) -> torch.device:
    """A device by name; "auto" is CUDA where there is one, else the CPU.

    Raises:
        ValueError: If there is no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not isinstance(name, str):
        raise ValueError(f"--device must be a name such as auto, cpu or cuda:1, got {show(name)}")
    try:
        device = torch.device(name)
        torch.empty(1, device=device).sum().item()
    except (RuntimeError, AssertionError, NotImplementedError):
        raise ValueError(f"--device {name}: there is no such device here; use cpu") from None
    return device
