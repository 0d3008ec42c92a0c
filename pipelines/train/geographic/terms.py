"""Terms of the geographic losses as tensors: the adjustment's measurements, with gradients (GeoRefGS section 2.4).

`tensor_term` makes the tensors of a term of `adjust.terms`, which describes its residuals. L_rel, a function of
other measurements, and control points through the rendered depth exist in training alone.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust import terms as adjustment
from pipelines.adjust.state import SystematicErrors
from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray, IntArray
from pipelines.survey.adjustment import GeolocatedPoints
from pipelines.survey.scene import Scene
from pipelines.survey.survey import Survey
from pipelines.train.geographic.unknowns import Estimate, TensorSimilarity, exp_so3_tensor, log_so3_tensor

RecordT = TypeVar("RecordT")

# σ of the rendered surface at a mark, as a fraction of its distance: 12 cm at 60 m.
SURFACE_SIGMA = 2e-3
_WORTH = 0.1  # share of the fixes' information on the scale that the distances may repeat
_PAIRS = 300
# Candidates drawn for each pair in use. The longest are used, because short pairs hardly constrain the scale.
_DRAWN = 3


def moved_tensors(record: RecordT, move: Callable[[Tensor], Tensor]) -> RecordT:
    """Return a dataclass with every tensor replaced by `move` of it, e.g. for another device."""
    tensors = {
        field.name: move(getattr(record, field.name))
        for field in fields(record)  # type: ignore[arg-type]
        if isinstance(getattr(record, field.name), Tensor)
    }
    return replace(record, **tensors)  # type: ignore[type-var]


class TensorTerm(ABC):
    """M observations of one kind."""

    kind: ClassVar[str]  # name in losses and metrics
    dimension: ClassVar[int] = 3  # d, of a residual
    in_metres: ClassVar[bool] = True  # if so, plain mean squares need no whitening

    root_information: Tensor  # (M, d, d) float64, W with WᵀW = Σ⁻¹
    share: float = 1.0  # weight of each observation in the loss, 0 to 1

    @abstractmethod
    def residuals(self, at: Estimate) -> Tensor:
        """Return the residuals (M, d), predicted minus measured, in metres or radians."""

    def __len__(self) -> int:
        return len(self.root_information)

    def whitened(self, at: Estimate) -> Tensor:
        """Return the residuals (M, d) in units of their σ."""
        return (self.root_information @ self.residuals(at)[:, :, None])[:, :, 0]


@dataclass(frozen=True)
class FixTerm(TensorTerm):
    """L_abs, `adjust.terms.Fixes`, in float64; `shares` (F, B) as of its function of that name."""

    kind: ClassVar[str] = "absolute"

    camera: Tensor
    position_in_geo: Tensor
    root_information: Tensor
    shares: Tensor

    def residuals(self, at: Estimate) -> Tensor:
        predicted = at.geo_from_model.apply(at.center[self.camera]) + self.shares @ at.vector.view(-1, 3)
        arm = at.error("lever-arm")
        if arm is not None:
            predicted = predicted + at.geo_from_cam(self.camera) @ arm
        return predicted - self.position_in_geo


@dataclass(frozen=True)
class MarkedTensorTerm(TensorTerm):
    """Observations of J points that their marks place, `adjust.terms.MarkedTerm`, in float64; K marks in all."""

    per_observation: ClassVar[int] = 1

    point: Tensor
    camera: Tensor
    bearing_in_cam: Tensor
    sigma_rad: Tensor
    bearing_by_lens: Tensor

    def _intersected(self, at: Estimate) -> Tensor:
        """Return the points (J, 3) in `model` nearest to the rays of their marks."""
        bearing = self.bearing_in_cam
        if len(at.lens):
            bearing = torch.nn.functional.normalize(bearing + self.bearing_by_lens @ at.lens, dim=1)
        rotation, center = at.rotation[self.camera], at.center[self.camera]
        direction = (rotation.transpose(1, 2) @ bearing[:, :, None])[:, :, 0]
        projector = torch.eye(3, dtype=direction.dtype, device=direction.device) - (
            direction[:, :, None] * direction[:, None, :]
        )
        weight = 1.0 / self.sigma_rad**2
        point = torch.zeros(0)
        for _ in range(2):  # the first pass gives the distances, and so the weights
            normal = self._sum_by_point(weight[:, None, None] * projector)
            right = self._sum_by_point(weight[:, None, None] * (projector @ center[:, :, None]))
            point = torch.linalg.solve_ex(normal, right).result[:, :, 0]  # `solve` would wait for the device
            distance = (point[self.point] - center).norm(dim=1)
            weight = 1.0 / (self.sigma_rad * distance.detach()) ** 2
        return point

    def _sum_by_point(self, values: Tensor) -> Tensor:
        shape = (self.per_observation * len(self), *values.shape[1:])
        total = torch.zeros(shape, dtype=values.dtype, device=values.device)
        return total.index_add(0, self.point, values)


@dataclass(frozen=True)
class ControlTerm(MarkedTensorTerm):
    """L_gcp, `adjust.terms.ControlPoints`, in float64.

    The root information of control points through the rendered depth holds the surface's σ, too.
    """

    kind: ClassVar[str] = "control"

    position_in_geo: Tensor
    root_information: Tensor

    def residuals(self, at: Estimate) -> Tensor:
        missed = at.geo_from_model.apply(self._intersected(at)) - self.position_in_geo
        shift = at.error("earlier-date")
        return missed if shift is None else missed + shift


@dataclass(frozen=True)
class EarlierTerm(MarkedTensorTerm):
    """Points in common with an earlier date, `adjust.terms.EarlierPoints`, in float64."""

    kind: ClassVar[str] = "earlier"

    position_in_geo: Tensor
    root_information: Tensor

    def residuals(self, at: Estimate) -> Tensor:
        return at.geo_from_model.apply(self._intersected(at)) - self.position_in_geo


@dataclass(frozen=True)
class KnownDistanceTerm(MarkedTensorTerm):
    """`adjust.terms.Distances` in float64."""

    kind: ClassVar[str] = "distances"
    dimension: ClassVar[int] = 1
    per_observation: ClassVar[int] = 2

    distance_m: Tensor
    root_information: Tensor

    def residuals(self, at: Estimate) -> Tensor:
        place = at.geo_from_model.apply(self._intersected(at))
        length: Tensor = (place[::2] - place[1::2]).norm(dim=1)
        return (length - self.distance_m)[:, None]


@dataclass(frozen=True)
class AttitudeTerm(TensorTerm):
    """L_att, `adjust.terms.Attitudes`, in float64."""

    kind: ClassVar[str] = "attitude"
    in_metres: ClassVar[bool] = False

    camera: Tensor
    geo_from_cam: Tensor
    root_information: Tensor

    def residuals(self, at: Estimate) -> Tensor:
        turned, recorded = at.geo_from_cam(self.camera), self.geo_from_cam
        common, boresight = at.error("common"), at.error("boresight")
        if common is not None:
            turned = exp_so3_tensor(common) @ turned
        if boresight is not None:
            recorded = recorded @ exp_so3_tensor(boresight)
        return log_so3_tensor(turned.transpose(1, 2) @ recorded)


@dataclass(frozen=True)
class PlaneTerm(TensorTerm):
    """L_lidar, `adjust.terms.Planes`, in float64."""

    kind: ClassVar[str] = "lidar"
    dimension: ClassVar[int] = 1

    point_in_model: Tensor
    position_in_geo: Tensor
    normal_in_geo: Tensor
    root_information: Tensor

    def residuals(self, at: Estimate) -> Tensor:
        apart = at.geo_from_model.apply(self.point_in_model) - self.position_in_geo
        shift = at.error("lidar-shift")
        apart = apart if shift is None else apart + shift
        return (self.normal_in_geo * apart).sum(dim=1, keepdim=True)


@dataclass(frozen=True)
class LevelTerm(TensorTerm):
    """Upward direction of the whole, `adjust.terms.Level`, in float64."""

    kind: ClassVar[str] = "level"
    dimension: ClassVar[int] = 2
    in_metres: ClassVar[bool] = False

    up_in_model: Tensor
    axes_in_model: Tensor
    root_information: Tensor

    def residuals(self, at: Estimate) -> Tensor:
        solved = at.geo_from_model.rotation[2].expand_as(self.up_in_model)
        along = (self.up_in_model * solved).sum(dim=1)
        across = torch.linalg.cross(self.up_in_model, solved)
        turned: Tensor = (self.axes_in_model @ across[:, :, None])[:, :, 0]
        return 2.0 * turned / (1.0 + along)[:, None]


def tensor_term(term: adjustment.Term, errors: SystematicErrors) -> TensorTerm:
    """Return a term of the adjustment as tensors, given the systematic errors of its problem."""
    match term:
        case adjustment.Fixes():
            shares = torch.from_numpy(term.shares(errors))
            return FixTerm(**_tensors(term, "camera", "position_in_geo", "root_information"), shares=shares)
        case adjustment.ControlPoints():
            return ControlTerm(**_tensors(term, *(field.name for field in fields(ControlTerm))))
        case adjustment.EarlierPoints():
            return EarlierTerm(**_tensors(term, *(field.name for field in fields(EarlierTerm))))
        case adjustment.Distances():
            return KnownDistanceTerm(**_tensors(term, *(field.name for field in fields(KnownDistanceTerm))))
        case adjustment.Attitudes():
            return AttitudeTerm(**_tensors(term, *(field.name for field in fields(AttitudeTerm))))
        case adjustment.Level():
            return LevelTerm(**_tensors(term, *(field.name for field in fields(LevelTerm))))
        case adjustment.Planes():
            return PlaneTerm(**_tensors(term, *(field.name for field in fields(PlaneTerm))))
    raise TypeError(f"{term.kind} has no tensors")


def _tensors(term: adjustment.Term, *names: str) -> dict[str, Tensor]:
    return {name: torch.from_numpy(np.ascontiguousarray(getattr(term, name))) for name in names}


@dataclass(frozen=True)
class DistanceTerm(TensorTerm):
    """Distances between P pairs of intersected points, or of cameras with fixes: the term L_rel.

    The distances are functions of the fixes, not independent measurements.

    The points are fixed at their SfM positions. In the bundle, they would follow the corrections of the cameras.
    These corrections keep the points' mean position, rotation and size
    (`geometry.bundle.correction_basis`). Fixed points are therefore right to first order for the scale,
    the only quantity that the pairs determine.
    """

    kind: ClassVar[str] = "relative"
    dimension: ClassVar[int] = 1

    distance_in_model: Tensor | None  # (P,) float64; None: between the cameras below
    camera: Tensor | None  # (P, 2) int64 indices into the cameras; None: between fixed points
    distance_in_geo: Tensor  # (P,) float64 metres
    root_information: Tensor  # (P, 1, 1) float64, 1/σ of the measured distance in 1/m
    share: float = 1.0  # limits their information on the scale to a tenth of that of the fixes

    def residuals(self, at: Estimate) -> Tensor:
        """Return s |x_i − x_j| − |X_i − X_j| (P, 1) in metres."""
        if self.camera is None:
            assert self.distance_in_model is not None
            distance = self.distance_in_model
        else:
            distance = (at.center[self.camera[:, 0]] - at.center[self.camera[:, 1]]).norm(dim=1)
        return (at.geo_from_model.scale * distance - self.distance_in_geo)[:, None]


def distance_term(
    scene: Scene, fixes: adjustment.Fixes, points: GeolocatedPoints | None, seed: int
) -> DistanceTerm | None:
    """Return 300 long distances across the scene: between located points, else between cameras with fixes.

    Located points are functions of the same few fixes (`adjust.alignment`), and contain the lens's errors as well.
    Counted as independent measurements, hundreds of pairs would claim a σ of the scale many times below that of the
    fixes. Their purpose is to steady the scale, not to decide it. None: their share of the information is zero.

    There are at least two fixes; the seed is that of the pairs. An InputError: points of another model.
    """
    if points is not None and not np.array_equal(points.point_id, scene.sparse.point_id):
        raise InputError(
            "points-of-another-model",
            "The located points belong to another SfM model: run `georef geolocate` again.",
        )
    located = np.zeros(0, dtype=np.int64) if points is None else np.flatnonzero(points.inlier)
    if points is not None and len(located) >= 2:
        in_model, in_geo, cov_in_geo = scene.point_in_model, points.position_in_geo, points.cov_in_geo
        in_model, in_geo, cov_in_geo = in_model[located], in_geo[located], cov_in_geo[located]
        i, j = _long_pairs(in_model, seed)
        pairs, inside = None, torch.from_numpy(np.linalg.norm(in_model[i] - in_model[j], axis=1))
    else:
        in_geo, root = fixes.position_in_geo, fixes.root_information
        cov_in_geo = np.asarray(np.linalg.inv(np.swapaxes(root, 1, 2) @ root), dtype=np.float64)
        i, j = _long_pairs(scene.poses.cam_center_in_model[fixes.camera], seed)
        pairs, inside = torch.from_numpy(np.column_stack([fixes.camera[i], fixes.camera[j]])), None
    apart = in_geo[i] - in_geo[j]
    distance = np.linalg.norm(apart, axis=1)
    along = apart / distance[:, None]
    variance = np.einsum("pi,pij,pj->p", along, cov_in_geo[i] + cov_in_geo[j], along)
    root_information = torch.from_numpy(variance**-0.5)[:, None, None]
    distances = DistanceTerm(inside, pairs, torch.from_numpy(distance), root_information)
    of_pairs = float((distances.distance_in_geo * distances.root_information[:, 0, 0]).square().sum())
    root, place = fixes.root_information, fixes.position_in_geo
    weight = (root**2).sum(axis=(1, 2))
    arm = place - weight @ place / weight.sum()
    of_fixes = float(((root @ arm[:, :, None]) ** 2).sum())  # on ln s, about the weighted mean of the fixes
    share = min(1.0, _WORTH * of_fixes / of_pairs) if of_pairs > 0 else 0.0
    return replace(distances, share=share) if share > 0 else None


def _long_pairs(place: FloatArray, seed: int) -> tuple[IntArray, IntArray]:
    """Return the row numbers (P,), (P,) of pairs of points (n, 3): the longest third of randomly drawn pairs."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, len(place), _DRAWN * _PAIRS)
    second = (first + rng.integers(1, len(place), len(first))) % len(place)
    length = np.linalg.norm(place[first] - place[second], axis=1)
    longest = np.sort(np.argsort(-length, kind="stable")[:_PAIRS])
    return first[longest], second[longest]


