"""A calibrated depth-of-field post-process: an all-in-focus image and its depth in, a real lens's photograph out."""

from .module import DepthOfField, blur_by_coc, depth_of_field
from .optics.blur_table import BlurTable
from .optics.camera import Camera

__all__ = ["BlurTable", "Camera", "DepthOfField", "blur_by_coc", "depth_of_field"]
