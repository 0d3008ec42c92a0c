"""Intersection of rays from uncertain cameras: many points at once, robust, with covariance.

GeoRefGS section 2.3, eqs 4–15 (doi 10.3390/drones10030195). The paper minimises Σ |(X − Cᵢ) × dᵢ|² with equal
weights and propagates Σ_X = J Σ_obs Jᵀ. Here every ray is whitened first:

1. (X − Cᵢ) has two components across the ray. Three errors cause their covariance: the camera's position, its
   attitude (times distance) and the pixel (times depth).
2. Whitening divides the two components by that covariance. J Σ_obs Jᵀ is then the inverse of the normal matrix, and
   no linear estimate is better.
3. A convex robust fit reveals one bad fix among several rays. The ray of that fix is left out.

Rays are flat arrays sorted by point. The rays of a point are a run (a segment) of the arrays.

`nearest_points` takes cameras and rays as they are, for marks that have been checked: point, covariance and
derivatives. `intersection_jacobian` is the same to first order, by the unknowns of a bundle. `refined_points` moves
the points of a bundle to where cameras that have changed now see them.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csr_matrix

from pipelines.core.machine import thread_count
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.cameras import project_each
from pipelines.geometry.network import (
    Network,
    chunks_of_points,
    has_positive_depth,
    lens_slots,
    linearise_bundle,
    projection_residuals,
    with_positive_depths,
)
from pipelines.geometry.rotations import skew
from pipelines.geometry.statistics import cauchy_loss, cauchy_weight, chi2_quantile, huber_weight


@dataclass(frozen=True)
class CommonRotation:
    """A rotation error that all cameras share, as when SfM's rotations were aligned to geo as a whole."""

    cov_rad2: FloatArray  # (3, 3) of the rotation vector in geo
    gain: FloatArray  # (n, 3, 3) rad per metre of error of each camera's centre, from which it was estimated


@dataclass(frozen=True)
class UncertainCameras:
    """n cameras in geo, with errors that are independent between cameras (but for `common`)."""

    center_in_geo: FloatArray  # (n, 3) metres
    rotation_geo_from_cam: FloatArray  # (n, 3, 3)
    cov_center_in_geo: FloatArray  # (n, 3, 3) m², of the position
    sigma_attitude_rad: FloatArray  # (n,) per axis
    sigma_ray: FloatArray  # (n,) σ of x/z and y/z: σ of the pixel over the focal length
    common: CommonRotation | None = None  # rotation error of all cameras together, or None


@dataclass(frozen=True)
class Rays:
    """M rays: `point` (M,) ascending, `view` (M,) index of the camera, `xy` (M, 2) undistorted x/z and y/z."""

    point: IntArray
    view: IntArray
    xy: FloatArray


@dataclass(frozen=True)
class Intersections:
    """Positions of N points at which rays intersect."""

    position_in_geo: FloatArray  # (N, 3) metres, NaN with fewer than two rays or parallel ones
    cov_in_geo: FloatArray  # (N, 3, 3) m², NaN likewise
    ray_count: NDArray[np.int32]  # (N,) rays used
    max_angle_deg: FloatArray  # (N,) largest angle between two used rays
    condition: FloatArray  # (N,) condition number of the normal matrix; infinite where there is no position
    consistent: BoolArray  # (N,) most rays agree within their σ, and the point lies in front of all that do
    used: BoolArray  # (M,) rays that were used

    @classmethod
    def none(cls, point_count: int, ray_count: int = 0) -> Intersections:
        """Return the intersections of points none of which has a position."""
        return cls(
            position_in_geo=np.full((point_count, 3), np.nan),
            cov_in_geo=np.full((point_count, 3, 3), np.nan),
            ray_count=np.zeros(point_count, dtype=np.int32),
            max_angle_deg=np.zeros(point_count),
            condition=np.full(point_count, np.inf),
            consistent=np.zeros(point_count, dtype=bool),
            used=np.zeros(ray_count, dtype=bool),
        )


_CHUNK_RAYS = 60_000  # working arrays of a chunk stay in the processor's cache
_CONVEX_SCALE = 0.5  # near enough to a sum of distances that the fit is a median
_CONVEX_STEPS, _REDESCENDING_STEPS = 6, 4
_RAY_GATE = float(chi2_quantile(0.999, 2))
_RAY_ALARM = float(chi2_quantile(0.99, 2))
_WORST_CONDITION = 1e10


