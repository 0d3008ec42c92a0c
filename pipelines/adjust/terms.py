"""Terms of the adjustment: measurements of one kind, with their residuals and derivatives (GeoRefGS section 2.4).

A term consists of the observations of one kind: residuals, their covariance, and their derivatives by the
cameras, the lens and the systematic errors. The similarity has no derivative of its own: the corrections of the
cameras contain it (`adjust.system`). A new kind of measurement is one subclass of `Term`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from pipelines.adjust.state import SystematicErrors
from pipelines.core.types import FloatArray, IntArray, Rows
from pipelines.geometry.intersection import NearestPoints, across_rays, nearest_points
from pipelines.geometry.rotations import exp_so3, log_so3, right_jacobian_inverse_so3, skew
from pipelines.geometry.similarity import Similarity, jacobian_at
from pipelines.geometry.statistics import root_information

_FIXED = 2e-6  # σ of what nothing measures in a local frame: of a rotation, and of a shift over the radius


@dataclass(frozen=True)
class At:
    """Estimate that measurements are compared with."""

    cam_from_model: FloatArray  # (n, 3, 3) corrected rotations
    center: FloatArray  # (n, 3) corrected projection centres in `model`
    geo_from_model: Similarity
    lens: FloatArray  # (L,) change of the lens
    errors: SystematicErrors
    vector: FloatArray  # (p,) values of the systematic errors
    turn_by_correction: FloatArray  # (n, 3, 3) change of the rotation Exp(δω) by δω: its right Jacobian

    def geo_from_cam(self, camera: IntArray) -> FloatArray:
        """Return the rotations geo ← cam (K, 3, 3) of cameras (K,)."""
        return self.geo_from_model.rotation @ np.swapaxes(self.cam_from_model[camera], 1, 2)


@dataclass(frozen=True)
class Slopes:
    """Residuals of M observations near a state, and their derivatives."""

    residual: FloatArray  # (M, d), predicted minus measured, in metres or radians
    row: IntArray  # (E,) observation of each block
    camera: IntArray  # (E,) camera of each block
    by_pose: FloatArray  # (E, d, 6) by the corrections (δω, δc) of that camera
    by_lens: FloatArray  # (M, d, L)
    by_errors: FloatArray  # (M, d, p)
    # (M, d, 7) by the mean similarity, in `model`, of the points that follow the cameras; None: the observations do
    # not depend on these points
    by_similarity: FloatArray | None = None


class Term(Rows, ABC):
    """M observations of one kind."""

    kind: ClassVar[str]  # name in normal equations, tests and products
    dimension: ClassVar[int] = 3  # d, of a residual
    cov: FloatArray  # (M, d, d), Σ of the observations

    @cached_property
    def root_information(self) -> FloatArray:
        """W (M, d, d) with WᵀW = Σ⁻¹, which whitens the residuals."""
        return root_information(self.cov)

    @abstractmethod
    def residuals(self, at: At) -> FloatArray:
        """Return the residuals (M, d), predicted minus measured, in metres or radians."""

    @abstractmethod
    def slopes(self, at: At) -> Slopes:
        """Return the residuals with their derivatives."""

    def whitened(self, at: At) -> FloatArray:
        """Return the residuals (M, d) in units of their σ."""
        return (self.root_information @ self.residuals(at)[:, :, None])[:, :, 0]


@dataclass(frozen=True)
class Fixes(Term):
    """Measured positions of F cameras: the term L_abs."""

    kind: ClassVar[str] = "fixes"

    name: tuple[str, ...]
    camera: IntArray  # (F,) index into the cameras
    position_in_geo: FloatArray  # (F, 3) metres
    cov: FloatArray  # (F, 3, 3) m², of the fixes' own errors
    session: IntArray  # (F,) session of each fix, whose common error they share
    # (F, K) shapes in time of the drift of each session, for a factor of 1; without drift it is not read
    drift: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def shares(self, errors: SystematicErrors) -> FloatArray:
        """Return how far each fix has each systematic error (F, B).

        Its session's bias, shapes of its drift, and the place of the earlier date.
        """
        shares = np.zeros((len(self), len(errors.blocks)))
        for column, block in enumerate(errors.blocks):
            if block.name == "bias":
                shares[:, column] = self.session == block.session
            elif block.name == "drift" and block.mode is not None:
                shares[:, column] = np.where(self.session == block.session, self.drift[:, block.mode], 0.0)
            elif block.name == "earlier-date":
                shares[:, column] = 1.0
        return shares

    def residuals(self, at: At) -> FloatArray:
        """Return S(c_i) + lever arm + bias + drift − C_i (F, 3) in metres."""
        predicted = at.geo_from_model.apply(at.center[self.camera])
        arm = at.errors.value(at.vector, "lever-arm")
        if arm is not None:
            predicted = predicted + at.geo_from_cam(self.camera) @ arm
        if len(at.errors):
            predicted = predicted + self.shares(at.errors) @ at.vector.reshape(-1, 3)
        return predicted - self.position_in_geo

    def slopes(self, at: At) -> Slopes:
        count, similarity = len(self), at.geo_from_model
        by_pose = np.zeros((count, 3, 6))
        by_pose[:, :, 3:] = similarity.scale * similarity.rotation
        by_errors = np.einsum("fb,ij->fibj", self.shares(at.errors), np.eye(3)).reshape(count, 3, len(at.vector))
        arm, columns = at.errors.value(at.vector, "lever-arm"), at.errors.columns("lever-arm")
        if arm is not None and columns is not None:
            in_model = np.swapaxes(at.cam_from_model[self.camera], 1, 2) @ arm
            turned = similarity.rotation @ -skew(in_model)
            by_pose[:, :, :3] = turned @ at.turn_by_correction[self.camera]
            by_errors[:, :, columns] = at.geo_from_cam(self.camera)
        no_lens = np.zeros((count, 3, len(at.lens)))
        return Slopes(self.residuals(at), np.arange(count), self.camera, by_pose, no_lens, by_errors)


@dataclass(frozen=True)
class MarkedTerm(Term):
    """Observations of J points that are the intersections of their image marks, K in all."""

    per_observation: ClassVar[int] = 1  # points, in their order

    name: tuple[str, ...]
    point: IntArray  # (K,) index into the points
    camera: IntArray  # (K,) index into the cameras
    bearing_in_cam: FloatArray  # (K, 3) unit vectors
    sigma_rad: FloatArray  # (K,) angular σ of a mark
    bearing_by_lens: FloatArray  # (K, 3, L) derivative of the bearings by the lens parameters

    def places(self, at: At) -> FloatArray:
        """Return the points (J, 3) in metres of geo."""
        return at.geo_from_model.apply(self._intersected(at)[0].position)

    def place_slopes(self, at: At) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the points (J, 3) in geo, and derivatives (K, 3, 6) by each mark's pose and (K, 3, L) by the lens.

        A point's derivative by the lens is the sum over its marks.
        """
        met, bearing_scale = self._intersected(at)
        by_center, by_direction = met.derivatives()
        to_geo = at.geo_from_model.scale * at.geo_from_model.rotation
        by_turn = by_direction @ -skew(met.direction) @ at.turn_by_correction[self.camera]
        by_pose = to_geo @ np.concatenate([by_turn, by_center], axis=2)
        by_lens = np.zeros((len(self.point), 3, len(at.lens)))
        if len(at.lens):
            turn = np.swapaxes(at.cam_from_model[self.camera], 1, 2)
            by_bearing = to_geo @ by_direction @ across_rays(met.direction) @ turn
            by_lens = by_bearing @ self.bearing_by_lens / bearing_scale[:, None, None]
        return at.geo_from_model.apply(met.position), by_pose, by_lens

    def _intersected(self, at: At) -> tuple[NearestPoints, FloatArray]:
        """Return the points in `model` nearest to their rays, and the lengths (K,) of unnormalised bearings."""
        bearing = self.bearing_in_cam
        if len(at.lens):
            bearing = bearing + self.bearing_by_lens @ at.lens
        length = np.linalg.norm(bearing, axis=1)
        direction = np.einsum("kji,kj->ki", at.cam_from_model[self.camera], bearing / length[:, None])
        center, count = at.center[self.camera], self.per_observation * len(self)
        return nearest_points(self.point, center, direction, self.sigma_rad, count), length


