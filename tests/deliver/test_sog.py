"""Streamed SOG: every Gaussian once in level 0, at its true place by the sidecar; coarser levels in one tree."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.products import load_json
from pipelines.deliver import sog
from pipelines.deliver.options import ExportSogOptions
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from tests.delivered_scenes import splat_arrays, true_ecef, write_trained
from tests.sog_files import read_sog


def leaves(node: dict[str, Any]) -> list[dict[str, Any]]:
    below = node.get("children", [])
    for child in below:
        for side, sign in (("min", 1), ("max", -1)):
            outside = sign * (np.array(child["bound"][side]) - node["bound"][side])
            assert (outside >= 0).all()
    return [leaf for child in below for leaf in leaves(child)] if below else [node]


@pytest.mark.parametrize("up", ["-y", "y"])
def test_every_gaussian_is_at_its_true_place(tmp_path: Path, up: Any) -> None:
    """Rounded by no more than is told, which is a part of the scene's 16 m, and a float's step."""
    splat = splat_arrays()
    stage = write_trained(tmp_path / "ws", splat, "sog")
    summary = sog.run(stage, ExportSogOptions(up=up))
    index = stage.out / "lod-meta.json"
    document = json.loads(index.read_text())
    assert (document["version"], document["counts"], document["filenames"]) == (1, [40], ["0_0/meta.json"])
    placed = load_json(GeorefSidecar, sidecar_path(index)).ecef_from_file().apply(read_sog(stage.out / "0_0").means)
    apart_m = np.linalg.norm(placed[:, None] - true_ecef(splat), axis=2)
    assert sorted(apart_m.argmin(axis=1)) == list(range(40))
    rounding_m = summary.values["rounding_m"]
    assert 0 < rounding_m < 0.003 and np.sort(apart_m.min(axis=1))[-2] < np.sqrt(3) * rounding_m + 1e-4


def test_levels_share_a_tree_whose_leaves_name_their_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sog, "_MOST_IN_LEAF", 50)
    monkeypatch.setattr(sog, "MOST_IN_UNIT", 150)
    monkeypatch.setattr(sog, "_LEAST_IN_LEVEL", 60)
    splat = splat_arrays(1000)
    stage = write_trained(tmp_path / "ws", splat, "sog")
    levels = sog.run(stage, ExportSogOptions(sh_degree=0)).values["levels"]
    document = json.loads((stage.out / "lod-meta.json").read_text())
    assert document["counts"] == levels and levels[0] == 1000 and document["lodLevels"] == len(levels) >= 3
    assert all(finer >= 2 * coarser for finer, coarser in itertools.pairwise(levels))
    units = [read_sog((stage.out / name).parent) for name in document["filenames"]]
    used = [np.zeros(len(unit), np.int64) for unit in units]
    shown = [0] * len(levels)
    for leaf in leaves(document["tree"]):
        assert leaf["lods"]["0"]["count"] <= 50
        for level, rows in leaf["lods"].items():
            part = slice(rows["offset"], rows["offset"] + rows["count"])
            used[rows["file"]][part] += 1
            shown[int(level)] += rows["count"]
            places = units[rows["file"]].means[part]
            low, high = (np.array(leaf["bound"][side]) for side in ("min", "max"))
            assert ((places >= low - 0.01) & (places <= high + 0.01)).all()
    assert shown == levels and all((count == 1).all() for count in used)
    assert max(map(len, units)) <= 150 and len(units) < len(leaves(document["tree"]))
    assert {name.partition("_")[0] for name in document["filenames"]} == {str(n) for n in range(len(levels))}
