"""Time whole training iterations, and what they are worth: python examples/benchmarks/training.py --help.

`scaling` prints time and memory of an iteration (projection, harmonics, binning, blending, loss with SSIM,
backward, optimiser, density statistics) against Gaussians and pixels, over the made-up scene of raster.py. `curve`
trains on a workspace with each strategy and limit of Gaussians, and prints PSNR of training views (exposures
applied) and test views against time; the time that measuring takes does not count. `georeference` trains with each
way of holding to the georeference and several seeds, and prints test PSNR, errors of check points, and how far the
cameras have moved from the adjustment. `presets` trains with each preset, and compares them at one size of picture:
each preset's own test PSNR is of photographs of its own size, and small ones are easier.
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
from fitted_cost import fitted_cost, work_of
from raster import make_scene

from pipelines.adjust.solution import posterior_of
from pipelines.core.stages import POINTS
from pipelines.core.types import IntArray
from pipelines.core.workspace import Workspace
from pipelines.evaluate.photometric import TrainingCoverage
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.densify import DefaultSettings, DefaultStrategy
from pipelines.splat.losses import photometric_loss
from pipelines.splat.memory import TrainingSize, predicted_peak_bytes
from pipelines.splat.metrics import psnr
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.depth_maps import DepthMaps
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.marks import mark_rays, triangulated_points
from pipelines.survey.photographs import ImageCache
from pipelines.survey.scene import SparseScene, load_adjusted_scene, photographs
from pipelines.survey.solution import GeolocatedPoints
from pipelines.survey.survey import Survey
from pipelines.train.georeference.problem import frozen_problem, refining_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.options import TrainOptions
from pipelines.train.solution_state import measured_problem, solved_at
from pipelines.train.stage import trained_model
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
        cost = fitted_cost(np.array(sizes), measured)
        ratio = np.array([cost.of(work_of(size)) for size in np.array(sizes)]) / measured
        print(f"{name}: {np.round(cost, 4).tolist()}, {ratio.min():.2f} to {ratio.max():.2f} of each")


def undistorted(root: Path, scene: SparseScene, survey: Survey, options: TrainOptions) -> ImageCache:
    """Undistorted photographs of a workspace with init-sim3 done."""
    images = photographs(scene.sparse, survey, Workspace(root), options.effort.max_image_size)
    images.build()
    return images


def trainer_on(root: Path, options: TrainOptions) -> tuple[JointTrainer, SparseScene, ImageCache]:
    """Trainer before its first iteration, on a workspace with init-sim3 done, as `georef train` makes it."""
    solution, survey, adjusted = load_adjusted_scene(Workspace(root))
    scene = adjusted.at(solution)
    images = undistorted(root, scene, survey, options)
    measured = measured_problem(solution, survey, adjusted, control_points=options.gcp_loss)
    maps = DepthMaps(Workspace(root).cache / "surface", scene, images)
    maps.build()
    problem = frozen_problem(solution, scene)
    if options.refined_cameras(len(images)):
        posterior = posterior_of(Workspace(root), solution, adjusted.sparse)
        points = GeolocatedPoints.load(Workspace(root).path(POINTS))
        problem = refining_problem(posterior, survey, adjusted, measured, options, points=points, seed=options.seed)
    trainer = make_trainer(
        TrainingScene(scene, images, SceneSurface(maps)),
        problem,
        rasterizer(options.backend),
        options,
    )
    return trainer, scene, images


def trained_on(root: Path, options: TrainOptions) -> tuple[JointTrainer, SparseScene, ImageCache, float]:
    """What `trainer_on` returns after the last iteration, and the processor seconds of all iterations."""
    trainer, scene, images = trainer_on(root, options)
    worked = time.process_time()
    while trainer.iteration < trainer.options.iterations:
        trainer.step()
    return trainer, scene, images, time.process_time() - worked


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


def psnr_of_test_views(trainer: JointTrainer, scene: SparseScene, images: ImageCache) -> float:
    """Mean over the test views of the renders as they are, without exposure."""
    return ViewQuality(trainer, images).psnr(scene.test)


@dataclass(frozen=True)
class ViewQuality:
    """Renders of whole photographs against them; pairs of both are drawn into a folder, if there is one."""

    trainer: JointTrainer
    images: ImageCache
    look: Path | None = None
    judged_px: int | None = None  # longest side to which both are reduced first; None: as trained
    coverage: TrainingCoverage | None = None  # pixels of ground that two training views show count alone

    @torch.no_grad()
    def psnr(self, views: IntArray) -> float:
        """Mean over views (V,) of the renders, with the exposure of their photographs."""
        return statistics.fmean(map(self._psnr, map(int, views)))

    def _psnr(self, index: int) -> float:
        trainer, settings = self.trainer, RasterSettings(sh_degree=self.trainer.options.sh_degree)
        pose, pinhole = trainer.problem.unknowns.cam_from_model(index), trainer.pinholes.of(index)
        colour = trainer.rasterizer.render(trainer.optimizer.gaussians, pose, pinhole, settings).colour
        if trainer.exposures is not None:
            colour = trainer.exposures.apply(index, colour)
        photo = torch.from_numpy(np.array(self.images.image(index))).float() / 255.0
        colour = colour.cpu().clamp(0, 1)
        if self.look is not None:
            self.look.mkdir(parents=True, exist_ok=True)
            pair = torch.cat([photo, colour], dim=1).mul(255).round().byte().numpy()
            cv2.imwrite(str(self.look / f"{index:04d}.png"), pair[..., ::-1])
        mask = torch.from_numpy(np.array(self.images.mask(index)))
        covered = None if self.coverage is None else self.coverage.covered(index)
        mask = mask if covered is None else mask & covered
        if self.judged_px is not None:
            colour, photo, mask = (reduced(image, self.judged_px) for image in (colour, photo, mask))
        return psnr(colour, photo, mask)


def reduced(image: torch.Tensor, longest_px: int) -> torch.Tensor:
    """Return means over areas of an image (H, W, …), or the pixels of a mask (H, W) without a hole."""
    height, width = image.shape[:2]
    size = [max(1, round(side * longest_px / max(width, height))) for side in (width, height)]
    mean = cv2.resize(image.float().numpy(), size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(mean > 0.999 if image.dtype == torch.bool else mean)


def presets(arguments: argparse.Namespace) -> None:
    """Print PSNR of the test views after a training with each preset and seed: at its own size, and at one size."""
    heads = "  ".join(f"at {px:3d} px" for px in sorted(arguments.at))
    print(f"preset    seed  seconds  gaussians  own px  own PSNR dB  {heads}")
    for preset, seed in product(arguments.presets, arguments.seeds):
        options = TrainOptions.model_validate({"preset": preset, "seed": seed, "backend": arguments.backend})
        start = now(arguments.backend)
        trainer, scene, images, _ = trained_on(arguments.workspace, options)
        taken, solution = now(arguments.backend) - start, load_adjusted_scene(Workspace(arguments.workspace))[0]
        renderer = ModelRenderer(
            *(trained_model(trainer, solution), scene.sparse, trainer.optimizer.gaussians.detached()),
            *(images, trainer.rasterizer),
        )
        coverage = TrainingCoverage(renderer)
        sizes = [px for px in sorted(arguments.at) if px <= images.max_size_px]
        views = [ViewQuality(trainer, images, None, px, coverage) for px in (None, *sizes)]
        own, *quality = [view.psnr(scene.test) for view in views]
        judged = "  ".join(f"{one:9.2f}" for one in quality)
        print(
            f"{preset:8s} {seed:5d} {taken:8.0f} {len(trainer.optimizer.gaussians):10d} {images.max_size_px:7d}"
            f" {own:12.2f}  {judged}",
            flush=True,
        )


FIGURES = ("cpu s", "PSNR dB", "H mm", "V mm", "moved mm", "most mm", "whole mm", "surplus")


def georeference(arguments: argparse.Namespace) -> None:
    """Print figures of trainings that hold to the georeference in several ways: of each run, mean and spread."""
    print(f"{'georeference':12s} seed    " + "  ".join(f"{name:>10s}" for name in FIGURES), flush=True)
    found: dict[str, list[list[float]]] = {}
    for seed, form in product(arguments.seeds, arguments.forms):
        given = {"preset": "smoke", "iterations": arguments.iterations, "seed": seed, "georeference": form}
        options = TrainOptions.model_validate({**given, "backend": arguments.backend})
        trainer, scene, images, worked = trained_on(arguments.workspace, options)
        test = psnr_of_test_views(trainer, scene, images)
        found.setdefault(form, []).append([worked, test, *placed(arguments.workspace, trainer, options)])
        print(f"{form:12s} {seed:6d}  " + "  ".join(f"{one:10.3f}" for one in found[form][-1]), flush=True)
    for form, runs in found.items():
        for what, of_runs in (("mean", np.mean(runs, axis=0)), ("spread", np.std(runs, axis=0))):
            print(f"{form:12s} {what:6s}  " + "  ".join(f"{one:10.3f}" for one in of_runs), flush=True)


def placed(root: Path, trainer: JointTrainer, options: TrainOptions) -> list[float]:
    """Return `FIGURES` after the first two: check points, triangulated, motion of the cameras, χ² of the motion.

    H and V are RMSE, NaN without check points. The motion since `init-sim3`, in `geo`, is the root mean square over
    the cameras beside their mean, the largest of all, and that mean. Its χ² is what it costs all measurements.
    """
    solution, survey, scene = load_adjusted_scene(Workspace(root))
    model, unknowns = solution, trainer.problem.unknowns
    if len(unknowns.w):
        measured = measured_problem(solution, survey, scene, control_points=options.gcp_loss)
        model = solved_at(solution, survey, scene, measured, unknowns.state()).solution
    rays = mark_rays(survey.check_points, model.with_lenses(scene.sparse))
    surveyed = np.array([point.position_in_geo for point in survey.check_points]).reshape(-1, 3)
    error = triangulated_points(model, rays) - surveyed
    seen = np.isfinite(error).all(axis=1)
    error = error[seen] if seen.any() else np.full((1, 3), np.nan)
    moved = model.center_in_geo - solution.center_in_geo
    own = np.linalg.norm(moved - moved.mean(axis=0), axis=1)
    lengths_m = (
        *(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()), np.sqrt((error[:, 2] ** 2).mean())),
        *(np.sqrt(np.mean(own**2)), np.linalg.norm(moved, axis=1).max(), np.linalg.norm(moved.mean(axis=0))),
    )
    surplus = float(unknowns.chi2().detach())
    return [*(1e3 * float(length) for length in lengths_m), surplus]


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
    held = modes.add_parser("georeference", help="quality against what a training does with the georeference")
    held.add_argument("workspace", type=Path, help="with init-sim3 done")
    held.add_argument("--forms", nargs="+", default=["joint", "frozen"], help="of joint, paper, frozen")
    held.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    held.add_argument("--iterations", type=int, default=200)
    held.set_defaults(run=georeference)
    effort = modes.add_parser("presets", help="quality of each preset at one size of picture")
    effort.add_argument("workspace", type=Path, help="with init-sim3 done")
    effort.add_argument("--presets", nargs="+", default=["smoke", "fast", "standard", "high"])
    effort.add_argument("--seeds", type=int, nargs="+", default=[0])
    effort.add_argument("--at", type=int, nargs="+", default=[320, 800], help="longest sides in pixels")
    effort.set_defaults(run=presets)
    arguments = parser.parse_args()
    arguments.run(arguments)


if __name__ == "__main__":
    main()
