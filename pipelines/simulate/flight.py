"""Flights: position and attitude of the camera at any time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.rotations import ENU_FROM_NED, geo_from_cam

START_NS = 1_700_000_000_000_000_000  # 2023-11-14 22:13:20 UTC
LEAD_S = 1.0  # time that the sensors run before the first and after the last photograph
_LOOK_AT_M = 6.0
_SPEED_M_S = 8.0
DEFAULT_HEIGHTS_M = {"orbit": (60.0,), "grid": (70.0,), "facade": (7.0, 15.0)}
DEFAULT_RADIUS_M = {"orbit": 85.0, "grid": 60.0, "facade": 19.0}


@dataclass(frozen=True)
class FlightPlan:
    """Plan of a flight.

    Attributes:
        kind: "orbit", "grid" or "facade".
        interval_s: time between photographs; None for 2 s, or more where the aircraft would be faster than 8 m/s.
        heights_m: above the origin, one round each.
        radius_m: radius, half side, or distance from the facade.
    """

    kind: str
    images: int
    interval_s: float | None
    heights_m: tuple[float, ...]
    radius_m: float


@dataclass(frozen=True)
class TrueTrajectory:
    """True motion of the camera. Times are seconds of the camera's clock since the first photograph.

    Attributes:
        photo_s: (N,) times of the photographs.
        cam_from_body: (3, 3) nominal mounting: body axes (forward, right, down) → camera.
        position: camera centres (N, 3) in geo at times (N,); its second derivative is the acceleration in m/s².
    """

    photo_s: FloatArray
    cam_from_body: FloatArray
    position: CubicSpline
    _angles: PchipInterpolator

    @property
    def stamp_ns(self) -> IntArray:
        """Stamps (N,) of the photographs on the camera's clock."""
        return START_NS + np.round(self.photo_s * 1e9).astype(np.int64)

    def geo_from_nominal_cam(self, time_s: ArrayLike) -> FloatArray:
        """Return rotations (N, 3, 3) camera → geo of a camera that is mounted exactly as planned."""
        return geo_from_cam(self._angles(time_s))

    def geo_from_body(self, time_s: ArrayLike) -> FloatArray:
        """Return rotations (N, 3, 3) body → geo of the body (forward, right, down)."""
        return self.geo_from_nominal_cam(time_s) @ self.cam_from_body


def make_trajectory(
    plan: FlightPlan, complex_m: tuple[float, float], axes: FloatArray, rng: np.random.Generator
) -> TrueTrajectory:
    """Return the motion of a flight over a scene, with the wobble of an aircraft.

    Args:
        plan: of the flight.
        complex_m: half lengths of the complex in the middle.
        axes: (3, 3) rows: the town's axes in geo.
        rng: of the wobble.
    """
    index = np.arange(-1.0, plan.images + 1)
    if plan.kind == "orbit":
        positions, angles = _orbit(plan, index)
    elif plan.kind == "grid":
        positions, angles = _grid(plan, index, axes)
    else:
        positions, angles = _facade(plan, index, complex_m, axes)
    positions = positions + rng.normal(0, 0.008 * plan.radius_m, positions.shape)
    pitch = float(np.round(angles[:, 1].mean()))
    angles = angles + rng.normal(0, 1.5, angles.shape)
    angles[:, 0] = np.degrees(np.unwrap(np.radians(angles[:, 0])))
    step_m = float(np.median(np.linalg.norm(np.diff(positions, axis=0), axis=1)))
    # In half seconds: photographs coincide with fixes.
    unhurried_s = max(2.0, float(np.ceil(2 * step_m / _SPEED_M_S)) / 2)
    times = index * (plan.interval_s or unhurried_s)
    return TrueTrajectory(
        times[1:-1].astype(np.float64),
        # The mount tilts the camera as the flight needs, so that the body itself flies level.
        geo_from_cam([0.0, pitch, 0.0]).T @ ENU_FROM_NED,
        CubicSpline(times, positions),
        PchipInterpolator(times, angles),
    )


