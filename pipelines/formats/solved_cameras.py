"""Cameras, lenses and tie points that another program has solved, in one form for every file format.

A reader hands its photographs, lenses and tie points to `solved_cameras`, which refuses nonsense and makes a model
in COLMAP's conventions of them. Poses lead from the camera (x right, y down, z forward) to the file's world.
Worlds with coordinates of a map or of the Earth are shifted to the cameras: the model's frame has an arbitrary
place.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict

from pipelines.core.errors import InputError
from pipelines.core.products import Remark
from pipelines.core.sentences import listed
from pipelines.core.types import ByteArray, FloatArray, IntArray
from pipelines.geometry.cameras import Camera, project_each
from pipelines.geometry.lens_fit import ForeignLens, nearest_camera
from pipelines.geometry.sparse_model import SparseModel

# Width and height of the photograph that a name in a file means; None: it is none of the survey's.
PhotoSize = Callable[[str], tuple[int, int] | None]

_MOST_OFF_ROTATION = 1e-3  # of the entries of R Rᵀ; programs write four decimals and more
_FARTHEST = 1e9  # the Earth's radius is 6.4e6 m
LONGEST_SIDE_PX = 1_000_000
_FAR = 100.0  # extents of the cameras, beyond which the world is shifted
_PROPORTION_PX = 1.0  # of the smaller picture, by which rounded sides may differ from its proportions
# A lens that is replaced by another: said above, refused above (px, and of the longer side).
_SAID_PX, _MOST_PX, _MOST_OF_SIDE = 0.05, 2.0, 2e-3


class Foreign(BaseModel):
    """Base of what is read of another program's JSON: unknown keys are ignored, NaN is refused."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


@dataclass(frozen=True)
class SolvedPhotograph:
    """Photograph: its name in the file, the key of its lens, and its pose camera → world."""

    name: str
    lens: str
    world_from_cam: FloatArray  # (3, 3)
    center_in_world: FloatArray  # (3,)


@dataclass(frozen=True)
class TiePoints:
    """Points (N, 3) in the world with colours, and observations (M,) of them in pixels of photographs."""

    position: FloatArray
    rgb: ByteArray  # (N, 3)
    obs_point: IntArray  # (M,) index into the points
    obs_photograph: IntArray  # (M,) index into the photographs; negative: of none of them
    obs_xy_px: FloatArray  # (M, 2), the centre of the top-left pixel being (0.5, 0.5)


@dataclass(frozen=True)
class SolvedCameras:
    """Solved cameras of a file as a model of the survey's photographs, and what has to be said about them."""

    program: str
    model: SparseModel  # names as in the file; without points where the file has none
    foreign: tuple[str, ...]  # names of photographs that the survey lacks
    remarks: tuple[Remark, ...]


def solved_cameras(
    path: Path,
    program: str,
    photographs: Sequence[SolvedPhotograph],
    lenses: Mapping[str, ForeignLens],
    photo_size: PhotoSize,
    *,
    ties: TiePoints | None = None,
    remarks: Sequence[Remark] = (),
) -> SolvedCameras:
    """Return the photographs of the survey with their lenses, and the tie points that two of them see.

    Raises:
        InputError: no photograph has a pose, a pose is no rotation or lies beyond the Earth, values are not finite,
            a lens is missing or cannot be replaced by one of COLMAP's.
    """
    if not photographs:
        raise InputError("no-solved-cameras", f"{program} has solved no camera in this file.", path=path)
    size_of = [photo_size(photograph.name) for photograph in photographs]
    chosen = [row for row, size in enumerate(size_of) if size is not None]
    foreign = tuple(photograph.name for photograph, size in zip(photographs, size_of, strict=True) if size is None)
    rows = [photographs[row] for row in chosen]
    rotation = np.array([_rotation(photograph, path) for photograph in rows]).reshape(-1, 3, 3)
    center = np.array([photograph.center_in_world for photograph in rows], dtype=np.float64).reshape(-1, 3)
    if not (np.abs(center) < _FARTHEST).all():
        bad = rows[int(np.flatnonzero(~(np.abs(center) < _FARTHEST).all(axis=1))[0])]
        message = f"The position of the photograph {bad.name!r} is no number, or beyond {_FARTHEST:g}."
        raise InputError("position-impossible", message, path=path, field="position")
    shift = _shift(center)
    sizes = [size for size in size_of if size is not None]
    kinds = [(row.lens, size) for row, size in zip(rows, sizes, strict=True)]
    keys = {kind: number for number, kind in enumerate(dict.fromkeys(kinds), start=1)}
    cameras, scales, said = _cameras(keys, lenses, path)
    cam_from_world = np.swapaxes(rotation, 1, 2)
    scale = np.array([scales[keys[kind]] for kind in kinds]).reshape(-1, 2)
    seen = _points(ties, np.array(chosen, dtype=np.int64), len(photographs), path)
    model = SparseModel(
        cameras=cameras,
        image_id=np.arange(1, len(rows) + 1),
        image_name=tuple(row.name for row in rows),
        image_camera_id=np.array([keys[kind] for kind in kinds], dtype=np.int64),
        rotation_cam_from_local=cam_from_world,
        translation_cam_from_local=-np.einsum("nij,nj->ni", cam_from_world, center - shift),
        point_id=np.arange(1, len(seen.position) + 1),
        point_in_local=seen.position - shift,
        point_rgb=seen.rgb,
        point_error_px=np.full(len(seen.position), np.nan),
        obs_point=seen.obs_point,
        obs_image=seen.obs_photograph,
        obs_xy_px=seen.obs_xy_px * scale[seen.obs_photograph],
    )
    return SolvedCameras(program, model, foreign, (*remarks, *said))


