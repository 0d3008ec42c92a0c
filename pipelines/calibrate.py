"""`georef calibrate`: time offset, boresight and lever arm, from the SfM cameras against the recorded navigation.

Reads `ingest/survey.json`, `ingest/track.npz` and `sfm/sparse`; writes nothing. What it finds is applied by running
`ingest` again with the values as its options: the survey then has them in every position and attitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.blocks.observations import control_correspondences
from pipelines.config import CalibrateConfig
from pipelines.errors import InputError
from pipelines.formats.colmap import SparseModel, read_sparse
from pipelines.geometry.rotations import log_so3
from pipelines.georef.rig_fit import (
    LIMIT_ARM_M,
    LIMIT_BORESIGHT_DEG,
    LIMIT_OFFSET_S,
    FitOptions,
    RigData,
    fit_rig,
)
from pipelines.products import FloatArray, NavigationTrack, Survey, load_json
from pipelines.stages import SPARSE, SURVEY, TRACK
from pipelines.workspace import Workspace

_LIMITS = {"time-offset": LIMIT_OFFSET_S, "boresight": LIMIT_BORESIGHT_DEG, "lever-arm": LIMIT_ARM_M}
_UNITS = {"time-offset": "s", "boresight": "deg", "lever-arm": "m"}


@dataclass(frozen=True)
class Estimate:
    """One parameter of the rig, in the sense and unit of the option of `ingest` of the same name.

    Attributes:
        value: estimated; `before`: that the survey was made with; `sigma`: of each component.
        observable: by component: whether σ is small enough to use it.
    """

    name: str
    unit: str
    value: tuple[float, ...]
    sigma: tuple[float, ...]
    before: tuple[float, ...]
    observable: tuple[bool, ...]

    @property
    def usable(self) -> bool:
        """Whether every component is observable."""
        return all(self.observable)

    @property
    def option(self) -> str:
        """The value as `ingest` takes it."""
        return ",".join(f"{number:.6g}" for number in self.value)


@dataclass(frozen=True)
class Calibration:
    """The estimates, images used, and what is left: robust σ per axis of positions (m) and attitudes (degrees)."""

    estimates: tuple[Estimate, ...]
    images: int
    control_points: int
    rms_position_m: float
    rms_attitude_deg: float | None

    @property
    def options(self) -> dict[str, str]:
        """Options of `ingest` that apply what is usable."""
        return {one.name.replace("-", "_"): one.option for one in self.estimates if one.usable}


def calibrate(workspace: Workspace, config: CalibrateConfig) -> Calibration:
    """Estimate the rig of a workspace's flight.

    Raises:
        MissingProductError: there is no survey or no SfM model.
        InputError: the navigation was not recorded by time, or there are no attitudes for what is asked.
        DegenerateGeometryError: the flight shows nothing of it: a hover, a straight line.
    """
    survey = load_json(Survey, workspace.path(SURVEY))
    model = read_sparse(workspace.path(SPARSE))
    if not (workspace.root / TRACK).exists():
        raise InputError(
            "the survey has no navigation recorded by time, only a position for each image: ingest a --bag",
            path=workspace.root / TRACK,
        )
    return estimate_rig(survey, model, NavigationTrack.load(workspace.root / TRACK), config)


def estimate_rig(
    survey: Survey, model: SparseModel, track: NavigationTrack, config: CalibrateConfig
) -> Calibration:
    """As `calibrate`, of products."""
    data = _data(survey, model, track)
    mounted = bool(np.isfinite(data.cam_from_body).all(axis=(1, 2)).any())
    if "lever-arm" in config.wanted and not len(track.attitude_time_s):
        raise InputError("lever-arm needs attitudes, which were not recorded", field="--estimate")
    if "boresight" in config.wanted and not (mounted and len(track.attitude_time_s)):
        raise InputError(
            "boresight needs recorded attitudes and the camera's mount (/tf or --camera-mount)", field="--estimate"
        )
    wanted = config.wanted
    before_s = float(track.time_offset_s)
    options = FitOptions("time-offset" in wanted, "lever-arm" in wanted, config.max_offset)
    found = fit_rig(data, before_s, track.nominal_from_cam, options)
    arm = np.nan_to_num(track.antenna_in_body).mean(axis=0)
    state, sigma = found.state, found.sigma
    # Along its view a camera's centre trades against lens and terrain: SfM is wrong there by a pixel's footprint,
    # alike in all images, which no scatter shows.
    arm_sigma = np.hypot(sigma[11:14], state.geo_from_local.scale * _footprint(model))
    rows = {
        "time-offset": (np.array([state.offset_s]), sigma[7:8], np.array([before_s])),
        "boresight": (_degrees(state.boresight), np.degrees(sigma[8:11]), _degrees(track.nominal_from_cam)),
        "lever-arm": (arm + state.arm, arm_sigma, arm),
    }
    estimates = []
    for name in wanted:
        value, spread, before = (tuple(float(number) for number in row) for row in rows[name])
        seen = tuple(one <= _LIMITS[name] for one in spread)
        estimates.append(Estimate(name, _UNITS[name], value, spread, before, seen))
    attitude = found.rms_attitude_deg
    return Calibration(
        estimates=tuple(estimates),
        images=found.images,
        control_points=len(data.control_in_local),
        rms_position_m=found.rms_position_m,
        rms_attitude_deg=attitude if np.isfinite(attitude) else None,
    )


def _data(survey: Survey, model: SparseModel, track: NavigationTrack) -> RigData:
    row_of = {name: row for row, name in enumerate(track.image.tolist())}
    registered = [index for index, name in enumerate(model.image_name) if name in row_of]
    rows = [row_of[model.image_name[index]] for index in registered]
    control, _ = control_correspondences(survey, model)
    return RigData(
        track=track,
        time_s=track.image_time_s[rows],
        center_in_local=model.cam_center_in_local[registered],
        cam_from_local=model.rotation_cam_from_local[registered],
        cam_from_body=track.cam_from_body[rows],
        antenna_in_body=np.nan_to_num(track.antenna_in_body[rows]),
        control_in_local=control.in_local,
        control_in_geo=control.in_geo,
        control_cov_in_local=control.cov_in_local,
        control_cov_in_geo=control.cov_in_geo,
    )


def _footprint(model: SparseModel) -> float:
    """Width of a pixel at the distance of the points, in units of local."""
    arm = model.point_in_local[model.obs_point] - model.cam_center_in_local[model.obs_image]
    focal = np.array([model.camera_of(image).mean_focal_px for image in range(len(model.image_name))])
    return float(np.median(np.linalg.norm(arm, axis=1) / focal[model.obs_image]))


def _degrees(rotation: FloatArray) -> FloatArray:
    return np.degrees(log_so3(rotation))
