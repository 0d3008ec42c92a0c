"""Which photographs of several lenses were exposed together, as makers and users say it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from pipelines.core.errors import InputError
from pipelines.survey.survey import Survey
from tests.photo_folders import PIX4D, Folder, packet
from tests.refusals import codes, refused

COUNT = 4


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "photos")


def _flight(folder: Folder, lenses: Mapping[str, Mapping[str, str]], *, capture: str = "") -> Path:
    """Photographs of lenses at `COUNT` instants, `{}` in names being the instant's; positions in a table."""
    rows = []
    for number in range(COUNT):
        at = folder.instant()
        at.gps.clear()
        for name, tags in lenses.items():
            stated = dict(tags) | ({capture: f"C0FFEE{number:02d}"} if capture else {})
            folder.add(name.format(number), at, xmp=packet(PIX4D, stated) if stated else None)
            rows.append(f"{name.format(number)} {7 + number * 1e-4} 46 500\n")
    table = folder.root.parent / "geo.txt"
    table.write_text("EPSG:4326\n" + "".join(rows))
    return table


def _beside(survey: Survey) -> dict[str, str]:
    return {each.name: each.beside for each in survey.companions}


TOLD: dict[str, tuple[dict[str, dict[str, str]], str]] = {
    "Parrot's identifier": ({"a{}1.TIF": {"BandName": "Green"}, "b{}7.TIF": {"BandName": "NIR"}}, "CaptureUUID"),
    "MicaSense's identifier": (
        {"IMG_{:04d}_1.tif": {"BandName": "Green"}, "x{}.tif": {"BandName": "Red edge"}},
        "CaptureId",
    ),
    "names": ({"IMG_{:04d}_GRE.TIF": {}, "IMG_{:04d}_NIR.TIF": {}}, ""),
    "names in folders": ({"A/IMG_{:04d}_GRE.TIF": {}, "A/IMG_{:04d}_RED.TIF": {}}, ""),
    "times of a rig": (
        {
            "g{}x.TIF": {"RigName": "R", "RigCameraIndex": "0", "BandName": "Green"},
            "n{}y.TIF": {"RigName": "R", "RigCameraIndex": "1", "BandName": "NIR"},
        },
        "",
    ),
}


@pytest.mark.parametrize("how", TOLD)
def test_lenses_that_expose_together_are_a_rig(folder: Folder, how: str) -> None:
    lenses, capture = TOLD[how]
    geo = _flight(folder, lenses, capture=capture)
    survey, _ = folder.ingest(geo=geo, sensor="all")
    reference, other = lenses
    assert [image.name for image in survey.images] == [reference.format(k) for k in range(COUNT)]
    assert _beside(survey) == {other.format(k): reference.format(k) for k in range(COUNT)}
    assert len(survey.cameras) == 2
    assert "rig" in codes(survey.assumptions)
    assert not {"other-sensors", "rig-photograph-alone"} & set(codes(survey.warnings))
    whole = survey.with_companions()
    assert len(whole.images) == 2 * COUNT
    assert [image.fix for image in whole.images[COUNT:]] == [image.fix for image in survey.images]


def test_a_photograph_without_its_instant_is_left_out(folder: Folder) -> None:
    geo = _flight(folder, {"IMG_{:04d}_GRE.TIF": {}, "IMG_{:04d}_NIR.TIF": {}})
    folder.add("IMG_0009_NIR.TIF")
    survey, _ = folder.ingest(geo=geo, sensor="all")
    assert "IMG_0009_NIR.TIF" not in _beside(survey)
    assert "rig-photograph-alone" in codes(survey.warnings)


def _config(folder: Folder, cameras: list[dict[str, Any]]) -> Path:
    path = folder.root.parent / "rig_config.json"
    path.write_text(json.dumps([{"cameras": cameras}]))
    return path


LEFT, RIGHT = {"image_prefix": "left/", "ref_sensor": True}, {"image_prefix": "right/"}


def test_a_file_of_the_rig_tells_lenses_apart(folder: Folder) -> None:
    """Two cameras alike in all tags, of which one is turned: each has its own intrinsics."""
    geo = _flight(folder, {"left/{}.jpg": {}, "right/{}.jpg": {}})
    turned = {**RIGHT, "cam_from_rig_rotation": [0.0, 0.0, 2.0**-0.5, 2.0**-0.5]}
    survey, _ = folder.ingest(geo=geo, rig=_config(folder, [turned, LEFT]))
    assert _beside(survey) == {f"right/{k}.jpg": f"left/{k}.jpg" for k in range(COUNT)}
    assert len(survey.cameras) == 2
    assert survey.companions[0].stated_quat_xyzw == pytest.approx((0.0, 2.0**-0.5, 2.0**-0.5, 0.0))


@pytest.mark.parametrize(
    ("cameras", "code"),
    [
        ([LEFT], "rig-reference"),
        ([RIGHT, {"image_prefix": "left/"}], "rig-reference"),
        ([LEFT, {"image_prefix": "left/"}], "rig-prefix"),
        ([LEFT, {"image_prefix": "behind/"}], "rig-prefix-unknown"),
        ([LEFT, {**RIGHT, "cam_from_rig_rotation": [1, 2, 3]}], "rig-rotation"),
        ([LEFT, {**RIGHT, "cam_from_rig_rotation": [1, 1, 0, 0]}], "rig-rotation"),
    ],
)
def test_a_file_that_is_no_rig_is_refused(folder: Folder, cameras: list[dict[str, Any]], code: str) -> None:
    geo = _flight(folder, {"left/{}.jpg": {}, "right/{}.jpg": {}})
    with refused(code, InputError):
        folder.ingest(geo=geo, rig=_config(folder, cameras))


def test_lenses_that_nothing_ties_are_no_rig(folder: Folder) -> None:
    geo = _flight(folder, {"a{}1.TIF": {"BandName": "Green"}, "b{}7.TIF": {"BandName": "NIR"}})
    with refused("no-rig", InputError):
        folder.ingest(geo=geo, sensor="all")
