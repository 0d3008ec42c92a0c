"""Surveys of a flight, whose true cameras are drawn from what the image observations leave open.

The SfM model stays, and the truth moves about it: an adjustment of a few thousand points for each draw would take
minutes, and a draw from the bundle's own information takes none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.sparse import diags

from pipelines.adjust.posterior import Posterior
from pipelines.geometry.bundle import BundleInformation, bundle_information
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.network import Network
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.sparse_cholesky import SparseCholesky
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.marks import RayErrors, intersect_marks, mark_rays
from pipelines.survey.survey import Fix, FixSession, Mark, Survey, SurveyedPoint
from tests.scenes import GEO_FROM_LOCAL, Measured, Noise, TrueScene, looking_at, sparse_model, survey_of

MARK_PX = 0.3


@dataclass(frozen=True)
class Flight:
    """Cameras over hilly ground in geo, their SfM model (frame `local`), its bundle in geo, and surveyed places."""

    scene: TrueScene
    model: SparseModel
    bundle: BundleInformation
    control: np.ndarray
    check: np.ndarray

    @property
    def poses(self) -> CameraPoses:
        return CameraPoses(np.swapaxes(self.scene.geo_from_cam, 1, 2), self.scene.center_in_geo)


@cache
def flight(cameras: int, points: int, control: int = 6, check: int = 12) -> Flight:
    """Return a flight of lines, to and fro at two heights, a little oblique, with noisy pixels."""
    rng, columns = np.random.default_rng(cameras), int(np.sqrt(cameras))
    row, column = np.divmod(np.arange(cameras), columns)
    center = np.column_stack([12.0 * column, 18.0 * row, np.where(row % 2, 55.0, 70.0)])
    center += rng.normal(0, 0.5, center.shape)
    target = center * [1, 1, 0] + rng.normal(0, 8, center.shape) * [1, 1, 0]
    turned = looking_at(center, target) @ exp_so3(np.where(row % 2, np.pi / 2, 0.0)[:, None] * [0.0, 0.0, 1.0])
    low, high = center[:, :2].min(axis=0), center[:, :2].max(axis=0)

    def ground(count: int) -> np.ndarray:
        xy = rng.uniform(low, high, (count, 2))
        return np.column_stack([xy, 5 * np.sin(xy[:, 0] / 30) + rng.uniform(0, 3, count)])

    scene = TrueScene(center, turned, ground(points), np.zeros((0, 3)))
    model = with_long_tracks(sparse_model(scene, Noise(), rng))
    network = Network(
        model.cameras,
        model.image_camera_id,
        np.swapaxes(turned, 1, 2),
        center,
        GEO_FROM_LOCAL.apply(model.point_in_local),
        model.obs_point,
        model.obs_image,
        model.obs_xy_px,
    )
    places = np.concatenate([corners(low, high, control), ground(check)])
    return Flight(scene, model, bundle_information(network), places[:control], places[control:])


def corners(low: np.ndarray, high: np.ndarray, count: int) -> np.ndarray:
    """Places in the corners of the block, then between them."""
    share = np.array([[0.1, 0.1], [0.9, 0.9], [0.1, 0.9], [0.9, 0.1], [0.5, 0.4], [0.5, 0.6]])[:count]
    xy = low + share * (high - low)
    return np.column_stack([xy, np.linspace(0, 4, len(xy))])


def with_long_tracks(model: SparseModel) -> SparseModel:
    """Return the model with the points that three or more photographs see."""
    rays = np.bincount(model.obs_point, minlength=len(model.point_id))
    kept, rows = rays >= 3, rays[model.obs_point] >= 3
    return replace(
        model,
        point_id=model.point_id[kept],
        point_in_local=model.point_in_local[kept],
        point_rgb=model.point_rgb[kept],
        point_error_px=model.point_error_px[kept],
        obs_point=(np.cumsum(kept) - 1)[model.obs_point[rows]],
        obs_image=model.obs_image[rows],
        obs_xy_px=model.obs_xy_px[rows],
    )


def drawn(of: Flight, rng: np.random.Generator) -> TrueScene:
    """Return true cameras and lens, drawn from the covariance that the image observations leave."""
    bundle, sums = of.bundle, of.bundle.sums
    hold = diags((bundle.unit * bundle.loosest_sigma_m) ** -2.0).tobsr((6, 6))  # of the similarity, removed below
    factor = SparseCholesky((sums.poses + hold).tobsr((6, 6)), of.scene.center_in_geo)
    response = factor.solve(sums.cross)
    lens = rng.multivariate_normal(np.zeros(len(sums.lens)), np.linalg.inv(sums.lens - sums.cross.T @ response))
    poses = factor.coloured(rng.normal(size=(len(bundle.unit), 1)))[:, 0] - response @ lens
    poses -= bundle.similarity_modes @ (bundle.followed @ np.concatenate([poses, lens]))
    turn, shift = np.split(poses.reshape(-1, 6), 2, axis=1)
    return replace(
        of.scene,
        center_in_geo=of.scene.center_in_geo + shift,
        geo_from_cam=exp_so3(turn) @ of.scene.geo_from_cam,
        camera=replace(of.scene.camera, params=of.scene.camera.params + lens),
    )


@dataclass(frozen=True)
class Receiver:
    """σ of the fixes' own and of their common errors, metres."""

    white_m: tuple[float, float, float]
    common_m: tuple[float, float, float]


