"""The stage `ingest` on small flights whose truth is known, through the runner and alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.geodesy import enu
from pipelines.geodesy.crs import parse_crs
from pipelines.geometry.rotations import geo_from_cam, matrix_from_quat_xyzw
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import Survey
from tests.earth import enu_from_lla
from tests.photos import FLIGHT_START_S, Exif, dji_xmp, gps_entries, jpeg, write_flight
from tests.refusals import codes, numbers, refused, said

LAT, LON = 46.02, 7.75


def _build(images: Path, **options: Any) -> Survey:
    return survey_and_track(IngestOptions(images=images, **options), None)[0]


def _positions(survey: Survey) -> np.ndarray:
    return np.array([image.fix.position_in_geo for image in survey.images if image.fix is not None])


def _points(path: Path, crs: str, xyz: np.ndarray, images: list[str]) -> Path:
    """A gcp_list.txt with points P0, P1 … at xyz (N, 3), each marked in the first two images."""
    rows = [
        f"{x:.10f} {y:.10f} {z:.4f} {10 + index} {20 + index} {image} P{index}"
        for index, (x, y, z) in enumerate(xyz)
        for image in images[:2]
    ]
    path.write_text("\n".join([crs, *rows]) + "\n")
    return path


def test_exif_alone(tmp_path: Path) -> None:
    write_flight(tmp_path / "images", 9, lat=LAT, lon=LON)
    survey = _build(tmp_path / "images")
    assert survey.names("test") == ("IMG_0000.JPG", "IMG_0008.JPG")
    assert (survey.origin.lat_deg, survey.origin.lon_deg, survey.origin.alt_m) == (46.02, 7.7504, 120.0)
    truth = enu_from_lla([[LAT, LON + 1e-4 * index, 120.0] for index in range(9)], survey.origin)
    np.testing.assert_allclose(_positions(survey), truth, rtol=0, atol=1e-4)  # EXIF's last digit
    fix = survey.images[0].fix
    assert fix is not None and (fix.source, fix.sigma_source) == ("exif", "default")
    np.testing.assert_allclose(fix.cov_in_geo, np.diag([2.5**2, 2.5**2, 5.0**2]), atol=1e-3)
    assert survey.images[3].timestamp_s == FLIGHT_START_S + 3
    assert not survey.vertical.stated
    assert "ellipsoidal" in said(survey.assumptions, "vertical-datum-assumed")


def test_through_the_runner(tmp_path: Path) -> None:
    write_flight(tmp_path / "images", 4)
    workspace = Workspace(tmp_path / "ws")
    outcome = run_stage(workspace, BY_NAME["ingest"], {"images": str(tmp_path / "images")})
    survey = load_json(Survey, workspace.path(SURVEY))
    assert survey.image_dir == str((tmp_path / "images").resolve())
    assert outcome.manifest.key_figure == "4 images, 4 positions, 0 control and 0 check points"
    assert outcome.manifest.values["fixes"] == 4
    again = run_stage(workspace, BY_NAME["ingest"], {"images": str(tmp_path / "images")})
    assert not again.ran
    (tmp_path / "images" / "IMG_0000.JPG").write_bytes(jpeg(77, exif=Exif(gps=gps_entries(LAT, LON))))
    assert run_stage(workspace, BY_NAME["ingest"], {"images": str(tmp_path / "images")}).ran


def test_copy_makes_the_workspace_complete(tmp_path: Path) -> None:
    names = write_flight(tmp_path / "images" / "sub", 3)
    workspace = Workspace(tmp_path / "ws")
    run_stage(workspace, BY_NAME["ingest"], {"images": str(tmp_path / "images"), "copy_images": True})
    survey = load_json(Survey, workspace.path(SURVEY))
    assert survey.image_dir == "ingest/images"
    for name in names:
        copy = workspace.root / survey.image_dir / "sub" / name
        assert copy.read_bytes() == (tmp_path / "images" / "sub" / name).read_bytes()


def test_attitudes_and_sigma_turn_with_the_meridians(tmp_path: Path) -> None:
    # At 70° N, images 10 km apart: north turns by a quarter of a degree between them.
    images = tmp_path / "images"
    images.mkdir()
    xmp = dji_xmp(GimbalYawDegree="0", GimbalPitchDegree="-90", GimbalRollDegree="0")
    for index, lon in enumerate((24.0, 24.1, 24.2625)):
        (images / f"{index}.jpg").write_bytes(jpeg(index, exif=Exif(gps=gps_entries(70.0, lon)), xmp=xmp))
    survey = _build(images)
    for image, lon in zip(survey.images, (24.0, 24.1, 24.2625), strict=True):
        assert image.attitude is not None and image.attitude.source == "gimbal" and image.attitude.sigma_deg == 2.0
        local = enu.geo_from_enu_at([70.0, lon, 100.0], survey.origin)
        expected = local @ geo_from_cam([0.0, -90.0, 0.0])
        np.testing.assert_allclose(matrix_from_quat_xyzw(image.attitude.quat_xyzw), expected, rtol=0, atol=1e-9)


def test_trajectory_in_utm_with_attitude_and_sigma(tmp_path: Path) -> None:
    names = write_flight(tmp_path / "images", 4, positions=False)
    truth = np.array([[LAT, LON + 1e-4 * index, 500.0 + index] for index in range(4)])
    xyz = parse_crs("EPSG:32632").xyz_from_lla(truth)
    rows = [
        f"{name},{x:.4f},{y:.4f},{z:.4f},90,-45,0,0.1,0.2,0.3" for name, (x, y, z) in zip(names, xyz, strict=True)
    ]
    path = tmp_path / "t.csv"
    path.write_text("image,x,y,z,yaw,pitch,roll,sigma_e,sigma_n,sigma_u\n" + "\n".join(rows))
    survey = _build(tmp_path / "images", trajectory=path, crs="EPSG:32632", vertical="ellipsoidal", test_every=0)
    np.testing.assert_allclose(_positions(survey), enu_from_lla(truth, survey.origin), rtol=0, atol=2e-4)
    image = survey.images[2]
    assert image.fix is not None and image.attitude is not None and image.fix.sigma_source == "file"
    np.testing.assert_allclose(image.fix.cov_in_geo, np.diag([0.01, 0.04, 0.09]), rtol=0, atol=1e-5)
    looks = matrix_from_quat_xyzw(image.attitude.quat_xyzw) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(looks, [np.sqrt(0.5), 0.0, -np.sqrt(0.5)], atol=1e-5)  # east and down
    assert image.attitude.sigma_deg == 1.0
    assert survey.vertical.stated and survey.source_crs == "EPSG:32632"
    assert survey.names("test") == ()


def test_geo_txt_control_and_check_points(tmp_path: Path) -> None:
    names = write_flight(tmp_path / "images", 4, positions=False)
    (tmp_path / "geo.txt").write_text(
        "EPSG:4326\n" + "\n".join(f"{name} {LON + 1e-4 * index} {LAT} 500" for index, name in enumerate(names))
    )
    lla = np.array([[LAT + 1e-4, LON, 450.0], [LAT, LON + 1e-4, 451.0], [LAT - 1e-4, LON, 452.0]])
    gcp = _points(tmp_path / "gcp_list.txt", "WGS84 UTM 32N", parse_crs("EPSG:32632").xyz_from_lla(lla), names)
    other = np.array([[LON, LAT + 2e-4, 450.0]])
    checks = _points(tmp_path / "checkpoints.txt", "EPSG:4979", other, names)
    checks.write_text(checks.read_text().replace("P0", "C0"))
    files: dict[str, Any] = {"geo": tmp_path / "geo.txt", "gcp": gcp, "checkpoints": checks}
    survey = _build(tmp_path / "images", **files, check=("P1",), vegetated=("P1",), sigma_mark=0.3)
    assert [point.land_cover for point in survey.check_points] == ["open", "vegetated"]
    with refused("vegetated-not-a-check", InputError) as error:
        _build(tmp_path / "images", **files, vegetated=("P2",))
    assert error.value.field == "--vegetated" and all(name in error.value.message for name in ("'P2'", "C0"))
    assert [point.name for point in survey.control_points] == ["P0", "P2"]
    assert [point.name for point in survey.check_points] == ["C0", "P1"]
    for point, place in zip(survey.control_points, lla[[0, 2]], strict=True):
        np.testing.assert_allclose(point.position_in_geo, enu_from_lla(place, survey.origin), rtol=0, atol=2e-4)
        np.testing.assert_allclose(point.cov_in_geo, np.diag([4e-4, 4e-4, 9e-4]), rtol=0, atol=1e-7)
    assert survey.control_points[0].marks[1].sigma_px == 0.3
    assert "vertical-datums-mixed" in codes(survey.warnings)


def test_ground_points_without_any_position(tmp_path: Path) -> None:
    names = write_flight(tmp_path / "images", 4, positions=False)
    xyz = np.array([[LON, LAT, 450.0], [LON + 1e-3, LAT, 451.0], [LON, LAT + 1e-3, 452.0]])
    survey = _build(tmp_path / "images", gcp=_points(tmp_path / "gcp_list.txt", "EPSG:4979", xyz, names))
    assert all(image.fix is None for image in survey.images)
    assert (survey.origin.lat_deg, survey.origin.lon_deg, survey.origin.alt_m) == (LAT, LON, 451.0)
    assert survey.source_crs == "EPSG:4979" and survey.vertical.stated
    assert numbers(said(survey.warnings, "no-positions")) == [3.0]


def test_time_matched_trajectory(tmp_path: Path) -> None:
    write_flight(tmp_path / "images", 4, positions=False)
    rows = [f"{FLIGHT_START_S - 0.5 + index};46,02;{7.75 + 1e-4 * index:.6f};500" for index in range(6)]
    (tmp_path / "t.csv").write_text("timestamp;lat;lon;alt\r\n" + "\r\n".join(rows).replace(".", ","))
    survey = _build(tmp_path / "images", trajectory=tmp_path / "t.csv", max_gap=1.5)
    truth = enu_from_lla([[LAT, LON + 1e-4 * (index + 0.5), 500.0] for index in range(4)], survey.origin)
    np.testing.assert_allclose(_positions(survey), truth, rtol=0, atol=1e-3)


def test_times_in_whole_seconds_ask_for_the_time_offset(tmp_path: Path) -> None:
    """Only the photographs' own motion tells what of a second was cut off: 0.5 s at 7.7 m/s is far beyond 2 cm."""
    write_flight(tmp_path / "images", 4, positions=False)
    rows = [
        f"{FLIGHT_START_S - 0.5 + index},46.02,{7.75 + 1e-4 * index:.6f},500,0.02,0.02,0.03" for index in range(6)
    ]
    head = "timestamp,lat,lon,alt,sigma_e,sigma_n,sigma_u"
    (tmp_path / "t.csv").write_text("\n".join([head, *rows]))
    survey = _build(tmp_path / "images", trajectory=tmp_path / "t.csv")
    assert survey.estimate == ("time-offset",)
    assert _build(tmp_path / "images", trajectory=tmp_path / "t.csv", time_offset=0.1).estimate == ()
    fix = survey.images[1].fix
    assert fix is not None
    sigma_e = np.sqrt(fix.cov_in_geo[0][0])
    assert sigma_e == pytest.approx(0.577 * 7.74, rel=0.02)
    np.testing.assert_allclose(np.abs(fix.common_along_m), [0.5 * 7.74, 0.0, 0.0], atol=0.05)


