"""Terms of the geographic losses, built from the survey's measurements of the training images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.control_by_depth import ControlByDepth
from pipelines.adjust.observations import recorded_rotations
from pipelines.adjust.terms import AttitudeTerm, ControlTerm, DistanceTerm, FixTerm
from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.marks import mark_rays
from pipelines.scene.scene import Scene
from pipelines.scene.survey import Survey

# Gap between two consecutive fixes beyond which the receiver may have restarted.
FLIGHT_GAP_S = 600.0
# σ of the rendered surface at a mark, as a fraction of its distance: 12 cm at 60 m.
SURFACE_SIGMA = 2e-3
_WORTH = 0.1  # share of the fixes' information on the scale that the distances may repeat
_PAIRS = 300
# Candidates drawn for each pair in use. The longest are used, because short pairs hardly constrain the scale.
_DRAWN = 3


def fix_term(scene: Scene, survey: Survey) -> FixTerm | None:
    """Return the fixes of the training cameras, or None if there are fewer than three.

    The fixes of test cameras stay unused, like their photographs.
    """
    images = [(int(index), survey.image(scene.sparse.image_name[index])) for index in scene.train]
    fixed = [(index, image, image.fix) for index, image in images if image is not None and image.fix is not None]
    if len(fixed) < 3:
        return None
    covariance = np.array([fix.cov_in_geo for _, _, fix in fixed])
    return FixTerm(
        torch.tensor([index for index, _, _ in fixed]),
        torch.tensor([fix.position_in_geo for _, _, fix in fixed], dtype=torch.float64),
        torch.from_numpy(root_information(covariance)),
        torch.from_numpy(flights([image.timestamp_s for _, image, _ in fixed])),
    )


def flights(times_s: list[float | None]) -> np.ndarray:
    """Return the flight (F,) of each fix, counted from 0 in the order of time.

    A gap of more than `FLIGHT_GAP_S` begins a new flight. Without the time of every fix, all belong to one flight.
    """
    if any(time is None for time in times_s):
        return np.zeros(len(times_s), dtype=np.int64)
    times = np.array(times_s, dtype=np.float64)
    order = np.argsort(times, kind="stable")
    flight = np.empty(len(times), dtype=np.int64)
    flight[order] = np.concatenate([[0], np.cumsum(np.diff(times[order]) > FLIGHT_GAP_S)])
    return flight


def control_term(scene: Scene, survey: Survey) -> ControlTerm | None:
    """Return the control points with marks in two or more training images, or None if there is none."""
    rays = mark_rays(survey.control_points, scene.sparse, scene.train)
    marked = rays.marks_of_point >= 2
    if not marked.any():
        return None
    rays = rays.of_points(marked)
    surveyed = [point for point, enough in zip(survey.control_points, marked, strict=True) if enough]
    control = ControlTerm(
        point=torch.from_numpy(rays.point),
        camera=torch.from_numpy(rays.camera),
        bearing_in_cam=torch.from_numpy(rays.bearing_in_cam),
        sigma_rad=torch.from_numpy(rays.sigma_rad),
        position_in_geo=torch.tensor([point.position_in_geo for point in surveyed], dtype=torch.float64),
        root_information=torch.eye(3, dtype=torch.float64).repeat(len(surveyed), 1, 1),
        point_id=rays.point_id,
        bearing_by_lens=torch.from_numpy(scene.sparse.lenses.bearing_jacobian(rays.camera, rays.xy_px)),
    )
    of_survey = np.array([point.cov_in_geo for point in surveyed])
    return _with_covariance(control, of_survey + _mark_covariance(scene, control))


def control_by_depth(scene: Scene, survey: Survey, marks: ControlTerm) -> tuple[ControlByDepth, ControlTerm]:
    """Return the marks for projection onto the rendered surface, and the control points with the surface's σ added.

    The surface's error has a σ of `SURFACE_SIGMA` times the distance, along each axis. All marks of a point share
    this error, because they show one piece of the surface.

    Args:
        scene: cameras at the start of the training.
        survey: has the control points.
        marks: of `control_term`.
    """
    order = torch.argsort(marks.camera, stable=True)
    point, camera = marks.point[order], marks.camera[order]
    center = torch.from_numpy(scene.geo_from_model.apply(scene.poses.cam_center_in_model))[camera]
    distance = (marks.position_in_geo[point] - center).norm(dim=1)
    surveyed = {each.name: np.array(each.cov_in_geo) for each in survey.control_points}
    covariance = torch.from_numpy(np.array([surveyed[name] for name in marks.point_id]))
    identity = torch.eye(3, dtype=torch.float64)
    lateral, surface = marks.sigma_rad[order] * distance, SURFACE_SIGMA * distance
    of_mark = covariance[point] + (lateral.square() + surface.square())[:, None, None] * identity
    bearing = marks.bearing_in_cam[order]
    count = torch.bincount(point, minlength=len(marks.position_in_geo))
    starts = {int(index): int(torch.searchsorted(camera, index)) for index in torch.unique(camera)}
    by_depth = ControlByDepth(
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
    return by_depth, _with_covariance(marks, all_in)


def _slopes(bearing: Tensor, by_lens: Tensor | None, order: Tensor) -> Tensor | None:
    """Return the derivatives (K, 2, L) of x/z and y/z by the lens.

    Args:
        bearing: (K, 3), already in `order`.
        by_lens: (K, 3, L) derivatives of the bearings, not yet in `order`.
        order: (K,) permutation.
    """
    if by_lens is None:
        return None
    by_lens, z = by_lens[order], bearing[:, 2:, None]
    return by_lens[:, :2] / z - bearing[:, :2, None] * by_lens[:, 2:] / z**2


def attitude_term(scene: Scene, survey: Survey) -> AttitudeTerm | None:
    """Return the recorded rotations of the training cameras that the SfM model does not contradict, or None."""
    recorded = recorded_rotations(survey, scene.sparse)
    mine = np.isin(recorded.image, scene.train)
    if not mine.any():
        return None
    return AttitudeTerm(
        torch.from_numpy(recorded.image[mine]),
        torch.from_numpy(recorded.geo_from_cam[mine]),
        torch.from_numpy(np.eye(3) / recorded.sigma_rad[mine, None, None]),
    )


def distance_term(scene: Scene, fixes: FixTerm, points: GeolocatedPoints | None, seed: int) -> DistanceTerm | None:
    """Return 300 long distances across the scene: between located points, else between cameras with fixes.

    Their information on the scale is limited to a tenth of that of the fixes (`scale_share`). None: that share is
    zero.

    Args:
        scene: cameras and points at the start of the training.
        fixes: of the training cameras.
        points: of `geolocate`; None: take the cameras.
        seed: of the random pairs.

    Raises:
        InputError: `points` belongs to another model.
    """
    distances = _pairs_of_points(scene, points, seed) if points is not None else None
    distances = _pairs_of_cameras(scene, fixes, seed) if distances is None else distances
    weight = (distances.distance_in_geo * distances.root_information[:, 0, 0]).square().sum()
    share = scale_share(_scale_information(fixes), float(weight))
    return replace(distances, share=share) if share > 0 else None


def scale_share(information_of_fixes: float, information_of_pairs: float) -> float:
    """Return the share of each pair that limits their information on the scale to a tenth of that of the fixes.

    Located points are functions of the same few fixes (`adjust.alignment`), and contain the lens's errors as well.
    Counted as independent measurements, hundreds of pairs would claim a σ of the scale many times below that of the
    fixes. They add no information of their own: their purpose is to steady the scale, not to decide it.

    Args:
        information_of_fixes: Σ |W (C_i − C̄)|², of ln s.
        information_of_pairs: Σ (distance/σ)², of ln s.
    """
    most = _WORTH * information_of_fixes
    return min(1.0, most / information_of_pairs) if information_of_pairs > 0 else 0.0


def _pairs_of_points(scene: Scene, points: GeolocatedPoints, seed: int) -> DistanceTerm | None:
    if not np.array_equal(points.point_id, scene.sparse.point_id):
        raise InputError("the geolocated points are of another model: run `georef geolocate` again")
    good = np.flatnonzero(points.inlier)
    if len(good) < 2:
        return None
    first, second = _long_pairs(scene.point_in_model[good], seed)
    i, j = good[first], good[second]
    apart = points.position_in_geo[i] - points.position_in_geo[j]
    inside = np.linalg.norm(scene.point_in_model[i] - scene.point_in_model[j], axis=1)
    return DistanceTerm(
        torch.from_numpy(inside), None, *_measured_distance(apart, points.cov_in_geo[i] + points.cov_in_geo[j]), 1.0
    )


def _pairs_of_cameras(scene: Scene, fixes: FixTerm, seed: int) -> DistanceTerm:
    camera, place = fixes.camera.numpy(), fixes.position_in_geo.numpy()
    i, j = _long_pairs(scene.poses.cam_center_in_model[camera], seed)
    root = fixes.root_information.numpy()
    covariance = np.linalg.inv(np.swapaxes(root, 1, 2) @ root)
    chosen = torch.from_numpy(np.column_stack([camera[i], camera[j]]))
    return DistanceTerm(None, chosen, *_measured_distance(place[i] - place[j], covariance[i] + covariance[j]), 1.0)


def _long_pairs(place: FloatArray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the row numbers (P,), (P,) of pairs of points (n, 3): the longest third of randomly drawn pairs."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, len(place), _DRAWN * _PAIRS)
    second = (first + rng.integers(1, len(place), len(first))) % len(place)
    length = np.linalg.norm(place[first] - place[second], axis=1)
    longest = np.sort(np.argsort(-length, kind="stable")[:_PAIRS])
    return first[longest], second[longest]


def _measured_distance(apart: FloatArray, covariance: FloatArray) -> tuple[Tensor, Tensor]:
    """Return the lengths (P,) of differences (P, 3), and their 1/σ (P, 1, 1)."""
    distance = np.linalg.norm(apart, axis=1)
    along = apart / distance[:, None]
    variance = np.einsum("pi,pij,pj->p", along, covariance, along)
    return torch.from_numpy(distance), torch.from_numpy(variance**-0.5)[:, None, None]


def _scale_information(fixes: FixTerm) -> float:
    """Return the information of the fixes on ln s: Σ |W (C − C̄)|² about their weighted mean."""
    root = fixes.root_information
    information = root.transpose(1, 2) @ root
    weight = information.diagonal(dim1=1, dim2=2).sum(dim=1)
    arm = fixes.position_in_geo - (weight @ fixes.position_in_geo) / weight.sum()
    return float((root @ arm[:, :, None]).square().sum())


def _with_covariance(marks: ControlTerm, covariance: FloatArray) -> ControlTerm:
    return replace(marks, root_information=torch.from_numpy(root_information(covariance)))


def _mark_covariance(scene: Scene, marks: ControlTerm) -> FloatArray:
    """Return the covariance (J, 3, 3) of each intersected point that the σ of its marks causes."""
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
    """Return W (N, 3, 3) with WᵀW = Σ⁻¹, from covariances Σ (N, 3, 3)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
