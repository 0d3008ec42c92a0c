"""`/tf` and `/tf_static`: where the frames of an aircraft are, one in another."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.trajectory import Trajectory

TYPE = "tf2_msgs/msg/TFMessage"
OLD_TYPE = "tf/msg/tfMessage"
_MAX_LINKS = 1000
_MAX_STEPS = 64


@dataclass
class _Link:
    """A frame in its parent: samples of (time, x, y, z, qx, qy, qz, qw)."""

    parent: str
    static: bool
    samples: array[float] = field(default_factory=lambda: array("d"))


class Transforms:
    """The tree of frames. Static links hold at all times; others only between their samples."""

    def __init__(self) -> None:
        self._links: dict[str, _Link] = {}
        self.refused = 0

    def __contains__(self, frame: str) -> bool:
        return frame in self._links or any(link.parent == frame for link in self._links.values())

    def add(self, message: Any, *, static: bool) -> None:
        """Add the links of a `TFMessage`; transforms that are not finite are counted in `refused`."""
        for transform in message.transforms:
            stamp, shift, turn = (
                transform.header.stamp, transform.transform.translation, transform.transform.rotation,
            )  # fmt: skip
            values = (
                stamp.sec + stamp.nanosec * 1e-9, shift.x, shift.y, shift.z, turn.x, turn.y, turn.z, turn.w,
            )  # fmt: skip
            child, parent = _name(transform.child_frame_id), _name(transform.header.frame_id)
            norm = float(np.linalg.norm(values[4:]))
            known = child in self._links or len(self._links) < _MAX_LINKS
            if not np.isfinite(values).all() or abs(norm - 1) > 0.05 or child == parent or not known:
                self.refused += 1
                continue
            link = self._links.get(child)
            if link is None or link.parent != parent or static:
                link = self._links[child] = _Link(parent, static)
            link.samples.extend(values)

    def between(self, to: str, of: str, time_s: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return rotations (N, 3, 3) and origins (N, 3) of frame `of` in `to` at times (N,); None if not linked.

        Rows are NaN where a moving link on the way has no samples around the time.
        """
        to, of = _name(to), _name(of)
        up_to, up_of = self._ancestors(to), self._ancestors(of)
        common = next((frame for frame in up_of if frame in up_to), None)
        if common is None:
            return None
        common_from_of = self._upwards(up_of[: up_of.index(common)], time_s)
        common_from_to = self._upwards(up_to[: up_to.index(common)], time_s)
        back = np.swapaxes(common_from_to[0], -1, -2)
        shift = np.einsum("nij,nj->ni", back, common_from_of[1] - common_from_to[1])
        return back @ common_from_of[0], shift

    def _ancestors(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on."""
        line = [frame]
        while line[-1] in self._links and len(line) < _MAX_STEPS:
            parent = self._links[line[-1]].parent
            if parent in line:
                break
            line.append(parent)
        return line

    def _upwards(self, frames: list[str], time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        rotation, shift = np.tile(np.eye(3), (len(time_s), 1, 1)), np.zeros((len(time_s), 3))
        for frame in frames:
            step_rotation, step_shift = _at(self._links[frame], time_s)
            rotation, shift = step_rotation @ rotation, np.einsum("nij,nj->ni", step_rotation, shift) + step_shift
        return rotation, shift


def _at(link: _Link, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotations (N, 3, 3) and origins (N, 3) of a link's frame in its parent at times (N,)."""
    samples = np.frombuffer(link.samples).reshape(-1, 8)
    if link.static:
        turn = matrix_from_quat_xyzw(samples[-1, 4:])
        return np.tile(turn, (len(time_s), 1, 1)), np.tile(samples[-1, 1:4], (len(time_s), 1))
    clock, first = np.unique(samples[:, 0], return_index=True)
    motion = Trajectory.from_samples(
        clock, position=samples[first, 1:4], rotation=matrix_from_quat_xyzw(samples[first, 4:])
    )
    there = motion.at(time_s)
    return there.rotation, there.position


def _name(frame: str) -> str:
    return frame.lstrip("/")
