"""Masks of photographs: which file is whose, the sky of a drawn picture, and what masked pixels no longer do."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT
from pipelines.formats.colmap import quiet_colmap
from pipelines.geometry.cameras import Camera, distort
from pipelines.ingest.masks import mask_files, sky_pixels, write_masks
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.remarks import Remarks
from pipelines.sfm.features import SfmJob, extract_features
from pipelines.sfm.options import SfmOptions
from pipelines.survey.photographs import ImageCache, Photograph
from pipelines.survey.survey import Attitude, Survey
from tests.refusals import codes, numbers, refused
from tests.sfm_scenes import HEIGHT, WIDTH, survey_of

NAMES = ["a.png", "sub/b.png", "sub/c.png"]


@pytest.fixture
def textured(tmp_path: Path) -> Survey:
    """Three photographs full of texture, without masks; the folder is `tmp_path / "photos"`."""
    random = np.random.default_rng(3)
    for name in NAMES:
        path = tmp_path / "photos" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        coarse = random.integers(0, 255, (HEIGHT // 6, WIDTH // 6), np.uint8)
        cv2.imwrite(str(path), cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC))
    return survey_of(NAMES)


def _write(path: Path, mask: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.where(mask, 255, 0).astype(np.uint8))
    return path


def _half() -> np.ndarray:
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[:, : WIDTH // 2] = False
    return mask


def test_masks_are_found_by_their_photographs_names(tmp_path: Path) -> None:
    for name in ("a.png.png", "sub/c.png", "other.png"):
        _write(tmp_path / "masks" / name, _half())
    remarks = Remarks()
    everywhere = _write(tmp_path / "legs.png", _half())
    found = mask_files(IngestOptions(masks=tmp_path / "masks"), NAMES, remarks)
    assert {name: [path.name for path in files] for name, files in found.items()} == {
        "a.png": ["a.png.png"],
        "sub/c.png": ["c.png"],
    }
    assert codes(remarks.warnings) == ["mask-without-photograph"]
    found = mask_files(IngestOptions(masks=tmp_path / "masks", mask=everywhere), NAMES, remarks)
    assert [len(found[name]) for name in NAMES] == [2, 1, 2]


def test_unusable_masks_are_refused(textured: Survey, tmp_path: Path) -> None:
    with refused("no-mask-matches", InputError):
        (tmp_path / "none").mkdir()
        mask_files(IngestOptions(masks=tmp_path / "none"), NAMES, Remarks())

    def write(mask: np.ndarray) -> None:
        options = IngestOptions(mask=_write(tmp_path / "mask.png", mask))
        write_masks(textured, options, tmp_path / "photos", tmp_path / "out")

    with refused("mask-size", InputError) as error:
        write(_half()[:-1])
    assert numbers(error.value.message) == [WIDTH, HEIGHT - 1, WIDTH, HEIGHT]
    with refused("mask-leaves-nothing", InputError):
        write(np.zeros((HEIGHT, WIDTH), dtype=bool))


def test_masked_pixels_have_no_features(textured: Survey, tmp_path: Path) -> None:
    """Also in subfolders, where COLMAP looks for whole names; photographs without a mask have all."""
    options = IngestOptions(masks=_write(tmp_path / "masks/sub/b.png.png", _half()).parent.parent)
    survey = write_masks(textured, options, tmp_path / "photos", tmp_path / "ingest/masks")
    assert [bool(image.mask_sha256) for image in survey.images] == [False, True, False]
    sfm = SfmOptions(max_features=500, threads=1)
    job = SfmJob(survey, tmp_path / "photos", tmp_path / "database.db", sfm, tmp_path / "ingest/masks")
    with quiet_colmap() as colmap:
        extract_features(colmap, job, range(3), SILENT)
    columns = dict(_columns(job.database))
    assert all(len(column) > 20 for column in columns.values())
    assert columns["sub/b.png"].min() > WIDTH // 2 - 1
    assert columns["a.png"].min() < WIDTH // 4


def _columns(database: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the x of all keypoints of each photograph."""
    query = "select images.name, rows, cols, data from keypoints join images using (image_id)"
    with closing(sqlite3.connect(database)) as rows:
        for name, count, width, data in rows.execute(query).fetchall():
            yield name, np.frombuffer(data, np.float32).reshape(count, width)[:, 0]


