"""What stands for the sharp dot in the forward model: its picture, an ideal dot, or a point of light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ..result import Array
from .dot import Dot, noise_of
from .dot_model import STEPS, Edge, draw_edge

__all__ = ["IdealDot", "PictureOfDot", "Source", "point_source"]


class Source(Protocol):
    """A dot that can be drawn anywhere and at any size.

    Attributes:
        dot: where it is in the sharp picture.
        noise: standard deviation of its pixels.
        reach: radius in px beyond which it is dark.
    """

    @property
    def dot(self) -> Dot: ...  # noqa: D102
    @property
    def noise(self) -> float: ...  # noqa: D102
    @property
    def reach(self) -> float: ...  # noqa: D102

    def draw(self, rows: Array, columns: Array, x: float, y: float, magnification: float) -> Array:
        """Level of each pixel with the dot's centre at (x, y), magnified."""
        ...

    def variants(self) -> tuple[list[Source], Array]:
        """The same dot one step off in each quantity that was fitted to it, and their covariance in those steps."""
        ...


@dataclass(frozen=True)
class PictureOfDot:
    """The dot as photographed, between its pixels by cubic splines."""

    dot: Dot
    noise: float
    reach: float
    spline: Array

    @classmethod
    def of(cls, picture: Array, dot: Dot) -> PictureOfDot:
        """Cut the dot out of a picture: what lies farther than its reach is dark."""
        from scipy.ndimage import spline_filter

        rows, columns = np.indices(picture.shape)
        reach = dot.reach + 2.0
        inside = np.hypot(columns - dot.x, rows - dot.y) <= reach
        return cls(
            dot, noise_of(picture), reach, spline_filter(np.where(inside, picture - dot.background, 0.0), order=3)
        )

    def draw(self, rows: Array, columns: Array, x: float, y: float, magnification: float) -> Array:
        """See `Source`."""
        from scipy.ndimage import map_coordinates

        where = [(rows - y) / magnification + self.dot.y, (columns - x) / magnification + self.dot.x]
        return np.asarray(map_coordinates(self.spline, where, order=3, prefilter=False), dtype=np.float64)

    def variants(self) -> tuple[list[Source], Array]:
        """None: its uncertainty is its pixels' noise."""
        return [], np.zeros((0, 0))


@dataclass(frozen=True)
class IdealDot:
    """A soft disc fitted to the photographed dot: no noise of its own, and exact at any place and size."""

    dot: Dot
    edge: Edge
    noise: float = 0.0

    @classmethod
    def of(cls, dot: Dot, edge: Edge) -> IdealDot:
        """The ideal dot with a fitted edge."""
        return cls(replace(dot, x=edge.x, y=edge.y, radius=edge.radius, background=0.0, peak=1.0, noise=0.0), edge)

    @property
    def reach(self) -> float:
        """Radius in px beyond which it is dark."""
        return self.edge.radius + 5 * self.edge.softness + 1.0

    def draw(self, rows: Array, columns: Array, x: float, y: float, magnification: float) -> Array:
        """See `Source`. The softness is the sensor's, not the print's: it does not grow with the dot."""
        softness = self.edge.softness
        square = magnification**2 * (self.edge.radius**2 + softness**2) - softness**2  # as the light of a soft disc
        return self.edge.level * draw_edge(rows, columns, x, y, np.sqrt(max(square, 0.0)), softness)

    def variants(self) -> tuple[list[Source], Array]:
        """A little more radius, and more softness."""
        moved = [
            replace(self.edge, radius=self.edge.radius + STEPS["radius"]),
            replace(self.edge, softness=self.edge.softness + STEPS["softness"]),
        ]
        steps = np.array([STEPS["radius"], STEPS["softness"]])
        covariance = np.where(np.isfinite(self.edge.covariance), self.edge.covariance, 0.0) / np.outer(steps, steps)
        return [replace(self, edge=e) for e in moved], covariance


def point_source(shape: tuple[int, ...], dot: Dot) -> PictureOfDot:
    """A point of light at the pixel nearest to a blurred dot's centre, blurred as the integral over a pixel is.

    Kernels hold the optical blur alone; the pixel's own, a variance of 1/12 px^2 along each axis, is the source's.
    """
    from scipy.ndimage import convolve1d, spline_filter

    x, y = int(round(dot.x)), int(round(dot.y))
    picture = np.zeros(shape)
    picture[y, x] = 1.0
    for axis in (0, 1):
        picture = convolve1d(picture, np.array([1.0, 22.0, 1.0]) / 24.0, axis)
    point = Dot(float(x), float(y), 0.0, 1.0, 0.0, 1.0, 0.0, 1.0)
    return PictureOfDot(point, 0.0, 4.0, spline_filter(picture, order=3))
