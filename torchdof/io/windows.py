"""Places a map in the frame of an image by the data and display windows of EXR files."""

import numpy as np

from .decode import check_size

Window = tuple[int, int, int, int, int, int]
"""Place of pixels in a frame: x, y of their corner, x, y, width and height of the frame (the display window)."""

_SAME_ASPECT = 0.03  # largest difference of the aspect ratios of two frames that show the same area
_WHOLE_PX = 0.01  # a place that is nearer to a whole number of pixels is exact


def placed(values: np.ndarray, window: Window | None, size: tuple[int, int], target: Window | None) -> np.ndarray:
    """A map ``[h, w]`` with the area of an image of a size (height, width), at its own resolution; NaN where unknown.

    ``window`` is that of the map, ``target`` that of the image; None is a whole frame. A map without a window that has
    the size of the image's pixels, and not of its frame, has the area of the pixels. If the two frames do not show the
    same area, the map is returned as it is.

    Raises:
        ValueError: If the image's area starts or ends between two pixels of the map.
    """
    height, width = size
    rows, columns = values.shape
    if window is None and (rows, columns) == (height, width):
        return values
    x, y, full_x, full_y, full_width, full_height = window or (0, 0, 0, 0, columns, rows)
    to_x, to_y, to_full_x, to_full_y, to_width, to_height = target or (0, 0, 0, 0, width, height)
    if min(full_width, full_height, to_width, to_height) < 1:
        return values
    ratio = full_width * to_height / (full_height * to_width)
    if (x, y) == (full_x, full_y) and (columns, rows) == (full_width, full_height):
        if (to_x, to_y, width, height) == (to_full_x, to_full_y, to_width, to_height):
            return values  # both are whole frames
        if window is None and abs(ratio - 1.0) > abs(columns * height / (rows * width) - 1.0):
            return values  # the map has the shape of the pixels rather than of the frame
    if abs(ratio - 1.0) > _SAME_ASPECT:
        return values
    across, down = full_width / to_width, full_height / to_height  # pixels of the map for each of the image
    corner = ((to_x - to_full_x) * across, (to_y - to_full_y) * down)
    ends = (corner[0] + width * across, corner[1] + height * down)
    left, top, right, bottom = (round(place) for place in (*corner, *ends))
    rounding = max(abs(place - round(place)) for place in (*corner, *ends))
    if rounding > _WHOLE_PX:
        frames = f"{full_width} x {full_height} pixels, the image's {to_width} x {to_height}"
        raise ValueError(
            f"its frame has {frames}, so that the image's area ends between its pixels; store both with the same frame"
        )
    if (left, top, right, bottom) == (x - full_x, y - full_y, x - full_x + columns, y - full_y + rows):
        return values
    check_size(right - left, bottom - top, 4)
    area = np.full((bottom - top, right - left), np.nan, np.float32)
    start_x, start_y = x - full_x - left, y - full_y - top  # place of the map in the area
    inside = [
        slice(max(0, start), max(0, min(n, start + m)))
        for start, m, n in ((start_y, rows, area.shape[0]), (start_x, columns, area.shape[1]))
    ]
    source = [
        slice(part.start - start, max(part.start, part.stop) - start)
        for part, start in zip(inside, (start_y, start_x), strict=True)
    ]
    area[inside[0], inside[1]] = values[source[0], source[1]]
    return area
