"""One position for each photograph from all that its tags state: EXIF's, a second EXIF block's and XMP's.

Sources of one quantity are compared. A difference beyond what their digits explain is resolved by a rule, and both
values are stated; where no rule decides, the first source counts with a σ that reaches the other. The rules:

1. Coarser digits lose, if they explain the difference.
2. An exact zero is no measurement.
3. A minus, S or W is written on purpose; a plus may be a lost sign. Of heights, the number that carries its own
   sign outranks the one whose sign lies in another tag.
4. Heights above take-off are not heights, and feet are not metres.
5. A value that stands still while the other source moves is an old one.
6. Where a few photographs differ, their neighbours decide; where all scatter, the steadier track does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.exif import GpsTag
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.crs_names import code_of_name
from pipelines.geodesy.vertical import FOOT_M
from pipelines.geometry.statistics import scatter_about_median
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.reference_system import note_operation
from pipelines.ingest.remarks import Remarks, shortened
from pipelines.ingest.written_values import (
    M_PER_DEG,
    UNKNOWN_SIGMA_M,
    digits_sigma_m,
    step_of_heights,
    step_of_places,
    zero_heights,
)

_FINE_M = 0.1  # a step that no σ of a plain receiver notices
_SLACK_M = 0.02
_FEW = 1 / 3  # of the photographs, whose differences are blunders
_DECISIVE = 0.5
_DATUM_SIGMA_M = 500.0  # national datums, and the shifted maps of one country, are up to some 700 m from WGS84
_LOWEST_GROUND_M = -450.0  # the shore of the Dead Sea


@dataclass(frozen=True)
class TaggedPositions:
    """Positions of N photographs by their tags, with what their sources and digits add to their σ."""

    xyz: FloatArray  # (N, 3) longitude, latitude in degrees, height in metres; NaN where unknown
    sigma_m: FloatArray  # (N, 3) east, north, up, of each photograph alone
    common_sigma_m: tuple[float, float]  # horizontal and vertical, of all photographs together


@dataclass(frozen=True)
class _Flight:
    """Facts on N photographs by which the rules choose, and the remarks on their choices."""

    names: Sequence[str]
    order: Sequence[int]  # rows in the order in which they were taken
    relative_m: FloatArray  # (N,) heights above take-off, NaN where unknown
    remarks: Remarks


@dataclass(frozen=True)
class _Choice:
    """Choice between two sources: (N, k) values, σ of each (N,), and the σ that all share."""

    values: FloatArray
    sigma_m: FloatArray
    common_m: float


def tagged_positions(photos: Sequence[Photo], remarks: Remarks) -> TaggedPositions:
    """Return the positions that the tags of photographs state; what was chosen and left out is noted."""
    used, datum_m = _in_wgs84(_without_void(photos, remarks), remarks)
    names = [photo.name for photo in photos]
    flight = _Flight(names, _in_time(photos), _column(photos, "relative_altitude_m"), remarks)
    horizontal, heights = _sources(used), _height_sources(photos, used)
    if horizontal and "EXIF" not in horizontal:
        remarks.assume("positions-from-xmp", "EXIF has no position: those in XMP are used.")
    plan = _first(horizontal, len(photos), 2)
    for name in list(horizontal)[1:]:
        plan = _chosen_places(plan, horizontal[name], (next(iter(horizontal)), name), flight)
    height = _first(heights, len(photos), 1)
    for name in list(heights)[1:]:
        height = _chosen_heights(height, heights[name], (next(iter(heights)), name), flight)
    zero, unknown = zero_heights(height.values[:, 0], names, "the photographs", remarks)
    height = replace(height, values=np.where(zero[:, None], np.nan, height.values))
    digits_h, digits_v = digits_sigma_m(
        plan.values, height.values[:, 0], degrees=True, of="the photographs", remarks=remarks
    )
    place_h = np.hypot(plan.sigma_m, digits_h)
    low = height.values[np.isfinite(height.values)]
    if len(low) and low.min() < 0.0:
        remarks.assume(
            "heights-below-zero",
            f"Heights of {low.min():.1f} to {low.max():.1f} m are below zero in part, as the tags say.",
        )
    return TaggedPositions(
        xyz=np.column_stack([plan.values[:, ::-1], height.values[:, 0]]),
        sigma_m=np.column_stack([place_h, place_h, np.hypot(height.sigma_m, digits_v)]),
        common_sigma_m=(math.hypot(plan.common_m, datum_m), UNKNOWN_SIGMA_M if unknown else height.common_m),
    )


def _without_void(photos: Sequence[Photo], remarks: Remarks) -> list[tuple[GpsTag, ...]]:
    """Return the positions of each photograph, without those of a receiver that says that it had no fix.

    One drone says so of every photograph, with good positions: then all are used, and that is a caution.
    """
    tagged = [photo.tags.positions for photo in photos]
    void = [photo.name for photo, tags in zip(photos, tagged, strict=True) if any(tag.void for tag in tags)]
    if not void:
        return tagged
    if len(void) == sum(map(bool, tagged)):
        remarks.caution(
            "gps-status-void",
            f"The receiver says of all {len(void)} positions that it had no fix (GPSStatus is void). They are "
            "used; some cameras say so of good positions, others repeat the last one.",
        )
        return tagged
    remarks.warn_counted(
        "gps-status-void",
        void,
        "Positions are left out of which the receiver says that it had no fix (GPSStatus is void)",
    )
    return [tuple(tag for tag in tags if not tag.void) for tags in tagged]


def _in_wgs84(tagged: Sequence[tuple[GpsTag, ...]], remarks: Remarks) -> tuple[list[tuple[GpsTag, ...]], float]:
    """Return positions whose tags name another datum in WGS84, and the σ in m of a datum that nobody knows."""
    unknown_m = 0.0
    moved: dict[GpsTag, GpsTag] = {}
    for name in sorted({tag.datum for tags in tagged for tag in tags} - {""}):
        old = list(dict.fromkeys(tag for tags in tagged for tag in tags if tag.datum == name))
        crs = _crs_of_datum(name)
        try:
            lla = None if crs is None else crs.lla_from_xyz([(tag.lon_deg, tag.lat_deg, 0.0) for tag in old])
        except InputError:  # They lie outside the area of that datum.
            lla = None
        if crs is None or lla is None:
            unknown_m = _DATUM_SIGMA_M
            remarks.caution(
                "exif-datum-unknown",
                f"The tags say that the positions of {len(old)} photographs are in {name[:40]!r} (GPSMapDatum): no "
                f"datum that PROJ knows there. They are taken as WGS84, and {unknown_m:.0f} m are added to the "
                "σ of the error that they share.",
            )
            continue
        remarks.assume(
            "exif-datum",
            f"The positions of {len(old)} photographs are in {name} (GPSMapDatum), read as {crs.name}, and are "
            "transformed to WGS84.",
        )
        note_operation(crs, lla, Path("EXIF"), "positions", remarks)
        pairs = zip(old, lla.tolist(), strict=True)
        moved |= {tag: replace(tag, lat_deg=lat, lon_deg=lon) for tag, (lat, lon, _) in pairs}
    return [tuple(moved.get(tag, tag) for tag in tags) for tags in tagged], unknown_m


def _crs_of_datum(name: str) -> PointCrs | None:
    """Return the latitudes and longitudes of a datum by its name; None: PROJ has none of that name."""
    code = code_of_name(name)
    crs = None if code is None else parse_crs(f"EPSG:{code}")
    return crs if crs is not None and crs.is_geographic else None


def _sources(tagged: Sequence[tuple[GpsTag, ...]]) -> dict[str, FloatArray]:
    """Return latitudes and longitudes (N, 2) by their sources, NaN where a source has none, EXIF's first."""
    sources: dict[str, FloatArray] = {}
    for row, tags in enumerate(tagged):
        seen: dict[str, int] = {}
        for tag in tags:
            seen[tag.source] = seen.get(tag.source, 0) + 1
            name = tag.source if seen[tag.source] == 1 else f"a second {tag.source}"
            places = sources.setdefault(name, np.full((len(tagged), 2), np.nan))
            if seen[tag.source] <= 2:
                places[row] = tag.lat_deg, tag.lon_deg
    return {name: sources[name] for name in sorted(sources, key=lambda name: (name != "EXIF", name))}


