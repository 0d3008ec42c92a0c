"""The scene as training and evaluation see it: cameras, points and photographs in the frame `model`.

`model` has the axes and the metre of `geo`, and an origin near the scene, so that float32 holds it to fractions of
a millimetre. Its relation to the SfM frame, `model_from_local`, is fixed when training starts; its relation to the
Earth, `geo_from_model`, is what training refines.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.config import TrainConfig
from pipelines.errors import DegenerateGeometryError, InputError
from pipelines.formats.colmap import SparseModel
from pipelines.formats.image_cache import ImageCache, Photograph
from pipelines.geometry.bundle import CorrectionBasis, Network, correction_basis
from pipelines.geometry.cameras import undistort
from pipelines.geometry.similarity import Similarity, moved_pivot
from pipelines.georef.cameras import CameraCorrections, CameraPoses
from pipelines.georef.losses import ControlMarks, Fixes
from pipelines.georef.problem import GeoProblem
from pipelines.georef.similarity import LearnableSimilarity
from pipelines.products import FloatArray, InitialSimilarity, Survey, SurveyedPoint
from pipelines.stages import SPARSE
from pipelines.workspace import Workspace

# Beyond this the dense normal matrix of the cameras no longer fits a laptop.
_MOST_CORRECTED_CAMERAS = 1200


@dataclass(frozen=True)
class Scene:
    """n registered cameras and N points in `model`.

    Attributes:
        sparse: the SfM model (frame `local`).
        model_from_local: fixed.
        geo_from_model: initial estimate; a pure shift.
        train, test: indices of the cameras in each split.
    """

    sparse: SparseModel
    model_from_local: Similarity
    geo_from_model: Similarity
    train: NDArray[np.int64]
    test: NDArray[np.int64]

    @cached_property
    def poses(self) -> CameraPoses:
        """The cameras as SfM left them."""
        turn = self.model_from_local.rotation
        return CameraPoses(
            self.sparse.rotation_cam_from_local @ turn.T,
            self.model_from_local.apply(self.sparse.cam_center_in_local),
        )

    @cached_property
    def point_in_model(self) -> FloatArray:
        """SfM points (N, 3) in metres."""
        return self.model_from_local.apply(self.sparse.point_in_local)

    @cached_property
    def network(self) -> Network:
        """Cameras, points and image observations as SfM left them, in `model`."""
        sparse, poses = self.sparse, self.poses
        return Network(
            sparse.cameras,
            sparse.image_camera_id,
            poses.cam_from_model,
            poses.cam_center_in_model,
            self.point_in_model,
            sparse.obs_point,
            sparse.obs_image,
            sparse.obs_xy_px,
        )

    @cached_property
    def correction_basis(self) -> CorrectionBasis | None:
        """What the image observations know of the cameras; None where there are too many of them."""
        if len(self.sparse.image_name) > _MOST_CORRECTED_CAMERAS:
            return None
        return correction_basis(self.network)


def make_scene(sparse: SparseModel, survey: Survey, model_from_local: Similarity, shift: FloatArray) -> Scene:
    """Put a sparse model into the frame `model`, whose origin lies at `shift` (3,) in `geo`.

    Raises:
        DegenerateGeometryError: fewer than two registered training images.
    """
    index = sparse.image_index()
    train = np.array([index[name] for name in survey.names("train") if name in index], dtype=np.int64)
    test = np.array([index[name] for name in survey.names("test") if name in index], dtype=np.int64)
    if len(train) < 2:
        raise DegenerateGeometryError(f"{len(train)} registered training images are too few to train on")
    return Scene(sparse, model_from_local, Similarity(translation=shift), train, test)


def initial_scene(sparse: SparseModel, survey: Survey, initial: InitialSimilarity) -> Scene:
    """The scene at the start of training: origin of `model` at the median SfM point, rounded to a metre."""
    geo_from_local = Similarity.from_record(initial.geo_from_local)
    shift = np.round(np.median(geo_from_local.apply(sparse.point_in_local), axis=0))
    model_from_local = replace(geo_from_local, translation=geo_from_local.translation - shift)
    return make_scene(sparse, survey, model_from_local, shift)


def photographs(sparse: SparseModel, survey: Survey, workspace: Workspace, max_size_px: int) -> ImageCache:
    """The registered photographs, undistorted to a longest side of `max_size_px`, cached in the workspace.

    Raises:
        InputError: an image of the model is not in the survey.
    """
    known = {image.name for image in survey.images}
    foreign = [name for name in sparse.image_name if name not in known]
    if foreign:
        raise InputError(
            f"{len(foreign)} images are not in the survey, the first is {foreign[0]!r}: take the model over with "
            "`georef sfm --import`, which leaves them out",
            path=workspace.root / SPARSE,
        )
    folder = workspace.root / survey.image_dir
    shots = [
        Photograph(name, folder / name, sparse.camera_of(index)) for index, name in enumerate(sparse.image_name)
    ]
    return ImageCache(workspace.cache / "undistorted", shots, max_size_px)


def geo_problem(scene: Scene, survey: Survey, initial: InitialSimilarity, config: TrainConfig) -> GeoProblem:
    """The similarity, the cameras and the measurements that hold them, ready to be optimised."""
    record = initial.geo_from_local
    pivot = scene.geo_from_model.apply(scene.poses.cam_center_in_model[scene.train]).mean(axis=0)
    covariance = moved_pivot(np.array(record.covariance), record.pivot, pivot)
    basis = scene.correction_basis if config.optimize_cameras else None
    matrix = np.zeros((len(scene.sparse.image_name), 6, 0)) if basis is None else basis.matrix
    fixes = _fixes(scene, survey) if config.geo_loss else None
    marks = _control_marks(scene, survey) if config.geo_loss else None
    return GeoProblem(
        LearnableSimilarity(scene.geo_from_model, covariance, pivot),
        CameraCorrections(scene.poses, matrix),
        fixes,
        marks,
        weighting=config.weighting,
        hold_prior=initial.layout == "line" or (fixes is None and not _determined_by(marks)),
    )


def _determined_by(marks: ControlMarks | None) -> bool:
    """Whether control points alone fix all seven unknowns of the similarity."""
    return marks is not None and len(marks.position_in_geo) >= 3


def _fixes(scene: Scene, survey: Survey) -> Fixes | None:
    """Fixes of the training cameras; those of test cameras stay unused, as their photographs do."""
    found = [(int(i), survey.image(scene.sparse.image_name[i])) for i in scene.train]
    fixed = [(index, image.fix) for index, image in found if image is not None and image.fix is not None]
    if len(fixed) < 3:
        return None
    covariance = np.array([fix.cov_in_geo for _, fix in fixed])
    return Fixes(
        torch.tensor([index for index, _ in fixed]),
        torch.tensor([fix.position_in_geo for _, fix in fixed], dtype=torch.float64),
        torch.from_numpy(root_information(covariance)),
    )


def _control_marks(scene: Scene, survey: Survey) -> ControlMarks | None:
    """Marks of the control points in training images, where a point is seen in two or more of them."""
    rays = [(point, _rays(scene, point)) for point in survey.control_points]
    kept = [(point, found) for point, found in rays if len({camera for camera, _, _ in found}) >= 2]
    if not kept:
        return None
    flat = [(j, *ray) for j, (_, found) in enumerate(kept) for ray in found]
    marks = ControlMarks(
        point=torch.tensor([row[0] for row in flat]),
        camera=torch.tensor([row[1] for row in flat]),
        bearing_in_cam=torch.from_numpy(np.array([row[2] for row in flat])),
        sigma_rad=torch.tensor([row[3] for row in flat], dtype=torch.float64),
        position_in_geo=torch.tensor([point.position_in_geo for point, _ in kept], dtype=torch.float64),
        root_information=torch.eye(3, dtype=torch.float64).repeat(len(kept), 1, 1),
    )
    covariance = np.array([point.cov_in_geo for point, _ in kept]) + _mark_covariance(scene, marks)
    return replace(marks, root_information=torch.from_numpy(root_information(covariance)))


def _rays(scene: Scene, point: SurveyedPoint) -> list[tuple[int, FloatArray, float]]:
    """Of each mark in a training image: camera index, bearing (3,) in the camera, angular σ."""
    index, trained = scene.sparse.image_index(), set(map(int, scene.train))
    rays = []
    for mark in point.marks:
        camera_index = index.get(mark.image)
        if camera_index is None or camera_index not in trained:
            continue
        camera = scene.sparse.camera_of(camera_index)
        ray = np.append(undistort(camera, np.array([mark.x_px, mark.y_px])), 1.0)
        if not np.isfinite(ray).all():  # a mark where the lens model maps no ray
            continue
        rays.append((camera_index, ray / np.linalg.norm(ray), mark.sigma_px / float(camera.params[0])))
    return rays


def _mark_covariance(scene: Scene, marks: ControlMarks) -> FloatArray:
    """Covariance (J, 3, 3) that the marks' own σ leaves in each intersected point."""
    poses, position = scene.poses, marks.position_in_geo.numpy()
    camera, point = marks.camera.numpy(), marks.point.numpy()
    center = scene.geo_from_model.apply(poses.cam_center_in_model[camera])
    direction = np.einsum("kji,kj->ki", poses.cam_from_model[camera], marks.bearing_in_cam.numpy())
    distance = np.linalg.norm(position[point] - center, axis=1)
    weight = 1.0 / (marks.sigma_rad.numpy() * distance) ** 2
    projector = np.eye(3) - direction[:, :, None] * direction[:, None, :]
    normal = np.zeros((len(position), 3, 3))
    np.add.at(normal, point, weight[:, None, None] * projector)
    return np.asarray(np.linalg.inv(normal))


def root_information(covariance: FloatArray) -> FloatArray:
    """W (N, 3, 3) with WᵀW = Σ⁻¹."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
