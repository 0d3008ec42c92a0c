"""Ground points tied to images; control and check points kept apart."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pyproj
import pytest

from pipelines.core.errors import InputError
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.ingest.ground_points import (
    GroundFile,
    known_distances,
    read_ground_files,
    require_near,
    split_checks,
    tie_marks,
    unmarked_points,
)
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import KnownDistance
from tests.photos import write_flight
from tests.refusals import codes, refused, said

SIZES = {"a.jpg": (64, 48), "b.jpg": (64, 48)}
G1 = "7.75 46.02 1620 10.5 20.5 a.jpg G1\n7.75 46.02 1620 11.5 21.5 b.jpg G1\n"
G2 = "7.76 46.02 1620 10.5 20.5 a.jpg G2\n7.76 46.02 1620 11.5 21.5 b.jpg G2\n"


def _read(tmp_path: Path, rows: str, name: str = "gcp_list.txt", remarks: Remarks | None = None) -> GroundFile:
    path = tmp_path / name
    path.write_text("EPSG:4979\n" + rows)
    options, remarks = IngestOptions(gcp=path), remarks or Remarks()
    file, _ = read_ground_files(options, remarks)
    assert file is not None
    return tie_marks(file, SIZES, options.sigma_mark, remarks)


def test_points_and_marks(tmp_path: Path) -> None:
    remarks = Remarks()
    rows = G1 + G2 + "7.75 46.02 1620 1 1 absent.jpg G1\n7.77 46.02 1620 1 1 a.jpg G3\n"
    file = _read(tmp_path, rows, remarks=remarks)
    assert [(point.name, point.is_marked) for point in file.points] == [("G1", True), ("G2", True), ("G3", False)]
    np.testing.assert_allclose(
        file.points[0].position_in_ecef, ecef_from_lla([46.02, 7.75, 1620.0]), rtol=0, atol=1e-8
    )
    mark = file.points[0].marks[1]
    assert (mark.image, mark.x_px, mark.y_px, mark.sigma_px) == ("b.jpg", 11.5, 21.5, 0.5)
    assert file.crs.vertical.stated and file.crs.vertical.name == "ellipsoidal"
    assert codes(remarks.warnings) == ["mark-in-unknown-image"]
    assert "(1): gcp_list.txt:6 (absent.jpg)" in remarks.warnings[0].sentence
    control, check = split_checks(file, None, [])
    assert [point.name for point in control if point.is_marked] == ["G1", "G2"]
    unmarked_points(control, check, remarks)
    assert "(1): G3 (control)" in said(remarks.warnings[1:], "point-unmarked")


@pytest.mark.parametrize(
    ("rows", "code", "place", "says"),
    [
        (G1 + "7.75 46.02 1620 1 1 a.jpg G1\n", "mark-twice", (4, "image"), "G1 .* a.jpg"),
        ("7.75 46.02 1620 65 20 a.jpg G1\n", "mark-outside-image", (2, "px py"), r"G1 .*\(65, 20\)"),
        ("7.75 46.02 1620 -1 20 a.jpg G1\n", "mark-outside-image", (2, "px py"), r"a\.jpg \(64×48 px\)"),
        ("7.75 46.02 1620 1 1 x.jpg G1\n", "no-image-matched", (None, "image"), r"'x\.jpg' .*'a\.jpg' …"),
        ("7.75 46.02 1620 1 1 ../a.jpg G1\n", "image-outside-folder", (2, "image"), "../a.jpg"),
        (
            re.sub(r"1620 (\d)\d\.5 \d\d\.5", r"1620 0.\1 0.4", G1 + G2),
            "marks-are-fractions",
            (None, "px py"),
            "All 4",
        ),
        ("46.02 97.75 1620 1 1 a.jpg G1\n", "latitude-range", (2, "latitude"), "x is the longitude"),
    ],
)
def test_refusals(tmp_path: Path, rows: str, code: str, place: tuple[int | None, str], says: str) -> None:
    with refused(code, InputError) as error:
        _read(tmp_path, rows)
    assert (error.value.line, error.value.field) == place and error.value.path.name == "gcp_list.txt"
    assert re.search(says, error.value.message)


@pytest.mark.parametrize("version", ["WKT1_GDAL", "WKT1_ESRI", "WKT2_2019"])
def test_the_first_line_may_be_wkt(tmp_path: Path, version: str) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(pyproj.CRS("EPSG:32632").to_wkt(version) + "\n403300 5097000 500 10 20 a.jpg G1\n")
    file, _ = read_ground_files(IngestOptions(gcp=path), Remarks())
    assert file is not None and file.crs.xyz_from_lla([[46.0, 9.0, 0.0]])[0, 0] == pytest.approx(500_000.0)


def test_one_point_has_one_place(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="line 2") as error:
        _read(tmp_path, G1 + "7.75 46.02 1621 1 1 a.jpg G1\n")
    assert (error.value.line, error.value.field) == (4, "x y z")


def test_named_control_points_become_check_points(tmp_path: Path) -> None:
    control, check = split_checks(_read(tmp_path, G1 + G2), None, ["G2"])
    assert [point.name for point in control] == ["G1"]
    assert [point.name for point in check] == ["G2"]


def test_an_unknown_name_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    with refused("check-not-a-point", InputError) as error:
        split_checks(_read(tmp_path, G1 + G2), None, ["G9"])
    assert re.search(r"gcp_list\.txt \[--check\]: 'G9' .*G1, G2", str(error.value))


@pytest.mark.parametrize("rows", [G1, G1.replace("G1", "other")])
def test_a_point_in_both_files_is_refused_whatever_its_name(tmp_path: Path, rows: str) -> None:
    control = _read(tmp_path, G1 + G2)
    check = _read(tmp_path, rows, "checkpoints.txt")
    with refused("point-control-and-check", InputError) as error:
        split_checks(control, check, [])
    assert re.search(r"checkpoints\.txt:2: .* G1 \(line 2\)", str(error.value))


def test_points_in_another_country_are_refused(tmp_path: Path) -> None:
    with refused("point-far-away", InputError) as error:
        require_near(_read(tmp_path, G1), ecef_from_lla([7.75, 46.02, 1620.0]))
    assert re.search(r"gcp_list\.txt:2: G1 is \d+ km", str(error.value))


MARKS = "image,label,x,y\na.jpg,T1,5,6\nb.jpg,T1,7,8\na.jpg,T2,9,9\nb.jpg,T2,8,9\na.jpg,G2,1,1\n"


def _distances(tmp_path: Path, rows: str, remarks: Remarks) -> tuple[KnownDistance, ...]:
    (tmp_path / "bars.csv").write_text(rows)
    (tmp_path / "marks.csv").write_text(MARKS)
    (tmp_path / "gcp_list.txt").write_text("EPSG:4979\n" + G1)
    options = IngestOptions(
        gcp=tmp_path / "gcp_list.txt", marks=tmp_path / "marks.csv", distances=tmp_path / "bars.csv"
    )
    control, check = read_ground_files(options, remarks)
    assert control is not None
    tied = tie_marks(control, SIZES, options.sigma_mark, remarks)
    return known_distances(options, (tied, check), SIZES, remarks)


@pytest.mark.parametrize("header", ["", "from,to,distance (m),use,sigma\n"])
def test_distances_between_control_points_and_targets(header: str, tmp_path: Path) -> None:
    remarks = Remarks()
    rows = "T1,T2,1.5,0.001\nG1,T1,20.25\n" if not header else "T1,T2,1.5,check,0.001\nG1,T1,20.25,,\n"
    bar, taped = _distances(tmp_path, header + rows, remarks)
    assert (bar.name, bar.distance_m, bar.sigma_m, bar.use) == (
        "T1–T2",
        1.5,
        0.001,
        "check" if header else "control",
    )
    assert (taped.sigma_m, taped.use) == (0.002, "control")
    assert [(mark.image, mark.x_px) for mark in bar.ends[0].marks] == [("a.jpg", 5.0), ("b.jpg", 7.0)]
    assert [mark.x_px for mark in taped.ends[0].marks] == [10.5, 11.5]
    assert "1 distances" in said(remarks.assumptions, "default-distance-sigma")
    assert "G2" in said(remarks.warnings, "mark-of-unknown-point")


@pytest.mark.parametrize(
    ("row", "code", "field"),
    [
        ("T1,T9,1.5,0.001", "distance-end-unmarked", "to"),
        ("T1,T2,0,0.001", "distance-not-positive", "distance"),
        ("T1,T1,1.5,0.001", "distance-of-one-point", "to"),
        ("T1,T2,1.5,0.001,scale", "unknown-use", "use"),
        ("T1,T2,1.5,0.001\nT2,T1,1.5,0.001", "distance-twice", "to"),
        ("T1,T2,1.5,-1", "sigma-not-positive", "sigma"),
    ],
)
def test_unusable_distances_are_refused(row: str, code: str, field: str, tmp_path: Path) -> None:
    with refused(code, InputError) as error:
        _distances(tmp_path, row + "\n", Remarks())
    assert (error.value.path, error.value.field) == (tmp_path / "bars.csv", field)
    assert error.value.line == 1 + row.count("\n")


@pytest.mark.parametrize("marks", [1, 0])
def test_points_with_one_mark_each_do_not_place_a_survey(tmp_path: Path, marks: int) -> None:
    names = write_flight(tmp_path / "images", 4, positions=False)
    rows = [f"7.75 46.02 16{index}0 10.5 20.5 {name} G{index}" for index, name in enumerate(names[: 3 + marks])]
    (tmp_path / "gcp.txt").write_text("\n".join(["EPSG:4979", *rows]) + "\n")
    options = IngestOptions(images=tmp_path / "images", gcp=tmp_path / "gcp.txt")
    with refused("control-points-unmarked", InputError) as error:
        survey_and_track(options, None)
    # How many points have how many marks, and how many a point needs.
    assert {3 + marks, 1, 2} <= set(map(int, re.findall(r"\d+", str(error.value))))


def _opf(folder: Path, crs: dict[str, object], coordinates: list[float]) -> Path:
    """Write an OPF project with a control point and a check point, and nothing that was calibrated."""
    marks = [{"camera_id": 1 << 63, "position_px": [10.5, 20.5], "accuracy": 1.0}]
    place = {"crs": crs, "coordinates": coordinates, "sigmas": [0.02, 0.03, 0.05]}
    points = [
        {"id": name, "geolocation": place, "marks": marks, "is_checkpoint": name == "C"} for name in ("G1", "C")
    ]
    listed = [{"id": 1 << 63, "uri": "file:///C:/flight/a.jpg"}]
    files = {"camera_list": ("camera-list", {"cameras": listed})}
    files["input_control_points"] = ("input-control-points", {"gcps": points, "mtps": []})
    items = []
    for kind, (name, content) in files.items():
        form = f"application/opf-{name}+json"
        (folder / f"{name}.json").write_text(json.dumps({"format": form, "version": "1.0", **content}))
        items.append({"type": kind, "resources": [{"uri": f"{name}.json", "format": form}]})
    (path := folder / "project.opf").write_text(
        json.dumps({"format": "application/opf-project+json", "version": "1.0", "items": items})
    )
    return path


@pytest.mark.parametrize(
    ("crs", "coordinates"),
    [
        ("EPSG:4979", [46.02, 7.75, 1620.0]),  # latitude first, as the CRS has it
        (pyproj.CRS("EPSG:4979").to_wkt("WKT2_2019"), [46.02, 7.75, 1620.0]),
        ("EPSG:4978", ecef_from_lla([46.02, 7.75, 1620.0]).tolist()),
    ],
)
def test_control_points_of_an_opf_project(tmp_path: Path, crs: str, coordinates: list[float]) -> None:
    options, remarks = IngestOptions(gcp=_opf(tmp_path, {"definition": crs}, coordinates)), Remarks()
    file, _ = read_ground_files(options, remarks)
    assert file is not None
    tied = tie_marks(file, SIZES, options.sigma_mark, remarks)
    np.testing.assert_allclose(
        tied.points[0].position_in_ecef, ecef_from_lla([46.02, 7.75, 1620.0]), rtol=0, atol=1e-6
    )
    assert [(point.name, point.is_check) for point in tied.points] == [("G1", False), ("C", True)]
    (mark,) = tied.points[0].marks
    assert (mark.image, mark.x_px, mark.y_px) == ("a.jpg", 10.5, 20.5)
    assert (tied.points[0].sigma_h_m, tied.points[0].sigma_v_m) == (0.03, 0.05)


def test_heights_above_one_height_of_a_geoid_are_refused(tmp_path: Path) -> None:
    path = _opf(tmp_path, {"definition": "EPSG:4326+5773", "geoid_height": 47.1}, [46.02, 7.75, 1570.0])
    with refused("geoid-height", InputError) as error:
        read_ground_files(IngestOptions(gcp=path), Remarks())
    assert "47.1" in error.value.message