def surveyed(
    of: Flight, truth: TrueScene, receiver: Receiver, control_m: float | None, rng: np.random.Generator
) -> Survey:
    """Return the survey of true cameras: a session of fixes, check points, and control points if they have a σ."""
    survey = survey_of(truth, Noise(), Measured(fixes=False, attitudes=False), rng)
    common, cov = rng.normal(0, receiver.common_m), np.diag(np.square(receiver.white_m))
    fixes = truth.center_in_geo + common + rng.normal(size=truth.center_in_geo.shape) * receiver.white_m
    images = tuple(
        image.model_copy(
            update={
                "fix": Fix(
                    position_in_geo=tuple(position), cov_in_geo=rows_of(cov), source="csv", sigma_source="file"
                )
            }
        )
        for image, position in zip(survey.images, fixes, strict=True)
    )
    session = FixSession(receiver="rtk", sigma_common_m=receiver.common_m, sigma_source="default")
    control = () if control_m is None else marked(truth, of.control, control_m, "control", rng)
    return survey.model_copy(
        update={
            "images": images,
            "sessions": (session,),
            "control_points": control,
            "check_points": marked(truth, of.check, None, "check", rng),
        }
    )


def marked(
    truth: TrueScene, place: np.ndarray, sigma_m: float | None, name: str, rng: np.random.Generator
) -> tuple[SurveyedPoint, ...]:
    """Return points with marks in all photographs that show them; without a σ, their survey is exact."""
    owner, image, xy = truth.pixels(place)
    xy = xy + rng.normal(0, MARK_PX, xy.shape)
    said = place if sigma_m is None else place + rng.normal(0, sigma_m, place.shape)
    return tuple(
        SurveyedPoint(
            name=f"{name}{index}",
            position_in_geo=tuple(position),
            cov_in_geo=rows_of(np.eye(3) * (1e-4 if sigma_m is None else sigma_m) ** 2),
            marks=tuple(
                Mark(image=truth.names[image[row]], x_px=xy[row, 0], y_px=xy[row, 1], sigma_px=MARK_PX)
                for row in np.flatnonzero(owner == index)
            ),
        )
        for index, position in enumerate(said)
    )


def rows_of(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


def missed(posterior: Posterior, survey: Survey) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (J, 3) of the check points in the solution, and their joint covariance (3 J, 3 J)."""
    rays, poses = mark_rays(survey.check_points, posterior.sparse), posterior.solution.poses
    found = intersect_marks(rays, poses.cam_from_model, poses.cam_center_in_model, RayErrors(1e-9, 1e-9))
    place = posterior.solution.similarity.apply(found.position_in_geo)
    true = np.array([point.position_in_geo for point in survey.check_points])
    return place - true, posterior.jointly_of_marked_points(place, rays)
