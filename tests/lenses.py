"""Lenses with front and rear exchanged, for tests that trace light backwards."""

from dataclasses import replace

from torchdof.fit.lens.glass import AIR
from torchdof.fit.lens.lens import Lens


def turned(lens: Lens) -> Lens:
    """The lens with front and rear exchanged: radii and polynomials change their signs."""
    media = [(AIR, 0.0), *((surface.glass, surface.thickness) for surface in lens.surfaces[:-1])]
    surfaces = [
        replace(one, radius=-one.radius, polynomial=tuple(-a for a in one.polynomial), glass=glass, thickness=gap)
        for one, (glass, gap) in zip(lens.surfaces, media, strict=True)
    ]
    return replace(lens, surfaces=tuple(surfaces[::-1]), stop=len(surfaces) - 1 - lens.stop)
