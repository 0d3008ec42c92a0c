"""Compilation of the kernels of a training before their first use, on data of a few pixels.

A machine compiles them once. `georef run` does so in a child process while COLMAP reconstructs, so that the
training finds them in the user's cache.
"""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import torch

from pipelines.core.child import start_in_child
from pipelines.core.errors import InputError, WorkspaceBusyError
from pipelines.core.json_values import JsonValue
from pipelines.core.lock import WriteLock
from pipelines.core.progress import SILENT, Progress
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.splat.exposure import Exposures
from pipelines.splat.initialise import InitialisationOptions, gaussians_from_points
from pipelines.splat.kernel_cache import cache_folder, compilation_stamp
from pipelines.splat.losses import photometric_loss
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.surface.agreement import agreed_depth
from pipelines.surface.depth_maps import LEVELS
from pipelines.surface.matching import StereoView
from pipelines.surface.sweep import SweepPlanes, plane_sweep

_PATIENCE_S = 600.0
_COMPILATION_S = 45.0  # on two cores, beside a reconstruction
_WIDTH, _HEIGHT = 48, 32
_DOWN = np.diag([1.0, -1.0, -1.0])


def compilation_s() -> float:
    """Return the seconds, about, by which a run that compiles takes longer; 0: the user's cache has the kernels."""
    return 0.0 if compilation_stamp(__name__).exists() else _COMPILATION_S


def start_compilation() -> None:
    """Start a child process that compiles what the user's cache lacks. It ends with this process."""
    if not compilation_stamp(__name__).exists():
        start_in_child(f"{__name__}:compile_in_child")


def compile_in_child(_arguments: Mapping[str, JsonValue], progress: Progress) -> None:
    """Compile as `compile_kernels`, at the priority of a training that may wait for it: task of `core.child`.

    Where another process compiles already, it does so for this one too.
    """
    with suppress(WorkspaceBusyError):
        compile_kernels(progress, patience_s=0.0)


def compile_kernels(progress: Progress = SILENT, *, renders: bool = True, patience_s: float = _PATIENCE_S) -> None:
    """Compile the kernels of stereo and rendering that the user's cache lacks, and load the others.

    Without `renders` those of stereo only: another backend than that of the CPU renders. One process
    compiles at a time: the others wait, and load what it has compiled.

    Raises:
        WorkspaceBusyError: another process compiles, and there is no patience.
    """
    steps = {"stereo": _match, "rendering": _render} if renders else {"stereo": _match}
    with progress.task("kernels, compiled once", len(steps)) as task, _only_one(patience_s):
        for name, step in steps.items():
            step()
            task.advance(note=name)
        stamp = compilation_stamp(__name__)
        with suppress(OSError):
            if renders:
                stamp.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                stamp.touch()


@contextmanager
def _only_one(patience_s: float) -> Iterator[None]:
    with ExitStack() as stack:
        try:
            stack.enter_context(WriteLock(cache_folder()).hold("the compilation of kernels", patience_s))
        except InputError:
            pass  # Without a cache each process compiles for itself.
        except WorkspaceBusyError:
            if patience_s == 0.0:
                raise
        yield


def _render() -> None:
    """Take one step of a training: render, compare, and move three Gaussians."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.1]])
    start = gaussians_from_points(points, np.full((3, 3), 128), InitialisationOptions(sh_degree=3))
    optimizer = GaussianAdam(start, extent_m=1.0, iterations=2)
    pose = torch.eye(4)
    pose[2, 3] = 4.0
    view = CpuRasterizer().render(
        optimizer.gaussians, pose, Pinhole(_WIDTH, _HEIGHT, 40.0, 40.0, 24.0, 16.0), RasterSettings(depth=True)
    )
    assert view.expected_depth is not None
    exposures = Exposures(torch.eye(3, 4)[None], torch.zeros(1, dtype=torch.int64), iterations=2)
    loss = photometric_loss(
        exposures.apply(0, view.colour, torch.zeros(_HEIGHT, _WIDTH)),
        torch.zeros_like(view.colour),
        torch.ones(_HEIGHT, _WIDTH, dtype=torch.bool),
    )
    (loss + view.expected_depth.sum()).backward()
    optimizer.step(1, view.stats.visible)


def _match() -> None:
    """Sweep planes through two views of a textured ground, and compare their depths."""
    grey = np.random.default_rng(0).integers(1, 256, (_HEIGHT, _WIDTH), dtype=np.uint8)
    pinhole = Pinhole(_WIDTH, _HEIGHT, 40.0, 40.0, 24.0, 16.0)
    views = [StereoView(ViewPose(pinhole, _DOWN, np.array([east, 0.0, 10.0])), grey) for east in (0.0, 1.0)]
    planes = [SweepPlanes(np.array([0.0, 0.0, 1.0]), np.linspace(-1, 1, 4))]
    sweeps = [
        plane_sweep(one, [other], planes, match)
        for match in (level.settings for level in LEVELS)
        for one, other in (views, views[::-1])
    ]
    agreed_depth(sweeps[0], sweeps[1:2])