def _height_sources(photos: Sequence[Photo], tagged: Sequence[tuple[GpsTag, ...]]) -> dict[str, FloatArray]:
    """Return heights (N, 1) by their sources; XMP's of a drone counts where its latitude is missing too."""
    exif, xmp = np.full((len(photos), 1), np.nan), np.full((len(photos), 1), np.nan)
    for row, (photo, tags) in enumerate(zip(photos, tagged, strict=True)):
        known = {tag.source: tag.alt_m for tag in reversed(tags) if tag.alt_m is not None}
        absolute = None if photo.tags.dji is None else photo.tags.dji.absolute_altitude_m
        exif[row] = known.get("EXIF", np.nan)
        xmp[row] = known.get("XMP", absolute if absolute is not None else np.nan)
    return {name: values for name, values in (("EXIF", exif), ("XMP", xmp)) if np.isfinite(values).any()}


def _first(sources: dict[str, FloatArray], count: int, width: int) -> _Choice:
    """Return the values (count, width) of the first source, NaN without any."""
    return _Choice(next(iter(sources.values()), np.full((count, width), np.nan)), np.zeros(count), 0.0)


def _column(photos: Sequence[Photo], name: str) -> FloatArray:
    values = (None if photo.tags.dji is None else getattr(photo.tags.dji, name) for photo in photos)
    return np.array([np.nan if value is None else value for value in values])


