"""Cautions on the screen: each once a command, as its last lines, by the command whose stage adds it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.core.options import StageOptions
from pipelines.core.products import Remark
from pipelines.core.stages import BY_NAME, PIPELINE
from pipelines.core.workspace import StageRun, Summary, Workspace
from tests import fakes
from tests.cli_runs import Georef

SHIFT = Remark(code="fixes-shifted", sentence="All fixes are [red]1.2 m[/red] too high.")
FEW = Remark(code="few-points", sentence="Nothing checks the height.")
IN_ORDER = [
    {"stage": "init-sim3", **SHIFT.model_dump()},
    {"stage": "train", **FEW.model_dump()},
]
LINES = {
    "init-sim3": "caution: All fixes are [red]1.2 m[/red] too high. (init-sim3, fixes-shifted)",
    "train": "caution: Nothing checks the height. (train, few-points)",
}
LAST_LINES = list(LINES.values())


def cautious(stage: str, *cautions: Remark) -> Callable[[StageRun, StageOptions], Summary]:
    """The `run` of a fake stage whose product has limits."""

    def run(out: StageRun, options: StageOptions) -> Summary:
        fakes.write_products(out, BY_NAME[stage], "limited")
        return Summary(f"{stage} done", {}, (), cautions)

    return run


@pytest.fixture
def limited(georef: Georef, workspace: Workspace, photos: Path) -> Path:
    """A workspace whose stages carry two cautions on."""
    fakes.install(
        init_sim3=cautious("init-sim3", SHIFT),
        train=cautious("train", SHIFT, FEW),
        export_ply=cautious("export-ply", SHIFT, FEW),
    )
    assert georef("run", workspace.root, "--images", photos).code == 0
    return workspace.root


@pytest.mark.parametrize("words", [("run",), ("run", "--force")])
def test_the_run_ends_with_all(georef: Georef, limited: Path, words: tuple[str, ...]) -> None:
    result = georef(words[0], limited, *words[1:])
    assert result.code == 0
    assert [line for line in result.out.splitlines() if "caution:" in line] == LAST_LINES
    assert result.out.splitlines()[-2:] == LAST_LINES
    assert FEW.sentence not in result.err and SHIFT.sentence not in result.err


@pytest.mark.parametrize("force", [(), ("--force",)], ids=["current", "again"])
@pytest.mark.parametrize("stage", [spec.name for spec in PIPELINE if spec.name != "calibrate"])
def test_a_stage_ends_with_those_that_it_adds(
    georef: Georef, limited: Path, stage: str, force: tuple[str, ...]
) -> None:
    result = georef(stage, limited, *force)
    assert result.code == 0
    told = [line for line in result.out.splitlines() if "caution:" in line]
    assert told == ([LINES[stage]] if stage in LINES else [])
    assert result.out.splitlines()[-1:] == told or not told
    assert FEW.sentence not in result.err and SHIFT.sentence not in result.err


@pytest.mark.parametrize("command", ["run", "status", *(spec.name for spec in PIPELINE)])
def test_json_has_them_with_code_sentence_and_stage(georef: Georef, limited: Path, command: str) -> None:
    result = georef(command, limited, "--json")
    assert result.code == 0
    assert result.document["cautions"] == IN_ORDER


def test_the_log_of_a_stage_has_those_that_it_adds(georef: Georef, limited: Path) -> None:
    before = (limited / "logs/train.log").read_text()
    assert georef("train", limited, "--force").code == 0
    new = (limited / "logs/train.log").read_text().removeprefix(before)
    assert new.count(FEW.sentence) == 1 and SHIFT.sentence not in new


def test_a_warning_is_said_once(georef: Georef, workspace: Workspace, photos: Path) -> None:
    """On stderr by the command whose stage just ran; on stdout while the stage is current."""
    left_out = Remark(code="left-out", sentence="One image was left out.")

    def ingest(out: StageRun, options: StageOptions) -> Summary:
        fakes.write_products(out, BY_NAME["ingest"], "text")
        return Summary("ingest done", {}, (left_out,))

    fakes.install(ingest=ingest)
    words = ("ingest", workspace.root, "--images", photos)
    for command in (words, ("run", workspace.root, "--force")):
        ran = georef(*command)
        assert ran.warned == ("left-out",)
        assert (ran.err.count(left_out.sentence), ran.out.count(left_out.sentence)) == (1, 0)
    for command in (words, ("run", workspace.root)):
        current = georef(*command)
        assert current.warned == ()
        assert (current.err.count(left_out.sentence), current.out.count(left_out.sentence)) == (0, 1)


def test_status_counts_them_and_says_them_below(georef: Georef, limited: Path) -> None:
    lines = georef("status", limited).out.splitlines()
    head = lines[0].index("cautions") + len("cautions")
    counts = {line.split()[0]: line[:head].split()[-1] for line in lines[1 : 1 + len(PIPELINE)]}
    assert {stage for stage, count in counts.items() if count == "1"} == {"init-sim3", "train"}
    assert lines[1 + len(PIPELINE)].startswith("accuracy not known: ")
    assert lines[2 + len(PIPELINE) :] == LAST_LINES


def test_no_caution_is_no_line(georef: Georef, workspace: Workspace, photos: Path) -> None:
    result = georef("run", workspace.root, "--images", photos)
    assert "caution" not in result.out
    assert georef("status", workspace.root, "--json").document["cautions"] == []
