"""Stage `calibrate`: time offset, boresight and lever arm, from the SfM cameras against the recorded navigation.

Reads `ingest/survey.json`, and if any parameter is to be estimated, `ingest/track.npz` and `sfm/sparse`. Writes
`calibrate/rig.json`. Its applied estimates change positions and attitudes when later stages read the survey
(`scene.calibrated.load_survey`). The SfM model stays as it is.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pipelines.adjust.observations import control_correspondences
from pipelines.adjust.options import CalibrateOptions
from pipelines.adjust.rig_fit import (
    LIMIT_ARM_M,
    LIMIT_BORESIGHT_DEG,
    LIMIT_OFFSET_S,
    FitOptions,
    RigFit,
    fit_rig,
)
from pipelines.adjust.rig_model import RigData
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import SPARSE, SURVEY
from pipelines.core.types import FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.navigation import NavigationTrack, load_track, require_estimable
from pipelines.scene.rig import RigCalibration, RigEstimate, RigParameter
from pipelines.scene.survey import Survey

_LIMITS: dict[RigParameter, tuple[float, Literal["s", "deg", "m"]]] = {
    "time-offset": (LIMIT_OFFSET_S, "s"),
    "boresight": (LIMIT_BORESIGHT_DEG, "deg"),
    "lever-arm": (LIMIT_ARM_M, "m"),
}
_ENDLESS = 1e6


def run(stage: StageRun, options: CalibrateOptions) -> Summary:
    """Estimate the rig of the flight and write the estimates; without any to estimate, write an empty product.

    Raises:
        MissingProductError: a product does not exist.
        InputError: a product is damaged, or an error of `calibrate`.
    """
    workspace = stage.workspace
    survey = load_json(Survey, workspace.path(SURVEY))
    calibration = RigCalibration()
    if _wanted(survey, options):
        calibration = calibrate(survey, read_sparse(workspace.path(SPARSE)), load_track(workspace), options)
    save_json(calibration, stage.out / "rig.json")
    return _summary(calibration, survey)


def calibrate(
    survey: Survey, model: SparseModel, track: NavigationTrack, options: CalibrateOptions
) -> RigCalibration:
    """Return the estimates of the rig.

    An observable estimate is applied if the survey names its parameter. `options.apply` overrides the survey: all
    observable estimates, or none. A flight in which no parameter is observable is no failure: `problem` states the
    reason.

    Args:
        survey: has the control points and the option of `ingest`.
        model: the SfM model.
        track: the recorded navigation.
        options: of the stage.

    Raises:
        InputError: the navigation was not recorded by time; or attitudes, the body's axes or the mount are needed
            and unknown.
    """
    wanted = _wanted(survey, options)
    require_estimable(track, wanted, "--estimate")
    data, start_s = _data(survey, model, track), float(track.time_offset_s)
    free = FitOptions("time-offset" in wanted, "lever-arm" in wanted, options.max_offset)
    try:
        fit = fit_rig(data, start_s, track.nominal_from_cam, free)
    except DegenerateGeometryError as error:
        return RigCalibration(wanted=wanted, problem=str(error))
    estimates = [_estimates(fit, track)[name] for name in wanted]
    to_apply = survey.estimate if options.apply is None else wanted if options.apply else ()
    applied = tuple(estimate for estimate in estimates if estimate.usable and estimate.name in to_apply)
    attitude = fit.rms_attitude_deg
    return RigCalibration(
        wanted=wanted,
        applied=applied,
        not_applied=tuple(estimate for estimate in estimates if estimate not in applied),
        images=fit.images,
        control_points=len(data.control_in_local),
        rms_position_m=fit.rms_position_m,
        rms_attitude_deg=attitude if np.isfinite(attitude) else None,
    )


def _wanted(survey: Survey, options: CalibrateOptions) -> tuple[RigParameter, ...]:
    """Return the parameters to estimate: those of the options, else those of the survey."""
    return survey.estimate if options.estimate is None else options.estimate


def _estimates(fit: RigFit, track: NavigationTrack) -> dict[RigParameter, RigEstimate]:
    arm = np.nan_to_num(track.antenna_in_body).mean(axis=0)
    state, sigma = fit.state, fit.sigma
    return {
        "time-offset": _estimate("time-offset", [state.offset_s], sigma[7:8], [float(track.time_offset_s)]),
        "boresight": _estimate(
            "boresight", _degrees(state.boresight), np.degrees(sigma[8:11]), _degrees(track.nominal_from_cam)
        ),
        "lever-arm": _estimate("lever-arm", arm + state.arm, sigma[11:14], arm),
    }


def _summary(calibration: RigCalibration, survey: Survey) -> Summary:
    residuals = {
        "images": calibration.images,
        "control_points": calibration.control_points,
        "rms_position_m": calibration.rms_position_m,
        "rms_attitude_deg": calibration.rms_attitude_deg,
    }
    values = {
        "wanted": list(calibration.wanted),
        "estimates": [estimate.model_dump(mode="json") for estimate in calibration.estimates],
        "applied": [estimate.name for estimate in calibration.applied],
        "residuals": residuals,
    }
    return Summary(_key_figure(calibration), values, _warnings(calibration, survey))


def _key_figure(calibration: RigCalibration) -> str:
    if not calibration.wanted:
        return "nothing to estimate"
    parts = []
    for estimate in calibration.estimates:
        value = ", ".join(f"{number:.3f}" for number in estimate.value)
        sigma = ", ".join(f"{number:.3f}" for number in estimate.sigma)
        unit = {"s": " s", "deg": "°", "m": " m"}[estimate.unit]
        remark = "" if estimate in calibration.applied else " (not applied)"
        remark = remark if estimate.usable else " (not observable, not applied)"
        parts.append(f"{estimate.name} {value} ± {sigma}{unit}{remark}")
    return "; ".join(parts) or "nothing of the rig is observable"


def _warnings(calibration: RigCalibration, survey: Survey) -> tuple[str, ...]:
    """Return warnings of parameters that keep the values of `ingest` although they were to be estimated."""
    if calibration.problem:
        return (f"{calibration.problem}; {', '.join(calibration.wanted)} stay as told",)
    warnings = [
        f"{estimate.name} is not observable in this flight (σ {max(estimate.sigma):.2g} {estimate.unit}): it stays "
        "as told"
        for estimate in calibration.estimates
        if not estimate.usable
    ]
    missed = [name for name in survey.estimate if name not in calibration.wanted]
    if missed:
        warnings.append(f"--estimate leaves out what ingest was asked to estimate: {', '.join(missed)}")
    return tuple(warnings)


def _data(survey: Survey, model: SparseModel, track: NavigationTrack) -> RigData:
    row_of = {name: row for row, name in enumerate(track.image.tolist())}
    registered = [index for index, name in enumerate(model.image_name) if name in row_of]
    rows = [row_of[model.image_name[index]] for index in registered]
    control, _ = control_correspondences(survey, model)
    pixel_rad, footprint = _pixel(model)
    return RigData(
        positions=track.positions,
        attitudes=track.attitudes,
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
    """Return the angle of a pixel in radians, and its width at the distance of the points in units of local."""
    arm = model.point_in_local[model.obs_point] - model.cam_center_in_local[model.obs_image]
    focal = np.array([model.camera_of(image).mean_focal_px for image in range(len(model.image_name))])
    footprint = np.median(np.linalg.norm(arm, axis=1) / focal[model.obs_image])
    return float(1.0 / np.median(focal)), float(footprint)


def _estimate(name: RigParameter, value: ArrayLike, sigma: ArrayLike, start: ArrayLike) -> RigEstimate:
    values, sigmas, starts = (tuple(float(number) for number in np.ravel(row)) for row in (value, sigma, start))
    limit, unit = _LIMITS[name]
    # A parameter without any information has an infinite σ, which JSON cannot hold.
    sigmas = tuple(min(number, _ENDLESS) for number in sigmas)
    return RigEstimate(
        name=name,
        unit=unit,
        value=values,
        sigma=sigmas,
        start=starts,
        observable=tuple(number <= limit for number in sigmas),
    )


def _degrees(rotation: FloatArray) -> FloatArray:
    return np.degrees(log_so3(rotation))