def not_placed(program: str, place: str) -> Remark:
    """Return the remark that poses are taken and their place on Earth is not."""
    sentence = (
        f"Poses and lenses of {program} are taken. Its place on Earth ({place}) is not: init-sim3 places the model "
        "by the survey's own measurements."
    )
    return Remark(code="georeference-not-taken", sentence=sentence)


def crs_name(text: str | None) -> str:
    """Return a short name of a CRS that a file states as WKT or as a code."""
    first = re.search(r'"([^"]{1,80})"', text or "")
    return first[1] if first else " ".join((text or "").split())[:80] or "an unnamed CRS"


def _rotation(photograph: SolvedPhotograph, path: Path) -> FloatArray:
    """Return the rotation nearest to the one in a file, which differs by the file's decimals."""
    given = np.asarray(photograph.world_from_cam, dtype=np.float64)
    off = np.abs(given @ given.T - np.eye(3)).max() if np.isfinite(given).all() else np.inf
    if not off <= _MOST_OFF_ROTATION or np.linalg.det(given) < 0:
        kind = "is mirrored" if off <= _MOST_OFF_ROTATION else "is no rotation: its axes have no length of 1"
        message = f"The attitude of the photograph {photograph.name!r} {kind}."
        remedy = "Export the cameras again."
        raise InputError("rotation-impossible", message, path=path, field="rotation", remedy=remedy)
    left, _, right = np.linalg.svd(given)
    return np.asarray(left @ right)


def _shift(center: FloatArray) -> FloatArray:
    """Return what is subtracted from a world's coordinates: nothing where they are of the cameras' extent."""
    if not len(center):
        return np.zeros(3)
    middle = np.median(center, axis=0)
    extent = float(np.abs(center - middle).max())
    return np.round(middle) if np.abs(middle).max() > _FAR * max(extent, 1e-9) else np.zeros(3)


def _cameras(
    keys: Mapping[tuple[str, tuple[int, int]], int], lenses: Mapping[str, ForeignLens], path: Path
) -> tuple[dict[int, Camera], dict[int, tuple[float, float]], list[Remark]]:
    """Return cameras by number, the scales from the file's pixels to those of the photographs, and remarks."""
    cameras, scales, replaced, resized = {}, {}, [], []
    for (key, size), number in keys.items():
        if key not in lenses:
            message = f"Photographs have the camera {key[:80]!r}, which the file does not describe."
            raise InputError("lens-missing", message, path=path, field="cameras")
        lens = lenses[key]
        width, height = lens.size
        sides_fit = 0 < width <= LONGEST_SIDE_PX and 0 < height <= LONGEST_SIDE_PX
        if not sides_fit or not np.isfinite(lens.start.params).all():
            message = f"The camera {key[:80]!r} of {width}×{height} pixels has parameters that no camera has."
            raise InputError("lens-impossible", message, path=path, field="cameras")
        camera, error = nearest_camera(lens)
        limit = max(_MOST_PX, _MOST_OF_SIDE * max(width, height))
        if not error <= limit:
            message = (
                f"The lens of the camera {key[:80]!r} has no like among COLMAP's models: the nearest, "
                f"{camera.model}, is {error:.1f} px off (limit {limit:.1f} px)."
            )
            remedy = "Solve the cameras without skew (b2), or with fewer terms of distortion."
            raise InputError("lens-not-convertible", message, path=path, field="cameras", remedy=remedy)
        if error > _SAID_PX:
            replaced.append((key[:80], camera.model, error))
        cameras[number], scales[number] = _resized(camera, size)
        if scales[number] != (1.0, 1.0):
            resized.append((lens.size, size))
    remarks = []
    if resized:
        (width, height), size = resized[0]
        sentence = (
            f"The cameras were solved on pictures of {width}×{height} pixels, the photographs have "
            f"{size[0]}×{size[1]}: lenses and observations are scaled."
        )
        remarks.append(Remark(code="pictures-resized", sentence=sentence))
    if not replaced:
        return cameras, scales, remarks
    worst = max(replaced, key=lambda entry: entry[2])
    sentence = (
        f"{worst[1]} stands for the lens of {listed([entry[0] for entry in replaced])}: {worst[2]:.2f} px off "
        "in the image at most."
    )
    return cameras, scales, [*remarks, Remark(code="lens-replaced", sentence=sentence)]


