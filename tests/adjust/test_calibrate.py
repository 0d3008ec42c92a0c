"""Time offset, boresight and lever arm of flights whose rig is known, by `georef calibrate` and in `georef run`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.core.fingerprints import fingerprints
from pipelines.core.products import load_json
from pipelines.core.stages import BY_NAME, RIG, SURVEY, TRACK, stage_slice
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import write_sparse
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geometry.cameras import Camera
from pipelines.geometry.rotations import exp_so3, log_so3, matrix_from_quat_xyzw
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import simulate
from pipelines.simulate.truth import Truth
from pipelines.survey.navigation import RigCalibration, load_survey
from pipelines.survey.survey import Survey
from tests import bags
from tests.earth import enu_from_lla
from tests.refusals import numbers
from tests.scenes import Noise, TrueScene, sparse_model

pytestmark = pytest.mark.usefixtures("children_here")  # a model is taken over in each test
OFFSET_S, BORESIGHT_DEG = 0.2, np.array([0.7, -0.5, 0.4])
EXACT = Noise(pixel_px=0.05)
SIZE = (1200, 900)  # of the photographs in the bags, and of the cameras of `sparse_model`
Command = Callable[..., Any]


class Winding(bags.Flight):
    """A flight that turns and changes its speed, which the base's straight line does not."""

    def camera(self, time_ns: np.ndarray) -> np.ndarray:
        t = (time_ns - bags.START) / 1e9
        return np.stack([30 * np.sin(0.5 * t), 20 * np.sin(0.37 * t + 1), 60 + 5 * np.sin(0.8 * t)], axis=1)


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """`georef …`: its JSON document, or with `fails` what it says."""

    def call(*arguments: object, fails: bool = False) -> Any:
        code = boundary.guarded(cli, [*map(str, arguments), *([] if fails else ["--json"])])
        captured = capsys.readouterr()
        # An option that is at fault alone, without any file, is a usage error.
        assert code == (0 if not fails else 2 if captured.err.rpartition("error: ")[2].startswith("[--") else 1)
        return captured.err if fails else {**json.loads(captured.out), "err": captured.err}

    return call


def photograph(index: int) -> np.ndarray:
    """A JPEG of one grey, which no other photograph has."""
    return cv2.imencode(".jpg", np.full((SIZE[1], SIZE[0], 3), 5 * index + 10, np.uint8))[1].ravel()


def write_model(
    path: Path, names: list[str], centers: np.ndarray, geo_from_cam: np.ndarray, width: int = SIZE[0]
) -> Path:
    """What SfM would make of cameras (n, 3) and (n, 3, 3) above a landscape, in a frame of its own."""
    rng = np.random.default_rng(0)
    land = np.column_stack([rng.uniform(-150, 150, (600, 2)), rng.uniform(0, 15, 600)])
    scene = TrueScene(centers, geo_from_cam, land, np.empty((0, 3)))
    model = sparse_model(scene, EXACT, rng)
    camera = model.cameras[1]
    factor = width / camera.width
    params = np.concatenate([camera.params[:4] * factor, camera.params[4:]])
    seen = np.bincount(model.obs_point, minlength=len(land)) > 2
    keep = seen[model.obs_point]
    model = replace(
        model,
        image_name=tuple(names),
        point_id=model.point_id[seen],
        point_in_local=model.point_in_local[seen],
        point_rgb=model.point_rgb[seen],
        point_error_px=model.point_error_px[seen],
        obs_point=(np.cumsum(seen) - 1)[model.obs_point[keep]],
        obs_image=model.obs_image[keep],
        obs_xy_px=model.obs_xy_px[keep] * factor,
        cameras={1: Camera(camera.model, width, round(camera.height * factor), params)},
    )
    path.mkdir(parents=True)
    write_sparse(model, path)
    return path


def flown(path: Path, flight: bags.Flight) -> dict[str, Path]:
    """A bag whose photographs are stamped 0.2 s late of the navigation's clock, and the true cameras as SfM's."""
    messages = [one for one in bags.usual(flight) if "image" not in one[0]]
    for index, (topic, kind, ns, message) in enumerate(bags.images(flight)):
        message.header.stamp = bags.time(ns - round(OFFSET_S * 1e9))
        message.data = photograph(index)
        messages.append((topic, kind, ns, message))
    centers, nominal = bags.expected(flight, bags.ORIGIN)
    names = [f"frame_{i:06d}.jpg" for i in range(flight.count)]
    model = write_model(path / "model", names, centers, nominal @ exp_so3(np.radians(BORESIGHT_DEG)))
    return {"--bag": bags.write(path / "bag", messages), "--import": model}


