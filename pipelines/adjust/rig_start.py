"""Start of a calibration: the time offset at which the tracks of cameras and navigation have the same shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.adjust.rig_model import RigData, RigState, cameras_by_navigation, usable_images
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geometry.similarity import umeyama
from pipelines.geometry.trajectory import Trajectory

LEAST_IMAGES = 6
NOT_OBSERVABLE = (
    f"nothing of the rig is observable: fewer than {LEAST_IMAGES} images lie within the recorded navigation, or "
    "all lie on one line or in one place"
)
_SMOOTHING_S = 0.1


def scan_offsets(data: RigData, offsets: FloatArray, boresight: FloatArray) -> RigState:
    """Return the state at the time offset for which the shapes of the tracks agree best.

    Args:
        data: cameras and navigation.
        offsets: (m,) candidates in seconds; the first wins a tie.
        boresight: (3, 3) nominal ← true camera, taken over into the state.

    Raises:
        DegenerateGeometryError: fewer than six images within the track, or all on one line or in one place.
    """
    best: tuple[float, RigState] | None = None
    for offset in offsets:
        inside = usable_images(data, float(offset))
        if inside.sum() < LEAST_IMAGES:
            continue
        place, _ = cameras_by_navigation(data, float(offset), np.zeros(3), inside)
        try:
            model = umeyama(data.center_in_local[inside], place)
        except DegenerateGeometryError:
            continue
        missed = np.linalg.norm(place - model.apply(data.center_in_local[inside]), axis=1)
        # Few images agree easily: images that an offset moves out of the navigation raise its cost.
        cost = float(np.median(missed)) * (1.0 + 10.0 * (1.0 - inside.mean()))
        if best is None or cost < best[0]:
            best = cost, RigState(model, float(offset), boresight, np.zeros(3))
    if best is None:
        raise DegenerateGeometryError(NOT_OBSERVABLE)
    state = best[1]
    spread = np.linalg.svd(data.center_in_local - data.center_in_local.mean(axis=0), compute_uv=False)
    extent_m = state.geo_from_local.scale * spread / np.sqrt(len(data.center_in_local))
    if extent_m[0] < 1.0 or extent_m[1] < 0.01 * extent_m[0]:
        raise DegenerateGeometryError(
            "nothing of the rig is observable: the cameras stay within a metre of one place, or on one line; "
            "fly turns and changes of speed"
        )
    return state


def smoothed(attitudes: Trajectory) -> Trajectory:
    """Return attitudes averaged over 0.1 s on either side: white noise shrinks, while turns are kept."""
    clock = attitudes.time_s
    if len(clock) < 3:
        return attitudes
    half = int(_SMOOTHING_S / max(float(np.median(np.diff(clock))), 1e-6))
    if half < 1 or len(clock) < 4 * half:
        return attitudes
    quat = Rotation.from_matrix(attitudes.rotation).as_quat()
    flips = np.cumprod(np.where((quat[1:] * quat[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    quat[1:] *= flips[:, None]
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    mean = np.stack([np.convolve(quat[:, i], kernel, mode="valid") for i in range(4)], axis=1)
    inner = slice(half, len(clock) - half)
    even = clock[2 * half :] - clock[: -2 * half] < 3 * half * float(np.median(np.diff(clock)))
    quat[inner] = np.where(even[:, None], mean, quat[inner])
    return replace(attitudes, rotation=np.asarray(Rotation.from_quat(quat).as_matrix()))
