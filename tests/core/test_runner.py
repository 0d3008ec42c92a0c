"""The runner: what runs, what is skipped, what is remembered, and what each stage's state is."""

from __future__ import annotations

import logging
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from pipelines.core import runner
from pipelines.core import staleness as states
from pipelines.core.errors import (
    ConvergenceError,
    DegenerateGeometryError,
    GeorefError,
    InputError,
    MissingProductError,
)
from pipelines.core.fingerprints import fingerprints
from pipelines.core.options import read_requests
from pipelines.core.products import Remark
from pipelines.core.stages import BY_NAME, PIPELINE, SPARSE, stage_slice
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.ingest.options import IngestOptions
from tests import fakes
from tests.refusals import logged_codes, refused

pytestmark = pytest.mark.usefixtures("fake_stages")

ALL = [spec.name for spec in PIPELINE]
FEW = Remark(code="few-registered", sentence="Only 62 % of the photographs are registered.")


def complete(workspace: Workspace, **flags: dict[str, object]) -> list[str]:
    """Run the pipeline; the names of the stages that ran."""
    outcomes = runner.run_pipeline(workspace, PIPELINE, flags)
    return [outcome.stage for outcome in outcomes if outcome.ran]


def state_of(workspace: Workspace) -> dict[str, str]:
    return {row.stage: row.state for row in states.status(workspace)}


def reason_of(workspace: Workspace, stage: str) -> str:
    return next(row.reason for row in states.status(workspace) if row.stage == stage)


@pytest.fixture
def done(workspace: Workspace, photos: Path) -> Workspace:
    """A workspace in which all stages are current."""
    assert complete(workspace, ingest={"images": photos}) == ALL
    return workspace


def test_second_run_does_nothing(done: Workspace) -> None:
    assert complete(done) == []
    assert set(state_of(done).values()) == {"current"}


def test_force_runs_again(done: Workspace) -> None:
    outcomes = runner.run_pipeline(done, stage_slice("train", "evaluate"), {}, force=True)
    assert [outcome.ran for outcome in outcomes] == [True, True]


def test_changed_option_runs_that_stage_and_what_follows(done: Workspace) -> None:
    assert complete(done, train={"seed": 5}) == ["train", "evaluate", "export-ply"]


def test_equal_product_of_a_changed_stage_stops_the_change(done: Workspace, photos: Path) -> None:
    """What is downstream depends on content, and the survey of the fake `ingest` does not change."""
    (photos / "a.jpg").write_bytes(b"another")
    assert state_of(done)["ingest"] == "stale"
    assert state_of(done)["export-ply"] == "stale"
    assert complete(done) == ["ingest"]


