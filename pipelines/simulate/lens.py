"""Simulated camera: exact projection, rays by Newton's method; rendering under sun and sky, with sensor noise.

The lens shares no code with the pipeline's camera models on purpose: a common mistake would cancel at all check
points.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.types import ByteArray, Float32Array, FloatArray
from pipelines.simulate.mesh import MISS, Hits, Raycaster
from pipelines.simulate.scene import SimulatedScene
from pipelines.simulate.textures import TextureSamples, albedo, mix

LensModel = Literal["pinhole", "radial", "opencv"]
COLMAP_MODEL = {"pinhole": "SIMPLE_PINHOLE", "radial": "RADIAL", "opencv": "OPENCV"}
_TOLERANCE = 1e-12


@dataclass(frozen=True)
class BrownLens:
    """Lens of COLMAP's RADIAL or OPENCV kind, with one focal length."""

    model: LensModel  # determines the coefficients in use
    width: int
    height: int
    focal_px: float
    center_px: tuple[float, float]  # principal point; the centre of the top-left pixel is (0.5, 0.5)
    k1: float = 0.0  # k1, k2 radial, p1, p2 tangential coefficients of Brown's model, as in OpenCV
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def colmap_model(self) -> str:
        return COLMAP_MODEL[self.model]

    @property
    def colmap_params(self) -> tuple[float, ...]:
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
        """Return directions (N, 3), z = 1, of pixels (N, 2), exact to 1e-12; an InputError: the lens folds."""
        target = (np.asarray(pixels, dtype=np.float64) - np.array(self.center_px)) / self.focal_px
        guess = target.copy()
        for _ in range(30):
            residual = self._distort(guess) - target
            if np.abs(residual).max(initial=0.0) < _TOLERANCE:
                break
            guess = guess - self._newton_step(guess, residual)
        solved = np.abs(self._distort(guess) - target).max(initial=0.0) < 1e-9
        if not solved or np.square(guess).sum(axis=1).max(initial=0.0) >= self._fold_radius() ** 2:
            raise InputError(
                "distortion-too-strong",
                "The distortion is too strong for this field of view.",
                field="--k1",
                remedy="Use a smaller --k1 or a larger --focal.",
            )
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

    def _newton_step(self, xy: FloatArray, residual: FloatArray) -> FloatArray:
        """Return the step (N, 2): the 2×2 Jacobian of `_distort` solved by Cramer's rule."""
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial, slope = 1 + r2 * (self.k1 + r2 * self.k2), 2 * (self.k1 + 2 * r2 * self.k2)
        xx = radial + x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x
        xy_ = x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y
        yy = radial + y * y * slope + 2 * self.p2 * x + 6 * self.p1 * y
        u, v = residual[:, 0], residual[:, 1]
        return np.stack([yy * u - xy_ * v, xx * v - xy_ * u], axis=1) / (xx * yy - xy_ * xy_)[:, None]

    def _fold_radius(self) -> float:
        """Return the radius (tangent of the angle) at which r (1 + k1 r² + k2 r⁴) stops growing."""
        roots = np.roots([5 * self.k2, 0.0, 3 * self.k1, 0.0, 1.0])
        real = roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)].real
        return float(real.min()) if len(real) else float("inf")


# Rays at a time: larger arrays leave the cache, smaller arrays cost more calls than work (measured: +50 %, +10 %).
_CHUNK = 1 << 15
_RAYS_KEPT = 1 << 24
_SUN = np.array([3.0, 2.78, 2.45], dtype=np.float32)
_SKY = np.array([0.52, 0.62, 0.80], dtype=np.float32)
_HORIZON = np.array([0.72, 0.79, 0.86], dtype=np.float32)
_ZENITH = np.array([0.24, 0.42, 0.75], dtype=np.float32)
_BOUNCE = np.array([0.22, 0.20, 0.17], dtype=np.float32)
_HAZE_M = 1300.0
_SHADOW_LIFT_M = 0.02  # of a shadow ray's start above the surface, which would hide the sun otherwise
_ROLLING_ROWS = 4  # of a moving camera that are rendered at once: it moves by a hundredth of its travel meanwhile


@dataclass(frozen=True)
class Pose:
    """Camera pose: centre (3,) in geo, as the middle row is read, and rotation (3, 3) camera → geo."""

    center: FloatArray
    geo_from_cam: FloatArray
    # (3,) metres in geo from the first row's readout to the last's
    travel: FloatArray = field(default_factory=lambda: np.zeros(3))

    def at_row(self, share: ArrayLike) -> FloatArray:
        """Return the centres (N, 3) or (3,) at rows, given as shares of the height."""
        moved = np.asarray(share, dtype=np.float64)[..., None] - 0.5
        return np.asarray(self.center + moved * self.travel)


