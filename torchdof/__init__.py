"""A calibrated depth-of-field post-process: an all-in-focus image and its depth in, a real lens's photograph out."""

from .camera import Camera
from .table import BlurTable

__all__ = ["BlurTable", "Camera"]
