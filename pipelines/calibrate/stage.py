"""`georef calibrate`: time offset, boresight and lever arm, from the SfM cameras against the recorded navigation.

Reads `ingest/survey.json`, `ingest/track.npz` and `sfm/sparse`. What it finds is applied to the survey: positions
and attitudes anew from the navigation, the estimates beside them. What SfM made of the photographs stays as it is.
"""

from __future__ import annotations

import logging
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pipelines.calibrate.options import CalibrateOptions
from pipelines.calibrate.rig_fit import (
    LIMIT_ARM_M,
    LIMIT_BORESIGHT_DEG,
    LIMIT_OFFSET_S,
    FitOptions,
    RigData,
    fit_rig,
)
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.fingerprints import layout_of, product_hash
from pipelines.core.products import load_json
from pipelines.core.stages import SPARSE, SURVEY, TRACK
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.calibrated import apply_calibration as with_calibration
from pipelines.scene.navigation import NavigationTrack, require_estimable
from pipelines.scene.observations import control_correspondences
from pipelines.scene.rig import RigCalibration, RigEstimate, RigParameter
from pipelines.scene.survey import Survey

log = logging.getLogger(__name__)

_LIMITS: dict[RigParameter, tuple[float, Literal["s", "deg", "m"]]] = {
    "time-offset": (LIMIT_OFFSET_S, "s"),
    "boresight": (LIMIT_BORESIGHT_DEG, "deg"),
    "lever-arm": (LIMIT_ARM_M, "m"),
}
_ENDLESS = 1e6


def calibrate(workspace: Workspace, config: CalibrateOptions) -> RigCalibration:
    """Estimate the rig of a workspace's flight; changes nothing.

    Raises:
        MissingProductError: there is no survey or no SfM model.
        InputError: the navigation was not recorded by time, or there are no attitudes for what is asked.
        DegenerateGeometryError: the flight shows nothing of it: a hover, a straight line.
    """
    survey = load_json(Survey, workspace.path(SURVEY))
    model = read_sparse(workspace.path(SPARSE))
    found = estimate_rig(survey, model, _track(workspace), config)
    return found.model_copy(update={"model": product_hash(workspace, SPARSE), "layout": layout_of(survey)})


def apply_calibration(workspace: Workspace, rig: RigCalibration) -> None:
    """Make the survey of a workspace anew with what is usable of `rig`; the lock is the caller's to hold."""
    survey = load_json(Survey, workspace.path(SURVEY))
    workspace.replace(SURVEY, with_calibration(survey, _track(workspace), rig))


def calibrate_as_asked(workspace: Workspace) -> tuple[RigCalibration | None, bool]:
    """Estimate and apply what the survey asks for, unless that is done and the SfM model still the same.

    A flight that shows nothing of the rig is no failure here: the survey then says so.

    Returns:
        The estimates, None if nothing is asked for; and whether they were made now.
    """
    survey = load_json(Survey, workspace.path(SURVEY))
    wanted = survey.rig.wanted if survey.rig is not None else survey.estimate
    if not wanted:
        return None, False
    if survey.rig is not None and survey.rig.model == product_hash(workspace, SPARSE):
        return survey.rig, False
    try:
        found = calibrate(workspace, CalibrateOptions(estimate=wanted))
    except DegenerateGeometryError as error:
        found = RigCalibration(
            wanted=wanted, problem=str(error), model=product_hash(workspace, SPARSE), layout=layout_of(survey)
        )
    for warning in warnings_of(found):
        log.warning("calibrate: %s", warning)
    log.info("calibrate: %s", told(found))
    apply_calibration(workspace, found)
    return found, True


def told(rig: RigCalibration) -> str:
    """The estimates in a line."""
    parts = []
    for one in rig.estimates:
        value = ", ".join(f"{number:.3f}" for number in one.value)
        sigma = ", ".join(f"{number:.3f}" for number in one.sigma)
        unit = {"s": " s", "deg": "°", "m": " m"}[one.unit]
        parts.append(f"{one.name} {value} ± {sigma}{unit}{'' if one.usable else ' (not observable, not applied)'}")
    return "; ".join(parts) or "nothing of the rig is observable"


def warnings_of(rig: RigCalibration) -> list[str]:
    """What could not be estimated, and what counts instead."""
    if rig.problem:
        return [f"{rig.problem}; {', '.join(rig.wanted)} stay as told"]
    return [
        f"{one.name} is not observable in this flight (σ {max(one.sigma):.2g} {one.unit}): it stays as told"
        for one in rig.estimates
        if not one.usable
    ]


def estimate_rig(
    survey: Survey, model: SparseModel, track: NavigationTrack, config: CalibrateOptions
) -> RigCalibration:
    """As `calibrate`, of products."""
    wanted = config.estimate
    require_estimable(track, wanted, "--estimate")
    data = _data(survey, model, track)
    start_s = float(track.time_offset_s)
    options = FitOptions("time-offset" in wanted, "lever-arm" in wanted, config.max_offset)
    found = fit_rig(data, start_s, track.nominal_from_cam, options)
    arm = np.nan_to_num(track.antenna_in_body).mean(axis=0)
    state, sigma = found.state, found.sigma
    rows: dict[RigParameter, RigEstimate] = {
        "time-offset": _estimate("time-offset", [state.offset_s], sigma[7:8], [start_s]),
        "boresight": _estimate(
            "boresight", _degrees(state.boresight), np.degrees(sigma[8:11]), _degrees(track.nominal_from_cam)
        ),
        "lever-arm": _estimate("lever-arm", arm + state.arm, sigma[11:14], arm),
    }
    attitude = found.rms_attitude_deg
    return RigCalibration(
        wanted=wanted,
        estimates=tuple(rows[name] for name in wanted),
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
    pixel_rad, footprint = _pixel(model)
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
        pixel_rad=pixel_rad,
        footprint_in_local=footprint,
    )


def _pixel(model: SparseModel) -> tuple[float, float]:
    """A pixel's angle in radians, and its width at the distance of the points in units of local."""
    arm = model.point_in_local[model.obs_point] - model.cam_center_in_local[model.obs_image]
    focal = np.array([model.camera_of(image).mean_focal_px for image in range(len(model.image_name))])
    footprint = np.median(np.linalg.norm(arm, axis=1) / focal[model.obs_image])
    return float(1.0 / np.median(focal)), float(footprint)


def _estimate(name: RigParameter, value: ArrayLike, sigma: ArrayLike, start: ArrayLike) -> RigEstimate:
    values, sigmas, starts = (tuple(float(number) for number in np.ravel(row)) for row in (value, sigma, start))
    limit, unit = _LIMITS[name]
    # What nothing was said of has an endless σ, which JSON does not have.
    sigmas = tuple(min(number, _ENDLESS) for number in sigmas)
    return RigEstimate(
        name=name,
        unit=unit,
        value=values,
        sigma=sigmas,
        start=starts,
        observable=tuple(number <= limit for number in sigmas),
    )


def _track(workspace: Workspace) -> NavigationTrack:
    path = workspace.root / TRACK
    if not path.exists():
        raise InputError(
            "the survey has no navigation recorded by time, only a position for each image: ingest a --bag, or a "
            "--trajectory by time",
            path=path,
        )
    return NavigationTrack.load(path)


def _degrees(rotation: FloatArray) -> FloatArray:
    return np.degrees(log_so3(rotation))
