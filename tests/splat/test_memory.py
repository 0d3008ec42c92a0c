"""The memory of a training is predicted well enough to refuse what will not fit, and nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.errors import ResourceError
from pipelines.core.machine import _free_in_group
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.memory import (
    USABLE,
    TrainingSize,
    free_memory_bytes,
    predicted_peak_bytes,
    require_memory,
)
from tests.refusals import refused

CAMERA = Pinhole(320, 240, 300.0, 300.0, 160.0, 120.0)
SIZE = TrainingSize(300_000, CAMERA, 3, 0)

# Iterations and one edit of 150 000 Gaussians to 300 000, in a process of their own: a peak cannot be taken back.
TRAINING = """
import torch
from pipelines.core.machine import peak_memory_bytes as peak
from pipelines.splat.densify import DefaultSettings, DefaultStrategy
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.losses import photometric_loss
from pipelines.splat.optimizer import GaussianAdam
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
camera, count = Pinhole(320, 240, 300.0, 300.0, 160.0, 120.0), 150_000
render = rasterizer("cpu").render
before = peak()
random = torch.Generator().manual_seed(0)
means = torch.rand(count, 3, generator=random) * torch.tensor([8.0, 6.0, 4.0]) + torch.tensor([-4.0, -3.0, 6.0])
adam = GaussianAdam(Gaussians(means, torch.randn(count, 4, generator=random), torch.full((count, 3), -4.5),
                              torch.zeros(count), torch.zeros(count, 16, 3)), 1.0, 100)
strategy = DefaultStrategy(DefaultSettings(0, 100, 2, 0, 0.0, max_gaussians=300_000), 1.0, count)
for iteration in range(1, 5):
    view = render(adam.gaussians, torch.eye(4), camera, RasterSettings())
    photometric_loss(view.colour, torch.rand(240, 320, 3, generator=random)).backward()
    adam.step(iteration, view.stats.visible)
    strategy.observe(view.stats, camera)
    strategy.update(iteration, adam)
    adam.show()
assert len(adam.gaussians) == 300_000, len(adam.gaussians)
print(peak() - before)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no resource module")
@pytest.mark.slow
def test_prediction_agrees_with_the_measured_peak() -> None:
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", TRAINING], cwd=root, capture_output=True, text=True, check=True, timeout=120
    )
    measured = int(done.stdout)
    # Never too little by much (the machine would swap), nor so much that what fits is refused.
    assert 0.8 * measured < predicted_peak_bytes(SIZE) < 2.0 * measured, measured / 2**20


def test_refusal_names_a_number_of_gaussians_that_fits() -> None:
    free = predicted_peak_bytes(SIZE) // 2
    with refused("training-memory", ResourceError) as caught:
        require_memory(SIZE, free)
    assert "--max-image-size" in str(caught.value)
    fitting = int(str(caught.value).split("--max-gaussians ")[1].split()[0])
    assert 50_000 < fitting < 150_000
    require_memory(TrainingSize(fitting, CAMERA, 3, 0), free)


def test_too_large_an_image_cannot_be_saved_by_fewer_gaussians() -> None:
    large = TrainingSize(1000, Pinhole(40_000, 30_000, 3e4, 3e4, 2e4, 1.5e4), 3, 0)
    with refused("training-memory", ResourceError) as caught:
        require_memory(large, 4 * 2**30)
    assert "a smaller --max-image-size and a smaller --max-gaussians" in str(caught.value)


def test_a_training_is_refused_from_nine_tenths_of_the_free_memory_on_and_never_where_it_is_unknown() -> None:
    needed = predicted_peak_bytes(SIZE)
    require_memory(SIZE, None)
    require_memory(SIZE, int(1.001 * needed / USABLE))
    with refused("training-memory", ResourceError):
        require_memory(SIZE, int(0.999 * needed / USABLE))


def test_the_machine_tells_how_much_is_free() -> None:
    free = free_memory_bytes(torch.device("cpu"))
    assert free is not None and 2**20 < free < 2**50


def test_the_peak_of_a_process_is_not_that_of_its_parent() -> None:
    ballast = np.ones(400_000_000, dtype=np.uint8)
    program = "from pipelines.core.machine import peak_memory_bytes; print(peak_memory_bytes())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert 2**22 < int(done.stdout) < len(ballast)


def test_a_containers_limit_counts_without_its_file_cache(tmp_path: Path) -> None:
    for name, text in (
        ("memory.max", "1000"),
        ("memory.current", "700"),
        ("memory.stat", "anon 5\ninactive_file 200"),
    ):
        (tmp_path / name).write_text(text + "\n")
    assert _free_in_group(tmp_path) == 500
    (tmp_path / "memory.max").write_text("max\n")
    assert _free_in_group(tmp_path) is None


def test_memory_is_bounded_by_the_window_and_not_by_the_photograph() -> None:
    """Undistortion takes a few bytes for each pixel of a photograph, an iteration two hundred in its window."""
    window, photograph_px = Pinhole(1232, 1026, 1e3, 1e3, 616.0, 513.0), 5472 * 3648
    whole = predicted_peak_bytes(TrainingSize(100_000, Pinhole(5472, 3648, 4e3, 4e3, 2736.0, 1824.0), 3, 0))
    cropped = predicted_peak_bytes(TrainingSize(100_000, window, 3, 0, photograph_px))
    assert cropped < 0.2 * whole
    # A photograph with nearly no Gaussians: the undistortion decides.
    assert predicted_peak_bytes(TrainingSize(100, window, 3, 0, photograph_px)) > 20 * photograph_px
