"""Photographs of more than eight bits: one place has one brightness in all, and none is nearly black."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.survey.photographs import decoded_photograph
from pipelines.survey.survey import Survey
from tests.refusals import codes, said

SIZE = (48, 64)
COUNT = 3


def _scene(number: int) -> np.ndarray:
    """Reflectances of 0 to 1, of which each photograph sees more."""
    values = np.random.default_rng(7).random(SIZE)
    return np.asarray(values * (number + 1) / COUNT)


def _survey(tmp_path: Path, pictures: list[np.ndarray], suffix: str) -> tuple[Survey, list[np.ndarray]]:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, picture in enumerate(pictures):
        assert cv2.imwrite(str(folder / f"a{number}{suffix}"), picture)
    rows = [f"a{number}{suffix} {7.0 + number * 1e-4} 46.0 900" for number in range(len(pictures))]
    (tmp_path / "geo.txt").write_text("EPSG:4326\n" + "\n".join(rows) + "\n")
    workspace = Workspace(tmp_path / "ws")
    options = {"images": folder, "geo": tmp_path / "geo.txt", "vertical": "ellipsoidal", "focal_px": 60.0}
    run_stage(workspace, BY_NAME["ingest"], options)
    survey = load_json(Survey, workspace.path(SURVEY))
    root = workspace.root / survey.image_dir
    found = [decoded_photograph(root / image.name, image.sha256) for image in survey.images]
    return survey, [picture[..., 0] for picture in found if picture is not None]


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_bits_in_use_fill_eight(tmp_path: Path, bits: int, suffix: str) -> None:
    """A hot pixel in one photograph decides nothing."""
    pictures = [(_scene(number) * (2**bits - 1)).astype(np.uint16) for number in range(COUNT)]
    large = np.kron(pictures[0], np.ones((4, 4), np.uint16))
    large[0, 0] = 65535
    pictures = [large, *(np.kron(picture, np.ones((4, 4), np.uint16)) for picture in pictures[1:])]
    survey, found = _survey(tmp_path, pictures, suffix)
    assert f"{bits} bits" in said(survey.assumptions, "image-bit-depth")
    assert survey.original_dir == str((tmp_path / "photos").resolve())
    assert {each.name: each.sha256 for each in survey.originals} == {
        file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in (tmp_path / "photos").iterdir()
    }
    for number, picture in enumerate(found):
        expected = _scene(number) * 255
        # Rounded to 2^bits − 1 steps, cut off below, and to 255 steps.
        assert np.abs(picture[2::4, 2::4].astype(float) - expected).max() < 0.5 + 255 / 2**bits + 0.01


@pytest.mark.parametrize("kind", ["centikelvin", "celsius"])
def test_temperatures_fill_eight_bits_by_one_scale(tmp_path: Path, kind: str) -> None:
    """Of 14 K of ground, in 16-bit hundredths of a kelvin and in floating-point degrees."""
    celsius = [5.0 + 14.0 * _scene(number) for number in range(COUNT)]
    pictures = (
        [((one + 273.15) * 100).astype(np.uint16) for one in celsius]
        if kind == "centikelvin"
        else [one.astype(np.float32) for one in celsius]
    )
    _, found = _survey(tmp_path, pictures, ".tif")
    low, high = min(one.min() for one in celsius), max(one.max() for one in celsius)
    for one, picture in zip(celsius, found, strict=True):
        # A step of the file is 0.01 K, and one of eight bits 14 K / 255.
        assert np.abs(picture.astype(float) - (one - low) / (high - low) * 255).max() < 0.5 + 0.02 / 14 * 255


def test_sixteen_and_eight_bits_stay_as_they_are(tmp_path: Path) -> None:
    pictures = [(_scene(number) * 65535).astype(np.uint16) for number in range(COUNT)]
    survey, _ = _survey(tmp_path, pictures, ".png")
    assert survey.image_dir == str((tmp_path / "photos").resolve())
    assert survey.original_dir is None and not survey.originals
    assert "image-bit-depth" not in codes(survey.assumptions)
