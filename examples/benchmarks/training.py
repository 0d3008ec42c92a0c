"""Time whole training iterations, and what they are worth: python examples/benchmarks/training.py --help.

`scaling` prints time and memory of an iteration (projection, harmonics, binning, blending, loss with SSIM,
backward, optimiser, density statistics) against Gaussians and pixels, over the made-up scene of raster.py. `curve`
trains on a workspace with each strategy and prints PSNR on its test views against wall-clock time; the time that
measuring takes does not count.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path

# As the command line does, and for the same reason: see georef_cli/main.py.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch
from raster import make_scene

from pipelines.core.products import load_json
from pipelines.core.stages import SIM3, SPARSE
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.cameras import Pinhole
from pipelines.scene.calibrated import load_survey
from pipelines.scene.geographic import geo_problem
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.photographs import ImageCache
from pipelines.scene.scene import Scene, initial_scene, photographs
from pipelines.splat.densify import DefaultSettings, DefaultStrategy
from pipelines.splat.losses import photometric_loss
from pipelines.splat.memory import TrainingSize, predicted_peak_bytes
from pipelines.splat.metrics import psnr
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.train.assembly import make_trainer
from pipelines.train.depth_maps import DepthMaps
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.options import TrainOptions
from pipelines.train.surface import SceneSurface
from pipelines.train.trainer import JointTrainer


def iterations(count: int, camera: Pinhole, visible: float, repeats: int, backend_name: str) -> Iterator[float]:
    """Seconds of each of `repeats` whole iterations; the first, which compiles, is left out."""
    device = "cuda" if backend_name == "cuda" else "cpu"
    backend = rasterizer("cuda" if device == "cuda" else "cpu")
    gaussians = make_scene(count, camera, visible, device)
    adam = GaussianAdam(gaussians, 1.0, 30_000)
    strategy = DefaultStrategy(DefaultSettings(), 1.0, count)
    target = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1)).to(device)
    pose = torch.eye(4, device=device, requires_grad=True)
    for iteration in range(1, repeats + 2):
        start = now(device)
        adam.zero_grad()
        render = backend.render(adam.gaussians, pose, camera, RasterSettings())
        photometric_loss(render.colour, target).backward()
        adam.step(iteration, render.stats.visible)
        strategy.observe(render.stats, camera)
        if iteration > 1:
            yield now(device) - start


def scaling(arguments: argparse.Namespace) -> None:
    """Print the table of time and memory."""
    print("gaussians       size   best ms  median ms  peak RSS MiB  predicted peak MiB (above the start)")
    base = _peak_bytes()
    for size in arguments.size:
        width, height = (int(part) for part in size.split("x"))
        camera = Pinhole(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
        for count in arguments.gaussians:
            seconds = list(iterations(count, camera, arguments.visible, arguments.repeats, arguments.backend))
            predicted = predicted_peak_bytes(TrainingSize(count, camera, 3, 0))
            print(
                f"{count:9d} {size:>10s} {1e3 * min(seconds):9.1f} {1e3 * statistics.median(seconds):10.1f}"
                f" {_peak_bytes() / 2**20:13.0f} {predicted / 2**20:10.0f}",
                flush=True,
            )
    print(f"peak RSS before the first: {base / 2**20:.0f} MiB; the peak of a process never falls")


def trainer_on(root: Path, options: TrainOptions) -> tuple[JointTrainer, Scene, ImageCache]:
    """Trainer before its first iteration, on a workspace with init-sim3 done, as `georef train` makes it."""
    workspace = Workspace(root)
    survey = load_survey(workspace)
    initial = load_json(InitialSimilarity, workspace.path(SIM3))
    scene = initial_scene(read_sparse(workspace.path(SPARSE)), survey, initial)
    images = photographs(scene.sparse, survey, workspace, options.effort.max_image_size)
    images.build()
    maps = DepthMaps(workspace.cache / "surface", scene, images)
    maps.build()
    trainer = make_trainer(
        TrainingScene(scene, images, SceneSurface(maps)),
        geo_problem(scene, survey, initial, options),
        rasterizer(options.backend),
        options,
    )
    return trainer, scene, images


def curve(arguments: argparse.Namespace) -> None:
    """Print PSNR on the test views against time, for each strategy."""
    print("strategy   seconds  iteration  gaussians  test PSNR dB")
    for strategy in arguments.strategies:
        config = TrainOptions.model_validate(
            {
                "preset": "standard",
                "strategy": strategy,
                "iterations": arguments.iterations,
                "max_image_size": arguments.max_image_size,
                "max_gaussians": arguments.max_gaussians,
                "backend": arguments.backend,
                "faithful_surface": arguments.faithful_surface,
            }
        )
        trainer, scene, images = trainer_on(arguments.workspace, config)
        seconds, device = 0.0, arguments.backend
        while trainer.iteration < arguments.iterations and seconds < arguments.seconds:
            start = now(device)
            trainer.step()
            seconds += now(device) - start
            if trainer.iteration % arguments.every == 0 or trainer.iteration == arguments.iterations:
                count, quality = len(trainer.optimizer.gaussians), psnr_of_test_views(trainer, scene, images)
                print(
                    f"{strategy:8s} {seconds:9.1f} {trainer.iteration:10d} {count:10d} {quality:13.2f}", flush=True
                )


@torch.no_grad()
def psnr_of_test_views(trainer: JointTrainer, scene: Scene, images: ImageCache) -> float:
    """Mean over the test views of the renders as they are, without exposure."""
    values, settings = [], RasterSettings(sh_degree=trainer.options.sh_degree)
    for index in map(int, scene.test):
        pose = trainer.problem.cameras.cam_from_model(index)
        colour = trainer.rasterizer.render(
            trainer.optimizer.gaussians, pose, trainer.pinhole(index), settings
        ).colour
        photo = torch.from_numpy(np.array(images.image(index))).float() / 255.0
        values.append(psnr(colour.cpu(), photo, torch.from_numpy(np.array(images.mask(index)))))
    return statistics.fmean(values)


def now(device: str) -> float:
    """Seconds of a clock, when the device has done all that was queued."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def _peak_bytes() -> int:
    if sys.platform == "win32":
        raise SystemExit("measures memory, which Windows tells otherwise: run it on Linux or macOS")
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", choices=["cpu", "cuda"], default="cpu")
    modes = parser.add_subparsers(required=True)
    table = modes.add_parser("scaling", help="time and memory against Gaussians and pixels")
    table.add_argument("--gaussians", type=int, nargs="+", default=[10_000, 30_000, 100_000, 300_000, 1_000_000])
    table.add_argument("--size", nargs="+", default=["600x450", "661x372", "1280x960"], help="WIDTHxHEIGHT …")
    table.add_argument("--visible", type=float, default=1 / 3, help="fraction within the image")
    table.add_argument("--repeats", type=int, default=7)
    table.set_defaults(run=scaling)
    time_line = modes.add_parser("curve", help="PSNR against wall-clock time for each strategy")
    time_line.add_argument("workspace", type=Path, help="with init-sim3 done")
    time_line.add_argument("--strategies", nargs="+", default=["default", "mcmc", "fast"])
    time_line.add_argument("--iterations", type=int, default=4000, help="length of the schedule")
    time_line.add_argument("--seconds", type=float, default=600.0, help="stop each training after so long")
    time_line.add_argument("--every", type=int, default=500, help="iterations between measurements")
    time_line.add_argument("--max-image-size", type=int, default=600)
    time_line.add_argument("--max-gaussians", type=int, default=80_000)
    time_line.add_argument("--faithful-surface", action=argparse.BooleanOptionalAction, default=True)
    time_line.set_defaults(run=curve)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