@pytest.fixture(scope="module")
def winding(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Inputs of a flight that shows time offset and boresight, which nobody changes."""
    return flown(tmp_path_factory.mktemp("winding"), Winding(count=24))


def arguments(inputs: dict[str, Path]) -> list[object]:
    return [part for pair in inputs.items() for part in pair]


def states(command: Command, workspace: Path) -> dict[str, str]:
    return {row["stage"]: row["state"] for row in command("status", workspace)["stages"]}


def missed(workspace: Path, flight: bags.Flight) -> tuple[np.ndarray, np.ndarray]:
    """Errors of a survey's positions (n, 3) in metres and of its attitudes (n,) in degrees."""
    survey = load_survey(Workspace(workspace))
    truth = enu_from_lla(lla_from_enu(flight.camera(flight.image_ns), bags.ORIGIN), survey.origin)
    positions = np.array([image.fix.position_in_geo for image in survey.images if image.fix])
    quats = [image.attitude.quat_xyzw for image in survey.images if image.attitude]
    true_turns = bags.expected(flight, survey.origin)[1] @ exp_so3(np.radians(BORESIGHT_DEG))
    turned = log_so3(matrix_from_quat_xyzw(quats) @ np.swapaxes(true_turns, 1, 2))
    return positions - truth, np.degrees(np.linalg.norm(turned, axis=1))


def test_run_estimates_after_sfm_and_goes_on(tmp_path: Path, command: Command, winding: dict[str, Path]) -> None:
    flight, workspace = Winding(count=24), tmp_path / "ws"
    asked = [*arguments(winding), "--time-offset", "auto", "--estimate", "boresight"]
    document = command("run", workspace, *asked, "--to", "init-sim3")
    stages = {row["stage"]: row for row in document["stages"]}
    assert list(stages) == [spec.name for spec in stage_slice(None, "init-sim3")]
    assert all(row["ran"] for row in stages.values())
    assert "calibrate: time-offset 0.2" in document["err"]
    assert stages["calibrate"]["values"]["applied"] == ["time-offset", "boresight"]
    estimates = {row["name"]: row for row in stages["calibrate"]["values"]["estimates"]}
    assert estimates["time-offset"]["value"][0] == pytest.approx(OFFSET_S, abs=0.02)
    np.testing.assert_allclose(estimates["boresight"]["value"], BORESIGHT_DEG, atol=0.1)
    position, turned = missed(workspace, flight)
    # 20 ms at 15 m/s, were it all of the offset's error; positions at the start were 3 m off.
    assert np.abs(position).max() < 0.1
    assert turned.max() < 0.15
    assert stages["geolocate"]["values"]["rotation_source"] == "recorded"
    # The adjustment goes on from there: of the boresight of 0.95° next to nothing is left, and it observes that.
    (left,) = (row for row in stages["init-sim3"]["values"]["estimated_errors"] if row["name"] == "boresight")
    assert np.abs(left["value"]).max() < 0.1 and left["observed"] == [True] * 3
    assert numbers(stages["init-sim3"]["key_figure"])[-6::2] == pytest.approx(left["value"], abs=6e-4)
    # The survey stays as recorded: positions were 3 m off.
    recorded, applied = load_json(Survey, workspace / SURVEY), load_survey(Workspace(workspace))
    shift_m = [
        float(np.linalg.norm(np.subtract(before.fix.position_in_geo, after.fix.position_in_geo)))
        for before, after in zip(recorded.images, applied.images, strict=True)
        if before.fix and after.fix
    ]
    assert max(shift_m) > 1.0
    # What was estimated stays; nothing is done twice.
    again = command("run", workspace, *asked, "--to", "init-sim3")
    assert not any(row["ran"] for row in again["stages"])
    assert (workspace / "logs/calibrate.log").exists()


@pytest.mark.slow
def test_ingest_made_again_keeps_sfm_and_is_calibrated_again(
    tmp_path: Path, command: Command, winding: dict[str, Path]
) -> None:
    workspace = tmp_path / "ws"
    command("run", workspace, *arguments(winding), "--time-offset", "auto", "--to", "geolocate")
    before, rig = load_survey(Workspace(workspace)), load_json(RigCalibration, workspace / RIG)
    document = command("run", workspace, "--sigma-h", 0.5, "--test-every", 5, "--to", "geolocate")
    made = {row["stage"]: row["ran"] for row in document["stages"]}
    assert made["ingest"] and not made["sfm"] and made["calibrate"] and made["geolocate"]
    after = load_survey(Workspace(workspace))
    assert load_json(RigCalibration, workspace / RIG) == rig
    places = [[image.fix.position_in_geo for image in one.images if image.fix] for one in (before, after)]
    assert places[0] == places[1]
    # Another model is another estimate.
    (tmp_path / "other").mkdir()
    other = flown(tmp_path / "other", Winding(count=20))["--import"]
    document = command("run", workspace, "--import", other, "--to", "geolocate")
    made = {row["stage"]: row["ran"] for row in document["stages"]}
    assert not made["ingest"] and made["sfm"] and made["calibrate"] and made["geolocate"]


def test_flight_that_shows_nothing_is_told_and_no_failure(tmp_path: Path, command: Command) -> None:
    flight, workspace = bags.Flight(count=24), tmp_path / "ws"  # a straight line at constant speed
    inputs = flown(tmp_path, flight)
    document = command("run", workspace, *arguments(inputs), "--time-offset", "auto", "--to", "geolocate")
    rig = load_json(RigCalibration, workspace / RIG)
    assert rig.problem in document["err"] and "time-offset" in document["err"]
    assert rig.wanted == ("time-offset",) and rig.estimates == ()
    assert load_survey(Workspace(workspace)) == load_json(Survey, workspace / SURVEY)
    again = command("run", workspace, "--to", "geolocate")
    assert not any(row["ran"] for row in again["stages"])


def test_calibrate_and_apply(
    tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str], winding: dict[str, Path]
) -> None:
    flight, workspace = Winding(count=24), tmp_path / "ws"
    document = command("run", workspace, *arguments(winding), "--to", "geolocate")
    figures = {row["stage"]: row["key_figure"] for row in document["stages"]}
    assert figures["calibrate"] == "nothing to estimate"
    before = load_json(Survey, workspace / SURVEY)
    command("run", workspace, "--time-offset", "auto", "--estimate", "boresight,lever-arm", "--to", "sfm")
    asked = load_json(Survey, workspace / SURVEY)
    assert (asked.images, asked.estimate) == (before.images, ("time-offset", "boresight", "lever-arm"))
    values = command("calibrate", workspace, "--no-apply")["values"]
    assert [row["name"] for row in values["estimates"]] == ["time-offset", "boresight", "lever-arm"]
    assert values["applied"] == []
    assert load_survey(Workspace(workspace)) == asked
    command("run", workspace, "--estimate", "boresight", "--to", "calibrate")
    values = command("calibrate", workspace, "--apply")["values"]
    assert values["applied"] == ["time-offset", "boresight"]
    position, turned = missed(workspace, flight)
    assert np.abs(position).max() < 0.1 and turned.max() < 0.15
    now = states(command, workspace)
    assert now["ingest"] == now["sfm"] == now["calibrate"] == "current" and now["geolocate"] == "stale"
    rows = {row["stage"]: row["ran"] for row in command("run", workspace, "--to", "geolocate")["stages"]}
    assert [stage for stage, ran in rows.items() if ran] == ["geolocate"]
    command("run", workspace, "--estimate", "lever-arm", "--to", "sfm")
    assert boundary.guarded(cli, ["calibrate", str(workspace)]) == 0
    table = capsys.readouterr().out
    assert "lever-arm forward" in table and "control points" in table
    # A workspace without navigation by time
    (workspace / "ingest/track.npz").unlink()
    message = command("calibrate", workspace, fails=True)
    assert "track.npz" in message and "--trajectory" in message