@dataclass(frozen=True)
class ControlPoints(MarkedTerm):
    """Control points against the intersections of their image marks: the term L_gcp."""

    kind: ClassVar[str] = "control points"

    position_in_geo: FloatArray  # (J, 3) metres, surveyed
    cov: FloatArray  # (J, 3, 3) m², of survey and intersection together

    def residuals(self, at: At) -> FloatArray:
        """Return S(x_j) + v − X_j (J, 3) in metres, with x_j the intersection of the marks of point j.

        v is the error of the earlier date, if the survey is tied to one.
        """
        return self._missed(self.places(at), at)

    def slopes(self, at: At) -> Slopes:
        point_in_geo, by_pose, by_lens_of_mark = self.place_slopes(at)
        by_lens = np.zeros((len(self), 3, len(at.lens)))
        np.add.at(by_lens, self.point, by_lens_of_mark)
        by_errors = np.zeros((len(self), 3, len(at.vector)))
        if (columns := at.errors.columns("earlier-date")) is not None:
            by_errors[:, :, columns] = np.eye(3)
        return Slopes(self._missed(point_in_geo, at), self.point, self.camera, by_pose, by_lens, by_errors)

    def _missed(self, point_in_geo: FloatArray, at: At) -> FloatArray:
        shift = at.errors.value(at.vector, "earlier-date")
        return point_in_geo - self.position_in_geo + (0.0 if shift is None else shift)


