"""Terms of the adjustment (GeoRefGS section 2.4, doi 10.3390/drones10030195), in float64.

A term consists of the observations of one kind: residuals against an estimate, their root information, and their
share in the loss. A new kind of measurement is one subclass of `Term`; no other code depends on the kinds.

The residuals are whitened by their covariance: each term is half of a χ², and the whole a maximum a posteriori
estimate. `paper` takes plain mean squares in metres instead. A Cauchy kernel bounds the effect of one bad fix.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import ClassVar, Literal, TypeVar

import torch
from torch import Tensor

from pipelines.adjust.estimate import Estimate
from pipelines.adjust.so3 import exp_so3, log_so3
from pipelines.robust.kernels import CAUCHY_SCALE2

RecordT = TypeVar("RecordT")
Weighting = Literal["whitened", "paper"]


def cauchy(chi2: Tensor, dimension: int) -> Tensor:
    """Return Cauchy's ρ (N,) of squared whitened residuals (N,) of a dimension: c² ln(1 + χ²/c²)."""
    scale2 = CAUCHY_SCALE2[dimension]
    return scale2 * torch.log1p(chi2 / scale2)


def moved_tensors(record: RecordT, move: Callable[[Tensor], Tensor]) -> RecordT:
    """Return a dataclass with every tensor replaced by `move` of it, e.g. for another device."""
    tensors = {
        field.name: move(getattr(record, field.name))
        for field in fields(record)  # type: ignore[arg-type]
        if isinstance(getattr(record, field.name), Tensor)
    }
    return replace(record, **tensors)  # type: ignore[type-var]


class Term(ABC):
    """M observations of one kind.

    Attributes:
        kind: name in losses, metrics and normal equations.
        dimension: d, of a residual.
        measures: whether the observations are independent measurements. A term that is a function of others
            steadies the training, and is not part of the posterior.
        in_metres: whether the residuals are lengths, which plain mean squares need no whitening for.
        root_information: (M, d, d) float64, W with WᵀW = Σ⁻¹.
        share: weight of each observation in the loss, 0 to 1.
    """

    kind: ClassVar[str]
    dimension: ClassVar[int] = 3
    measures: ClassVar[bool] = True
    in_metres: ClassVar[bool] = True

    root_information: Tensor
    share: float = 1.0

    @abstractmethod
    def residuals(self, at: Estimate) -> Tensor:
        """Return the residuals (M, d), predicted minus measured, in metres or radians."""

    @abstractmethod
    def incidence(self) -> tuple[Tensor, Tensor]:
        """Return the observations (E,) and the cameras (E,) whose poses affect them, both int64."""

    def __len__(self) -> int:
        return len(self.root_information)

    def whitened(self, at: Estimate) -> Tensor:
        """Return the residuals (M, d) in units of their σ."""
        return (self.root_information @ self.residuals(at)[:, :, None])[:, :, 0]


@dataclass(frozen=True)
class FixTerm(Term):
    """Measured positions of F training cameras: the term L_abs.

    Attributes:
        camera: (F,) int64 index into the cameras.
        position_in_geo: (F, 3) float64 metres.
        root_information: (F, 3, 3) float64, in 1/m.
        flight: (F,) int64, flight of each fix; None: all in one.
    """

    kind: ClassVar[str] = "absolute"

    camera: Tensor
    position_in_geo: Tensor
    root_information: Tensor
    flight: Tensor | None = None

    def incidence(self) -> tuple[Tensor, Tensor]:
        """Return one camera for each observation."""
        return torch.arange(len(self), device=self.camera.device), self.camera

    def residuals(self, at: Estimate) -> Tensor:
        """Return T(c_i) + lever arm + bias − C_i (F, 3) in metres."""
        predicted = at.geo_from_model.apply(at.center[self.camera])
        if at.errors.arm_m is not None:
            predicted = predicted + at.geo_from_cam(self.camera) @ at.errors.arm_m
        if at.errors.bias_m is not None:
            predicted = predicted + (at.errors.bias_m[0] if self.flight is None else at.errors.bias_m[self.flight])
        return predicted - self.position_in_geo


@dataclass(frozen=True)
class ControlTerm(Term):
    """Control points against the intersections of their image marks: the term L_gcp; J points, K marks in all.

    Attributes:
        point: (K,) int64 index into the points.
        camera: (K,) int64 index into the cameras.
        bearing_in_cam: (K, 3) float64 unit vectors.
        sigma_rad: (K,) float64 angular σ of a mark.
        position_in_geo: (J, 3) float64 metres, surveyed.
        root_information: (J, 3, 3) float64 of survey and intersection together, in 1/m; for control points through
            the rendered depth, of the surface too.
        point_id: of the points (J), as in the survey.
        bearing_by_lens: (K, 3, L) float64, derivative of the bearings by the lens parameters, in the order of
            `geometry.lens.Lenses`; None: the lens of the bearings is exact.
    """

    kind: ClassVar[str] = "control"

    point: Tensor
    camera: Tensor
    bearing_in_cam: Tensor
    sigma_rad: Tensor
    position_in_geo: Tensor
    root_information: Tensor
    point_id: tuple[str, ...] = ()
    bearing_by_lens: Tensor | None = None

    def incidence(self) -> tuple[Tensor, Tensor]:
        """Return point and camera of each mark."""
        return self.point, self.camera

    def residuals(self, at: Estimate) -> Tensor:
        """Return T(x_j) − X_j (J, 3) in metres, with x_j the intersection of the marks of point j."""
        return at.geo_from_model.apply(self.intersected(at)) - self.position_in_geo

    def bearings(self, lens: Tensor) -> Tensor:
        """Return the unit vectors (K, 3) of the marks, to first order in the lens change (L,); L = 0: none."""
        if self.bearing_by_lens is None or not len(lens):
            return self.bearing_in_cam
        return torch.nn.functional.normalize(self.bearing_in_cam + self.bearing_by_lens @ lens, dim=1)

    def intersected(self, at: Estimate) -> Tensor:
        """Return the points (J, 3) in `model` nearest to the rays of their marks, differentiable.

        The rays are weighted by their inverse lateral variance at the point, (angular σ × distance)⁻²; GeoRefGS
        eqs 4–8. The derivative reaches cameras and lens.
        """
        rotation, center = at.rotation[self.camera], at.center[self.camera]
        direction = (rotation.transpose(1, 2) @ self.bearings(at.lens)[:, :, None])[:, :, 0]
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
            weight = 1.0 / (self.sigma_rad * distance) ** 2
        return point

    def _sum_by_point(self, values: Tensor) -> Tensor:
        total = torch.zeros((len(self), *values.shape[1:]), dtype=values.dtype, device=values.device)
        return total.index_add(0, self.point, values)