@pytest.mark.slow
def test_what_ingest_asked_for_can_be_left_unapplied(
    tmp_path: Path, command: Command, winding: dict[str, Path]
) -> None:
    workspace = tmp_path / "ws"
    command("run", workspace, *arguments(winding), "--time-offset", "auto", "--to", "calibrate")
    values = command("calibrate", workspace, "--no-apply")["values"]
    assert [row["name"] for row in values["estimates"]] == ["time-offset"] and values["applied"] == []
    assert load_survey(Workspace(workspace)) == load_json(Survey, workspace / SURVEY)


@pytest.mark.slow
def test_a_comparison_reads_the_calibration_where_it_is(
    tmp_path: Path, command: Command, winding: dict[str, Path]
) -> None:
    """Configurations share the stages up to geolocate, and are stale with what these apply."""
    workspace = tmp_path / "ws"
    command("run", workspace, *arguments(winding), "--time-offset", "auto", "--to", "geolocate")
    root = Workspace(workspace)
    lent = {spec.folder: workspace / spec.folder for spec in stage_slice(None, "geolocate")}
    variant = Workspace(workspace / "compare/A", root, lent, "compare")
    spec = BY_NAME["geolocate"]
    before = fingerprints(variant, spec, spec.options(), {}).hashes
    assert before == fingerprints(root, spec, spec.options(), {}).hashes
    assert load_survey(variant) == load_survey(root)
    command("calibrate", workspace, "--no-apply")
    after = fingerprints(variant, spec, spec.options(), {}).hashes
    assert set(before) - set(after) == {RIG, TRACK}


