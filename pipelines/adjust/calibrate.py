"""Stage `calibrate`: time offset, and starts of boresight and lever arm, by SfM cameras and recorded navigation.

Reads `ingest/survey.json`, `sfm/sparse`, and `ingest/track.npz` if the navigation was recorded by time; positions
by photograph are tested for a lag instead. Writes `calibrate/rig.json`. Its applied estimates change positions and
attitudes when later stages read the survey (`survey.navigation.load_survey`). The SfM model stays as it is.

Boresight and lever arm are unknowns of the adjustment. It needs a start: an arm of a metre would make outliers of
most positions of an RTK receiver. Here they are free so that their errors do not become a time offset.
"""

from typing import Literal

import numpy as np

from pipelines.adjust import rig_fit
from pipelines.adjust.fix_patterns import FixPattern, pattern_of
from pipelines.adjust.measurements import control_correspondences
from pipelines.adjust.options import CalibrateOptions
from pipelines.adjust.state import SIGMA_ARM_M, SIGMA_BORESIGHT_RAD, is_observed
from pipelines.core.errors import DegenerateGeometryError, MissingProductError
from pipelines.core.products import Remark, load_json, save_json
from pipelines.core.stages import SPARSE, SURVEY, TRACK
from pipelines.core.types import BoolArray, FloatArray, vector3
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.rotations import log_so3
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.navigation import (
    FIX_LAG,
    FIX_LAG_OPEN,
    FixLag,
    NavigationTrack,
    RigCalibration,
    RigEstimate,
    apply_calibration,
    load_track,
    shown_by,
)
from pipelines.survey.survey import RigParameter, Survey

# A parameter without any information has an infinite σ, which JSON cannot hold.
_ENDLESS = 1e6
# A lag counts as open beyond this σ; of a receiver that writes its last fix it has the other, without any evidence.
OPEN_LAG_S, _PRIOR_LAG_S = 0.1, 0.3


def run(stage: StageRun, options: CalibrateOptions) -> Summary:
    """Estimate the rig of the flight and write the estimates; without any to estimate, write an empty product."""
    workspace, calibration = stage.workspace, RigCalibration()
    survey = load_json(Survey, workspace.path(SURVEY))
    model = read_sparse(workspace.path(SPARSE))
    track = _track(workspace, needed="time-offset" in survey.estimate)
    if track is not None and _wanted(survey, track):
        calibration = calibrate(survey, model, track, options)
    if options.apply:
        calibration = with_lag(survey, model, track, calibration)
    save_json(calibration, stage.out / "rig.json")
    return _summary(calibration)


def _track(workspace: Workspace, *, needed: bool) -> NavigationTrack | None:
    """Return the recorded navigation; None: there is none, and none is needed."""
    try:
        workspace.path(TRACK)
    except MissingProductError:
        if not needed:
            return None
    return load_track(workspace)


def calibrate(
    survey: Survey, model: SparseModel, track: NavigationTrack, options: CalibrateOptions
) -> RigCalibration:
    """Return the estimates of the rig.

    They are those of the survey that the navigation can show. The observable ones are applied, unless
    `options.apply` forbids it. A flight in which no parameter is observable is no failure: `problem` states the
    reason.
    """
    wanted = _wanted(survey, track)
    data, start_s = _data(survey, model, track), float(track.time_offset_s)
    free = rig_fit.FitOptions("time-offset" in wanted, "lever-arm" in wanted, options.max_offset)
    try:
        fit = rig_fit.fit_rig(data, start_s, track.nominal_from_cam, free)
    except DegenerateGeometryError as error:
        return RigCalibration(wanted=wanted, problem=error.fault, remedy=error.remedy)
    estimated = _estimates(fit, track)
    estimates = [estimated[name] for name in wanted]
    applied = tuple(estimate for estimate in estimates if options.apply and all(estimate.observable))
    attitude = fit.rms_attitude_deg
    return RigCalibration(
        wanted=wanted,
        applied=applied,
        not_applied=tuple(estimate for estimate in estimates if estimate not in applied),
        images=fit.images,
        control_points=len(data.control),
        rms_position_m=fit.rms_position_m,
        rms_attitude_deg=attitude if np.isfinite(attitude) else None,
    )


