"""Cautions: their form, and their way through the manifests."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import pytest
from pydantic import ValidationError

from pipelines.core.products import Remark, union
from pipelines.core.stages import BY_NAME
from pipelines.core.staleness import cautions_by_stage
from pipelines.core.workspace import Manifest, Workspace

SHIFT = Remark(code="fixes-shifted", sentence="All fixes are 1.2 m too high.")
FEW = Remark(code="few-points", sentence="Nothing checks the height.")


def put(workspace: Workspace, stage: str, *cautions: Remark) -> None:
    """Write the manifest of a stage."""
    folder = workspace.root / BY_NAME[stage].folder
    folder.mkdir(parents=True)
    manifest = Manifest(
        stage=stage,
        config={},
        inputs={},
        versions={},
        started=datetime.now(UTC),
        duration_s=1.0,
        key_figure="",
        values={},
        warnings=[],
        cautions=cautions,
    )
    (folder / "manifest.json").write_text(manifest.model_dump_json())


@pytest.mark.parametrize("code", ["", "Fixes", "fixes shifted", "fixes_shifted", "-fixes", "fixes--shifted"])
def test_codes_are_kebab_case(code: str) -> None:
    with pytest.raises(ValidationError):
        Remark(code=code, sentence="It is so.")


def test_union_keeps_the_order_and_each_once() -> None:
    assert union((SHIFT,), (FEW, SHIFT), (FEW,)) == (SHIFT, FEW)


def test_each_caution_is_of_the_first_stage_that_has_it(workspace: Workspace) -> None:
    put(workspace, "init-sim3", SHIFT)
    put(workspace, "train", SHIFT, FEW)
    put(workspace, "export-ply", SHIFT, FEW)
    assert cautions_by_stage(workspace) == {"init-sim3": (SHIFT,), "train": (FEW,)}


def test_caution_of_a_product_without_manifest_is_shown_downstream(workspace: Workspace) -> None:
    put(workspace, "train", SHIFT)
    assert cautions_by_stage(workspace) == {"train": (SHIFT,)}


def test_manifest_from_before_has_none(workspace: Workspace) -> None:
    put(workspace, "train")
    path = workspace.root / "train/manifest.json"
    document = json.loads(path.read_text())
    del document["cautions"]
    path.write_text(json.dumps(document))
    assert workspace.manifest(BY_NAME["train"]) is not None
    assert cautions_by_stage(workspace) == {}


def test_damaged_manifest_hides_no_other(workspace: Workspace) -> None:
    put(workspace, "init-sim3", SHIFT)
    put(workspace, "train", FEW)
    (workspace.root / "train/manifest.json").write_text("{")
    assert cautions_by_stage(workspace) == {"init-sim3": (SHIFT,)}
