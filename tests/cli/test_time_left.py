"""Time left of a whole run."""

from __future__ import annotations

import pytest

from georef_cli.estimate import RunTimeLeft


def test_a_machine_twice_as_slow_doubles_the_rest() -> None:
    now = [0.0]
    left = RunTimeLeft({"sfm": 60.0, "train": 100.0}, lambda: now[0])
    assert left.seconds == 160.0
    for stage, took_s in (("ingest", 5.0), ("sfm", 120.0)):
        left.begin()
        now[0] += took_s
        left.end(stage)
    assert left.seconds == pytest.approx(200.0)  # ingest has no estimate: its time corrects none
    left.begin()
    left.end("train")
    assert left.seconds == 0.0


def test_a_training_on_a_gpu_has_no_estimate() -> None:
    assert RunTimeLeft({"sfm": 60.0, "train": None}).seconds is None
    assert RunTimeLeft({}).seconds == 0