def with_lag(
    survey: Survey, model: SparseModel, track: NavigationTrack | None, calibration: RigCalibration
) -> RigCalibration:
    """Return the calibration with the lag that the residuals of positions by photograph show.

    Of positions from a recorded navigation, whose times somebody answers for, a time offset is estimated if it is
    asked for, and a lag if that offset is not observable.
    """
    observed = {estimate.name for estimate in calibration.estimates if all(estimate.observable)}
    is_open = "time-offset" in set(survey.estimate) & set(calibration.wanted) and "time-offset" not in observed
    if survey.origin is None or not (track is None or is_open):
        return calibration
    calibrated = survey
    if calibration.applied and track is not None:
        calibrated = apply_calibration(survey, track, calibration)
    pattern = pattern_of(calibrated, model)
    if pattern is None:
        return calibration
    return calibration.model_copy(update={"fix_lag": lag_of(calibrated, pattern)})


def lag_of(survey: Survey, pattern: FixPattern) -> FixLag:
    """Return the lag of a survey's positions; one that the flight leaves open is a σ along the motion.

    Positions that were computed for the exposures, as those of RTK receivers and of tables, have no open lag.
    """
    by_receiver = {
        image.name
        for image in survey.images
        if image.fix is not None
        and image.fix.source == "exif"
        and not (survey.sessions and survey.sessions[image.fix.session].receiver.startswith("RTK"))
    }
    is_open = pattern.sigma_lag_s > OPEN_LAG_S and by_receiver.issuperset(pattern.name)
    sigma_along_s = 0.0
    if pattern.has_lag:
        sigma_along_s = min(pattern.sigma_lag_s, abs(pattern.lag_s))
    elif is_open:
        sigma_along_s = min(pattern.sigma_lag_s, max(_PRIOR_LAG_S, abs(pattern.lag_s) / 2.0))
    return FixLag(
        lag_s=pattern.lag_s,
        sigma_s=min(pattern.sigma_lag_s, _ENDLESS),
        applied=pattern.has_lag,
        sigma_along_s=sigma_along_s,
        scatter_m=pattern.scatter_m,
        velocity_in_geo={
            name: vector3(velocity) for name, velocity in zip(pattern.name, pattern.velocity_in_geo, strict=True)
        },
    )


def _wanted(survey: Survey, track: NavigationTrack) -> tuple[RigParameter, ...]:
    return tuple(name for name in shown_by(track) if name in survey.estimate)


def _data(survey: Survey, model: SparseModel, track: NavigationTrack) -> rig_fit.RigData:
    """Return cameras and control points; the size of a pixel is the median over images, at the points' distance."""
    row_of = {name: row for row, name in enumerate(track.image.tolist())}
    registered = [index for index, name in enumerate(model.image_name) if name in row_of]
    rows = [row_of[model.image_name[index]] for index in registered]
    control, _ = control_correspondences(survey, model)
    distance = np.linalg.norm(
        model.point_in_local[model.obs_point] - model.cam_center_in_local[model.obs_image], axis=1
    )
    return rig_fit.RigData(
        positions=track.positions,
        attitudes=track.attitudes,
        time_s=track.image_time_s[rows],
        center_in_local=model.cam_center_in_local[registered],
        cam_from_local=model.rotation_cam_from_local[registered],
        cam_from_body=track.cam_from_body[rows],
        antenna_in_body=np.nan_to_num(track.antenna_in_body[rows]),
        control=control,
        pixel_rad=float(1.0 / np.median(model.focal_px)),
        footprint_in_local=float(np.median(distance / model.focal_px[model.obs_image])),
    )


