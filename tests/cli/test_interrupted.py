"""Interrupted and finished trainings: nothing of an interrupted one is lost unasked, a finished one is extended."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pipelines.core.errors import ConvergenceError
from pipelines.core.options import read_requests
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import StageRun, Summary, Workspace
from tests import fakes
from tests.cli_runs import Georef, Result

CHECKPOINT = "train.partial/checkpoint"
FOUND = r"1500 of 7000 iterations, 12 min, saved 20\d\d-\d\d-\d\d \d\d:\d\d"


def stop(stage: StageRun, options: object) -> Summary:
    (stage.out / "checkpoint").write_text("1500")
    stage.record_progress("1500 of 7000 iterations, 12 min")
    raise KeyboardInterrupt


@pytest.fixture
def interrupted(georef: Georef, workspace: Workspace, photos: Path) -> Path:
    """A workspace whose training, begun with `--preset fast`, was interrupted after 12 minutes."""
    fakes.install(train=stop)
    assert georef("run", workspace.root, "--images", photos, "--to", "train", "--preset", "fast").code == 130
    fakes.install()
    return workspace.root


def training(root: Path) -> tuple[bool, str]:
    manifest = Workspace(root).manifest(BY_NAME["train"])
    assert manifest is not None
    return bool(manifest.values["resumed"]), str(manifest.config["preset"])


def assert_refused(result: Result, root: Path, reason: str) -> None:
    result.assert_failed(1, "interrupted-run-lost")
    assert re.search(rf"\({FOUND}, with --preset fast\)", result.err)
    assert f"because {reason}" in result.err
    assert f"`georef train {root}`" in result.err
    assert "--force" in result.err
    assert (root / CHECKPOINT).read_text() == "1500"


@pytest.mark.parametrize("words", [("run",), ("train",), ("train", "--resume")])
def test_other_options_are_refused(georef: Georef, interrupted: Path, words: tuple[str, ...]) -> None:
    command, *options = words
    result = georef(command, interrupted, *options, "--preset", "high", "--json")
    assert_refused(result, interrupted, "option preset changed")
    assert read_requests(interrupted)["train"] == {"preset": "fast"}, "the refused option is not remembered"


def test_run_refuses_before_its_first_stage(georef: Georef, interrupted: Path, photos: Path) -> None:
    """Not after an hour of sfm."""
    (photos / "c.jpg").write_bytes(b"c")
    result = georef("run", interrupted, "--preset", "high")
    assert_refused(result, interrupted, "option preset changed")
    assert "ingest: started" not in result.err


def test_other_inputs_are_refused(georef: Georef, interrupted: Path) -> None:
    assert georef("init-sim3", interrupted, "--seed", 5).code == 0
    assert_refused(
        georef("run", interrupted),
        interrupted,
        "sim3/adjustment.json, sim3/adjustment.npz changed",
    )


@pytest.mark.parametrize("words", [("run",), ("train", "--resume"), ("train", "--preset", "fast")])
def test_the_same_options_continue(georef: Georef, interrupted: Path, words: tuple[str, ...]) -> None:
    command, *options = words
    assert georef(command, interrupted, *options).code == 0
    assert training(interrupted) == (True, "fast")
    assert not (interrupted / "train/progress.txt").exists()


@pytest.mark.parametrize("words", [("run", "--from", "train"), ("train",)])
def test_force_drops_it(georef: Georef, interrupted: Path, words: tuple[str, ...]) -> None:
    command, *options = words
    assert georef(command, interrupted, *options, "--preset", "high", "--force").code == 0
    assert training(interrupted) == (False, "high")


def test_a_diverged_training_is_worth_nothing(georef: Georef, interrupted: Path) -> None:
    def diverge(stage: StageRun, options: object) -> Summary:
        stage.record_progress("1600 of 7000 iterations, 13 min")
        raise ConvergenceError("diverged-train-again-with", "diverged: train again with another --seed")

    fakes.install(train=diverge)
    assert georef("train", interrupted).code == 1
    fakes.install()
    assert georef("train", interrupted, "--seed", 3).code == 0


class TestBesideAFinishedProduct:
    """`train --force` was killed: the old product is current, and the work beside it is told and gone on with."""

    @pytest.fixture
    def forced(self, georef: Georef, workspace: Workspace, photos: Path) -> Path:
        assert georef("run", workspace.root, "--images", photos, "--preset", "fast").code == 0
        fakes.install(train=stop)
        assert georef("train", workspace.root, "--force").code == 130
        fakes.install()
        return workspace.root

    @pytest.mark.parametrize("words", [("train",), ("run",), ("train", "--resume")])
    def test_the_next_command_goes_on(self, georef: Georef, forced: Path, words: tuple[str, ...]) -> None:
        command, *options = words
        done = georef(command, forced, *options)
        assert done.code == 0
        assert re.search(f"train: goes on with an interrupted run: {FOUND}, with --preset fast", done.err)
        assert "beside the finished product" in done.err
        assert training(forced) == (True, "fast")
        assert not (forced / "train.partial").exists()

    def test_force_drops_it_and_says_so(self, georef: Georef, forced: Path) -> None:
        done = georef("train", forced, "--force")
        assert "interrupted-run-dropped" in done.warned and re.search(FOUND, done.err)
        assert training(forced) == (False, "fast")

    def test_it_is_told_before(self, georef: Georef, forced: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("georef_cli.estimate._photographs", lambda *_: None)  # fake surveys have none
        state = " ".join(georef("status", forced).out.split())
        assert re.search(f"an interrupted run: {FOUND}, with --preset fast; `georef train", state)
        row = next(row for row in georef("status", forced, "--json").document["stages"] if row["stage"] == "train")
        assert row["state"] == "current" and re.search(FOUND, row["interrupted"])
        planned = {
            force: georef("train", forced, "--dry-run", "--json", *force).document["stages"][0]
            for force in ((), ("--force",))
        }
        assert planned[()]["action"] == "resume" and re.search(FOUND, planned[()]["reason"])
        assert re.search(f"drops an interrupted run: {FOUND}", planned["--force",]["reason"])
        assert (forced / CHECKPOINT).exists()

    def test_work_of_other_options_stays_and_the_right_command_is_named(self, georef: Georef, forced: Path) -> None:
        assert georef("train", forced).code == 0
        fakes.install(train=stop)
        assert georef("train", forced, "--iterations", 900).code == 130
        fakes.install()
        command = f"`georef train {forced} --iterations 900`"
        current = georef("run", forced, "--forget", "iterations")
        assert current.code == 0, "the product of these options is there, and nothing is lost"
        assert "interrupted-run-kept" in current.warned and command in current.err
        refused = georef("train", forced, "--seed", 5)
        refused.assert_failed(1, "interrupted-run-lost")
        assert command in refused.err
        assert georef(*command.strip("`").split()[1:]).code == 0
        assert training(forced)[0]

    def test_what_cannot_be_continued_is_dropped(self, georef: Georef, forced: Path) -> None:
        fakes.install(evaluate=stop)
        assert georef("evaluate", forced, "--force").code == 130
        fakes.install()
        again = georef("evaluate", forced)
        assert "evaluate: a run that did not end left nothing to go on with, and is dropped" in again.err
        assert "evaluate: current" in again.err and not (forced / "evaluate.partial").exists()


class TestExtension:
    """Only options that grow differ: the stage sees its finished folder."""

    @pytest.fixture
    def seen(self) -> list[bool]:
        seen: list[bool] = []

        def train(stage: StageRun, options: object) -> Summary:
            seen.append(stage.extends is not None and (stage.extends / "model.json").is_file())
            return fakes.fake_run(BY_NAME["train"])(stage, options)  # type: ignore[arg-type]

        fakes.install(train=train)
        return seen

    @pytest.mark.parametrize(
        ("words", "extends"),
        [
            (["--iterations", 900], True),
            (["--iterations", 900, "--seed", 3], False),
            (["--iterations", 900, "--force"], False),
            (["--seed", 3], False),
        ],
    )
    def test_more_iterations_extend(
        self,
        georef: Georef,
        seen: list[bool],
        workspace: Workspace,
        photos: Path,
        words: list[object],
        extends: bool,
    ) -> None:
        assert georef("run", workspace.root, "--images", photos, "--to", "train", "--iterations", 300).code == 0
        assert georef("train", workspace.root, *words).code == 0
        assert seen == [False, extends]

    def test_other_inputs_do_not(
        self, georef: Georef, seen: list[bool], workspace: Workspace, photos: Path
    ) -> None:
        assert georef("run", workspace.root, "--images", photos, "--to", "train", "--iterations", 300).code == 0
        assert georef("run", workspace.root, "--to", "train", "--test-every", 4, "--iterations", 900).code == 0
        assert seen == [False, False]