def _in_time(photos: Sequence[Photo]) -> list[int]:
    """Return the rows in the order in which they were taken; in that of their names where times are missing."""
    times = [photo.tags.timestamp_s for photo in photos]
    if any(time is None for time in times):
        return list(range(len(photos)))
    return sorted(range(len(photos)), key=lambda row: (times[row] or 0.0, row))


def _chosen_places(choice: _Choice, other: FloatArray, sources: tuple[str, str], flight: _Flight) -> _Choice:
    """Return the better of two sources of latitude and longitude (N, 2), by the rules of this module."""
    (one, two), names, remarks = sources, flight.names, flight.remarks
    values = _filled(choice.values, other, sources, "positions", remarks)
    both = _known(choice.values) & _known(other)
    if not both.any():
        return replace(choice, values=values)
    chosen, other = values.copy(), other.copy()
    for wrong, right, loser, winner in ((chosen, other, one, two), (other, chosen, two, one)):
        zero = both & (wrong == 0.0).any(axis=1) & (_metres(wrong, right) > _SLACK_M)
        if zero.any():
            remarks.caution(
                "position-zero",
                f"{int(zero.sum())} positions in {loser} have a latitude or longitude of 0, which means none, and "
                f"differ from those in {winner}, which are used: {_named(names, zero)}.",
            )
            wrong[zero] = right[zero]
    turned = both & (np.abs(np.abs(chosen) - np.abs(other)) * M_PER_DEG < 100.0).all(axis=1)
    turned &= (chosen * other < 0.0).any(axis=1) & (_metres(chosen, other) > 1000.0)
    if turned.any():
        row = int(np.flatnonzero(turned)[0])
        remarks.caution(
            "position-sign",
            f"{one} and {two} disagree in the sign of {int(turned.sum())} positions ({_pair(chosen[row])} in "
            f"{one}, {_pair(other[row])} in {two} of {names[row]}). The southern and western one is used: a lost "
            "sign leaves north and east.",
        )
        negative = np.minimum(chosen, other)
        differs = (chosen * other < 0.0) & turned[:, None]
        chosen[differs], other = negative[differs], np.where(differs, negative, other)
    step = [step_of_places(each[both], compared=True) for each in (chosen, other)]
    allowed = (step[0] + step[1]) * M_PER_DEG * np.sqrt(2.0) + _SLACK_M
    apart = np.where(both, _metres(chosen, other), 0.0)
    if (apart <= allowed).all():
        if step[0] * M_PER_DEG > _FINE_M and step[0] > 3.0 * step[1]:
            remarks.assume(
                "position-digits-differ",
                f"{one} and {two} differ by up to {apart.max():.1f} m, as far as the digits of {one} explain, "
                f"which are steps of {step[0] * M_PER_DEG:.2g} m. The positions in {two} are used.",
            )
            chosen[both] = other[both]
        return replace(choice, values=chosen)
    moves = [np.round((each[both] - each[both][0]) * _scale(each[both]), 3) for each in (chosen, other)]
    case = _Case(chosen, other, both, apart, allowed, one, two, "position", moves, _scale(chosen))
    return _decided(case, choice, flight)


