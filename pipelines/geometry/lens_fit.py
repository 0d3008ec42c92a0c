"""Lenses of other programs as the nearest of COLMAP's camera models, with the largest error over the image.

Brown's lens has OpenCV's tangential terms: u gains 2 p1 x y + p2 (r² + 2 x²), v gains p1 (r² + 2 y²) + 2 p2 x y.
Up to r⁶ and without skew it is COLMAP's OPENCV or FULL_OPENCV exactly, and a polynomial of the angle up to θ⁹ is
OPENCV_FISHEYE exactly. Any other lens is replaced by the one of the same family that least squares fits to it in
pixels, over rays that cover the image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Camera, distort, undistort

FISHEYE = "OPENCV_FISHEYE"
_SAMPLES = 25  # rays along each side of the image
_ROUNDS = 2  # the second covers the image by the rays of the first
_LEAST_RAYS = 200  # of 625: a circular fisheye fills half of its picture
_MOST_STEPS = 200


@dataclass(frozen=True)
class ForeignLens:
    """Lens of another program for images of `start`'s size.

    `start` approximates it; `pixels_of` gives pixels (N, 2) of rays (N, 2) as (x/z, y/z). None: `start` is exact.
    """

    start: Camera
    pixels_of: Callable[[FloatArray], FloatArray] | None = None

    @property
    def size(self) -> tuple[int, int]:
        return self.start.width, self.start.height


@dataclass(frozen=True)
class Brown:
    """Parameters of Brown's lens, or of a fisheye whose terms are those of the angle; lengths in pixels.

    `radial` holds k1 … k4 of r² … r⁸, `tangential` p1 and p2 in OpenCV's order, `growth` what they are multiplied
    by: 1 + growth₀ r² + growth₁ r⁴. `skew` is the pixels that u gains by y.
    """

    size: tuple[int, int]
    focal: tuple[float, float]
    center: tuple[float, float]
    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    growth: tuple[float, float] = (0.0, 0.0)
    skew: float = 0.0

    def pixels_of(self, plane: FloatArray) -> FloatArray:
        """Return pixels (N, 2) of points (N, 2) in the plane before distortion, such as rays (x/z, y/z)."""
        (k1, k2, k3, k4), (p1, p2) = self.radial, self.tangential
        x, y = plane.T
        r2 = x * x + y * y
        gain = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        more = 1 + r2 * (self.growth[0] + r2 * self.growth[1])
        u = x * gain + more * (2 * p1 * x * y + p2 * (r2 + 2 * x * x))
        v = y * gain + more * (2 * p2 * x * y + p1 * (r2 + 2 * y * y))
        return np.stack(
            [self.focal[0] * u + self.skew * v + self.center[0], self.focal[1] * v + self.center[1]], -1
        )


def brown_lens(brown: Brown) -> ForeignLens:
    """Return the lens of Brown's parameters."""
    (k1, k2, k3, k4), (p1, p2) = brown.radial, brown.tangential
    if not any((k1, k2, k3, k4, p1, p2)):
        model, params = "PINHOLE", [*brown.focal, *brown.center]
    elif k3 or k4:
        model, params = "FULL_OPENCV", [*brown.focal, *brown.center, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    else:
        model, params = "OPENCV", [*brown.focal, *brown.center, k1, k2, p1, p2]
    start = Camera(model, *brown.size, np.array(params, dtype=np.float64))
    grows = any(brown.growth) and any(brown.tangential)
    return ForeignLens(start, brown.pixels_of if k4 or brown.skew or grows else None)


def fisheye_lens(brown: Brown, *, equisolid: bool = False) -> ForeignLens:
    """Return the lens whose radius grows by the angle θ (or 2 sin θ/2, if equisolid) before Brown's terms apply."""
    k1, k2, k3, k4 = brown.radial
    # 2 sin θ/2 = θ − θ³/24 + θ⁵/1920 …
    first = (k1 - 1 / 24, k2 - k1 / 8 + 1 / 1920, 0.0, 0.0) if equisolid else (k1, k2, k3, k4)
    start = Camera(FISHEYE, *brown.size, np.array([*brown.focal, *brown.center, *first]))

    def pixels_of(ray: FloatArray) -> FloatArray:
        radius = np.hypot(*ray.T)
        angle = np.arctan(radius)
        bent = 2 * np.sin(angle / 2) if equisolid else angle
        return brown.pixels_of(ray * np.where(radius > 0, bent / np.where(radius > 0, radius, 1.0), 1.0)[:, None])

    return ForeignLens(start, pixels_of if equisolid or any(brown.tangential) or brown.skew else None)


def nearest_camera(lens: ForeignLens) -> tuple[Camera, float]:
    """Return the camera of COLMAP's models nearest to a lens, and its largest error in the image, in pixels.

    The error is that of a grid of rays up to the border of the image, and infinite where no such rays are found.
    """
    if lens.pixels_of is None:
        return lens.start, 0.0
    camera = lens.start
    if camera.model not in (FISHEYE, "FULL_OPENCV"):
        params = np.zeros(12)
        params[: len(camera.params)] = camera.params
        camera = replace(camera, model="FULL_OPENCV", params=params)
    for _ in range(_ROUNDS):
        rays, _ = _rays(camera, lens)
        if len(rays) < _LEAST_RAYS:
            return camera, float("inf")
        camera = _fitted(camera, rays, lens.pixels_of(rays))
    rays, pixels = _rays(camera, lens)
    off = np.hypot(*(lens.pixels_of(rays) - pixels).T)
    return camera, float(off.max()) if len(rays) >= _LEAST_RAYS else float("inf")


def _rays(camera: Camera, lens: ForeignLens) -> tuple[FloatArray, FloatArray]:
    """Return the rays (N, 2) of a grid of pixels (N, 2) by a camera, corners included, that the lens maps, too."""
    assert lens.pixels_of is not None
    x, y = (np.linspace(0.0, side, _SAMPLES) for side in lens.size)
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = undistort(camera, pixels)
    with np.errstate(all="ignore"):
        seen = np.isfinite(rays).all(axis=1) & np.isfinite(lens.pixels_of(rays)).all(axis=1)
    return rays[seen], pixels[seen]


def _fitted(camera: Camera, rays: FloatArray, pixels: FloatArray) -> Camera:
    """Return the camera of the same model that least squares fits to the pixels (N, 2) of rays (N, 2)."""
    from scipy.optimize import least_squares

    # Focal length and principal point move by pixels, the other terms by thousandths.
    unit = np.full(len(camera.params), 1e-3)
    unit[:4] = 1.0

    def residuals(step: FloatArray) -> FloatArray:
        off = distort(replace(camera, params=camera.params + unit * step), rays) - pixels
        return np.asarray(np.nan_to_num(off, nan=1e6, posinf=1e6, neginf=-1e6).ravel())

    try:
        fitted = least_squares(residuals, np.zeros(len(unit)), x_scale="jac", max_nfev=_MOST_STEPS).x
    except (ValueError, np.linalg.LinAlgError, InputError):  # no focal length above zero on the way
        return camera
    return replace(camera, params=camera.params + unit * fitted)
