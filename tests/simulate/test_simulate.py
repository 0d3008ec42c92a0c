"""A simulated survey agrees with its own truth, through the public function and the files alone."""

from __future__ import annotations

import csv
import filecmp
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.ExifTags import GPS, IFD
from rosbags.highlevel import AnyReader

from pipelines.core.errors import InputError
from pipelines.core.options import resolve
from pipelines.core.products import dump_json, load_json
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geometry.rotations import geo_from_cam, log_so3
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.simulate.lens import Renderer, Sensor
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.recording import write_trajectory
from pipelines.simulate.stage import SimulationSummary, fly_survey, simulate
from pipelines.simulate.truth import Truth
from pipelines.simulate.world import make_world
from tests.earth import enu_from_lla
from tests.refusals import numbers, refused

ORIGIN = "-33.86,151.21,-20"  # south, east, below the ellipsoid
SMALL: dict[str, Any] = {"size": "160x120", "samples": "1", "images": 4, "targets": 30}


class SimulatedSurvey:
    """Simulated survey, read from its files."""

    def __init__(self, folder: Path, **options: Any) -> None:
        self.options = SimulateOptions(**{**SMALL, **options})
        self.folder = folder
        self.summary: SimulationSummary = simulate(self.options, folder)
        self.truth = load_json(Truth, folder / "truth.json")
        self.centers = np.array(self.truth.centers)
        self.cam_from_enu = np.array(self.truth.cam_from_enu)
        self.camera = pycolmap.Camera(
            model=self.truth.lens.model, width=self.truth.lens.width, height=self.truth.lens.height,
            params=self.truth.lens.params,
        )  # fmt: skip

    def table(self, name: str) -> list[dict[str, str]]:
        with (self.folder / name).open(encoding="utf-8", newline="") as handle:
            return list(csv.DictReader(handle))

    def points(self, name: str) -> list[list[str]]:
        return [line.split() for line in (self.folder / name).read_text("utf-8").splitlines()[1:]]

    def image(self, i: int) -> np.ndarray:
        picture = cv2.imread(str(self.folder / "images" / self.truth.images[i]), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        return picture

    def recorded_positions(self) -> np.ndarray:
        rows = self.table("trajectory.csv")
        return np.array([[float(row[key]) for key in ("latitude", "longitude", "altitude")] for row in rows])

    def project(self, i: int, points: np.ndarray) -> np.ndarray:
        in_cam = (points - self.centers[i]) @ self.cam_from_enu[i].T
        return np.array([self.camera.img_from_cam(point) for point in in_cam])


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """Return a survey of eight photographs with every file that can be written."""
    return SimulatedSurvey(
        tmp_path_factory.mktemp("simulated") / "survey", images=8, origin=ORIGIN, bag="mcap", depth=True,
        gnss="outliers", lever_arm="0.1,-0.2,-0.3", sigma_mark=0.3, lidar=True, lidar_density=1, lidar_radius=40,
    )  # fmt: skip


def test_marks_are_the_projections_of_the_targets(survey: SimulatedSurvey) -> None:
    exact, written = [], []
    for target in survey.truth.targets:
        for mark in target.marks:
            i = survey.truth.images.index(mark.image)
            (pixel,) = survey.project(i, np.array([target.position_in_geo]))
            exact.append(pixel - [mark.x_px, mark.y_px])
            written.append([mark.written_x_px - mark.x_px, mark.written_y_px - mark.y_px])
    assert np.abs(exact).max() < 1e-8
    # σ 0.3 px; its estimate from n numbers scatters by 0.3/√(2n).
    assert abs(np.std(written) - 0.3) < 5 * 0.3 / np.sqrt(2 * np.size(written))


def test_point_files_hold_the_targets(survey: SimulatedSurvey) -> None:
    for name, role in (("gcp_list.txt", "control"), ("checkpoints.txt", "check")):
        assert (survey.folder / name).read_text("utf-8").splitlines()[0] == "EPSG:4979"
        rows = survey.points(name)
        expected = [
            (target.name, mark.image, mark.written_x_px, mark.written_y_px)
            for target in survey.truth.targets if target.role == role for mark in target.marks
        ]  # fmt: skip
        assert [(row[6], row[5], float(row[3]), float(row[4])) for row in rows] == expected
        places = {target.name: target.position_in_geo for target in survey.truth.targets}
        lla = np.array([[float(row[1]), float(row[0]), float(row[2])] for row in rows])
        positions = enu_from_lla(lla, survey.truth.origin)
        # Ten decimals of a degree and five of a metre: below 0.02 mm.
        np.testing.assert_allclose(positions, [places[row[6]] for row in rows], atol=2e-5)


@pytest.mark.slow
def test_targets_are_in_the_photographs(tmp_path: Path) -> None:
    """Boards in the photographs lie at their marks: two white quarters across from each other."""
    survey = SimulatedSurvey(tmp_path / "survey", size="320x240", samples="1", images=3, target_size=4.0, noise=0.0)
    east, north, _ = fly_survey(survey.options).world.scene.axes
    contrasts = []
    for target in survey.truth.targets:
        if target.surface == "wall":  # those boards stand; the others lie, along the axes of the town
            continue
        quarters = np.array(target.position_in_geo) + np.array(
            [east + north, -east - north, east - north, north - east]
        )
        for mark in target.marks:
            i = survey.truth.images.index(mark.image)
            pixels = survey.project(i, quarters).astype(np.float32) - np.float32(0.5)
            grey = cv2.remap(survey.image(i), pixels[:, :1], pixels[:, 1:], cv2.INTER_LINEAR).ravel().astype(float)
            contrasts.append(grey[:2].min() - grey[2:].max())
    assert len(contrasts) > 10
    assert np.median(contrasts) > 40


def test_trajectory_is_truth_and_errors(survey: SimulatedSurvey) -> None:
    positions = enu_from_lla(survey.recorded_positions(), survey.truth.origin)
    rows = survey.table("trajectory.csv")
    assert list(rows[0]) == [
        "image", "timestamp", "latitude", "longitude", "altitude", "yaw", "pitch", "roll",
        "sigma_e", "sigma_n", "sigma_u",
    ]  # fmt: skip
    navigation = survey.truth.navigation
    body_from_cam = np.array(navigation.cam_from_body).T
    geo_from_body = np.swapaxes(survey.cam_from_enu, 1, 2) @ body_from_cam.T
    antenna = survey.centers + geo_from_body @ np.array(navigation.antenna_in_body_m)
    np.testing.assert_allclose(positions - survey.truth.fix_errors, antenna, atol=2e-4)
    size = np.linalg.norm(survey.truth.fix_errors, axis=1)
    wrong = [name in navigation.wrong_images for name in survey.truth.images]
    assert sum(wrong) == round(0.15 * 8)
    assert (size[wrong] > 9).all()
    assert (size[~np.array(wrong)] < 6 * 0.08).all()
    angles = np.array([[float(row[key]) for key in ("yaw", "pitch", "roll")] for row in rows])
    error = log_so3(survey.cam_from_enu @ geo_from_cam(angles))
    assert np.degrees(np.abs(error)).max() < 5 * 0.5


def test_photographs_carry_the_same_position(survey: SimulatedSurvey) -> None:
    recorded = survey.recorded_positions()
    for name, (lat, lon, alt) in zip(survey.truth.images, recorded, strict=True):
        data = (survey.folder / "images" / name).read_bytes()
        tags = Image.open(io.BytesIO(data)).getexif().get_ifd(IFD.GPSInfo)
        degrees = []
        for key, sign in (("Latitude", "S"), ("Longitude", "W")):
            whole, minutes, seconds = (float(part) for part in tags[GPS[f"GPS{key}"]])
            negative = tags[GPS[f"GPS{key}Ref"]] == sign
            degrees.append((whole + minutes / 60 + seconds / 3600) * (-1 if negative else 1))
        np.testing.assert_allclose(degrees, [lat, lon], atol=1e-9)
        assert f'GpsLatitude="{lat:.9f}"'.encode() in data
        assert f'GpsLongitude="{lon:.9f}"'.encode() in data
        height = float(tags[GPS.GPSAltitude]) * (-1 if tags[GPS.GPSAltitudeRef] == b"\x01" else 1)
        assert height == pytest.approx(alt, abs=2e-4)


def test_bag_says_the_same_as_the_tables(survey: SimulatedSurvey) -> None:
    fixes, images, count = {}, {}, 0
    with AnyReader([survey.folder / "bag"]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            count += 1
            if connection.topic.endswith(("fix", "compressed")):
                stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
                if connection.topic.endswith("fix"):
                    fixes[stamp] = (message.latitude, message.longitude, message.altitude)
                else:
                    images[stamp] = bytes(message.data)
    assert count == survey.summary.bag_messages
    assert list(images) == list(survey.truth.stamp_ns)
    for stamp, name, recorded in zip(
        survey.truth.stamp_ns, survey.truth.images, survey.recorded_positions(), strict=True
    ):
        assert images[stamp] == (survey.folder / "images" / name).read_bytes()
        # Both clocks agree and photographs fall on whole fixes: no interpolation comes between. 9 decimals: 0.1 mm.
        np.testing.assert_allclose(fixes[stamp][:2], recorded[:2], atol=1e-9)
        assert fixes[stamp][2] == pytest.approx(recorded[2], abs=1e-4)
    rows = survey.table("gnss.csv")
    assert len(rows) == len(fixes)
    assert [round(float(row["timestamp"]) * 10) for row in rows] == [stamp // 100_000_000 for stamp in fixes]


def test_marks_fit_the_photographs_and_the_bag(survey: SimulatedSurvey, tmp_path: Path) -> None:
    """One gcp_list.txt serves both: the photographs are named as a bag's frames."""
    points = {"gcp": survey.folder / "gcp_list.txt", "checkpoints": survey.folder / "checkpoints.txt"}
    from_bag, _ = survey_and_track(IngestOptions(bag=survey.folder / "bag", **points), tmp_path / "frames")
    from_folder = survey_and_track(IngestOptions(images=survey.folder / "images", **points), None)[0]
    assert [image.name for image in from_bag.images] == [image.name for image in from_folder.images]
    marks = [
        {point.name: point.marks for point in (*ingested.control_points, *ingested.check_points)}
        for ingested in (from_bag, from_folder)
    ]
    assert marks[0] == marks[1]
    assert len(marks[0]) == sum(len(target.marks) > 1 for target in survey.truth.targets) > 5


def test_depth_lies_on_the_surface(survey: SimulatedSurvey) -> None:
    """Targets seen in a photograph have the depth of its depth map, and two maps agree on the ground."""
    gaps = []
    for target in survey.truth.targets:
        for mark in target.marks:
            i = survey.truth.images.index(mark.image)
            depth = np.load(survey.folder / "depth" / f"{Path(mark.image).stem}.npy", allow_pickle=False)
            assert depth.dtype == np.float32
            row, column = int(mark.y_px), int(mark.x_px)
            ray = ray_of(survey, column + 0.5, row + 0.5)
            point = survey.centers[i] + survey.cam_from_enu[i].T @ (ray * float(depth[row, column]))
            gaps.append(np.linalg.norm(point - np.array(target.position_in_geo)))
    # A pixel is about 0.8 m wide here, and slanted surfaces stretch it; a wrong surface would be many metres off.
    assert np.median(gaps) < 0.7
    assert np.mean(np.array(gaps) > 4) < 0.05


def ray_of(survey: SimulatedSurvey, x: float, y: float) -> np.ndarray:
    xy = survey.camera.cam_from_img(np.array([x, y]))
    assert xy is not None
    return np.array([xy[0], xy[1], 1.0])


@pytest.mark.slow
def test_same_seed_same_bytes_other_seed_other_survey(tmp_path: Path) -> None:
    options: dict[str, Any] = {"images": 3, "bag": "mcap", "depth": True, "flight": "grid"}
    SimulatedSurvey(tmp_path / "a", **options)
    SimulatedSurvey(tmp_path / "b", **options, threads=1)
    names = sorted(str(path.relative_to(tmp_path / "a")) for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(names) == 3 + 3 + 2 + 6
    same, different, missing = filecmp.cmpfiles(tmp_path / "a", tmp_path / "b", names, shallow=False)
    assert (sorted(same), different, missing) == (names, [], [])
    SimulatedSurvey(tmp_path / "c", **options, seed=1)
    names = [name for name in names if not name.endswith((".txt", ".yaml"))]
    same, _, _ = filecmp.cmpfiles(tmp_path / "a", tmp_path / "c", names, shallow=False)
    assert same == []


def test_flight_without_photographs_is_that_of_the_survey(survey: SimulatedSurvey, tmp_path: Path) -> None:
    write_trajectory(tmp_path / "trajectory.csv", fly_survey(survey.options).recording.photos)
    assert (tmp_path / "trajectory.csv").read_bytes() == (survey.folder / "trajectory.csv").read_bytes()


def test_receivers_record_the_same_flight(survey: SimulatedSurvey) -> None:
    other = fly_survey(survey.options.model_copy(update={"gnss": "consumer"})).recording
    assert other.truth.centers == survey.truth.centers
    assert other.truth.targets == survey.truth.targets
    assert other.truth.fix_errors != survey.truth.fix_errors


@pytest.mark.slow
def test_neighbours_match_by_sift() -> None:
    """Photographs are rich enough for SfM: neighbours match, and the matches obey the true geometry."""
    world = make_world(SimulateOptions(size="480x360", images=30, targets=0), np.random.SeedSequence(0))
    renderer = Renderer(world.scene, world.lens, 4)
    poses, gains = world.poses[4:6], (1.0, 1.15)
    sift = cv2.SIFT_create(3000)
    features = []
    for pose, gain in zip(poses, gains, strict=True):
        rgb = renderer.photograph(pose, Sensor(gain, (1.0, 1.0, 1.0), 1.0), np.random.default_rng(int(100 * gain)))
        keys, descriptors = sift.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        features.append((np.array([key.pt for key in keys]) + 0.5, descriptors))
    nearest = cv2.BFMatcher().knnMatch(features[0][1], features[1][1], k=2)
    good = np.array([(m.queryIdx, m.trainIdx) for m, n in nearest if m.distance < 0.8 * n.distance])
    rays = [
        world.lens.directions(keys[good[:, k]]) @ pose.geo_from_cam.T
        for k, ((keys, _), pose) in enumerate(zip(features, poses, strict=True))
    ]
    baseline = poses[1].center - poses[0].center
    normals = np.cross(baseline, rays[0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    off_plane = np.einsum("ni,ni->n", rays[1], normals) / np.linalg.norm(rays[1], axis=1)
    inliers = np.abs(off_plane) * world.lens.focal_px < 1.5
    assert len(features[0][0]) > 1000
    assert inliers.sum() > 200
    assert inliers.mean() > 0.6


@pytest.mark.parametrize("origin", ["89.99,10,5", "-90,0,2800", "0,180,0", "12.5,-179.9999,-400"])
def test_anywhere_on_earth(tmp_path: Path, origin: str) -> None:
    survey = SimulatedSurvey(
        tmp_path / "survey", origin=origin, images=3, targets=0, sigma_attitude=0.0, gnss="rtk"
    )
    lat, lon, alt = (float(part) for part in origin.split(","))
    positions = enu_from_lla(survey.recorded_positions(), Origin(lat_deg=lat, lon_deg=lon, alt_m=alt))
    np.testing.assert_allclose(positions, survey.centers, atol=0.15)
    # Yaw is against the north of the place, which differs from the origin's near a pole.
    rows = survey.table("trajectory.csv")
    for row, rotation, place in zip(rows, survey.cam_from_enu, positions, strict=True):
        angles = [float(row[key]) for key in ("yaw", "pitch", "roll")]
        look = geo_from_cam(angles)[:, 2]
        ahead = lla_from_enu(place + 5 * rotation[2], survey.truth.origin)
        place_origin = Origin(
            **dict(zip(("lat_deg", "lon_deg", "alt_m"), lla_from_enu(place, survey.truth.origin), strict=True))
        )
        np.testing.assert_allclose(enu_from_lla(ahead, place_origin), 5 * look, atol=1e-4)


def test_without_exif_and_targets(tmp_path: Path) -> None:
    survey = SimulatedSurvey(tmp_path / "survey", exif=False, targets=0, images=3, lens="pinhole", gnss="consumer")
    for name in survey.truth.images:
        data = (survey.folder / "images" / name).read_bytes()
        assert b"Exif" not in data
        assert b"drone-dji" not in data
    assert survey.points("gcp_list.txt") == survey.points("checkpoints.txt") == []
    assert not (survey.folder / "bag").exists()
    assert survey.truth.lens.model == "SIMPLE_PINHOLE"


def test_only_a_simulation_is_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "survey"
    folder.mkdir()
    options = SimulateOptions(**{**SMALL, "images": 3, "targets": 0})
    simulate(options, folder)  # an empty folder may be used
    with refused("simulation-exists", InputError):
        simulate(options, folder)
    simulate(options, folder, overwrite=True)
    other = tmp_path / "thesis"
    other.mkdir()
    (other / "chapter.txt").write_text("years of work", encoding="utf-8")
    with refused("folder-not-empty", InputError):
        simulate(options, other, overwrite=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["survey", "thesis"]


def test_a_failed_simulation_leaves_nothing(tmp_path: Path) -> None:
    with refused("camera-too-near", InputError):
        simulate(SimulateOptions(**SMALL, heights=(4.0,), radius=60.0), tmp_path / "low")
    with refused("distortion-too-strong", InputError):
        simulate(SimulateOptions(**SMALL, focal=0.35, k1=-0.45), tmp_path / "bent")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"size": "640"}, "--size"),
        ({"size": "99999x480"}, "--size"),
        ({"origin": "91,0,0"}, "--origin"),
        ({"origin": "1,2"}, "--origin"),
        ({"lever_arm": "a,b,c"}, "--lever-arm"),
        ({"boresight": "nan,0,0"}, "--boresight"),
        ({"images": 2}, "--images"),
        ({"heights": ["tall"]}, "--height"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=rf"^\[{field}\]"):
        resolve(SimulateOptions, {}, options, Path("georef.toml"))


def test_lidar_is_written_on_request(survey: SimulatedSurvey) -> None:
    assert survey.truth.lidar is not None and survey.truth.lidar.returns > 1000
    assert (survey.folder / "lidar.laz").stat().st_size > 10_000
    assert len(survey.table("lidar_trajectory.csv")) > 100


def test_too_few_points_are_told_with_their_number(survey: SimulatedSurvey) -> None:
    warnings = json.loads(dump_json({"warnings": survey.summary.warnings}))["warnings"]
    few = next(warning for warning in warnings if warning["code"] == "few-check-points")
    assert numbers(few["sentence"])[0] == survey.summary.well_seen < 30


def test_truth_is_plain_json(survey: SimulatedSurvey) -> None:
    document = json.loads((survey.folder / "truth.json").read_text("utf-8"))
    assert len(document["centers"]) == len(document["cam_from_enu"]) == len(document["images"]) == 8
    rotations = np.array(document["cam_from_enu"])
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), [np.eye(3)] * 8, atol=1e-12)
