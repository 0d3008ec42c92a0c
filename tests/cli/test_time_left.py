"""Time left of a whole run."""

from __future__ import annotations

import pytest

from georef_cli.estimate import RunTimeLeft


def test_a_machine_twice_as_slow_doubles_the_rest() -> None:
    now = [0.0]
    left = RunTimeLeft({"sfm": 60.0, "train": 100.0}, lambda: now[0])  # ingest corrects nothing
    assert left.seconds == 160.0
    for stage, took_s in (("ingest", 5.0), ("sfm", 120.0)):
        left.begin()
        now[0] += took_s
        left.end(stage)
    # A third of the run took twice as long: so will the rest, but for the weight of the estimate.
    assert 170.0 < left.seconds < 200.0
    left.begin()
    left.end("train")
    assert left.seconds == 0.0


def test_a_second_tells_little_of_an_hour() -> None:
    now = [0.0]
    left = RunTimeLeft({"ingest": 4.0, "sfm": 600.0, "train": 3000.0}, lambda: now[0])
    left.begin()
    now[0] += 1.0
    left.end("ingest")
    assert left.seconds == pytest.approx(3600.0, rel=0.02)


def test_a_training_on_a_gpu_has_no_estimate() -> None:
    assert RunTimeLeft({"sfm": 60.0, "train": None}).seconds is None
    assert RunTimeLeft({}).seconds == 0