class TestStatus:
    def test_nothing_there(self, workspace: Workspace) -> None:
        with refused("no-workspace", InputError):
            states.status(workspace)

    def test_removed_photograph(self, done: Workspace, photos: Path) -> None:
        (photos / "b.jpg").unlink()
        assert reason_of(done, "ingest") == "--images changed"
        assert reason_of(done, "sfm") == "ingest is stale"

    def test_removed_folder(self, done: Workspace, photos: Path) -> None:
        shutil.rmtree(photos)
        assert reason_of(done, "ingest").startswith(f"{photos} [--images]: ")

    def test_toml_counts(self, done: Workspace) -> None:
        done.config_file.write_text("[train]\nseed = 9\n")
        assert reason_of(done, "train") == "option seed changed"
        assert state_of(done)["init-sim3"] == "current"

    def test_bad_toml_is_an_error(self, done: Workspace) -> None:
        done.config_file.write_text("[train]\nseeds = 9\n")
        with refused("unknown-option", InputError) as error:
            states.status(done)
        assert (error.value.path, error.value.field) == (done.config_file, "train.seeds")

    def test_vanished_product(self, done: Workspace) -> None:
        shutil.rmtree(done.root / SPARSE)
        assert reason_of(done, "sfm") == "sfm/sparse is gone"
        assert complete(done) == ["sfm"]

    def test_damaged_manifest(self, done: Workspace, caplog: pytest.LogCaptureFixture) -> None:
        (done.root / "sfm/manifest.json").write_text('{"format_version": 99')
        assert "sfm/manifest.json" in reason_of(done, "sfm")
        assert complete(done) == ["sfm"]
        assert "manifest-damaged" in logged_codes(caplog)

    def test_manifest_of_another_version(self, done: Workspace) -> None:
        path = done.root / "train/manifest.json"
        path.write_text(path.read_text().replace('"preset"', '"old_name"'))
        assert reason_of(done, "train") == "made by a version with other options"

    def test_product_of_another_form(self, done: Workspace) -> None:
        """A survey that later stages would refuse is stale, and the options of its run are remembered."""
        path = done.root / "ingest/manifest.json"
        assert '"product_version": 2' in path.read_text()
        path.write_text(path.read_text().replace('"product_version": 2', '"product_version": 1'))
        assert reason_of(done, "ingest") == "made by another version of georef"
        assert complete(done) == ["ingest"]
        assert state_of(done)["sfm"] == "current"

    def test_failed_stage_tells_why(self, done: Workspace) -> None:
        def fail(stage: StageRun, options: object) -> Summary:
            raise ConvergenceError("residual-above-limit", "residual 7 m > 5 m")

        fakes.install(init_sim3=fail)
        with pytest.raises(ConvergenceError):
            runner.run_stage(done, BY_NAME["init-sim3"], {"max_residual": 5.0})
        row = next(row for row in states.status(done) if row.stage == "init-sim3")
        assert row.state == "stale"
        assert row.reason == "option max_residual changed; a later run failed: residual 7 m > 5 m"

    def test_first_failure_and_interruption(self, workspace: Workspace, photos: Path) -> None:
        def fail(stage: StageRun, options: object) -> Summary:
            raise GeorefError("too-few-registered", "2 of 48 registered")

        def stop(stage: StageRun, options: object) -> Summary:
            raise KeyboardInterrupt

        runner.run_stage(workspace, BY_NAME["ingest"], {"images": photos})
        fakes.install(sfm=fail)
        with pytest.raises(GeorefError):
            runner.run_stage(workspace, BY_NAME["sfm"], {})
        assert state_of(workspace)["sfm"] == "failed"
        assert reason_of(workspace, "sfm") == "2 of 48 registered"
        fakes.install(sfm=stop)
        with pytest.raises(KeyboardInterrupt):
            runner.run_stage(workspace, BY_NAME["sfm"], {}, resume="if-same")
        assert state_of(workspace)["sfm"] == "interrupted"

    def test_running_stage(self, done: Workspace) -> None:
        with done.lock("train"):
            assert state_of(done)["train"] == "running"
            assert state_of(done)["sfm"] == "current"

    def test_looking_writes_nothing(self, done: Workspace) -> None:
        def listing() -> dict[str, int]:
            return {str(path): path.stat().st_mtime_ns for path in done.root.rglob("*")}

        before = listing()
        states.status(done)
        assert listing() == before


class TestByHand:
    """A product can be replaced by hand: it is kept, and what builds on it follows."""

    def test_edited_product_counts_as_damaged_until_its_manifest_is_deleted(self, done: Workspace) -> None:
        """A hash cannot tell an edit from damage: the user says which it is."""
        (done.root / SPARSE / "content.txt").write_text("a better model")
        assert state_of(done)["sfm"] == "damaged"
        assert state_of(done)["geolocate"] == "stale"
        (done.root / "sfm/manifest.json").unlink()
        states_now = state_of(done)
        assert states_now["sfm"] == "current"
        assert states_now["geolocate"] == "stale"
        assert reason_of(done, "train") == "sfm/sparse changed"
        assert "sfm" not in complete(done)

    def test_product_without_a_run_is_kept(self, workspace: Workspace, photos: Path) -> None:
        mine = workspace.root / SPARSE / "content.txt"
        mine.parent.mkdir(parents=True)
        mine.write_text("my own model")
        assert "sfm" not in complete(workspace, ingest={"images": photos})
        assert mine.read_text() == "my own model"
        assert reason_of(workspace, "sfm") == "put there by hand"
        outcome = runner.run_stage(workspace, BY_NAME["sfm"], {}, force=True)
        assert outcome.ran
        assert mine.read_text() != "my own model"


