"""Time the rasteriser, forward and backward, over a made-up scene: python examples/benchmarks/raster.py --help.

The Gaussians lie about one spacing wide on several layers in front of the camera, as in a trained model; only a
part of them (`--visible`) is in the image, as in a survey of many views.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time

import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import RasterSettings, Render
from pipelines.splat.rasterizer.backends import rasterizer


def make_scene(count: int, camera: Pinhole, visible: float, device: str, seed: int = 0) -> Gaussians:
    """`count` Gaussians at depths 2 to 8 m, of which the fraction `visible` lies within the image's width."""
    random = torch.Generator().manual_seed(seed)
    depth = 2 + 6 * torch.rand(count, generator=random)
    across = (torch.rand(count, generator=random) - 0.5) * camera.width / visible / camera.fx
    down = (torch.rand(count, generator=random) - 0.5) * camera.height / camera.fy
    spacing_px = math.sqrt(camera.width * camera.height / (count * visible))
    log_sigma = torch.log(spacing_px * depth / camera.fx)[:, None]
    opacity = 2 * torch.randn(count, generator=random)
    tensors = (
        torch.stack([across * depth, down * depth, depth], dim=1),
        torch.randn(count, 4, generator=random),
        log_sigma + 0.5 * torch.randn(count, 3, generator=random),
        opacity,
        0.3 * torch.randn(count, 16, 3, generator=random),
    )
    return Gaussians(*(tensor.to(device).requires_grad_() for tensor in tensors))


def measure(
    arguments: argparse.Namespace, count: int, size: tuple[int, int]
) -> tuple[list[float], list[float], Render]:
    """Forward and backward times in ms, and the last render."""
    width, height = size
    camera = Pinhole(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
    device = "cuda" if arguments.backend == "cuda" else "cpu"
    gaussians = make_scene(count, camera, arguments.visible, device)
    pose = torch.eye(4, device=device, requires_grad=True)
    target = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1)).to(device)
    backend = rasterizer(arguments.backend)
    settings = RasterSettings(sh_degree=3, depth=arguments.depth)
    forward, backward = [], []
    for _ in range(arguments.repeats + 1):
        for tensor in (*gaussians.tensors().values(), pose):
            tensor.grad = None
        start = _now(device)
        render = backend.render(gaussians, pose, camera, settings)
        middle = _now(device)
        loss = (render.colour - target).abs().mean()
        if render.expected_depth is not None:
            loss = loss + render.expected_depth.mean()
        before = _now(device)
        loss.backward()
        forward.append(1000 * (middle - start))
        backward.append(1000 * (_now(device) - before))
    # The first round compiles.
    return forward[1:], backward[1:], render


def _now(device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, nargs="+", default=[10_000, 30_000, 100_000, 300_000, 1_000_000])
    parser.add_argument("--size", nargs="+", default=["661x372", "600x450"], help="WIDTHxHEIGHT …")
    parser.add_argument("--visible", type=float, default=1 / 3, help="fraction within the image")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--backend", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--depth", action="store_true", help="render depths too, with a loss on them")
    arguments = parser.parse_args()
    print("gaussians  visible       size  forward ms  backward ms   both ms  (best; both: median)")
    for size in arguments.size:
        width, height = (int(part) for part in size.split("x"))
        for count in arguments.gaussians:
            forward, backward, render = measure(arguments, count, (width, height))
            both = statistics.median(a + b for a, b in zip(forward, backward, strict=True))
            print(
                f"{count:9d} {len(render.stats.visible):8d} {size:>10s} {min(forward):11.1f} {min(backward):12.1f}"
                f" {min(a + b for a, b in zip(forward, backward, strict=True)):9.1f}  ({both:.1f})"
            )


if __name__ == "__main__":
    main()
