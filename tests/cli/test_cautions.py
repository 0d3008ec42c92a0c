"""Cautions on the screen: the last thing that a command says is what limits the result."""

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
LAST_LINES = [
    "caution: All fixes are [red]1.2 m[/red] too high. (init-sim3, fixes-shifted)",
    "caution: Nothing checks the height. (train, few-points)",
]


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


@pytest.mark.parametrize("command", ["run", *(spec.name for spec in PIPELINE if spec.name != "calibrate")])
def test_last_lines_are_the_cautions_each_once(georef: Georef, limited: Path, command: str) -> None:
    result = georef(command, limited)
    assert result.code == 0
    assert result.out.splitlines()[-2:] == LAST_LINES
    assert sum("caution:" in line for line in result.out.splitlines()) == 2


@pytest.mark.parametrize("command", ["run", "status", *(spec.name for spec in PIPELINE)])
def test_json_has_them_with_code_sentence_and_stage(georef: Georef, limited: Path, command: str) -> None:
    result = georef(command, limited, "--json")
    assert result.code == 0
    assert result.document["cautions"] == IN_ORDER


def test_stage_that_ran_says_its_own_on_stderr_and_in_its_log(georef: Georef, limited: Path) -> None:
    result = georef("train", limited, "--force")
    assert [line for line in result.err.splitlines() if "warning" in line] == [f"warning: train: {FEW.sentence}"]
    assert FEW.sentence in (limited / "logs/train.log").read_text()


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
