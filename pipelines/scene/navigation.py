"""Navigation as recorded, with the times and the rig of the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import load_npz, save_npz
from pipelines.core.stages import TRACK
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.rig import Rig
from pipelines.geometry.trajectory import Trajectory
from pipelines.scene.rig import RigParameter


@dataclass(frozen=True)
class NavigationTrack:
    """Second product of `ingest`: the navigation as recorded, with the times and the rig of n photographs.

    `calibrate` fits the SfM cameras to this navigation. Positions are those of the antenna, attitudes those of the
    body (forward-right-down), both on the navigation's clock, without any correction by the rig. The rig is the one
    given to `ingest`.

    Attributes:
        position_time_s: (K,) float64, seconds.
        antenna_in_geo: (K, 3) float64, metres.
        sigma_m: (K, 3) float64, σ east, north, up; NaN where the receiver states none.
        attitude_time_s: (M,) float64, seconds.
        geo_from_body: (M, 3, 3) float64.
        image: (n,) names of images.
        image_time_s: (n,) float64, camera clock.
        cam_from_body: (n, 3, 3) float64, mount; NaN where unknown.
        antenna_in_body: (n, 3) float64, lever arm; NaN where unknown.
        nominal_from_cam: (3, 3) float64, boresight.
        time_offset_s: () float64, navigation clock minus camera clock.
        max_gap_s: () float64, longest gap to interpolate over.
        body_known: () bool; if false, the body's axes are set to the camera's nominal axes.
    """

    position_time_s: FloatArray
    antenna_in_geo: FloatArray
    sigma_m: FloatArray
    attitude_time_s: FloatArray
    geo_from_body: FloatArray
    image: NDArray[np.str_]
    image_time_s: FloatArray
    cam_from_body: FloatArray
    antenna_in_body: FloatArray
    nominal_from_cam: FloatArray
    time_offset_s: FloatArray
    max_gap_s: FloatArray
    body_known: BoolArray

    @property
    def positions(self) -> Trajectory:
        """Trajectory of the antenna in geo, on the navigation's clock."""
        return Trajectory.from_samples(
            self.position_time_s,
            position=self.antenna_in_geo,
            sigma_m=self.sigma_m,
            max_gap_s=float(self.max_gap_s),
        )

    @property
    def attitudes(self) -> Trajectory:
        """Rotations of the body in geo, on the navigation's clock."""
        return Trajectory.from_samples(
            self.attitude_time_s, rotation=self.geo_from_body, max_gap_s=float(self.max_gap_s)
        )

    @property
    def rig(self) -> Rig:
        """Rig of the n images, as given to `ingest`."""
        return Rig(self.cam_from_body, self.antenna_in_body, self.nominal_from_cam)

    def save(self, path: Path) -> None:
        """Write the navigation as NPZ."""
        save_npz(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> NavigationTrack:
        """Read the navigation from NPZ.

        Raises:
            InputError: the file is no NPZ file with these arrays, or an array has another form.
        """
        arrays = load_npz(path, tuple(field.name for field in fields(cls)))
        lengths: dict[str, int] = {}
        for name, (kind, *shape) in _TRACK_ARRAYS.items():
            array = arrays[name]
            matches = array.dtype.kind in kind and array.ndim == len(shape)
            for length, wanted in zip(array.shape, shape, strict=False):
                expected = lengths.setdefault(wanted, length) if isinstance(wanted, str) else wanted
                matches = matches and length == expected
            if not matches:
                raise InputError(f"has the form {array.shape} {array.dtype}", path=path, field=name)
        return cls(**arrays)


# Kind of number, and shape, in which a letter stands for a length that several arrays share.
_TRACK_ARRAYS: dict[str, tuple[Any, ...]] = {
    "position_time_s": ("f", "K"),
    "antenna_in_geo": ("f", "K", 3),
    "sigma_m": ("f", "K", 3),
    "attitude_time_s": ("f", "M"),
    "geo_from_body": ("f", "M", 3, 3),
    "image": ("U", "n"),
    "image_time_s": ("f", "n"),
    "cam_from_body": ("f", "n", 3, 3),
    "antenna_in_body": ("f", "n", 3),
    "nominal_from_cam": ("f", 3, 3),
    "time_offset_s": ("fi",),
    "max_gap_s": ("fi",),
    "body_known": ("b",),
}


def load_track(workspace: Workspace) -> NavigationTrack:
    """Return the navigation of a workspace's survey.

    Raises:
        InputError: the navigation was not recorded by time, or the file is damaged.
    """
    try:
        path = workspace.path(TRACK)
    except MissingProductError as error:
        raise InputError(
            "the survey has no navigation recorded by time, only a position for each image: ingest a --bag, or a "
            "--trajectory by time",
            path=workspace.root / TRACK,
        ) from error
    return NavigationTrack.load(path)


def require_estimable(track: NavigationTrack | None, wanted: Sequence[RigParameter], field: str) -> None:
    """Refuse parameters of the rig that the navigation cannot determine.

    Args:
        track: the navigation; None: not recorded by time.
        wanted: parameters to be estimated.
        field: option that names them.

    Raises:
        InputError: the navigation was not recorded by time; or attitudes, the body's axes or the mount are needed
            and unknown.
    """
    if track is None or len(track.position_time_s) < 2:
        raise InputError(
            "needs the navigation recorded by time: a --bag, or a --trajectory without a column of images",
            field=field,
        )
    turned = len(track.attitude_time_s) > 1
    if "lever-arm" in wanted and not turned:
        raise InputError("lever-arm needs attitudes, which were not recorded", field=field)
    if "lever-arm" in wanted and not track.body_known:
        raise InputError("lever-arm needs the body's axes: give --camera-mount YAW,PITCH,ROLL", field=field)
    mounted = bool(np.isfinite(track.cam_from_body).all(axis=(1, 2)).any())
    if "boresight" in wanted and not (turned and mounted):
        raise InputError(
            "boresight needs recorded attitudes and the camera's mount (/tf or --camera-mount)", field=field
        )
