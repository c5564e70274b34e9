"""Runs GEGL for ``gegl.py``, in an interpreter that has GEGL's bindings.

Usage: python _gegl_worker.py FOLDER WIDTH HEIGHT RADIUS; prints seconds.
"""

import sys
import time
from pathlib import Path

import gi

gi.require_version("Gegl", "0.4")
from gi.repository import Gegl  # noqa: E402


def main() -> None:
    """Reads ``image`` and ``radius``, writes ``out``."""
    Gegl.init([])
    folder, width, height, largest = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
    frame = Gegl.Rectangle.new(0, 0, width, height)

    def buffer(pixels: str, name: str | None = None) -> Gegl.Buffer:
        new_buffer = Gegl.Buffer.new(pixels, 0, 0, width, height)
        if name:
            new_buffer.set(frame, pixels, (folder / name).read_bytes())
        return new_buffer

    image, radius = buffer("RGB float", "image"), buffer("Y float", "radius")
    for _ in range(2):  # the first one warms up
        out = buffer("RGB float")
        graph = Gegl.Node.new()
        source, aux = (graph.create_child("gegl:buffer-source") for _ in range(2))
        source.set_property("buffer", image)
        aux.set_property("buffer", radius)
        blur, sink = graph.create_child("gegl:lens-blur"), graph.create_child("gegl:write-buffer")
        blur.set_property("radius", largest)
        blur.set_property("linear-mask", True)
        sink.set_property("buffer", out)
        source.link(blur)
        aux.connect_to("output", blur, "aux")
        blur.link(sink)
        start = time.perf_counter()
        sink.process()
        seconds = time.perf_counter() - start
    (folder / "out").write_bytes(out.get(frame, 1.0, "RGB float", Gegl.AbyssPolicy.NONE))
    print(seconds)


if __name__ == "__main__":
    main()
