"""Hypotheses that would reconcile fixes with the SfM model, or control points with the fixes.

Each hypothesis changes the fixes as a known mistake would have changed them back, and is judged by how well the
changed fixes fit the model: by the robust scatter about the best similarity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla, enu_from_ecef, lla_from_ecef
from pipelines.geodesy.vertical import FOOT_M, MOST_GEOID_M
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.robust.statistics import median_chi2

_LEAST_FEET_M = 50.0
_FEET_PART = 0.05  # of a height, by which cameras are higher than control points
# A hypothesis explains a contradiction if it lowers the scatter by so much.
_EXPLAINS = 2.0
_CLOCK_S, _CLOCK_STEP_S = 15.0, 0.25
_ROUNDS = 20
_LEAST = 4


@dataclass(frozen=True)
class Hypothesis:
    """A mistake that would explain the measurements.

    Attributes:
        code: stable word.
        sentence: the mistake, and what to do.
        scatter_m: robust scatter per axis of the corrected fixes about the SfM model.
        geo_from_local: similarity of the corrected fixes.
    """

    code: str
    sentence: str
    scatter_m: float
    geo_from_local: Similarity


def fit(center_in_local: FloatArray, position_in_geo: FloatArray) -> tuple[Similarity, float]:
    """Return the similarity with the least sum of distances, and the robust scatter per axis in metres.

    Raises:
        DegenerateGeometryError: the positions do not determine a similarity.
    """
    weight = np.ones(len(center_in_local))
    for _ in range(_ROUNDS):
        similarity = umeyama(center_in_local, position_in_geo, weight)
        distance = np.linalg.norm(position_in_geo - similarity.apply(center_in_local), axis=1)
        weight = 1.0 / np.maximum(distance, 1e-3 + 0.1 * float(np.median(distance)))
    redundancy = max(1.0 - 7.0 / (3.0 * len(distance)), 0.05)
    return similarity, float(np.median(distance) / np.sqrt(median_chi2(3) * redundancy))


def explanations_of_fixes(
    center_in_local: FloatArray, position_in_geo: FloatArray, time_s: FloatArray, origin: Origin
) -> list[Hypothesis]:
    """Return the mistakes that would make the fixes fit the SfM model, the best first.

    Args:
        center_in_local: (n, 3) projection centres.
        position_in_geo: (n, 3) fixes.
        time_s: (n,) times of the photographs, NaN where unknown.
        origin: of geo.
    """
    if len(center_in_local) < _LEAST:
        return []
    try:
        scatter = fit(center_in_local, position_in_geo)[1]
    except DegenerateGeometryError:
        return []
    tried: list[Hypothesis] = []
    changes = (*_changed_axes(position_in_geo, origin), *_drifts(position_in_geo, center_in_local, time_s))
    for code, sentence, changed in changes:
        tried += _tried(code, sentence, center_in_local, changed)
    tried += _clock(center_in_local, position_in_geo, time_s)
    good = [hypothesis for hypothesis in tried if hypothesis.scatter_m < scatter / _EXPLAINS]
    return sorted(good, key=lambda hypothesis: hypothesis.scatter_m)


def mirrored(position_in_geo: FloatArray) -> FloatArray:
    """Return positions (n, 3) with east and north exchanged, about their mean."""
    middle = position_in_geo.mean(axis=0)
    return np.asarray((position_in_geo - middle)[:, [1, 0, 2]] + middle)


def _tried(code: str, sentence: str, center: FloatArray, changed: FloatArray) -> list[Hypothesis]:
    try:
        similarity, scatter = fit(center, changed)
    except DegenerateGeometryError:
        return []
    return [Hypothesis(code, sentence, scatter, similarity)]


def _changed_axes(position: FloatArray, origin: Origin) -> Iterator[tuple[str, str, FloatArray]]:
    yield (
        "axis-order",
        "the track is mirrored: east and north are exchanged; check the order of the columns and the CRS",
        mirrored(position),
    )
    yield "axis-order", "latitude and longitude are exchanged", _latitude_for_longitude(position, origin)
    feet = position * np.array([1.0, 1.0, FOOT_M])
    yield "feet", "the heights are in feet: give a CRS whose vertical unit is the foot", feet
    metres = position / np.array([1.0, 1.0, FOOT_M])
    yield "feet", "the heights are in metres, although the CRS has feet", metres
    down = position * np.array([1.0, 1.0, -1.0])
    yield "heights-down", "the heights count downward", down


def _latitude_for_longitude(position: FloatArray, origin: Origin) -> FloatArray:
    lla = lla_from_ecef(ecef_from_enu(position, origin))
    middle = np.median(lla, axis=0)
    exchanged = np.column_stack([lla[:, 1], lla[:, 0], lla[:, 2]])
    exchanged = exchanged - exchanged.mean(axis=0) + np.array([middle[1], middle[0], middle[2]])
    if np.abs(exchanged[:, 0]).max() > 89.0:
        return position
    place = Origin(lat_deg=float(middle[1]), lon_deg=float(middle[0]), alt_m=origin.alt_m)
    return enu_from_ecef(ecef_from_lla(exchanged), place)


def _drifts(position: FloatArray, center: FloatArray, time_s: FloatArray) -> Iterator[tuple[str, str, FloatArray]]:
    """Remove a drift that is linear in time, or a step at one time, both estimated against the SfM model."""
    if not np.isfinite(time_s).all() or len(time_s) < 2 * _LEAST:
        return
    order = np.argsort(time_s, kind="stable")
    since = time_s - time_s[order[0]]
    if since.max() <= 0:
        return
    part = since / since.max()
    changed, slope = _without(position, center, part)
    yield (
        "drift",
        f"the fixes drift by {_vector(slope)} m east, north, up from the first photograph to the last",
        changed,
    )
    best: tuple[float, FloatArray, FloatArray, int] | None = None
    for first in range(_LEAST, len(order) - _LEAST + 1, max(1, len(order) // 24)):
        later = np.zeros(len(order))
        later[order[first:]] = 1.0
        moved, step = _without(position, center, later)
        try:
            scatter = fit(center, moved)[1]
        except DegenerateGeometryError:
            continue
        if best is None or scatter < best[0]:
            best = (scatter, moved, step, first)
    if best is not None:
        yield (
            "step",
            f"the last {len(order) - best[3]} of {len(order)} fixes are shifted by {_vector(best[2])} m east, "
            "north, up against the others: another base station or datum",
            best[1],
        )


def _without(position: FloatArray, center: FloatArray, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the fixes less an error that is proportional to `shape` (n,), and the error (3,) of shape 1."""
    changed, total = position, np.zeros(3)
    design = np.column_stack([shape, np.ones(len(shape))])
    for _ in range(10):
        residual = changed - fit(center, changed)[0].apply(center)
        step = np.linalg.lstsq(design, residual, rcond=None)[0][0]
        total, changed = total + step, changed - shape[:, None] * step
        if np.abs(step).max() < 1e-3:
            break
    return changed, total


