"""Solved survey, read from the workspace: cameras in `model`, the similarity, and any Gaussians.

Also its surveyed points, intersected from their marks; the differences between adjusted cameras and their fixes;
and the extent of the scene that files cover: that of the SfM points, without those at its rim.
"""

from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from pipelines.core.errors import DegenerateGeometryError, InputError, MissingProductError
from pipelines.core.products import load_json
from pipelines.core.stages import ADJUSTMENT, GAUSSIANS, MODEL, SIM3, SPARSE
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import Gaussians, read_gaussians
from pipelines.survey.adjustment import InitialSimilarity
from pipelines.survey.calibrated import load_survey
from pipelines.survey.marks import MarkRays, RayErrors, intersect_marks
from pipelines.survey.survey import Survey
from pipelines.survey.trained_model import Adjustment, TrainedModel

Solution = TypeVar("Solution", bound=Adjustment)


@dataclass(frozen=True)
class SolvedSurvey:
    """Survey with the solution of its adjustment; `sfm` has SfM's lenses, its images the order of `poses`."""

    survey: Survey
    sfm: SparseModel
    model: Adjustment

    @cached_property
    def poses(self) -> CameraPoses:
        return self.model.poses

    @cached_property
    def sparse(self) -> SparseModel:
        """SfM model with the adjusted lenses."""
        return self.model.with_lenses(self.sfm)

    @property
    def geo_from_model(self) -> Similarity:
        return self.model.similarity

    @property
    def point_in_model(self) -> FloatArray:
        """SfM points (N, 3) in `model`, in metres."""
        return Similarity.from_record(self.model.model_from_local).apply(self.sfm.point_in_local)

    def indices(self, split: str) -> list[int]:
        """Return the indices of the cameras of a split."""
        return [index for index, camera in enumerate(self.model.cameras) if camera.split == split]


@dataclass(frozen=True)
class TrainedSurvey(SolvedSurvey):
    """Survey with its trained model, and the Gaussians in `model`."""

    model: TrainedModel
    gaussians: Gaussians


def load_solved(workspace: Workspace, similarity: Literal["trained", "initial"] = "trained") -> SolvedSurvey:
    """Read the survey with its solution: with the trained model if there is one, else as init-sim3 has solved it.

    `similarity` chooses `geo_from_model`: the solution's, or the one that follows from `geo_from_local`.

    Raises:
        MissingProductError: a product does not exist.
        InputError: a product is damaged, or cameras or lenses of the solution are not those of `sfm`.
    """
    return (load_trained if workspace.has(MODEL) else load_cameras)(workspace, similarity)


def load_cameras(workspace: Workspace, similarity: Literal["trained", "initial"] = "trained") -> SolvedSurvey:
    """As `load_solved`, without any Gaussians, which may be larger than the memory."""
    if workspace.has(MODEL):
        return SolvedSurvey(*_loaded(workspace, TrainedModel, MODEL, similarity, "train again"))
    advice = "run `georef init-sim3` again"
    return SolvedSurvey(*_loaded(workspace, Adjustment, ADJUSTMENT, similarity, advice))


def load_trained(workspace: Workspace, similarity: Literal["trained", "initial"] = "trained") -> TrainedSurvey:
    """As `load_solved`, of a survey that must be trained."""
    survey, sparse, model = _loaded(workspace, TrainedModel, MODEL, similarity, "train again")
    return TrainedSurvey(survey, sparse, model, read_gaussians(workspace.path(GAUSSIANS)))


def _loaded(
    workspace: Workspace, kind: type[Solution], product: str, similarity: Literal["trained", "initial"], advice: str
) -> tuple[Survey, SparseModel, Solution]:
    """Read a solution with its SfM model, and the survey with the variance factors of `init-sim3`."""
    path = workspace.path(product)
    model, sparse = load_json(kind, path), read_sparse(workspace.path(SPARSE))
    _require_same_cameras(model, sparse, path, advice)
    if similarity == "initial":
        model = _initially_placed(model, workspace)
    survey = load_survey(workspace)
    try:
        return load_json(InitialSimilarity, workspace.path(SIM3)).weighted(survey), sparse, model
    except MissingProductError:  # a model that was put there by hand: σ are as stated
        return survey, sparse, model


