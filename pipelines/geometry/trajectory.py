"""A motion recorded by time, and how camera, antenna and body are put together: mount, boresight, lever arm.

The rules of every interpolation in time:

1. Between two samples at most `max_gap_s` apart, places and σ change linearly, rotations on the shortest arc.
2. Elsewhere an instant within a millisecond of a sample takes that sample: clocks write milliseconds.
3. All other instants are NaN: nothing is extrapolated.
4. A quantity that one of the two samples lacks (NaN) is NaN.

The body is Forward-Right-Down. The mount is the planned rotation between body and camera; the boresight is the
small rotation from the true camera axes to those that the mount says.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import BoolArray, FloatArray, IntArray, Rows
from pipelines.geometry.rotations import ENU_FROM_NED, exp_so3, geo_from_cam, log_so3

_SAME_TIME_S = 1e-3


@dataclass(frozen=True)
class Trajectory(Rows):
    """Samples of a motion on one clock; what was not recorded is NaN.

    Positions are Cartesian: degrees jump at the date line. Rotations turn axes of the moving body into the axes of
    the samples' frame, or into East-North-Up where each sample was taken.
    """

    time_s: FloatArray  # (K,) increasing
    position: FloatArray  # (K, 3) metres
    rotation: FloatArray  # (K, 3, 3)
    sigma_m: FloatArray  # (K, 3) σ of the positions
    sigma_deg: FloatArray  # (K,) σ of the rotations
    max_gap_s: float  # longest time between two samples to interpolate over

    @classmethod
    def from_samples(
        cls,
        time_s: FloatArray,
        *,
        position: FloatArray | None = None,
        rotation: FloatArray | None = None,
        sigma_m: FloatArray | None = None,
        sigma_deg: FloatArray | None = None,
        max_gap_s: float = np.inf,
    ) -> Trajectory:
        """Return the trajectory of the quantities that were recorded at times (K,)."""
        count = len(time_s)
        return cls(
            time_s,
            np.full((count, 3), np.nan) if position is None else position,
            np.full((count, 3, 3), np.nan) if rotation is None else rotation,
            np.full((count, 3), np.nan) if sigma_m is None else sigma_m,
            np.full(count, np.nan) if sigma_deg is None else sigma_deg,
            max_gap_s,
        )

    def covers(self, time_s: FloatArray) -> BoolArray:
        """Return for which times (n,) there is a value, by rules 1 and 2."""
        return _bracket(self.time_s, time_s, self.max_gap_s).covered

    def chord_error(self, time_s: FloatArray, beyond_s: float) -> FloatArray:
        """Return how far (n, 3) the motion may be from the straight line between two samples; zero in short gaps.

        The acceleration is that of the samples' velocities before and after, the larger of the two. Gaps up to
        `beyond_s` count as short.
        """
        error = np.zeros((len(time_s), 3))
        if len(self) < 3:
            return error
        gap_s = np.diff(self.time_s)
        velocity = np.diff(self.position, axis=0) / gap_s[:, None]
        turning = np.zeros((len(self), 3))
        turning[1:-1] = np.diff(velocity, axis=0) / ((gap_s[1:] + gap_s[:-1]) / 2.0)[:, None]
        turning[0], turning[-1] = turning[1], turning[-2]
        bracket = _bracket(self.time_s, time_s, self.max_gap_s)
        rows = bracket.covered & (bracket.after > bracket.before)
        before, after, part = bracket.before[rows], bracket.after[rows], bracket.part[rows]
        ends = np.stack([turning[before], turning[after]])
        larger = np.linalg.norm(ends, axis=2).argmax(axis=0)
        apart_s = self.time_s[after] - self.time_s[before]
        bend = 0.5 * part * (1.0 - part) * np.where(apart_s > beyond_s, apart_s, 0.0) ** 2
        error[rows] = ends[larger, np.arange(len(larger))] * bend[:, None]
        return np.asarray(np.nan_to_num(error))

    def at(self, time_s: FloatArray) -> Trajectory:
        """Return the motion at times (n,)."""
        bracket = _bracket(self.time_s, time_s, self.max_gap_s)
        return Trajectory(
            time_s,
            _linear(self.position, bracket),
            _shortest_arc(self.rotation, bracket),
            _linear(self.sigma_m, bracket),
            _linear(self.sigma_deg[:, None], bracket)[:, 0],
            self.max_gap_s,
        )


@dataclass(frozen=True)
class _Bracket:  # samples before and after each of n times, the part of the way between, and whether they count
    before: IntArray
    after: IntArray
    part: FloatArray
    covered: BoolArray


def _bracket(clock_s: FloatArray, time_s: FloatArray, max_gap_s: float) -> _Bracket:
    count = len(time_s)
    if not len(clock_s):
        none = np.zeros(count, dtype=np.int64)
        return _Bracket(none, none, np.zeros(count), np.zeros(count, dtype=bool))
    last = len(clock_s) - 1
    after = np.clip(np.searchsorted(clock_s, time_s), min(1, last), last)
    before = np.maximum(after - 1, 0)
    gap_s = clock_s[after] - clock_s[before]
    part = np.clip((time_s - clock_s[before]) / np.where(gap_s > 0, gap_s, 1.0), 0.0, 1.0)
    between = (time_s >= clock_s[before]) & (time_s <= clock_s[after]) & (gap_s <= max_gap_s)
    nearest = np.where(part < 0.5, before, after)
    same = ~between & (np.abs(clock_s[nearest] - time_s) <= _SAME_TIME_S)
    return _Bracket(
        before=np.where(same, nearest, before),
        after=np.where(same, nearest, after),
        part=np.where(same, 0.0, part),
        covered=np.asarray(between | same),
    )


def _linear(values: FloatArray, bracket: _Bracket) -> FloatArray:
    result = np.full((len(bracket.part), values.shape[1]), np.nan)
    rows = bracket.covered
    start, end = values[bracket.before[rows]], values[bracket.after[rows]]
    result[rows] = start + bracket.part[rows, None] * (end - start)
    return result


def _shortest_arc(rotations: FloatArray, bracket: _Bracket) -> FloatArray:
    result = np.full((len(bracket.part), 3, 3), np.nan)
    known = np.asarray(np.isfinite(rotations).all(axis=(1, 2)))
    rows = np.flatnonzero(bracket.covered)
    rows = rows[known[bracket.before[rows]] & known[bracket.after[rows]]]
    start, end = rotations[bracket.before[rows]], rotations[bracket.after[rows]]
    arc = log_so3(np.swapaxes(start, 1, 2) @ end)
    result[rows] = start @ exp_so3(bracket.part[rows, None] * arc)
    return result


FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Rig:
    """Mount, lever arm and boresight of one camera, or mount and lever arm of each of N photographs."""

    cam_from_body: FloatArray | None = None  # (3, 3) or (N, 3, 3) mount; None or NaN where nothing is known of it
    # (3,) or (N, 3) lever arm: metres from the camera's centre, forward-right-down; None or NaN where nothing is
    # known of it
    antenna_in_body: FloatArray | None = None
    nominal_from_cam: FloatArray = field(default_factory=lambda: np.eye(3))  # (3, 3) boresight

    def of_each(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the mount (N, 3, 3) and the lever arm (N, 3) of each of N photographs, NaN where unknown."""
        mounts = np.nan if self.cam_from_body is None else self.cam_from_body
        arms = np.nan if self.antenna_in_body is None else self.antenna_in_body
        return np.broadcast_to(mounts, (count, 3, 3)).copy(), np.broadcast_to(arms, (count, 3)).copy()


