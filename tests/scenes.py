"""Synthetic surveys with known truth, as arrays, as a COLMAP model and as a `Survey` product."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.manifest import MANIFEST
from pipelines.core.products import save_json
from pipelines.core.stages import SPARSE, SURVEY, StageSpec
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import write_sparse
from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.cameras import Camera, CameraPoses, project
from pipelines.geometry.rotations import exp_so3, quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity, SimilarityRecord
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.solution import SimilarityEstimate, SolvedCamera, TrainedModel
from pipelines.survey.survey import Attitude, CameraPrior, Fix, FixSession, Mark, Survey, SurveyedPoint, SurveyImage

CAMERA = Camera("OPENCV", 1200, 900, np.array([1020.0, 1018.0, 603.0, 447.0, -0.045, 0.012, 3e-4, -2e-4]))
GEO_FROM_LOCAL = Similarity(12.5, exp_so3([0.4, -1.1, 2.0]), np.array([30.0, -45.0, 70.0]))
IDENTITY = Similarity()
Layout = Literal["orbit", "grid", "line"]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the measurements."""

    fix_m: tuple[float, float, float] = (0.02, 0.02, 0.03)
    attitude_deg: float = 0.5
    pixel_px: float = 0.5
    gcp_m: float = 0.02
    mark_px: float = 0.3
    outliers: tuple[int, ...] = ()
    outlier_m: float = 15.0
    bias_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


STATED = Noise()
# Positions and marks as good as exact, with σ that can still be divided by.
NOISELESS = Noise(pixel_px=0.2, mark_px=1e-9, gcp_m=1e-9, fix_m=(1e-9, 1e-9, 1e-9), attitude_deg=0.5)


@dataclass(frozen=True)
class TrueScene:
    """True cameras and points in geo, with their observations."""

    center_in_geo: np.ndarray  # (n, 3)
    geo_from_cam: np.ndarray  # (n, 3, 3)
    point_in_geo: np.ndarray  # (N, 3)
    gcp_in_geo: np.ndarray  # (g, 3)
    camera: Camera = CAMERA
    geo_from_local: Similarity = field(default_factory=lambda: GEO_FROM_LOCAL)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the images."""
        return tuple(f"image_{index:03d}.jpg" for index in range(len(self.center_in_geo)))

    def pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the observations of points (N, 3) in geo, by point: indices of point and image, exact pixels."""
        observations = []
        for image, (center, rotation) in enumerate(zip(self.center_in_geo, self.geo_from_cam, strict=True)):
            in_cam = (points - center) @ rotation
            ahead = np.flatnonzero(in_cam[:, 2] > 0.5)
            # The lens polynomial holds in the picture only; far outside it folds back in.
            ahead = ahead[(np.abs(in_cam[ahead, :2]) < 0.8 * in_cam[ahead, 2:]).all(axis=1)]
            xy = project(self.camera, in_cam[ahead])
            inside = ((xy > 0) & (xy < [self.camera.width, self.camera.height])).all(axis=1)
            observations.append(np.column_stack([ahead[inside], np.full(inside.sum(), image), xy[inside]]))
        rows = np.concatenate(observations)
        rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
        return rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2:]