def _require_same_cameras(model: Adjustment, sparse: SparseModel, path: Path, advice: str) -> None:
    """Refuse a solution of another SfM model."""
    refusal, of_another = partial(InputError, path=path), f"are not those of sfm/sparse; {advice}"
    if tuple(camera.name for camera in model.cameras) != sparse.image_name:
        raise refusal("cameras-of-another-model", f"its cameras {of_another}", field="cameras")
    for lens in model.lenses:
        camera = sparse.cameras.get(lens.camera_id)
        if camera is None or (camera.model, len(camera.params)) != (lens.model, len(lens.params)):
            raise refusal("lenses-of-another-model", f"its lenses {of_another}", field="lenses")


def _initially_placed(model: Solution, workspace: Workspace) -> Solution:
    """Return a solution with the `geo_from_model` of the initial similarity.

    The covariance carries over unchanged, because it describes a perturbation in the target frame `geo`.
    """
    record = load_json(InitialSimilarity, workspace.path(SIM3)).geo_from_local
    geo_from_model = Similarity.from_record(record) @ Similarity.from_record(model.model_from_local).inverse()
    placed = geo_from_model.to_record("model", "geo", covariance=np.array(record.covariance), pivot=record.pivot)
    return model.model_copy(update={"geo_from_model": placed})


# Errors of the trained cameras: rays agree within these errors and the σ of their marks.
_CAMERA_ERRORS = RayErrors(sigma_center=0.02, sigma_attitude_rad=2e-4)


def triangulated_points(solved: SolvedSurvey, rays: MarkRays) -> FloatArray:
    """Return the intersections (J, 3) in `geo` of the rays of each point; NaN: marks in fewer than two images."""
    poses = solved.poses
    met = intersect_marks(rays, poses.cam_from_model, poses.cam_center_in_model, _CAMERA_ERRORS)
    position = met.position_in_geo.copy()  # in the frame of the cameras, `model`
    position[rays.marks_of_point < 2] = np.nan
    return solved.geo_from_model.apply(position)


@dataclass(frozen=True)
class FixDifferences:
    """Adjusted minus measured position (F, 3) in metres of the F registered cameras that have a fix.

    `is_outlier` says whether the solution has left the fix out.
    """

    camera: IntArray
    difference_in_geo: FloatArray
    is_outlier: BoolArray


def fix_differences(solved: SolvedSurvey) -> FixDifferences:
    """Return the differences between the adjusted cameras of a survey and their fixes."""
    center_in_geo = solved.geo_from_model.apply(solved.poses.cam_center_in_model)
    fixes = {image.name: image.fix for image in solved.survey.images}
    outliers = set(solved.model.gnss_outliers)
    cameras = solved.model.cameras
    rows = [(index, fix) for index, camera in enumerate(cameras) if (fix := fixes.get(camera.name)) is not None]
    index = np.array([row for row, _ in rows], dtype=np.int64)
    measured = np.array([fix.position_in_geo for _, fix in rows]).reshape(-1, 3)
    return FixDifferences(
        camera=index,
        difference_in_geo=center_in_geo[index] - measured,
        is_outlier=np.array([cameras[row].name in outliers for row in index], dtype=bool),
    )


_RIM = 0.002  # fraction of the SfM points outside the extent on each side


def scene_points(solved: SolvedSurvey) -> FloatArray:
    """Return the SfM points (P, 3) in `geo` that lie within the scene: those at its rim are left out.

    Raises:
        DegenerateGeometryError: the SfM model has no points.
    """
    if not len(solved.sfm.point_in_local):
        raise DegenerateGeometryError("no-sfm-points", "The SfM model has no points, so the extent is unknown.")
    points = solved.geo_from_model.apply(solved.point_in_model)
    low, high = np.quantile(points[:, :2], [_RIM, 1 - _RIM], axis=0)
    return np.asarray(points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)])


def corners(points: FloatArray) -> FloatArray:
    """Return the corners (8, 3) of the box around points."""
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    return np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
