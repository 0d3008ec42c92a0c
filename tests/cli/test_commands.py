"""Every command over a workspace with fake stages: what it does, prints and returns."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from georef_cli.commands.run import LATER
from pipelines.core.errors import ConvergenceError
from pipelines.core.machine import chosen_threads, thread_count
from pipelines.core.options import read_requests
from pipelines.core.products import Remark
from pipelines.core.stages import BY_NAME, DELIVERABLES, PIPELINE, stage_slice
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.survey.options import AreaOptions
from tests import fakes
from tests.cli_runs import Georef

STAGES = [spec.name for spec in PIPELINE]


def everything_in(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of everything in a folder."""
    return {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(folder.rglob("*"))}


@pytest.fixture
def done(georef: Georef, workspace: Workspace, photos: Path) -> Path:
    """A workspace in which all stages are current."""
    assert georef("run", workspace.root, "--images", photos).code == 0
    return workspace.root


def test_run_runs_everything_once(georef: Georef, workspace: Workspace, photos: Path) -> None:
    first = georef("run", workspace.root, "--images", photos, "--json")
    assert first.code == 0
    assert [(row["stage"], row["ran"]) for row in first.document["stages"]] == [(name, True) for name in STAGES]
    second = georef("run", workspace.root, "--json")
    assert [row["ran"] for row in second.document["stages"]] == [False] * len(STAGES)


def test_stage_by_stage(georef: Georef, workspace: Workspace, photos: Path) -> None:
    for name in STAGES:
        options = ["--images", photos] if name == "ingest" else []
        result = georef(name, workspace.root, *options, "--json")
        assert result.code == 0
        assert set(result.document) == {
            *("stage", "ran", "key_figure", "values", "warnings", "cautions", "duration_s")
        }
        assert (result.document["stage"], result.document["ran"]) == (name, True)
        assert not georef(name, workspace.root, *options, "--json").document["ran"]
        assert georef(name, workspace.root, *options, "--force", "--json").document["ran"]


def test_status(georef: Georef, done: Path, photos: Path) -> None:
    (photos / "c.jpg").write_bytes(b"c")
    table = georef("status", done)
    assert table.code == 0
    assert table.err == ""
    lines = [line for line in table.out.splitlines() if not line.startswith(" ")]  # long reasons go on below
    assert [line.split()[0] for line in lines] == ["stage", *STAGES, "accuracy"]
    assert "stale" in lines[1]
    assert "--images changed" in lines[1]
    rows = georef("status", done, "--json").document["stages"]
    assert [row["stage"] for row in rows] == STAGES
    assert set(rows[0]) == {"stage", "state", "reason", "finished", "duration_s", "key_figure", "interrupted"}
    assert [row["state"] for row in rows] == ["stale"] * len(STAGES)


def test_status_of_nothing(georef: Georef, tmp_path: Path) -> None:
    result = georef("status", tmp_path / "nowhere", "--json")
    result.assert_failed(1, "no-workspace")
    assert result.err.startswith(f"error: {tmp_path}/nowhere: ")


