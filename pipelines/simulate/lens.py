"""Simulated lens: exact projection, and rays by Newton's method.

The code is separate from the pipeline's own camera models on purpose. A mistake in code that both sides shared
would cancel, and never show at a check point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray

LensModel = Literal["pinhole", "radial", "opencv"]
COLMAP_MODEL = {"pinhole": "SIMPLE_PINHOLE", "radial": "RADIAL", "opencv": "OPENCV"}
_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Lens:
    """Lens of COLMAP's RADIAL or OPENCV kind, with one focal length.

    Attributes:
        model: determines the coefficients in use.
        width, height: image size in pixels.
        focal_px: focal length in pixels.
        center_px: principal point; the centre of the top-left pixel is (0.5, 0.5).
        k1, k2, p1, p2: radial and tangential coefficients of Brown's model, as OpenCV orders them.
    """

    model: LensModel
    width: int
    height: int
    focal_px: float
    center_px: tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def colmap_model(self) -> str:
        """COLMAP's name of the model."""
        return COLMAP_MODEL[self.model]

    @property
    def colmap_params(self) -> tuple[float, ...]:
        """COLMAP's parameters of the model."""
        cx, cy = self.center_px
        if self.model == "pinhole":
            return (self.focal_px, cx, cy)
        if self.model == "radial":
            return (self.focal_px, cx, cy, self.k1, self.k2)
        return (self.focal_px, self.focal_px, cx, cy, self.k1, self.k2, self.p1, self.p2)

    def project(self, points_in_cam: ArrayLike) -> FloatArray:
        """Return pixels (N, 2) of points (N, 3) in the camera frame; NaN if the lens cannot see the point.

        The polynomial folds back at large angles. A point from beyond the fold has no true image, although the
        polynomial gives one.
        """
        points = np.asarray(points_in_cam, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            normalised = points[:, :2] / points[:, 2:3]
            distorted = self._distort(normalised)
        pixels = self.focal_px * distorted + np.array(self.center_px)
        seen = (points[:, 2] > 0) & (np.square(normalised).sum(axis=1) < self._fold_radius() ** 2)
        pixels[~seen] = np.nan
        return np.asarray(pixels)

    def directions(self, pixels: ArrayLike) -> FloatArray:
        """Return directions (N, 3) with z = 1 of pixels (N, 2), exact to 1e-12.

        Raises:
            InputError: the distortion folds inside the image, so that a pixel has no ray.
        """
        target = (np.asarray(pixels, dtype=np.float64) - np.array(self.center_px)) / self.focal_px
        guess = target.copy()
        for _ in range(30):
            residual = self._distort(guess) - target
            if np.abs(residual).max(initial=0.0) < _TOLERANCE:
                break
            guess = guess - self._solve(guess, residual)
        solved = np.abs(self._distort(guess) - target).max(initial=0.0) < 1e-9
        if not solved or np.square(guess).sum(axis=1).max(initial=0.0) >= self._fold_radius() ** 2:
            raise InputError("the distortion is too strong for this field of view: use a smaller one", field="--k1")
        return np.concatenate([guess, np.ones((len(guess), 1))], axis=1)

    def _distort(self, xy: FloatArray) -> FloatArray:
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (self.k1 + r2 * self.k2)
        return np.stack(
            [
                x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * radial + 2 * self.p2 * x * y + self.p1 * (r2 + 2 * y * y),
            ],
            axis=1,
        )

    def _solve(self, xy: FloatArray, residual: FloatArray) -> FloatArray:
        """Return the Newton step (N, 2): the 2×2 Jacobian of `_distort` solved by Cramer's rule."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial, slope = 1 + r2 * (self.k1 + r2 * self.k2), 2 * (self.k1 + 2 * r2 * self.k2)
        xx = radial + x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        xy_ = x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
        yy = radial + y * y * slope + 2 * self.p2 * x + 6 * self.p1 * y
        u, v = residual[:, 0], residual[:, 1]
        return np.asarray(np.stack([yy * u - xy_ * v, xx * v - xy_ * u], axis=1) / (xx * yy - xy_ * xy_)[:, None])

    def _fold_radius(self) -> float:
        """Return the radius (tangent of the angle) at which r (1 + k1 r² + k2 r⁴) stops growing."""
        roots = np.roots([5 * self.k2, 0.0, 3 * self.k1, 0.0, 1.0])
        real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
        return float(real.min()) if len(real) else float("inf")
