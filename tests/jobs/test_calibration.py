"""The speed of a machine is measured once, and what is kept is used."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipelines.jobs import calibration


def test_measured_once_and_again_only_for_other_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[float] = []
    monkeypatch.setattr(calibration, "user_cache", lambda: tmp_path / "cache")
    monkeypatch.setattr(calibration, "_processor_s", lambda: measured.append(1.0) or 1.0)
    factor = calibration._factor.__wrapped__
    slow = factor(2, "a 2", compiled=True)
    assert factor(2, "a 2", compiled=True) == slow and factor(2, "a 2", compiled=False) == slow
    assert len(measured) == 1
    # The same processor time, on twice the threads.
    assert factor(4, "a 4", compiled=True) == pytest.approx(slow / 2)
    file = tmp_path / "cache" / "speed.json"
    assert json.loads(file.read_text())["key"] == "a 4"
    for damaged in ("", "{", '{"key": "b 2", "factor": "x"}', '{"key": "b 2", "factor": 1e9}', "[]"):
        file.write_text(damaged)
        assert factor(2, "b 2", compiled=False) == 1.0


def test_an_iteration_is_measured() -> None:
    assert 0.001 < calibration._processor_s() < 60
