"""Fingerprints of what a stage reads: of a whole product, or of the part of it that decides."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pipelines.core.errors import MissingProductError
from pipelines.core.fingerprints import fingerprints
from pipelines.core.options import StageOptions
from pipelines.core.product_parts import ProductPart
from pipelines.core.stages import APPLIED_RIG, MEASURED, PHOTOGRAPHS, RIG, SURVEY, TRACK, StageSpec
from pipelines.core.workspace import Workspace

FIX = {"position_in_geo": [1.0, 2.0, 3.0], "cov_in_geo": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
IMAGES: list[dict[str, Any]] = [
    {"name": "a.jpg", "camera_id": 1, "sha256": "0", "fix": FIX, "attitude": None, "split": "train"},
    {"name": "b.jpg", "camera_id": 1, "sha256": "1", "fix": None, "attitude": None, "split": "test"},
]
SURVEYED = {"image_dir": "/photos", "cameras": [{"camera_id": 1}], "images": IMAGES, "control_points": []}
ESTIMATE = {"name": "boresight", "value": [1.0, 0.0, 0.0], "start": [0.0, 0.0, 0.0], "sigma": [0.1, 0.1, 0.1]}


class Look:
    """Hashes of one part in a workspace, as its files are now."""

    def __init__(self, root: Path, part: ProductPart) -> None:
        self.workspace = Workspace(root)
        self.spec = StageSpec("stage", "", "", (part,), "stage/product")

    def write(self, product: str, document: Any) -> None:
        path = self.workspace.root / product
        path.parent.mkdir(exist_ok=True)
        path.write_text(document if isinstance(document, str) else json.dumps(document))

    def hashes(self) -> dict[str, str]:
        return fingerprints(self.workspace, self.spec, StageOptions(), {}).hashes


@pytest.fixture
def photographs(tmp_path: Path) -> Look:
    look = Look(tmp_path, PHOTOGRAPHS)
    look.write(SURVEY, SURVEYED)
    return look


@pytest.fixture
def applied(tmp_path: Path) -> Look:
    return Look(tmp_path, APPLIED_RIG)


def with_image(**changes: Any) -> dict[str, Any]:
    return {**SURVEYED, "images": [{**IMAGES[0], **changes}, IMAGES[1]]}


@pytest.mark.parametrize(
    "document",
    [
        {**SURVEYED, "control_points": [{"name": "P1"}], "estimate": ["boresight"]},
        {**SURVEYED, "image_dir": "/others"},
        with_image(split="test"),
        with_image(fix={**FIX, "cov_in_geo": [[4, 0, 0], [0, 4, 0], [0, 0, 4]]}),
        with_image(timestamp_s=5.0),
        dict(reversed(SURVEYED.items())),
    ],
    ids=["control points", "folder", "split", "covariance", "time", "order of keys"],
)
def test_nothing_but_the_fields_counts(photographs: Look, document: dict[str, Any]) -> None:
    before = photographs.hashes()
    photographs.write(SURVEY, document)
    assert photographs.hashes() == before


@pytest.mark.parametrize(
    "document",
    [
        {**SURVEYED, "cameras": [{"camera_id": 1, "width": 4}]},
        {**SURVEYED, "images": IMAGES[:1]},
        with_image(name="c.jpg"),
        with_image(sha256="2"),
        with_image(fix=None),
        with_image(fix={**FIX, "position_in_geo": [1.0, 2.0, 4.0]}),
        with_image(attitude={"quat_xyzw": [0, 0, 0, 1]}),
    ],
    ids=["cameras", "images", "name", "content", "no fix", "position", "attitude"],
)
def test_each_field_counts(photographs: Look, document: dict[str, Any]) -> None:
    before = photographs.hashes()
    photographs.write(SURVEY, document)
    after = photographs.hashes()
    assert list(after) == [SURVEY] and after != before


def test_place_and_messages_of_a_survey_do_not_count(tmp_path: Path) -> None:
    """All stages but `sfm` read the whole survey, of which these fields change no result."""
    look = Look(tmp_path, MEASURED)
    look.write(SURVEY, SURVEYED)
    before = look.hashes()
    look.write(SURVEY, {**SURVEYED, "image_dir": "/others", "warnings": ["one"], "assumptions": ["two"]})
    assert look.hashes() == before
    look.write(SURVEY, {**SURVEYED, "control_points": [{"name": "P1"}]})
    assert look.hashes() != before


@pytest.mark.parametrize("text", ["{", "[]", '{"other": 1}', "[" * 100_000], ids=["cut", "list", "other", "deep"])
def test_a_product_of_another_form_counts_as_a_whole(photographs: Look, text: str) -> None:
    """The stage that reads it says what is wrong; until then any change of it counts."""
    photographs.write(SURVEY, text)
    before = photographs.hashes()
    photographs.write(SURVEY, text + " ")
    assert photographs.hashes() != before


def test_a_missing_product_is_told(tmp_path: Path) -> None:
    with pytest.raises(MissingProductError) as error:
        Look(tmp_path, PHOTOGRAPHS).hashes()
    assert error.value.product == SURVEY


class TestOptionalPart:
    def test_without_a_value_it_counts_as_not_there(self, applied: Look) -> None:
        applied.workspace.root.mkdir(exist_ok=True)
        assert applied.hashes() == {}
        applied.write(TRACK, "navigation")
        applied.write(RIG, {"applied": [], "not_applied": [ESTIMATE], "images": 5})
        assert applied.hashes() == {}

    def test_with_a_value_it_counts_and_brings_the_navigation(self, applied: Look) -> None:
        applied.write(RIG, {"applied": [ESTIMATE]})
        alone = applied.hashes()
        assert list(alone) == [RIG]
        applied.write(TRACK, "navigation")
        both = applied.hashes()
        assert set(both) == {RIG, TRACK} and both[RIG] == alone[RIG]
        applied.write(TRACK, "another")
        assert applied.hashes()[TRACK] != both[TRACK]

    def test_what_stands_beside_the_value_does_not_count(self, applied: Look) -> None:
        applied.write(RIG, {"applied": [ESTIMATE]})
        before = applied.hashes()
        applied.write(RIG, {"applied": [{**ESTIMATE, "sigma": [0.2, 0.2, 0.2]}], "images": 7})
        assert applied.hashes() == before
        applied.write(RIG, {"applied": [{**ESTIMATE, "value": [1.0, 0.0, 0.1]}]})
        assert applied.hashes() != before

    def test_a_damaged_file_counts_as_a_whole(self, applied: Look) -> None:
        applied.write(RIG, "{")
        assert list(applied.hashes()) == [RIG]
