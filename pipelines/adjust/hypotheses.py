"""Hypotheses that would reconcile fixes with the SfM model.

Each hypothesis changes the fixes back as a known mistake would have changed them. Its cost is the sum of the
truncated squares that it leaves, and a price for each unknown that it adds: many unknowns explain noise, too. The
plain fit competes, with what it leaves as blunders or noise. Solutions in which the cameras hang upside down are no
explanation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from pipelines.adjust.alignment import RotationPrior, turn_against
from pipelines.adjust.measurements import fix_correspondences
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.sentences import listed
from pipelines.core.types import FloatArray, IntArray
from pipelines.geodesy.enu import Origin, ecef_from_lla, enu_from_ecef, lla_from_enu
from pipelines.geodesy.vertical import FOOT_M
from pipelines.geometry import statistics
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.survey import Survey

# A hypothesis explains an inconsistency if it lowers the scatter by so much.
_EXPLAINS = 2.0
# GPS time is 18 s ahead of UTC, and offsets of half a minute are clocks that were set by hand.
_CLOCK_S, _CLOCK_STEP_S, _LEAP_S = 40.0, 0.25, 18.0
_LEAST_CLOCK_S, _TURN_S = 0.01, 2.0
_WORTH = 10.0  # times the least cost of a step, up to which a minimum between two steps is looked for
_ROUNDS, _DRAWS = 20, 300
_LEAST = 4
_GATE = statistics.outlier_gate(3)
_BLUNDER = 4.0 * _GATE  # SfM's own errors add to those of the fixes
_MEMBER = 2.0 * np.log(2.0)  # price of saying of one fix to which of two groups it belongs
# Median of (up component of the image's upward direction) + (down component of the view) below which cameras hang
# upside down: level and nadir cameras have 1, and oblique ones up to 1.4.
_UPSIDE_DOWN = -0.2


class StatedFixes:
    """Fixes of a survey's n registered photographs as stated, against the SfM model."""

    def __init__(self, survey: Survey, model: SparseModel) -> None:
        fixes = fix_correspondences(survey, model)
        times = {image.name: image.timestamp_s for image in survey.images}
        self.model, self.survey, self.name = model, survey, fixes.name
        self.center_in_local, self.position_in_geo = fixes.in_local, fixes.in_geo  # (n, 3), and (n, 3) in metres
        self.time_s = np.array([times[name] for name in fixes.name], dtype=np.float64)  # (n,), NaN where unknown
        self.sigma_m = statistics.typical_sigma(fixes.cov_in_geo) if len(fixes) else np.nan  # per axis


@dataclass(frozen=True)
class Hypothesis:
    """A mistake that would explain the measurements, and what to do."""

    code: str
    sentence: str
    scatter_m: float  # robust scatter per axis of the corrected fixes about the SfM model
    geo_from_local: Similarity  # of the corrected fixes
    distance_m: FloatArray  # (n,) of the corrected fixes from the SfM model; NaN where the hypothesis says nothing
    price: float = 0.0  # of the unknowns that it adds, in units of −2 ln likelihood
    remedy: str = ""  # what to type against it


_IN_FEET = "The heights are in feet."
# What to type, by sentence.
_REMEDIES = {_IN_FEET: "Give a CRS whose vertical unit is the foot (--crs)."}
# Code, sentence, fixes (n, 3) without the mistake, and price of its unknowns.
_Change = tuple[str, str, FloatArray, float]


def fit(center_in_local: FloatArray, position_in_geo: FloatArray) -> tuple[Similarity, float]:
    """Return the similarity with the least sum of distances, and the robust scatter per axis in metres.

    Raises:
        DegenerateGeometryError: the positions do not determine a similarity.
    """
    weight = np.ones(len(center_in_local))
    for _ in range(_ROUNDS):
        similarity = umeyama(center_in_local, position_in_geo, weight)
        distance = _distances(similarity, center_in_local, position_in_geo)
        weight = 1.0 / np.maximum(distance, 1e-3 + 0.1 * float(np.median(distance)))
    redundancy = max(1.0 - 7.0 / (3.0 * len(distance)), 0.05)
    return similarity, float(np.median(distance) / np.sqrt(statistics.median_chi2(3) * redundancy))


def _distances(similarity: Similarity, center_in_local: FloatArray, position_in_geo: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(position_in_geo - similarity.apply(center_in_local), axis=1))


