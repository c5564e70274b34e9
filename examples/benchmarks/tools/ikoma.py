"""The layered formula of Ikoma et al. 2021 by FFT in PyTorch, on which torchdof builds.

Ikoma, Nguyen, Metzler, Peng, Wetzstein, "Depth from defocus with learned optics", ICCP 2021. Written from the formula,
not from the authors' code.
"""

import torch
from torch import Tensor

from torchdof.reference.ikoma import layered_fft

NAME = "Ikoma, FFT"
NOTE = "float32; a layer each 0.75 px of circle of confusion, exact discs. Time: the whole call."


def available() -> None:
    """Comes with torchdof."""


def version() -> str:
    """Version of PyTorch, whose FFT it is."""
    return f"torch {torch.__version__}"


def blur(image: Tensor, coc_px: Tensor) -> Tensor:
    """Blurs ``image`` ``[1, C, H, W]`` by ``coc_px`` ``[1, 1, H, W]``."""
    return layered_fft(image, coc_px)
