"""`ingest` on the sample surveys in the folder that GEOREF_DATA names."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.core.types import FloatArray
from pipelines.geodesy import enu
from pipelines.geodesy.enu import Origin
from pipelines.geometry.rotations import log_so3, matrix_from_quat_xyzw
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import Survey
from tests.refusals import said

DATA = Path(os.environ.get("GEOREF_DATA", "no-samples"))
ORBIT, BEACH = DATA / "orbit_dev", DATA / "brighton_beach"
needs_orbit = pytest.mark.skipif(not ORBIT.is_dir(), reason="the sample survey orbit_dev is not here")
needs_beach = pytest.mark.skipif(not BEACH.is_dir(), reason="the sample survey brighton_beach is not here")


def _orbit(trajectory: str) -> tuple[Survey, FloatArray, FloatArray]:
    """The survey, its positions in the truth's frame, and the true ones."""
    options = IngestOptions(
        images=ORBIT / "images",
        trajectory=ORBIT / trajectory,
        gcp=ORBIT / "gcp_list.txt",
        checkpoints=ORBIT / "checkpoints.txt",
    )
    survey = survey_and_track(options, None)[0]
    document = json.loads((ORBIT / "truth.json").read_text())
    origin = Origin(lat_deg=document["lat"], lon_deg=document["lon"], alt_m=document["alt"])
    in_geo = np.array([image.fix.position_in_geo for image in survey.images if image.fix is not None])
    positions = enu.enu_from_ecef(enu.ecef_from_enu(in_geo, survey.origin), origin)
    return survey, positions, np.array(document["centers"])


@needs_orbit
@pytest.mark.parametrize(
    ("trajectory", "sigma_m"),
    [("trajectory_rtk.csv", (0.02, 0.02, 0.03)), ("trajectory_consumer.csv", (1.5, 1.5, 3.0))],
)
def test_orbit_positions_err_by_the_receivers_sigma(trajectory: str, sigma_m: tuple[float, float, float]) -> None:
    survey, positions, truth = _orbit(trajectory)
    assert (len(survey.images), len(survey.control_points), len(survey.check_points)) == (48, 8, 47)
    assert len(survey.names("test")) == 6
    whitened = (positions - truth) / sigma_m
    # 144 standard normal deviates: their mean square is 1 ± 0.12.
    assert 0.6 < np.mean(whitened**2) < 1.5
    assert np.abs(whitened).max() < 5.0


@needs_orbit
def test_orbit_attitudes_err_by_half_a_degree() -> None:
    survey, _, _ = _orbit("trajectory_rtk.csv")
    document = json.loads((ORBIT / "truth.json").read_text())
    cam_from_enu = np.array(document["cam_from_enu"], dtype=np.float64)
    measured = matrix_from_quat_xyzw(
        [image.attitude.quat_xyzw for image in survey.images if image.attitude is not None]
    )
    error_deg = np.degrees(log_so3(measured @ cam_from_enu))
    # 0.5° of noise on each angle; yaw counts less about a camera that looks 35° down.
    assert 0.25 < np.sqrt(np.mean(error_deg**2)) < 0.75


@needs_orbit
def test_orbit_bag_says_what_it_lacks_and_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It was recorded without /tf: nobody but the user knows how the camera sits in the body."""
    assert boundary.guarded(cli, ["inspect", str(ORBIT / "bag")]) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert "/tf does not link camera 'camera_optical' and body 'base_link': give --camera-mount" in output
    bare, _ = survey_and_track(IngestOptions(bag=ORBIT / "bag"), tmp_path / "bare")
    assert not any(image.attitude for image in bare.images)
    assert "--camera-mount" in said(bare.warnings, "camera-mount-unknown")
    mounted = IngestOptions(bag=ORBIT / "bag", camera_mount="0,0,0", lever_arm="0,0,0")  # its body is the gimbal
    survey, _ = survey_and_track(mounted, tmp_path / "mounted")
    assert survey.warnings == ()
    document = json.loads((ORBIT / "truth.json").read_text())
    measured = matrix_from_quat_xyzw([image.attitude.quat_xyzw for image in survey.images if image.attitude])
    error_deg = np.degrees(log_so3(measured @ np.array(document["cam_from_enu"], dtype=np.float64)))
    assert 0.25 < np.sqrt(np.mean(error_deg**2)) < 0.75  # 0.5° of noise on each axis
    origin = Origin(lat_deg=document["lat"], lon_deg=document["lon"], alt_m=document["alt"])
    in_geo = np.array([image.fix.position_in_geo for image in survey.images if image.fix is not None])
    positions = enu.enu_from_ecef(enu.ecef_from_enu(in_geo, survey.origin), origin)
    assert np.abs(positions - document["centers"]).max() < 5 * 0.03


@needs_beach
def test_brighton_beach() -> None:
    survey = survey_and_track(IngestOptions(images=BEACH / "images"), None)[0]
    assert len(survey.images) == 18 and len(survey.cameras) == 1
    assert all(image.fix is not None and image.attitude is not None for image in survey.images)
    assert survey.cameras[0].make_model == "DJI FC300S"
    assert survey.cameras[0].params[0] == pytest.approx(3.61 / 6.17 * 2000)
    assert not survey.warnings
    up = np.array([image.fix.position_in_geo[2] for image in survey.images if image.fix is not None])
    assert np.abs(up).max() < 5.0  # one flying height
    for image in survey.images:
        assert image.attitude is not None
        looks = matrix_from_quat_xyzw(image.attitude.quat_xyzw) @ [0.0, 0.0, 1.0]
        assert looks[2] < -0.99
