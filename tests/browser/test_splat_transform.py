"""PlayCanvas' splat-transform, from npm, reads PLY, SPZ of version 4 and streamed SOG as they were meant.

It works on a processor: the library of its graphics card is left out. It takes Gaussians of all three along the
axes of the file, and tells them as a table.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipelines.deliver import sog
from pipelines.deliver.options import ExportPlyOptions, ExportSogOptions, ExportSpzOptions
from pipelines.deliver.ply import run as export_ply
from pipelines.deliver.spz import run as export_spz
from pipelines.formats.splat_ply import read_splat_ply
from tests.browser.chromium import LIBRARIES, MissingProgramError
from tests.delivered_scenes import splat_arrays, write_trained

pytestmark = pytest.mark.browser
SPLAT = splat_arrays(400)
_NO_GPU = "export const globals = {}; export const create = () => { throw new Error('no GPU'); };"


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the command of splat-transform."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is missing, which runs splat-transform: `apt-get install nodejs`")
    try:
        library = LIBRARIES["SplatTransform"].folder()
    except MissingProgramError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("splat-transform")
    shutil.copytree(library, folder, dirs_exist_ok=True)
    gpu = folder / "node_modules/webgpu"
    gpu.mkdir(parents=True)
    (gpu / "package.json").write_text('{"name": "webgpu", "type": "module", "main": "index.js"}')
    (gpu / "index.js").write_text(_NO_GPU)
    return [node, str(folder / "bin/cli.mjs")]


def table(program: list[str], file: Path) -> dict[str, np.ndarray]:
    """Return the columns of a file as the program reads them."""
    out = file.parent / "read.csv"
    command = [*program, "--overwrite", str(file), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr + done.stdout
    rows = np.genfromtxt(out, delimiter=",", names=True)
    return {name: rows[name] for name in rows.dtype.names or ()}


def means(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([columns[axis] for axis in "xyz"], axis=1)


def same_gaussians(columns: dict[str, np.ndarray], splat_ply: Path, atol_m: float) -> None:
    """Every Gaussian of a PLY is there, with its scale, colour and harmonics within the steps of SPZ."""
    truth = read_splat_ply(splat_ply)
    apart_m = np.abs(means(columns)[:, None] - truth.means).max(axis=2)
    nearest = apart_m.argmin(axis=1)
    assert sorted(nearest) == list(range(len(truth))) and apart_m.min(axis=1).max() < atol_m
    scales = np.stack([columns[f"scale_{axis}"] for axis in range(3)], axis=1)
    np.testing.assert_allclose(scales, truth.log_scales[nearest], rtol=0, atol=1 / 32 + 1e-5)
    np.testing.assert_allclose(columns["f_dc_1"], truth.sh[nearest, 0, 1], rtol=0, atol=0.0132)
    np.testing.assert_allclose(columns["f_rest_2"], truth.sh[nearest, 3, 0], rtol=0, atol=0.0314)
    quats = np.stack([columns[f"rot_{part}"] for part in range(4)], axis=1)
    unit = truth.quats_wxyz[nearest] / np.linalg.norm(truth.quats_wxyz[nearest], axis=1, keepdims=True)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    assert np.abs((quats * unit).sum(axis=1)).min() > 0.9999


@pytest.fixture(scope="module")
def plys(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """PLYs of one model by the axis that points up."""
    folder = tmp_path_factory.mktemp("plys")
    found = {}
    for up in ("y", "-y"):
        stage = write_trained(folder / up / "ws", SPLAT, "export")
        export_ply(stage, ExportPlyOptions(up=up))  # type: ignore[arg-type]
        found[up] = stage.out / "splat.ply"
    return found


def test_ply_is_read(program: list[str], plys: dict[str, Path]) -> None:
    same_gaussians(table(program, plys["-y"]), plys["-y"], 1e-5)


def test_spz_of_version_4_is_read_beside_its_georeference(
    program: list[str], plys: dict[str, Path], tmp_path: Path
) -> None:
    """Its axes are right, up, back; steps are 2^-12 m."""
    stage = write_trained(tmp_path / "ws", SPLAT, "spz")
    export_spz(stage, ExportSpzOptions(spz_version="4", embed_georeference=True))
    same_gaussians(table(program, stage.out / "splat.spz"), plys["y"], 0.51 / 4096 + 1e-5)


def test_streamed_sog_is_read(
    program: list[str], plys: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many levels and units, the program reads the finest level whole."""
    monkeypatch.setattr(sog, "_MOST_IN_LEAF", 60)
    monkeypatch.setattr(sog, "MOST_IN_UNIT", 150)
    monkeypatch.setattr(sog, "_LEAST_IN_LEVEL", 60)
    stage = write_trained(tmp_path / "ws", SPLAT, "sog")
    summary = sog.run(stage, ExportSogOptions())
    assert len(summary.values["levels"]) > 1 and summary.values["units"] > 3
    same_gaussians(table(program, stage.out / "lod-meta.json"), plys["-y"], 0.005)
