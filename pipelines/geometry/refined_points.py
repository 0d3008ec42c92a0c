"""Points of a bundle, moved to where cameras that have changed now see them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.bundle import Network
from pipelines.geometry.cameras import project_each
from pipelines.robust.kernels import cauchy_loss, cauchy_weight

_STEPS = 4
_DIFFERENCE = 1e-6  # of the depth
_DAMPING = 1e-6  # of the trace: a point that its rays leave open along them stays there
_CHUNK = 300_000  # observations: 0.1 GB of working arrays


@dataclass(frozen=True)
class RefinedPoints:
    """N points of a network.

    Attributes:
        point_in_world: (N, 3) metres.
        error_px: (N,) mean reprojection error; NaN for a point that no camera sees in front of it.
    """

    point_in_world: FloatArray
    error_px: FloatArray


def refined_points(network: Network) -> RefinedPoints:
    """Return the points at the least robust reprojection error, with the cameras held.

    Gauss–Newton with Cauchy's kernel from the points' present positions; a step that does not lower a point's error
    is not taken.

    Args:
        network: observations sorted by point.
    """
    refined = RefinedPoints(network.point_in_world.copy(), np.full(len(network.point_in_world), np.nan))
    for points, observations in _chunks(network):
        part = replace(
            network,
            point_in_world=network.point_in_world[points],
            obs_point=network.obs_point[observations] - points.start,
            obs_image=network.obs_image[observations],
            obs_xy_px=network.obs_xy_px[observations],
        )
        refined.point_in_world[points], refined.error_px[points] = _refine(part)
    return refined


def _chunks(network: Network) -> list[tuple[slice, slice]]:
    """Return slices of points and of their observations, about `_CHUNK` observations each."""
    count = len(network.point_in_world)
    starts = np.searchsorted(network.obs_point, np.arange(count + 1))
    cuts = np.searchsorted(starts, np.arange(0, max(int(starts[-1]), 1), _CHUNK)).tolist()
    cuts = sorted({*cuts, count})
    return [(slice(a, b), slice(int(starts[a]), int(starts[b]))) for a, b in pairwise(cuts)]


def _refine(network: Network) -> tuple[FloatArray, FloatArray]:
    point = network.point_in_world
    residual, usable = _residuals(network, point)
    cost = _cost(network, residual, usable)
    for _ in range(_STEPS):
        jacobian = _jacobian(network, point, residual, usable)
        weight = usable * cauchy_weight((residual**2).sum(axis=1), 2)
        normal = _sums(network, weight[:, None, None] * np.swapaxes(jacobian, 1, 2) @ jacobian)
        pull = _sums(network, weight[:, None] * np.einsum("mda,md->ma", jacobian, residual))
        trace = np.trace(normal, axis1=1, axis2=2)
        damping = np.where(trace > 0, _DAMPING * trace, 1.0)
        step = np.linalg.solve(normal + damping[:, None, None] * np.eye(3), pull[..., None])[..., 0]
        moved = point - step
        moved_residual, moved_usable = _residuals(network, moved)
        moved_cost = _cost(network, moved_residual, moved_usable)
        better = (moved_cost < cost) & (_sums(network, (usable & ~moved_usable).astype(float)) == 0)
        point = np.where(better[:, None], moved, point)
        cost = np.where(better, moved_cost, cost)
        taken = better[network.obs_point]
        residual = np.where(taken[:, None], moved_residual, residual)
        usable = np.where(taken, moved_usable, usable)
    seen = _sums(network, usable.astype(float))
    total = _sums(network, usable * np.linalg.norm(residual, axis=1))
    return point, np.where(seen > 0, total / np.maximum(seen, 1), np.nan)


def _in_cam(network: Network, point: FloatArray) -> FloatArray:
    ray = point[network.obs_point] - network.cam_center_in_world[network.obs_image]
    return np.asarray(np.einsum("mij,mj->mi", network.cam_from_world[network.obs_image], ray))


def _project(network: Network, in_cam: FloatArray) -> FloatArray:
    return project_each(network.cameras, network.camera_id[network.obs_image], in_cam)


def _residuals(network: Network, point: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return projected minus observed (M, 2), and the mask of points before their camera; zero behind it."""
    residual = _project(network, _in_cam(network, point)) - network.obs_xy_px
    usable = np.asarray(np.isfinite(residual).all(axis=1))
    return np.where(usable[:, None], residual, 0.0), usable


def _jacobian(network: Network, point: FloatArray, residual: FloatArray, usable: BoolArray) -> FloatArray:
    """Return the derivative (M, 2, 3) of the residuals by their points, by differences along the camera's axes."""
    in_cam = _in_cam(network, point)
    step = _DIFFERENCE * np.maximum(np.abs(in_cam[:, 2]), 1e-3)
    here = residual + network.obs_xy_px
    by_cam = [(_project(network, in_cam + step[:, None] * axis) - here) / step[:, None] for axis in np.eye(3)]
    jacobian = np.stack(by_cam, axis=-1) @ network.cam_from_world[network.obs_image]
    return np.where((usable & np.isfinite(jacobian).all(axis=(1, 2)))[:, None, None], jacobian, 0.0)


def _cost(network: Network, residual: FloatArray, usable: BoolArray) -> FloatArray:
    """Return the sums (N,) of Cauchy's kernel over the observations of each point."""
    return _sums(network, usable * cauchy_loss((residual**2).sum(axis=1), 2))


def _sums(network: Network, values: FloatArray) -> FloatArray:
    """Return the sums (N, …) of values (M, …) over the observations of each point."""
    flat = values.reshape(len(values), -1)
    count = len(network.point_in_world)
    sums = [np.bincount(network.obs_point, column, count).astype(np.float64) for column in flat.T]
    return np.asarray(np.stack(sums, axis=-1).reshape(count, *values.shape[1:]))
