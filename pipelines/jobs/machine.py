"""The machine: cores, memory, GPU, backends and their kernels, grids of PROJ, Chromium, versions of libraries."""

import platform
from dataclasses import dataclass

import torch

from pipelines.core.errors import BackendUnavailableError
from pipelines.core.extras import CORE_MB, EXTRAS, SIZES_MB, Part, extra_part
from pipelines.core.fingerprints import library_versions
from pipelines.core.machine import available_cores, thread_count, total_main_memory_bytes
from pipelines.core.progress import Progress
from pipelines.geodesy.operations import grid_folders, installed_grids
from pipelines.report.chromium import find_chromium
from pipelines.splat.memory import free_memory_bytes
from pipelines.splat.rasterizer.api import BackendName
from pipelines.splat.rasterizer.backends import BACKENDS, chosen_backend
from pipelines.splat.rasterizer.cuda_kernels import compile_gsplat, kernels_ready
from pipelines.splat.rasterizer.cuda_parts import compiling_parts, running_parts

_LIBRARIES = (
    *("numpy", "scipy", "numba", "torch", "gsplat", "cuda-toolkit", "pycolmap", "opencv-contrib-python-headless"),
    *("pyproj", "rasterio", "laspy", "matplotlib", "click", "rich"),
)


@dataclass(frozen=True)
class Gpu:
    """GPU that torch sees, and its memory."""

    name: str
    bytes: int


@dataclass(frozen=True)
class BackendState:
    """Rasteriser backend: whether it can be used, and the reason why not."""

    name: str
    available: bool
    reason: str


@dataclass(frozen=True)
class Machine:
    """Parts and limits of this machine, as `inspect_machine` finds them."""

    system: str  # name, release, and the processor's architecture
    python: str
    cores: int  # that this process may use
    threads: int  # that stages compute with (`--threads`)
    memory_bytes: int  # main memory
    free_bytes: int | None  # of it; None: not known
    gpus: tuple[Gpu, ...]
    backends: tuple[BackendState, ...]
    extras: tuple[Part, ...]  # optional libraries, by the extra that installs them
    sizes_mb: dict[str, int]  # on the disk, about: `core`, and what each extra adds
    cuda_parts: tuple[Part, ...]  # what the cuda backend needs, and what compiles its kernels
    cuda_kernels: str | None  # place of the compiled kernels; None: the first use compiles them
    grid_folders: tuple[str, ...]  # where PROJ looks for grids
    grids: tuple[str, ...]  # file names of the geoid models and datum shifts
    chromium: str | None  # path of Chromium or Chrome; None: not found
    versions: dict[str, str]


def inspect_machine() -> Machine:
    """Return what the machine offers: system, cores, memory in bytes, GPUs, backends and extras."""
    devices = range(torch.cuda.device_count() if torch.cuda.is_available() else 0)
    gpus = (torch.cuda.get_device_properties(index) for index in devices)
    return Machine(
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        python=platform.python_version(),
        cores=available_cores(),
        threads=thread_count(),
        memory_bytes=total_main_memory_bytes(),
        free_bytes=free_memory_bytes(torch.device("cpu")),
        gpus=tuple(Gpu(properties.name, int(properties.total_memory)) for properties in gpus),
        backends=tuple(_backend(name) for name in BACKENDS),
        extras=tuple(map(extra_part, EXTRAS)),
        sizes_mb={"core": CORE_MB} | {str(name): size for name, size in SIZES_MB.items()},
        cuda_parts=(*running_parts(), *compiling_parts()),
        cuda_kernels=kernels_ready(),
        grid_folders=tuple(map(str, grid_folders())),
        grids=tuple(installed_grids()),
        chromium=find_chromium(),
        versions=library_versions(_LIBRARIES),
    )


def compile_cuda_kernels(progress: Progress) -> None:
    """Compile the kernels of the cuda backend, unless that is done.

    Raises:
        BackendUnavailableError: a part is missing (names each), or the compiler fails (names its log).
        InputError: neither a GPU nor the variable TORCH_CUDA_ARCH_LIST tells what to compile for.
    """
    if kernels_ready() is None:
        compile_gsplat(progress)


def _backend(name: BackendName) -> BackendState:
    try:
        chosen_backend(name)
    except BackendUnavailableError as error:
        return BackendState(name, False, str(error))
    return BackendState(name, True, "")
