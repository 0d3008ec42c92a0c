"""The training loop: the same from the same seed, through interruptions, and through one divergence."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.errors import ConvergenceError, DamagedPartialError
from pipelines.core.progress import SILENT
from pipelines.splat.densify import FastSettings, FastStrategy, Strategy
from pipelines.splat.densify_mcmc import McmcSettings, McmcStrategy
from pipelines.splat.surface import SurfaceSettings
from pipelines.survey.photographs import ImageCache
from pipelines.train.loop import LoopOptions, optimise
from pipelines.train.schedule import JointOptions
from pipelines.train.trainer import JointTrainer
from tests import tiny_training as tiny
from tests.refusals import refused

pytestmark = pytest.mark.usefixtures("one_thread")

ITERATIONS = 40
OPTIONS = JointOptions(
    ITERATIONS, sh_degree=1, coarse=((2, 0.3),), coarse_least_px=32, surface=SurfaceSettings(normals_from=0.5)
)
STRATEGIES: dict[str, Callable[[], Strategy | None]] = {
    "default": lambda: None,
    "mcmc": lambda: McmcStrategy(McmcSettings(start=4, stop=30, every=8, max_gaussians=300), tiny.EXTENT_M),
    "fast": lambda: FastStrategy(
        tiny.SETTINGS, FastSettings(views=3, prune_stop=35, high_error_px=0.1), tiny.EXTENT_M, 200
    ),
}


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> ImageCache:
    return tiny.photographs(tmp_path_factory.mktemp("photographs"), tiny.true_gaussians())


def files(folder: Path, *, resume: bool = False) -> LoopOptions:
    return LoopOptions(folder / "checkpoint.npz", folder / "metrics.jsonl", 10, 5, resume)


def result(trainer: JointTrainer) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in trainer.state().items()}


def assert_same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert one.keys() == other.keys()
    different = [name for name in one if not torch.equal(one[name], other[name])]
    assert different == []


@pytest.mark.parametrize("name", STRATEGIES)
def test_the_same_seed_gives_the_same_bits_also_through_an_interruption(
    images: ImageCache, tmp_path: Path, name: str
) -> None:
    def new() -> JointTrainer:
        return tiny.trainer(images, OPTIONS, strategy=STRATEGIES[name](), with_exposures=True)

    whole, again, first, second = (new() for _ in range(4))
    for trainer, folder in ((whole, "a"), (again, "b")):
        (tmp_path / folder).mkdir()
        optimise(trainer, files(tmp_path / folder), SILENT)
    assert_same(result(whole), result(again))
    (tmp_path / "c").mkdir()
    _stop_at(first, 17, files(tmp_path / "c"))
    optimise(second, files(tmp_path / "c", resume=True), SILENT)
    assert_same(result(whole), result(second))
    rows = [json.loads(row) for row in (tmp_path / "c" / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == list(range(5, ITERATIONS + 1, 5))


def _stop_at(trainer: JointTrainer, iteration: int, options: LoopOptions) -> None:
    """Kill a training at an iteration between two checkpoints: nothing is written on the way out."""
    step = trainer.step

    def killed() -> object:
        if trainer.iteration + 1 == iteration:
            raise SystemExit
        return step()

    trainer.step = killed  # type: ignore[method-assign,assignment]
    with pytest.raises(SystemExit):
        optimise(trainer, options, SILENT)


def _spoil(trainer: JointTrainer, iterations: set[int]) -> None:
    """Make one Gaussian's colour not a number before these iterations, each time that they come."""
    step, left = trainer.step, sorted(iterations)

    def spoiled() -> object:
        if left and trainer.iteration + 1 == left[0]:
            left.pop(0)
            with torch.no_grad():
                trainer.optimizer.gaussians.sh[:, 0] = float("nan")
        return step()

    trainer.step = spoiled  # type: ignore[method-assign,assignment]


