"""Measure the backend of a GPU in one command: python examples/benchmarks/gpu.py OUT.json.

1. kernels: seconds to compile and load gsplat (0 where it was compiled before).
2. parity: images and gradients against the reference in float64, which the CPU computes.
3. speed: iterations per second and peak memory by Gaussians and pixels, and the time of gsplat's own iteration.
4. waiting: places of the program where an iteration waits for the GPU.
5. geographic: the share of an iteration that the geographic losses take.
6. quality: PSNR of the test views against seconds of training.

The last three need a workspace with init-sim3 done (`--workspace`), such as that of `orbit_dev`; a workspace that
was trained before brings its depth maps along. Each part runs in a process of its own, within its own time and
eight minutes in all. A part that fails is an entry of the file: the others go on. Without a GPU, `--backend cpu`
with small sizes shows that the benchmark itself works.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import statistics
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

# As the command line does, and for the same reason: see georef_cli/main.py.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import torch
from raster import make_scene
from torch import Tensor
from training import iterations, now, psnr_of_test_views, trainer_on

from pipelines.core.fingerprints import library_versions
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.losses import photometric_loss
from pipelines.splat.rasterizer.api import RasterSettings, Render
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.splat.rasterizer.reference import render_reference
from pipelines.train.options import TrainOptions
from pipelines.train.trainer import JointTrainer

TOTAL_S = 465.0  # of eight minutes: the start of the program takes some, too
IMAGE_BOUND, GRADIENT_BOUND = 1e-4, 1e-3
# A float32 backend and the reference can disagree whether a contribution of alpha 1/255 counts.
_OUTLYING_SHARE = 1e-3
_VISIBLE = 1 / 3  # share of the Gaussians in view, where speed is measured
_REST_S = 3.0  # for the last part to end, and for the file


def kernels(arguments: argparse.Namespace) -> dict[str, Any]:
    """Seconds until the backend can render."""
    start = time.perf_counter()
    backend = rasterizer(arguments.backend)
    return {"backend": backend.name, "seconds": round(time.perf_counter() - start, 2)}


def parity(arguments: argparse.Namespace) -> dict[str, Any]:
    """Largest differences from the reference: of images, and of gradients relative to the largest gradient."""
    backend, device = rasterizer(arguments.backend), arguments.backend
    camera = Pinhole(70, 45, 60.0, 58.0, 36.0, 21.0)  # no multiple of a tile
    settings = RasterSettings(sh_degree=3, background=(0.2, 0.5, 0.9), depth=True)
    images: dict[str, list[float]] = {}
    gradients: dict[str, list[float]] = {}
    outlying = 0.0
    for seed in range(arguments.scenes):
        scene = make_scene(120, camera, 1.0, "cpu", seed)
        truth, truth_pose = _leaves(scene, torch.float64, "cpu")
        ours, pose = _leaves(scene, torch.float32, device)
        expected = render_reference(truth, truth_pose, camera, settings)
        render = backend.render(ours, pose, camera, settings)
        for name in ("colour", "alpha", "expected_depth"):
            difference = (getattr(render, name).detach().cpu().double() - getattr(expected, name).detach()).abs()
            if name == "expected_depth":
                difference = difference / 8.0  # of the farthest Gaussian
            images.setdefault(name, []).append(float(difference.quantile(1 - _OUTLYING_SHARE)))
            outlying = max(outlying, float((difference > IMAGE_BOUND).double().mean()))
        _loss(expected).backward()
        _loss(render).backward()
        pairs = {name: (tensor, truth.tensors()[name]) for name, tensor in ours.tensors().items()}
        for name, (mine, reference) in {**pairs, "pose": (pose, truth_pose)}.items():
            assert mine.grad is not None and reference.grad is not None
            error = (mine.grad.cpu().double() - reference.grad).abs().max() / reference.grad.abs().max()
            gradients.setdefault(name, []).append(float(error))
    worst_image, worst_gradient = max(map(max, images.values())), max(map(max, gradients.values()))
    return {
        "scenes": arguments.scenes,
        "image": {name: max(errors) for name, errors in images.items()},
        "share_of_pixels_beyond": outlying,
        "gradient": {name: max(errors) for name, errors in gradients.items()},
        "bounds": {"image": IMAGE_BOUND, "gradient": GRADIENT_BOUND},
        "holds": worst_image < IMAGE_BOUND and outlying < _OUTLYING_SHARE and worst_gradient < GRADIENT_BOUND,
    }


def speed(arguments: argparse.Namespace) -> dict[str, Any]:
    """Iterations per second and peak memory of whole iterations over made-up scenes."""
    rows = []
    for size in arguments.size:
        width, height = (int(part) for part in size.split("x"))
        camera = Pinhole(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
        for count in arguments.gaussians:
            if arguments.backend == "cuda":
                torch.cuda.reset_peak_memory_stats()
            seconds = [one for one, _ in iterations(count, camera, _VISIBLE, arguments.repeats, arguments.backend)]
            row: dict[str, Any] = {
                "gaussians": count,
                "pixels": size,
                "iterations_per_s": round(1 / statistics.median(seconds), 2),
                "best_ms": round(1e3 * min(seconds), 3),
                "median_ms": round(1e3 * statistics.median(seconds), 3),
            }
            if arguments.backend == "cuda":
                row["peak_bytes"] = torch.cuda.max_memory_allocated()
                for name, packed in (("packed", True), ("unpacked", False)):
                    theirs = statistics.median(_seconds_of_gsplat(count, camera, arguments.repeats, packed=packed))
                    row[f"gsplat_{name}_ms"] = round(1e3 * theirs, 3)
            rows.append(row)
            print(json.dumps({"rows": rows}), flush=True)  # what is measured counts, should time run out
    return {"rows": rows}


def _seconds_of_gsplat(count: int, camera: Pinhole, repeats: int, *, packed: bool) -> list[float]:
    """Seconds of gsplat's own iterations over the same scene, the first of which does not count.

    It renders without gradients of the camera, keeps the statistics of its default strategy, and takes a step of
    torch's fused Adam for each quantity, as its trainer does for one image. The loss is ours.
    """
    import gsplat

    scene = make_scene(count, camera, _VISIBLE, "cuda")
    values = {
        "means": scene.means,
        "scales": scene.log_scales,
        "quats": scene.quats_wxyz,
        "opacities": scene.logit_opacities,
        "sh0": scene.sh[:, :1],
        "shN": scene.sh[:, 1:],
    }
    leaves = {name: torch.nn.Parameter(tensor.detach().clone()) for name, tensor in values.items()}
    adams = {name: torch.optim.Adam([leaf], lr=1e-4, eps=1e-15, fused=True) for name, leaf in leaves.items()}
    strategy = gsplat.DefaultStrategy(refine_start_iter=repeats + 2)
    state = strategy.initialize_state(scene_scale=1.0)
    target = torch.rand(camera.height, camera.width, 3, device="cuda")
    matrix = torch.tensor(
        [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]], device="cuda"
    )
    pose, seconds = torch.eye(4, device="cuda"), []
    for iteration in range(repeats + 1):
        start = now("cuda")
        images, _, meta = gsplat.rasterization(
            leaves["means"],
            leaves["quats"],
            leaves["scales"].exp(),
            leaves["opacities"].sigmoid(),
            torch.cat([leaves["sh0"], leaves["shN"]], dim=1),
            pose[None],
            matrix[None],
            camera.width,
            camera.height,
            sh_degree=3,
            packed=packed,
        )
        strategy.step_pre_backward(leaves, adams, state, iteration, meta)
        photometric_loss(images[0], target).backward()
        for adam in adams.values():
            adam.step()
            adam.zero_grad(set_to_none=True)
        strategy.step_post_backward(leaves, adams, state, iteration, meta, packed=packed)
        seconds.append(now("cuda") - start)
    return seconds[1:]


def waiting(arguments: argparse.Namespace) -> dict[str, Any]:
    """Places where an iteration waits for the GPU, with their number per iteration, as torch reports them."""
    if arguments.backend != "cuda":
        return {"not_measured": "torch reports these on a GPU alone"}
    trainer, steps = _trainer(arguments), 20
    for _ in range(3):
        trainer.step()
    torch.cuda.set_sync_debug_mode("warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(steps):
            trainer.step()
    torch.cuda.set_sync_debug_mode("default")
    places = Counter(f"{Path(warning.filename).name}:{warning.lineno}" for warning in caught)
    return {"per_iteration": {place: count / steps for place, count in places.most_common(20)}}


def geographic(arguments: argparse.Namespace) -> dict[str, Any]:
    """Share of an iteration that the geographic losses take: blocks of iterations with and without, in turn."""
    trainer, device = _trainer(arguments), arguments.backend
    problem, loss = trainer.problem, trainer.problem.loss

    def nothing() -> Tensor:
        return 0.0 * problem.unknowns.w.sum()

    seconds: dict[str, list[float]] = {"with": [], "without": []}
    for _ in range(5):
        trainer.step()
    for _ in range(arguments.blocks):
        for name, term in (("with", loss), ("without", nothing)):
            object.__setattr__(problem, "loss", term)
            start = now(device)
            for _ in range(arguments.block):
                trainer.step()
            seconds[name].append((now(device) - start) / arguments.block)
    whole, rest = (statistics.median(seconds[name]) for name in ("with", "without"))
    return {
        "iteration_ms": round(1e3 * whole, 3),
        "without_ms": round(1e3 * rest, 3),
        "share": round(1 - rest / whole, 4),
        "target_share": 0.03,
        "unknowns": problem.unknowns.w.numel(),
    }


def quality(arguments: argparse.Namespace) -> dict[str, Any]:
    """PSNR of the test views against seconds of training; the time of rendering the test views does not count."""
    device, options = arguments.backend, _options(arguments)
    trainer, scene, images = trainer_on(arguments.workspace, options)
    rows, seconds, total = [], 0.0, options.effort.iterations
    while trainer.iteration < total:
        start = now(device)
        for _ in range(max(total // 12, 1)):
            if trainer.iteration < total:
                trainer.step()
        seconds += now(device) - start
        row = {"iteration": trainer.iteration, "seconds": round(seconds, 2)}
        psnr = round(psnr_of_test_views(trainer, scene, images), 3)
        rows.append({**row, "gaussians": len(trainer.optimizer.gaussians), "test_psnr_db": psnr})
        print(json.dumps({"preset": options.preset, "rows": rows}), flush=True)
    return {"preset": options.preset, "iterations": total, "rows": rows}


# Part, limit of its time in seconds, and whether it needs a workspace.
PARTS: dict[str, tuple[Callable[[argparse.Namespace], dict[str, Any]], float, bool]] = {
    "kernels": (kernels, 240.0, False),
    "parity": (parity, 60.0, False),
    "speed": (speed, 90.0, False),
    "waiting": (waiting, 60.0, True),
    "geographic": (geographic, 60.0, True),
    "quality": (quality, 150.0, True),
}


def measured(name: str, arguments: argparse.Namespace, left_s: float) -> dict[str, Any]:
    """Figures of a part, which runs in a process of its own; or why there are none."""
    _, limit_s, needs_workspace = PARTS[name]
    if needs_workspace and arguments.workspace is None:
        return {"not_measured": "give --workspace"}
    limit_s = min(limit_s, left_s)
    if limit_s <= 0:
        return {"not_measured": "the eight minutes were over"}
    command = [sys.executable, __file__, *sys.argv[1:], "--part", name]
    start = time.perf_counter()
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=limit_s, check=False
        )
        output, failure = done.stdout, _last(done.stderr) if done.returncode else None
    except subprocess.TimeoutExpired as error:
        output = (error.stdout or b"").decode() if isinstance(error.stdout, bytes) else error.stdout or ""
        failure = f"stopped after {limit_s:.0f} s"
    figures = [json.loads(line) for line in output.splitlines() if line.startswith("{")]
    entry = figures[-1] if figures else {}
    entry |= {} if failure is None else {"failed": failure}
    return {**entry, "part_s": round(time.perf_counter() - start, 1)}


def hardware(arguments: argparse.Namespace) -> dict[str, Any]:
    """Date, machine and versions, without which no figure means anything."""
    on_gpu = torch.cuda.is_available()
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "backend": arguments.backend,
        "gpu": torch.cuda.get_device_name() if on_gpu else None,
        "gpu_bytes": torch.cuda.get_device_properties(0).total_memory if on_gpu else None,
        "cuda": torch.version.cuda,
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "versions": library_versions(("torch", "gsplat", "numba", "numpy")),
    }


def _options(arguments: argparse.Namespace) -> TrainOptions:
    names = ("preset", "backend", "iterations", "max_image_size")
    given = {name: getattr(arguments, name) for name in names} | {"georeference": "joint"}  # with all that can be
    return TrainOptions.model_validate({name: value for name, value in given.items() if value is not None})


def _trainer(arguments: argparse.Namespace) -> JointTrainer:
    return trainer_on(arguments.workspace, _options(arguments))[0]


def _leaves(scene: Gaussians, dtype: torch.dtype, device: str) -> tuple[Gaussians, Tensor]:
    tensors = [tensor.detach().to(device, dtype).requires_grad_() for tensor in scene.tensors().values()]
    return Gaussians(*tensors), torch.eye(4, dtype=torch.float64, device=device).requires_grad_()


def _loss(render: Render) -> Tensor:
    """Loss to which every pixel contributes with its own weight."""
    assert render.expected_depth is not None
    random, total = (
        torch.Generator().manual_seed(0),
        torch.zeros((), dtype=torch.float64, device=render.alpha.device),
    )
    for image in (render.colour, render.alpha, render.expected_depth):
        weight = torch.randn(image.shape, generator=random, dtype=torch.float64).to(image.device)
        total = total + (weight * image).sum()
    return total


def _last(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1][:500] if lines else "ended without a message"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="JSON file to write")
    parser.add_argument("--backend", choices=["cpu", "cuda"], default="cuda")
    parser.add_argument("--workspace", type=Path, help="with init-sim3 done; a copy of it, for caches are written")
    parser.add_argument("--preset", default="fast", help="of the trainings")
    parser.add_argument("--iterations", type=int, help="of the trainings (default: the preset's)")
    parser.add_argument("--max-image-size", type=int, help="in pixels (default: the preset's)")
    parser.add_argument("--scenes", type=int, default=8, help="for the parity")
    parser.add_argument("--gaussians", type=int, nargs="+", default=[100_000, 300_000, 1_000_000, 3_000_000])
    parser.add_argument("--size", nargs="+", default=["600x450", "1280x960", "2000x1500"], help="WIDTHxHEIGHT …")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--blocks", type=int, default=5, help="of iterations with, and without, geographic terms")
    parser.add_argument("--block", type=int, default=20, help="iterations of a block")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.part:
        print(json.dumps(PARTS[arguments.part][0](arguments)))
        return
    start = time.perf_counter()
    report: dict[str, Any] = {"hardware": hardware(arguments)}
    for name in PARTS:
        report[name] = measured(name, arguments, TOTAL_S - _REST_S - (time.perf_counter() - start))
        print(f"{name}: {json.dumps(report[name])[:300]}", flush=True)
        report["seconds"] = round(time.perf_counter() - start, 1)
        draft = arguments.out.with_suffix(".tmp")
        draft.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
        draft.replace(arguments.out)


if __name__ == "__main__":
    main()