def _chosen_heights(height: _Choice, other: FloatArray, sources: tuple[str, str], flight: _Flight) -> _Choice:
    """Return the better of two sources of heights (N, 1), by the rules of this module."""
    (one, two), names, remarks = sources, flight.names, flight.remarks
    values = _filled(height.values, other, sources, "heights", remarks)
    both = np.isfinite(height.values[:, 0]) & np.isfinite(other[:, 0])
    step = [step_of_heights(each[both].ravel()) for each in (height.values, other)]
    allowed = step[0] + step[1] + _SLACK_M
    a, b, relative = values[:, 0].copy(), other[:, 0].copy(), np.where(both, flight.relative_m, np.nan)
    rules = (
        ("height-zero", a == 0.0, b == 0.0, "0, which means none"),
        ("height-sign", *_wrong_signs(a, b, relative, allowed), "of the other sign"),
        (
            "height-relative",
            np.abs(a - relative) <= allowed + _FINE_M,
            np.abs(b - relative) <= allowed + _FINE_M,
            "above take-off, as RelativeAltitude says",
        ),
        ("height-feet", _is_feet(a, b, allowed), _is_feet(b, a, allowed), "in feet"),
    )
    common = height.common_m
    for code, first_wrong, second_wrong, reason in rules:
        differ = both & (np.abs(a - b) > allowed)
        for wrong, loser, winner, bad, good in ((first_wrong, one, two, a, b), (second_wrong, two, one, b, a)):
            rows = differ & wrong & ~(first_wrong & second_wrong)
            if not rows.any():
                continue
            row = int(np.flatnonzero(rows)[0])
            remarks.caution(
                code,
                f"{int(rows.sum())} heights in {loser} are {reason}, and differ from those in {winner}, which are "
                f"used: {bad[row]:.1f} and {good[row]:.1f} m in {names[row]}.",
            )
            if code == "height-sign" and not _is_too_low(np.minimum(a, b)[rows], relative[rows]):
                common = max(common, float(np.abs(a - b)[rows].max()))
            bad[rows] = good[rows]
    chosen, other = a[:, None], b[:, None]
    apart = np.where(both, np.abs(a - b), 0.0)
    if (apart <= allowed).all():
        if step[0] > 3.0 * step[1] and step[0] > _FINE_M:
            remarks.assume(
                "height-digits-differ",
                f"The heights in {one} and {two} differ by up to {apart.max():.1f} m, as far as the digits of "
                f"{one} explain, which are steps of {step[0]:g} m. Those in {two} are used.",
            )
            chosen = np.where(both[:, None], other, chosen)
        return _Choice(chosen, height.sigma_m, common)
    moves = [np.round(each[both], 3) for each in (chosen, other)]
    case = _Case(chosen, other, both, apart, allowed, one, two, "height", moves, np.ones(1))
    return _decided(case, replace(height, common_m=common), flight)


