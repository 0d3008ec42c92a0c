"""The joint optimisation step by step: order of views, schedule, state, and its guard."""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from pipelines.adjust.solution import posterior_of
from pipelines.core.workspace import Workspace
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.survey.scene import load_adjusted_scene, photographs
from pipelines.train.georeference.problem import frozen_problem, refining_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.options import TrainOptions
from pipelines.train.solution_state import measured_problem
from pipelines.train.trainer import JointTrainer, load_checkpoint, make_trainer, save_checkpoint
from tests.splat_scenes import Rendered, make_rendered, write_photographs, write_rendered

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = TrainOptions(georeference="joint", iterations=60, sh_degree=2, max_gaussians=1000)


@pytest.fixture(scope="module")
def rendered() -> Rendered:
    return make_rendered()


@pytest.fixture(scope="module")
def workspace(rendered: Rendered, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    root = tmp_path_factory.mktemp("flight")
    write_photographs(rendered, root / "photos")
    return write_rendered(root, rendered)


def trainer_of(workspace: Workspace, config: TrainOptions = CONFIG) -> JointTrainer:
    solution, survey, scene = load_adjusted_scene(workspace)
    solved = scene.at(solution)
    images = photographs(solved.sparse, survey, workspace, 640)
    refines = config.refined_cameras(len(images)) > 0
    problem = frozen_problem(solution, scene)
    if refines:
        posterior = posterior_of(workspace, solution, scene.sparse)
        problem = refining_problem(posterior, survey, scene, measured_problem(solution, survey, scene), config)
    return make_trainer(TrainingScene(solved, images), problem, rasterizer("cpu"), config)


class ReadsOfValues(TorchDispatchMode):
    """Records where a value of a tensor is read, for which a GPU would have to finish all that is queued there."""

    READING = ("_local_scalar_dense", "nonzero", "masked_select", "bincount", "_linalg_check_errors", "equal")

    def __init__(self) -> None:
        super().__init__()
        self.places: list[str] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.name().removeprefix("aten::").partition(".")[0] in self.READING:
            frames = traceback.extract_stack()
            ours = [f"{frame.filename}:{frame.lineno}" for frame in frames if "pipelines" in frame.filename]
            # torch's Adam reads its count of steps on a CPU alone: on a GPU it is fused.
            if not any(frame.filename.endswith("adam.py") for frame in frames):
                self.places.append(ours[-1] if ours else "the test")
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("strategy", ["default", "mcmc", "fast"])
def test_an_iteration_reads_no_value(workspace: Workspace, strategy: str) -> None:
    """Between two edits of the Gaussians, only the rasteriser reads values of tensors."""
    trainer = trainer_of(workspace, CONFIG.model_copy(update={"strategy": strategy}))
    trainer.step()
    with ReadsOfValues() as reads:
        for _ in range(3):
            report = trainer.step()
        assert [place for place in reads.places if "rasterizer/cpu.py" not in place.replace("\\", "/")] == []
        float(report.losses["photometric"])  # the probe hears this
    assert reads.places[-1] == "the test"


def test_a_step_moves_everything(workspace: Workspace) -> None:
    trainer = trainer_of(workspace)
    before = {name: tensor.detach().clone() for name, tensor in trainer.optimizer.gaussians.tensors().items()}
    start = trainer.problem.unknowns.w.detach().clone()
    report = trainer.step()
    assert trainer.iteration == 1
    assert 0 < report.weight < 0.05
    assert float(report.losses["photometric"]) > 0
    after = trainer.optimizer.gaussians.tensors()
    assert any(not torch.equal(before[name], after[name].detach()) for name in before)
    assert not torch.equal(trainer.problem.unknowns.w, start)


def test_state_restores_the_next_step_exactly(workspace: Workspace, tmp_path: Path) -> None:
    one, two = trainer_of(workspace), trainer_of(workspace)
    for _ in range(5):
        one.step()
    save_checkpoint(tmp_path / "c.npz", one.state())
    two.restore(load_checkpoint(tmp_path / "c.npz"))
    for _ in range(3):
        first, second = one.step(), two.step()
        assert float(first.losses["photometric"]) == float(second.losses["photometric"])
        assert float(first.losses["geographic"]) == float(second.losses["geographic"])
    state, again = one.state(), two.state()
    assert state.keys() == again.keys()
    for name in state:
        assert torch.equal(state[name], again[name]), name


def test_state_of_a_run_that_has_not_begun(workspace: Workspace, tmp_path: Path) -> None:
    one, two = trainer_of(workspace), trainer_of(workspace)
    save_checkpoint(tmp_path / "c.npz", one.state())
    two.restore(load_checkpoint(tmp_path / "c.npz"))
    assert float(one.step().losses["photometric"]) == float(two.step().losses["photometric"])


def test_views_are_seen_through_the_lens_that_follows(workspace: Workspace) -> None:
    one, two = trainer_of(workspace), trainer_of(workspace)
    before, unknowns = one.pinholes.of(0), one.problem.unknowns
    undistorted_with = float(unknowns.lens()[0].detach())
    (basis,) = torch.autograd.grad(unknowns.lens()[0], unknowns.w)
    with torch.no_grad():  # toward a focal length two pixels longer
        unknowns.w.copy_(2 * basis / basis.square().sum())
    one.step()
    fx = float(one.problem.unknowns.lens()[0].detach()) - undistorted_with + before.fx
    assert one.pinholes.of(0).fx == pytest.approx(fx, abs=0.1)  # but for the step itself
    # It stays for a hundred iterations, whatever the cameras do, also for who goes on from there.
    with torch.no_grad():
        one.problem.unknowns.w.zero_()
    two.restore(one.state())
    one.step(), two.step()
    assert two.pinholes.of(0) == one.pinholes.of(0) != before
    one.iteration = 100
    one.step()
    assert one.pinholes.of(0).fx == pytest.approx(before.fx, abs=0.2)


def test_cameras_that_were_solved_once_do_not_move(workspace: Workspace) -> None:
    trainer = trainer_of(workspace, CONFIG.model_copy(update={"georeference": "frozen"}))
    problem = trainer.problem
    center, similarity = problem.unknowns.moved()[1].detach().clone(), problem.unknowns.current_similarity()
    lens, affine = problem.unknowns.lens().clone(), trainer.exposures.affine.clone()  # type: ignore[union-attr]
    sh = trainer.optimizer.gaussians.sh.detach().clone()
    for _ in range(3):
        report = trainer.step()
    assert float(report.losses["geographic"]) == 0
    assert torch.equal(problem.unknowns.moved()[1], center)
    np.testing.assert_array_equal(problem.unknowns.current_similarity().translation, similarity.translation)
    assert torch.equal(problem.unknowns.lens(), lens)
    assert not torch.equal(trainer.exposures.affine, affine)  # type: ignore[union-attr]
    assert not torch.equal(trainer.optimizer.gaussians.sh.detach(), sh)
    # SfM's cameras differ from the adjustment, and training renders from the adjustment.
    solution, _, scene = load_adjusted_scene(workspace)
    np.testing.assert_allclose(center, solution.poses.cam_center_in_model, atol=1e-9)
    assert np.abs(scene.poses.cam_center_in_model - center.numpy()).max() > 1e-4
