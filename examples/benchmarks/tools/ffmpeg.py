"""FFmpeg's varblur, 16-bit integers: the mean over a square with its own size for each pixel, by a summed area table.

The square has the variance of the disc. In FFmpeg 5 and 6 its side is ``2 + 8 max_r value / 65535`` pixels. It is at
least 2 and even on average, so no pixel stays sharp and the picture shifts by half a pixel. Light is scaled so that the
largest integer is 16; brighter light is clipped.
"""

import re
import shutil
import subprocess
import tempfile

import numpy as np
import torch
from torch import Tensor

NAME = "FFmpeg varblur"
NOTE = (
    "16-bit integers, linear light clipped at 16; a square with the disc's variance. Time: of the filter alone, by "
    "FFmpeg's own bench filter on the third frame; without process start, file i/o and conversion to integers."
)
_WHITE = 16.0
_MAX_R = 32


def available() -> str | None:
    """None, or what to install."""
    if shutil.which("ffmpeg"):
        filters = subprocess.run(["ffmpeg", "-hide_banner", "-filters"], capture_output=True, text=True).stdout
        if " varblur " in filters and " bench " in filters:
            return None
    return "Debian and Ubuntu: apt install ffmpeg (5.0 or later)"


def version() -> str:
    """Version of FFmpeg."""
    return subprocess.run(["ffmpeg", "-version"], capture_output=True, text=True).stdout.split()[2]


def blur(image: Tensor, coc_px: Tensor) -> tuple[Tensor, float]:
    """Blurs ``image`` ``[1, 3, H, W]`` by ``coc_px`` ``[1, 1, H, W]``; returns it and the seconds that FFmpeg took."""
    height, width = image.shape[-2:]
    # Variance along an axis: R^2 / 4 for a disc, 1 / 12 for its pixels, (n^2 - 1) / 12 for n pixels in a row.
    side = (3.0 * coc_px.square() + 2.0).sqrt().clamp(2.0, 2.0 + 8.0 * _MAX_R)
    radius = ((side - 2.0) / (8.0 * _MAX_R)).expand(1, 3, -1, -1)
    frame = torch.cat([image / _WHITE, radius], 2)[0, [1, 2, 0]].clamp(0.0, 1.0)  # [3, 2 H, W]: green, blue, red
    picture = f"{width}:{height}"
    graph = (
        f"[0:v]split[a][b]; [b]crop={picture}:0:{height}[radius]; [a]crop={picture}:0:0,bench=start[image];"
        f"[image][radius]varblur=min_r=0:max_r={_MAX_R},bench=stop[out]"
    )
    with tempfile.TemporaryDirectory() as folder:
        (frame * 65535).round().numpy().astype("<u2").tofile(f"{folder}/in")
        raw = ["-f", "rawvideo", "-pixel_format", "gbrp16le"]
        command = ["ffmpeg", "-hide_banner", "-nostdin", "-stream_loop", "2", *raw]
        command += ["-video_size", f"{width}x{2 * height}", "-i", f"{folder}/in", "-filter_complex", graph]
        command += ["-filter_complex_threads", str(torch.get_num_threads()), "-map", "[out]", *raw, f"{folder}/out"]
        done = subprocess.run(command, capture_output=True, text=True)
        times = re.findall(r"\bt:([0-9.]+)", done.stderr)
        if done.returncode or not times:
            raise ChildProcessError(f"FFmpeg failed: {done.stderr[-500:]}")
        frames = np.fromfile(f"{folder}/out", "<u2").reshape(-1, 3, height, width)
    out = torch.from_numpy(frames[-1].astype(np.float32))[[2, 0, 1]]
    return out[None] * (_WHITE / 65535), float(times[-1])