def with_rig(antenna: FloatArray, frame_from_body: FloatArray, rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Return camera centres (N, 3) and rotations frame ← camera (N, 3, 3), from the navigation of N photographs.

    The antennas (N, 3) are metres in any Cartesian frame, or in one for each photograph; the attitudes (N, 3, 3) of
    the body, forward-right-down, are in that frame. Where the lever arm is not known, the antenna stands for the
    camera. A lever arm without an attitude gives no centre, because the arm could point anywhere; no mount or no
    attitude gives no rotation: both are NaN.
    """
    mounts, arms = rig.of_each(len(antenna))
    arms = np.nan_to_num(arms)
    center, moved = antenna.copy(), arms.any(axis=1)
    center[moved] -= np.einsum("nij,nj->ni", frame_from_body[moved], arms[moved])
    return center, frame_from_body @ np.swapaxes(mounts, -1, -2) @ rig.nominal_from_cam


def mount(yaw_pitch_roll_deg: ArrayLike) -> FloatArray:
    """Return the rotation (3, 3) body → camera of yaw, pitch, roll (Z-Y-X) from the body's forward axis.

    (0, 0, 0) looks ahead, (0, −90, 0) straight down with the top of the image ahead.
    """
    return geo_from_cam(yaw_pitch_roll_deg).T @ ENU_FROM_NED


def frame_from_frd(axes: str) -> FloatArray:
    """Return the rotation (3, 3) from forward-right-down into a frame's own axes: "frd", "flu" or "optical"."""
    if axes == "optical":
        return mount([0.0, 0.0, 0.0])
    return FLU_FROM_FRD.copy() if axes == "flu" else np.eye(3)
