"""Several sources in one bag: which receiver counts, and how far the clocks of topics are apart.

The order of receivers: those that cover less than half of the time of another come last; then a σ that is clearly
smaller (by a factor of two); then the kind of fix (corrected or not); then σ, the number of fixes and the name.

Clocks may be a known number of seconds apart: GPS time, atomic time (TAI), time zones. Messages of one moment are
recorded at one moment, so that the recorder's clock tells how far the stamps of two topics are apart, but for the
time that a message takes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pipelines.core.products import Remark
from pipelines.core.types import FloatArray
from pipelines.formats.bag import Bag, BagTopic, UndecodableError
from pipelines.formats.gps_time import unix_from_gps
from pipelines.geodesy.enu import Origin, ecef_from_lla, enu_from_ecef
from pipelines.ingest.bag_messages import FIX_KINDS, POSITIONS

TOPIC_CHOICE = "bag-topic-choice"  # code of the assumption which of several topics counts
RECEIVER_TYPES = ("sensor_msgs/msg/NavSatFix", "px4_msgs/msg/SensorGps")
# σ in metres by kind of fix, of receivers that state none; it orders and compares them only.
_USUAL_SIGMA_M = (2.5, 1.0, 0.5, 0.05)
_LEAST_SHARE = 0.5
_SIGMAS, _LEAST_APART_M = 3.0, 1.0  # beyond both, two receivers contradict each other


@dataclass
class _Receiver:
    """Fixes of a topic: time of recording, latitude, longitude, height; σ where stated; the kind of each fix."""

    topic: BagTopic
    fixes: list[tuple[float, float, float, float]] = field(default_factory=list)
    sigma_h_m: list[float] = field(default_factory=list)
    kinds: list[int] = field(default_factory=list)

    @property
    def span_s(self) -> float:
        return self.fixes[-1][0] - self.fixes[0][0] if self.fixes else 0.0

    @property
    def sigma_m(self) -> float:
        """Median of the σ that are stated; NaN: none."""
        known = [value for value in self.sigma_h_m if math.isfinite(value)]
        return float(np.median(known)) if known else math.nan

    @property
    def kind(self) -> int:
        return int(np.median(self.kinds)) if self.kinds else 0

    @property
    def known_or_usual_m(self) -> float:
        """σ as stated, else as usual for the kind of fix."""
        return self.sigma_m if math.isfinite(self.sigma_m) else _USUAL_SIGMA_M[self.kind]

    def rank(self, longest_s: float) -> tuple[bool, int, int, float, int, str]:
        sigma = self.known_or_usual_m
        short = not self.fixes or self.span_s < _LEAST_SHARE * longest_s
        return short, round(math.log2(sigma)), -self.kind, sigma, -len(self.fixes), self.topic.name

    def words(self) -> str:
        known = math.isfinite(self.sigma_m)
        sigma = f"σ {self.sigma_m:.3g} m horizontally" if known else "no σ stated"
        return f"{len(self.fixes)} fixes, {FIX_KINDS[self.kind]}, {sigma}"


def ranked_receivers(bag: Bag, topics: Sequence[BagTopic]) -> tuple[list[BagTopic], Remark, Remark | None]:
    """Return the topics of receivers from the best to the worst, a remark on the choice, and one on a difference.

    The last is None where the σ of the two best explain how far they are apart. Reads all their messages.
    """
    receivers = {topic.name: _Receiver(topic) for topic in topics}
    for message in bag.messages(list(receivers)):
        try:
            sample = POSITIONS[message.type](bag.decode(message))
        except UndecodableError:
            continue
        if not sample.problem:
            one = receivers[message.topic]
            one.fixes.append((message.bag_ns / 1e9, *sample.coordinates))
            one.sigma_h_m.append(math.hypot(*sample.sigma_enu_m[:2]) / math.sqrt(2.0))
            one.kinds.append(sample.fix_kind)
    longest_s = max(one.span_s for one in receivers.values())
    order = sorted(receivers.values(), key=lambda one: one.rank(longest_s))
    best, second = order[0], order[1]
    others = ", ".join(f"{one.topic.name} ({one.words()})" for one in order[1:])
    apart = _apart(best, second)
    distance = ""
    if apart is not None:
        distance = (
            f" {second.topic.name} is {apart[0]:.2f} m away horizontally and {apart[1]:+.2f} m in height (median)."
        )
    sentence = f"The positions are from {best.topic.name} ({best.words()}), not {others}.{distance}"
    choice = Remark(code=TOPIC_CHOICE, sentence=sentence, remedy="--fix-topic selects another topic.")
    return [one.topic for one in order], choice, None if apart is None else _beyond_sigma(best, second, apart)


def _beyond_sigma(best: _Receiver, other: _Receiver, apart_m: tuple[float, float]) -> Remark | None:
    """Return the caution of receivers that are further apart in plan than their σ allow; None: none are."""
    sigma_m = math.hypot(best.known_or_usual_m, other.known_or_usual_m)
    if apart_m[0] <= max(_SIGMAS * sigma_m, _LEAST_APART_M):
        return None
    sentence = (
        f"{best.topic.name} and {other.topic.name} are {apart_m[0]:.2f} m apart horizontally (median), where their "
        f"σ together are {sigma_m:.2g} m: one of them is wrong, in another datum, or elsewhere on the aircraft. "
        f"{best.topic.name} is used."
    )
    remedy = "Compare both with control points (--gcp), or name the right one with --fix-topic."
    return Remark(code="receivers-apart", sentence=sentence, remedy=remedy)


def _apart(best: _Receiver, other: _Receiver) -> tuple[float, float] | None:
    """Return how far another receiver is from the best one, horizontally and upwards in metres (medians)."""
    if len(best.fixes) < 2 or not other.fixes:
        return None
    fixes, its = np.array(best.fixes), np.array(other.fixes)
    order = np.argsort(fixes[:, 0])
    inside = (its[:, 0] >= fixes[order[0], 0]) & (its[:, 0] <= fixes[order[-1], 0])
    if not inside.any():
        return None
    origin = Origin(lat_deg=fixes[0, 1], lon_deg=fixes[0, 2], alt_m=fixes[0, 3])
    position = enu_from_ecef(ecef_from_lla(fixes[order, 1:]), origin)
    there: FloatArray = enu_from_ecef(ecef_from_lla(its[inside, 1:]), origin)
    at = np.column_stack([np.interp(its[inside, 0], fixes[order, 0], position[:, axis]) for axis in range(3)])
    shift = np.median(there - at, axis=0)
    return float(math.hypot(*shift[:2])), float(shift[2])


# Atomic time is ahead of GPS time, by definition.
_TAI_FROM_GPS_S = 19.0
# Receivers and cameras hand over a message this long after its moment, or sooner.
_LATENCY_S = 0.6
# Topics that are further apart have different clocks.
_APART_S = 1.0
_QUARTER_S, _ZONE_S = 900.0, 14 * 3600.0


@dataclass(frozen=True)
class ClockShift:
    """How a topic's stamps are brought to the clock of the others: `shift_s` is subtracted."""

    shift_s: float
    code: Literal["stamps-in-gps-time", "stamps-in-tai", "stamps-in-local-time", "topic-clocks-differ"]
    sentence: str
    remedy: str = ""

    @property
    def remark(self) -> Remark:
        return Remark(code=self.code, sentence=self.sentence, remedy=self.remedy)


