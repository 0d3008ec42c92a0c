"""What a machine's own runs took corrects its estimates; a loaded machine is recognised."""

from pathlib import Path

import pytest

from pipelines.core.stages import DELIVERABLES, PIPELINE
from pipelines.jobs import pace
from pipelines.jobs.costs import COSTS, Work


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(pace, "user_cache", lambda: tmp_path / "cache")
    return tmp_path / "cache" / "pace.json"


def test_every_stage_and_deliverable_has_a_time() -> None:
    own = {"sfm", "train"}  # which have models of their own
    for spec in (*PIPELINE, *DELIVERABLES):
        if spec.name not in own:
            few, many = (COSTS[spec.name].of(Work(photographs=count, megapixels=count / 5)) for count in (10, 400))
            assert 0 < few <= many


def test_the_median_of_the_last_runs_corrects_the_next() -> None:
    assert pace.corrected("train", 100.0) == 100.0
    for took_s in (150.0, 160.0, 900.0):
        pace.learn("train", 100.0, took_s)
    assert pace.corrected("train", 100.0) == pytest.approx(160.0)
    assert pace.corrected("sfm", 100.0) == 100.0
    for _ in range(5):  # older runs are forgotten
        pace.learn("train", 100.0, 50.0)
    assert pace.corrected("train", 200.0) == pytest.approx(100.0)


def test_a_stage_that_never_ran_is_as_slow_as_the_others() -> None:
    pace.learn("ingest", 1.0, 3.0)
    pace.learn("train", 100.0, 250.0)
    assert pace.corrected("export-mesh", 10.0) == 10.0  # two stages may both be exceptions
    pace.learn("evaluate", 10.0, 20.0)
    assert pace.corrected("export-mesh", 10.0) == pytest.approx(25.0)


def test_another_processor_learns_for_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    pace.learn("train", 100.0, 200.0)
    monkeypatch.setattr(pace, "_processor", lambda: "another")
    assert pace.corrected("train", 100.0) == 100.0
    pace.learn("train", 100.0, 50.0)
    monkeypatch.undo()


@pytest.mark.parametrize("damaged", ["", "{", "[]", '{"a": 1}', '{"a": {"train": "x"}}'])
def test_a_damaged_file_is_as_none(cache: Path, damaged: str) -> None:
    cache.parent.mkdir()
    cache.write_text(damaged)
    assert pace.corrected("train", 10.0) == 10.0
    pace.learn("train", 10.0, 20.0)
    assert pace.corrected("train", 10.0) == pytest.approx(20.0)


def test_a_loaded_machine_is_recognised(monkeypatch: pytest.MonkeyPatch) -> None:
    ticks_per_s = pace.os.sysconf("SC_CLK_TCK")
    before = pace.Ticks(total=1000, idle=500, steal=0)
    # Two cores for ten seconds: this run used one of them, another program the other, stolen ticks count as used.
    after = pace.Ticks(total=1000 + 20 * ticks_per_s, idle=500, steal=5 * ticks_per_s)
    monkeypatch.setattr(pace, "ticks", lambda: after)
    assert pace.used_by_others(before, 10.0) == pytest.approx(0.5)
    assert pace.is_loaded(0.5) and not pace.is_loaded(pace.used_by_others(before, 20.0))
    monkeypatch.setattr(pace.os, "getloadavg", lambda: (7.4, 0.0, 0.0))
    monkeypatch.setattr(pace.os, "cpu_count", lambda: 2)
    assert "load 7.4 on 2 cores" in pace.load_sentence()
    monkeypatch.setattr(pace.os, "getloadavg", lambda: (0.1, 0.0, 0.0))
    assert pace.load_sentence() == ""
