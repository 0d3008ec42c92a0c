"""Solution of a survey, and its parts: the verdict on measurements, the similarity before it, SfM points on Earth.

It has frames, cameras, lenses and systematic errors; with the settings of `train`, it is the product of that stage.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pipelines.core.errors import InputError
from pipelines.core.products import ArrayProduct, Covariance3, ImageName, Product, Remark, Rotation, load_json
from pipelines.core.stages import ADJUSTMENT, MODEL, SIM3, SPARSE
from pipelines.core.types import BoolArray, FloatArray, IntArray, Matrix34, Row7, Vector3
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity, SimilarityRecord
from pipelines.geometry.sparse_model import SparseModel
from pipelines.geometry.statistics import ResidualStats
from pipelines.survey.measurement_errors import (
    EstimatedError,
    VarianceFactor,
    applied_factors,
    factor_of_check_points,
    with_variance_factors,
)
from pipelines.survey.report import AccuracySummary
from pipelines.survey.survey import Survey


class MeasurementVerdict(Product):
    """Decisions of `init-sim3` on the measurements, which every later stage keeps.

    Attributes:
        gnss_outliers, control_outliers, distance_outliers: names of the images whose fixes, of the control points
            and of the distances that were rejected, or that their marks do not determine: they enter no solution.
        variance_factors: tests of the stated σ, with the factors that apply to all later stages.
        tied: whether points in common with an earlier date take part.
        common_outliers: COLMAP's ids of those that were rejected.
        cautions: limits of the solution.
    """

    gnss_outliers: tuple[str, ...] = ()
    control_outliers: tuple[str, ...] = ()
    distance_outliers: tuple[str, ...] = ()
    variance_factors: tuple[VarianceFactor, ...] = ()
    tied: bool = False
    common_outliers: tuple[int, ...] = ()
    cautions: tuple[Remark, ...] = ()

    @property
    def verdict(self) -> dict[str, Any]:
        """Values of these fields, for another product that keeps them."""
        return {name: getattr(self, name) for name in MeasurementVerdict.model_fields}

    def weighted(self, survey: Survey) -> Survey:
        """Return a survey with the applied variance factors in its covariances."""
        factors = self.variance_factors
        of_checks = factor_of_check_points(factors)
        return with_variance_factors(survey, applied_factors(factors), of_assumed_checks=of_checks)

    def rejected(self, survey: Survey) -> Survey | None:
        """Return a survey with the rejected measurements alone; None: there are none."""
        outliers = self.gnss_outliers or self.control_outliers or self.distance_outliers
        return self.in_use(survey, used=False) if outliers else None

    def in_use(self, survey: Survey, *, used: bool = True) -> Survey:
        """Return a survey without the measurements that were rejected, or else with these alone."""
        bad_fixes, bad_points = set(self.gnss_outliers), set(self.control_outliers)
        images = tuple(
            image if (image.name not in bad_fixes) == used else image.model_copy(update={"fix": None})
            for image in survey.images
        )
        control = tuple(point for point in survey.control_points if (point.name not in bad_points) == used)
        bad_distances = set(self.distance_outliers)
        distances = tuple(
            distance
            for distance in survey.distances
            if distance.use == "check" or (distance.name not in bad_distances) == used
        )
        common = None
        if used and self.tied and survey.common is not None:
            common = survey.common.without(self.common_outliers)
        return survey.model_copy(
            update={"images": images, "control_points": control, "distances": distances, "common": common}
        )


class SimilarityEstimate(Product):
    """How `init-sim3` has found the similarity of the SfM model, and how well its correspondences agree with it.

    Attributes:
        geo_from_local: of a joint adjustment, that of its solution.
        method: `robust` or `paper`, the option of `init-sim3`; `adjusted` by the bundle adjustment of the baseline.
        correspondences, inliers: numbers by kind, of all and of those that agree with the similarity: `gnss`
            (camera centres with fixes), `gcp` (control points), `points` (intersected points).
        condition_number: of the normal matrix, with angles and ln s scaled by the size of the layout.
        layout: extent of the correspondences: they fill a volume, lie in a plane, or on a line.
    """

    geo_from_local: SimilarityRecord
    method: Literal["robust", "paper", "adjusted"]
    correspondences: dict[str, int]
    inliers: dict[str, int]
    residuals: dict[str, ResidualStats]
    condition_number: float
    layout: Literal["volume", "plane", "line"]
    attitude_used: bool


@dataclass(frozen=True)
class GeolocatedPoints(ArrayProduct):
    """Product of `geolocate`: N SfM points intersected in the geo frame.

    Attributes:
        point_id: of the COLMAP model.
        position_in_geo, cov_in_geo: metres, m²; NaN where rays did not intersect.
        ray_count: int32, rays in use.
        max_angle_deg: largest angle between two of its rays.
        condition: condition number of the normal matrix.
        rotation_source: source of the rays' rotations: "recorded" attitudes or "sfm".
    """

    FORMS: ClassVar = {
        "point_id": ("i", "N"),
        "position_in_geo": ("f", "N", 3),
        "cov_in_geo": ("f", "N", 3, 3),
        "ray_count": ("i", "N"),
        "max_angle_deg": ("f", "N"),
        "condition": ("f", "N"),
        "inlier": ("b", "N"),
        "rotation_source": None,
    }

    point_id: IntArray
    position_in_geo: FloatArray
    cov_in_geo: FloatArray
    ray_count: NDArray[np.int32]
    max_angle_deg: FloatArray
    condition: FloatArray
    inlier: BoolArray
    rotation_source: str


WhichSimilarity = Literal["trained", "initial"]


class SolvedCamera(Product):
    """Pose `cam_from_model` of a camera. In training, a test camera moves only with its neighbours.

    Attributes:
        quat_xyzw, translation: p_cam = R p_model + translation, metres.
        exposure: gain matrix and offset (A | b): the photograph shows a colour c as A c + b. None: not estimated.
    """

    name: ImageName
    split: Literal["train", "test"]
    quat_xyzw: Rotation
    translation: Vector3
    exposure: Matrix34 | None = None


class SolvedLens(Product):
    """Lens of a camera of the SfM model, as it was solved: COLMAP's parameters of COLMAP's camera model."""

    camera_id: int
    model: str
    params: tuple[float, ...]


class Measurement(Product):
    """State of one measurement in the adjustment.

    Attributes:
        used: whether it takes part; what was rejected stays rejected in every later stage.
        reason: why it was rejected; empty: it is used.
        residual: predicted minus measured, metres or radians; of a distance one number, else three.
        normalised: length of the residual in units of its σ.
        left_out_error_m: of a control point: error of the solution of all other measurements, east, north, up;
            None: they leave the point open.
        left_out_cov_m2: covariance of that error, of solution, marks and survey.
    """

    kind: Literal["fix", "control point", "distance", "attitude", "systematic error"]
    name: str
    used: bool
    reason: str = ""
    residual: tuple[float] | Vector3
    normalised: float
    left_out_error_m: Vector3 | None = None
    left_out_cov_m2: Covariance3 | None = None


class EarlierDate(Product):
    """Earlier date that a solution is tied to, whose places it has taken over.

    Attributes:
        workspace: its folder.
        points, used: points in common with it, and those that take part, as they agree with the others.
        covariance, pivot: of its similarity, as in `SimilarityRecord`, in this `geo`: the error of place, rotation
            and scale that both dates share. All absolute covariances include it.
    """

    workspace: str
    points: int
    used: int
    covariance: Annotated[tuple[Row7, ...], Field(min_length=7, max_length=7)]
    pivot: Vector3


class Solution(MeasurementVerdict):
    """Solution of all that does not depend on Gaussians: similarity, cameras, lenses, systematic errors.

    Attributes:
        model_from_local: fixed similarity from the SfM frame.
        cameras: in the order of the SfM model's images.
        lenses: a camera of the SfM model without one keeps SfM's lens.
        sigma_px: σ of an image coordinate of a tie point.
        sigma_datum_m: σ east, north, up that all positions share beyond the matrix of the adjustment: that of the
            transformation of the control points' CRS. All absolute covariances include it.
        earlier: the earlier date that the places are tied to; None: there is none.
        accuracy: predicted σ over the scene; None: a solution that states none.
        initial: the similarity that it begins with, of `init-sim3`; None: of a training.
    """

    format_version: Literal[1] = 1
    geo_from_model: SimilarityRecord
    model_from_local: SimilarityRecord
    cameras: tuple[SolvedCamera, ...]
    lenses: tuple[SolvedLens, ...] = ()
    estimated_errors: tuple[EstimatedError, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    sigma_px: float | None = None
    sigma_datum_m: Vector3 = (0.0, 0.0, 0.0)
    earlier: EarlierDate | None = None
    accuracy: AccuracySummary | None = None
    initial: SimilarityEstimate | None = None

    @property
    def similarity(self) -> Similarity:
        return Similarity.from_record(self.geo_from_model)

    def similarity_from_local(self) -> SimilarityRecord:
        """Return the similarity geo ← local, with the covariance of geo ← model, which is of the target frame."""
        geo_from_local = self.similarity @ Similarity.from_record(self.model_from_local)
        record = self.geo_from_model
        return geo_from_local.to_record("local", "geo", covariance=np.array(record.covariance), pivot=record.pivot)

    @property
    def poses(self) -> CameraPoses:
        rotation = matrix_from_quat_xyzw([camera.quat_xyzw for camera in self.cameras])
        translation = np.array([camera.translation for camera in self.cameras])
        return CameraPoses(rotation, -np.einsum("nji,nj->ni", rotation, translation))

    @property
    def center_in_geo(self) -> FloatArray:
        """Projection centres (n, 3), metres."""
        return self.similarity.apply(self.poses.cam_center_in_model)

    def of_images(self, images: IntArray) -> Self:
        """Return the solution of some cameras (K,), in ascending order."""
        return self.model_copy(update={"cameras": tuple(self.cameras[index] for index in np.unique(images))})

    def with_lenses(self, sfm: SparseModel) -> SparseModel:
        """Return the SfM model with the lenses of this solution."""
        solved = {
            lens.camera_id: replace(sfm.cameras[lens.camera_id], params=np.array(lens.params))
            for lens in self.lenses
        }
        return replace(sfm, cameras=sfm.cameras | solved)

    def point_in_model(self, sfm: SparseModel) -> FloatArray:
        """Return the SfM points (N, 3) in `model`, metres."""
        return Similarity.from_record(self.model_from_local).apply(sfm.point_in_local)

    def indices(self, split: Literal["train", "test"]) -> list[int]:
        """Return the indices of the cameras of a split."""
        return [index for index, camera in enumerate(self.cameras) if camera.split == split]


class LensVignetting(Product):
    """Fall-off of a lens: its photographs show a colour c as c · (1 + r²(v₀ + r²(v₁ + r² v₂))).

    r is the distance from the optical axis, 1 in the furthest corner of the undistorted photograph.
    """

    camera_id: int
    coefficients: Vector3


class TrainedModel(Solution):
    """Product of `train` beside the Gaussians: the solution of the training, and its settings."""

    vignetting: tuple[LensVignetting, ...] = ()  # of the lenses for which it was estimated
    max_image_size: int = Field(gt=0)
    background: Vector3
    sh_degree: int
    iterations: int
    gaussians: int
    backend: Literal["cpu", "cuda"]
    mip_filter: bool = False  # whether opacities make up for the dilation of renders, in training and ever after


def read_solution(
    workspace: Workspace, product: str | None = None, similarity: WhichSimilarity = "trained"
) -> Solution:
    """Return the solution of a workspace.

    Args:
        product: that it is in; None: that of the training if there is one, else that of init-sim3.
        similarity: the solution's own, or the initial one, as `geo_from_local` places the SfM model.

    Raises:
        MissingProductError: there is no solution; names the command.
        InputError: the product is damaged, or of an earlier version, which kept a part of it in another file.
    """
    if product is None:
        product = MODEL if workspace.has(MODEL) else ADJUSTMENT
    solution: Solution = load_json(TrainedModel if product == MODEL else Solution, workspace.path(product))
    if "distance_outliers" not in solution.model_fields_set and (workspace.root / SIM3).exists():
        raise _of_earlier_version(workspace, product)
    return _initially_placed(solution, workspace) if similarity == "initial" else solution


def _initially_placed(solution: Solution, workspace: Workspace) -> Solution:
    """Return a solution with the `geo_from_model` of the initial similarity.

    The covariance carries over unchanged, because it describes a perturbation in the target frame `geo`.
    """
    initial = load_json(Solution, workspace.path(ADJUSTMENT)).initial
    if initial is None:
        raise _of_earlier_version(workspace, ADJUSTMENT)
    record = initial.geo_from_local
    model_from_local = Similarity.from_record(solution.model_from_local)
    geo_from_model = Similarity.from_record(record) @ model_from_local.inverse()
    placed = geo_from_model.to_record("model", "geo", covariance=np.array(record.covariance), pivot=record.pivot)
    return solution.model_copy(update={"geo_from_model": placed})


def _of_earlier_version(workspace: Workspace, product: str) -> InputError:
    what = "is of an earlier version of GeoRefGS, which kept a part of it in another file."
    remedy = "Run `georef init-sim3` (and `georef train`) again."
    return InputError("solution-of-older-version", what, path=workspace.path(product), remedy=remedy)


def read_trained(workspace: Workspace, similarity: WhichSimilarity = "trained") -> TrainedModel:
    """Return the solution of the training; arguments and errors as of `read_solution`."""
    model = read_solution(workspace, MODEL, similarity)
    assert isinstance(model, TrainedModel)
    return model


def read_sfm(workspace: Workspace, solution: Solution) -> SparseModel:
    """Return the SfM model that a solution is of, with SfM's lenses; its images have the order of the cameras.

    Raises:
        MissingProductError: there is none; names the command.
        InputError: it is damaged, or the cameras or lenses of the solution are not its own.
    """
    sfm = read_sparse(workspace.path(SPARSE))
    product, remedy = ADJUSTMENT, "Run `georef init-sim3` again."
    if isinstance(solution, TrainedModel):
        product, remedy = MODEL, "Run `georef train` again."
    refusal = partial(InputError, path=workspace.path(product), remedy=remedy)
    if tuple(camera.name for camera in solution.cameras) != sfm.image_name:
        raise refusal("cameras-of-another-model", "has other cameras than sfm/sparse.", field="cameras")
    for lens in solution.lenses:
        camera = sfm.cameras.get(lens.camera_id)
        if camera is None or (camera.model, len(camera.params)) != (lens.model, len(lens.params)):
            raise refusal("lenses-of-another-model", "has other lenses than sfm/sparse.", field="lenses")
    return sfm


@dataclass(frozen=True)
class FixDifferences:
    """Adjusted minus measured position (F, 3) in metres of the F registered cameras that have a fix.

    `is_outlier` says whether the solution has left the fix out.
    """

    camera: IntArray
    difference_in_geo: FloatArray
    is_outlier: BoolArray


def fix_differences(solution: Solution, survey: Survey) -> FixDifferences:
    """Return the differences between the adjusted cameras and their fixes."""
    fixes, outliers = {image.name: image.fix for image in survey.images}, set(solution.gnss_outliers)
    cameras = solution.cameras
    rows = [(index, fix) for index, camera in enumerate(cameras) if (fix := fixes.get(camera.name)) is not None]
    index = np.array([row for row, _ in rows], dtype=np.int64)
    measured = np.array([fix.position_in_geo for _, fix in rows]).reshape(-1, 3)
    return FixDifferences(
        camera=index,
        difference_in_geo=solution.center_in_geo[index] - measured,
        is_outlier=np.array([cameras[row].name in outliers for row in index], dtype=bool),
    )
