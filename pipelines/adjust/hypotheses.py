"""Hypotheses that would reconcile fixes with the SfM model.

Each hypothesis changes the fixes back as a known mistake would have changed them. Its cost is the sum of the
truncated squares that it leaves, and a price for each unknown that it adds: many unknowns explain noise, too. The
plain fit competes, with what it leaves as blunders or noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.sentences import listed
from pipelines.core.types import FloatArray, IntArray
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla, enu_from_ecef, lla_from_ecef
from pipelines.geodesy.vertical import FOOT_M
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.robust.patterns import blunders_among, scatter_about_median, two_groups
from pipelines.robust.ransac import RansacOptions, ransac
from pipelines.robust.statistics import median_chi2, outlier_gate

# A hypothesis explains a contradiction if it lowers the scatter by so much.
_EXPLAINS = 2.0
# GPS time is 18 s ahead of UTC, and offsets of half a minute are clocks that were set by hand.
_CLOCK_S, _CLOCK_STEP_S, _LEAP_S = 40.0, 0.25, 18.0
_LEAST_CLOCK_S, _TURN_S = 0.01, 2.0
_WORTH = 10.0  # times the least cost of a step, up to which a minimum between two steps is looked for
_ROUNDS, _DRAWS = 20, 300
_LEAST = 4
_GATE = outlier_gate(3)
_BLUNDER = 4.0 * _GATE  # SfM's own errors add to those of the fixes
_MEMBER = 2.0 * np.log(2.0)  # price of saying of one fix to which of two groups it belongs


@dataclass(frozen=True)
class Hypothesis:
    """A mistake that would explain the measurements.

    Attributes:
        code: stable word.
        sentence: the mistake, and what to do.
        scatter_m: robust scatter per axis of the corrected fixes about the SfM model.
        geo_from_local: similarity of the corrected fixes.
        distance_m: (n,) of the corrected fixes from the SfM model; NaN where the hypothesis says nothing.
        price: of the unknowns that it adds, in units of −2 ln likelihood.
    """

    code: str
    sentence: str
    scatter_m: float
    geo_from_local: Similarity
    distance_m: FloatArray
    price: float = 0.0

    def cost(self, sigma_m: float) -> float:
        """Return −2 ln likelihood at a σ per axis, blunders at the price of the gate."""
        known = np.nan_to_num(self.distance_m / sigma_m, nan=np.sqrt(_GATE / 2))
        return float(np.minimum(known**2, _GATE).sum()) + self.price


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


def explanation_of_fixes(
    names: tuple[str, ...],
    center_in_local: FloatArray,
    position_in_geo: FloatArray,
    time_s: FloatArray,
    *,
    origin: Origin,
    sigma_m: float,
    plausible: Callable[[Similarity], bool],
) -> Hypothesis | None:
    """Return the likeliest mistake that would make the fixes fit the SfM model; None: no known one does.

    Args:
        names: of the n photographs.
        center_in_local: (n, 3) projection centres.
        position_in_geo: (n, 3) fixes.
        time_s: (n,) times of the photographs, NaN where unknown.
        origin: of geo.
        sigma_m: σ of the fixes per axis.
        plausible: whether a similarity may be right.
    """
    if len(center_in_local) < _LEAST:
        return None
    try:
        consensus = _consensus(center_in_local, position_in_geo, sigma_m)
        plain = _plain(center_in_local, position_in_geo, consensus, sigma_m)
    except DegenerateGeometryError:
        return None
    price = np.log(3.0 * len(names))
    tried: list[Hypothesis] = []
    changes = (*_changed_axes(position_in_geo, origin), *_drifts(position_in_geo, center_in_local, time_s))
    for code, sentence, changed, unknowns in changes:
        tried += _tried(code, sentence, center_in_local, changed, price=unknowns * price)
    tried += _groups(names, center_in_local, position_in_geo, consensus, price=3.0 * price)
    tried += _clock(center_in_local, position_in_geo, time_s, 3.0 * price)
    good = [one for one in tried if one.scatter_m < plain.scatter_m / _EXPLAINS and plausible(one.geo_from_local)]
    scale_m = max(sigma_m, min(one.scatter_m for one in (plain, *good)))
    best = min((plain, *good), key=lambda one: one.cost(scale_m))
    if best is not plain:
        return best
    return _blunders(names, position_in_geo - plain.geo_from_local.apply(center_in_local), plain, sigma_m)


def clock_that_turns(
    center_in_local: FloatArray,
    position_in_geo: FloatArray,
    time_s: FloatArray,
    turn_of: Callable[[Similarity], float],
) -> tuple[float, float] | None:
    """Return the clock offset in s that turns a solution onto its attitudes, and the angle left in rad.

    On a circle, or on lines in one direction, a wrong time turns or shifts the whole flight without any scatter.

    Args:
        center_in_local: (n, 3) projection centres.
        position_in_geo: (n, 3) fixes.
        time_s: (n,) times of the photographs, NaN where unknown.
        turn_of: angle in rad between the attitudes and a similarity.

    Returns:
        None: the times are unknown, or no offset within the search fits the model as well as none.
    """
    track = _Track.of(center_in_local, position_in_geo, time_s)
    if track is None:
        return None
    limit = _EXPLAINS * max(track.at(0.0)[1], 1e-6)

    def turn(offset_s: float) -> float:
        similarity, scatter, _ = track.at(offset_s)
        return turn_of(similarity) + (0.0 if scatter < limit else np.pi)

    found = min(_minima(turn, track.offsets(_TURN_S)), key=lambda one: one[1], default=None)
    return None if found is None or found[1] > np.pi else found


def mirrored(position_in_geo: FloatArray) -> FloatArray:
    """Return positions (n, 3) with east and north exchanged, about their mean."""
    middle = position_in_geo.mean(axis=0)
    return np.asarray((position_in_geo - middle)[:, [1, 0, 2]] + middle)


def _plain(center: FloatArray, position: FloatArray, consensus: Similarity, sigma_m: float) -> Hypothesis:
    """Return the fit of least distances, or that of the consensus if most fixes agree with it."""
    similarity, scatter = fit(center, position)
    agreeing = ((position - consensus.apply(center)) ** 2).sum(axis=1) <= _BLUNDER * sigma_m**2
    if agreeing.mean() > 0.5:
        with suppress(DegenerateGeometryError):
            similarity = fit(center[agreeing], position[agreeing])[0]
    return Hypothesis("", "", scatter, similarity, np.linalg.norm(position - similarity.apply(center), axis=1))


def _consensus(center: FloatArray, position: FloatArray, sigma_m: float) -> Similarity:
    """Return the similarity that the most fixes agree with.

    Raises:
        DegenerateGeometryError: the positions do not determine a similarity.
    """
    return ransac(
        len(center),
        lambda chosen: umeyama(center[chosen], position[chosen]),
        lambda found: ((position - found.apply(center)) ** 2).sum(axis=1) / sigma_m**2,
        RansacOptions(3, _BLUNDER, max_draws=_DRAWS),
        np.random.default_rng(0),
    ).model


def _blunders(names: tuple[str, ...], residual: FloatArray, plain: Hypothesis, sigma_m: float) -> Hypothesis | None:
    """Return the explanation by blunders among good fixes, from the residuals (n, 3) of the plain fit."""
    bad = blunders_among(residual, sigma_m)
    if bad is None:
        return None
    scatter = scatter_about_median(residual[~bad])
    if scatter > max(plain.scatter_m / _EXPLAINS, _BLUNDER**0.5 * sigma_m):
        return None
    distance, rows = plain.distance_m, np.flatnonzero(bad)
    worst = [f"{names[row]} ({distance[row]:.1f} m)" for row in rows[np.argsort(-distance[rows], kind="stable")]]
    sentence = f"{len(rows)} of {len(names)} fixes are blunders, the others agree; remove {listed(worst)}"
    return replace(plain, code="fix-outliers", sentence=sentence, scatter_m=scatter)


def _tried(code: str, sentence: str, center: FloatArray, changed: FloatArray, *, price: float) -> list[Hypothesis]:
    try:
        similarity, scatter = fit(center, changed)
    except DegenerateGeometryError:
        return []
    distance = np.linalg.norm(changed - similarity.apply(center), axis=1)
    return [Hypothesis(code, sentence, scatter, similarity, distance, price)]


def _changed_axes(position: FloatArray, origin: Origin) -> Iterator[tuple[str, str, FloatArray, int]]:
    yield (
        "axis-order",
        "the track is mirrored: east and north are exchanged; check the order of the columns and the CRS",
        mirrored(position),
        0,
    )
    yield "axis-order", "latitude and longitude are exchanged", _latitude_for_longitude(position, origin), 0
    feet = position * np.array([1.0, 1.0, FOOT_M])
    yield "feet", "the heights are in feet: give a CRS whose vertical unit is the foot", feet, 0
    metres = position / np.array([1.0, 1.0, FOOT_M])
    yield "feet", "the heights are in metres, although the CRS has feet", metres, 0
    down = position * np.array([1.0, 1.0, -1.0])
    yield "heights-down", "the heights count downward", down, 0


def _latitude_for_longitude(position: FloatArray, origin: Origin) -> FloatArray:
    lla = lla_from_ecef(ecef_from_enu(position, origin))
    middle = np.median(lla, axis=0)
    exchanged = np.column_stack([lla[:, 1], lla[:, 0], lla[:, 2]])
    exchanged = exchanged - exchanged.mean(axis=0) + np.array([middle[1], middle[0], middle[2]])
    if np.abs(exchanged[:, 0]).max() > 89.0:
        return position
    place = Origin(lat_deg=float(middle[1]), lon_deg=float(middle[0]), alt_m=origin.alt_m)
    return enu_from_ecef(ecef_from_lla(exchanged), place)


def _drifts(
    position: FloatArray, center: FloatArray, time_s: FloatArray
) -> Iterator[tuple[str, str, FloatArray, int]]:
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
        3,
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
            4,
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


def _groups(
    names: tuple[str, ...], center: FloatArray, position: FloatArray, start: Similarity, *, price: float
) -> list[Hypothesis]:
    """Shift a part of the fixes back that is shifted against the others, whenever they were recorded."""
    second, similarity = np.zeros(len(position), dtype=bool), start
    for _ in range(_ROUNDS):
        found = two_groups(position - similarity.apply(center))
        if found is None or np.array_equal(found.second, second):
            break
        second = found.second
        changed, apart = _without(position, center, second.astype(np.float64))
        similarity = fit(center, changed)[0]
    if not second.any():
        return []
    shifted = listed([names[row] for row in np.flatnonzero(second)])
    sentence = (
        f"{int(second.sum())} of {len(names)} fixes are shifted by {_vector(apart)} m east, north, up against the "
        f"others: another base station, datum or receiver ({shifted})"
    )
    return _tried("mixture", sentence, center, changed, price=price + _MEMBER * len(names))


@dataclass(frozen=True)
class _Track:
    """Fixes as a curve in time, and the projection centres at the photographs' times."""

    center: FloatArray  # (n, 3)
    time_s: FloatArray  # (n,)
    timed: IntArray  # (m,) rows in ascending order of time
    curve: CubicSpline

    @classmethod
    def of(cls, center: FloatArray, position: FloatArray, time_s: FloatArray) -> _Track | None:
        timed = np.flatnonzero(np.isfinite(time_s))
        order = timed[np.argsort(time_s[timed], kind="stable")]
        order = order[np.concatenate([[True], np.diff(time_s[order]) > 1e-3])] if len(order) else order
        if len(order) < 2 * _LEAST:
            return None
        return cls(center, time_s, order, CubicSpline(time_s[order], position[order]))

    def offsets(self, most_s: float) -> FloatArray:
        """Return the offsets to try, those that leave half of the photographs, and at least eight, on the curve."""
        first, last = self.time_s[self.timed[[0, -1]]]
        steps = np.arange(-most_s, most_s + 1e-9, _CLOCK_STEP_S)
        times = self.time_s[self.timed] + steps[:, None]
        inside = ((times >= first) & (times <= last)).sum(axis=1)
        return np.asarray(steps[inside >= max(2 * _LEAST, len(self.timed) // 2)])

    def at(self, offset_s: float) -> tuple[Similarity, float, IntArray]:
        """Return similarity, scatter in metres and rows of the photographs on the curve at a clock offset.

        Raises:
            DegenerateGeometryError: these photographs do not determine a similarity.
        """
        first, last = self.time_s[self.timed[[0, -1]]]
        time_s = self.time_s[self.timed] + offset_s
        rows = self.timed[(time_s >= first) & (time_s <= last)]
        return *fit(self.center[rows], self.curve(self.time_s[rows] + offset_s)), rows


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


def _clock(center: FloatArray, position: FloatArray, time_s: FloatArray, price: float) -> list[Hypothesis]:
    """Take the fixes at other times than the photographs'; on circles and parallel lines, several times may fit."""
    track = _Track.of(center, position, time_s)
    if track is None:
        return []
    found = []
    for offset, scatter in _minima(lambda offset: track.at(offset)[1], track.offsets(_CLOCK_S)):
        if abs(offset) < _LEAST_CLOCK_S:
            continue
        similarity, _, rows = track.at(offset)
        distance = np.full(len(center), np.nan)
        distance[rows] = np.linalg.norm(track.curve(time_s[rows] + offset) - similarity.apply(center[rows]), axis=1)
        leap = ", as GPS time and UTC differ" if abs(abs(offset) - _LEAP_S) < 2.0 * _CLOCK_STEP_S else ""
        sentence = (
            f"the navigation clock is off by about {offset:+.2f} s against the camera's{leap}: correct the times "
            "or let `georef ingest --time-offset auto` estimate the offset"
        )
        found.append(Hypothesis("clock", sentence, scatter, similarity, distance, price))
    return found


def _vector(values: FloatArray) -> str:
    return "(" + ", ".join(f"{value:+.2f}" for value in values) + ")"