@dataclass(frozen=True)
class _RayBundle:
    """The rays of one chunk of p points with at least two rays each."""

    start: IntArray  # (p,) first ray of each point
    owner: IntArray  # (m,) point of each ray
    view: IntArray  # (m,)
    center: FloatArray  # (m, 3), from `shift`
    direction: FloatArray  # (m, 3) unit
    axis: FloatArray  # (m, 3) optical axis of its camera
    shift: FloatArray  # (3,) subtracted, so that large coordinates cost no digits

    def select(self, points: BoolArray) -> tuple[_RayBundle, BoolArray]:
        """Return the bundle of the chosen points (p,), and the mask of their rays (m,)."""
        rays = points[self.owner]
        renumber = np.cumsum(points) - 1
        owner = renumber[self.owner[rays]]
        start = np.searchsorted(owner, np.arange(int(points.sum())))
        fields = (self.view[rays], self.center[rays], self.direction[rays], self.axis[rays])
        return _RayBundle(start, owner, *fields, self.shift), rays

    def sum_by_point(self, values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values, self.start, axis=0))


def intersect_rays(rays: Rays, cameras: UncertainCameras, point_count: int) -> Intersections:
    """Intersect the rays of each of N points.

    Raises:
        ValueError: `rays.point` is not ascending.
    """
    if len(rays.point) and (np.diff(rays.point) < 0).any():
        raise ValueError("rays must be sorted by point")
    intersections = Intersections.none(point_count, len(rays.point))
    counts = np.bincount(rays.point, minlength=point_count)
    usable = np.flatnonzero(counts[rays.point] >= 2)
    point = rays.point[usable]
    # Chunks never end within a point; those without rays are left out.
    starts = np.unique(np.searchsorted(point, point[_CHUNK_RAYS::_CHUNK_RAYS]))
    chunks = [chosen for chosen in np.split(usable, starts) if len(chosen)]
    with ThreadPoolExecutor(thread_count()) as pool:  # numpy lets go of the interpreter in these sizes
        list(pool.map(partial(_intersect_chunk, rays, cameras, intersections), chunks))
    return intersections


def _intersect_chunk(rays: Rays, cameras: UncertainCameras, intersections: Intersections, chosen: IntArray) -> None:
    bundle, ids = _ray_bundle(rays, cameras, chosen)
    fit = _fit_rays(bundle, cameras)
    position, used = fit.position, fit.used
    information = fit.information * used[:, None, None]
    normal = bundle.sum_by_point(information)
    eigenvalues = np.linalg.eigvalsh(normal)
    solved = eigenvalues[:, 0] * _WORST_CONDITION > eigenvalues[:, 2]
    condition = np.where(solved, eigenvalues[:, 2] / np.where(solved, eigenvalues[:, 0], 1.0), np.inf)
    offset = position[bundle.owner] - bundle.center
    squared = _squared_residuals(fit.whitener, offset)
    ahead = (offset * bundle.direction).sum(axis=1) > 0
    count = bundle.sum_by_point(used.astype(np.float64))
    agrees = bundle.sum_by_point(used * squared) <= chi2_quantile(0.9999, np.maximum(2 * count - 3, 1))
    behind = bundle.sum_by_point((used & ~ahead).astype(np.float64)) > 0
    most = 2 * count > bundle.sum_by_point(np.ones(len(used)))
    cov = np.full((len(ids), 3, 3), np.nan)
    cov[solved] = np.linalg.solve(normal[solved], np.eye(3))
    if cameras.common is not None:
        cov += _common_covariance(bundle, cameras, cameras.common, cov[bundle.owner] @ information, offset)
    intersections.position_in_geo[ids] = np.where(solved[:, None], position + bundle.shift, np.nan)
    intersections.cov_in_geo[ids] = (cov + np.swapaxes(cov, 1, 2)) / 2
    intersections.ray_count[ids] = np.where(solved, count, 0)
    intersections.max_angle_deg[ids] = _largest_angle_deg(bundle, used)
    intersections.condition[ids] = condition
    intersections.consistent[ids] = solved & agrees & most & ~behind & (count >= 2)
    intersections.used[chosen] = used & solved[bundle.owner]


