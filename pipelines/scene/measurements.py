"""What a survey measured of a scene, as the geographic losses take it: training images only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.geometry.lens import bearings
from pipelines.georef.measured import Attitudes, ControlMarks, DepthMarks, Fixes, Pairs, scale_share
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.observations import recorded_rotations
from pipelines.scene.scene import Scene
from pipelines.scene.survey import Survey, SurveyedPoint

# Between the times of two consecutive fixes: longer, and the receiver may have started anew.
FLIGHT_GAP_S = 600.0
# Of the rendered surface at a mark, as a part of its distance: 12 cm at 60 m.
SURFACE_SIGMA = 2e-3
_PAIRS = 300
# Candidates for each pair that is taken: the longest are, since short ones say little of the scale.
_DRAWN = 3


def fixes_of(scene: Scene, survey: Survey) -> Fixes | None:
    """Fixes of the training cameras; those of test cameras stay unused, as their photographs do."""
    found = [(int(i), survey.image(scene.sparse.image_name[i])) for i in scene.train]
    fixed = [(index, image, image.fix) for index, image in found if image is not None and image.fix is not None]
    if len(fixed) < 3:
        return None
    covariance = np.array([fix.cov_in_geo for _, _, fix in fixed])
    return Fixes(
        torch.tensor([index for index, _, _ in fixed]),
        torch.tensor([fix.position_in_geo for _, _, fix in fixed], dtype=torch.float64),
        torch.from_numpy(root_information(covariance)),
        torch.from_numpy(flights([image.timestamp_s for _, image, _ in fixed])),
    )


def flights(times_s: list[float | None]) -> np.ndarray:
    """The flight (F,) of each fix, from 0 in the order of time; all in one where a time is missing."""
    if any(time is None for time in times_s):
        return np.zeros(len(times_s), dtype=np.int64)
    times = np.array(times_s, dtype=np.float64)
    order = np.argsort(times, kind="stable")
    flight = np.empty(len(times), dtype=np.int64)
    flight[order] = np.concatenate([[0], np.cumsum(np.diff(times[order]) > FLIGHT_GAP_S)])
    return flight


def control_marks(scene: Scene, survey: Survey) -> ControlMarks | None:
    """Marks of the control points in training images, where a point is seen in two or more of them."""
    rays = [(point, _rays(scene, point)) for point in survey.control_points]
    kept = [(point, found) for point, found in rays if len({ray[0] for ray in found}) >= 2]
    if not kept:
        return None
    flat = [(j, *ray) for j, (_, found) in enumerate(kept) for ray in found]
    bearing, pixel = (np.array([row[column] for row in flat]) for column in (2, 4))
    camera = np.array([row[1] for row in flat])
    marks = ControlMarks(
        point=torch.tensor([row[0] for row in flat]),
        camera=torch.from_numpy(camera),
        bearing_in_cam=torch.from_numpy(bearing),
        sigma_rad=torch.tensor([row[3] for row in flat], dtype=torch.float64),
        position_in_geo=torch.tensor([point.position_in_geo for point, _ in kept], dtype=torch.float64),
        root_information=torch.eye(3, dtype=torch.float64).repeat(len(kept), 1, 1),
        name=tuple(point.name for point, _ in kept),
        bearing_by_lens=torch.from_numpy(scene.sparse.lenses.bearing_jacobian(camera, pixel)),
    )
    return _with_covariance(marks, _survey_covariance(kept) + _mark_covariance(scene, marks))


def depth_marks(scene: Scene, survey: Survey, marks: ControlMarks) -> tuple[DepthMarks, ControlMarks]:
    """The marks for projection onto the rendered surface, and the control points with the surface's σ added.

    The surface is taken to be off by `SURFACE_SIGMA` of the distance, in any direction, the same for all marks of a
    point: they look at one piece of it.
    """
    order = torch.argsort(marks.camera, stable=True)
    point, camera = marks.point[order], marks.camera[order]
    center = torch.from_numpy(scene.geo_from_model.apply(scene.poses.cam_center_in_model))[camera]
    distance = (marks.position_in_geo[point] - center).norm(dim=1)
    surveyed = {each.name: np.array(each.cov_in_geo) for each in survey.control_points}
    covariance = torch.from_numpy(np.array([surveyed[name] for name in marks.name]))
    identity = torch.eye(3, dtype=torch.float64)
    lateral, surface = marks.sigma_rad[order] * distance, SURFACE_SIGMA * distance
    of_mark = covariance[point] + (lateral.square() + surface.square())[:, None, None] * identity
    bearing = marks.bearing_in_cam[order]
    count = torch.bincount(point, minlength=len(marks.position_in_geo))
    starts = {int(index): int(torch.searchsorted(camera, index)) for index in torch.unique(camera)}
    found = DepthMarks(
        camera=camera,
        xy=bearing[:, :2] / bearing[:, 2:],
        position_in_geo=marks.position_in_geo[point],
        root_information=torch.from_numpy(root_information(of_mark.numpy())),
        share=1.0 / count[point],
        views=len(scene.train),
        rows={index: slice(first, first + int((camera == index).sum())) for index, first in starts.items()},
        xy_by_lens=_slopes(bearing, marks.bearing_by_lens, order),
    )
    mean = torch.zeros(len(count), dtype=torch.float64).index_add(0, point, surface.square()) / count
    all_in = covariance.numpy() + _mark_covariance(scene, marks) + mean.numpy()[:, None, None] * np.eye(3)
    return found, _with_covariance(marks, all_in)


def _slopes(bearing: Tensor, by_lens: Tensor | None, order: Tensor) -> Tensor | None:
    """Derivatives (K, 2, L) of x/z and y/z of bearings (K, 3), from those of the bearings in another order."""
    if by_lens is None:
        return None
    by_lens, z = by_lens[order], bearing[:, 2:, None]
    return by_lens[:, :2] / z - bearing[:, :2, None] * by_lens[:, 2:] / z**2


def attitudes_of(scene: Scene, survey: Survey) -> Attitudes | None:
    """Recorded rotations of the training cameras, as far as the SfM model bears them out."""
    recorded = recorded_rotations(survey, scene.sparse)
    mine = np.isin(recorded.image, scene.train)
    if not mine.any():
        return None
    return Attitudes(
        torch.from_numpy(recorded.image[mine]),
        torch.from_numpy(recorded.geo_from_cam[mine]),
        torch.from_numpy(1.0 / recorded.sigma_rad[mine]),
    )


def pairs_of(scene: Scene, fixes: Fixes, points: GeolocatedPoints | None, seed: int) -> Pairs | None:
    """Some hundred long distances across the scene: between located points, else between cameras with fixes.

    What they are worth is limited to a tenth of what the fixes say of the scale (`georef.measured.scale_share`).

    Raises:
        InputError: `points` does not belong to the scene.
    """
    found = _pairs_of_points(scene, points, seed) if points is not None else None
    found = _pairs_of_cameras(scene, fixes, seed) if found is None else found
    weight = (found.distance_in_geo * found.root_information).square().sum()
    share = scale_share(_scale_information(fixes), float(weight))
    return replace(found, share=share) if share > 0 else None


def _pairs_of_points(scene: Scene, points: GeolocatedPoints, seed: int) -> Pairs | None:
    if not np.array_equal(points.point_id, scene.sparse.point_id):
        raise InputError("the geolocated points are of another model: run `georef geolocate` again")
    good = np.flatnonzero(points.inlier)
    if len(good) < 2:
        return None
    first, second = _long_pairs(scene.point_in_model[good], seed)
    i, j = good[first], good[second]
    apart = points.position_in_geo[i] - points.position_in_geo[j]
    inside = np.linalg.norm(scene.point_in_model[i] - scene.point_in_model[j], axis=1)
    return Pairs(
        torch.from_numpy(inside), None, *_measured_distance(apart, points.cov_in_geo[i] + points.cov_in_geo[j]), 1.0
    )


def _pairs_of_cameras(scene: Scene, fixes: Fixes, seed: int) -> Pairs:
    camera, place = fixes.camera.numpy(), fixes.position_in_geo.numpy()
    i, j = _long_pairs(scene.poses.cam_center_in_model[camera], seed)
    root = fixes.root_information.numpy()
    covariance = np.linalg.inv(np.swapaxes(root, 1, 2) @ root)
    chosen = torch.from_numpy(np.column_stack([camera[i], camera[j]]))
    return Pairs(None, chosen, *_measured_distance(place[i] - place[j], covariance[i] + covariance[j]), 1.0)


def _long_pairs(place: FloatArray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (P,), (P,) of points (n, 3): the longest third of randomly drawn pairs."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, len(place), _DRAWN * _PAIRS)
    second = (first + rng.integers(1, len(place), len(first))) % len(place)
    length = np.linalg.norm(place[first] - place[second], axis=1)
    longest = np.sort(np.argsort(-length, kind="stable")[:_PAIRS])
    return first[longest], second[longest]


def _measured_distance(apart: FloatArray, covariance: FloatArray) -> tuple[Tensor, Tensor]:
    """Lengths (P,) of differences (P, 3), and 1/σ (P,) of them."""
    distance = np.linalg.norm(apart, axis=1)
    along = apart / distance[:, None]
    variance = np.einsum("pi,pij,pj->p", along, covariance, along)
    return torch.from_numpy(distance), torch.from_numpy(variance**-0.5)


def _scale_information(fixes: Fixes) -> float:
    """What the fixes say of ln s: Σ |W (C − C̄)|² about their weighted mean."""
    root = fixes.root_information
    information = root.transpose(1, 2) @ root
    weight = information.diagonal(dim1=1, dim2=2).sum(dim=1)
    arm = fixes.position_in_geo - (weight @ fixes.position_in_geo) / weight.sum()
    return float((root @ arm[:, :, None]).square().sum())


_Ray = tuple[int, FloatArray, float, tuple[float, float]]


def _rays(scene: Scene, point: SurveyedPoint) -> list[_Ray]:
    """Of each mark in a training image: camera index, bearing (3,) in the camera, angular σ, pixel."""
    index, trained = scene.sparse.image_index(), set(map(int, scene.train))
    rays = []
    for mark in point.marks:
        camera_index = index.get(mark.image)
        if camera_index is None or camera_index not in trained:
            continue
        camera = scene.sparse.camera_of(camera_index)
        bearing = bearings(camera, np.array([[mark.x_px, mark.y_px]]))[0]
        if not np.isfinite(bearing).all():  # a mark where the lens model maps no ray
            continue
        rays.append((camera_index, bearing, mark.sigma_px / float(camera.params[0]), (mark.x_px, mark.y_px)))
    return rays


def _survey_covariance(kept: list[tuple[SurveyedPoint, list[_Ray]]]) -> FloatArray:
    return np.array([point.cov_in_geo for point, _ in kept])


def _with_covariance(marks: ControlMarks, covariance: FloatArray) -> ControlMarks:
    return replace(marks, root_information=torch.from_numpy(root_information(covariance)))


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