def hangs_upside_down(model: SparseModel, geo_from_local: Similarity) -> bool:
    """Return whether the median camera of a model in `geo` has its upper edge, and its back, below it."""
    up_in_cam = model.rotation_cam_from_local @ geo_from_local.rotation[2]
    return float(np.median(-up_in_cam[:, 1] - up_in_cam[:, 2])) < _UPSIDE_DOWN


def mirrored(position_in_geo: FloatArray) -> FloatArray:
    """Return positions (n, 3) with east and north exchanged, about their mean."""
    middle = position_in_geo.mean(axis=0)
    return np.asarray((position_in_geo - middle)[:, [1, 0, 2]] + middle)


def explanation_of(fixes: StatedFixes) -> Hypothesis | None:
    """Return the likeliest mistake that would make the fixes fit the SfM model; None: no known one does."""
    if len(fixes.name) < _LEAST:
        return None
    try:
        consensus, plain = _plain(fixes)
    except DegenerateGeometryError:
        return None
    of_one = float(np.log(3.0 * len(fixes.name)))  # price of one unknown
    changes = chain(_changed_axes(fixes), _drifts(fixes, of_one), _groups(fixes, consensus, 3.0 * of_one))
    tried = []
    for code, sentence, changed, price in changes:
        with suppress(DegenerateGeometryError):
            similarity, scatter = fit(fixes.center_in_local, changed)
            distance = _distances(similarity, fixes.center_in_local, changed)
            remedy = _REMEDIES.get(sentence, "")
            tried.append(Hypothesis(code, sentence, scatter, similarity, distance, price, remedy))
    tried += _clock(fixes, 3.0 * of_one)
    good = [
        one
        for one in tried
        if one.scatter_m < plain.scatter_m / _EXPLAINS and not hangs_upside_down(fixes.model, one.geo_from_local)
    ]
    sigma_m = max(fixes.sigma_m, min(one.scatter_m for one in (plain, *good)))

    def cost(one: Hypothesis) -> float:
        """Return −2 ln likelihood at a σ per axis, blunders at the price of the gate."""
        known = np.nan_to_num(one.distance_m / sigma_m, nan=np.sqrt(_GATE / 2))
        return float(np.minimum(known**2, _GATE).sum()) + one.price

    best = min((plain, *good), key=cost)
    return _blunders(fixes, plain) if best is plain else best


def clock_that_turns(fixes: StatedFixes, attitude: RotationPrior) -> tuple[float, float] | None:
    """Return the clock offset in s that turns a solution onto its attitudes, and the angle left in rad.

    On a circle, or on lines in one direction, a wrong time turns or shifts the whole flight without any scatter.
    None: the times are unknown, or no offset within the search fits the model as well as none.
    """
    track = _Track.of(fixes)
    if track is None:
        return None
    limit = _EXPLAINS * max(track.at(0.0)[1], 1e-6)

    def turn(offset_s: float) -> float:
        similarity, scatter, _ = track.at(offset_s)
        return turn_against(attitude, similarity) + (0.0 if scatter < limit else np.pi)

    best = min(_minima(turn, track.offsets(_TURN_S)), key=lambda one: one[1], default=None)
    return None if best is None or best[1] > np.pi else best


def _plain(fixes: StatedFixes) -> tuple[Similarity, Hypothesis]:
    """Return the similarity that the most fixes agree with, and the fit to these, or to all if most disagree."""
    center, position = fixes.center_in_local, fixes.position_in_geo
    consensus = statistics.ransac(
        len(fixes.name),
        lambda chosen: umeyama(center[chosen], position[chosen]),
        lambda found: _distances(found, center, position) ** 2 / fixes.sigma_m**2,
        statistics.RansacOptions(3, _BLUNDER, max_draws=_DRAWS),
        np.random.default_rng(0),
    ).model
    similarity, scatter = fit(center, position)
    agreeing = _distances(consensus, center, position) ** 2 <= _BLUNDER * fixes.sigma_m**2
    if agreeing.mean() > 0.5:
        with suppress(DegenerateGeometryError):
            similarity = fit(center[agreeing], position[agreeing])[0]
    return consensus, Hypothesis("", "", scatter, similarity, _distances(similarity, center, position))


