"""The verification of four tables with both methods: ``python examples/benchmarks/exported_families.py``.

The disc, a double Gauss traced and fitted as soft discs (``softm``), the ring of Sato et al. and the shipped double
Gauss (``radial``), each as a file for layers up to 3 pixels, compared with its module. It takes some ten minutes,
most of it tracing.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from torchdof import BlurTable, Camera, DepthOfField
from torchdof.export.conversion import to_onnx

__all__ = ["main", "tables"]

WIDTH = 1920


def tables() -> Iterator[tuple[str, BlurTable]]:
    """Name and table of each family."""
    from torchdof.fit import trace_table
    from torchdof.fit.lens.lens import Lens

    yield "disc", BlurTable.disc()
    lens = Lens.read("double_gauss_50mm")
    yield "softm", trace_table(lens, f_number=2.0, focus_m=2.0, nodes=9, family="softm", name="double Gauss, softm")
    yield "ring", BlurTable.load("sato_j15")
    yield "radial", BlurTable.load("double_gauss_50mm_f2")


def main() -> None:
    """Export each and print the comparisons."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--max-coc", type=float, default=3.0, help="largest radius in pixels")
    parser.add_argument("--tolerance", type=float, default=8 / 255)
    parser.add_argument("--family", action="append", help="only these (disc, softm, ring, radial); may be repeated")
    parser.add_argument("--method", action="append", help="only these (layered, fold); may be repeated")
    arguments = parser.parse_args()
    for family, table in tables():
        if arguments.family and family not in arguments.family:
            continue
        for method in arguments.method or ("layered", "fold"):
            dof = DepthOfField(
                Camera(), table, tolerance=arguments.tolerance, method=method, max_coc_px=arguments.max_coc, check=False
            )
            start = time.perf_counter()
            with tempfile.TemporaryDirectory() as folder:
                width = None if table.unit == "relative" else WIDTH
                report = to_onnx(dof, Path(folder) / "dof.onnx", width=width)
            print(report)
            print(f"exported in {time.perf_counter() - start:.0f} s\n", flush=True)


if __name__ == "__main__":
    main()
