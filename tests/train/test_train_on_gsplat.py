"""A whole training with `--backend cuda`, on gsplat's own Python code over kernels of a CPU."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import BLOCK_PLAN, BLOCK_TRAINING, BY_NAME, LIDAR, MODEL
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import lla_from_enu
from pipelines.splat.rasterizer import cuda, cuda_kernels
from pipelines.survey.block_plan import BlockPlan, BlockTraining
from pipelines.survey.lidar_report import LidarReport
from pipelines.survey.report import EvaluationReport
from pipelines.survey.solution import TrainedModel
from pipelines.train import trainer
from tests.block_scenes import georef, make_field, write_field
from tests.gsplat_on_cpu import gsplat_on_cpu
from tests.splat_scenes import RenderedFlight, ground_height
from tests.survey.test_measured_cloud import UTM, write_las

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]


@pytest.fixture
def gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    module = gsplat_on_cpu(monkeypatch)
    monkeypatch.setattr(cuda, "load_gsplat", lambda progress: module)
    monkeypatch.setattr(cuda.CudaRasterizer, "device", torch.device("cpu"))
    monkeypatch.setattr(cuda_kernels, "missing_for_cuda", lambda: None)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (64 << 30, 80 << 30))


def evaluated(flight: RenderedFlight, options: dict[str, object], backend: str, name: str) -> float:
    """Return the mean PSNR of the test views after a training and evaluation with a backend."""
    workspace = flight.workspace(name)
    run_stage(workspace, BY_NAME["train"], {**options, "backend": backend})
    run_stage(workspace, BY_NAME["evaluate"], {"backend": backend})
    assert load_json(TrainedModel, workspace.path(MODEL)).backend == backend
    report = load_json(EvaluationReport, workspace.root / "evaluate/report.json")
    assert report.test_views is not None and report.test_views.psnr is not None
    return report.test_views.psnr


# Without density control, which would turn differences of rounding into differences of tenths of a dB.
# Photographs of 48 × 36 px: the kernels are plain torch.
SAME = {"georeference": "joint", "iterations": 200, "sh_degree": 1, "max_image_size": 48, "max_gaussians": 500}
VARIANTS = {
    "mcmc": {"strategy": "mcmc", "iterations": 60},
    "fast": {"strategy": "fast", "robust_photometric": True},
    "crops": {"crop_size": 32, "geometry_regularisation": False},
    "frozen": {"georeference": "frozen", "exposure": False, "sh_degree": 3},
}


def test_trains_to_the_same_picture(flights: list[RenderedFlight], gsplat: None) -> None:
    # Differences of rounding grow with the iterations: after 200, poses 1e-9 apart end 0.1 to 0.5 dB apart.
    options = {**SAME, "iterations": 60}
    theirs = evaluated(flights[0], options, "cuda", "gsplat")
    ours = evaluated(flights[0], options, "cpu", "cpu")
    assert theirs == pytest.approx(ours, abs=0.1)


@pytest.mark.parametrize("variant", VARIANTS)
def test_each_way_of_training_runs(flights: list[RenderedFlight], gsplat: None, variant: str) -> None:
    """Density control, crops, masks of outliers and frozen cameras ask gsplat for other things."""
    options = {**SAME, "iterations": 30, **VARIANTS[variant]}
    psnr = evaluated(flights[0], options, "cuda", f"gsplat-{variant}")
    # Grey photographs have 14 dB of the truth here; 30 iterations reach more, 60 with MCMC's noise.
    assert psnr > 15


def test_lidar_trains(
    flights: list[RenderedFlight], gsplat: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rendered depth against the fused surface, and Gaussians against planes and free space."""
    flight, seen = flights[0], set[str]()
    weighted_sum = trainer.weighted_sum

    def noted(*arguments: object) -> object:
        total, values = weighted_sum(*arguments)  # type: ignore[arg-type]
        seen.update(values)
        return total, values

    monkeypatch.setattr(trainer, "weighted_sum", noted)
    origin, times = flight.rendered.survey.origin, np.linspace(1.0, 9.0, 20_000)
    place = np.random.default_rng(0).uniform(-30, 30, (len(times), 2))
    ground = np.column_stack([place, ground_height(*place.T)])
    scanned = parse_crs(UTM).xyz_from_lla(lla_from_enu(ground, origin))
    write_las(tmp_path / "scan.laz", scanned, gps_time=times)
    rows = [f"{time},{origin.lat_deg},{origin.lon_deg},{origin.alt_m + 50}" for time in range(11)]
    (tmp_path / "scanner.csv").write_text("\n".join(["timestamp,latitude,longitude,altitude", *rows]))
    # At 48 px, stereo finds a ground this smooth half a metre too high.
    of_lidar = {
        "lidar": tmp_path / "scan.laz",
        "lidar_vertical": "ellipsoidal",
        "lidar_trajectory": tmp_path / "scanner.csv",
        "lidar_register": True,
        "lidar_loss": "both",
    }
    workspace = flight.workspace("gsplat-lidar")
    run_stage(workspace, BY_NAME["train"], {**SAME, "iterations": 12, "backend": "cuda", **of_lidar})
    assert load_json(TrainedModel, workspace.path(MODEL)).backend == "cuda"
    assert {"depth", "normals", "free space", "plane attraction"} <= seen
    found = load_json(LidarReport, workspace.root / LIDAR)
    # Measured on the ground that the photographs show.
    assert found.points > 1000 and found.rejected_share < 0.05


def test_blocks_train(gsplat: None, tmp_path: Path) -> None:
    """Plan, solution, scaffold, blocks, seams: each is a command that chooses its backend itself."""
    workspace = write_field(tmp_path, make_field(5, 3, points=400, test_views=(7,)))
    options = ("--backend", "cuda", "--blocks", 2, "--iterations", 12, "--max-gaussians", 500, "--sh-degree", 0)
    code, jobs = georef("train", workspace.root, *options, "--max-image-size", 48)
    assert (code, sorted(jobs)) == (0, ["block 0", "block 1", "scaffold", "seams"])
    for block in load_json(BlockPlan, workspace.root / "blocks" / BLOCK_PLAN).blocks:
        training = load_json(BlockTraining, workspace.root / "blocks" / str(block.id) / BLOCK_TRAINING)
        # Grey photographs have 11 dB of the field.
        assert training.backend == "cuda" and training.train_psnr > 13
    assert load_json(TrainedModel, workspace.path(MODEL)).backend == "cuda"
