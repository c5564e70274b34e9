"""A subject's mask from a file, as coverage for ``matte=``."""

import os
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..validation import stretch
from .decode import errors_named, read_array, read_parts
from .paths import existing_map
from .windows import Window, placed

__all__ = ["matte_of_size", "read_matte"]


def read_matte(path: str | os.PathLike[str], size: Sequence[int] | None = None, window: Window | None = None) -> Tensor:
    """Reads a subject's mask: ``[1, 1, H, W]`` float32 coverage in [0, 1].

    The numbers are coverage, without a transfer curve: whole numbers are divided by the largest of their type (255 for
    8 bits), or are 0 and 1 already. Of a cut-out with transparent pixels, as rembg writes it, alpha is the coverage.

    Args:
        path: An image of one channel, of equal ones or with alpha; or a ``.npy`` or ``.npz`` file.
        size: Height and width of the photograph, to which the mask is resampled; None keeps its own.
        window: Data window of the photograph, as in :class:`torchdof.io.images.Picture`. With it, the mask is placed by
            its own data window, and is 0 outside.

    Raises:
        OSError: If the file is missing, empty or damaged.
        ValueError: If its channels differ, its numbers are not in [0, 1], or its shape is not that of the photograph.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.save(f"{folder}/mask.npy", np.array([[0, 51, 255]], np.uint8))
        ...     read_matte(f"{folder}/mask.npy")
        tensor([[[[0.0000, 0.2000, 1.0000]]]])
    """
    path = existing_map(path)
    with errors_named(path):
        own_window = None
        if path.suffix.lower() in (".npy", ".npz"):
            values = read_array(path, None, kinds="fiub")
        else:
            part = read_parts(path)[0]
            own_window = part.window if part.is_exr else None
            alpha = part.values[..., part.names.index("A")] if "A" in part.names else None
            shades = part.values[..., [name != "A" for name in part.names]]
            opaque = 1.0 if part.values.dtype.kind == "f" else np.iinfo(part.values.dtype).max
            if alpha is not None and (len(part.names) == 1 or bool((alpha < opaque).any())):
                values = alpha
            elif bool((shades == shades[..., :1]).all()):
                values = shades[..., 0]
            else:
                raise ValueError(f"a matte must have one channel or alpha, it has {', '.join(part.names)}, all unequal")
        if values.dtype.kind in "iu" and (values.size == 0 or values.max() > 1):
            values = values / np.iinfo(values.dtype).max
        if size is not None and (window or own_window):
            values = np.nan_to_num(placed(values.astype(np.float32), own_window, (size[0], size[1]), window))
        matte = torch.from_numpy(np.array(values, np.float32))[None, None]
        if not bool(((matte >= 0) & (matte <= 1)).all()):
            low, high = float(matte.min()), float(matte.max())
            raise ValueError(f"a matte must hold coverage in [0, 1], it holds {low:g} to {high:g}")
        return matte if size is None else matte_of_size(matte, size)


def matte_of_size(matte: Tensor, size: Sequence[int]) -> Tensor:
    """A matte ``[1, 1, h, w]`` resampled to height and width of its photograph, whose shape it must have."""
    height, width = size
    if stretch(matte.new_empty(1, 1, height, width), matte) != 0.0:
        sizes = f"{matte.shape[-1]} x {matte.shape[-2]} pixels beside a photograph of {width} x {height}"
        raise ValueError(f"a matte must have the shape of the photograph, it has {sizes}; crop or turn it")
    if matte.shape[-2:] == (height, width):
        return matte
    return interpolate(matte, (height, width), mode="bilinear", antialias=True).clamp(0.0, 1.0)