def test_some_without_position_and_one_astray(tmp_path: Path) -> None:
    images = tmp_path / "images"
    write_flight(images, 5)
    (images / "no_gps.jpg").write_bytes(jpeg(50))
    (images / "astray.jpg").write_bytes(jpeg(51, exif=Exif(gps=gps_entries(-12.0, 44.0))))
    (images / "null.jpg").write_bytes(jpeg(52, exif=Exif(gps=gps_entries(0.0, 0.0))))
    (images / "large.jpg").write_bytes(jpeg(53, size=(96, 64), exif=Exif(image=[(0x0112, 3, 6)])))
    survey = _build(images)
    assert sum(image.fix is not None for image in survey.images) == 5
    for code, says in {
        "position-far-away": "(1): astray.jpg (",
        "images-without-position": "(4): astray.jpg, large.jpg, no_gps.jpg, null.jpg.",
        "exif-unusable": "the GPS position is 0, 0, which means none (1): null.jpg.",
        "image-sizes": "2 sizes (64×48, 96×64)",
        "exif-orientation": "(1): large.jpg.",
    }.items():
        assert says in said(survey.warnings, code)
    assert len(survey.cameras) == 2


def test_three_images_hold_none_out(tmp_path: Path) -> None:
    write_flight(tmp_path / "images", 3)
    survey = _build(tmp_path / "images")
    assert survey.names("test") == ()
    assert numbers(said(survey.warnings, "no-test-images")) == [3.0]


