"""A calibrated depth-of-field post-process: an all-in-focus image and its depth in, a real lens's photograph out."""

from .camera import Camera
from .module import DepthOfField, blur_by_coc, depth_of_field
from .table import BlurTable

__all__ = ["BlurTable", "Camera", "DepthOfField", "blur_by_coc", "depth_of_field"]
