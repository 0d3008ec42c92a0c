"""Time, memory and calibration of the sparse camera solve: `python examples/benchmarks/many_cameras.py --cameras
1000`.

A flight over hilly ground is made of geometry alone: cameras on parallel lines with 80 % and 60 % overlap, tie
points with noisy pixels, an RTK fix for each camera, all with one common error, control points and check points
with noisy marks. True corrections of cameras and lens are drawn from the bundle's covariance. The solve then has to
find them. The errors over their predicted σ have a root mean square of 1 where the covariances are right.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import diags

from pipelines.adjust.posterior import camera_covariances
from pipelines.adjust.state import State, SystematicError, SystematicErrors
from pipelines.adjust.system import Problem, linearised, minimise, posterior_weights
from pipelines.adjust.terms import ControlPoints, Fixes
from pipelines.core.machine import peak_memory_bytes
from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.bundle import BundleInformation, bundle_information
from pipelines.geometry.cameras import Camera, CameraPoses, Lenses, bearings, project_each
from pipelines.geometry.intersection import intersection_jacobian
from pipelines.geometry.network import Network
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import perturbation
from pipelines.geometry.sparse_cholesky import SparseCholesky

_HEIGHT_M, _RELIEF_M, _TILT_RAD = 100.0, 8.0, 0.03
_LENS = Camera("OPENCV", 6000, 4000, np.array([4200.0, 4200.0, 3000.0, 2000.0, -0.05, 0.01, 1e-4, -1e-4]))
_ALONG, _ACROSS = 0.2, 0.4  # of the footprint, between photographs and between lines
_SEEN = 0.4  # part of the photographs in which the matcher finds a point
_CHUNK = 50_000  # points
_TIE_PX, _MARK_PX, _SURVEY_M = 0.6, 0.4, 0.01
_RTK_M, _COMMON_M = np.array([0.02, 0.02, 0.03]), (0.03, 0.03, 0.05)
_START = np.array([0.001, 0.002, 0.002, 0.002, 0.3, 0.3, 0.3])  # of the similarity that the descent starts from


@contextmanager
def timed(name: str) -> Iterator[None]:
    """Print the seconds that a step takes, those of all processors, and the most memory so far."""
    clock, processor = time.perf_counter(), time.process_time()
    yield
    peak = (peak_memory_bytes() or math.nan) / 1e9
    taken, used = time.perf_counter() - clock, time.process_time() - processor
    print(f"  {name:34s} {taken:7.1f} s   processor {used:7.1f} s   peak {peak:5.2f} GB", flush=True)


@dataclass(frozen=True)
class Flight:
    """Poses of n cameras on a grid, and the distances between them."""

    rotation: FloatArray
    center: FloatArray
    columns: int
    step_m: FloatArray

    def seeing(self, point: FloatArray, share: float, rng: np.random.Generator) -> Network:
        """The network of points (N, 3), with exact pixels in a share of the photographs that cover them."""
        parts = [self._covered(part, share, rng) for part in np.array_split(point, len(point) // _CHUNK + 1)]
        first = np.cumsum([0, *(len(part[0]) for part in parts)])
        return Network(
            {1: _LENS},
            np.ones(len(self.center), dtype=np.int64),
            self.rotation,
            self.center,
            np.concatenate([part[0] for part in parts]),
            np.concatenate([shift + part[1] for shift, part in zip(first, parts, strict=False)]),
            np.concatenate([part[2] for part in parts]),
            np.concatenate([part[3] for part in parts]),
        )

    def _covered(
        self, point: FloatArray, share: float, rng: np.random.Generator
    ) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
        """Points in at least three photographs; and point, photograph and pixel of each observation."""
        reach = np.ceil(0.5 / np.array([_ACROSS, _ALONG])).astype(int) + 1
        offset = np.stack(np.meshgrid(*(np.arange(-r, r + 1) for r in reach)), axis=-1).reshape(-1, 2)
        cell = np.rint(point[:, :2] / self.step_m).astype(int)[:, None] + offset
        rows = -(-len(self.center) // self.columns)
        image = cell[..., 1] * self.columns + cell[..., 0]
        inside = ((cell >= 0) & (cell < [self.columns, rows])).all(axis=2) & (image < len(self.center))
        inside &= rng.random(inside.shape) < share
        owner, place = np.nonzero(inside)
        image = image[owner, place]
        xy_px = self._pixels(point[owner], image)
        seen = ((xy_px > 0) & (xy_px < [_LENS.width, _LENS.height])).all(axis=1)
        enough = np.bincount(owner[seen], minlength=len(point)) >= 3
        seen &= enough[owner]
        return point[enough], (np.cumsum(enough) - 1)[owner[seen]], image[seen], xy_px[seen]

    def _pixels(self, point: FloatArray, image: IntArray) -> FloatArray:
        in_cam = np.einsum("mij,mj->mi", self.rotation[image], point - self.center[image])
        return np.asarray(project_each({1: _LENS}, np.ones(len(image), dtype=np.int64), in_cam))


def fly(count: int, rng: np.random.Generator) -> Flight:
    """Cameras on parallel lines that look down, each line against the one before."""
    focal = _LENS.params[0]
    step_m = np.array([_ACROSS * _LENS.width, _ALONG * _LENS.height]) * _HEIGHT_M / focal
    columns = max(int(np.sqrt(count * step_m[1] / step_m[0])), 2)
    row, column = np.divmod(np.arange(count), columns)
    center = np.column_stack([column * step_m[0], row * step_m[1], np.full(count, _HEIGHT_M)])
    center += rng.normal(0, 1.0, center.shape)
    down = np.diag([1.0, -1.0, -1.0])
    yaw = exp_so3((column % 2 * np.pi)[:, None] * [0.0, 0.0, 1.0])
    return Flight(exp_so3(rng.normal(0, _TILT_RAD, (count, 3))) @ yaw @ down, center, columns, step_m)


def ground(flight: Flight, count: int, rng: np.random.Generator) -> FloatArray:
    """Points (count, 3) under the flight."""
    low, high = flight.center[:, :2].min(axis=0), flight.center[:, :2].max(axis=0)
    xy = rng.uniform(low, high, (count, 2))
    height = _RELIEF_M * (np.sin(xy[:, 0] / 60) * np.cos(xy[:, 1] / 45)) + rng.uniform(0, 4, count)
    return np.column_stack([xy, height])


def drawn_truth(
    network: Network, bundle: BundleInformation, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Corrections (n, 6) of the cameras and (L,) of the lens, drawn from the bundle's covariance."""
    sums = bundle.sums
    hold = diags((bundle.unit * bundle.loosest_sigma_m) ** -2.0).tobsr((6, 6))  # of the similarity, removed below
    factor = SparseCholesky((sums.poses + hold).tobsr((6, 6)), network.cam_center_in_world)
    response = factor.solve(sums.cross)
    lens = rng.multivariate_normal(np.zeros(len(sums.lens)), np.linalg.inv(sums.lens - sums.cross.T @ response))
    poses = factor.coloured(rng.normal(size=(len(bundle.unit), 1)))[:, 0] - response @ lens
    common = bundle.followed @ np.concatenate([poses, lens])
    return (poses - bundle.similarity_modes @ common).reshape(-1, 6), lens


