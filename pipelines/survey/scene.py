"""Sparse scene of adjustment, training and evaluation: cameras and points of SfM in the frame `model`.

The frame `model` has the axes and the metre of `geo`. Its origin lies near the scene, so that float32 resolves
fractions of a millimetre. `model_from_local`, its relation to the SfM frame, is fixed when training starts.
Training refines `geo_from_model`, its relation to the Earth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.plan import photograph_folder
from pipelines.core.stages import ADJUSTMENT, MASKS, SPARSE
from pipelines.core.types import Float32Array, FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.bundle import BundleInformation, bundle_information
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.network import Network
from pipelines.geometry.rolling_shutter import depths_at, in_rolling_shutter
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.navigation import load_survey
from pipelines.survey.photographs import ImageCache, Photograph
from pipelines.survey.solution import SimilarityEstimate, Solution, read_solution
from pipelines.survey.survey import Survey

_SHIFT_GRID = (48, 36)  # columns and rows: tie points are not denser


@dataclass(frozen=True)
class SparseScene:
    """n registered cameras and N points in `model`."""

    sparse: SparseModel  # the SfM model (frame `local`)
    model_from_local: Similarity  # similarity that stays fixed
    geo_from_model: Similarity  # initial estimate, a pure shift
    train: IntArray  # indices of cameras
    test: IntArray
    # Information of the image observations where it is known from another frame; None: it is computed
    known_bundle: BundleInformation | None = None

    @cached_property
    def poses(self) -> CameraPoses:
        turn = self.model_from_local.rotation
        return CameraPoses(
            self.sparse.rotation_cam_from_local @ turn.T,
            self.model_from_local.apply(self.sparse.cam_center_in_local),
        )

    def of_images(self, images: IntArray) -> SparseScene:
        """Return the scene of some cameras (K,), in ascending order, in the same frame."""
        rows = np.unique(images)
        train, test = (np.searchsorted(rows, np.intersect1d(split, rows)) for split in (self.train, self.test))
        return replace(self, sparse=self.sparse.of_images(rows), train=train, test=test, known_bundle=None)

    @cached_property
    def point_in_model(self) -> FloatArray:
        """Points of the SfM model (N, 3), metres in `model`."""
        return self.model_from_local.apply(self.sparse.point_in_local)

    def at(self, solution: Solution) -> SparseScene:
        """Return the scene as a solution has it: with its cameras and lenses, and the points that they see.

        SfM's own cameras are the place at which the adjustment is linear. What photographs show, such as stereo,
        belongs to the solved ones: else it has the bend of SfM's model, which the adjustment removes.
        """
        poses, sparse = solution.poses, solution.with_lenses(self.sparse)
        local_from_model, turn = self.model_from_local.inverse(), self.model_from_local.rotation
        refined = refined_points(network_of(sparse, poses, self.point_in_model))
        rotation, center = poses.cam_from_model @ turn, local_from_model.apply(poses.cam_center_in_model)
        solved = replace(
            sparse,
            rotation_cam_from_local=rotation,
            translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, center),
            point_in_local=local_from_model.apply(refined.point_in_world),
            point_error_px=refined.error_px,
        )
        return replace(self, sparse=solved, known_bundle=None)

    def geo_from_local(self, geo_from_model: Similarity) -> Similarity:
        """Return a similarity of the model as one of the SfM frame."""
        return geo_from_model @ self.model_from_local

    @cached_property
    def network(self) -> Network:
        """Cameras, points and image observations of the SfM model, in `model`."""
        return network_of(self.sparse, self.poses, self.point_in_model)

    @cached_property
    def bundle(self) -> BundleInformation:
        """Information of the image observations on the cameras, which the lens follows."""
        return bundle_information(self.network) if self.known_bundle is None else self.known_bundle


def network_of(sparse: SparseModel, poses: CameraPoses, point_in_model: FloatArray) -> Network:
    """Return the image observations of an SfM model with its cameras and points (N, 3) in `model`."""
    return Network(
        sparse.cameras,
        sparse.image_camera_id,
        poses.cam_from_model,
        poses.cam_center_in_model,
        point_in_model,
        sparse.obs_point,
        sparse.obs_image,
        sparse.obs_xy_px,
    )


def make_scene(sparse: SparseModel, survey: Survey, model_from_local: Similarity, shift: FloatArray) -> SparseScene:
    """Return the scene of a sparse model, whose origin lies at a `shift` (3,) in `geo`.

    Raises:
        DegenerateGeometryError: fewer than two registered training images.
    """
    index = sparse.image_index()
    train = np.array([index[name] for name in survey.names("train") if name in index], dtype=np.int64)
    test = np.array([index[name] for name in survey.names("test") if name in index], dtype=np.int64)
    if len(train) < 2:
        raise DegenerateGeometryError(
            "too-few-training-images",
            f"{len(train)} training images are registered; at least two are needed.",
        )
    return SparseScene(sparse, model_from_local, Similarity(translation=shift), train, test)


def initial_scene(sparse: SparseModel, survey: Survey, initial: SimilarityEstimate) -> SparseScene:
    """Return the scene at the start of training, its origin at the median SfM point, rounded to a metre.

    Raises as `make_scene`.
    """
    geo_from_local = Similarity.from_record(initial.geo_from_local)
    shift = np.round(np.median(geo_from_local.apply(sparse.point_in_local), axis=0))
    model_from_local = replace(geo_from_local, translation=geo_from_local.translation - shift)
    return make_scene(sparse, survey, model_from_local, shift)


def adjusted_scene(sparse: SparseModel, survey: Survey, adjustment: Solution) -> SparseScene:
    """Return the scene in the frame of an adjustment; `geo_from_model` is the pure shift that comes nearest to it.

    Raises as `make_scene`.
    """
    model_from_local = Similarity.from_record(adjustment.model_from_local)
    middle = np.median(model_from_local.apply(sparse.point_in_local), axis=0)
    return make_scene(sparse, survey, model_from_local, adjustment.similarity.apply(middle) - middle)


def load_adjusted_scene(workspace: Workspace, product: str = ADJUSTMENT) -> tuple[Solution, Survey, SparseScene]:
    """Read the adjustment, the survey with its variance factors, and the scene.

    `product` is the adjustment: that of `init-sim3`, or the solution that blocks share.

    Raises:
        GeorefError: a product does not exist, is damaged, or has too few images.
    """
    adjustment = read_solution(workspace, product)
    survey = adjustment.weighted(load_survey(workspace))
    return adjustment, survey, adjusted_scene(read_sparse(workspace.path(SPARSE)), survey, adjustment)


def load_solved_scene(workspace: Workspace, product: str = ADJUSTMENT) -> tuple[Solution, Survey, SparseScene]:
    """Read what `load_adjusted_scene` reads, and return the scene at the solution (`SparseScene.at`)."""
    solution, survey, scene = load_adjusted_scene(workspace, product)
    return solution, survey, scene.at(solution)


def photographs(sparse: SparseModel, survey: Survey, workspace: Workspace, max_size_px: int) -> ImageCache:
    """Return the cache of the registered photographs, undistorted with their longer side limited to `max_size_px`.

    Raises as `photograph_files`.
    """
    shots = photograph_files(sparse, survey, workspace)
    return ImageCache(workspace.cache / "undistorted", shots, max_size_px)


def photograph_files(sparse: SparseModel, survey: Survey, workspace: Workspace) -> list[Photograph]:
    """Return the registered photographs with the lenses of the model, in its order.

    Raises:
        InputError: an image of the model is not in the survey.
    """
    known = {image.name: image for image in survey.images}
    foreign = [name for name in sparse.image_name if name not in known]
    if foreign:
        raise InputError(
            "images-not-in-survey",
            f"{len(foreign)} images of the model are not in the survey, such as {foreign[0]!r}.",
            path=workspace.root / SPARSE,
            remedy="Import the model with `georef sfm --import`, which leaves them out.",
        )
    folder = photograph_folder(workspace, survey.image_dir)
    shots = []
    for index, name in enumerate(sparse.image_name):
        shift, hashed = _rolling_shift(sparse, index), known[name].mask_sha256
        mask = workspace.path(f"{MASKS}/{name}.png") if hashed else None
        shots.append(
            Photograph(name, folder / name, sparse.camera_of(index), known[name].sha256, shift, mask, hashed)
        )
    return shots


def _rolling_shift(sparse: SparseModel, image: int) -> Float32Array | None:
    """Return the shift of a photograph's pixels by its rolling shutter, as of `Photograph.shift`."""
    if sparse.travel_in_cam is None or not sparse.travel_in_cam[image].any():
        return None
    camera = sparse.camera_of(image)
    x, y = ((np.arange(cells) + 0.5) / cells for cells in _SHIFT_GRID)
    xy_px = np.stack(np.meshgrid(x * camera.width, y * camera.height), axis=-1).reshape(-1, 2)
    seen = in_rolling_shutter(camera, xy_px, depths_at(sparse, image, xy_px), sparse.travel_in_cam[image])
    return np.nan_to_num(seen - xy_px).reshape(*_SHIFT_GRID[::-1], 2).astype(np.float32)
