"""`georef simulate` as users meet it."""

from __future__ import annotations

import json
from pathlib import Path

from tests.cli_runs import Georef

TINY = ("--images", 3, "--size", "64x48", "--samples", 1, "--targets", 0)


def test_simulate_makes_a_survey_and_says_so(georef: Georef, tmp_path: Path) -> None:
    folder = tmp_path / "survey"
    made = georef("simulate", folder, *TINY, "--height", 50, "--height", 70, "--flight", "grid", "--json")
    assert made.code == 0
    assert made.document["images"] == 3
    assert sorted(path.name for path in folder.iterdir()) == [
        "checkpoints.txt", "gcp_list.txt", "gnss.csv", "images", "imu.csv", "trajectory.csv", "truth.json",
    ]  # fmt: skip
    heights = [center[2] for center in json.loads((folder / "truth.json").read_text("utf-8"))["centers"]]
    assert min(heights) < 55 and max(heights) > 65
    again = georef("simulate", folder, *TINY)
    assert again.code == 1
    assert "--force" in again.err
    replaced = georef("simulate", folder, *TINY, "--force", "--no-exif", "-j", 1)
    assert replaced.code == 0
    assert "3 photographs" in replaced.out


def test_bad_option_is_one_line_and_exit_2(georef: Georef, tmp_path: Path) -> None:
    result = georef("simulate", tmp_path / "survey", "--origin", "100,0,0")
    result.assert_failed(2)
    assert "[--origin]" in result.err
    assert "latitude" in result.err
    assert not (tmp_path / "survey").exists()
