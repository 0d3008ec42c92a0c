"""Two dates of one ground with all drawn: photographs, positions with an error of each date, and solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.relative import Solved
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_enu_rotation, enu_from_ecef, lla_of
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.network import Network
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.common_points import CommonPoints
from pipelines.survey.survey import Fix, FixSession, Survey
from tests.bundle_scenes import SIGMA_PX, adjuster, exact_network, jacobian, noisy, pixels, readjusted, size
from tests.drawn_surveys import rows_of
from tests.scenes import Measured, Noise, material

IMAGES, POINTS, COMMON = 8, 80, 60
HERE = Origin(lat_deg=46.0, lon_deg=7.75, alt_m=1600.0)
ASIDE = Origin(lat_deg=46.002, lon_deg=7.753, alt_m=1580.0)  # 320 m from there
CHECK = np.random.default_rng(5).uniform([-8, -8, -1], [8, 8, 1], (12, 3))


@dataclass(frozen=True)
class Receiver:
    """σ east, north, up of the positions' own errors, and of the error that those of a date share."""

    own_m: tuple[float, float, float]
    common_m: tuple[float, float, float]


CONSUMER = Receiver((0.5, 0.5, 1.0), (1.5, 1.5, 3.0))
RTK = Receiver((0.015, 0.015, 0.03), (0.03, 0.03, 0.05))


@dataclass(frozen=True)
class Date:
    """A date as it was drawn and solved; `solved` is in the `geo` of its survey."""

    truth: Network
    survey: Survey
    model: SparseModel
    posterior: Posterior

    @property
    def solved(self) -> Solved:
        return Solved(self.posterior, self.survey.origin_on_earth)

    def seen(self, place: np.ndarray) -> np.ndarray:
        """Return Earth-centred places (J, 3) that the solution gives points of HERE which all photographs see."""
        posterior, origin = self.posterior, self.survey.origin_on_earth
        true = marked(enu_from_ecef(ecef_from_enu(place, HERE), origin), self.truth)
        poses = posterior.solution.poses
        rays = replace(
            true,
            cameras=posterior.sparse.cameras,
            cam_from_world=poses.cam_from_model,
            cam_center_in_world=poses.cam_center_in_model,
            point_in_world=posterior.solution.similarity.inverse().apply(true.point_in_world),
        )
        return ecef_from_enu(posterior.solution.similarity.apply(refined_points(rays).point_in_world), origin)


def marked(points: np.ndarray, truth: Network) -> Network:
    """Return points that all cameras see, at their exact pixels."""
    count = len(points)
    seen = replace(
        truth,
        point_in_world=points,
        obs_point=np.repeat(np.arange(count), IMAGES),
        obs_image=np.tile(np.arange(IMAGES), count),
        obs_xy_px=np.zeros((count * IMAGES, 2)),
    )
    return replace(seen, obs_xy_px=pixels(seen, np.zeros(size(seen))))


@cache
def ground() -> np.ndarray:
    """Return the points (POINTS, 3) of the ground at both dates, in the `geo` of HERE."""
    return np.random.default_rng(7).uniform([-9, -9, -1], [9, 9, 1], (POINTS, 3))


@cache
def true_date(seed: int, origin: Origin, moved: tuple[int, ...] = (), by_m: float = 0.0) -> Network:
    """Return the photographs of a date over the ground, some of whose points have moved up since, in its `geo`."""
    network, points = exact_network(images=IMAGES, points=POINTS, seed=seed), ground().copy()
    points[list(moved), 2] += by_m
    turn = ecef_from_enu_rotation(lla_of(HERE)).T @ ecef_from_enu_rotation(lla_of(origin))
    there = replace(
        network,
        cam_from_world=network.cam_from_world @ turn,
        cam_center_in_world=enu_from_ecef(ecef_from_enu(network.cam_center_in_world, HERE), origin),
    )
    return marked(enu_from_ecef(ecef_from_enu(points, HERE), origin), there)


@cache
def _adjuster(seed: int, origin: Origin, moved: tuple[int, ...], by_m: float) -> np.ndarray:
    return adjuster(true_date(seed, origin, moved, by_m))


