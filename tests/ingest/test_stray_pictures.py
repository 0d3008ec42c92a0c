"""Pictures that are none of the survey: thumbnails, reduced copies and panoramas, and what only looks like them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import check_inputs
from pipelines.survey.survey import Survey
from tests.photos import ASCII, Exif, gps_entries
from tests.refusals import codes, refused, said

COUNT, SIZE = 4, (96, 72)
GPANO = "http://ns.google.com/photos/1.0/panorama/"


def exif(number: int, model: str = "FC1") -> Exif:
    moment = f"2026:05:04 10:00:{number:02d}"
    return Exif(
        image=[(0x0110, ASCII, model)],
        photo=[(0x9003, ASCII, moment), (0x9011, ASCII, "+00:00")],
        gps=gps_entries(46.0, 7.0 + 1e-4 * number),
    )


def picture(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A scene of its own for each number, at any size."""
    coarse = np.random.default_rng(number).integers(30, 225, (9, 12, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC))


def write(path: Path, pixels: np.ndarray, tags: Exif | None = None, *, xmp: bytes = b"", quality: int = 90) -> None:
    """A JPEG with tags."""
    plain = cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()
    payloads = [
        *([b"Exif\0\0" + tags.tiff()] if tags else []),
        *([b"http://ns.adobe.com/xap/1.0/\0" + xmp] if xmp else []),
    ]
    segments = b"".join(b"\xff\xe1" + (len(one) + 2).to_bytes(2, "big") + one for one in payloads)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(plain[:2] + segments + plain[2:])


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for number in range(COUNT):
        write(tmp_path / f"photos/images/IMG_{number}.jpg", picture(number), exif(number))
    return tmp_path / "photos"


def ingest(photos: Path, **options: object) -> Survey:
    workspace = Workspace(photos.parent / "ws")
    run_stage(workspace, BY_NAME["ingest"], {"images": photos, "vertical": "ellipsoidal", **options})
    return load_json(Survey, workspace.path(SURVEY))


def names(survey: Survey) -> list[str]:
    return [image.name for image in survey.images]


ORIGINALS = [f"images/IMG_{number}.jpg" for number in range(COUNT)]


@pytest.mark.parametrize(
    "place",
    [
        "images/@eaDir/IMG_{}.jpg/SYNOPHOTO_THUMB_XL.jpg", "Thumbs/IMG_{}.jpg", "images/_thumbnails/IMG_{}.jpg",
        "THMBNL/IMG_{}T01.JPG", "images/thumb_IMG_{}.jpg", "images/IMG_{}_thumb.jpg", "@Recycle/IMG_{}.jpg",
    ],
)  # fmt: skip
def test_thumbnails_by_their_place(photos: Path, place: str) -> None:
    """Also those that a server has cut square, without tags."""
    for number in range(COUNT):
        write(photos / place.format(number), picture(number, (32, 32)))
    survey = ingest(photos)
    assert names(survey) == ORIGINALS
    assert f"({COUNT}): {place.format(0)}" in said(survey.warnings, "image-thumbnails")


def test_photographs_in_a_folder_of_that_name_alone_stay(tmp_path: Path) -> None:
    for number in range(COUNT):
        write(tmp_path / f"photos/thumbs/IMG_{number}.jpg", picture(number), exif(number))
    assert len(names(ingest(tmp_path / "photos"))) == COUNT


@pytest.mark.parametrize(
    ("place", "size", "has_tags"),
    [
        ("images_2/IMG_{}.jpg", (48, 36), True),
        ("images_4/IMG_{}.jpg", (24, 18), False),
        ("web/IMG_{}.JPEG", (95, 71), True),  # rounded sides
        ("small/preview-{}.jpg", (48, 36), True),  # another name, the same instant
        ("jpeg80/IMG_{}.jpg", SIZE, True),  # recompressed
    ],
)
def test_reduced_copies(photos: Path, place: str, size: tuple[int, int], has_tags: bool) -> None:
    for number in range(COUNT):
        tags = exif(number) if has_tags else None
        write(
            photos / place.format(number),
            cv2.resize(picture(number), size, interpolation=cv2.INTER_AREA),
            tags,
            quality=80,
        )
    survey = ingest(photos)
    assert names(survey) == ORIGINALS and len(survey.cameras) == 1
    told = said(survey.warnings, "image-reduced-copies")
    assert f"({COUNT})" in told and f"{place.format(0)} (of {ORIGINALS[0]})" in told


def test_a_dry_run_knows_reduced_copies_by_their_tags(photos: Path) -> None:
    for number in range(COUNT):
        write(photos / f"images_2/IMG_{number}.jpg", picture(number, (48, 36)), exif(number))
    options = IngestOptions.model_validate({"images": photos, "vertical": "ellipsoidal"})
    assert check_inputs(Workspace(photos.parent / "ws"), options).values["images"] == COUNT