def _resized(camera: Camera, size: tuple[int, int]) -> tuple[Camera, tuple[float, float]]:
    """Return the camera of photographs of another size and the same proportions, and its scale along x and y.

    Programs solve cameras on smaller copies. A pinhole may be that of undistorted copies: it stays as it is.
    """
    across, along = size[0] / camera.width, size[1] / camera.height
    apart_px = abs(across / along - 1.0) * min(camera.width, camera.height)
    if (across, along) == (1.0, 1.0) or apart_px > _PROPORTION_PX or camera.model == "PINHOLE":
        return camera, (1.0, 1.0)
    params = camera.params.copy()
    params[:4] *= (across, along, across, along)  # fx, fy, cx, cy in all models that are made here
    return Camera(camera.model, *size, params), (across, along)


def _points(ties: TiePoints | None, chosen: IntArray, count: int, path: Path) -> TiePoints:
    """Return the points which two of the chosen photographs see, sorted by point, with places among the chosen."""
    if ties is None:
        nothing = np.empty(0, np.int64)
        return TiePoints(np.empty((0, 3)), np.empty((0, 3), np.uint8), nothing, nothing, np.empty((0, 2)))
    if not (np.isfinite(ties.position).all() and np.isfinite(ties.obs_xy_px).all()):
        raise InputError(
            "values-not-finite", "Tie points have values that are no numbers.", path=path, field="points"
        )
    rank = np.full(count + 1, -1)  # the last one is for observations in no photograph
    rank[chosen] = np.arange(len(chosen))
    image = rank[np.where(ties.obs_photograph < 0, count, ties.obs_photograph)]
    kept = np.flatnonzero(image >= 0)
    # A program may list a point twice in one image: the first one counts.
    pairs, first = np.unique(np.stack([ties.obs_point[kept], image[kept]], axis=-1), axis=0, return_index=True)
    seen = np.bincount(pairs[:, 0], minlength=len(ties.position)) >= 2
    used = seen[pairs[:, 0]]
    points = np.flatnonzero(seen)
    return TiePoints(
        ties.position[points],
        ties.rgb[points],
        np.searchsorted(points, pairs[used, 0]),
        pairs[used, 1],
        ties.obs_xy_px[kept[first[used]]],
    )


def without_far_observations(solved: SolvedCameras, most_of_side: float) -> SolvedCameras:
    """Return the cameras without observations that lie further from their point than a share of the longer side."""
    model = solved.model
    in_cam = np.einsum(
        "nij,nj->ni", model.rotation_cam_from_local[model.obs_image], model.point_in_local[model.obs_point]
    )
    in_cam += model.translation_cam_from_local[model.obs_image]
    owner = model.image_camera_id[model.obs_image]
    off = np.linalg.norm(project_each(model.cameras, owner, in_cam) - model.obs_xy_px, axis=1)
    side = {key: most_of_side * max(camera.width, camera.height) for key, camera in model.cameras.items()}
    good = off <= np.array([side[key] for key in owner.tolist()])
    if good.all():
        return solved
    fewer = replace(
        model, obs_point=model.obs_point[good], obs_image=model.obs_image[good], obs_xy_px=model.obs_xy_px[good]
    )
    return replace(solved, model=fewer.of_images(np.arange(len(model.image_name))))


def vector_of(values: ArrayLike, count: int) -> FloatArray:
    """Return `count` finite numbers as an array; a ValueError otherwise."""
    array = np.asarray(values, dtype=np.float64).ravel()
    if len(array) != count or not np.isfinite(array).all():
        raise ValueError(f"expected {count} numbers")
    return array