def _estimates(fit: rig_fit.RigFit, track: NavigationTrack) -> dict[RigParameter, RigEstimate]:
    start_s, start_deg = track.time_offset_s.reshape(1), np.degrees(log_so3(track.nominal_from_cam))
    start_m = np.nan_to_num(track.antenna_in_body).mean(axis=0)
    value_s, sigma_s = np.array([fit.state.offset_s]), fit.sigma[rig_fit.OFFSET]
    value_deg, sigma_deg = np.degrees(log_so3(fit.state.boresight)), np.degrees(fit.sigma[rig_fit.BORESIGHT])
    sigma_m = fit.sigma[rig_fit.ARM]
    offset_seen = sigma_s <= rig_fit.LIMIT_OFFSET_S
    boresight_seen = is_observed("boresight", fit.sigma[rig_fit.BORESIGHT], SIGMA_BORESIGHT_RAD)
    arm_seen = is_observed("lever-arm", sigma_m, SIGMA_ARM_M)
    quantities: dict[
        RigParameter, tuple[Literal["s", "deg", "m"], BoolArray, FloatArray, FloatArray, FloatArray]
    ] = {
        "time-offset": ("s", offset_seen, value_s, sigma_s, start_s),
        "boresight": ("deg", boresight_seen, value_deg, sigma_deg, start_deg),
        "lever-arm": ("m", arm_seen, start_m + fit.state.arm, sigma_m, start_m),
    }
    return {
        name: RigEstimate(
            name=name,
            unit=unit,
            value=tuple(value.tolist()),
            sigma=tuple(np.minimum(sigma, _ENDLESS).tolist()),
            start=tuple(start.astype(float).tolist()),
            observable=tuple(seen.tolist()),
        )
        for name, (unit, seen, value, sigma, start) in quantities.items()
    }


def _summary(calibration: RigCalibration) -> Summary:
    lag = calibration.fix_lag
    values = {
        "fix_lag": None if lag is None else lag.model_dump(mode="json", exclude={"velocity_in_geo"}),
        "wanted": list(calibration.wanted),
        "estimates": [estimate.model_dump(mode="json") for estimate in calibration.estimates],
        "applied": [estimate.name for estimate in calibration.applied],
        "residuals": calibration.model_dump(
            include={"images", "control_points", "rms_position_m", "rms_attitude_deg"}
        ),
    }
    return Summary(_key_figure(calibration), values, _warnings(calibration))


def _key_figure(calibration: RigCalibration) -> str:
    parts = []
    lag = calibration.fix_lag
    if lag is not None and lag.applied:
        side = "lag" if lag.lag_s > 0 else "lead"
        parts.append(f"positions {side} the exposures by {abs(lag.lag_s):.2f} ± {lag.sigma_s:.2f} s (applied)")
    if not calibration.wanted:
        return "; ".join(parts) or "nothing to estimate"
    for estimate in calibration.estimates:
        value = ", ".join(f"{number:.3f}" for number in estimate.value)
        sigma = ", ".join(f"{number:.3f}" for number in estimate.sigma)
        unit = {"s": " s", "deg": "°", "m": " m"}[estimate.unit]
        remark = "" if estimate in calibration.applied else " (not applied)"
        remark = remark if all(estimate.observable) else " (not observable, not applied)"
        parts.append(f"{estimate.name} {value} ± {sigma}{unit}{remark}")
    return "; ".join(parts) or "nothing of the rig is observable"


def _warnings(calibration: RigCalibration) -> tuple[Remark, ...]:
    """Return warnings of a lag, and of a time offset that stays as `ingest` set it although it was asked for.

    What the flight does not show of boresight and lever arm is said of their solution, by `init-sim3`.
    """
    warnings = []
    if calibration.fix_lag is not None and (calibration.fix_lag.applied or calibration.fix_lag.sigma_along_s):
        code = FIX_LAG if calibration.fix_lag.applied else FIX_LAG_OPEN
        warnings.append(Remark(code=code, sentence=calibration.fix_lag.sentence))
    if calibration.problem:
        sentence = f"{calibration.problem} The values that ingest set stay: {', '.join(calibration.wanted)}."
        return (*warnings, Remark(code="rig-not-calibrated", sentence=sentence, remedy=calibration.remedy))
    warnings += [
        Remark(
            code="rig-not-observable",
            sentence=f"The time offset is not observable in this flight (σ {max(estimate.sigma):.2g} s): the value "
            "that ingest set stays.",
        )
        for estimate in calibration.estimates
        if estimate.name == "time-offset" and not all(estimate.observable) and not warnings
    ]
    return tuple(warnings)