def looking_at(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return rotations geo ← camera (n, 3, 3) of level cameras at centres (n, 3) that look at targets (n, 3)."""
    forward = target - center
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [1e-9, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=-1)


def make_scene(
    layout: Layout = "orbit", images: int = 24, points: int = 300, gcps: int = 6, seed: int = 0
) -> TrueScene:
    """Return a built-up area 100 m wide, seen from an orbit at two heights, a nadir grid, or one straight line."""
    rng = np.random.default_rng(seed)
    cloud = np.column_stack([rng.uniform(-50, 50, (points, 2)), rng.uniform(0, 20, points)])
    control = np.column_stack([rng.uniform(-45, 45, (gcps, 2)), rng.uniform(0, 5, gcps)])
    if layout == "orbit":
        angle = np.linspace(0, 4 * np.pi, images, endpoint=False)
        height = np.where(angle < 2 * np.pi, 60.0, 80.0) + rng.normal(0, 0.5, images)
        center = np.column_stack([88 * np.cos(angle), 88 * np.sin(angle), height])
        target = np.zeros_like(center) + rng.normal(0, 3, center.shape)
    else:
        side = int(np.ceil(np.sqrt(images))) if layout == "grid" else images
        rows = 1 if layout == "line" else side
        east, north = np.meshgrid(np.linspace(-60, 60, side), np.linspace(-60, 60, rows) if rows > 1 else [0.0])
        center = np.column_stack([east.ravel(), north.ravel(), np.full(east.size, 80.0)])[:images]
        target = center - np.array([0.0, 1e-3, 80.0])
    return TrueScene(center, looking_at(center, target), cloud, control)


def sparse_model(scene: TrueScene, noise: Noise, rng: np.random.Generator) -> SparseModel:
    """Return the model of an SfM with perfect cameras: the scene in `local`, with noisy pixels."""
    local_from_geo = scene.geo_from_local.inverse()
    owner, image, xy = scene.pixels(scene.point_in_geo)
    rotation = np.swapaxes(scene.geo_from_cam, 1, 2) @ scene.geo_from_local.rotation
    center = local_from_geo.apply(scene.center_in_geo)
    count = len(scene.point_in_geo)
    return SparseModel(
        cameras={1: scene.camera},
        image_id=np.arange(1, len(center) + 1),
        image_name=scene.names,
        image_camera_id=np.ones(len(center), dtype=np.int64),
        rotation_cam_from_local=rotation,
        translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
        point_id=np.arange(1, count + 1),
        point_in_local=local_from_geo.apply(scene.point_in_geo),
        point_rgb=np.full((count, 3), 128, dtype=np.uint8),
        point_error_px=np.full(count, noise.pixel_px),
        obs_point=owner,
        obs_image=image,
        obs_xy_px=xy + rng.normal(0, noise.pixel_px, xy.shape),
    )


@dataclass(frozen=True)
class Measured:
    """Choice of the measurements that a survey carries."""

    fixes: bool = True
    attitudes: bool = True
    gcps: bool = False


WITH_GCPS = Measured(gcps=True)


def survey_of(scene: TrueScene, noise: Noise, measured: Measured, rng: np.random.Generator) -> Survey:
    """Return the measurements, with noise of exactly the σ that they state (but for outliers and bias)."""
    fixes = scene.center_in_geo + rng.normal(size=scene.center_in_geo.shape) * noise.fix_m + noise.bias_m
    for index in noise.outliers:
        direction = rng.normal(size=3)
        fixes[index] += noise.outlier_m * direction / np.linalg.norm(direction)
    turned = exp_so3(np.radians(noise.attitude_deg) * rng.normal(size=fixes.shape)) @ scene.geo_from_cam
    cov = _matrix(np.diag(np.square(noise.fix_m)))
    images = []
    for index, name in enumerate(scene.names):
        fix = Fix(position_in_geo=_vector(fixes[index]), cov_in_geo=cov, source="csv", sigma_source="file")
        quat = tuple(quat_xyzw_from_matrix(turned[index]).tolist())
        attitude = Attitude(quat_xyzw=quat, sigma_deg=noise.attitude_deg, source="csv")
        image = SurveyImage(name=name, camera_id=1, sha256="")
        if measured.fixes:
            image = image.model_copy(update={"fix": fix})
        if measured.attitudes:
            image = image.model_copy(update={"attitude": attitude})
        images.append(image)
    prior = CameraPrior(
        camera_id=1,
        model=scene.camera.model,
        width=scene.camera.width,
        height=scene.camera.height,
        params=tuple(scene.camera.params.tolist()),
        focal_source="calibrated",
    )
    return Survey(
        origin=Origin(lat_deg=46.0, lon_deg=7.75, alt_m=1600.0),
        source_crs="EPSG:4979",
        vertical=VerticalDatum(name="ellipsoidal", stated=True),
        image_dir=".",
        cameras=(prior,),
        images=tuple(images),
        control_points=_control(scene, noise, rng) if measured.gcps else (),
        # Without control points nothing is drawn of the common error, and nothing stated.
        sessions=(session_of(noise.fix_m[0]),) if measured.gcps and measured.fixes else (),
    )


def session_of(sigma_m: float) -> FixSession:
    """Return the session of fixes with such a σ, and the default σ of their common error."""
    if sigma_m <= 0.1:
        return FixSession(receiver="RTK fixed", sigma_common_m=(0.03, 0.03, 0.05), sigma_source="default")
    return FixSession(receiver="unknown receiver", sigma_common_m=(2.0, 2.0, 4.0), sigma_source="default")


def _control(scene: TrueScene, noise: Noise, rng: np.random.Generator) -> tuple[SurveyedPoint, ...]:
    owner, image, xy = scene.pixels(scene.gcp_in_geo)
    xy = xy + rng.normal(0, noise.mark_px, xy.shape)
    surveyed = scene.gcp_in_geo + rng.normal(0, noise.gcp_m, scene.gcp_in_geo.shape)
    return tuple(
        SurveyedPoint(
            name=f"gcp{index}",
            position_in_geo=_vector(position),
            cov_in_geo=_matrix(np.eye(3) * noise.gcp_m**2),
            marks=tuple(
                Mark(image=scene.names[image[row]], x_px=xy[row, 0], y_px=xy[row, 1], sigma_px=noise.mark_px)
                for row in np.flatnonzero(owner == index)
            ),
        )
        for index, position in enumerate(surveyed)
    )


def material(
    noise: Noise = STATED, measured: Measured = WITH_GCPS, images: int = 8, points: int = 60
) -> tuple[TrueScene, SparseModel, Survey]:
    """Return an orbit, its SfM model and its survey."""
    scene, rng = make_scene(images=images, points=points), np.random.default_rng(0)
    survey = survey_of(scene, noise, measured, rng)
    return scene, sparse_model(scene, noise, rng), survey


def initial(layout: str = "volume") -> SimilarityEstimate:
    """Return the true similarity, with σ of 1 % of scale, 0.01 rad and 1 cm about a place in the scene."""
    covariance, pivot = np.eye(7) * 1e-4, (5.0, -3.0, 60.0)
    return initial_product(GEO_FROM_LOCAL.to_record("local", "geo", covariance=covariance, pivot=pivot), layout)


def initial_product(geo_from_local: SimilarityRecord, layout: str = "volume") -> SimilarityEstimate:
    """Return a similarity as `init-sim3` states it, without counts of correspondences and residuals."""
    return SimilarityEstimate(
        geo_from_local=geo_from_local,
        method="robust",
        correspondences={},
        inliers={},
        residuals={},
        condition_number=1.0,
        layout=layout,  # type: ignore[arg-type]
        attitude_used=False,
    )


def trained_cameras(
    names: Sequence[str], poses: CameraPoses, test: Collection[int] = ()
) -> tuple[SolvedCamera, ...]:
    """Return cameras as a product, of poses in `model`."""
    quats = quat_xyzw_from_matrix(poses.cam_from_model)
    shift = -np.einsum("nij,nj->ni", poses.cam_from_model, poses.cam_center_in_model)
    return tuple(
        SolvedCamera(
            name=name,
            split="test" if index in test else "train",
            quat_xyzw=tuple(quats[index].tolist()),
            translation=tuple(shift[index].tolist()),
        )
        for index, name in enumerate(names)
    )


def trained_model(
    geo_from_model: Similarity,
    model_from_local: Similarity = IDENTITY,
    *,
    max_image_size: int = 320,
    cameras: tuple[SolvedCamera, ...] = (),
) -> TrainedModel:
    """Return the product that `train` writes beside a single Gaussian without bands."""
    return TrainedModel(
        geo_from_model=geo_from_model.to_record("model", "geo"),
        model_from_local=model_from_local.to_record("local", "model"),
        max_image_size=max_image_size,
        cameras=cameras,
        background=(0.0, 0.0, 0.0),
        sh_degree=0,
        iterations=1,
        gaussians=1,
        backend="cpu",
    )


def write_workspace(root: Path, survey: Survey, model: SparseModel) -> Workspace:
    """Return a workspace as `ingest` and `sfm` leave it."""
    save_json(survey, root / SURVEY)
    write_sparse(model, root / SPARSE)
    return Workspace(root)


def without_hashes(workspace: Workspace, spec: StageSpec) -> None:
    """Take the hashes of its files out of a product's manifest, so that a test may change the product."""
    manifest = workspace.manifest(spec)
    assert manifest is not None
    save_json(manifest.model_copy(update={"files": {}}), workspace.path(f"{spec.folder}/{MANIFEST}"))


def without_fixes(survey: Survey, names: tuple[str, ...]) -> Survey:
    """Return the survey without the fixes of the named images."""
    images = tuple(
        image.model_copy(update={"fix": None}) if image.name in names else image for image in survey.images
    )
    return survey.model_copy(update={"images": images})


def moved(scene: TrueScene, geo_from_local: Similarity) -> TrueScene:
    """Return the scene with another SfM frame."""
    return replace(scene, geo_from_local=geo_from_local)


def _vector(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _matrix(values: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    return tuple(_vector(row) for row in values)