@dataclass(frozen=True)
class EarlierPoints(MarkedTerm):
    """Points in common with an earlier date, against their places in its solution.

    The cameras of the earlier date stay as they were solved, as do the files made from them: the later date is
    adjusted onto them. What of their error the difference of both dates contains is a matter of `adjust.relative`.
    """

    kind: ClassVar[str] = "common points"

    position_in_geo: FloatArray  # (J, 3) metres, by the earlier solution
    cov: FloatArray  # (J, 3, 3) m², of the marks of both dates together

    def residuals(self, at: At) -> FloatArray:
        """Return S(x_j) − X_j (J, 3) in metres, with x_j the intersection of the track of point j."""
        return self.places(at) - self.position_in_geo

    def slopes(self, at: At) -> Slopes:
        point_in_geo, by_pose, by_lens_of_mark = self.place_slopes(at)
        by_lens = np.zeros((len(self), 3, len(at.lens)))
        np.add.at(by_lens, self.point, by_lens_of_mark)
        by_errors = np.zeros((len(self), 3, len(at.vector)))
        return Slopes(point_in_geo - self.position_in_geo, self.point, self.camera, by_pose, by_lens, by_errors)


@dataclass(frozen=True)
class Distances(MarkedTerm):
    """Measured distances between marked points, such as of scale bars: D, between points 2 i and 2 i + 1."""

    kind: ClassVar[str] = "distances"
    dimension: ClassVar[int] = 1
    per_observation: ClassVar[int] = 2

    distance_m: FloatArray  # (D,) measured
    cov: FloatArray  # (D, 1, 1) m², of measurement and intersections together

    def residuals(self, at: At) -> FloatArray:
        """Return |S(x_a) − S(x_b)| − d (D, 1) in metres."""
        return self.compared(self.places(at))[0]

    def slopes(self, at: At) -> Slopes:
        point_in_geo, by_pose, by_lens_of_mark = self.place_slopes(at)
        residual, along = self.compared(point_in_geo)
        row, sign = np.divmod(self.point, 2)
        onto = (np.where(sign == 0, 1.0, -1.0)[:, None] * along[row])[:, None, :]
        by_lens = np.zeros((len(self), 1, len(at.lens)))
        np.add.at(by_lens, row, onto @ by_lens_of_mark)
        by_errors = np.zeros((len(self), 1, len(at.vector)))
        return Slopes(residual, row, self.camera, onto @ by_pose, by_lens, by_errors)

    def compared(self, point_in_geo: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (D, 1) of points (2 D, 3), and the unit vectors (D, 3) between them."""
        apart = point_in_geo[::2] - point_in_geo[1::2]
        length = np.linalg.norm(apart, axis=1, keepdims=True)
        return length - self.distance_m[:, None], apart / length


@dataclass(frozen=True)
class Attitudes(Term):
    """Recorded rotations of A cameras: the term L_att."""

    kind: ClassVar[str] = "attitudes"

    name: tuple[str, ...]
    camera: IntArray  # (A,) index into the cameras
    geo_from_cam: FloatArray  # (A, 3, 3), of the nominal camera axes
    cov: FloatArray  # (A, 3, 3) rad²

    def residuals(self, at: At) -> FloatArray:
        """Return Log(R_iᵀ G_i B) (A, 3) in radians, from a camera to its recorded axes, with the boresight B."""
        turned, recorded, _, _ = self._compared(at)
        return np.asarray(log_so3(np.swapaxes(turned, 1, 2) @ recorded))

    def slopes(self, at: At) -> Slopes:
        turned, _, common, boresight = self._compared(at)
        residual = self.residuals(at)
        by_right = right_jacobian_inverse_so3(residual)
        by_left = right_jacobian_inverse_so3(-residual)
        by_pose = np.zeros((len(self), 3, 6))
        by_pose[:, :, :3] = -by_left @ at.cam_from_model[self.camera] @ at.turn_by_correction[self.camera]
        by_errors = np.zeros((len(self), 3, len(at.vector)))
        vectors = np.stack([-common, boresight])
        of_common, of_boresight = np.linalg.inv(right_jacobian_inverse_so3(vectors))  # right Jacobians of Exp
        if (columns := at.errors.columns("common")) is not None:
            by_errors[:, :, columns] = -by_left @ np.swapaxes(turned, 1, 2) @ of_common
        if (columns := at.errors.columns("boresight")) is not None:
            by_errors[:, :, columns] = by_right @ of_boresight
        no_lens = np.zeros((len(self), 3, len(at.lens)))
        return Slopes(residual, np.arange(len(self)), self.camera, by_pose, no_lens, by_errors)

    def _compared(self, at: At) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the cameras' and the recorded rotations (A, 3, 3), the common and the boresight error (3,)."""
        common, boresight = (at.errors.value(at.vector, name) for name in ("common", "boresight"))
        common = np.zeros(3) if common is None else common
        boresight = np.zeros(3) if boresight is None else boresight
        turned = exp_so3(common) @ at.geo_from_cam(self.camera)
        return turned, self.geo_from_cam @ exp_so3(boresight), common, boresight


@dataclass(frozen=True)
class Planes(Term):
    """Planes of a LiDAR against the surface that the photographs show: the term L_lidar.

    The LiDAR may be shifted as a whole: that shift is a systematic error. The surface moves with the mean of the
    SfM points.
    """

    kind: ClassVar[str] = "lidar"
    dimension: ClassVar[int] = 1

    point_in_model: FloatArray  # (M, 3) metres, on the surface of the photographs
    position_in_geo: FloatArray  # (M, 3) metres, on the plane of the LiDAR
    normal_in_geo: FloatArray  # (M, 3) unit normals of the planes
    cov: FloatArray  # (M, 1, 1) m², of the distance between both along the normal

    def residuals(self, at: At) -> FloatArray:
        """Return n · (S(x) + shift − p) (M, 1) in metres."""
        apart = at.geo_from_model.apply(self.point_in_model) - self.position_in_geo
        shift = at.errors.value(at.vector, "lidar-shift")
        apart = apart if shift is None else apart + shift
        return np.asarray((self.normal_in_geo * apart).sum(axis=1, keepdims=True))

    def slopes(self, at: At) -> Slopes:
        similarity, normal = at.geo_from_model, self.normal_in_geo[:, None, :]
        moved = jacobian_at(self.point_in_model, at.center.mean(axis=0))
        by_errors = np.zeros((len(self), 1, len(at.vector)))
        if (columns := at.errors.columns("lidar-shift")) is not None:
            by_errors[:, :, columns] = normal
        none = np.zeros(0, dtype=np.int64)
        return Slopes(
            self.residuals(at),
            none,
            none,
            np.zeros((0, 1, 6)),
            np.zeros((len(self), 1, len(at.lens))),
            by_errors,
            similarity.scale * normal @ similarity.rotation @ moved,
        )


@dataclass(frozen=True)
class Level(Term):
    """Upward direction of the whole, from what is known of the photographs (`adjust.level`): one row.

    Its heading is open. The scene turns with the mean of the SfM points.
    """

    kind: ClassVar[str] = "level"
    dimension: ClassVar[int] = 2

    up_in_model: FloatArray  # (1, 3) unit vector
    axes_in_model: FloatArray  # (1, 2, 3) unit vectors square to it, about which it turns
    cov: FloatArray  # (1, 2, 2) rad²

    def residuals(self, at: At) -> FloatArray:
        """Return 2 tan(θ/2) (1, 2) along the axes, θ being the turn from the known to the solved vertical."""
        return self._compared(at)[0]

    def slopes(self, at: At) -> Slopes:
        residual, across, solved, along = self._compared(at)
        known = self.up_in_model
        # A rotation δω of the whole turns the solved vertical v, seen in `model`, by −δω × v.
        by_cross = self.axes_in_model @ (
            -(along[:, None, None] * np.eye(3)) + solved[:, :, None] * known[:, None, :]
        )
        scale = 2.0 / (1.0 + along)[:, None, None]
        by_turn = scale * by_cross - residual[:, :, None] * (scale[:, 0] / 2 * across)[:, None, :]
        none = np.zeros(0, dtype=np.int64)
        by_similarity = np.zeros((1, 2, 7))
        by_similarity[:, :, 1:4] = by_turn
        return Slopes(
            residual,
            none,
            none,
            np.zeros((0, 2, 6)),
            np.zeros((1, 2, len(at.lens))),
            np.zeros((1, 2, len(at.vector))),
            by_similarity,
        )

    def _compared(self, at: At) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return residual (1, 2), cross product (1, 3) and solved vertical (1, 3) in `model`, cosine (1,)."""
        solved = at.geo_from_model.rotation[2][None, :]
        across = np.cross(self.up_in_model, solved)
        along = np.maximum((self.up_in_model * solved).sum(axis=1), -1.0 + 1e-9)
        turned = np.einsum("mak,mk->ma", self.axes_in_model, across)
        return 2.0 * turned / (1.0 + along)[:, None], across, solved, along


@dataclass(frozen=True)
class CommonErrors(Term):
    """Prior of the systematic errors as measurements of the value zero: the surplus of a wrong one is rejected.

    One error that every fix of a session shares may be far larger than its σ says: a base station on wrong
    coordinates. Cauchy's kernel then sets the prior aside, as it does with a bad fix.
    """

    kind: ClassVar[str] = "systematic errors"

    cov: FloatArray  # (B, 3, 3) m² or rad², by block

    def residuals(self, at: At) -> FloatArray:
        return at.vector.reshape(-1, 3)

    def slopes(self, at: At) -> Slopes:
        count, none = len(self), np.zeros(0, dtype=np.int64)
        by_errors = np.eye(3 * count).reshape(count, 3, 3 * count)
        no_lens = np.zeros((count, 3, len(at.lens)))
        return Slopes(self.residuals(at), none, none, np.zeros((0, 3, 6)), no_lens, by_errors)


@dataclass(frozen=True)
class LocalFrame(Term):
    """Gauge of a survey without a place on Earth: two rows, rotation and shift of the mean of the SfM points.

    Nothing measures them: their residuals are zero at every state, so that the adjustment leaves them as they are,
    and covariances are relative to the frame of the mean (inner constraints).
    """

    kind: ClassVar[str] = "local frame"

    cov: FloatArray  # (2, 3, 3), rad² and m²

    @classmethod
    def fixed(cls, radius_m: float) -> LocalFrame:
        """Return the frame of cameras within a radius, fixed with σ below those of measurements, above rounding."""
        return cls(np.square(_FIXED * np.array([1.0, radius_m]))[:, None, None] * np.eye(3))

    def residuals(self, at: At) -> FloatArray:
        return np.zeros((2, 3))

    def slopes(self, at: At) -> Slopes:
        none, turn = np.zeros(0, dtype=np.int64), at.geo_from_model.rotation
        by_similarity = np.zeros((2, 3, 7))
        by_similarity[0, :, 1:4], by_similarity[1, :, 4:] = turn, at.geo_from_model.scale * turn
        no_lens, no_errors = np.zeros((2, 3, len(at.lens))), np.zeros((2, 3, len(at.vector)))
        return Slopes(self.residuals(at), none, none, np.zeros((0, 3, 6)), no_lens, no_errors, by_similarity)
