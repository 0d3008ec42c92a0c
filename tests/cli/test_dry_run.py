"""`--dry-run`: what a run would do, why, with which options, for how long; and nothing is written."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from georef_cli import estimate
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.geodesy.crs import parse_crs
from pipelines.jobs.costs import TimeLeft, iteration_seconds
from pipelines.train import compilation
from tests import bags, fakes
from tests.cli_runs import Georef
from tests.photos import write_flight
from tests.refusals import numbers


def listing(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in folder.rglob("*")}


def actions(georef: Georef, *words: object) -> dict[str, str]:
    result = georef(*words, "--dry-run", "--json")
    assert result.code == 0, result.err
    return {row["stage"]: row["action"] for row in result.document["stages"]}


def test_before_the_first_run(georef: Georef, tmp_path: Path) -> None:
    """Photographs of 64×48 px are trained as they are; every stage has a time, and their sum is the total."""
    write_flight(tmp_path / "photos", 5, lat=46.0, lon=7.7)
    words = ("run", tmp_path / "ws", "--images", tmp_path / "photos", "--preset", "smoke", "--dry-run")
    document = georef(*words, "--json").document
    assert not (tmp_path / "ws").exists()
    assert {row["action"] for row in document["stages"]} == {"run"}
    assert (document["photographs"]["count"], document["photographs"]["size_px"]) == (5, [64, 48])
    training = document["training"]
    assert (training["iterations"], training["max_gaussians"], training["training_px"]) == (150, 20_000, [64, 48])
    assert training["peak_bytes"] > 100e6
    seconds = {row["stage"]: row["seconds"] for row in document["stages"]}
    assert all(value > 0 for value in seconds.values())
    total = document["total"]
    assert total["seconds"] == pytest.approx(sum(seconds.values()) + total["compilation_seconds"])
    assert document["total"]["peak_bytes"] >= training["peak_bytes"] and document["total"]["disk_bytes"] > 1e6
    origins = {row["flag"]: row["origin"] for row in document["stages"][5]["options"]}
    assert origins["--preset"] == "command line" and origins["--iterations"] == "preset"
    text = georef(*words).out
    assert "smoke: 150 iterations, 30 a photograph, at most 20000 Gaussians" in text
    assert "5 of 64×48 px" in text and "Nothing was run" in text and "In all: about" in text


def test_a_machine_that_has_to_compile_its_kernels_says_so(
    georef: Georef, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_flight(tmp_path / "photos", 5, lat=46.0, lon=7.7)
    words = ("run", tmp_path / "ws", "--images", tmp_path / "photos", "--preset", "smoke", "--dry-run")
    totals = []
    for there in (True, False):
        stamp = tmp_path / "stamp"
        stamp.touch() if there else stamp.unlink()
        monkeypatch.setattr(compilation, "compilation_stamp", lambda _: stamp)  # noqa: B023
        totals.append(georef(*words, "--json").document["total"])
        assert ("compiles the kernels" in georef(*words).out) == (not there)
    later_s = totals[1]["seconds"] - totals[0]["seconds"]
    assert totals[0]["compilation_seconds"] == 0 and totals[1]["compilation_seconds"] > 10
    assert later_s == pytest.approx(totals[1]["compilation_seconds"])


def test_a_run_that_compiled_teaches_nothing_of_stages_after_the_training(monkeypatch: pytest.MonkeyPatch) -> None:
    taught: list[str] = []
    monkeypatch.setattr(estimate.pace, "learn", lambda stage, *_: taught.append(stage))
    monkeypatch.setattr(estimate.pace, "used_by_others", lambda *_: 0.0)
    names = ("ingest", "sfm", "train", "evaluate")
    planned = [SimpleNamespace(stage=name, action="run") for name in names]
    ran = [SimpleNamespace(stage=name, ran=True, manifest=SimpleNamespace(duration_s=1.0)) for name in names]
    for compilation_s, expected in ((0.0, list(names)), (45.0, ["ingest", "sfm", "train"])):
        taught.clear()
        run = SimpleNamespace(planned=planned, modelled={}, compilation_s=compilation_s)
        estimate.keep_times(run, ran, None)  # type: ignore[arg-type]
        assert taught == expected


def test_a_run_begins_with_the_estimate(georef: Georef, tmp_path: Path) -> None:
    """Ahead of the first stage, and once."""
    write_flight(tmp_path / "photos", 5, lat=46.0, lon=7.7)
    lines = georef("run", tmp_path / "ws", "--images", tmp_path / "photos", "--max-image-size", 40).err.splitlines()
    assert lines[0] == "train: standard: 150 iterations, 30 a photograph, at most 150000 Gaussians"
    assert (
        lines[1] == "train: 5 photographs of 64×48 px are trained at 40×30, 1/1.6 of their side (--max-image-size)"
    )
    assert any(line.startswith("ingest: started") for line in lines[3:])
    assert sum("Gaussians" in line for line in lines) == 1


def test_large_photographs_are_trained_in_crops(georef: Georef, tmp_path: Path) -> None:
    """A crop of 32×32 px takes a quarter of 64×48 px and more."""
    write_flight(tmp_path / "photos", 5, lat=46.0, lon=7.7)
    words = ("run", tmp_path / "ws", "--images", tmp_path / "photos", "--dry-run")
    whole, cropped = (georef(*words, *more, "--json").document["training"] for more in ((), ("--crop-size", 32)))
    assert (whole["crops"], cropped["crops"]) == (1, 4)
    assert cropped["seconds"] < whole["seconds"] and cropped["peak_bytes"] < whole["peak_bytes"]
    assert "each in 4 crops (--crop-size)" in " ".join(georef(*words, "--crop-size", 32).out.split())


def test_a_missing_file_is_told(georef: Georef, tmp_path: Path) -> None:
    georef("run", tmp_path / "ws", "--images", tmp_path / "phots", "--dry-run").assert_failed(1)
    georef("train", tmp_path / "ws", "--dry-run").assert_failed(1)


class TestInputs:
    """`--dry-run` reads what ingest reads: same message, same exit code, nothing written."""

    @pytest.fixture
    def photos(self, tmp_path: Path) -> Path:
        write_flight(tmp_path / "photos", 4, positions=False)
        return tmp_path / "photos"

    @pytest.mark.parametrize(
        ("more", "reason"),
        [
            ((), "--trajectory"),
            (("--geo", "photos/IMG_0000.JPG"), "IMG_0000.JPG"),
            (("--gcp", "gcp_list.txt"), "gcp_list.txt:2"),
        ],
    )
    def test_are_refused_as_by_the_run(
        self, real_georef: Georef, tmp_path: Path, photos: Path, more: tuple[str, ...], reason: str
    ) -> None:
        (tmp_path / "gcp_list.txt").write_text("EPSG:32632\nno numbers here\n", "utf-8")
        paths = [word if word.startswith("--") else tmp_path / word for word in more]
        words, before = ("run", tmp_path / "ws", "--images", photos, *paths), listing(tmp_path)
        dry = real_georef(*words, "--dry-run")
        dry.assert_failed(1)
        assert reason in dry.err
        assert listing(tmp_path) == before
        assert real_georef(*words, "--to", "ingest").err.splitlines()[-1] == dry.err.splitlines()[-1]

    def test_of_too_few_photographs(self, real_georef: Georef, tmp_path: Path) -> None:
        write_flight(tmp_path / "photos", 2)
        dry = real_georef("ingest", tmp_path / "ws", "--images", tmp_path / "photos", "--dry-run", "--json")
        dry.assert_failed(1)
        assert numbers(dry.document["error"]["message"])[:2] == [2, 3]  # usable images, and those needed

    def test_of_a_batch(self, real_georef: Georef, tmp_path: Path, photos: Path) -> None:
        write_flight(tmp_path / "located", 3)
        folders = {"nowhere": "photos", "placed": "located"}
        missions = "".join(f'[missions.{name}]\nimages = "{folder}"\n' for name, folder in folders.items())
        (tmp_path / "valley.toml").write_text(missions, "utf-8")
        dry = real_georef("batch", tmp_path / "valley.toml", "--dry-run", "--json")
        assert dry.code == 1
        refusals = {row["mission"]: row["refusal"] for row in dry.document["missions"]}
        assert "--trajectory" in refusals["nowhere"] and refusals["placed"] == ""

    def test_are_told_where_they_will_do(self, real_georef: Georef, tmp_path: Path) -> None:
        """Heads alone are read, so damage behind them is not seen: 10 000 photographs take seconds."""
        names = write_flight(tmp_path / "photos", 4)
        whole = (tmp_path / "photos" / names[0]).read_bytes()
        (tmp_path / "photos" / names[0]).write_bytes(whole[:-700])
        (tmp_path / "photos/a.jpg").write_text("no image")
        words = ("run", tmp_path / "ws", "--images", tmp_path / "photos", "--dry-run")
        dry = real_georef(*words)
        assert dry.code == 0, dry.err
        assert "Survey: 4 images, 4 positions, 0 control and 0 check points" in dry.out
        assert [line for line in dry.err.splitlines() if line.startswith("warning: ingest: ") and "a.jpg (" in line]
        assert real_georef(*words, "--json").document["survey"]["values"]["fixes"] == 4

    def test_of_a_bag(self, real_georef: Georef, tmp_path: Path) -> None:
        flight = bags.Flight()
        bags.write(tmp_path / "bag", bags.usual(flight))
        bags.write(tmp_path / "blind", bags.images(flight))
        dry = real_georef("run", tmp_path / "ws", "--bag", tmp_path / "bag", "--dry-run", "--json")
        assert f"a bag with {len(flight.image_ns)} frames" in dry.document["survey"]["key_figure"]
        words = ("run", tmp_path / "ws", "--bag", tmp_path / "blind", "--to", "ingest")
        dry = real_georef(*words, "--dry-run")
        dry.assert_failed(1)
        assert not (tmp_path / "ws").exists()
        # The run has read the frames, and says what their tags hold.
        told = dry.err.splitlines()[-1].partition(". ")[0]
        assert real_georef(*words).err.splitlines()[-1].startswith(told)
        assert "No image has a position" in told


class TestOfAWorkspace:
    @pytest.fixture
    def done(self, georef: Georef, workspace: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.setattr("georef_cli.estimate._photographs", lambda *_: None)  # fake surveys have none
        assert georef("run", workspace.root, "--images", photos, "--iterations", 300).code == 0
        return workspace.root

    def test_current_stages_are_kept(self, georef: Georef, done: Path) -> None:
        before = listing(done)
        assert set(actions(georef, "run", done).values()) == {"keep"}
        assert listing(done) == before

    def test_changed_option_runs_its_stage_and_perhaps_those_after(self, georef: Georef, done: Path) -> None:
        planned = actions(georef, "run", done, "--max-residual", 2)
        assert [planned[name] for name in ("geolocate", "init-sim3", "train", "export-ply")] == [
            "keep", "run", "perhaps", "perhaps",
        ]  # fmt: skip
        assert set(actions(georef, "run", done, "--force").values()) == {"run"}

    def test_origins_of_options(self, georef: Georef, done: Path) -> None:
        (done / "georef.toml").write_text("[train]\nseed = 7\n")
        (row,) = georef("train", done, "--max-gaussians", 900, "--dry-run", "--json").document["stages"]
        assert {(option["flag"], option["origin"]) for option in row["options"]} == {
            ("--iterations", "remembered"),
            ("--seed", "georef.toml"),
            ("--max-gaussians", "command line"),
            ("--max-image-size", "preset"),
        }
        assert row["reason"] == "option max_gaussians, seed changed"

    def test_longer_training_extends_and_interrupted_one_resumes(self, georef: Georef, done: Path) -> None:
        def stop(stage: StageRun, options: object) -> Summary:
            stage.record_progress("500 of 900 iterations, 2 min")
            raise KeyboardInterrupt

        assert actions(georef, "train", done, "--iterations", 900) == {"train": "extend"}
        fakes.install(train=stop)
        assert georef("train", done, "--iterations", 900).code == 130
        assert actions(georef, "run", done)["train"] == "resume"
        assert actions(georef, "run", done, "--seed", 3)["train"] == "refuse"


class TestCostModel:
    def test_time_left_counts_shrunken_photographs(self) -> None:
        """30 iterations of 1 s and 70 of 4 s: after 20 s, 290 s are left, where equal steps would say 80 s."""
        now = 0.0
        left = TimeLeft(lambda i: 1.0 if i <= 30 else 4.0, 100, clock=lambda: now)
        left.start(0)
        assert left.after(0) is None
        now = 20.0
        assert left.after(20) == pytest.approx(290.0)
        now = 30.0 + 70 * 4.0
        assert left.after(100) == 0.0

    @pytest.mark.parametrize(
        ("gaussians", "pixels", "photographs", "seconds"),
        [(100_000, 661 * 372, 48, 0.039), (1_000_000, 1280 * 960, 48, 0.371), (1_000_000, 661 * 372, 750, 0.059)],
    )
    def test_iterations_take_the_time_of_the_benchmarks(
        self, gaussians: int, pixels: int, photographs: int, seconds: float
    ) -> None:
        """Within 20 %; over all of examples/benchmarks/results/training.md the fit deviates by up to 21 %."""
        assert iteration_seconds(pixels, gaussians, photographs, surface=False) == pytest.approx(seconds, rel=0.2)


def test_a_reconstruction_that_does_not_fit(
    georef: Georef, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.sfm.estimate.free_main_memory_bytes", lambda: 100 << 20)
    write_flight(tmp_path / "photos", 5, lat=46.0, lon=7.7)
    words = ("run", tmp_path / "ws", "--images", tmp_path / "photos")
    assert actions(georef, *words)["sfm"] == "refuse"
    assert georef(*words, "--dry-run", "--json").document["reconstruction"]["peak_bytes"] > 100 << 20
    assert "SfM of 5 photographs needs about" in " ".join(georef(*words, "--dry-run").out.split())
    assert actions(georef, *words, "--import", tmp_path / "photos")["sfm"] == "run"


def test_assumptions_and_cautions_are_told_before_anything_runs(real_georef: Georef, tmp_path: Path) -> None:
    names = write_flight(tmp_path / "photos", 5, lat=46.9, lon=7.4, alt=560.0)
    (x, y, z), *_ = parse_crs("EPSG:21781").xyz_from_lla([[46.9, 7.4, 500.0]]).tolist()
    rows = [f"{x:.3f} {y:.3f} {z:.3f} 10.5 20.5 {name} P1" for name in names[:2]]
    (tmp_path / "gcp.txt").write_text("\n".join(["EPSG:21781", *rows]) + "\n")
    words = ("run", tmp_path / "ws", "--images", tmp_path / "photos", "--gcp", tmp_path / "gcp.txt", "--dry-run")
    found = real_georef(*words, "--json").document["survey"]
    assumed = {one["code"] for one in found["assumptions"]}
    assert {"vertical-datum-assumed", "default-datum-sigma", "default-position-sigma"} <= assumed
    (caution,) = (one for one in found["cautions"] if one["code"] == "transformation-accuracy")
    assert 1.5 in numbers(caution["sentence"])  # as PROJ publishes it for CH1903
    text = " ".join(real_georef(*words).out.split())
    for one in (*found["assumptions"], *found["cautions"]):
        assert one["sentence"][:60] in text
    assert not (tmp_path / "ws").exists()


@pytest.mark.parametrize(
    "words",
    [
        ("--preset", "fast"),
        ("--iterations", 50),
        ("--set", "train.sh_degree=1"),
        ("--set", "evaluate.cross_validate=true"),
    ],
)
def test_options_of_stages_that_a_run_does_not_reach_are_named(
    real_georef: Georef, tmp_path: Path, words: tuple[object, ...]
) -> None:
    write_flight(tmp_path / "photos", 4)
    run = ("run", tmp_path / "ws", "--images", tmp_path / "photos", "--to", "init-sim3", "--dry-run", *words)
    found = real_georef(*run)
    assert found.code == 0
    assert found.warned == ("option-not-used",)


def test_an_option_of_no_stage_that_comes_later_is_refused(real_georef: Georef, tmp_path: Path) -> None:
    write_flight(tmp_path / "photos", 4)
    run = ("run", tmp_path / "ws", "--images", tmp_path / "photos", "--to", "init-sim3", "--dry-run")
    assert real_georef(*run, "--set", "trian.sh_degree=1").code == 2
    assert real_georef(*run, "--set", "train.sh_degre=1").code == 2