def marks_of(seen: Network, truth: tuple[FloatArray, FloatArray], rng: np.random.Generator) -> ControlPoints:
    """Noisy marks of points, read through the uncorrected lens, and their noisy survey in the true cameras."""
    moved = intersection_jacobian(seen, np.full(len(seen.obs_point), _MARK_PX))
    corrections, lens = truth
    true = seen.point_in_world + (moved.by_poses @ corrections.ravel()).reshape(-1, 3) + moved.by_lens @ lens
    xy_px = seen.obs_xy_px + rng.normal(0, _MARK_PX, seen.obs_xy_px.shape)
    cov = moved.cov_of_marks + _SURVEY_M**2 * np.eye(3)
    return ControlPoints(
        tuple(map(str, range(len(true)))),
        seen.obs_point,
        seen.obs_image,
        bearings(_LENS, xy_px),
        np.full(len(xy_px), _MARK_PX / _LENS.params[0]),
        Lenses(seen.cameras, seen.camera_id).bearing_jacobian(seen.obs_image, xy_px),
        true + rng.normal(0, _SURVEY_M, true.shape),
        cov,
    )


def problem_of(
    network: Network,
    bundle: BundleInformation,
    truth: tuple[FloatArray, FloatArray],
    marks: ControlPoints,
    rng: np.random.Generator,
) -> Problem:
    """Fixes of all cameras with a common error, and marks of control points."""
    center, count = network.cam_center_in_world, len(network.camera_id)
    position = center + truth[0][:, 3:] + rng.normal(0, _COMMON_M) + _RTK_M * rng.normal(size=center.shape)
    fixes = Fixes(
        tuple(map(str, range(count))),
        np.arange(count),
        position,
        np.tile(np.diag(_RTK_M**2), (count, 1, 1)),
        np.zeros(count, dtype=np.int64),
    )
    errors = SystematicErrors((SystematicError("bias", _COMMON_M, 0),))
    return Problem(CameraPoses(network.cam_from_world, center), bundle, (fixes, marks), errors)