class TestRequests:
    def test_options_are_remembered(self, workspace: Workspace, photos: Path) -> None:
        runner.run_stage(workspace, BY_NAME["ingest"], {"images": photos, "test_every": 4})
        assert "ingest" not in complete(workspace)
        assert read_requests(workspace.root)["ingest"] == {"images": str(photos), "test_every": 4}

    def test_options_of_run_come_on_top(self, done: Workspace, photos: Path) -> None:
        complete(done, ingest={"test_every": 4})
        assert read_requests(done.root)["ingest"] == {"images": str(photos), "test_every": 4}

    def test_options_of_a_stage_stand_alone(self, done: Workspace) -> None:
        runner.run_stage(done, BY_NAME["train"], {"seed": 1})
        runner.run_stage(done, BY_NAME["train"], {"preset": "fast"})
        assert read_requests(done.root)["train"] == {"preset": "fast"}

    def test_refused_options_are_not_remembered(self, done: Workspace, photos: Path, tmp_path: Path) -> None:
        def refuse(stage: StageRun, options: object) -> Summary:
            raise InputError("no-images", "No images. Give --images.")

        fakes.install(ingest=refuse)
        with pytest.raises(InputError):
            runner.run_stage(done, BY_NAME["ingest"], {})
        with refused("no-such-file", InputError):
            runner.run_stage(done, BY_NAME["ingest"], {"images": tmp_path / "phots"})
        with refused("option-invalid", InputError) as error:
            runner.run_stage(done, BY_NAME["ingest"], {"images": photos, "test_every": -1})
        assert error.value.field == "--test-every"
        assert read_requests(done.root)["ingest"] == {"images": str(photos)}

    def test_options_of_all_stages_are_remembered_before_the_first_begins(
        self, workspace: Workspace, photos: Path
    ) -> None:
        """A run that is killed early must be completed with the effort that was asked for."""

        def killed(stage: StageRun, options: object) -> Summary:
            raise KeyboardInterrupt

        fakes.install(sfm=killed)
        with pytest.raises(KeyboardInterrupt):
            complete(workspace, ingest={"images": photos}, train={"preset": "smoke"})
        fakes.install()
        complete(workspace)
        manifest = workspace.manifest(BY_NAME["train"])
        assert manifest is not None and manifest.config["preset"] == "smoke"

    def test_bad_option_of_a_late_stage_is_told_before_the_first_begins(
        self, workspace: Workspace, photos: Path
    ) -> None:
        with refused("option-invalid", InputError) as error:
            complete(workspace, ingest={"images": photos}, train={"iterations": 0})
        assert error.value.field == "--iterations"
        assert not workspace.root.exists()

    def test_refused_run_is_not_remembered(self, done: Workspace, photos: Path, tmp_path: Path) -> None:
        before = read_requests(done.root)
        with refused("no-such-file", InputError):
            complete(done, ingest={"images": tmp_path / "phots"}, train={"preset": "smoke"})
        assert read_requests(done.root) == before

    def test_failed_demand_is_remembered(self, done: Workspace) -> None:
        """A bound that did not hold must not be dropped by the next `georef run`."""

        def fail(stage: StageRun, options: object) -> Summary:
            raise ConvergenceError("residual-above-limit", "too large")

        fakes.install(init_sim3=fail)
        for _ in range(2):
            with pytest.raises(ConvergenceError):
                complete(done, **{"init-sim3": {"max_residual": 5.0}})
        with pytest.raises(ConvergenceError):
            complete(done)


class TestResume:
    def interrupt(self, stage: StageRun, options: object) -> Summary:
        (stage.out / "checkpoint").write_text("1000")
        raise KeyboardInterrupt

    def resumed(self, workspace: Workspace) -> bool:
        manifest = workspace.manifest(BY_NAME["train"])
        assert manifest is not None
        return bool(manifest.values["resumed"])

    @pytest.fixture
    def interrupted(self, done: Workspace) -> Workspace:
        fakes.install(train=self.interrupt)
        with pytest.raises(KeyboardInterrupt):
            runner.run_stage(done, BY_NAME["train"], {"seed": 1})
        fakes.install()
        return done

    def test_run_resumes(self, interrupted: Workspace) -> None:
        assert complete(interrupted)[0] == "train"
        assert self.resumed(interrupted)

    def test_stage_starts_afresh_and_says_so(
        self, interrupted: Workspace, caplog: pytest.LogCaptureFixture
    ) -> None:
        runner.run_stage(interrupted, BY_NAME["train"], {"seed": 1})
        assert not self.resumed(interrupted)
        assert "interrupted-run-dropped" in logged_codes(caplog)

    def test_force_starts_afresh(self, interrupted: Workspace) -> None:
        runner.run_stage(interrupted, BY_NAME["train"], {"seed": 1}, resume="always", force=True)
        assert not self.resumed(interrupted)

    def test_resume_with_other_options_is_refused(self, interrupted: Workspace) -> None:
        with refused("interrupted-run-differs", InputError):
            runner.run_stage(interrupted, BY_NAME["train"], {"seed": 2}, resume="always")
        assert complete(interrupted)[0] == "train"
        assert self.resumed(interrupted)