@dataclass(frozen=True)
class Sensor:
    """Response of the sensor to light."""

    gain: float  # exposure of this photograph, 1 for a grey of 18 % under the sun at about mid-scale
    tint: tuple[float, float, float]  # white balance
    noise: float  # factor; 1: a small sensor at base sensitivity (0.4 % of full scale at mid-scale)
    vignetting: float = 0.22  # loss of light in the corners


class Renderer:
    """Renders one scene through one lens, with a square number of rays for a pixel; safe to use from several
    threads.
    """

    def __init__(self, scene: SimulatedScene, lens: BrownLens, samples: int, *, rolling: bool = False) -> None:
        self._scene, self._lens, self._samples = scene, lens, samples
        self.raycaster = Raycaster(scene.mesh)
        rows = min(max(1, _CHUNK // (lens.width * samples)), _ROLLING_ROWS if rolling else lens.height)
        self._bands = [(top, min(top + rows, lens.height)) for top in range(0, lens.height, rows)]
        # Rays are kept for all photographs if they fit; rays of large photographs are made anew for each.
        keep = lens.width * lens.height * samples <= _RAYS_KEPT
        self._kept = [_rays(lens, band, samples).astype(np.float32) for band in self._bands] if keep else []

    def photograph(self, pose: Pose, sensor: Sensor, rng: np.random.Generator) -> ByteArray:
        light = self.radiance(pose)
        height, width = light.shape[:2]
        across, down = np.linspace(-1, 1, width), np.linspace(-1, 1, height)
        falloff = (1 - sensor.vignetting / 2 * (across**2 + down[:, None] ** 2)).astype(np.float32)
        exposed = light * (falloff[..., None] * np.float32(sensor.gain)) * np.array(sensor.tint, dtype=np.float32)
        # Photon noise grows with the root of the signal; the constant term is read-out noise.
        spread = np.float32(sensor.noise) * np.sqrt(np.float32(6e-5) * np.maximum(exposed, 0) + np.float32(2.5e-6))
        exposed += spread * rng.standard_normal(exposed.shape, dtype=np.float32)
        return np.round(255 * _encode(exposed)).astype(np.uint8)

    def radiance(self, pose: Pose) -> Float32Array:
        """Return linear light (H, W, 3), about 0…1, before exposure."""
        rotation = pose.geo_from_cam.astype(np.float32)
        parts = []
        for k, band in enumerate(self._bands):
            rays = self._kept[k] if self._kept else _rays(self._lens, band, self._samples).astype(np.float32)
            light = self._shade(self._of_band(pose, band), rays @ rotation.T, rotation)
            # Samples are clipped before the mean: a highlight inside a pixel must not outshine its other samples.
            light = np.minimum(light, np.float32(1.5)).reshape(-1, self._lens.width, self._samples, 3)
            # The sum is taken slice by slice: numpy's mean over such a short axis takes four times as long.
            parts.append(sum(light[:, :, k] for k in range(self._samples)) / np.float32(self._samples))
        return np.concatenate(parts)

    def depth(self, pose: Pose) -> Float32Array:
        """Return depth (H, W) in metres along the camera's z axis at the pixel centres; 0 for the sky."""
        parts = []
        for band in self._bands:
            directions, center = _rays(self._lens, band, 1) @ pose.geo_from_cam.T, self._of_band(pose, band).center
            hits = self.raycaster.first_hits(center, directions)
            # The directions have z = 1 in the camera, so that the distance along them is the depth.
            distance = self.raycaster.exact_distance(center, directions, hits)
            parts.append(np.nan_to_num(distance, nan=0.0).astype(np.float32).reshape(-1, self._lens.width))
        return np.concatenate(parts)

    def _of_band(self, pose: Pose, band: tuple[int, int]) -> Pose:
        return replace(pose, center=pose.at_row(sum(band) / 2 / self._lens.height))

    def _shade(self, pose: Pose, rays: Float32Array, rotation: Float32Array) -> Float32Array:
        """Return the linear light (N, 3) that comes along rays (N, 3) of depth 1."""
        hits = self.raycaster.first_hits(pose.center, rays)
        hit = hits.triangle != MISS
        light = np.empty_like(rays)
        free, seen = np.nonzero(~hit)[0], np.nonzero(hit)[0]
        light[free] = _sky(rays[free], self._scene.sun.astype(np.float32))
        if len(seen):
            surface_hits = Hits(hits.triangle[seen], hits.distance[seen], hits.barycentric[seen])
            color = self._surface_light(pose, rays[seen], surface_hits, rotation)
            haze = 1 - np.exp(-np.square(surface_hits.distance / np.float32(_HAZE_M)))
            light[seen] = mix(color, _HORIZON, haze)
        return light

    def _surface_light(self, pose: Pose, rays: Float32Array, hits: Hits, rotation: Float32Array) -> Float32Array:
        mesh = self._scene.mesh
        points = pose.center.astype(np.float32) + rays * hits.distance[:, None]
        normals = _normals(mesh.normals[hits.triangle], hits.barycentric, rays)
        samples = self._texture_samples(points, rays, hits, normals, rotation)
        color = albedo(samples, mesh.material[hits.triangle], self._scene.plan)
        sun = self._scene.sun.astype(np.float32)
        facing = normals @ sun
        lit = np.nonzero(facing > 0)[0]
        start = points[lit] + np.float32(_SHADOW_LIFT_M) * normals[lit]
        shadowed = self.raycaster.blocked(start, np.broadcast_to(sun, start.shape))
        facing[facing < 0] = 0
        facing[lit[shadowed]] = 0
        sky = np.float32(0.5) + np.float32(0.5) * normals[:, 2]
        incoming = facing[:, None] * _SUN + sky[:, None] * _SKY + (1 - sky)[:, None] * _BOUNCE
        return np.asarray(color * incoming * np.float32(1 / 2.6))

    def _texture_samples(
        self, points: Float32Array, rays: Float32Array, hits: Hits, normals: Float32Array, rotation: Float32Array
    ) -> TextureSamples:
        mesh, index = self._scene.mesh, hits.triangle
        u_axis, v_axis, uv_shift = mesh.u_axis[index], mesh.v_axis[index], mesh.uv_shift[index]
        along = np.minimum(_dot(rays, normals), np.float32(-0.04) * np.linalg.norm(rays, axis=1))
        pixel = hits.distance / np.float32(self._lens.focal_px)
        ray_u, ray_v = _dot(rays, u_axis), _dot(rays, v_axis)
        du = dv = np.zeros_like(pixel)
        for axis in (rotation[:, 0], rotation[:, 1]):
            # The step of one pixel slides along the ray onto the surface.
            slide = (normals @ axis) / along
            du = du + np.abs(u_axis @ axis - slide * ray_u)
            dv = dv + np.abs(v_axis @ axis - slide * ray_v)
        return TextureSamples(
            _dot(points, u_axis) + uv_shift[:, 0],
            _dot(points, v_axis) + uv_shift[:, 1],
            pixel * du,
            pixel * dv,
            mesh.texture_params[mesh.texture[index]],
        )


def _rays(lens: BrownLens, band: tuple[int, int], samples: int) -> FloatArray:
    """Return directions (rows · W · samples, 3), z = 1: a turned grid in each pixel, its centre for one sample."""
    side = round(samples**0.5)
    grid = (np.arange(side) + 0.5) / side - 0.5
    dx, dy = (part.ravel() for part in np.meshgrid(grid, grid))
    turn = np.arctan(0.5) if side > 1 else 0.0
    offset = np.stack([dx * np.cos(turn) - dy * np.sin(turn), dx * np.sin(turn) + dy * np.cos(turn)], axis=1)
    y, x = np.mgrid[band[0] : band[1], 0 : lens.width] + 0.5
    centers = np.stack([x.ravel(), y.ravel()], axis=1)
    return lens.directions((centers[:, None] + offset).reshape(-1, 2))


def _dot(a: Float32Array, b: Float32Array) -> Float32Array:
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _normals(corners: Float32Array, weights: Float32Array, rays: Float32Array) -> Float32Array:
    """Return interpolated unit normals (N, 3), turned towards the camera."""
    first = (1 - weights[:, 0] - weights[:, 1])[:, None]
    normal = first * corners[:, 0] + weights[:, :1] * corners[:, 1] + weights[:, 1:] * corners[:, 2]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal[_dot(normal, rays) > 0] *= -1
    return np.asarray(normal)


def _sky(rays: Float32Array, sun: Float32Array) -> Float32Array:
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    height = np.clip(unit[:, 2], 0, 1)[:, None] ** np.float32(0.6)
    glow = np.clip(unit @ sun, 0, 1)[:, None] ** 8
    return np.asarray(_HORIZON + (_ZENITH - _HORIZON) * height + np.float32(0.2) * glow)


def _encode(linear: Float32Array) -> Float32Array:
    """Return values on sRGB's curve, after a soft shoulder that keeps highlights from clipping."""
    clean = np.maximum(linear, 0)
    rolled = np.where(clean < 0.7, clean, 0.7 + 0.3 * np.tanh((clean - 0.7) / 0.3))
    return np.asarray(np.where(rolled < 0.0031308, 12.92 * rolled, 1.055 * rolled ** (1 / 2.4) - 0.055))
