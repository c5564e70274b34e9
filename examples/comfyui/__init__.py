"""Depth of field as a node of ComfyUI; copy this folder into ``ComfyUI/custom_nodes``."""

from .depth_of_field import NODE_CLASS_MAPPINGS, NODE_DISPLAY_NAME_MAPPINGS

__all__ = ["NODE_CLASS_MAPPINGS", "NODE_DISPLAY_NAME_MAPPINGS"]
