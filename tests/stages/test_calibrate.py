"""`georef calibrate` on a workspace whose rig is known: bag, SfM cameras, estimate, and the survey made again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.config import CalibrateConfig
from pipelines.formats.colmap import SparseModel, write_sparse
from pipelines.geodesy.enu import enu_from_lla, lla_from_enu
from pipelines.geometry.cameras import Camera
from pipelines.geometry.rig import boresight
from pipelines.geometry.similarity import Similarity
from pipelines.products import Survey, load_json
from pipelines.workspace import Workspace
from tests import bags

OFFSET_S, BORESIGHT_DEG = 0.2, np.array([0.7, -0.5, 0.4])
GEO_FROM_LOCAL = Similarity(3.0, np.eye(3), np.array([1.0, 2.0, 3.0]))


class Winding(bags.Flight):
    """A flight that turns and changes its speed, which the base's straight line does not."""

    def camera(self, time_ns: np.ndarray) -> np.ndarray:
        t = (time_ns - bags.START) / 1e9
        return np.stack([30 * np.sin(0.5 * t), 20 * np.sin(0.37 * t + 1), 60 + 5 * np.sin(0.8 * t)], axis=1)


@pytest.fixture
def workspace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Workspace:
    """A bag whose photographs are stamped 0.2 s late of the navigation's clock, and the true cameras as SfM's."""
    flight = Winding(count=24)
    messages = [one for one in bags.usual(flight) if "image" not in one[0]]
    for topic, kind, ns, message in bags.images(flight):
        message.header.stamp = bags.time(ns - round(OFFSET_S * 1e9))
        messages.append((topic, kind, ns, message))
    made = Workspace(tmp_path / "ws")
    path = bags.write(tmp_path / "bag", messages)
    assert boundary.guarded(cli, ["ingest", str(made.root), "--bag", str(path), "--time-offset", "auto"]) == 0
    assert "georef calibrate" in capsys.readouterr().err
    survey = load_json(Survey, made.path("ingest/survey.json"))
    _write_model(flight, survey, made.root / "sfm/sparse")
    return made


def _write_model(flight: bags.Flight, survey: Survey, path: Path) -> None:
    centers, nominal = bags.expected(flight, survey.origin)
    rotation = np.swapaxes(nominal @ boresight(BORESIGHT_DEG), 1, 2)
    local = GEO_FROM_LOCAL.inverse().apply(centers)
    count = flight.count
    camera = Camera("PINHOLE", 64, 48, np.array([50.0, 51.0, 32.0, 24.0]))
    write_sparse(
        SparseModel(
            cameras={1: camera},
            image_id=np.arange(1, count + 1),
            image_name=tuple(image.name for image in survey.images),
            image_camera_id=np.ones(count, np.int64),
            rotation_cam_from_local=rotation,
            translation_cam_from_local=-np.einsum("nij,nj->ni", rotation, local),
            point_id=np.arange(1, 3),
            point_in_local=np.outer([0.0, 1.0], np.ones(3)),
            point_rgb=np.zeros((2, 3), np.uint8),
            point_error_px=np.zeros(2),
            obs_point=np.array([0, 0, 1, 1]),
            obs_image=np.array([0, 1, 0, 1]),
            obs_xy_px=np.full((4, 2), 10.0),
        ),
        path,
    )


def test_estimate_and_apply(workspace: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["calibrate", str(workspace.root), "--apply", "--json"]
    assert boundary.guarded(cli, arguments) == 0
    document = json.loads(capsys.readouterr().out)
    rows = {row["name"]: row for row in document["estimates"]}
    assert rows["time-offset"]["value"][0] == pytest.approx(OFFSET_S, abs=0.02)
    np.testing.assert_allclose(rows["boresight"]["value"], BORESIGHT_DEG, atol=0.1)
    assert all(all(row["observable"]) for row in rows.values())
    assert document["applied"]["ran"]
    # The survey made again has the cameras where they were, and turned as they were.
    survey = load_json(Survey, workspace.path("ingest/survey.json"))
    flight = Winding(count=24)
    truth = enu_from_lla(lla_from_enu(flight.camera(flight.image_ns), bags.ORIGIN), survey.origin)
    found = np.array([image.fix.position_in_geo for image in survey.images if image.fix])
    np.testing.assert_allclose(found, truth, atol=0.1)
    # Estimated afresh, nothing is left to correct.
    assert boundary.guarded(cli, ["calibrate", str(workspace.root)]) == 0
    table = capsys.readouterr().out
    assert "time-offset" in table and "not observable" not in table


def test_what_cannot_be_estimated_is_said(workspace: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    assert boundary.guarded(cli, ["calibrate", str(workspace.root), "--estimate", "focus"]) == 1
    assert "'focus' is none of time-offset" in capsys.readouterr().err
    (workspace.root / "ingest/track.npz").unlink()
    assert boundary.guarded(cli, ["calibrate", str(workspace.root)]) == 1
    assert "only a position for each image" in capsys.readouterr().err


def test_wanted_is_checked() -> None:
    assert CalibrateConfig(estimate="lever-arm,time-offset").wanted == ("time-offset", "lever-arm")
    with pytest.raises(ValueError, match="none of"):
        CalibrateConfig(estimate="")
