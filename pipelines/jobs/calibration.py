"""Speed of this machine against that of the cost models: measured once in seconds, kept in the user's cache.

Some iterations of a training are run on a made-up scene, and the least processor time counts: other programs take
hardly any of that away, unlike the time of the clock. Another number of threads, processor or version of the
kernels is measured anew. Until the kernels are compiled, the machine counts as that of the cost models.
"""

import json
import logging
import time
from functools import cache
from pathlib import Path

import llvmlite.binding as llvm
import torch

from pipelines.core.files import replace_text
from pipelines.core.machine import thread_count, user_cache
from pipelines.geometry.cameras import Pinhole
from pipelines.jobs.costs import ITERATION_SECONDS, MEASURED_CORES
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.kernel_cache import compilation_stamp
from pipelines.splat.losses import photometric_loss
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer

log = logging.getLogger(__name__)

_COMPILER = "pipelines.train.compilation"  # the module that leaves a stamp once all kernels are compiled
_CAMERA, _GAUSSIANS = Pinhole(480, 360, 400.0, 400.0, 240.0, 180.0), 60_000
_MODELLED_S = ITERATION_SECONDS.of(_CAMERA.width * _CAMERA.height, _GAUSSIANS / 3, _GAUSSIANS)
_LONGEST_S, _FEWEST, _MOST = 4.0, 3, 12  # of the measurement, and its iterations
_MOST_CORES = 16  # beyond, the kernels gain little
_SLOWEST = 100.0  # factor: beyond it, or below its inverse, a file is damaged


def machine_factor() -> float:
    """Return how many times as long as in the cost models anything takes on this machine, with its threads."""
    threads, stamp = thread_count(), compilation_stamp(_COMPILER)
    key = f"{stamp.parent.name} {llvm.get_host_cpu_name()} {threads} {_MODELLED_S:.4f}"
    return _factor(threads, key, stamp.exists())


@cache
def _factor(threads: int, key: str, compiled: bool) -> float:
    file = user_cache() / "speed.json"
    if (kept := _kept(file, key)) is not None:
        return kept
    if not compiled:
        return MEASURED_CORES / min(threads, _MOST_CORES)
    factor = _processor_s() / min(threads, _MOST_CORES) / _MODELLED_S
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        replace_text(file, json.dumps({"key": key, "factor": factor}))
    except OSError as error:
        log.debug("the speed of this machine cannot be kept in %s: %s", file, error)
    return factor


def _kept(file: Path, key: str) -> float | None:
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        factor = float(document["factor"])
        return factor if document["key"] == key and 1 / _SLOWEST < factor < _SLOWEST else None
    except (OSError, ValueError, TypeError, KeyError, RecursionError):  # missing, or damaged
        return None


def _processor_s() -> float:
    """Return the processor seconds of the fastest of some iterations."""
    random = torch.Generator().manual_seed(0)
    depth = 2 + 6 * torch.rand(_GAUSSIANS, generator=random)
    # A third of the Gaussians is in view, as in the measurements of the cost models.
    across = (torch.rand(_GAUSSIANS, generator=random) - 0.5) * 3 * _CAMERA.width / _CAMERA.fx
    down = (torch.rand(_GAUSSIANS, generator=random) - 0.5) * _CAMERA.height / _CAMERA.fy
    spacing_px = (3 * _CAMERA.width * _CAMERA.height / _GAUSSIANS) ** 0.5
    log_sigma = torch.log(spacing_px * depth / _CAMERA.fx)[:, None]
    tensors = (
        torch.stack([across * depth, down * depth, depth], dim=1),
        torch.randn(_GAUSSIANS, 4, generator=random),
        log_sigma + 0.5 * torch.randn(_GAUSSIANS, 3, generator=random),
        2 * torch.randn(_GAUSSIANS, generator=random),
        0.3 * torch.randn(_GAUSSIANS, 16, 3, generator=random),
    )
    adam = GaussianAdam(Gaussians(*(tensor.requires_grad_() for tensor in tensors)), 1.0, _MOST)
    target = torch.rand(_CAMERA.height, _CAMERA.width, 3, generator=random)
    taken: list[float] = []
    backend, pose, began = CpuRasterizer(), torch.eye(4), time.monotonic()
    while len(taken) < _FEWEST or (len(taken) < _MOST and time.monotonic() - began < _LONGEST_S):
        start = time.process_time()
        shown = adam.show(backend.candidates(adam.gaussians, pose, _CAMERA, RasterSettings()))
        render = backend.render(shown, pose, _CAMERA, RasterSettings())
        photometric_loss(render.colour, target).backward()
        adam.step(len(taken) + 1, render.stats.visible)
        taken.append(time.process_time() - start)
    return min(taken)
