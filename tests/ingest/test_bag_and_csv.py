"""The bag and the CSV of one simulated flight are the same survey; a long bag takes no more memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from pipelines.core.products import load_json
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geometry.rotations import log_so3, matrix_from_quat_xyzw
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import simulate
from pipelines.simulate.truth import Truth
from pipelines.survey.survey import Survey
from tests import bags
from tests.earth import enu_from_lla

ARM = "0.3,-0.1,-0.2"


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "survey"
    options = {"size": "64x48", "samples": "1", "targets": 0, "images": 6, "bag": "mcap"}
    simulate(SimulateOptions(**options, lever_arm=ARM, clock_offset=0.0, boresight="1,0.5,-0.7"), folder)
    return folder


def _read(survey: Survey) -> tuple[np.ndarray, np.ndarray]:
    fixes = [image.fix.position_in_geo for image in survey.images if image.fix]
    quats = [image.attitude.quat_xyzw for image in survey.images if image.attitude]
    return np.array(fixes), matrix_from_quat_xyzw(np.array(quats))


def test_bag_and_csv_are_the_same_survey(flown: Path, tmp_path: Path) -> None:
    truth = load_json(Truth, flown / "truth.json")
    # The simulator tilts the mount as its flight needs, in whole degrees.
    pitch = -round(float(np.degrees(np.arcsin(np.array(truth.navigation.cam_from_body)[2, 2]))))
    nominal = {"camera_mount": f"0,{pitch},0", "lever_arm": ARM, "boresight": "1,0.5,-0.7"}
    from_bag, track = survey_and_track(
        IngestOptions(bag=flown / "bag", boresight="1,0.5,-0.7"), tmp_path / "images"
    )
    table = IngestOptions(images=flown / "images", trajectory=flown / "trajectory.csv", **nominal)
    from_csv = survey_and_track(table, None)[0]
    assert from_bag.origin == from_csv.origin
    (a, turned_a), (b, turned_b) = _read(from_bag), _read(from_csv)
    assert len(a) == len(turned_a) == 6
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-3)
    assert np.degrees(np.linalg.norm(log_so3(turned_a @ np.swapaxes(turned_b, 1, 2)), axis=1)).max() < 0.01
    assert track is not None and len(track.position_time_s) > 100


def test_lever_arm_is_applied_to_a_millimetre(flown: Path, tmp_path: Path) -> None:
    """Against the truth: recorded minus true antenna is known, so that the camera's centre is too."""
    truth = load_json(Truth, flown / "truth.json")
    survey, _ = survey_and_track(IngestOptions(bag=flown / "bag", boresight="1,0.5,-0.7"), tmp_path / "images")
    centers = enu_from_lla(lla_from_enu(np.array(truth.centers), truth.origin), survey.origin)
    positions, rotations = _read(survey)
    missed = positions - centers - np.array(truth.fix_errors)
    # The attitude's white noise of 0.5° turns an arm of 0.37 m by 3 mm; what is left beside it is below 1 mm.
    true_turn = np.swapaxes(np.array(truth.cam_from_enu), 1, 2)
    noise = np.einsum(
        "nij,njk,k->ni",
        rotations - true_turn,
        np.array(truth.navigation.nominal_from_cam)[None].transpose(0, 2, 1),
        np.array(truth.navigation.cam_from_body) @ np.array(truth.navigation.antenna_in_body_m),
    )
    np.testing.assert_allclose(missed, -noise, rtol=0, atol=1e-3)


LIMIT_MIB = 1024


@pytest.mark.skipif(sys.platform != "linux", reason="measures memory by a line of Linux")
@pytest.mark.slow
def test_memory_does_not_grow_with_the_bag(tmp_path: Path) -> None:
    """More than 2 GiB of raw photographs; the process's own memory stays below 1 GiB."""
    flight = bags.Flight(count=360)
    big = np.random.default_rng(0).integers(0, 255, (1000, 2000, 3), dtype=np.uint8)
    _write_large(tmp_path / "bag", flight, big)
    assert sum(path.stat().st_size for path in (tmp_path / "bag").iterdir()) > 2**31
    # The process measures itself: `ru_maxrss` of a child starts at what its parent, the tests, had.
    code = """
import atexit, sys
from georef_cli.main import main
from pipelines.core.machine import peak_memory_bytes
atexit.register(lambda: open(sys.argv[1], "w").write(str(peak_memory_bytes())))
main(sys.argv[2:])
"""
    arguments = ["ingest", str(tmp_path / "ws"), "--bag", str(tmp_path / "bag"), "--every", "20s"]
    command = [sys.executable, "-c", code, str(tmp_path / "peak"), *arguments]
    subprocess.run(command, cwd=Path(__file__).parents[2], check=True)
    assert int((tmp_path / "peak").read_text("utf-8")) / 2**20 < LIMIT_MIB


def _write_large(path: Path, flight: bags.Flight, picture: np.ndarray) -> None:
    kind = "sensor_msgs/msg/Image"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {}
        for topic, name, ns, message in bags.fixes(flight):
            links.setdefault(topic, None)
            links[topic] = links[topic] or writer.add_connection(topic, name, typestore=bags.TYPES)
            writer.write(links[topic], int(ns), bags.TYPES.serialize_cdr(message, name))
        link = writer.add_connection("/camera/image_raw", kind, typestore=bags.TYPES)
        for i, ns in enumerate(flight.image_ns):
            picture[0, 0] = i % 256
            message = bags.make(
                kind, bags.header(ns, "camera_optical"), 1000, 2000, "bgr8", 0, 6000, picture.ravel()
            )
            writer.write(link, int(ns), bags.TYPES.serialize_cdr(message, kind))