class TestFailure:
    def test_stage_before_its_inputs(self, workspace: Workspace, photos: Path) -> None:
        with refused("no-workspace", InputError):
            runner.run_stage(workspace, BY_NAME["sfm"], {})
        assert not workspace.root.exists()
        runner.run_stage(workspace, BY_NAME["ingest"], {"images": photos})
        with pytest.raises(MissingProductError) as error:
            runner.run_stage(workspace, BY_NAME["train"], {})
        assert error.value.command.startswith("georef sfm")

    def test_failed_stage_keeps_its_product(self, done: Workspace) -> None:
        def fail(stage: StageRun, options: object) -> Summary:
            fakes.write_products(stage, BY_NAME["train"], "half")
            raise GeorefError("diverged", "diverged")

        before = fakes.read_products(done, BY_NAME["train"])
        fakes.install(train=fail)
        with pytest.raises(GeorefError):
            runner.run_stage(done, BY_NAME["train"], {"seed": 1})
        assert fakes.read_products(done, BY_NAME["train"]) == before

    def test_stage_that_forgets_a_product_is_a_defect(self, done: Workspace) -> None:
        fakes.install(train=lambda stage, options: Summary("done"))
        with pytest.raises(RuntimeError, match=r"did not write train/model\.json"):
            runner.run_stage(done, BY_NAME["train"], {}, force=True)

    def test_stale_input_is_told(self, done: Workspace, caplog: pytest.LogCaptureFixture, photos: Path) -> None:
        (photos / "c.jpg").write_bytes(b"c")
        with caplog.at_level(logging.WARNING):
            runner.run_stage(done, BY_NAME["sfm"], {})
        assert "input-stale" in logged_codes(caplog)
        assert "(--images changed)" in caplog.text

    def test_warnings_are_told_and_kept(self, done: Workspace, caplog: pytest.LogCaptureFixture) -> None:
        def warn(stage: StageRun, options: object) -> Summary:
            fakes.write_products(stage, BY_NAME["sfm"], "model")
            return Summary("30 of 48 registered", warnings=(FEW,))

        fakes.install(sfm=warn)
        outcome = runner.run_stage(done, BY_NAME["sfm"], {}, force=True)
        assert outcome.manifest.warnings == (FEW,)
        assert f"sfm: {FEW.sentence}" in caplog.text
        assert FEW.code in logged_codes(caplog)


def test_workspace_inside_the_photographs(photos: Path) -> None:
    """The workspace's own files are no photographs: writing them must not make ingest stale."""
    workspace = Workspace(photos / "flight")
    complete(workspace, ingest={"images": photos})
    assert complete(workspace) == []


def test_slice_in_wrong_order() -> None:
    with refused("stage-order"):
        stage_slice("train", "sfm")


def test_large_input_file_counts_by_size_and_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bag of many gigabytes is not read at each look: its size and samples stand for its content."""
    monkeypatch.setattr("pipelines.core.fingerprints._WHOLE_BYTES", 9_999)
    monkeypatch.setattr("pipelines.core.fingerprints._SAMPLE_BYTES", 10)
    bag, data = tmp_path / "flight.mcap", np.random.default_rng(0).bytes(10_000)
    bag.write_bytes(data)
    workspace, spec = Workspace(tmp_path / "ws"), BY_NAME["ingest"]
    options = IngestOptions(bag=bag)

    def seen() -> str:
        return fingerprints(workspace, spec, options, {}).hashes["--bag"]

    before = seen()
    os.utime(bag, (1, 1))
    assert seen() == before
    for other in (data + b"x", bytes([data[0] ^ 1]) + data[1:], data[:-1] + bytes([data[-1] ^ 1])):
        bag.write_bytes(other)
        assert seen() != before


@pytest.mark.parametrize(
    "error",
    [np.linalg.LinAlgError("Singular matrix"), RecursionError("nested too deeply"), OverflowError("out of range")],
)
def test_products_without_a_solution_are_a_known_failure(
    workspace: Workspace, photos: Path, error: Exception
) -> None:
    """Numbers that were edited by hand reach the linear algebra of a stage."""

    def fail(stage: StageRun, options: object) -> Summary:
        raise error

    fakes.install(sfm=fail)
    with refused("no-solution", DegenerateGeometryError) as refusal:
        complete(workspace, ingest={"images": photos})
    assert f"({error})" in str(refusal.value)
    assert str(error) in reason_of(workspace, "sfm")
