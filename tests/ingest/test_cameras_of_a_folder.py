"""Cameras of a folder: two bodies of one model, sensors beside each other, lenses that are no pinholes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import Camera, distort
from pipelines.survey.survey import Survey
from tests.photo_folders import AUX, DJI, EXIF_EX, PARROT, PIX4D, SMALL, Folder, packet
from tests.photos import ASCII, RATIONAL, Entry, rational
from tests.refusals import codes, refused, said


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "photos")


def cameras_of(survey: Survey) -> list[list[str]]:
    """The names of the photographs of each camera."""
    groups: dict[int, list[str]] = {}
    for image in survey.images:
        groups.setdefault(image.camera_id, []).append(image.name)
    return sorted(groups.values())


BODY, LENS = 0xA431, 0xA435
SERIALS: dict[str, dict[str, Any]] = {
    "EXIF body": {"photo": lambda n: ((BODY, ASCII, f"0412{n}"),)},
    "EXIF lens": {"photo": lambda n: ((BODY, ASCII, "77"), (LENS, ASCII, f"L{n}"))},
    "DNG's camera": {"image": lambda n: ((0xC62F, ASCII, f"PI04{n}"),)},
    "DJI's camera": {"xmp": lambda n: packet(DJI, {"CameraSerialNumber": f"4A{n}", "DroneSerialNumber": "1581"})},
    "DJI's drone": {"xmp": lambda n: packet(DJI, {"DroneSerialNumber": f"1581F{n}"}, elements=True)},
    "Adobe's": {"xmp": lambda n: packet(AUX, {"SerialNumber": f"60{n}"})},
    "EXIF in XMP": {"xmp": lambda n: packet(EXIF_EX, {"BodySerialNumber": f"60{n}"}, elements=True)},
    "Parrot's drone": {"xmp": lambda n: packet(PARROT, {"SerialNumber": f"PI0{n}"})},
}


@pytest.mark.parametrize("kind", SERIALS)
def test_serial_numbers_tell_two_bodies_apart(folder: Folder, kind: str) -> None:
    for number in range(6):
        folder.add(f"{number}.jpg", **{key: make(1 + number % 2) for key, make in SERIALS[kind].items()})
    survey, found = folder.ingest()
    assert cameras_of(survey) == [["0.jpg", "2.jpg", "4.jpg"], ["1.jpg", "3.jpg", "5.jpg"]]
    rows = found.manifest.values["camera_list"]
    assert [row["images"] for row in rows] == [3, 3]
    assert len({row["serial"] for row in rows}) == (1 if kind == "EXIF lens" else 2) and all(
        r["serial"] for r in rows
    )


def test_no_serial_number_makes_no_camera(folder: Folder) -> None:
    """Placeholders, other instruments, a body on two aircraft, leading zeros, and a photograph without its tags."""
    numbers = [
        {"xmp": packet(DJI, {"CameraSerialNumber": "4A1", "DroneSerialNumber": "1581A"})},
        {"xmp": packet(DJI, {"CameraSerialNumber": "004A1", "DroneSerialNumber": "1581B"})},
        {"xmp": packet(PIX4D, {"SunshineSerialNumber": "S1", "IrradianceSensorSerialNumber": "S2"})},
        {"photo": ((BODY, ASCII, "0000000"),)},
        {"photo": ((BODY, ASCII, "N/A"),)},
        {},
    ]
    for number, tags in enumerate(numbers):
        folder.add(f"{number}.jpg", **tags)  # type: ignore[arg-type]
    survey, _ = folder.ingest()
    assert [camera.serial for camera in survey.cameras] == ["4A1"]


def _pairs(folder: Folder, lenses: Mapping[str, Mapping[str, Any]], count: int = 3) -> None:
    """Photographs of several lenses at each instant: names with `{}` for the number, and their tags."""
    for number in range(count):
        at = replace(folder.instant(), gps=[])  # a table has the positions, also those of TIFF files
        for name, more in lenses.items():
            folder.add(name.format(number), at, **more)


def _source(text: str) -> dict[str, Any]:
    return {"xmp": packet(DJI, {"ImageSource": text})}


def _band(name: str, *, elements: bool = True, **more: object) -> dict[str, Any]:
    return {"xmp": packet(PIX4D, {"BandName": name, **more}, elements=elements)}


THERMAL = {"size": SMALL}
RIGS: dict[str, tuple[dict[str, dict[str, Any]], list[str]]] = {
    "DJI's sources": (
        {"{}a.jpg": _source("WideCamera"), "{}b.jpg": _source("ZoomCamera"), "{}c.jpg": _source("InfraredCamera")},
        ["wide", "zoom", "thermal"],
    ),
    "H20T's names": (
        {"DJI_2024_{:04d}_ZOOM.JPG": {}, "DJI_2024_{:04d}_WIDE.JPG": {}, "DJI_2024_{:04d}_THRM.JPG": THERMAL},
        ["wide", "zoom", "thermal"],
    ),
    "XT2's names": ({"DJI_{:04d}.jpg": {}, "DJI_{:04d}_R.JPG": THERMAL}, ["visible", "thermal"]),
    "pairs of another maker": ({"S{:05d}_v.jpg": {}, "S{:05d}_t.jpg": THERMAL}, ["visible", "thermal"]),
    "Autel's names and sizes": (
        {"MAX_{:04d}.jpg": {"size": (1600, 1200)}, "IRX_{:04d}.jpg": {"size": (640, 512)}},
        ["visible", "thermal"],
    ),
    "one model, two shapes": (
        {"DJI_{:04d}.JPG": {"size": (800, 600)}, "DJI_1{:03d}.JPG": {"size": (320, 256)}},
        ["visible", "thermal"],
    ),
    "FLIR beside another maker": (
        {"a{}.jpg": {"size": (800, 600)}, "b{}.jpg": {"size": (336, 256), "model": "FLIR Vue Pro"}},
        ["visible", "thermal"],
    ),
    "Phantom 4 Multispectral": (
        {
            "DJI_00{}0.JPG": {},
            "DJI_00{}1.TIF": _band("Blue"),
            "DJI_00{}2.TIF": _band("Green"),
            "DJI_00{}4.TIF": _band("RedEdge"),
        },
        ["visible", "blue", "green", "red-edge"],
    ),
    "dual rig": (
        {
            "IMG_{:04d}_1.tif": _band("Green-531"),
            "IMG_{:04d}_2.tif": _band("Green-560"),
            "IMG_{:04d}_6.tif": _band("LWIR"),
        },
        ["green-531", "green-560", "thermal"],
    ),
    "one name, two wavelengths": (
        {"{}_a.tif": _band("NIR", CentralWavelength=790), "{}_b.tif": _band("NIR", CentralWavelength=840)},
        ["nir-790", "nir-840"],
    ),
    "wavelengths alone": (
        {
            "{}_a.tif": {"xmp": packet(PIX4D, {"CentralWavelength": 668})},
            "{}_b.tif": {"xmp": packet(PIX4D, {"CentralWavelength": 560})},
        },
        ["560-nm", "668-nm"],
    ),
    "numbers of lenses alone": (
        {f"{{}}_{name}.tif": {"xmp": packet(PIX4D, {"RigCameraIndex": k})} for k, name in enumerate("xyz")},
        ["lens-0", "lens-1", "lens-2"],
    ),
    "numbers in names alone": (
        {f"IMG_{{:04d}}_{k}.tif": {} for k in range(1, 6)},
        ["lens-1", "lens-2", "lens-3", "lens-4", "lens-5"],
    ),
    "Sequoia's names": (
        {"IMG_{:04d}_GRE.TIF": {}, "IMG_{:04d}_NIR.TIF": {}, "IMG_{:04d}_REG.TIF": {}},
        ["green", "nir", "red-edge"],
    ),
}


@pytest.mark.parametrize("rig", RIGS)
def test_one_sensor_is_used_and_the_others_are_named(folder: Folder, rig: str) -> None:
    lenses, sensors = RIGS[rig]
    _pairs(folder, lenses)
    geo = folder.root.parent / "geo.txt"
    names = sorted(path.name for path in folder.root.iterdir())
    geo.write_text("EPSG:4326\n" + "".join(f"{n} {7 + k * 1e-4} 46 500\n" for k, n in enumerate(names)))
    survey, _ = folder.ingest(geo=geo)
    assert {camera.sensor or "visible" for camera in survey.cameras} == {sensors[0]}
    assert len(survey.images) == 3 and len(survey.cameras) == 1
    told = said(survey.warnings, "other-sensors")
    assert all(f"{sensor} (3)" in told for sensor in sensors)
    for sensor in sensors[1:]:
        chosen, _ = folder.ingest(workspace=sensor, geo=geo, sensor=sensor)
        assert {camera.sensor for camera in chosen.cameras} == {sensor}
        assert not {image.name for image in chosen.images} & {image.name for image in survey.images}
    with refused("no-such-sensor", InputError) as error:
        folder.ingest(workspace="none", geo=geo, sensor="ultraviolet")
    assert isinstance(error.value, InputError) and error.value.field == "--sensor"
    assert all(f"{sensor} (3)" in error.value.message for sensor in sensors)


def test_two_drones_are_no_pair(folder: Folder) -> None:
    """One states its lens and the other does not; names with letters and numbers that are no lenses."""
    for number in range(3):
        folder.add(f"DJI_{number:04d}_V.JPG", model="M3E", **_source("WideCamera"))
        folder.add(f"P4_{number}.JPG", model="FC6310")
        folder.add(f"plot_{number}_1.jpg", model="X")
        folder.add(f"house{number}_T.jpg", model="X")
    folder.add("roof_red.jpg", model="X")
    folder.add("small.jpg", model="X", size=(32, 24))
    survey, _ = folder.ingest()
    assert len(survey.images) == 14 and len(survey.cameras) == 4
    assert "other-sensors" not in codes(survey.warnings)


@pytest.mark.parametrize(
    ("xmp", "photo", "fisheye"),
    [
        ({"ModelType": "fisheye"}, (), True),
        ({"FisheyeAffineMatrix": "20,0,0,20", "FisheyePolynomial": "0,1,0,0"}, (), True),
        ({}, ((0xA434, ASCII, "Fisheye-NIKKOR 8mm f/2.8"),), True),
        ({"LensType": "Fish-Eye"}, (), True),
        ({"ModelType": "perspective"}, (), False),
        ({"ModelType": "fisheye", "DewarpFlag": "1"}, (), False),
        ({"DewarpFlag": "0"}, ((0xA434, ASCII, "24mm f/2.8"),), False),
    ],
)
@pytest.mark.parametrize("elements", [False, True])
def test_a_fisheye_is_no_pinhole(
    folder: Folder, xmp: dict[str, str], photo: tuple[Entry, ...], fisheye: bool, elements: bool
) -> None:
    for number in range(3):
        folder.add(f"{number}.jpg", photo=photo, xmp=packet(PIX4D, xmp, elements=elements))
    survey, _ = folder.ingest()
    assert [camera.model for camera in survey.cameras] == ["OPENCV_FISHEYE" if fisheye else "SIMPLE_RADIAL"]
    assert ("fisheye-lens" in codes(survey.assumptions)) is fisheye


def test_the_fisheye_of_the_tags_maps_rays_as_they_say(folder: Folder) -> None:
    """PIX4D's definition, r = C ρ(2θ/π), for a picture at half of the size as taken."""
    affine, polynomial, size = 1676.8, (0.0, 1.0, 0.0059, -0.137), (640, 480)
    xmp = packet(
        PIX4D,
        {
            "ModelType": "fisheye",
            "FisheyeAffineMatrix": f"{affine},0,0,{affine}",
            "FisheyePolynomial": ",".join(map(str, polynomial)),
            "PrincipalPoint": "2.544297,1.797905",
        },
    )
    taken: tuple[Entry, ...] = ((0xA002, 4, 1280), (0xA003, 4, 960), (0x920A, RATIONAL, [rational(4.0)]))
    taken += ((0xA20E, RATIONAL, [rational(266.6667)]), (0xA210, 3, 4))  # pixels a millimetre, as taken
    for number in range(3):
        folder.add(f"{number}.jpg", size=size, xmp=xmp, photo=taken)
    (camera,) = folder.ingest()[0].cameras
    lens = Camera(camera.model, camera.width, camera.height, np.array(camera.params))
    angle = np.linspace(0.02, 0.7, 30)  # the corner is 400 px or 0.73 rad from the axis
    pixel = distort(lens, np.stack([np.tan(angle), np.zeros_like(angle)], axis=1))
    expected = affine / 2 * np.polynomial.polynomial.polyval(2 * angle / np.pi, polynomial)
    # Two coefficients of odd powers replace a cubic polynomial with an even power of 0.006.
    assert np.abs(pixel[:, 0] - 2.544297 * 266.6667 / 2 - expected).max() < 0.2
    assert camera.params[3] == pytest.approx(1.797905 * 266.6667 / 2, abs=0.01)


def test_text_lists_the_cameras(folder: Folder, capsys: pytest.CaptureFixture[str]) -> None:
    from georef_cli.boundary import guarded
    from georef_cli.main import cli

    for number in range(4):
        folder.add(f"{number}.jpg", photo=((BODY, ASCII, f"04123{number % 2}"),))
    code = guarded(cli, ["ingest", str(folder.root.parent / "ws"), "--images", str(folder.root), "-q"])
    told = capsys.readouterr().out
    assert code == 0 and "041230" in told and "041231" in told and "64×48" in told