def _rounds(plan: FlightPlan, index: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the number of the round of each index, and the index as a fraction of that round."""
    rounds = len(plan.heights_m)
    per_round = -(-plan.images // rounds)
    number = np.clip(index // per_round, 0, rounds - 1).astype(np.intp)
    count = np.minimum(per_round, plan.images - number * per_round)
    return number, (index - number * per_round) / count


def _orbit(plan: FlightPlan, index: FloatArray) -> tuple[FloatArray, FloatArray]:
    number, share = _rounds(plan, index)
    azimuth = 2 * np.pi * share + 0.13 * number
    height = np.array(plan.heights_m)[number]
    positions = np.stack([plan.radius_m * np.cos(azimuth), plan.radius_m * np.sin(azimuth), height], axis=1)
    return positions, _looking(np.array([0.0, 0.0, _LOOK_AT_M]) - positions)


def _looking(direction: FloatArray) -> FloatArray:
    """Return yaw, pitch, roll (N, 3) in degrees of cameras that look along `direction` (N, 3) in geo."""
    yaw = np.degrees(np.arctan2(direction[:, 0], direction[:, 1]))
    pitch = np.degrees(np.arctan2(direction[:, 2], np.hypot(direction[:, 0], direction[:, 1])))
    return np.stack([yaw, pitch, np.zeros_like(yaw)], axis=1)


def _grid(plan: FlightPlan, index: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    number, share = _rounds(plan, index)
    per_round = -(-plan.images // len(plan.heights_m))
    # A photograph covers more across the line than along it: lines can be further apart than photographs.
    lines = max(1, round((0.75 * per_round) ** 0.5))
    per_line = -(-per_round // lines)
    step = np.clip(np.round(share * per_round), 0, per_round - 1).astype(int)
    line, along = step // per_line, step % per_line
    forward = line % 2 == 0
    place = np.where(forward, along, per_line - 1 - along) / max(per_line - 1, 1)
    x = plan.radius_m * (2 * place - 1)
    y = plan.radius_m * (2 * line / max(lines - 1, 1) - 1)
    # Lead-in and lead-out continue the line for a moment.
    x = x + np.where((index < 0) | (index >= plan.images), np.where(forward, 1, -1) * np.sign(index) * 5.0, 0.0)
    positions = np.stack([x, y, np.array(plan.heights_m)[number]], axis=1) @ axes
    positions[:, 2] = np.array(plan.heights_m)[number]
    heading = np.degrees(np.arctan2(axes[0, 0], axes[0, 1])) + np.where(forward, 0.0, 180.0)
    return positions, np.stack([heading, np.full(len(index), -90.0), np.zeros(len(index))], axis=1)


def _facade(
    plan: FlightPlan, index: FloatArray, complex_m: tuple[float, float], axes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    number, share = _rounds(plan, index)
    half_x, half_y = complex_m
    corner = 0.5 * np.pi * plan.radius_m
    sides = np.array([2 * half_x, corner, 2 * half_y, corner] * 2)[:8]
    ends = np.concatenate([[0.0], np.cumsum(sides)])
    way = np.mod(share, 1.0) * ends[-1]
    part = np.clip(np.searchsorted(ends, way, side="right") - 1, 0, 7)
    done = (way - ends[part]) / sides[part]
    # The outward normal turns by 90° along each corner and stays along each side, from south to east to north.
    turn = np.radians(-90 + 90 * (part // 2 + np.where(part % 2 == 1, done, 0.0)))
    outward = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    starts = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    corner_xy, next_corner_xy = starts[part // 2], starts[(part // 2 + 1) % 4]
    on_side = np.where(part % 2 == 1, 1.0, done)[:, None]
    place = corner_xy + (next_corner_xy - corner_xy) * on_side + plan.radius_m * outward
    height = np.array(plan.heights_m)[number]
    positions = np.concatenate([place, np.zeros((len(index), 1))], axis=1) @ axes
    positions[:, 2] = height
    inward = np.concatenate([-outward, np.full((len(index), 1), -0.12)], axis=1) @ axes
    return positions, _looking(inward)