def _ray_bundle(rays: Rays, cameras: UncertainCameras, chosen: IntArray) -> tuple[_RayBundle, IntArray]:
    point, view, xy = rays.point[chosen], rays.view[chosen], rays.xy[chosen]
    start = np.flatnonzero(np.diff(point, prepend=point[0] - 1))
    owner = np.repeat(np.arange(len(start)), np.diff(np.append(start, len(point))))
    rotation = cameras.rotation_geo_from_cam[view]
    in_cam = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    direction = (rotation @ in_cam[..., None])[..., 0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    shift = cameras.center_in_geo[view[0]]
    center = cameras.center_in_geo[view] - shift
    return _RayBundle(start, owner, view, center, direction, rotation[:, :, 2], shift), point[start]


@dataclass
class _RayFit:
    position: FloatArray  # (p, 3), from the bundle's shift
    whitener: FloatArray  # (m, 2, 3)
    information: FloatArray  # (m, 3, 3), W = Gᵀ G
    used: BoolArray  # (m,)


def _fit_rays(bundle: _RayBundle, cameras: UncertainCameras) -> _RayFit:
    """Fit points by least squares, and robustly where a ray is out of its σ."""
    # Eq. 9 with equal weights: near enough for the distances.
    position = _solve_points(bundle, across_rays(bundle.direction))
    whitener, information = _whitener(bundle, cameras, position)
    fit = _RayFit(_solve_points(bundle, information), whitener, information, np.ones(len(bundle.owner), dtype=bool))
    squared = _squared_residuals(whitener, fit.position[bundle.owner] - bundle.center)
    degrees = 2 * np.diff(np.append(bundle.start, len(bundle.owner))) - 3
    alarm = (bundle.sum_by_point(squared) > chi2_quantile(0.99, degrees)) | (
        np.maximum.reduceat(squared, bundle.start) > _RAY_ALARM
    )
    if alarm.any():
        suspect, rays = bundle.select(alarm)
        robust = _fit_robust(
            suspect, cameras, _RayFit(fit.position[alarm], whitener[rays], information[rays], rays[rays])
        )
        fit.position[alarm], fit.whitener[rays] = robust.position, robust.whitener
        fit.information[rays], fit.used[rays] = robust.information, robust.used
    return fit


def _fit_robust(bundle: _RayBundle, cameras: UncertainCameras, start: _RayFit) -> _RayFit:
    """Fit points by a nearly convex loss, then by a redescending loss, then by least squares within the gate.

    No outlier can mask the single minimum of the first. The last gives full weight, as the covariance assumes.
    """
    position, whitener, information = start.position, start.whitener, start.information
    convex, redescending = partial(huber_weight, scale=_CONVEX_SCALE), partial(cauchy_weight, dimension=2)
    for steps, weigh in ((_CONVEX_STEPS, convex), (_REDESCENDING_STEPS, redescending)):
        weighted_center = (information @ bundle.center[..., None])[..., 0]
        for _ in range(steps):
            weight = weigh(_squared_residuals(whitener, position[bundle.owner] - bundle.center))
            position = _solve_points(bundle, information * weight[:, None, None], weighted_center * weight[:, None])
        whitener, information = _whitener(bundle, cameras, position)  # the distances have changed
    used = np.ones(len(bundle.owner), dtype=bool)
    for _ in range(2):
        used = _squared_residuals(whitener, position[bundle.owner] - bundle.center) <= _RAY_GATE
        position = _solve_points(bundle, information * used[:, None, None])
    return _RayFit(position, whitener, information, used)


def _whitener(bundle: _RayBundle, cameras: UncertainCameras, position: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return G (m, 2, 3) such that G (X − C) has unit covariance for the errors of eqs 10–12, and W = Gᵀ G."""
    basis = _axes_across(bundle.direction)
    offset = position[bundle.owner] - bundle.center
    distance = (offset * bundle.direction).sum(axis=1)
    cosine = (bundle.direction * bundle.axis).sum(axis=1)
    cov = basis @ cameras.cov_center_in_geo[bundle.view] @ np.swapaxes(basis, 1, 2)
    # A pixel's σ moves the ray by depth · σ in the image plane, which is foreshortened along the axis.
    slant = (basis @ bundle.axis[..., None])[..., 0]
    pixel = (distance * cosine * cameras.sigma_ray[bundle.view]) ** 2
    cov -= pixel[:, None, None] * slant[:, :, None] * slant[:, None, :]
    isotropic = pixel + (distance * cameras.sigma_attitude_rad[bundle.view]) ** 2
    cov[:, 0, 0] += isotropic
    cov[:, 1, 1] += isotropic
    first = 1.0 / np.sqrt(cov[:, 0, 0])  # rows of the inverse Cholesky factor of the 2×2 covariance
    ratio = cov[:, 0, 1] / cov[:, 0, 0]
    second = 1.0 / np.sqrt(cov[:, 1, 1] - ratio * cov[:, 0, 1])
    rows = np.empty_like(basis)
    rows[:, 0] = first[:, None] * basis[:, 0]
    rows[:, 1] = second[:, None] * (basis[:, 1] - ratio[:, None] * basis[:, 0])
    return rows, np.swapaxes(rows, 1, 2) @ rows


def _axes_across(direction: FloatArray) -> FloatArray:
    """Return two unit vectors (m, 2, 3) across each direction and each other (Duff et al., JCGT 6(1), 2017)."""
    x, y, z = direction.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    basis = np.empty((len(direction), 2, 3))
    basis[:, 0, 0], basis[:, 0, 1], basis[:, 0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    basis[:, 1, 0], basis[:, 1, 1], basis[:, 1, 2] = b, sign + y * y * a, -y
    return basis


def _squared_residuals(whitener: FloatArray, offset: FloatArray) -> FloatArray:
    whitened = (whitener @ offset[..., None])[..., 0]
    return np.asarray((whitened**2).sum(axis=1))


def _solve_points(
    bundle: _RayBundle, information: FloatArray, weighted_center: FloatArray | None = None
) -> FloatArray:
    """Solve (Σ W) X = Σ W C for each point (eq. 9); `weighted_center` (m, 3) is W C where it is known."""
    normal = bundle.sum_by_point(information)
    right = bundle.sum_by_point(
        (information @ bundle.center[..., None])[..., 0] if weighted_center is None else weighted_center
    )
    # Without the ridge, parallel rays would stop the whole batch. The condition number reveals them afterwards.
    ridge = 1e-14 * np.trace(normal, axis1=1, axis2=2) + np.finfo(float).tiny
    normal[:, [0, 1, 2], [0, 1, 2]] += ridge[:, None]
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def _common_covariance(
    bundle: _RayBundle, cameras: UncertainCameras, common: CommonRotation, response: FloatArray, offset: FloatArray
) -> FloatArray:
    # The common rotation's own covariance, and that with the centres; ∂X/∂C of each ray and X − C.
    by_rotation = bundle.sum_by_point(response @ -skew(offset))
    shared = cameras.cov_center_in_geo @ np.swapaxes(common.gain, 1, 2)
    by_center = bundle.sum_by_point(response @ shared[bundle.view])
    cross = by_center @ np.swapaxes(by_rotation, 1, 2)
    of_rotation = by_rotation @ common.cov_rad2 @ np.swapaxes(by_rotation, 1, 2)
    return np.asarray(of_rotation + cross + np.swapaxes(cross, 1, 2))


def _largest_angle_deg(bundle: _RayBundle, used: BoolArray) -> FloatArray:
    """Return the largest angle (p,) between two used rays; 0 with fewer than two."""
    direction, owner = bundle.direction[used], bundle.owner[used]
    count = np.bincount(owner, minlength=len(bundle.start))
    first = np.cumsum(count) - count
    angle = np.zeros(len(count))
    for size in np.unique(count[count >= 2]):
        points = np.flatnonzero(count == size)
        for part in np.array_split(points, 1 + len(points) * size**2 // 4_000_000):
            run = direction[first[part][:, None] + np.arange(size)]
            cosine = (run @ np.swapaxes(run, 1, 2)).min(axis=(1, 2))
            angle[part] = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return angle


@dataclass(frozen=True)
class NearestPoints:
    """J points and the K rays of exact cameras that determine them, with covariance and derivatives of the points.

    A ray has the weight of its lateral variance at the point, (angular σ × distance)⁻².
    """

    position: FloatArray  # (J, 3), in the frame of the rays
    point: IntArray  # (K,) index into the points
    center: FloatArray  # (K, 3) projection centre
    direction: FloatArray  # (K, 3) unit
    sigma_rad: FloatArray  # (K,) angular σ

    @property
    def weight(self) -> FloatArray:
        distance = np.linalg.norm(self.position[self.point] - self.center, axis=1)
        return np.asarray(1.0 / (self.sigma_rad * distance) ** 2)

    @cached_property
    def cov(self) -> FloatArray:
        """Covariance (J, 3, 3) of the points from the σ of the rays."""
        normal = np.zeros((len(self.position), 3, 3))
        np.add.at(normal, self.point, self.weight[:, None, None] * across_rays(self.direction))
        return np.asarray(np.linalg.solve(normal, np.eye(3)))

    def derivatives(self) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives (K, 3, 3) of each ray's point by the ray's centre and by its direction.

        N dx = Σ w (P dc − dP (x − c)), and −dP (x − c) = (ρ I + d eᵀ) dd with x − c = ρ d + e.
        """
        arm = self.position[self.point] - self.center
        along = np.einsum("ki,ki->k", self.direction, arm)
        across = arm - along[:, None] * self.direction
        response = self.cov[self.point] * self.weight[:, None, None]
        turned = along[:, None, None] * np.eye(3) + self.direction[:, :, None] * across[:, None, :]
        return response @ across_rays(self.direction), response @ turned


def nearest_points(
    point: IntArray, center: FloatArray, direction: FloatArray, sigma_rad: FloatArray, count: int
) -> NearestPoints:
    """Return the J = `count` points nearest to their rays (K,), weighted as in `NearestPoints` (eqs 4–9)."""
    across, weight = across_rays(direction), np.asarray(1.0 / sigma_rad**2)
    nearest = NearestPoints(np.zeros((count, 3)), point, center, direction, sigma_rad)
    for _ in range(2):  # the first pass gives the distances, and so the weights
        nearest = replace(nearest, position=meeting_points(point, center, across, count, weight=weight))
        weight = nearest.weight
    return nearest


def meeting_points(
    point: IntArray,
    center: FloatArray,
    across: FloatArray,
    count: int,
    *,
    weight: FloatArray | None = None,
    ridge: float = 0.0,
) -> FloatArray:
    """Return the least-squares points (J, 3) of rays (K,) with `across_rays` (K, 3, 3): Σ w P x = Σ w P c (eq. 9).

    With a `ridge` on the diagonal, parallel rays do not raise.
    """
    weight = np.ones(len(point)) if weight is None else weight
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, point, weight[:, None, None] * across)
    np.add.at(right, point, weight[:, None] * np.einsum("kij,kj->ki", across, center))
    return np.asarray(np.linalg.solve(normal + ridge * np.eye(3), right[:, :, None])[:, :, 0])


def across_rays(direction: FloatArray) -> FloatArray:
    """Return the projections P = I − d dᵀ (K, 3, 3) across rays with unit vectors d."""
    return np.asarray(np.eye(3) - direction[:, :, None] * direction[:, None, :])


@dataclass(frozen=True)
class IntersectionJacobian:
    """Effect of poses, lens and marks on N intersected points, to first order."""

    # (3 N, 6 n) sparse, metres by (δω, δc) of each camera as in `geometry.bundle.BundleInformation`
    by_poses: csr_matrix
    by_lens: (
        FloatArray  # (N, 3, L) metres by the lens parameters, in the order of `geometry.bundle.BundleInformation`
    )
    # (N, 3, 3) m², from the σ of the marks; NaN for a point that its rays do not determine
    cov_of_marks: FloatArray


def intersection_jacobian(
    marks: Network, sigma_px: FloatArray, surveyed: FloatArray | None = None
) -> IntersectionJacobian:
    """Return the derivatives by poses and lens of the points of a network, each intersected from its own marks.

    The derivatives are taken at the projections of the points; of the marks their σ (M,) enter, and not the pixels.
    Marks of points behind their camera do not count. Points may have information (N, 3, 3) beyond these, in 1/m².
    """
    sigma_px, marks = sigma_px[has_positive_depth(marks)], with_positive_depths(marks)
    lin, count = linearise_bundle(marks), len(marks.point_in_world)
    weighted = np.swapaxes(lin.jacobian_point, 1, 2) / (sigma_px**2)[:, None, None]
    normal = np.zeros((count, 3, 3)) if surveyed is None else surveyed.copy()
    np.add.at(normal, marks.obs_point, weighted @ lin.jacobian_point)
    value, vector = np.linalg.eigh(normal)
    value[value[:, 0] <= 1e-9 * value[:, 2]] = np.nan
    cov = (vector / value[:, None, :]) @ np.swapaxes(vector, 1, 2)
    response = -cov[marks.obs_point] @ weighted  # (M, 3, 2) metres per pixel
    lens = np.zeros((count, len(marks.cameras), 3, lin.jacobian_intrinsics.shape[2]))
    np.add.at(lens, (marks.obs_point, lens_slots(marks)), response @ lin.jacobian_intrinsics)
    order = np.argsort(marks.obs_point, kind="stable")
    first = np.searchsorted(marks.obs_point[order], np.arange(count + 1))
    blocks = ((response @ lin.jacobian_pose)[order], marks.obs_image[order], first)
    poses = bsr_matrix(blocks, shape=(3 * count, 6 * len(marks.camera_id)))
    return IntersectionJacobian(csr_matrix(poses), np.swapaxes(lens, 1, 2).reshape(count, 3, -1), cov)


_STEPS = 4
_DIFFERENCE = 1e-6  # of the depth
_DAMPING = 1e-6  # of the trace: a point that its rays leave open along them stays there
_CHUNK = 300_000  # observations: 0.1 GB of working arrays


@dataclass(frozen=True)
class RefinedPoints:
    """N points of a network.

    `error_px` (N,) is the mean reprojection error; NaN for a point that no camera sees in front of it.
    """

    point_in_world: FloatArray
    error_px: FloatArray


def refined_points(network: Network) -> RefinedPoints:
    """Return the points at the least robust reprojection error, with the cameras frozen.

    Gauss–Newton with Cauchy's kernel from the points' present positions; a step that does not lower a point's error
    is not taken.
    """
    refined = RefinedPoints(network.point_in_world.copy(), np.full(len(network.point_in_world), np.nan))
    for part, points, _ in chunks_of_points(network, _CHUNK):
        refined.point_in_world[points], refined.error_px[points] = _refine(part)
    return refined


def _refine(network: Network) -> tuple[FloatArray, FloatArray]:
    residual, usable = _residuals(network)
    cost = _sums(network, usable * cauchy_loss((residual**2).sum(axis=1), 2))
    for _ in range(_STEPS):
        jacobian = _jacobian(network, residual, usable)
        weight = usable * cauchy_weight((residual**2).sum(axis=1), 2)
        normal = _sums(network, weight[:, None, None] * np.swapaxes(jacobian, 1, 2) @ jacobian)
        gradient = _sums(network, weight[:, None] * np.einsum("mda,md->ma", jacobian, residual))
        trace = np.trace(normal, axis1=1, axis2=2)
        damping = np.where(trace > 0, _DAMPING * trace, 1.0)
        step = np.linalg.solve(normal + damping[:, None, None] * np.eye(3), gradient[..., None])[..., 0]
        moved = replace(network, point_in_world=network.point_in_world - step)
        moved_residual, moved_usable = _residuals(moved)
        moved_cost = _sums(network, moved_usable * cauchy_loss((moved_residual**2).sum(axis=1), 2))
        better = (moved_cost < cost) & (_sums(network, (usable & ~moved_usable).astype(float)) == 0)
        point = np.where(better[:, None], moved.point_in_world, network.point_in_world)
        network, cost = replace(network, point_in_world=point), np.where(better, moved_cost, cost)
        taken = better[network.obs_point]
        residual = np.where(taken[:, None], moved_residual, residual)
        usable = np.where(taken, moved_usable, usable)
    seen = _sums(network, usable.astype(float))
    total = _sums(network, usable * np.linalg.norm(residual, axis=1))
    return network.point_in_world, np.where(seen > 0, total / np.maximum(seen, 1), np.nan)


def _residuals(network: Network) -> tuple[FloatArray, BoolArray]:
    """Return projected minus observed (M, 2), zero behind the camera, and the mask of points before theirs."""
    residual = projection_residuals(network)
    usable = np.asarray(np.isfinite(residual).all(axis=1))
    return np.where(usable[:, None], residual, 0.0), usable


def _jacobian(network: Network, residual: FloatArray, usable: BoolArray) -> FloatArray:
    """Return the derivative (M, 2, 3) of the residuals by their points, by differences along the camera's axes."""
    rotation, camera_of = network.cam_from_world[network.obs_image], network.camera_id[network.obs_image]
    in_cam = np.einsum("mij,mj->mi", rotation, network.rays())
    step = _DIFFERENCE * np.maximum(np.abs(in_cam[:, 2]), 1e-3)
    here = residual + network.obs_xy_px
    by_cam = [
        (project_each(network.cameras, camera_of, in_cam + step[:, None] * axis) - here) / step[:, None]
        for axis in np.eye(3)
    ]
    jacobian = np.stack(by_cam, axis=-1) @ rotation
    return np.where((usable & np.isfinite(jacobian).all(axis=(1, 2)))[:, None, None], jacobian, 0.0)


def _sums(network: Network, values: FloatArray) -> FloatArray:
    """Return the sums (N, …) of values (M, …) over the observations of each point."""
    flat = values.reshape(len(values), -1)
    count = len(network.point_in_world)
    sums = [np.bincount(network.obs_point, column, count).astype(np.float64) for column in flat.T]
    return np.stack(sums, axis=-1).reshape(count, *values.shape[1:])
