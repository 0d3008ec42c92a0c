"""A point in the photographs: lines of sight of its marks, and proposals for further marks."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.core.errors import GeorefError
from pipelines.core.types import ByteArray, FloatArray
from pipelines.geometry.cameras import project
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.solution import Solution
from pipelines.view.marking import MarkedPoint, appears_in, rays_of

_LINE_PLACES = 60  # of an epipolar line
_REACH = (0.2, 5.0)  # of a line of sight, in distances of the point, or of the scene
# Half sides of the template and of the search around the expected place, in pixels of the marked photograph.
_TEMPLATE_PX, _SEARCH_PX = 14, 24
_LEAST_SCORE = 0.75  # normalised correlation
_LEAST_CONTRAST = 6.0  # standard deviation of the template's grey values, of 255


def epipolar_lines(
    solution: Solution, sparse: SparseModel, point: MarkedPoint, camera: int, place_in_geo: FloatArray | None
) -> list[tuple[str, FloatArray]]:
    """Return the lines of sight of a point's marks in other photographs, as pixels (K, 2) of one photograph."""
    rays, poses = rays_of(point, sparse), solution.poses
    lens, lines, tie_points = sparse.camera_of(camera), [], solution.point_in_model(sparse)
    middle = tie_points.mean(axis=0) if len(tie_points) else poses.cam_center_in_model[camera]
    if place_in_geo is not None:
        middle = solution.similarity.inverse().apply(place_in_geo[None])[0]
    for other, bearing in zip(rays.camera.tolist(), rays.bearing_in_cam, strict=True):
        if other == camera:
            continue
        center = poses.cam_center_in_model[other]
        distance = float(np.linalg.norm(middle - center)) * np.geomspace(*_REACH, _LINE_PLACES)
        along = center + distance[:, None] * (poses.cam_from_model[other].T @ bearing)
        in_cam = (along - poses.cam_center_in_model[camera]) @ poses.cam_from_model[camera].T
        pixel = project(lens, in_cam)
        beside = np.array([lens.width, lens.height])
        in_image = np.isfinite(pixel).all(axis=1) & ((pixel > -beside) & (pixel < 2 * beside)).all(axis=1)
        if in_image.sum() > 1:
            lines.append((sparse.image_name[other], pixel[in_image]))
    return lines


@dataclass(frozen=True)
class Proposal:
    """Place of a point in a photograph without a mark, found by correlation with a marked one."""

    image: str
    camera: int
    place_px: tuple[float, float]
    score: float  # normalised correlation
    source: str  # the marked photograph


def proposals(
    solution: Solution,
    sparse: SparseModel,
    point: MarkedPoint,
    place_in_geo: FloatArray,
    photograph: Callable[[int], ByteArray],
    *,
    advance: Callable[[float], None],
) -> Iterator[Proposal]:
    """Yield the places where unmarked photographs look as the nearest marked one does around its mark.

    The patch of the photograph is brought onto that of the mark by planes through the point, level and across the
    line of sight; the better one counts.
    """
    names = sparse.image_name
    near = appears_in(place_in_geo, solution, sparse)
    marked = [camera for camera, _ in near if names[camera] in point.marks]
    wanted = [camera for camera, _ in near if names[camera] not in point.marks]
    if not marked:
        return
    source = marked[0]
    mark = np.array(point.marks[names[source]])
    half, centers = _TEMPLATE_PX + _SEARCH_PX, solution.center_in_geo
    template = _patch(photograph(source), np.eye(2), mark, _TEMPLATE_PX)
    if template.std() < _LEAST_CONTRAST:
        return
    for number, camera in enumerate(wanted):
        matches = []
        try:
            image = photograph(camera)
        except GeorefError:  # a photograph that cannot be read has no proposal
            image = None
        for axes in _planes(centers[source], place_in_geo) if image is not None else ():
            turn, expected = _affine(solution, sparse, (source, camera), place_in_geo, axes)
            if not np.isfinite(turn).all() or not 0.1 < abs(np.linalg.det(turn)) < 10:
                continue
            assert image is not None
            score = cv2.matchTemplate(_patch(image, turn, expected, half), template, cv2.TM_CCOEFF_NORMED)
            row, column = divmod(int(score.argmax()), score.shape[1])
            if min(row, column) == 0 or row == score.shape[0] - 1 or column == score.shape[1] - 1:
                continue
            off = np.array([column, row]) + _refined(np.asarray(score, np.float64), row, column) - _SEARCH_PX
            matches.append((float(score[row, column]), expected + turn @ off))
        if matches and max(matches, key=lambda each: each[0])[0] >= _LEAST_SCORE:
            best, place = max(matches, key=lambda each: each[0])
            yield Proposal(names[camera], camera, (float(place[0]), float(place[1])), best, names[source])
        advance((number + 1) / len(wanted))


def _planes(center_in_geo: FloatArray, place_in_geo: FloatArray) -> Iterator[FloatArray]:
    """Yield two axes (2, 3) in `geo` of each plane through a point that is tried, as a camera sees it."""
    yield np.eye(3)[:2]
    ray = (place_in_geo - center_in_geo) / np.linalg.norm(place_in_geo - center_in_geo)
    first = np.cross(ray, np.eye(3)[int(np.abs(ray).argmin())])
    first /= np.linalg.norm(first)
    yield np.stack([first, np.cross(ray, first)])


def _affine(
    solution: Solution, sparse: SparseModel, cameras: tuple[int, int], place_in_geo: FloatArray, axes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the matrix (2, 2) from pixels of one photograph to those of another, where the point is at (2,)."""
    poses, geo_from_model = solution.poses, solution.similarity
    center = geo_from_model.apply(poses.cam_center_in_model[cameras[0]][None])[0]
    step = float(np.linalg.norm(place_in_geo - center)) / sparse.camera_of(cameras[0]).mean_focal_px
    in_geo = place_in_geo + step * np.concatenate([np.zeros((1, 3)), axes])
    in_model = geo_from_model.inverse().apply(in_geo)
    pixel = []
    for one in cameras:
        in_cam = (in_model - poses.cam_center_in_model[one]) @ poses.cam_from_model[one].T
        pixel.append(project(sparse.camera_of(one), in_cam))
    by_plane = [(each[1:] - each[0]).T for each in pixel]
    if abs(np.linalg.det(by_plane[0])) < 1e-6:
        return np.full((2, 2), np.nan), pixel[1][0]
    return by_plane[1] @ np.linalg.inv(by_plane[0]), pixel[1][0]


def _patch(image: ByteArray, turn: FloatArray, middle: FloatArray, half: int) -> ByteArray:
    """Return the grey square of 2 · half + 1 pixels around a place of a photograph, turned by a matrix."""
    matrix = np.column_stack([turn, middle - 0.5 - turn @ np.array([half, half])])
    size = (2 * half + 1, 2 * half + 1)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.cvtColor(cv2.warpAffine(image, matrix, size, flags=flags), cv2.COLOR_RGB2GRAY))


def _refined(score: FloatArray, row: int, column: int) -> FloatArray:
    """Return how far (2,) right and down of a pixel the peak of parabolas through its neighbours lies."""
    shift = []
    for before, after in (
        (score[row, column - 1], score[row, column + 1]),
        (score[row - 1, column], score[row + 1, column]),
    ):
        bend = float(before) - 2 * float(score[row, column]) + float(after)
        shift.append(0.5 * (float(before) - float(after)) / bend if bend < 0 else 0.0)
    return np.array(shift)