def test_stages_one_by_one_are_reminded(tmp_path: Path, command: Command) -> None:
    inputs, workspace = flown(tmp_path, Winding(count=8)), tmp_path / "ws"
    command("ingest", workspace, "--bag", inputs["--bag"], "--time-offset", "auto")
    command("sfm", workspace, "--import", inputs["--import"])
    message = command("geolocate", workspace)["err"]
    assert "time-offset" in message and "`georef calibrate`" in message


def test_what_cannot_be_estimated_is_said_before_sfm(tmp_path: Path, command: Command) -> None:
    flight = Winding(count=6)
    path = bags.write(tmp_path / "bag", [*bags.fixes(flight), *bags.images(flight)])

    def refused(*more: object) -> str:
        return command("ingest", tmp_path / "ws", "--bag", path, *more, fails=True)

    assert "[--estimate]: boresight needs recorded attitudes" in refused("--estimate", "lever-arm,boresight")
    assert "[--estimate]: 'focus' is none of boresight" in refused("--estimate", "focus")
    # The turns of the SfM cameras show a lever arm without attitudes.
    command("ingest", tmp_path / "ws", "--bag", path, "--estimate", "lever-arm")
    assert load_json(Survey, tmp_path / "ws" / SURVEY).estimate == ("lever-arm",)
    empty = bags.write(tmp_path / "empty", bags.images(flight))
    message = command("ingest", tmp_path / "ws", "--bag", empty, "--time-offset", "auto", fails=True)
    assert "No image has a position" in message and "--gcp" in message


@pytest.mark.slow
def test_offset_of_a_trajectory_by_time(tmp_path: Path, command: Command) -> None:
    """The receiver's log of a simulated flight, 0.2 s ahead of the camera's clock, with true cameras as SfM's."""
    options = {"size": "64x48", "samples": "1", "targets": 0, "images": 24, "flight": "grid"}
    simulate(SimulateOptions(**options, clock_offset=OFFSET_S), tmp_path / "survey")
    truth = load_json(Truth, tmp_path / "survey/truth.json")
    turns = np.swapaxes(np.array(truth.cam_from_enu), 1, 2)
    model = write_model(tmp_path / "model", list(truth.images), np.array(truth.centers), turns, width=64)
    files = tmp_path / "survey"
    table = ["--images", files / "images", "--trajectory", files / "gnss.csv", "--import", model]
    document = command("run", tmp_path / "ws", *table, "--time-offset", "auto", "--to", "geolocate")
    (estimate,) = next(row for row in document["stages"] if row["stage"] == "calibrate")["values"]["estimates"]
    assert estimate["value"][0] == pytest.approx(OFFSET_S, abs=0.02)
    assert estimate["observable"] == [True]
    survey = load_survey(Workspace(tmp_path / "ws"))
    places = enu_from_lla(lla_from_enu(np.array(truth.centers), truth.origin), survey.origin)
    errors = np.array([image.fix.position_in_geo for image in survey.images if image.fix]) - places
    # White noise of σ 0.02 and 0.03 m, and 10 ms at some 5 m/s.
    assert np.sqrt((errors**2).mean()) < 0.06
    assert all(image.attitude for image in survey.images)  # the gimbal's, from XMP
    by_name = [*table[:2], "--trajectory", files / "trajectory.csv"]
    message = command("ingest", tmp_path / "new", *by_name, "--time-offset", "auto", fails=True)
    assert "[--time-offset]" in message and "--trajectory" in message
