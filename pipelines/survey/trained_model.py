"""Solution of a survey: frames, cameras, lenses, systematic errors; with the settings of `train`, its product."""

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pipelines.core.products import Covariance3, ImageName, Product, Remark, Rotation, load_json
from pipelines.core.stages import ADJUSTMENT, MODEL
from pipelines.core.types import Matrix34, Row7, Vector3
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity, SimilarityRecord
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.report import AccuracySummary
from pipelines.survey.report_parts import EstimatedError, VarianceFactor


class TrainedCamera(Product):
    """Pose `cam_from_model` of a camera after training. A test camera has moved only with its neighbours.

    Attributes:
        quat_xyzw, translation: p_cam = R p_model + translation, metres.
        exposure: gain matrix and offset (A | b): the photograph shows a colour c as A c + b. None: not estimated.
    """

    name: ImageName
    split: Literal["train", "test"]
    quat_xyzw: Rotation
    translation: Vector3
    exposure: Matrix34 | None = None


class TrainedLens(Product):
    """Lens of a camera of the SfM model after training: COLMAP's parameters of COLMAP's camera model."""

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


class Adjustment(Product):
    """Solution of all that does not depend on Gaussians: similarity, cameras, lenses, systematic errors.

    Attributes:
        model_from_local: fixed similarity from the SfM frame.
        cameras: in the order of the SfM model's images.
        lenses: a camera of the SfM model without one keeps SfM's lens.
        gnss_outliers, control_outliers: names of the images whose fixes, and of the control points that `init-sim3`
            has rejected: they entered no solution.
        sigma_px: σ of an image coordinate of a tie point.
        sigma_datum_m: σ east, north, up that all positions share beyond the matrix of the adjustment: that of the
            transformation of the control points' CRS. All absolute covariances include it.
        earlier: the earlier date that the places are tied to; None: there is none.
        accuracy: predicted σ over the scene; None: a solution that states none.
        variance_factors: tests of the stated σ, of the initial similarity.
        cautions: limits: those of the initial similarity, then the solution's own.
    """

    format_version: Literal[1] = 1
    geo_from_model: SimilarityRecord
    model_from_local: SimilarityRecord
    cameras: tuple[TrainedCamera, ...]
    lenses: tuple[TrainedLens, ...] = ()
    gnss_outliers: tuple[str, ...] = ()
    control_outliers: tuple[str, ...] = ()
    estimated_errors: tuple[EstimatedError, ...] = ()
    measurements: tuple[Measurement, ...] = ()
    sigma_px: float | None = None
    sigma_datum_m: Vector3 = (0.0, 0.0, 0.0)
    earlier: EarlierDate | None = None
    accuracy: AccuracySummary | None = None
    variance_factors: tuple[VarianceFactor, ...] = ()
    cautions: tuple[Remark, ...] = ()

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

    def with_lenses(self, sfm: SparseModel) -> SparseModel:
        """Return the SfM model with the lenses of this solution."""
        solved = {
            lens.camera_id: replace(sfm.cameras[lens.camera_id], params=np.array(lens.params))
            for lens in self.lenses
        }
        return replace(sfm, cameras=sfm.cameras | solved)


class LensVignetting(Product):
    """Fall-off of a lens: its photographs show a colour c as c · (1 + r²(v₀ + r²(v₁ + r² v₂))).

    r is the distance from the optical axis, 1 in the furthest corner of the undistorted photograph.
    """

    camera_id: int
    coefficients: Vector3


class TrainedModel(Adjustment):
    """Product of `train` beside the Gaussians: the solution of the training, and its settings."""

    vignetting: tuple[LensVignetting, ...] = ()  # of the lenses for which it was estimated
    max_image_size: int = Field(gt=0)
    background: Vector3
    sh_degree: int
    iterations: int
    gaussians: int
    backend: Literal["cpu", "cuda"]
    mip_filter: bool = False  # whether opacities make up for the dilation of renders, in training and ever after


def load_solution(workspace: Workspace) -> Adjustment:
    """Return the solution of a workspace: that of its training, else that of init-sim3.

    Raises:
        MissingProductError: neither exists; names the command.
        InputError: the product is damaged.
    """
    if workspace.has(MODEL):
        return load_json(TrainedModel, workspace.path(MODEL))
    return load_json(Adjustment, workspace.path(ADJUSTMENT))