def draw_date(
    seed: int,
    rng: np.random.Generator,
    *,
    receiver: Receiver = CONSUMER,
    origin: Origin = HERE,
    common: CommonPoints | None = None,
    moved: tuple[int, ...] = (),
    by_m: float = 0.0,
    k1_wrong: float = 0.0,
    changed: Callable[[Survey], Survey] = lambda survey: survey,
) -> Date:
    """Return a date with noise of pixels and positions, solved by `init-sim3`; `seed` places its cameras.

    SfM has held the lens, with a radial distortion that is wrong by a share `k1_wrong`, if that is not 0.
    """
    truth = true_date(seed, origin, moved, by_m)
    drawn, network = noisy(truth, rng), truth
    for _ in range(3):  # a weak lens moves far enough for second-order terms to count
        left = drawn.obs_xy_px - pixels(network, np.zeros(size(network)))
        step = _adjuster(seed, origin, moved, by_m) @ left.ravel()
        network = replace(readjusted(network, step), obs_xy_px=drawn.obs_xy_px)
    if k1_wrong:
        network = _of_wrong_lens(replace(drawn, cameras=truth.cameras), k1_wrong)
    survey = changed(_survey(truth, receiver, origin, rng)).model_copy(update={"common": common})
    model = _sparse(network, survey)
    points = geolocate(survey, model, GeolocateOptions()).points
    posterior, _ = estimate_similarity(survey, model, points, InitSim3Options())
    return Date(truth, survey, model, posterior)


def _of_wrong_lens(network: Network, share: float) -> Network:
    """Return a network whose poses and points fit its pixels with a wrong lens: its ground is domed."""
    lens = network.cameras[1]
    params = lens.params * np.array([1.0, 1.0, 1.0, 1.0 + share])
    network, observed = replace(network, cameras={1: replace(lens, params=params)}), network.obs_xy_px
    for _ in range(2):
        design = jacobian(network)[:, : -len(params)]
        left = observed - pixels(network, np.zeros(size(network)))
        step = np.linalg.lstsq(design, left.ravel(), rcond=1e-9)[0]  # of least norm: the gauge is free
        network = readjusted(network, np.concatenate([step, np.zeros(len(params))]))
    return network


def _survey(truth: Network, receiver: Receiver, origin: Origin, rng: np.random.Generator) -> Survey:
    blank = material(Noise(), Measured(fixes=False, attitudes=False), images=IMAGES)[2]
    position = truth.cam_center_in_world + np.array(receiver.common_m) * rng.normal(size=3)
    position = position + np.array(receiver.own_m) * rng.normal(size=position.shape)
    cov = rows_of(np.diag(np.square(receiver.own_m)))
    fixes = [
        Fix(position_in_geo=tuple(at.tolist()), cov_in_geo=cov, source="csv", sigma_source="file")
        for at in position
    ]
    images = [image.model_copy(update={"fix": fix}) for image, fix in zip(blank.images, fixes, strict=True)]
    session = FixSession(
        receiver="RTK fixed", sigma_common_m=receiver.common_m, sigma_source="file", sigma_drift_m=(0.0, 0.0, 0.0)
    )
    return blank.model_copy(update={"origin": origin, "images": tuple(images), "sessions": (session,)})


def _sparse(network: Network, survey: Survey) -> SparseModel:
    count = len(network.point_in_world)
    return SparseModel(
        cameras=network.cameras,
        image_id=np.arange(1, IMAGES + 1),
        image_name=tuple(image.name for image in survey.images),
        image_camera_id=network.camera_id,
        rotation_cam_from_local=network.cam_from_world,
        translation_cam_from_local=-np.einsum("nij,nj->ni", network.cam_from_world, network.cam_center_in_world),
        point_id=np.arange(1, count + 1),
        point_in_local=network.point_in_world,
        point_rgb=np.zeros((count, 3), dtype=np.uint8),
        point_error_px=np.full(count, SIGMA_PX),
        obs_point=network.obs_point,
        obs_image=network.obs_image,
        obs_xy_px=network.obs_xy_px,
    )


def common_of(earlier: Date, ids: np.ndarray, *, spread: float = 1.0) -> CommonPoints:
    """Return points of an earlier date, by COLMAP's ids, that have the same ids at a later one."""
    position, cov = earlier.solved.placed(ids)
    similarity, pivot = earlier.solved.similarity_in_ecef
    return CommonPoints(
        point_id=ids,
        earlier_point_id=ids,
        matches=np.full(len(ids), 3),
        position_in_ecef=position,
        cov_in_ecef=cov,
        sigma_m=earlier.solved.sigma_m,
        cov_similarity=similarity,
        pivot_in_ecef=pivot,
        spread=np.asarray(spread),
        found=np.asarray(len(ids)),
        factor=np.asarray(1.0),
        checked=np.asarray(True),
        earlier="/surveys/spring",
        solution="none",
    )