def test_sigma_and_focal_options(tmp_path: Path) -> None:
    write_flight(tmp_path / "images", 4)
    survey = _build(tmp_path / "images", sigma_h=0.5, sigma_v=0.7, focal_px=55.0)
    fix = survey.images[0].fix
    assert fix is not None and fix.sigma_source == "option"
    np.testing.assert_allclose(fix.cov_in_geo, np.diag([0.25, 0.25, 0.49]), atol=1e-5)
    assert survey.cameras[0].params == (55.0, 32.0, 24.0, 0.0)
    assert survey.cameras[0].focal_source == "option"


@pytest.mark.parametrize(
    ("options", "code", "field"),
    [
        ({"images": None}, "no-photographs-given", "--images"),
        ({"trajectory": "t.csv", "geo": "geo.txt"}, "two-position-files", "--geo"),
        ({"crs": "EPSG:32632"}, "crs-without-trajectory", "--crs"),
        ({"check": ("P1",)}, "check-without-gcp", "--check"),
        ({"test_every": 1}, "nothing-to-train-on", "--test-every"),
        ({"vertical": "sea"}, "vertical-datum-unknown", "--vertical"),
        ({"vertical": "EGM2008"}, "grid-not-installed", None),
        ({"every": "2s"}, "needs-bag", "--every"),
    ],
)
def test_options_that_cannot_be(tmp_path: Path, options: dict[str, Any], code: str, field: str | None) -> None:
    write_flight(tmp_path / "images", 3)
    with refused(code, InputError) as error:
        survey_and_track(IngestOptions(**{"images": tmp_path / "images", **options}), None)
    assert error.value.field == field
    assert code != "grid-not-installed" or "us_nga_egm08_25.tif" in error.value.message


