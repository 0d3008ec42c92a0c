"""Poses of an imported model against its own observations or matches: in COLMAP's convention, or in another.

COLMAP's poses lead from the world to the camera (x right, y down, z forward), and a quaternion begins with its real
part. Programs write others: the axes of OpenGL and Blender (y up, z backward), poses from the camera to the world,
the camera's centre in place of the translation, or the quaternion's real part last. Each is tried where the poses
as read do not fit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Camera, project_each, undistort
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.geometry.sparse_model import SparseModel

_FLIP = np.array([1.0, -1.0, -1.0])
_MOST_SAMPLES = 20_000
# A model whose observations lie further from its points in the median is none of these photographs.
_MOST_ERROR_PX, _MOST_ERROR_OF_SIDE = 5.0, 0.01
_USUAL_PX = 1.0  # median distance of matches from epipolar lines of right poses
_CLEARLY = 0.25  # of the error as read, below which another convention explains it

Matches = dict[tuple[int, int], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True)
class Convention:
    """Way in which poses may have been written; the default is COLMAP's."""

    opengl: bool = False
    pose: str = "world to camera"  # or `camera to world`, or `centre`: the translation is the camera's centre
    real_last: bool = False

    def poses(self, rotation: FloatArray, translation: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return COLMAP's rotations (N, 3, 3) and translations (N, 3) of poses that were written so."""
        if self.real_last:
            quat_xyzw = quat_xyzw_from_matrix(rotation)
            rotation = matrix_from_quat_xyzw(np.roll(quat_xyzw, 1, axis=1))
        if self.pose == "camera to world":
            rotation = np.swapaxes(rotation, 1, 2)
        if self.pose != "world to camera":
            translation = -np.einsum("nij,nj->ni", rotation, translation)
        if self.opengl:
            rotation, translation = rotation * _FLIP[:, None], translation * _FLIP
        return rotation, translation

    @property
    def code(self) -> str:
        return "-".join(self._parts(("camera-to-world", "camera-centre"), "opengl-axes", "real-part-last"))

    @property
    def sentence(self) -> str:
        parts = self._parts(
            ("poses from the camera to the world", "the camera's centre in place of the translation"),
            "the camera axes of OpenGL and Blender (y up, z backward)",
            "the quaternion's real part last",
        )
        return " and ".join(parts)

    @property
    def remedy(self) -> str:
        """How to write the poses as COLMAP does."""
        steps = []
        if self.real_last:
            steps.append("write the quaternion as QW QX QY QZ")
        if self.pose == "camera to world":
            steps.append("invert each pose (R transposed, −R transposed · t)")
        elif self.pose == "centre":
            steps.append("write t = −R · centre")
        if self.opengl:
            steps.append("negate the second and third row of each [R|t]")
        return ", then ".join(steps)

    def _parts(self, of_pose: tuple[str, str], opengl: str, real_last: str) -> list[str]:
        parts = [real_last] if self.real_last else []
        if self.pose != "world to camera":
            parts.append(of_pose[self.pose == "centre"])
        return [*parts, opengl] if self.opengl else parts


def _conventions() -> Iterator[Convention]:
    for real_last, pose, opengl in product(
        (False, True), ("world to camera", "camera to world", "centre"), (False, True)
    ):
        yield Convention(opengl, pose, real_last)


def check_observations(model: SparseModel, path: Path) -> None:
    """Refuse a model whose points do not lie where its own observations see them; names the convention that fits.

    Raises:
        InputError: points behind their cameras, or far from their observations in the median.
    """
    kept = np.arange(len(model.obs_point))
    if len(kept) > _MOST_SAMPLES:
        kept = np.random.default_rng(0).choice(len(kept), _MOST_SAMPLES, replace=False)
    image, points = model.obs_image[kept], model.point_in_local[model.obs_point[kept]]

    def error(convention: Convention) -> tuple[float, int]:
        rotation, translation = convention.poses(model.rotation_cam_from_local, model.translation_cam_from_local)
        in_cam = np.einsum("nij,nj->ni", rotation[image], points) + translation[image]
        front = np.flatnonzero(in_cam[:, 2] > 0)
        apart = np.full(len(in_cam), np.inf)
        seen = project_each(model.cameras, model.image_camera_id[image[front]], in_cam[front])
        apart[front] = np.linalg.norm(seen - model.obs_xy_px[kept][front], axis=1)
        apart[np.isnan(apart)] = np.inf
        return float(np.median(apart)), len(in_cam) - len(front)

    as_read, behind = error(Convention())
    limit = _limit_px(model.cameras)
    if as_read <= limit:
        return
    seen = (
        f"{behind} of {len(kept)} of its points lie behind the cameras that observe them"
        if behind > len(kept) / 2
        else f"its points reproject {as_read:.0f} px (median) from its own observations"
    )
    errors = {convention: error(convention)[0] for convention in _conventions()}
    raise _refusal(seen, errors, limit, path, "points reproject")


def check_matches(model: SparseModel, matches: Matches, path: Path) -> None:
    """Refuse poses that contradict matches of the photographs; names the convention that fits.

    `matches` has pixels (M, 2) and (M, 2) of pairs of images, given as rows of the model.

    Raises:
        InputError: matches lie far from the epipolar lines in the median.
    """
    rays = _rays(model, matches)
    errors = {convention: _epipolar_px(model, rays, convention) for convention in _conventions()}
    as_read, limit = errors[Convention()], _limit_px(model.cameras)
    # Between views that are only shifted, other axes move matches little off their lines.
    if as_read <= limit and (as_read <= _USUAL_PX or min(errors.values()) > _CLEARLY * as_read):
        return
    seen = f"matches of the photographs lie {as_read:.0f} px (median) from the epipolar lines of its poses"
    raise _refusal(seen, errors, limit, path, "matches lie")


def epipolar_error_px(model: SparseModel, matches: Matches) -> float:
    """Return the median distance of matches from their epipolar lines in pixels; 0 without matches."""
    return _epipolar_px(model, _rays(model, matches), Convention())


def _rays(model: SparseModel, matches: Matches) -> list[tuple[int, int, FloatArray, FloatArray]]:
    return [
        (i, j, undistort(model.camera_of(i), first), undistort(model.camera_of(j), second))
        for (i, j), (first, second) in matches.items()
    ]


def _epipolar_px(
    model: SparseModel, rays: list[tuple[int, int, FloatArray, FloatArray]], convention: Convention
) -> float:
    rotation, translation = convention.poses(model.rotation_cam_from_local, model.translation_cam_from_local)
    apart = [np.empty(0)]
    for i, j, first, second in rays:
        turn = rotation[j] @ rotation[i].T
        apart.append(_sampson(turn, translation[j] - turn @ translation[i], first, second))
    return float(np.median(model.focal_px)) * float(np.median(np.concatenate(apart))) if rays else 0.0


def _refusal(seen: str, errors: dict[Convention, float], limit: float, path: Path, what: str) -> InputError:
    as_read, best = errors[Convention()], min(errors, key=lambda convention: errors[convention])
    if best == Convention() or errors[best] > min(limit, _CLEARLY * as_read):
        return InputError(
            "model-against-observations",
            f"Poses and observations of the model do not fit: {seen}, and in no convention do they. Was it made of "
            "other photographs, in a left-handed world, or with another focal length? COLMAP's poses lead from the "
            "world to the camera (x right, y down, z forward).",
            path=path,
        )
    return InputError(
        f"model-{best.code}",
        (
            f"Poses of the model are not COLMAP's: {seen}. They were written with {best.sentence}: read so, "
            f"its {what} {errors[best]:.1f} px apart."
        ),
        path=path,
        remedy=f"Convert them and import the model again: {best.remedy}.",
    )


def _limit_px(cameras: dict[int, Camera]) -> float:
    longest = max((max(camera.width, camera.height) for camera in cameras.values()), default=0)
    return max(_MOST_ERROR_PX, _MOST_ERROR_OF_SIDE * longest)


def _sampson(rotation: FloatArray, translation: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the distances (M,) of matches from their epipolar lines, in units of the focal length (Sampson)."""
    x, y, z = translation
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation
    ones = np.ones((len(first), 1))
    a, b = np.hstack([first, ones]), np.hstack([second, ones])
    in_second, in_first = a @ essential.T, b @ essential
    scale = np.sqrt((in_second[:, :2] ** 2).sum(axis=1) + (in_first[:, :2] ** 2).sum(axis=1))
    return np.asarray(np.abs((b * in_second).sum(axis=1)) / np.maximum(scale, 1e-12))