def _clock(center: FloatArray, position: FloatArray, time_s: FloatArray) -> list[Hypothesis]:
    """Take the fixes at other times than the photographs'."""
    timed = np.flatnonzero(np.isfinite(time_s))
    order = timed[np.argsort(time_s[timed], kind="stable")]
    order = order[np.concatenate([[True], np.diff(time_s[order]) > 1e-3])] if len(order) else order
    if len(order) < 2 * _LEAST:
        return []
    track = CubicSpline(time_s[order], position[order])
    first, last = time_s[order[0]], time_s[order[-1]]
    best: tuple[float, float, Similarity] | None = None
    for offset in np.arange(-_CLOCK_S, _CLOCK_S + 1e-9, _CLOCK_STEP_S):
        inside = order[(time_s[order] + offset >= first) & (time_s[order] + offset <= last)]
        if abs(offset) < 1e-9 or len(inside) < max(_LEAST, len(order) // 2):
            continue
        try:
            similarity, scatter = fit(center[inside], track(time_s[inside] + offset))
        except DegenerateGeometryError:
            continue
        if best is None or scatter < best[0]:
            best = (scatter, float(offset), similarity)
    if best is None:
        return []
    sentence = (
        f"the navigation clock is off by about {best[1]:+.2f} s against the camera's: correct the times, or let "
        "`georef ingest --time-offset auto` estimate the offset"
    )
    return [Hypothesis("clock", sentence, best[0], best[2])]


def shift_sentence(shift_m: FloatArray, height_m: float) -> str:
    """Return the likely cause of a constant shift between fixes and control points.

    Args:
        shift_m: (3,) east, north, up; of which of the two is of no account.
        height_m: height of the control points as stated.
    """
    horizontal, vertical = float(np.hypot(shift_m[0], shift_m[1])), abs(float(shift_m[2]))
    for sign in (-1.0, 1.0):
        other_m = height_m + sign * float(shift_m[2])
        for high, low, side in ((height_m, other_m, "control points"), (other_m, height_m, "fixes")):
            if vertical > _LEAST_FEET_M and abs(high * FOOT_M - low) < _FEET_PART * abs(low):
                return f"the heights of the {side} are in feet, and taken for metres"
    if horizontal < 0.2 * vertical and 5.0 < vertical < MOST_GEOID_M:
        return (
            f"heights apart by {vertical:.1f} m: one above the ellipsoid, the other above a geoid or the take-off"
        )
    if horizontal < 0.2 * vertical and vertical >= MOST_GEOID_M:
        return "heights above another zero: the take-off, or another unit"
    if horizontal > 100_000.0:
        return "another zone, or exchanged axes"
    if horizontal > 20.0:
        return "another datum, or another realisation of it"
    return "the position of the base station, the datum, or the antenna offset"


def _vector(values: FloatArray) -> str:
    return "(" + ", ".join(f"{value:+.2f}" for value in values) + ")"
