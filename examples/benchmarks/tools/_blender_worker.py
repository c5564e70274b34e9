"""Runs Blender for ``blender.py``, in an interpreter that has bpy.

Usage: python _blender_worker.py FOLDER WIDTH HEIGHT THREADS
"""

import math
import sys
import time
from pathlib import Path

import bpy
import numpy as np


def main() -> None:
    """Reads ``image`` and ``radius``, writes ``out`` (RGBA) and ``seconds``."""
    folder, width, height, threads = Path(sys.argv[1]), *map(int, sys.argv[2:5])
    scene = bpy.context.scene
    settings = scene.render
    settings.resolution_x, settings.resolution_y, settings.resolution_percentage = width, height, 100
    settings.threads_mode, settings.threads = "FIXED", threads
    settings.compositor_device, settings.compositor_precision = "CPU", "FULL"
    settings.use_compositing = True
    settings.image_settings.file_format, settings.image_settings.color_depth = "OPEN_EXR", "32"
    settings.image_settings.color_mode = "RGBA"
    tree = scene.compositing_node_group = bpy.data.node_groups.new("peer", "CompositorNodeTree")
    tree.interface.new_socket(name="Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    result = tree.nodes.new("NodeGroupOutput")

    def source(name: str) -> bpy.types.Node:
        values = np.fromfile(folder / name, np.float32).reshape(height, width, -1)
        rgba = np.ones((height, width, 4), np.float32)
        rgba[..., :3] = values
        node = tree.nodes.new("CompositorNodeImage")
        node.image = bpy.data.images.new(name, width, height, float_buffer=True, is_data=True)
        node.image.pixels.foreach_set(rgba[::-1].ravel())  # Blender's first row is the lowest
        node.image.update()
        return node

    def seconds() -> float:
        start = time.perf_counter()
        bpy.ops.render.render()
        return time.perf_counter() - start

    image, radius = source("image"), source("radius")
    tree.links.new(image.outputs[0], result.inputs[0])
    seconds()  # warms up
    empty_seconds = seconds()
    blur = tree.nodes.new("CompositorNodeDefocus")
    blur.use_zbuffer, blur.z_scale, blur.bokeh = False, 1.0, "CIRCLE"
    blur.blur_max = math.ceil(float(np.fromfile(folder / "radius", np.float32).max())) + 1.0
    tree.links.new(image.outputs[0], blur.inputs[0])
    tree.links.new(radius.outputs[0], blur.inputs[1])
    tree.links.new(blur.outputs[0], result.inputs[0])
    blur_seconds = seconds() - empty_seconds

    bpy.data.images["Render Result"].save_render(str(folder / "out.exr"))
    out = np.empty(width * height * 4, np.float32)
    bpy.data.images.load(str(folder / "out.exr")).pixels.foreach_get(out)
    out.reshape(height, width, 4)[::-1].tofile(folder / "out")
    (folder / "seconds").write_text(str(blur_seconds))


if __name__ == "__main__":
    main()