def test_masked_pixels_count_nowhere_in_undistorted_photographs(tmp_path: Path) -> None:
    """A pixel counts if none of the rays around it is masked; the truth is the lens's own projection."""
    lens = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([200.0, 120.0, 90.0, -0.12]))
    cv2.imwrite(str(tmp_path / "a.png"), np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    hole = np.ones((HEIGHT, WIDTH), dtype=bool)
    hole[30:70, 150:200] = False
    plain = Photograph("a.png", tmp_path / "a.png", lens)
    masked = Photograph("a.png", tmp_path / "a.png", lens, mask=_write(tmp_path / "a.mask.png", hole))
    cache = ImageCache(tmp_path / "cache", [plain, masked], WIDTH)
    covered, counting, pinhole = np.array(cache.mask(0)), np.array(cache.mask(1)), cache.pinhole(1)
    u, v = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    seen = distort(lens, np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy], axis=-1))
    x, y = seen[..., 0], seen[..., 1]
    assert not counting[(x > 150) & (x < 200) & (y > 30) & (y < 70)].any()
    away = (x < 149) | (x > 201) | (y < 29) | (y > 71)
    assert (counting == covered)[away].all()
    assert cache.is_masked(1) and not cache.is_masked(0)


def test_the_sky_above_a_skyline_is_masked(textured: Survey, tmp_path: Path) -> None:
    """Blue that pales towards the horizon, a white cloud, trees and a red roof before it: the skyline is known."""
    random = np.random.default_rng(1)
    picture = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    rows = np.linspace(0, 1, HEIGHT)[:, None]
    picture[:] = np.stack([230 + 0 * rows, 150 + 60 * rows, 90 + 100 * rows], axis=-1).astype(np.uint8)
    cv2.ellipse(picture, (170, 25), (40, 12), 0, 0, 360, (250, 250, 250), -1)
    picture = cv2.GaussianBlur(picture, (9, 9), 0)
    skyline = 80 + (12 * np.sin(np.arange(WIDTH) / 9)).astype(int)
    ground = np.arange(HEIGHT)[:, None] > skyline
    leaves = np.stack([random.integers(20, 90, ground.shape), random.integers(60, 160, ground.shape)], axis=-1)
    picture[ground] = np.concatenate([leaves, leaves[..., :1]], axis=-1)[ground].astype(np.uint8)
    roof = (slice(60, 110), slice(100, 140))
    picture[roof], ground[roof] = (60, 70, 190), True
    found = sky_pixels(picture, np.arange(HEIGHT)[:, None] < np.full((1, WIDTH), 120))
    assert found[~ground].mean() > 0.97
    assert found[ground].mean() < 0.06  # a rim of two pixels
    # Level to the north, up by nothing: the horizon is the middle row.
    level = Attitude(quat_xyzw=(-(0.5**0.5), 0.0, 0.0, 0.5**0.5), sigma_deg=1.0, source="csv")
    cv2.imwrite(str(tmp_path / "photos/a.png"), picture)
    images = (textured.images[0].model_copy(update={"attitude": level}), *textured.images[1:])
    survey = textured.model_copy(update={"images": images})
    survey = write_masks(survey, IngestOptions(mask_sky=True), tmp_path / "photos", tmp_path / "out")
    assert codes(survey.warnings) == ["sky-without-attitude"]
    written = cv2.imread(str(tmp_path / "out/a.png.png"), cv2.IMREAD_GRAYSCALE)
    assert (written[~ground] == 0).mean() > 0.95 and (written[ground] == 0).mean() < 0.06