def _blunders(fixes: StatedFixes, plain: Hypothesis) -> Hypothesis | None:
    residual = fixes.position_in_geo - plain.geo_from_local.apply(fixes.center_in_local)
    bad = statistics.blunders_among(residual, fixes.sigma_m)
    if bad is None:
        return None
    scatter = statistics.scatter_about_median(residual[~bad])
    if scatter > max(plain.scatter_m / _EXPLAINS, _BLUNDER**0.5 * fixes.sigma_m):
        return None
    distance, rows = plain.distance_m, np.flatnonzero(bad)
    worst_first = rows[np.argsort(-distance[rows], kind="stable")]
    worst = listed([f"{fixes.name[row]} ({distance[row]:.1f} m)" for row in worst_first])
    sentence = f"{len(rows)} of {len(fixes.name)} fixes are blunders; the others agree. Remove {worst}."
    return replace(plain, code="fix-outliers", sentence=sentence, scatter_m=scatter)


def _changed_axes(fixes: StatedFixes) -> Iterator[_Change]:
    position = fixes.position_in_geo
    yield (
        "axis-order",
        "The track is mirrored: east and north are exchanged. Check the order of the columns and the CRS.",
        mirrored(position),
        0.0,
    )
    yield (
        "axis-order",
        "Latitude and longitude are exchanged.",
        _latitude_for_longitude(position, fixes.survey.origin_on_earth),
        0.0,
    )
    for code, sentence, factor in (
        ("feet", _IN_FEET, FOOT_M),
        ("feet", "The heights are in metres, although the CRS has feet.", 1.0 / FOOT_M),
        ("heights-down", "The heights count downward.", -1.0),
    ):
        yield code, sentence, position * np.array([1.0, 1.0, factor]), 0.0


def _latitude_for_longitude(position: FloatArray, origin: Origin) -> FloatArray:
    """Return the positions (n, 3) with latitude and longitude exchanged, about the median of their places."""
    lla = lla_from_enu(position, origin)
    middle = np.median(lla, axis=0)[[1, 0, 2]]
    exchanged = lla[:, [1, 0, 2]] - lla[:, [1, 0, 2]].mean(axis=0) + middle
    if np.abs(exchanged[:, 0]).max() > 89.0:
        return position
    exchanged_origin = Origin(lat_deg=float(middle[0]), lon_deg=float(middle[1]), alt_m=origin.alt_m)
    return enu_from_ecef(ecef_from_lla(exchanged), exchanged_origin)