def _wrong_signs(a: FloatArray, b: FloatArray, relative: FloatArray, allowed: float) -> tuple[BoolArray, BoolArray]:
    """Return where the first and where the second of two heights of opposite signs is wrong.

    The second carries its own sign, so that it counts, unless the ground below it were lower than any land.
    """
    opposite = (np.abs(a + b) <= allowed) & (np.abs(a) > allowed)
    ground = b - np.nan_to_num(relative)
    low = opposite & (ground < _LOWEST_GROUND_M)
    return opposite & ~low, low


def _is_too_low(heights: FloatArray, relative: FloatArray) -> bool:
    return bool(((heights - np.nan_to_num(relative)) < _LOWEST_GROUND_M + 10.0).all())


def _is_feet(a: FloatArray, b: FloatArray, allowed: float) -> BoolArray:
    """Return where the first height is the second in feet."""
    return (np.abs(b) > 10.0 * allowed) & (np.abs(a * FOOT_M - b) <= allowed + 0.002 * np.abs(b))


@dataclass(frozen=True)
class _Case:
    """Two sources (N, k) of a quantity, in the plane or in height, that no rule on single values has reconciled."""

    chosen: FloatArray
    other: FloatArray
    both: BoolArray  # (N,)
    apart: FloatArray  # (N,) metres
    allowed_m: float
    one: str
    two: str
    quantity: str
    moves: Sequence[FloatArray]  # of both sources where both are known, metres
    metres: FloatArray  # (k,) of a unit

    def caution(self, remarks: Remarks, pattern: str, rows: BoolArray, how: str) -> None:
        """State by how much the sources differ, where, and what follows."""
        least, most = self.apart[rows].min(), self.apart[rows].max()
        size = f"{most:.2f} m" if most - least < 0.05 else f"{least:.2f} to {most:.2f} m"
        remarks.caution(
            f"{self.quantity}-{pattern}",
            f"The {self.quantity}s in {self.one} and {self.two} differ by {size} in {int(rows.sum())} photographs, "
            f"which their digits do not explain: {how}",
        )