@pytest.mark.parametrize("kind", ["second flight", "second flight without tags", "other scene", "burst"])
def test_what_only_looks_like_a_copy_stays(photos: Path, kind: str) -> None:
    """Names begin anew with each card; a small camera fires with the large one; two exposures within a second."""
    for number in range(COUNT):
        path, scene = photos / f"b/IMG_{number}.jpg", picture(number + 50, (48, 36))
        if kind == "second flight":
            write(path, scene, exif(number + 20))
        elif kind == "second flight without tags":
            write(path, scene)
        elif kind == "other scene":
            write(path, scene, exif(number))
        else:
            write(photos / f"images/IMG_{number}b.jpg", picture(number + 50), exif(number))
    assert len(names(ingest(photos))) == 2 * COUNT


def gpano(**values: object) -> bytes:
    attributes = " ".join(f'GPano:{name}="{value}"' for name, value in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" xmlns:GPano="{GPANO}" {attributes}/></rdf:RDF></x:xmpmeta>'
    ).encode()


@pytest.mark.parametrize(
    ("place", "size", "xmp"),
    [
        ("images/IMG_9.jpg", (120, 60), gpano(ProjectionType="equirectangular")),
        ("images/IMG_9.jpg", (90, 60), gpano(ProjectionType="cylindrical")),
        ("images/IMG_9.jpg", (90, 60), gpano(FullPanoWidthPixels=120, UsePanoramaViewer="True")),
        ("images/IMG_9.jpg", (120, 60), b""),  # 2:1 among others of its camera
        ("PANO/DJI_stitched.jpg", (200, 60), b""),
        ("images/IMG_9_pano.jpg", (150, 72), b""),
    ],
)
def test_panoramas(photos: Path, place: str, size: tuple[int, int], xmp: bytes) -> None:
    write(photos / place, picture(9, size), exif(9), xmp=xmp)
    survey = ingest(photos)
    assert names(survey) == ORIGINALS
    assert f"(1): {place}" in said(survey.warnings, "image-panorama")


def test_what_is_no_panorama_stays(photos: Path) -> None:
    """The parts of one; a wide crop; a namespace that is named and not used, as DJI's; a telephone of 2:1."""
    write(photos / "PANO/PANO_0001.jpg", picture(20), exif(20))
    write(photos / "images/wide.jpg", picture(21, (160, 72)), exif(21))
    write(photos / "images/dji.jpg", picture(22), exif(22), xmp=gpano())
    for number in range(30, 34):
        write(photos / f"phone/{number}.jpg", picture(number, (120, 60)), exif(number, "Telephone"))
    survey = ingest(photos)
    assert len(names(survey)) == COUNT + 7 and "image-panorama" not in codes(survey.warnings)


def test_a_folder_of_panoramas_is_refused(tmp_path: Path) -> None:
    for number in range(COUNT):
        write(tmp_path / f"photos/R{number}.JPG", picture(number, (120, 60)), exif(number, "RICOH THETA Z1"))
    with refused("only-panoramas", InputError):
        ingest(tmp_path / "photos")


def detailed(number: int, contrast: float) -> np.ndarray:
    """A scene with detail of all scales, forest (contrast 40) or water (4)."""
    rng, pixels = np.random.default_rng(number), np.zeros((480, 640))
    for scale in (2, 4, 8, 16):
        pixels += cv2.resize(rng.normal(size=(480 // scale, 640 // scale)), (640, 480))
    return np.asarray(np.clip(120 + contrast / 2 * pixels, 0, 255).astype(np.uint8))


def moved(pixels: np.ndarray, by_px: int) -> np.ndarray:
    """As a camera that moves during the exposure sees it."""
    return np.asarray(cv2.blur(pixels, (by_px, 1)))


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_blurred_photographs_are_left_out_on_request(tmp_path: Path, suffix: str) -> None:
    """Moved by 40 px, and out of focus; a lake between forests is no blur, nor are 6 px of motion."""
    for number in range(16):
        pixels = detailed(number, 4.0 if 5 <= number < 11 else 40.0)
        pixels = moved(pixels, {2: 40, 13: 6}.get(number, 1))
        pixels = cv2.GaussianBlur(pixels, (0, 0), 12.0) if number == 7 else pixels
        path = tmp_path / f"photos/IMG_{number:02d}.{suffix}"
        if suffix == "jpg":
            write(path, pixels, exif(number), quality=95)
        else:
            path.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(path), pixels.astype(np.uint16) * 257 if suffix == "png" else pixels)
    positions = "".join(f"IMG_{n:02d}.{suffix},46.0,{7 + 1e-4 * n:.6f},500\n" for n in range(16))
    (tmp_path / "fixes.csv").write_text("image,lat,lon,alt\n" + positions)
    options = {"trajectory": tmp_path / "fixes.csv"} if suffix != "jpg" else {}
    every = ingest(tmp_path / "photos", **options)
    assert len(every.images) == 16 and "photographs-blurred" not in codes(every.warnings)
    sharpness = {image.name: image.sharpness for image in every.images}
    assert {name for name, value in sharpness.items() if value is not None and value < 0.5} == {
        f"IMG_{number:02d}.{suffix}" for number in (2, 7)
    }
    sharp = ingest(tmp_path / "photos", skip_blurred=True, **options)
    names = {image.name for image in every.images} - {image.name for image in sharp.images}
    assert names == {f"IMG_02.{suffix}", f"IMG_07.{suffix}"}
    assert "(2)" in said(sharp.warnings, "photographs-blurred") and "IMG_02" in said(
        sharp.warnings, "photographs-blurred"
    )