def normalised(error: FloatArray, cov: FloatArray) -> float:
    """Root mean square of errors (m, d) over their σ, all correlations of a row taken into account."""
    squared = np.einsum("mi,mi->m", error, np.linalg.solve(cov, error[:, :, None])[:, :, 0])
    return float(np.sqrt(squared.mean() / error.shape[1]))


def measure(count: int, points_per_camera: int, controls: int, seed: int) -> None:
    """Make a flight, solve it, and print what that took and how large the errors are."""
    rng = np.random.default_rng(seed)
    with timed("synthetic geometry"):
        flight = fly(count, rng)
        network = flight.seeing(ground(flight, count * points_per_camera // 5, rng), _SEEN, rng)
        noise = rng.normal(0, _TIE_PX, network.obs_xy_px.shape)
        network = replace(network, obs_xy_px=network.obs_xy_px + noise)
    rays = len(network.obs_point)
    print(f"  {rays / 1e6:.2f} million observations of {len(network.point_in_world) / 1e6:.2f} million points")
    with timed("information of the bundle"):
        bundle = bundle_information(network)
    with timed("draw of the truth"):
        truth = drawn_truth(network, bundle, rng)
        control = marks_of(flight.seeing(ground(flight, controls, rng), 1.0, rng), truth, rng)
        seen = flight.seeing(ground(flight, controls, rng), 1.0, rng)
        check = marks_of(seen, truth, rng)
        problem = problem_of(network, bundle, truth, control, rng)
        center = network.cam_center_in_world.mean(axis=0)
        start = perturbation(_START * rng.normal(size=7), center)
        state = State(start, np.zeros((count, 6)), np.zeros(len(truth[1])), np.zeros(len(problem.errors)))
    with timed("minimum"):
        state = minimise(problem, state).state
    with timed("posterior"):
        near = linearised(problem, state)
        normal = near.normal(posterior_weights(near.residuals))
        similarity = state.geo_from_model
        of_cameras = camera_covariances(normal, similarity.rotation, similarity.scale)
    with timed(f"covariances of {len(seen.point_in_world)} points"):
        moved = intersection_jacobian(seen, np.full(len(seen.obs_point), _MARK_PX))
        by_border = np.zeros((moved.by_poses.shape[0], len(normal.corner)))
        by_border[:, : len(problem.lens)] = moved.by_lens[:, :, problem.lens].reshape(len(by_border), -1)
        of_points = normal.covariances(moved.by_poses, by_border, 3)
    at = problem.at(state)
    centers = similarity.apply(at.center) - network.cam_center_in_world - truth[0][:, 3:]
    of_residuals = of_points + moved.cov_of_marks + _SURVEY_M**2 * np.eye(3)
    _print_errors("cameras", centers, of_cameras[:, 3:, 3:])
    _print_errors("check points", check.residuals(at), of_residuals)


def _print_errors(name: str, error: FloatArray, cov: FloatArray) -> None:
    """Print root mean squares of errors (m, 3) and of their predicted σ by axis, and of the errors over their σ."""
    squares = (error**2).mean(axis=0), np.diagonal(cov, axis1=1, axis2=2).mean(axis=0)
    found, predicted = (" ".join(f"{1000 * value:.1f}" for value in np.sqrt(square)) for square in squares)
    print(f"  {name}: RMS {found} mm, predicted {predicted} mm, {normalised(error, cov):.2f} of σ")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=1000)
    parser.add_argument("--points-per-camera", type=int, default=600, help="observations of tie points, about")
    parser.add_argument("--controls", type=int, default=40, help="control points, and as many check points")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(f"{options.cameras} cameras")
    with timed("all"):
        measure(options.cameras, options.points_per_camera, options.controls, options.seed)


if __name__ == "__main__":
    main()