def clock_shifts(ahead_s: Mapping[str, float], at_s: float) -> dict[str, ClockShift]:
    """Return the shifts of topics whose stamps are on another clock than those nearest to the recorder's.

    `ahead_s` has by how much the stamps of each topic are ahead of the times of recording (median), `at_s` a stamp.
    Differences that no known clock explains are named and left: their shift is 0.
    """
    if not ahead_s:
        return {}
    nearest = min(ahead_s, key=lambda topic: (abs(ahead_s[topic]), topic))
    shifts = {}
    for topic, ahead in ahead_s.items():
        apart = ahead - ahead_s[nearest]
        if abs(apart) > _APART_S:
            shifts[topic] = _explained(topic, nearest, apart, at_s + apart)
    return shifts


def _explained(topic: str, other: str, apart_s: float, at_s: float) -> ClockShift:
    leap_s = round(at_s - float(unix_from_gps(at_s)))
    side = "ahead of" if apart_s > 0 else "behind"
    for size, code, name in (
        (float(leap_s), "stamps-in-gps-time", f"as GPS time from UTC ({leap_s} leap seconds at that date)"),
        (leap_s + _TAI_FROM_GPS_S, "stamps-in-tai", "as atomic time (TAI) from UTC"),
        (round(abs(apart_s) / _QUARTER_S) * _QUARTER_S, "stamps-in-local-time", "as the time of a zone from UTC"),
    ):
        if 0 < size <= _ZONE_S and abs(abs(apart_s) - size) < _LATENCY_S:
            shift = float(np.copysign(size, apart_s))
            sentence = (
                f"Stamps of {topic} are {abs(apart_s):.2f} s {side} those of {other}, {name}: {size:.0f} s are "
                f"{'subtracted' if shift > 0 else 'added'}."
            )
            return ClockShift(shift, code, sentence)  # type: ignore[arg-type]
    sentence = (
        f"Stamps of {topic} are {abs(apart_s):.2f} s {side} those of {other}, by the recorder's clock, and no "
        "known clock explains it: positions may belong to other moments."
    )
    return ClockShift(0.0, "topic-clocks-differ", sentence, "State the difference with --time-offset.")