@dataclass(frozen=True)
class AttitudeTerm(Term):
    """Recorded rotations of A training cameras: the term L_att.

    Attributes:
        camera: (A,) int64 index into the cameras.
        geo_from_cam: (A, 3, 3) float64, of the nominal camera axes.
        root_information: (A, 3, 3) float64, in 1/rad.
    """

    kind: ClassVar[str] = "attitude"
    in_metres: ClassVar[bool] = False

    camera: Tensor
    geo_from_cam: Tensor
    root_information: Tensor

    def incidence(self) -> tuple[Tensor, Tensor]:
        """Return one camera for each observation."""
        return torch.arange(len(self), device=self.camera.device), self.camera

    def residuals(self, at: Estimate) -> Tensor:
        """Return Log(R_iᵀ G_i B) (A, 3) in radians, from a camera to its recorded axes, with the boresight B."""
        turned = at.geo_from_cam(self.camera)
        recorded = self.geo_from_cam
        if at.errors.common_rad is not None:
            turned = exp_so3(at.errors.common_rad) @ turned
        if at.errors.boresight_rad is not None:
            recorded = recorded @ exp_so3(at.errors.boresight_rad)
        return log_so3(turned.transpose(1, 2) @ recorded)


@dataclass(frozen=True)
class PlaneTerm(Term):
    """Planes of a LiDAR against the surface that the photographs show: the term L_lidar.

    The LiDAR may be shifted as a whole: that shift is a constant error.

    Attributes:
        point_in_model: (M, 3) float64 metres, on the surface of the photographs.
        position_in_geo: (M, 3) float64 metres, on the plane of the LiDAR.
        normal_in_geo: (M, 3) float64 unit normals of the planes.
        root_information: (M, 1, 1) float64, in 1/m, of the distance between both along the normal.
    """

    kind: ClassVar[str] = "lidar"
    dimension: ClassVar[int] = 1

    point_in_model: Tensor
    position_in_geo: Tensor
    normal_in_geo: Tensor
    root_information: Tensor

    def incidence(self) -> tuple[Tensor, Tensor]:
        """Return no pair: the surface of the photographs stays where it is in `model`."""
        none = torch.zeros(0, dtype=torch.int64, device=self.position_in_geo.device)
        return none, none

    def residuals(self, at: Estimate) -> Tensor:
        """Return n · (T(x) + shift − p) (M, 1) in metres."""
        apart = at.geo_from_model.apply(self.point_in_model) - self.position_in_geo
        if at.errors.lidar_m is not None:
            apart = apart + at.errors.lidar_m
        return (self.normal_in_geo * apart).sum(dim=1, keepdim=True)


@dataclass(frozen=True)
class DistanceTerm(Term):
    """Distances between P pairs of geolocated points, or of cameras with fixes: the term L_rel.

    The distances are functions of the fixes, not independent measurements.

    The points are fixed at their SfM positions. In the bundle, they would follow the corrections of the cameras.
    These corrections keep the points' mean position, rotation and size
    (`geometry.correction_basis.correction_basis`). Fixed points are therefore right to first order for the scale,
    the only quantity that the pairs determine.

    Attributes:
        distance_in_model: (P,) float64; None: between the cameras below.
        camera: (P, 2) int64 indices into the cameras; None: between fixed points of the scene.
        distance_in_geo: (P,) float64 metres.
        root_information: (P, 1, 1) float64, 1/σ of the measured distance in 1/m.
        share: see `adjust.measurements.scale_share`.
    """

    kind: ClassVar[str] = "relative"
    dimension: ClassVar[int] = 1
    measures: ClassVar[bool] = False

    distance_in_model: Tensor | None
    camera: Tensor | None
    distance_in_geo: Tensor
    root_information: Tensor
    share: float = 1.0

    def incidence(self) -> tuple[Tensor, Tensor]:
        """Return both cameras of each pair; none for fixed points."""
        camera = self.distance_in_geo.new_zeros((0, 2), dtype=torch.int64) if self.camera is None else self.camera
        return torch.arange(len(camera), device=camera.device).repeat_interleave(2), camera.flatten()

    def residuals(self, at: Estimate) -> Tensor:
        """Return s |x_i − x_j| − |X_i − X_j| (P, 1) in metres."""
        if self.camera is None:
            assert self.distance_in_model is not None
            distance = self.distance_in_model
        else:
            distance = (at.center[self.camera[:, 0]] - at.center[self.camera[:, 1]]).norm(dim=1)
        return (at.geo_from_model.scale * distance - self.distance_in_geo)[:, None]