def test_a_divergence_is_recovered_from_once_at_a_lower_rate(images: ImageCache, tmp_path: Path) -> None:
    trainer = tiny.trainer(images, OPTIONS)
    _spoil(trainer, {23})
    outcome = optimise(trainer, files(tmp_path), SILENT)
    assert outcome.recovery is not None
    assert "photometric loss is not finite at iteration 23" in outcome.recovery
    assert "continued from iteration 20" in outcome.recovery
    assert trainer.iteration == ITERATIONS and trainer.optimizer.rate_factor < 0.5
    assert all(bool(value.isfinite().all()) for value in result(trainer).values())
    rows = [json.loads(row) for row in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == list(range(5, ITERATIONS + 1, 5))
    assert all(abs(row["psnr"]) < 100 for row in rows)


def test_a_second_divergence_stops_and_names_both(images: ImageCache, tmp_path: Path) -> None:
    trainer = tiny.trainer(images, OPTIONS)
    _spoil(trainer, {3, 33})
    with refused("training-diverged", ConvergenceError) as error:
        optimise(trainer, files(tmp_path), SILENT)
    assert re.search(r"iteration 33; earlier, .* iteration 3; continued from.*--seed", str(error.value))
    # Whoever resumes does so from a sound state that knows of the first one.
    resumed = tiny.trainer(images, OPTIONS)
    outcome = optimise(resumed, files(tmp_path, resume=True), SILENT)
    assert outcome.recovery is not None and "iteration 3" in outcome.recovery
    assert resumed.iteration == ITERATIONS


def test_training_brings_the_renders_to_the_photographs(images: ImageCache, tmp_path: Path) -> None:
    trainer = tiny.trainer(images, JointOptions(80, sh_degree=0))
    optimise(trainer, files(tmp_path), SILENT)
    rows = [json.loads(row)["psnr"] for row in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    # From grey blobs at 64 × 48 pixels: these are renders of just as many Gaussians.
    assert rows[-1] > rows[0] + 6 and rows[-1] > 20


@pytest.mark.parametrize("damage", [b"", b"PK\x03\x04 nonsense", None], ids=["empty", "nonsense", "cut off"])
def test_damaged_checkpoint_is_recognised(images: ImageCache, tmp_path: Path, damage: bytes | None) -> None:
    """The runner drops what is damaged and trains afresh."""
    optimise(tiny.trainer(images, JointOptions(1, sh_degree=0)), files(tmp_path), SILENT)
    checkpoint = files(tmp_path).checkpoint
    whole = checkpoint.read_bytes()
    checkpoint.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    with refused("checkpoint-damaged", DamagedPartialError) as error:
        optimise(tiny.trainer(images, JointOptions(1, sh_degree=0)), files(tmp_path, resume=True), SILENT)
    assert error.value.path == checkpoint


def test_extended_training_is_as_good_as_an_uninterrupted_one(images: ImageCache, tmp_path: Path) -> None:
    """Mean PSNR of the last epoch against the photographs, which are renders of known Gaussians.

    The extension must close most of the way from the short training to the long one: it begins with Gaussians that
    have come to rest. With five seeds it closed 88 to 92 % of it.
    """

    def quality(folder: Path) -> float:
        rows = [json.loads(row) for row in (folder / "metrics.jsonl").read_text().splitlines()]
        assert [row["iteration"] for row in rows] == list(range(5, rows[-1]["iteration"] + 1, 5))
        return float(np.mean([row["psnr"] for row in rows[-6:]]))

    def train(name: str, iterations: int, extend: bool = False) -> tuple[JointTrainer, float]:
        folder = tmp_path / name
        folder.mkdir(exist_ok=True)
        trainer = tiny.trainer(images, replace(OPTIONS, iterations=iterations), with_exposures=True)
        optimise(trainer, replace(files(folder, resume=extend), extend=extend, note=notes.append), SILENT)
        return trainer, quality(folder)

    notes: list[str] = []
    _, short = train("short", 20)
    _, long = train("long", 60)
    extended, better = train("short", 60, extend=True)
    assert (extended.iteration, extended.schedule.extended_from) == (60, 20)
    assert notes[-1].startswith("60 of 60 iterations")
    assert long > short + 1.0, "otherwise there is nothing to gain"
    assert better - short > 0.8 * (long - short)
    resumed = tiny.trainer(images, replace(OPTIONS, iterations=60), with_exposures=True)
    optimise(resumed, files(tmp_path / "short", resume=True), SILENT)
    assert resumed.schedule.extended_from == 20, "also through an interruption"
