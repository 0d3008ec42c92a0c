"""Time whole training iterations, and what they are worth: python examples/benchmarks/training.py --help.

`scaling` prints time and memory of an iteration (projection, harmonics, binning, blending, loss with SSIM,
backward, optimiser, density statistics) against Gaussians and pixels, over the made-up scene of raster.py. `curve`
trains on a workspace with each strategy and limit of Gaussians, and prints PSNR of training views (exposures
applied) and test views against time; the time that measuring takes does not count.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

# As the command line does, and for the same reason: see georef_cli/main.py.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import cv2
import numpy as np
import torch
from raster import make_scene

from pipelines.core.types import IntArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import Pinhole
from pipelines.jobs.costs import IterationCost
from pipelines.splat.densify import DefaultSettings, DefaultStrategy
from pipelines.splat.losses import photometric_loss
from pipelines.splat.memory import TrainingSize, predicted_peak_bytes
from pipelines.splat.metrics import psnr
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.depth_maps import DepthMaps
from pipelines.survey.photographs import ImageCache
from pipelines.survey.scene import Scene, photographs
from pipelines.train.adjusted_scene import AdjustedScene
from pipelines.train.geographic.problem import refining_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.options import TrainOptions
from pipelines.train.surface import SceneSurface
from pipelines.train.trainer import JointTrainer, make_trainer


def iterations(
    count: int, camera: Pinhole, visible: float, repeats: int, backend_name: str
) -> Iterator[tuple[float, float]]:
    """Seconds and processor seconds of `repeats` whole iterations; the first, which compiles, is left out."""
    device = "cuda" if backend_name == "cuda" else "cpu"
    backend = rasterizer("cuda" if device == "cuda" else "cpu")
    gaussians = make_scene(count, camera, visible, device)
    adam = GaussianAdam(gaussians, 1.0, 30_000)
    strategy = DefaultStrategy(DefaultSettings(), 1.0, count)
    target = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1)).to(device)
    pose = torch.eye(4, device=device, requires_grad=True)
    for iteration in range(1, repeats + 2):
        start, worked = now(device), time.process_time()
        rows = backend.candidates(adam.gaussians, pose, camera, RasterSettings())
        render = backend.render(adam.show(rows), pose, camera, RasterSettings())
        photometric_loss(render.colour, target).backward()
        adam.step(iteration, render.stats.visible)
        strategy.observe(render.stats.among(rows), camera)
        if iteration > 1:
            yield now(device) - start, time.process_time() - worked


def scaling(arguments: argparse.Namespace) -> None:
    """Print the table of time and memory."""
    print("gaussians  in view       size   best ms  median ms  peak RSS MiB  predicted peak MiB (above the start)")
    base, sizes, best = _peak_bytes(), [], []
    for size, visible, count in product(arguments.size, arguments.visible, arguments.gaussians):
        width, height = (int(part) for part in size.split("x"))
        camera = Pinhole(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
        taken = np.array(list(iterations(count, camera, visible, arguments.repeats, arguments.backend)))
        predicted = predicted_peak_bytes(TrainingSize(count, camera, 3, 0))
        sizes.append([width * height, visible * count, count])
        best.append(taken.min(axis=0))
        print(
            f"{count:9d} {visible:8.1%} {size:>10s} {1e3 * best[-1][0]:9.1f} {1e3 * np.median(taken[:, 0]):10.1f}"
            f" {_peak_bytes() / 2**20:13.0f} {predicted / 2**20:10.0f}",
            flush=True,
        )
    print(f"peak RSS before the first: {base / 2**20:.0f} MiB; the peak of a process never falls")
    if len(sizes) < 4:
        return
    for name, measured in zip(("seconds", "processor seconds"), np.array(best).T, strict=True):
        cost = IterationCost.fitted(np.array(sizes), measured)
        ratio = np.array([cost.of(*one) for one in sizes]) / measured
        print(f"{name}: {np.round(cost.coefficients, 4).tolist()}, {ratio.min():.2f} to {ratio.max():.2f} of each")


def scene_of(root: Path, options: TrainOptions) -> tuple[AdjustedScene, ImageCache]:
    """Scene of a workspace with init-sim3 done, and its undistorted photographs."""
    workspace = Workspace(root)
    adjusted = AdjustedScene.load(workspace)
    images = photographs(adjusted.scene.sparse, adjusted.survey, workspace, options.effort.max_image_size)
    images.build()
    return adjusted, images


def trainer_on(root: Path, options: TrainOptions) -> tuple[JointTrainer, Scene, ImageCache]:
    """Trainer before its first iteration, on a workspace with init-sim3 done, as `georef train` makes it."""
    adjusted, images = scene_of(root, options)
    scene, measured = adjusted.scene, adjusted.measured(control_points=options.gcp_loss)
    maps = DepthMaps(Workspace(root).cache / "surface", scene, images)
    maps.build()
    trainer = make_trainer(
        TrainingScene(scene, images, SceneSurface(maps)),
        refining_problem(adjusted, measured, options, seed=options.seed),
        rasterizer(options.backend),
        options,
    )
    return trainer, scene, images


def curve(arguments: argparse.Namespace) -> None:
    """Print PSNR on training and test views against time, for each strategy and limit of Gaussians."""
    print("strategy   processor s  seconds  iteration  gaussians  train PSNR dB  test PSNR dB")
    for strategy, most in product(arguments.strategies, arguments.max_gaussians):
        config = TrainOptions.model_validate(
            {
                "preset": "standard",
                "strategy": strategy,
                "iterations": arguments.iterations,
                "max_image_size": arguments.max_image_size,
                "max_gaussians": most,
                "backend": arguments.backend,
                "geometry_regularisation": arguments.geometry_regularisation,
            }
        )
        trainer, scene, images = trainer_on(arguments.workspace, config)
        seconds, processor_s, device = 0.0, 0.0, arguments.backend
        while trainer.iteration < arguments.iterations and seconds < arguments.seconds:
            start, worked = now(device), time.process_time()
            trainer.step()
            seconds, processor_s = seconds + now(device) - start, processor_s + time.process_time() - worked
            if trainer.iteration % arguments.every == 0 or trainer.iteration == arguments.iterations:
                views = ViewQuality(trainer, images, arguments.look)
                print(
                    f"{strategy:8s} {processor_s:13.1f} {seconds:8.1f} {trainer.iteration:10d}"
                    f" {len(trainer.optimizer.gaussians):10d} {views.psnr(scene.train):14.2f}"
                    f" {views.psnr(scene.test):13.2f}",
                    flush=True,
                )


def psnr_of_test_views(trainer: JointTrainer, scene: Scene, images: ImageCache) -> float:
    """Mean over the test views of the renders as they are, without exposure."""
    return ViewQuality(trainer, images).psnr(scene.test)


@dataclass(frozen=True)
class ViewQuality:
    """Renders of whole photographs against them; pairs of both are drawn into a folder, if there is one."""

    trainer: JointTrainer
    images: ImageCache
    look: Path | None = None

    @torch.no_grad()
    def psnr(self, views: IntArray) -> float:
        """Mean over views (V,) of the renders, with the exposure of their photographs."""
        return statistics.fmean(map(self._psnr, map(int, views)))

    def _psnr(self, index: int) -> float:
        trainer, settings = self.trainer, RasterSettings(sh_degree=self.trainer.options.sh_degree)
        pose, pinhole = trainer.problem.cameras.cam_from_model(index), trainer.pinholes.of(index)
        colour = trainer.rasterizer.render(trainer.optimizer.gaussians, pose, pinhole, settings).colour
        if trainer.exposures is not None:
            colour = trainer.exposures.apply(index, colour)
        photo = torch.from_numpy(np.array(self.images.image(index))).float() / 255.0
        colour = colour.cpu().clamp(0, 1)
        if self.look is not None:
            self.look.mkdir(parents=True, exist_ok=True)
            pair = torch.cat([photo, colour], dim=1).mul(255).round().byte().numpy()
            cv2.imwrite(str(self.look / f"{index:04d}.png"), pair[..., ::-1])
        return psnr(colour, photo, torch.from_numpy(np.array(self.images.mask(index))))


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
    table.add_argument("--visible", type=float, nargs="+", default=[1 / 3], help="fractions within the image")
    table.add_argument("--repeats", type=int, default=7)
    table.set_defaults(run=scaling)
    time_line = modes.add_parser("curve", help="PSNR against time for each strategy and limit of Gaussians")
    time_line.add_argument("workspace", type=Path, help="with init-sim3 done")
    time_line.add_argument("--strategies", nargs="+", default=["default", "mcmc", "fast"])
    time_line.add_argument("--iterations", type=int, default=4000, help="length of the schedule")
    time_line.add_argument("--seconds", type=float, default=600.0, help="stop each training after so long")
    time_line.add_argument("--every", type=int, default=500, help="iterations between measurements")
    time_line.add_argument("--max-image-size", type=int, default=600)
    time_line.add_argument("--max-gaussians", type=int, nargs="+", default=[80_000])
    time_line.add_argument("--look", type=Path, help="folder for photographs beside their renders")
    time_line.add_argument("--geometry-regularisation", action=argparse.BooleanOptionalAction, default=True)
    time_line.set_defaults(run=curve)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