def _drifts(fixes: StatedFixes, price: float) -> Iterator[_Change]:
    """Remove a drift that is linear in time, or a step at one time, both estimated against the SfM model."""
    count, order = len(fixes.time_s), np.argsort(fixes.time_s, kind="stable")
    since = fixes.time_s - fixes.time_s[order[0]]
    if not np.isfinite(since).all() or count < 2 * _LEAST or since.max() <= 0:
        return
    changed, slope = _without(fixes, since / since.max())
    sentence = f"The fixes drift by {vector_text(slope)} m east, north, up from the first photograph to the last."
    yield "drift", sentence, changed, 3.0 * price
    steps = []
    for first in range(_LEAST, count - _LEAST + 1, max(1, count // 24)):
        later = np.zeros(count)
        later[order[first:]] = 1.0
        with suppress(DegenerateGeometryError):
            changed, step = _without(fixes, later)
            steps.append((fit(fixes.center_in_local, changed)[1], count - first, step, changed))
    if steps:
        _, shifted, step, changed = min(steps, key=lambda one: one[0])
        sentence = (
            f"The last {shifted} of {count} fixes are shifted by {vector_text(step)} m east, north, up against the "
            "others. Check base station and datum."
        )
        yield "step", sentence, changed, 4.0 * price


def _groups(fixes: StatedFixes, start: Similarity, price: float) -> Iterator[_Change]:
    count, similarity = len(fixes.name), start
    second = np.zeros(count, dtype=bool)
    for _ in range(_ROUNDS):
        groups = statistics.two_groups(fixes.position_in_geo - similarity.apply(fixes.center_in_local))
        if groups is None or np.array_equal(groups.second, second):
            break
        second = groups.second
        changed, apart = _without(fixes, second.astype(np.float64))
        similarity = fit(fixes.center_in_local, changed)[0]
    if not second.any():
        return
    shifted = listed([fixes.name[row] for row in np.flatnonzero(second)])
    sentence = (
        f"{int(second.sum())} of {count} fixes are shifted by {vector_text(apart)} m east, north, up against the "
        f"others ({shifted}). Check base station, datum and receiver."
    )
    yield "mixture", sentence, changed, price + _MEMBER * count


def _without(fixes: StatedFixes, shape: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the fixes less an error that is proportional to `shape` (n,), and the error (3,) of shape 1."""
    changed, total = fixes.position_in_geo, np.zeros(3)
    design = np.column_stack([shape, np.ones(len(shape))])
    for _ in range(10):
        residual = changed - fit(fixes.center_in_local, changed)[0].apply(fixes.center_in_local)
        step = np.linalg.lstsq(design, residual, rcond=None)[0][0]
        total, changed = total + step, changed - shape[:, None] * step
        if np.abs(step).max() < 1e-3:
            break
    return changed, total


def vector_text(values: FloatArray) -> str:
    """Return the components of a vector with signs and two decimals, in brackets."""
    return "(" + ", ".join(f"{value:+.2f}" for value in values) + ")"


def _clock(fixes: StatedFixes, price: float) -> Iterator[Hypothesis]:
    """Take the fixes at other times than the photographs'; on circles and parallel lines, several times may fit."""
    track = _Track.of(fixes)
    if track is None:
        return
    for offset, scatter in _minima(lambda offset: track.at(offset)[1], track.offsets(_CLOCK_S)):
        if abs(offset) < _LEAST_CLOCK_S:
            continue
        similarity, _, rows = track.at(offset)
        distance, position = np.full(len(fixes.name), np.nan), track.curve(fixes.time_s[rows] + offset)
        distance[rows] = _distances(similarity, fixes.center_in_local[rows], position)
        leap = ", as GPS time from UTC" if abs(abs(offset) - _LEAP_S) < 2.0 * _CLOCK_STEP_S else ""
        sentence = f"The navigation clock differs by {offset:+.2f} s from the camera's{leap}."
        remedy = "Correct the times, or let `georef ingest --time-offset auto` estimate the offset."
        yield Hypothesis("clock", sentence, scatter, similarity, distance, price, remedy)


@dataclass(frozen=True)
class _Track:
    """Fixes as a curve in time, and the rows (m,) of the photographs with a time, in its order."""

    fixes: StatedFixes
    rows: IntArray
    curve: CubicSpline

    @classmethod
    def of(cls, fixes: StatedFixes) -> _Track | None:
        rows = np.argsort(fixes.time_s, kind="stable")
        rows = rows[np.isfinite(fixes.time_s[rows])]
        # A curve has one place at a time: of photographs within a millisecond, the first stands for all.
        rows = rows[np.diff(fixes.time_s[rows], prepend=-np.inf) > 1e-3]
        if len(rows) < 2 * _LEAST:
            return None
        return cls(fixes, rows, CubicSpline(fixes.time_s[rows], fixes.position_in_geo[rows]))

    def offsets(self, most_s: float) -> FloatArray:
        """Return the offsets to try, those that leave half of the photographs, and at least eight, on the curve."""
        steps = np.arange(-most_s, most_s + 1e-9, _CLOCK_STEP_S)
        count = np.array([len(self.rows_at(step)) for step in steps])
        return np.asarray(steps[count >= max(2 * _LEAST, len(self.rows) // 2)])

    def rows_at(self, offset_s: float) -> IntArray:
        time_s = self.fixes.time_s[self.rows]
        return np.asarray(self.rows[(time_s + offset_s >= time_s[0]) & (time_s + offset_s <= time_s[-1])])

    def at(self, offset_s: float) -> tuple[Similarity, float, IntArray]:
        """Return similarity, scatter in metres and rows of the photographs on the curve at a clock offset."""
        rows = self.rows_at(offset_s)
        position = self.curve(self.fixes.time_s[rows] + offset_s)
        return *fit(self.fixes.center_in_local[rows], position), rows


def _minima(cost: Callable[[float], float], offsets: FloatArray) -> list[tuple[float, float]]:
    """Return place and value of each local minimum over offsets; none at a border: what lies beyond is unknown."""

    def safe(offset: float) -> float:
        try:
            return cost(offset)
        except DegenerateGeometryError:
            return np.inf

    costs = np.array([safe(float(offset)) for offset in offsets])
    worth = _WORTH * np.nanmin(costs, initial=np.inf)
    minima = []
    for index in range(1, len(offsets) - 1):
        if costs[index] < worth and costs[index] <= min(costs[index - 1], costs[index + 1]):
            bounds = (float(offsets[index - 1]), float(offsets[index + 1]))
            refined = minimize_scalar(safe, bounds=bounds, method="bounded", options={"xatol": 1e-3})
            here = (float(offsets[index]), float(costs[index]))
            minima.append(min(here, (float(refined.x), float(refined.fun)), key=lambda one: one[1]))
    return minima
