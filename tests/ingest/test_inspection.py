"""`georef inspect` on tiny bags."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from georef_cli import boundary
from georef_cli.main import cli
from tests import bags
from tests.bags import Flight, Message


def _inspected(path: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert boundary.guarded(cli, ["inspect", str(path), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_usual_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bags.write(tmp_path / "bag", bags.usual(Flight()))
    document = _inspected(path, capsys)
    rows = {row["name"]: row for row in document["topics"]}
    assert {name: row["use"] for name, row in rows.items()} == {
        "/camera/camera_info": "lens", "/camera/image_raw/compressed": "photographs", "/gnss/fix": "positions",
        "/imu/data": "attitudes", "/tf_static": "",
    }  # fmt: skip
    fix = rows["/gnss/fix"]
    assert (fix["messages"], fix["gaps"], fix["backwards"], fix["frame"]) == (65, 0, 0, "gnss")
    assert fix["rate_hz"] == pytest.approx(10, rel=1e-6)
    assert fix["last_s"] - fix["first_s"] == pytest.approx(6.4, abs=1e-6)
    assert document["missing"] == document["remarks"] == []
    assert boundary.guarded(cli, ["inspect", str(path)]) == 0
    table = capsys.readouterr().out
    assert "/gnss/fix" in table and "positions" in table


def test_gaps_and_stamps_that_run_backwards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = Flight()
    fixes = bags.fixes(flight)
    del fixes[20:40]
    fixes[5][3].header.stamp = bags.time(bags.START - 10**9)
    document = _inspected(bags.write(tmp_path / "bag", [*fixes, *bags.images(flight)]), capsys)
    fix = next(row for row in document["topics"] if row["name"] == "/gnss/fix")
    assert fix["longest_gap_s"] == pytest.approx(2.1)
    assert (fix["gaps"], fix["backwards"]) == (2, 1)
    assert [text.partition(":")[0] for text in document["missing"]] == [
        "no CameraInfo for the photographs", "no attitudes",
    ]  # fmt: skip


def test_what_a_local_frame_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = Flight()
    messages: list[Message] = [
        *bags.poses(flight, "nav_msgs/msg/Odometry"),
        *bags.imu(flight),
        *bags.images(flight),
    ]
    document = _inspected(bags.write(tmp_path / "bag", messages), capsys)
    missing = " ".join(document["missing"])
    assert "give --origin LAT,LON,HEIGHT" in missing and "give --camera-mount" in missing


def test_unknown_type_and_truncated_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = bags.write(tmp_path / "bag", bags.with_unknown(Flight()))
    assert "/thing" in {row["name"] for row in _inspected(path, capsys)["topics"]}
    (file,) = path.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-100])
    assert boundary.guarded(cli, ["inspect", str(path)]) == 1
    assert "is damaged" in capsys.readouterr().err