@dataclass(frozen=True)
class ControlByDepth:
    """Image marks of the control points, K in all, each projected onto the rendered surface on its own."""

    camera: Tensor  # (K,) int64 indices
    xy: Tensor  # (K, 2) float64, x/z and y/z of the marks' rays
    xy_by_lens: Tensor  # (K, 2, L) float64, derivative of `xy` by the lens parameters
    position_in_geo: Tensor  # (K, 3) float64 metres, surveyed
    root_information: Tensor  # (K, 3, 3) float64 of survey, mark and surface together, in 1/m
    share: Tensor  # (K,) float64, one over the number of marks of the same point
    views: int  # training views, all rendered equally often
    rows: dict[int, slice]  # slice of the K marks, by camera

    def rays(self, rows: slice, lens: Tensor) -> Tensor:
        """Return the rays x/z and y/z (K', 2) of a slice of the marks, to first order in the lens change (L,)."""
        return self.xy[rows] + self.xy_by_lens[rows] @ lens if len(lens) else self.xy[rows]


def control_by_depth(
    scene: Scene, survey: Survey, marks: adjustment.ControlPoints
) -> tuple[ControlByDepth, adjustment.ControlPoints]:
    """Return the marks for projection onto the rendered surface, and the control points with the surface's σ added.

    The surface's error has a σ of `SURFACE_SIGMA` times the distance, along each axis. All marks of a point share
    this error, because they show one piece of the surface. Marks in test views are not rendered.
    """
    order = np.argsort(marks.camera, kind="stable")
    order = order[np.isin(marks.camera[order], scene.train)]
    point, camera, bearing = marks.point[order], marks.camera[order], marks.bearing_in_cam[order]
    center = scene.geo_from_model.apply(scene.poses.cam_center_in_model)[camera]
    distance = np.linalg.norm(marks.position_in_geo[point] - center, axis=1)
    surveyed = {each.name: np.array(each.cov_in_geo) for each in survey.control_points}
    lateral, surface = marks.sigma_rad[order] * distance, SURFACE_SIGMA * distance
    of_survey = np.array([surveyed[name] for name in marks.name])[point]
    of_mark = of_survey + (lateral**2 + surface**2)[:, None, None] * np.eye(3)
    by_lens, z = marks.bearing_by_lens[order], bearing[:, 2:, None]
    count = np.bincount(point, minlength=len(marks))
    seen = [np.searchsorted(camera, [index, index + 1]).tolist() for index in np.unique(camera)]
    by_depth = ControlByDepth(
        camera=torch.from_numpy(camera),
        xy=torch.from_numpy(bearing[:, :2] / bearing[:, 2:]),
        xy_by_lens=torch.from_numpy(by_lens[:, :2] / z - bearing[:, :2, None] * by_lens[:, 2:] / z**2),
        position_in_geo=torch.from_numpy(marks.position_in_geo[point]),
        root_information=torch.from_numpy(adjustment.root_information(of_mark)),
        share=torch.from_numpy(1.0 / count[point]),
        views=len(scene.train),
        rows={int(index): slice(*ends) for index, ends in zip(np.unique(camera), seen, strict=True)},
    )
    mean = np.bincount(point, surface**2, minlength=len(marks)) / np.maximum(count, 1)
    root = marks.root_information
    covariance = np.linalg.inv(np.swapaxes(root, 1, 2) @ root) + mean[:, None, None] * np.eye(3)
    return by_depth, replace(marks, root_information=adjustment.root_information(covariance))


def depth_residuals(
    pose: tuple[Tensor, Tensor],
    geo_from_model: TensorSimilarity,
    position_in_geo: Tensor,
    xy: Tensor,
    depth_m: Tensor,
) -> Tensor:
    """Return T(c_i + R_iᵀ z (x, y, 1)) − X_j (K, 3) in metres, of the K marks of one camera.

    T is `geo_from_model`; the pose has a rotation cam ← model (3, 3) and a centre (3,). Each mark has the surveyed
    position (K, 3), its ray x/z and y/z (K, 2), and the rendered depth (K,) along the camera's z axis.
    """
    rotation, center = pose
    ray = torch.nn.functional.pad(xy, (0, 1), value=1.0)
    point = center + (depth_m[:, None] * ray) @ rotation
    return geo_from_model.apply(point) - position_in_geo
