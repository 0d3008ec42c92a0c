"""Several receivers in one bag, topics on other clocks, and altitudes that nobody flies at."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.geodesy.enu import lla_from_enu
from pipelines.ingest.bag_sources import clock_shifts
from tests import bags
from tests.bags import ORIGIN, Flight, Message
from tests.ingested_bags import Ingest, Refusal, check, remarked
from tests.px4_bags import px4

# Metres east, north and up that a consumer receiver is off.
OFF = np.array([1.8, 1.6, 4.1])


def others(flight: Flight, topic: str, step: int = 1, **stated: Any) -> list[Message]:
    """Return the fixes of another receiver, which is `OFF`."""
    times = flight.fix_ns[::step]
    places = lla_from_enu(flight.antenna(times) + OFF, ORIGIN)
    kind = "sensor_msgs/msg/NavSatFix"
    return [(topic, kind, ns, bags.fix(ns, lla, **stated)) for ns, lla in zip(times, places, strict=True)]


def rtk(flight: Flight, step: int = 2, **stated: Any) -> list[Message]:
    """Return fewer messages of a better receiver."""
    kind = "sensor_msgs/msg/NavSatFix"
    places = lla_from_enu(flight.antenna(flight.fix_ns), ORIGIN)
    rows = list(zip(flight.fix_ns, places, strict=True))[::step]
    return [("/rtk/fix", kind, ns, bags.fix(ns, lla, **stated)) for ns, lla in rows]


def base(flight: Flight) -> list[Message]:
    return [bags.transforms(flight), bags.info(flight), *bags.imu(flight), *bags.images(flight)]


@pytest.mark.parametrize(
    ("good", "poor"),
    [
        ({"status": 2, "sigma": 0.012}, {"status": 0, "sigma": 2.5}),
        ({"status": 0, "sigma": 0.012}, {"status": 1, "sigma": 2.5}),  # a driver that leaves the status out
        ({"status": 2, "covariance_type": 0}, {"status": 0, "sigma": 2.5}),  # one that leaves σ out
        ({"status": 2, "sigma": 0.5}, {"status": 0, "sigma": 0.4}),  # σ that are about equal: the status
        ({"status": 1, "covariance_type": 0}, {"status": 0, "covariance_type": 0}),
    ],
)
def test_better_receiver_is_taken(ingest: Ingest, good: dict[str, Any], poor: dict[str, Any]) -> None:
    flight = Flight()
    survey = ingest([*base(flight), *rtk(flight, **good), *others(flight, "/gps/fix", **poor)])
    check(survey, flight, tolerance_m=0.02)  # of the antenna's path, which is not linear between fixes
    (said,) = [one.sentence for one in survey.assumptions if one.code == "bag-topic-choice"]
    assert said.index("/rtk/fix") < said.index("/gps/fix")
    for each in (good, poor):
        if each.get("covariance_type") != 0:
            assert f"σ {each['sigma']:.3g} m" in said
    assert f"{math.hypot(*OFF[:2]):.2f} m away horizontally" in said and f"{OFF[2]:+.2f} m in height" in said


@pytest.mark.parametrize(
    ("good", "poor", "is_said"),
    [
        ({"status": 2, "sigma": 0.012}, {"status": 0, "sigma": 0.3}, True),  # 2.41 m apart
        ({"status": 2, "covariance_type": 0}, {"status": 2, "sigma": 0.05}, True),
        ({"status": 2, "sigma": 0.012}, {"status": 0, "sigma": 2.5}, False),
        ({"status": 0, "covariance_type": 0}, {"status": 0, "covariance_type": 0}, False),
    ],
)
def test_receivers_further_apart_than_their_sigma_are_a_caution(
    ingest: Ingest, good: dict[str, Any], poor: dict[str, Any], *, is_said: bool
) -> None:
    flight = Flight()
    survey = ingest([*base(flight), *rtk(flight, **good), *others(flight, "/gps/fix", **poor)])
    found = [one.sentence for one in survey.cautions if one.code == "receivers-apart"]
    assert len(found) == is_said
    assert all(f"{math.hypot(*OFF[:2]):.2f} m apart" in sentence for sentence in found)


def test_receiver_of_another_type(ingest: Ingest) -> None:
    """PX4's receiver, fixed by RTK, beside a consumer's NavSatFix, whose type comes first otherwise."""
    flight = Flight()
    survey = ingest(
        [*base(flight), *px4(flight, "SensorGps"), *others(flight, "/gps/fix", status=0, sigma=4.0)],
        "--lever-arm", "0.1,-0.2,-0.3",
    )  # fmt: skip
    assert remarked(survey, "bag-topic-choice", "not /gps/fix")
    check(survey, flight, tolerance_m=0.02)


def test_receiver_that_covers_little_comes_last(ingest: Ingest) -> None:
    flight = Flight()
    survey = ingest([*base(flight), *rtk(flight, status=2, sigma=0.012)[:5], *bags.fixes(flight, "/gps/fix")])
    check(survey, flight)


def test_named_receiver_is_taken(ingest: Ingest) -> None:
    flight = Flight()
    messages = [*base(flight), *rtk(flight, sigma=0.012), *others(flight, "/gps/fix", status=0, sigma=2.5)]
    survey = ingest(messages, "--fix-topic", "/gps/fix")
    up = [image.fix.position_in_geo[2] for image in survey.images if image.fix]
    truth = bags.expected(flight, survey.origin)[0][:, 2]
    assert np.allclose(np.array(up) - truth, OFF[2], atol=0.01)


def restamped(messages: list[Message], ahead_s: float, *, latency_s: float = 0.0) -> list[Message]:
    """Let the stamps of messages be ahead, and the messages be recorded late."""
    shift, late = round(ahead_s * 1e9), round(latency_s * 1e9)
    changed = []
    for topic, kind, ns, message in messages:
        own = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        message.header.stamp = bags.time(own + shift)
        changed.append((topic, kind, int(ns) + late, message))
    return changed


CLOCKS = {
    "fixes in GPS time": ("fix", 18.0, "stamps-in-gps-time", "18 leap seconds"),
    "fixes late, in GPS time": ("late fix", 18.0, "stamps-in-gps-time", "18 leap seconds"),
    "photographs in GPS time": ("images", 18.0, "stamps-in-gps-time", "18 leap seconds"),
    "fixes in UTC, the rest in GPS time": ("fix", -18.0, "stamps-in-gps-time", "added"),
    "photographs in atomic time": ("images", 37.0, "stamps-in-tai", "37 s"),
    "photographs in summer time": ("images", 7200.0, "stamps-in-local-time", "7200 s"),
    "attitudes in GPS time": ("imu", 18.0, "stamps-in-gps-time", "/imu/data"),
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_topic_on_a_known_clock(
    ingest: Ingest, tmp_path: Path, capsys: pytest.CaptureFixture[str], clock: str
) -> None:
    which, ahead_s, code, part = CLOCKS[clock]
    flight = Flight()
    groups = {"fix": bags.fixes(flight), "imu": bags.imu(flight), "images": bags.images(flight)}
    name = which.removeprefix("late ")
    groups[name] = restamped(groups[name], ahead_s, latency_s=0.4 if "late" in which else 0.0)
    messages = [bags.transforms(flight), bags.info(flight), *(one for group in groups.values() for one in group)]
    survey = ingest(messages)
    check(survey, flight)
    assert remarked(survey, code, part)
    path = bags.write(tmp_path / "inspected", messages)
    assert boundary.guarded(cli, ["inspect", str(path), "--json"]) == 0
    assert any(f"{abs(ahead_s):.0f} s are" in text for text in json.loads(capsys.readouterr().out)["remarks"])


def test_fixes_in_gps_time_beside_photographs_without_stamps(ingest: Ingest) -> None:
    flight = Flight()
    images = bags.images(flight)
    for *_, message in images:
        message.header.stamp = bags.time(0)
    fixes = restamped(bags.fixes(flight), 18.0)
    survey = ingest([bags.transforms(flight), bags.info(flight), *bags.imu(flight), *fixes, *images])
    check(survey, flight)
    assert remarked(survey, "stamps-in-gps-time")


def test_clock_that_nothing_explains_is_named(ingest: Ingest) -> None:
    flight = Flight()
    survey = ingest([*base(flight), *restamped(bags.fixes(flight), 5.3)])
    assert remarked(survey, "topic-clocks-differ", "5.30 s", "/gnss/fix")


@pytest.mark.parametrize(("year", "leaps_s"), [(2008, 14), (2012, 15), (2016, 17), (2024, 18)])
def test_leap_seconds_are_those_of_the_date(year: int, leaps_s: int) -> None:
    at_s = (year - 1970) * 365.25 * 86_400.0
    found = clock_shifts({"/a": 0.02, "/b": leaps_s + 0.1, "/c": leaps_s + 19.1, "/d": leaps_s + 1.3}, at_s)
    assert {topic: one.shift_s for topic, one in found.items()} == {"/b": leaps_s, "/c": leaps_s + 19.0, "/d": 0.0}
    assert found["/d"].code == "topic-clocks-differ"


def test_clocks_that_agree_are_not_blamed(ingest: Ingest) -> None:
    """Latencies below a second, and a recorder whose own clock is wrong, say nothing on the topics."""
    flight = Flight()
    messages = [*restamped(bags.images(flight), 18.0, latency_s=0.3), *restamped(bags.fixes(flight), 18.0)]
    messages += restamped(bags.imu(flight), 18.0)
    survey = ingest([bags.transforms(flight), bags.info(flight), *messages])
    check(survey, flight)
    codes = {one.code for one in (*survey.assumptions, *survey.warnings)}
    assert not codes & {"stamps-in-gps-time", "topic-clocks-differ"}


@pytest.mark.parametrize("height_m", [2_000_050.0, 1_620_000.0, -6000.0])
def test_altitudes_that_nobody_flies_at(refusal: Refusal, height_m: float) -> None:
    flight = Flight(count=3)
    fixes = bags.fixes(flight)
    for *_, message in fixes:
        message.altitude = height_m
    error = refusal([*base(flight), *fixes])
    assert (error["code"], error["field"]) == ("height-impossible", "/gnss/fix")


def test_some_altitudes_that_nobody_flies_at(ingest: Ingest) -> None:
    flight = Flight(count=3)
    fixes = bags.fixes(flight)
    for *_, message in fixes[:2]:
        message.altitude = 2e6
    survey = ingest([*base(flight), *fixes])
    check(survey, flight)
    assert remarked(survey, "message-unusable", "2 of 35", "altitude is impossible")