class TestRunOptions:
    def test_each_option_reaches_its_stages(self, georef: Georef, done: Path) -> None:
        result = georef("run", done, "--seed", 3, "--backend", "cpu", "--preset", "smoke", "--max-image-size", 400)
        assert result.code == 0
        requests = read_requests(done)
        assert requests["sfm"] == {"seed": 3}
        assert requests["init-sim3"] == {"seed": 3}
        assert requests["train"] == {"seed": 3, "backend": "cpu", "preset": "smoke", "max_image_size": 400}
        assert requests["evaluate"] == {"backend": "cpu"}

    def test_slice(self, georef: Georef, done: Path) -> None:
        result = georef("run", done, "--from", "sfm", "--to", "init-sim3", "--force", "--json")
        names = [row["stage"] for row in result.document["stages"]]
        assert names == [spec.name for spec in stage_slice("sfm", "init-sim3")]
        assert (names[0], names[-1]) == ("sfm", "init-sim3")
        assert all(row["ran"] for row in result.document["stages"])

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--from", "train", "--copy"], "--copy is for ingest"),
            (["--from", "train", "--to", "sfm"], "--from train"),
            (["--from", "training"], "'training' is not one of 'ingest'"),
        ],
    )
    def test_options_that_make_no_sense(
        self, georef: Georef, done: Path, arguments: list[str], message: str
    ) -> None:
        result = georef("run", done, *arguments)
        result.assert_failed(2)
        assert message in result.err

    @pytest.mark.parametrize("given", [["--iterations", "5"], ["--preset", "fast"], ["--backend", "cpu"]])
    def test_options_of_stages_that_are_not_reached_are_named_and_not_used(
        self, georef: Georef, done: Path, given: list[str]
    ) -> None:
        before = read_requests(done)
        result = georef("run", done, "--to", "sfm", *given)
        assert result.code == 0
        assert f"{given[0]} is for train" in result.err
        assert read_requests(done) == before

    def test_relative_paths_are_remembered_absolute(
        self, georef: Georef, workspace: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(photos.parent)
        assert georef("run", "flight", "--images", "photos").code == 0
        monkeypatch.chdir("/")
        rows = georef("run", workspace.root, "--json").document["stages"]
        assert [row["ran"] for row in rows] == [False] * len(STAGES)


class TestFlags:
    def test_file_decides_where_no_flag_is_given(self, georef: Georef, done: Path) -> None:
        (done / "georef.toml").write_text("[train]\nseed = 4\ndistance_loss = false\n")
        georef("train", done)
        georef("train", done, "--distance-loss", "--checkpoint-every", 9)
        manifest = Workspace(done).manifest(BY_NAME["train"])
        assert manifest is not None
        assert (manifest.config["seed"], manifest.config["distance_loss"]) == (4, True)
        assert manifest.config["checkpoint_every"] == 9

    def test_repeated_option(self, georef: Georef, done: Path, photos: Path) -> None:
        georef("ingest", done, "--images", photos, "--check", "P1", "--check", "P2", "--no-copy")
        assert read_requests(done)["ingest"] == {
            "images": str(photos),
            "check": ["P1", "P2"],
            "copy_images": False,
        }

    def test_out_of_range(self, georef: Georef, done: Path) -> None:
        result = georef("sfm", done, "--max-features", 1, "--json")
        result.assert_failed(2)
        assert result.err == "error: [--max-features]: Input should be greater than or equal to 200.\n"

    @pytest.mark.parametrize("arguments", [["--mapper", "best"], ["--max-features", "many"], ["--frobnicate"]])
    def test_usage(self, georef: Georef, done: Path, arguments: list[str]) -> None:
        result = georef("sfm", done, *arguments)
        result.assert_failed(2)
        assert arguments[0] in result.err

    def test_unknown_key_in_file(self, georef: Georef, done: Path) -> None:
        (done / "georef.toml").write_text("[train]\nsteps = 4\n")
        result = georef("train", done)
        result.assert_failed(1, "unknown-option")
        assert result.err.startswith(f"error: {done}/georef.toml [train.steps]: ")


class TestTrainResume:
    def stop(self, stage: StageRun, options: object) -> Summary:
        (stage.out / "checkpoint").write_text("1000")
        raise KeyboardInterrupt

    def test_resume_keeps_the_options(self, georef: Georef, done: Path) -> None:
        fakes.install(train=self.stop)
        assert georef("train", done, "--preset", "fast").code == 130
        fakes.install()
        other = georef("train", done, "--preset", "high", "--resume")
        other.assert_failed(1, "interrupted-run-differs")
        values = georef("train", done, "--resume", "--json").document["values"]
        assert values["resumed"]
        assert '"preset":"fast"' in values["text"]


class TestExport:
    @pytest.fixture(autouse=True)
    def splat_with_sidecar(self, georef: Georef) -> None:
        def export(stage: StageRun, options: object) -> Summary:
            (stage.out / "splat.ply").write_text("ply")
            (stage.out / "splat.ply.georef.json").write_text("{}")
            return Summary("1 Gaussian")

        fakes.install(export_ply=export)

    def test_output(self, georef: Georef, done: Path, tmp_path: Path) -> None:
        target = tmp_path / "site.ply"
        assert georef("export-ply", done, "-o", target).code == 0
        assert target.read_text() == "ply"
        assert (tmp_path / "site.ply.georef.json").read_text() == "{}"

    def test_existing_file_is_kept_unless_forced(self, georef: Georef, done: Path, tmp_path: Path) -> None:
        target = tmp_path / "site.ply"
        target.write_text("mine")
        result = georef("export-ply", done, "-o", target)
        result.assert_failed(1, "target-exists")
        assert target.read_text() == "mine"
        assert georef("export-ply", done, "-o", target, "--force").code == 0
        assert target.read_text() == "ply"

    def test_a_name_of_another_format_is_refused(self, georef: Georef, done: Path, tmp_path: Path) -> None:
        target = tmp_path / "site.spz"
        result = georef("export-ply", done, "--to", target)
        result.assert_failed(1, "target-suffix")
        assert result.err.startswith(f"error: {target}: ") and ".ply" in result.err
        assert not target.exists()

    def test_the_measurable_splat_is_a_file_of_its_own(self, georef: Georef, done: Path, tmp_path: Path) -> None:
        target = tmp_path / "site.ply"
        words = ("export-ply", done, "--measurable", "--disc-spacing", 0.5, "--to", target, "--json")
        assert georef(*words).document["stage"] == "export-measurable"
        assert '"disc_spacing":0.5' in target.read_text()
        assert (done / "measurable/splat.measurable.ply").exists() and (done / "export/splat.ply").exists()
        rows = georef("status", done, "--json").document["stages"]
        states = {row["stage"]: row["state"] for row in rows if row["stage"].startswith("export")}
        assert states == {"export-ply": "current", "export-measurable": "current"}
        assert not georef("export-ply", done, "--measurable", "--json").document["ran"], "the spacing is remembered"
        assert georef("export-ply", done, "--disc-spacing", 1).code == 2

    def test_missing_folders_are_made(self, georef: Georef, done: Path, tmp_path: Path) -> None:
        assert georef("export-ply", done, "-o", tmp_path / "out" / "deep" / "site.ply").code == 0
        assert (tmp_path / "out/deep/site.ply").read_text() == "ply"
        (tmp_path / "file").write_text("mine")
        result = georef("export-ply", done, "-o", tmp_path / "file" / "site.ply")
        result.assert_failed(1, "target-folder")
        assert result.err.startswith(f"error: {tmp_path}/file: ")

    def test_a_workspace_that_cannot_be_written_is_exported_from(
        self, georef: Georef, done: Path, tmp_path: Path
    ) -> None:
        """Nobody can lock it: not even root opens a folder as a file. A current product is copied as it is."""
        assert georef("report", done).code == 0
        (done / ".lock").unlink()
        (done / ".lock").mkdir()
        before = everything_in(done)
        refused = georef("export-ply", done, "--min-opacity", 0.25)
        refused.assert_failed(1, "workspace-read-only")
        assert "--to" in refused.err
        target = tmp_path / "out" / "site.ply"
        assert georef("export-ply", done, "--min-opacity", 0.25, "--to", target, "--json").document["ran"]
        assert georef("export-tiles", done, "--to", tmp_path / "out" / "www").code == 0
        assert sorted(path.name for path in target.parent.iterdir()) == ["site.ply", "site.ply.georef.json", "www"]
        assert not georef("report", done, "--to", tmp_path / "report.html", "--json").document["ran"]
        assert (tmp_path / "report.html").read_bytes() == (done / "report/report.html").read_bytes()
        assert everything_in(done) == before
        assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []

    def test_a_failure_leaves_nothing_beside_the_target(self, georef: Georef, done: Path, tmp_path: Path) -> None:
        def fail(stage: StageRun, options: object) -> Summary:
            raise ConvergenceError("diverged-at-iteration", "diverged at iteration 7")

        (done / ".lock").unlink()
        (done / ".lock").mkdir()
        before = everything_in(done)
        fakes.install(export_tiles=fail)
        georef("export-tiles", done, "--to", tmp_path / "www").assert_failed(1, "diverged-at-iteration")
        assert everything_in(done) == before
        assert not [path for path in tmp_path.iterdir() if "www" in path.name]


class TestTalk:
    """stdout is the result's; everything else goes to stderr and to the stage's log."""

    def test_stderr_tells_stages_and_warnings(self, georef: Georef, done: Path, photos: Path) -> None:
        (photos / "c.jpg").write_bytes(b"c")
        result = georef("sfm", done, "--force")
        assert result.out.startswith("sfm: sfm done (")
        lines = result.err.splitlines()
        assert result.warned == ("input-stale",)
        assert lines[0].startswith("warning: sfm ") and "(--images changed)" in lines[0]
        assert lines[1:3] == ["sfm: started", "sfm: 2/2 after 0 s, half"]
        quiet = georef("-q", "sfm", done, "--force")
        assert quiet.err.splitlines() == lines[:1]

    def test_log_keeps_the_story(self, georef: Georef, done: Path) -> None:
        def fail(stage: StageRun, options: object) -> Summary:
            raise ConvergenceError("diverged-at-iteration", "diverged at iteration 7")

        fakes.install(train=fail)
        assert georef("-q", "train", done, "--force").code == 1
        text = (done / "logs/train.log").read_text()
        assert "INFO pipelines.core.runner: train: train done" in text
        assert text.rstrip().endswith("ERROR georef_cli.boundary: diverged at iteration 7")

    def test_refused_command_leaves_nothing(self, georef: Georef, tmp_path: Path) -> None:
        assert georef("train", tmp_path / "typo").code == 1
        assert not (tmp_path / "typo").exists()

    def test_traceback_on_demand(self, georef: Georef, done: Path) -> None:
        plain = georef("sfm", done, "--max-features", 1).err
        long = georef("--traceback", "sfm", done, "--max-features", 1).err
        assert "Traceback" not in plain
        assert "Traceback" in long
        assert long.endswith(plain)

    @pytest.mark.parametrize("place", [0, 1, 3])
    def test_verbose_and_quiet(self, georef: Georef, done: Path, place: int) -> None:
        words: list[object] = ["status", done]
        words[place:place] = ["-v"]
        result = georef(*words, "-q", "--json")
        result.assert_failed(2)
        assert "exclude each other" in result.err

    @pytest.mark.parametrize("command", ["sfm", "run"])
    def test_verbosity_behind_the_command(self, georef: Georef, done: Path, command: str) -> None:
        assert georef(command, done, "--force", "-q").err == georef("-q", command, done, "--force").err == ""
        assert georef(command, done, "--force").err != ""
        failing = ("sfm", done, "--max-features", 1)
        assert georef(*failing, "--traceback").err == georef("--traceback", *failing).err

    @pytest.mark.parametrize("words", [("-j", 1, "status"), ("status", "--threads", 1), ("sfm", "-j", 1)])
    def test_threads(
        self, georef: Georef, done: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[object, ...]
    ) -> None:
        """The variables are those that OpenMP, BLAS and numba read when a stage loads them."""
        for name in ("OMP", "NUMBA", "OPENBLAS", "MKL", "GDAL"):
            monkeypatch.setenv(f"{name}_NUM_THREADS", "7")
        assert georef(*words, done).code == 0
        assert {os.environ[f"{name}_NUM_THREADS"] for name in ("OMP", "NUMBA", "OPENBLAS", "MKL")} == {"1"}
        assert (thread_count(), chosen_threads(-1), chosen_threads(3)) == (1, 1, 3)
        georef("status", done, "-j", 0).assert_failed(2)

    def test_markup_in_results_is_text(self, georef: Georef, done: Path) -> None:
        def run(stage: StageRun, options: object) -> Summary:
            fakes.write_products(stage, BY_NAME["sfm"], "")
            return Summary("[red]48[/red] of 48", {"[bold]a": "[b]"}, (Remark(code="markup", sentence="[i]w[/i]"),))

        fakes.install(sfm=run)
        assert "[red]48[/red] of 48" in georef("sfm", done, "--force").out
        again = georef("sfm", done).out
        assert "warning: [i]w[/i]" in again
        assert "[bold]a" in again
        assert "[red]48[/red]" in georef("status", done).out


def test_run_hands_a_boundary_to_every_stage_that_ends_at_it() -> None:
    assert set(LATER["boundary"]) == {
        spec.name for spec in (*PIPELINE, *DELIVERABLES) if issubclass(spec.options, AreaOptions)
    }


def test_an_option_of_later_stages_is_told(georef: Georef, tmp_path: Path, photos: Path) -> None:
    """A boundary is for train and deliverables: a run to sfm says that it is not used, and runs."""
    field = tmp_path / "field.geojson"
    field.write_text("{}")
    result = georef("run", tmp_path / "ws", "--images", photos, "--to", "sfm", "--boundary", field)
    assert result.code == 0, result.err
    assert "--boundary" in result.err