def _decided(case: _Case, before: _Choice, flight: _Flight) -> _Choice:
    """Return the better of two sources by what they do over the flight, else the first with a σ for both."""
    remarks = flight.remarks
    differ = case.both & (case.apart > case.allowed_m)
    still = [len(np.unique(each, axis=0)) <= max(1, len(each) // 2) for each in case.moves]
    span = [float(np.ptp(each, axis=0).max()) for each in case.moves]
    count = int(case.both.sum())
    values = case.chosen.copy()
    if count > 2 and still[0] != still[1] and span[still.index(False)] > max(1.0, case.allowed_m):
        winner = case.two if still[0] else case.one
        if still[0]:
            values[case.both] = case.other[case.both]
        loser = case.one if still[0] else case.two
        case.caution(
            remarks, "stands-still", differ, f"those in {loser} repeat, those in {winner} move and are used."
        )
        return replace(before, values=values)
    if differ.sum() <= _FEW * count and count - differ.sum() >= 2:
        return _by_neighbours(case, differ, before, flight)
    shift = (case.other - case.chosen)[case.both] * case.metres
    typical = float(np.median(np.linalg.norm(shift, axis=1)))
    if count > 1 and scatter_about_median(shift) < max(0.2 * typical, case.allowed_m):
        case.caution(
            remarks,
            "sources-apart",
            differ,
            f"a constant, of which no source is known to be right. Those in {case.one} are used, and "
            f"{typical:.1f} m is added to the σ of the error that they share.",
        )
        return replace(before, values=values, common_m=float(np.hypot(before.common_m, typical)))
    rough = [_roughness(each * case.metres, flight.order, case.both) for each in (case.chosen, case.other)]
    if min(rough) < _DECISIVE * max(rough):
        second = rough[1] < rough[0]
        if second:
            values[case.both] = case.other[case.both]
        steady = case.two if second else case.one
        case.caution(remarks, "sources-scatter", differ, f"those in {steady} are steadier, and are used.")
        return replace(before, values=values)
    case.caution(
        remarks, "sources-scatter", differ, f"those in {case.one} are used, with the differences added to their σ."
    )
    return _Choice(values, np.hypot(before.sigma_m, case.apart), float(np.hypot(before.common_m, typical)))


def _by_neighbours(case: _Case, differ: BoolArray, before: _Choice, flight: _Flight) -> _Choice:
    """Return the source that lies nearer to the line through the neighbours that agree, else a σ for both."""
    values, sigma_m, order = case.chosen.copy(), before.sigma_m.copy(), list(flight.order)
    rank = np.empty(len(order))
    rank[order] = np.arange(len(order))
    good = np.flatnonzero(case.both & ~differ)
    good = good[np.argsort(rank[good])]
    chosen: dict[str, list[str]] = {case.one: [], case.two: [], "neither": []}
    for row in np.flatnonzero(differ).tolist():
        expected = [np.interp(rank[row], rank[good], axis) for axis in case.chosen[good].T]
        off = [float(np.linalg.norm((each[row] - expected) * case.metres)) for each in (case.chosen, case.other)]
        winner = "neither" if min(off) > _DECISIVE * max(off) else (case.one, case.two)[int(off[1] < off[0])]
        chosen[winner].append(flight.names[row])
        if winner == case.two:
            values[row] = case.other[row]
        elif winner == "neither":
            sigma_m[row] = np.hypot(sigma_m[row], case.apart[row])
    parts = [
        f"{source} is used for {shortened(chosen[source])}" for source in (case.one, case.two) if chosen[source]
    ]
    if chosen["neither"]:
        parts.append(f"the difference is added to the σ of {shortened(chosen['neither'])}")
    case.caution(flight.remarks, "sources-blunders", differ, f"by their neighbours, {'; '.join(parts)}.")
    return replace(before, values=values, sigma_m=sigma_m)


def _roughness(values_m: FloatArray, order: Sequence[int], both: BoolArray) -> float:
    """Return the typical bend of a track, metres: the second difference of its places in time."""
    track = values_m[[row for row in order if both[row]]]
    return float(np.median(np.linalg.norm(np.diff(track, 2, axis=0), axis=1))) if len(track) > 4 else 0.0


def _filled(
    first: FloatArray, second: FloatArray, sources: tuple[str, str], what: str, remarks: Remarks
) -> FloatArray:
    """Return the first source with its gaps filled from the second."""
    gaps = ~_known(first) & _known(second)
    if gaps.any():
        remarks.assume(
            f"{what}-from-xmp", f"{int(gaps.sum())} {what} that {sources[0]} lacks are those in {sources[1]}."
        )
    return np.where(gaps[:, None], second, first)


def _known(values: FloatArray) -> BoolArray:
    """Return which rows (N,) of values (N, k) are complete."""
    return np.asarray(np.isfinite(values).all(axis=1))


def _scale(values_deg: FloatArray) -> FloatArray:
    """Return metres of a degree of latitude and of longitude (2,) where positions (N, 2) lie."""
    lat = float(np.nanmedian(values_deg[:, 0])) if np.isfinite(values_deg).any() else 0.0
    return np.array([M_PER_DEG, M_PER_DEG * np.cos(np.radians(lat))])


def _metres(one: FloatArray, two: FloatArray) -> FloatArray:
    """Return the distance (N,) of positions (N, 2) in degrees."""
    distance: FloatArray = np.linalg.norm((one - two) * _scale(one), axis=1)
    return np.nan_to_num(distance)


def _named(names: Sequence[str], rows: BoolArray) -> str:
    return shortened([names[row] for row in np.flatnonzero(rows).tolist()])


def _pair(values: FloatArray) -> str:
    return f"{values[0]:.5f}, {values[1]:.5f}"