def test_a_trajectory_that_is_not_there(tmp_path: Path) -> None:
    write_flight(tmp_path / "images", 3)
    with pytest.raises(InputError) as error:
        _build(tmp_path / "images", trajectory=Path("absent.csv"))
    assert error.value.path == Path("absent.csv")


def test_too_few_usable_images_say_why(tmp_path: Path) -> None:
    write_flight(tmp_path / "images", 2)
    (tmp_path / "images" / "cut.jpg").write_bytes(jpeg(5)[:600])
    with refused("too-few-images", InputError) as error:
        _build(tmp_path / "images")
    assert (error.value.path, error.value.field) == (tmp_path / "images", "--images")
    assert numbers(error.value.message)[:2] == [2.0, 3.0] and "cut.jpg" in error.value.message


def test_nothing_to_place_the_survey_with(tmp_path: Path) -> None:
    write_flight(tmp_path / "images", 3, positions=False)
    with refused("no-positions", InputError):
        _build(tmp_path / "images")


def test_control_points_far_away(tmp_path: Path) -> None:
    names = write_flight(tmp_path / "images", 3)
    swapped = np.array([[LAT, LON, 450.0]])
    gcp = _points(tmp_path / "gcp_list.txt", "EPSG:4979", swapped, names)
    with refused("point-far-away", InputError) as error:
        _build(tmp_path / "images", gcp=gcp)
    assert (error.value.path, error.value.line) == (gcp, 2) and "P0" in error.value.message


def test_a_workspace_among_its_photographs_is_refused(tmp_path: Path) -> None:
    write_flight(tmp_path, 3)
    with refused("workspace-in-photographs", InputError):
        run_stage(Workspace(tmp_path / "ws"), BY_NAME["ingest"], {"images": str(tmp_path)})
