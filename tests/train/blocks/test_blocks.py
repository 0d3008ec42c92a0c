"""A field trained in two blocks, by the command that people give, with jobs that run in this process."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.core.products import load_json
from pipelines.core.stages import BLOCK_GAUSSIANS, BLOCK_PLAN, BLOCK_RECORD, BLOCK_TRAINING, GAUSSIANS, MODEL
from pipelines.core.staleness import status
from pipelines.core.workspace import Workspace
from pipelines.splat.gaussians import read_gaussians
from pipelines.survey.block_plan import BlockPlan, BlockRecord, BlockTraining
from pipelines.survey.solution import TrainedModel, read_trained
from pipelines.train.estimate import estimate_training
from pipelines.train.options import TrainOptions
from tests.block_scenes import georef, make_field, write_field
from tests.threads import single_thread

OPTIONS = (
    "--max-gaussians",
    1500,
    "--max-image-size",
    96,
    "--sh-degree",
    0,
    "--no-geometry-regularisation",
    "--no-dense",
)
SHORT = (*OPTIONS, "--iterations", 60, "--checkpoint-every", 20)


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A workspace of the field, ready to train."""
    return write_field(tmp_path_factory.mktemp("field"), make_field(5, 3, points=400, test_views=(7,)))


@pytest.fixture(scope="module")
def trained(field: Workspace) -> Iterator[tuple[Workspace, list[str]]]:
    """The field trained in two blocks, and the jobs that did it."""
    code, jobs = georef("train", field.root, "--blocks", 2, *SHORT)
    assert code == 0
    yield field, jobs


