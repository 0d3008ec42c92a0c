"""Ground points tied to images; control and check points kept apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.ingest.ground_points import (
    GroundFile,
    read_ground_files,
    require_near,
    split_checks,
    tie_marks,
    unmarked_points,
)
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.remarks import Remarks

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
    assert remarks.warnings == [
        "1 mark is in an image that is not here: gcp_list.txt:6 (absent.jpg)",
    ]
    control, check = split_checks(file, None, [])
    assert [point.name for point in control if point.is_marked] == ["G1", "G2"]
    unmarked_points(control, check, remarks)
    assert remarks.warnings[1:] == [
        "1 ground point has marks in fewer than 2 images, and enters nothing until it is marked: G3 (control)"
    ]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (G1 + "7.75 46.02 1621 1 1 a.jpg G1\n", r"gcp_list\.txt:4 \[x y z\]: G1 has other coordinates in line 2"),
        (G1 + "7.75 46.02 1620 1 1 a.jpg G1\n", r"gcp_list\.txt:4 \[image\]: G1 is marked in a\.jpg already"),
        (
            "7.75 46.02 1620 65 20 a.jpg G1\n",
            r"gcp_list\.txt:2 \[px py\]: the mark of G1 at \(65, 20\) lies outside",
        ),
        ("7.75 46.02 1620 -1 20 a.jpg G1\n", r"lies outside a\.jpg \(64×48 pixels\)"),
        ("7.75 46.02 1620 1 1 x.jpg G1\n", r"names none of the images: it has 'x\.jpg' …, the folder 'a\.jpg' …"),
        ("7.75 46.02 1620 1 1 ../a.jpg G1\n", r"gcp_list\.txt:2 \[image\]: .*leaves the image folder"),
        ("46.02 97.75 1620 1 1 a.jpg G1\n", r"gcp_list\.txt:2 \[latitude\]: .*out of range.*x is the longitude"),
    ],
)
def test_refusals(tmp_path: Path, rows: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        _read(tmp_path, rows)


def test_named_control_points_become_check_points(tmp_path: Path) -> None:
    control, check = split_checks(_read(tmp_path, G1 + G2), None, ["G2"])
    assert [point.name for point in control] == ["G1"]
    assert [point.name for point in check] == ["G2"]


def test_an_unknown_name_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"gcp_list\.txt \[--check\]: 'G9' is no usable point there: it has G1, G2"
    ):
        split_checks(_read(tmp_path, G1 + G2), None, ["G9"])


@pytest.mark.parametrize("rows", [G1, G1.replace("G1", "other")])
def test_a_point_in_both_files_is_refused_whatever_its_name(tmp_path: Path, rows: str) -> None:
    control = _read(tmp_path, G1 + G2)
    check = _read(tmp_path, rows, "checkpoints.txt")
    with pytest.raises(InputError, match=r"checkpoints\.txt:2: .* is also control point G1 \(line 2\)"):
        split_checks(control, check, [])


def test_points_in_another_country_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"gcp_list\.txt:2: G1 is \d+ km from the images: wrong CRS, or x and y swapped"
    ):
        require_near(_read(tmp_path, G1), ecef_from_lla([7.75, 46.02, 1620.0]))
