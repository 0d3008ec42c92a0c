"""`georef ingest --bag` on PX4's messages, of every release that a bag may be from."""

from __future__ import annotations

from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin

from pipelines.formats.px4_messages import DEFINITIONS
from tests import bags
from tests.bags import Flight, Form
from tests.ingested_bags import Ingest, check, remarked
from tests.px4_bags import px4, px4_of

WHERE = "46.02,7.75,1620"


@pytest.mark.parametrize("position", ["SensorGps", "VehicleGlobalPosition"])
def test_px4(ingest: Ingest, position: str) -> None:
    flight = Flight()
    messages = [
        bags.transforms(flight), *px4(flight, position), *px4(flight, "VehicleAttitude"),
        *bags.images(flight),
    ]  # fmt: skip
    options = ["--lever-arm", "0.1,-0.2,-0.3"] if position == "SensorGps" else []
    survey = ingest(messages, *options)
    check(survey, flight)  # its altitude has 32 bits: 0.1 mm at 1700 m
    fix = survey.images[0].fix
    assert fix is not None
    sigma = 0.02 if position == "SensorGps" else 0.3
    assert fix.cov_in_geo[0][0] == pytest.approx(sigma**2 / 2, rel=1e-3)  # eph is that of the plane


LAYOUTS = [(kind.rpartition("/")[2], release) for kind, layouts in DEFINITIONS.items() for release in layouts]


@pytest.mark.parametrize("stated", [True, False], ids=["definition in the bag", "no definition"])
@pytest.mark.parametrize(("kind", "release"), LAYOUTS)
def test_px4_of_every_release(ingest: Ingest, tmp_path: Path, kind: str, release: str, stated: bool) -> None:
    """Decoded by the definition in the bag; where it has none, by the layout of the same length."""
    flight = Flight()
    messages = px4_of(release, px4(flight, kind))
    options = []
    if kind.startswith("VehicleOdometry"):
        options += ["--origin", WHERE]
    if kind == "SensorGps":
        options += ["--lever-arm", "0.1,-0.2,-0.3"]
    if kind == "VehicleAttitude":
        messages += px4(flight, "VehicleGlobalPosition")
    elif kind != "VehicleOdometry":
        messages += px4(flight, "VehicleAttitude")
    name = f"px4_msgs/msg/{kind}"
    form = Form(StoragePlugin.SQLITE3, definitions={name: DEFINITIONS[name][release] if stated else ""})
    path = bags.write(tmp_path / "bag", [bags.transforms(flight), *messages, *bags.images(flight)], form)
    survey = ingest(path, *options)
    # 10⁻⁷ degrees are 11 mm.
    check(survey, flight, tolerance_m=0.01 if (kind, release) == ("SensorGps", "1.14") else 1e-3)
    assumptions = [one.sentence for one in survey.assumptions if one.code == "message-definitions"]
    assert assumptions == [] if stated else f"{name} (as of PX4 {release})" in assumptions[0]


def test_px4_estimates_that_are_none(ingest: Ingest) -> None:
    flight = Flight()
    gps = px4(flight, "SensorGps")
    gps[3][3].fix_type, gps[4][3].fix_type = 8, 1
    survey = ingest([*gps, *bags.images(flight)])
    assert remarked(survey, "message-unusable", "2 of 65", "/fmu/out/SensorGps", "no fix (status)")
    estimates = px4(flight, "VehicleGlobalPosition")
    estimates[3][3].dead_reckoning = True
    survey = ingest([*estimates, *bags.images(flight)])
    assert remarked(survey, "message-unusable", "1 of 65", "/fmu/out/VehicleGlobalPosition", "dead reckoning")


def test_px4_message_of_no_known_layout(ingest: Ingest, tmp_path: Path) -> None:
    flight = Flight()
    gps = px4(flight, "SensorGps")
    strange = [
        (topic, kind, ns, bytes(bags.TYPES.serialize_cdr(one, kind)) + bytes(40)) for topic, kind, ns, one in gps
    ]
    strange[7:] = gps[7:]
    form = Form(definitions={"px4_msgs/msg/SensorGps": ""})
    survey = ingest(bags.write(tmp_path / "bag", [*strange, *bags.images(flight)], form))
    assert remarked(survey, "message-damaged", "7 messages", "/fmu/out/SensorGps", "px4_msgs/msg/SensorGps")
    assert all(image.fix for image in survey.images[1:])


def test_px4_counts_from_boot(ingest: Ingest) -> None:
    flight = Flight()
    boot = bags.START - 7_000_000_000
    messages = [
        bags.transforms(flight), *px4(flight, "VehicleGlobalPosition", boot),
        *px4(flight, "VehicleAttitude", boot), *bags.images(flight),
    ]  # fmt: skip
    survey = ingest(messages)
    check(survey, flight)
    assert remarked(survey, "clock-epoch")