def test_lidar_is_refused_before_any_work(
    field: Workspace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = tmp_path / "cloud.ply"
    cloud.write_bytes(b"ply\n")
    code, jobs = georef("train", field.root, "--part", "plan", "--blocks", 2, "--lidar", cloud)
    assert (code, jobs) == (2, [])
    assert "a training in blocks does not use LiDAR" in " ".join(capsys.readouterr().err.split())
    assert estimate_training(9, (96, 72), TrainOptions(blocks=2, lidar=cloud)).refusal
    assert not estimate_training(9, (96, 72), TrainOptions(blocks=1, lidar=cloud)).refusal


def test_each_gaussian_is_that_of_its_cell(trained: tuple[Workspace, list[str]]) -> None:
    workspace, jobs = trained
    assert jobs[0] == "scaffold"
    assert sorted(jobs[1:3]) == ["block 0", "block 1"]
    assert jobs[3:] == ["seams"]
    plan = load_json(BlockPlan, workspace.root / "blocks" / BLOCK_PLAN)
    merged = read_gaussians(workspace.path(GAUSSIANS)).means.numpy()
    expected = 0
    for block in plan.blocks:
        own = read_gaussians(workspace.root / "blocks" / str(block.id) / BLOCK_GAUSSIANS).means.double().numpy()
        inside = block.cell.contains(own)
        expected += int(inside.sum())
        # A block is trained beyond its cell, and the merged model takes nothing from there.
        assert 0.3 * len(own) < inside.sum() < len(own)
    assert len(merged) == expected
    assert load_json(TrainedModel, workspace.path(MODEL)).gaussians == expected


def test_the_merged_model_shows_the_field(trained: tuple[Workspace, list[str]]) -> None:
    """Its product is that of `train`: evaluation reads it, and finds a photograph that nobody trained on."""
    workspace, _ = trained
    assert georef("evaluate", workspace.root)[0] == 0
    report = json.loads((workspace.root / "evaluate/report.json").read_text())
    # Grey for all would give 11 dB: the colours of the patches lie evenly between 0.1 and 0.9.
    assert report["photometric"]["test"]["psnr"] > 16
    assert read_trained(workspace).max_image_size == 96
    states = {row.stage: row.state for row in status(workspace)}
    assert (states["train"], states["evaluate"]) == ("current", "current")


def test_neighbours_are_compared(trained: tuple[Workspace, list[str]]) -> None:
    workspace, _ = trained
    (seam,) = load_json(BlockRecord, workspace.path(BLOCK_RECORD)).seams
    assert seam.blocks == (0, 1)
    assert seam.pixels > 500
    # Both have seen the same photographs of the same ground, 40 m below: they agree to some per cent of that.
    assert abs(seam.depth_median_m) < 0.5
    assert 0 < seam.depth_nmad_m < 2.0
    assert seam.colour_rms < 0.2


def test_nothing_is_done_twice(trained: tuple[Workspace, list[str]]) -> None:
    workspace, _ = trained
    before = (workspace.root / "blocks/1/block/manifest.json").read_bytes()
    assert georef("train", workspace.root) == (0, [])
    assert georef("train", workspace.root, "--part", 1) == (0, [])
    assert georef("train", workspace.root) == (0, [])
    assert (workspace.root / "blocks/1/block/manifest.json").read_bytes() == before


def test_a_missing_block_is_trained_again(trained: tuple[Workspace, list[str]], tmp_path: Path) -> None:
    """Of all that there is, only the block that is missing, once the merged model is to be made anew."""
    workspace = copy_of(trained[0], tmp_path)
    whole = read_gaussians(workspace.path(GAUSSIANS))
    shutil.rmtree(workspace.root / "blocks/0")
    assert georef("train", workspace.root) == (0, [])  # the model is whole without the blocks that it is made of
    shutil.rmtree(workspace.root / "train")
    code, jobs = georef("train", workspace.root)
    assert (code, jobs) == (0, ["block 0"])  # its Gaussians are the same: the seams are still current
    again = read_gaussians(workspace.path(GAUSSIANS))
    np.testing.assert_array_equal(again.means.numpy(), whole.means.numpy())


def test_a_block_that_was_trained_again_is_merged_anew(
    trained: tuple[Workspace, list[str]], tmp_path: Path
) -> None:
    workspace = copy_of(trained[0], tmp_path)
    before = load_json(BlockRecord, workspace.path(BLOCK_RECORD)).blocks[1].training
    assert georef("train", workspace.root, "--part", 1, "--force") == (0, [])
    again = load_json(BlockTraining, workspace.root / "blocks/1" / BLOCK_TRAINING)
    assert again != before  # another duration at least
    assert georef("train", workspace.root)[0] == 0
    assert load_json(BlockRecord, workspace.path(BLOCK_RECORD)).blocks[1].training == again
    assert georef("train", workspace.root) == (0, [])


def test_an_interrupted_block_goes_on(trained: tuple[Workspace, list[str]], tmp_path: Path) -> None:
    """Killed after a checkpoint, a block continues from there, and ends where it would have ended."""
    workspace = copy_of(trained[0], tmp_path)
    block = workspace.root / "blocks/1/block"
    expected = read_gaussians(block / "gaussians.ply")
    shutil.rmtree(block)
    with single_thread(), pytest.MonkeyPatch.context() as patch:
        stop_after(patch, 45)
        assert boundary.guarded(cli, ["train", str(workspace.root), "--part", "1", "--quiet"]) == 130
    partial = workspace.root / "blocks/1/block.partial"
    assert (partial / "progress.txt").read_text().startswith("45 of 60 iterations")
    assert georef("train", workspace.root, "--part", 1)[0] == 0
    found = read_gaussians(block / "gaussians.ply")
    for name, values in expected.tensors().items():
        torch.testing.assert_close(found.tensors()[name], values, rtol=0, atol=0)


def test_a_block_that_is_not_planned(trained: tuple[Workspace, list[str]]) -> None:
    assert georef("train", trained[0].root, "--part", 9)[0] == 2
    assert georef("train", trained[0].root, "--part", "sow")[0] == 2
    assert georef("train", trained[0].root, "--part", 1, "--iterations", 10)[0] == 2  # the plan takes options


def copy_of(workspace: Workspace, folder: Path) -> Workspace:
    """A copy of a workspace."""
    shutil.copytree(workspace.root, folder / "copy")
    return Workspace(folder / "copy")


def stop_after(patch: pytest.MonkeyPatch, iteration: int) -> None:
    """Interrupt the training, as Ctrl-C does, after an iteration."""
    import signal

    from pipelines.train.trainer import JointTrainer

    step = JointTrainer.step

    def stepped(self: JointTrainer) -> object:
        report = step(self)
        if self.iteration == iteration:
            signal.raise_signal(signal.SIGINT)
        return report

    patch.setattr(JointTrainer, "step", stepped)
