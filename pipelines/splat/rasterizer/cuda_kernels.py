"""gsplat with its kernels: compiled once for this torch and these GPUs, and kept in the user's cache.

gsplat compiles at its first import, in that process, in silence, and two processes at once delete each other's
work. Here a child process compiles, one at a time, in a draft, and the library is renamed when it is complete.
Later runs load that library, and need no compiler.
"""

import contextlib
import importlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from types import ModuleType

import torch

from pipelines.core.child import python_command, python_environment
from pipelines.core.errors import BackendUnavailableError, InputError, WorkspaceBusyError
from pipelines.core.files import replace_file
from pipelines.core.lock import WriteLock
from pipelines.core.machine import free_main_memory_bytes, thread_count
from pipelines.core.progress import SILENT, Progress
from pipelines.splat.rasterizer.cuda_parts import (
    compiling_parts,
    gsplat,
    lacking,
    running_parts,
    tool_folders,
    toolkit_home,
)

_NAME = "gsplat_cuda"
_LIBRARY = f"{_NAME}.pyd" if sys.platform == "win32" else f"{_NAME}.so"
_COMPILE = "from gsplat.cuda import _backend; raise SystemExit(_backend._C is None)"
_JOB_BYTES = 3 * 2**30  # of one compiler: the blending of gsplat takes 2.5 GiB
_PAUSE_S = 0.5
_MOST_OF_A_LINE = 300


def kernels_file() -> Path | None:
    """Return the compiled kernels that run on every GPU of this machine; None: they have to be compiled.

    Without a GPU, kernels for any GPU count.
    """
    needed = set(_capabilities())
    files = sorted(_folder().glob(f"*/{_LIBRARY}")) if _folder().is_dir() else []
    return next((file for file in files if needed <= set(file.parent.name.split("_"))), None)


def compile_gsplat(progress: Progress = SILENT) -> Path:
    """Compile gsplat's kernels and return their library. This needs no GPU, and minutes.

    They are compiled for the GPUs of this machine, or for those that the variable TORCH_CUDA_ARCH_LIST names.

    Raises:
        BackendUnavailableError: a part is missing (names each), or the compiler fails (names its log).
        InputError: neither a GPU nor the variable tells what to compile for, or the cache cannot be written.
    """
    missing = lacking((gsplat(), *compiling_parts()))
    if missing is not None:
        message = f"The kernels of the cuda backend cannot be compiled: {missing}."
        raise BackendUnavailableError("cuda-compiler-missing", message)
    folder = _folder() / "_".join(_architectures())
    with _alone_in(folder):
        library = folder / _LIBRARY
        if not library.is_file():
            draft = folder / "draft"
            shutil.rmtree(draft, ignore_errors=True)
            draft.mkdir()
            _compile(draft, folder / "compile.log", progress)
            replace_file(draft / _NAME / _LIBRARY, library)
            shutil.rmtree(draft, ignore_errors=True)
    return library


def load_gsplat(progress: Progress = SILENT) -> ModuleType:
    """Return gsplat with its kernels, which are compiled first if need be.

    Raises:
        BackendUnavailableError: gsplat, or a part that compiles it, is missing, or the compiler fails.
        InputError: the cache cannot be written.
    """
    try:
        if not _prebuilt() and "gsplat.csrc" not in sys.modules:
            library = kernels_file() or compile_gsplat(progress)
            specification = importlib.util.spec_from_file_location(_NAME, library)
            assert specification is not None and specification.loader is not None
            kernels = importlib.util.module_from_spec(specification)
            specification.loader.exec_module(kernels)
            # Where gsplat looks for kernels that its wheel brings, before it compiles.
            sys.modules["gsplat.csrc"] = kernels
        return importlib.import_module("gsplat")
    except ImportError as error:
        remedy = f"Delete {_folder()} and run the command again, or use the cpu backend."
        raise BackendUnavailableError(
            "gsplat-unloadable", f"gsplat cannot be loaded ({error}). {remedy}"
        ) from error


def missing_for_cuda() -> str | None:
    """Return what the cuda backend lacks on this machine, each part with its remedy; None: nothing."""
    return lacking(running_parts() if kernels_ready() is not None else (*running_parts(), *compiling_parts()))


def kernels_ready() -> str | None:
    """Return the place of the kernels, if no compiler is needed to use gsplat; else None."""
    return "in gsplat's wheel" if _prebuilt() else None if (file := kernels_file()) is None else str(file)


def _prebuilt() -> bool:
    """Return whether the installed gsplat is a build with kernels, for this torch and CUDA."""
    spec = importlib.util.find_spec("gsplat")
    places = (spec.submodule_search_locations or ()) if spec is not None else ()
    return any(path.suffix in (".so", ".pyd") for place in places for path in Path(place).glob("csrc.*"))


def _folder() -> Path:
    """Return the folder of all kernels for this gsplat, torch and Python."""
    cache = os.environ.get("TORCH_EXTENSIONS_DIR")
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "georef"
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    parts = ("gsplat", _version("gsplat"), "torch", torch.__version__, f"cu{torch.version.cuda}", python)
    return (Path(cache) if cache else user) / "-".join(parts)


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "none"


def _capabilities() -> list[str]:
    """Return the compute capabilities of the GPUs of this machine (`8.9`)."""
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    capabilities = {torch.cuda.get_device_capability(index) for index in range(count)}
    return [f"{major}.{minor}" for major, minor in sorted(capabilities)]


def _architectures() -> list[str]:
    named = os.environ.get("TORCH_CUDA_ARCH_LIST", "").replace(";", " ").split()
    architectures = sorted(name.removesuffix("+PTX") for name in named) or _capabilities()
    if not architectures:
        message = "This machine has no GPU to compile for."
        remedy = (
            "Name its compute capability in the variable TORCH_CUDA_ARCH_LIST (8.6 for the RTX 30 series, 8.9 for "
            "40, 12.0 for 50, 8.0 for A100, 9.0 for H100; several with blanks)."
        )
        raise InputError("gpu-unknown", message, remedy=remedy)
    if not all(name.replace(".", "").removesuffix("a").isdecimal() for name in architectures):
        message = f"TORCH_CUDA_ARCH_LIST is {' '.join(named)!r}; numbers like 8.6 with blanks between are expected."
        raise InputError("compute-capability", message)
    return architectures


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder; waits for another process that compiles there."""
    lock, held = WriteLock(folder), contextlib.ExitStack()
    while True:
        try:
            held.enter_context(lock.hold("the compilation of gsplat's kernels"))
            break
        except WorkspaceBusyError:
            time.sleep(_PAUSE_S)
    with held:
        yield


def _compile(draft: Path, log: Path, progress: Progress) -> None:
    """Compile in a process group of its own, whose end an interrupt brings about."""
    sources = _sources()
    with log.open("wb") as output, progress.task("compiling CUDA kernels, once", sources + 1) as task:
        process = subprocess.Popen(
            python_command(["-c", _COMPILE]),
            stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, env=_environment(draft),
            start_new_session=True,
        )  # fmt: skip
        try:
            done = 0
            while process.poll() is None:
                time.sleep(_PAUSE_S)
                now = len(list(draft.glob(f"{_NAME}/*.o")))
                task.advance(now - done, note=f"{now} of {sources} files")
                done = now
        finally:
            _end(process)
    if process.returncode != 0 or not (draft / _NAME / _LIBRARY).is_file():
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        cause = next((line for line in lines if "error" in line.lower()), "no message")[:_MOST_OF_A_LINE]
        message = f"gsplat's kernels could not be compiled ({cause.strip()}). The compiler's log is {log}."
        raise BackendUnavailableError("kernels-not-compiled", message)


def _environment(draft: Path) -> dict[str, str]:
    """Return the environment of the compilation; torch reads its variables when it is imported."""
    home = toolkit_home()
    assert home is not None  # one of the parts that were checked
    free = free_main_memory_bytes()
    jobs = max(min(thread_count(), thread_count() if free is None else free // _JOB_BYTES), 1)
    libraries = [str(_link_library(home, draft)), *filter(None, [os.environ.get("LIBRARY_PATH")])]
    return {
        "MAX_JOBS": str(jobs),
        **python_environment(),
        "CUDA_HOME": str(home),
        "LIBRARY_PATH": os.pathsep.join(libraries),
        "PATH": os.pathsep.join([*map(str, tool_folders()), os.environ.get("PATH", "")]),
        "TORCH_CUDA_ARCH_LIST": os.environ.get("TORCH_CUDA_ARCH_LIST") or ";".join(_architectures()),
        "TORCH_EXTENSIONS_DIR": str(draft),
        "VERBOSE": "1",
    }


def _link_library(home: Path, draft: Path) -> Path:
    """Return a folder with `libcudart.so`: the wheel of the runtime holds `libcudart.so.13` alone."""
    folder = draft / "lib"
    folder.mkdir()
    runtime = next(
        (path for name in ("lib64", "lib") for path in sorted((home / name).glob("libcudart.so*"))), None
    )
    if runtime is not None:
        (folder / "libcudart.so").symlink_to(runtime)
    return folder


def _sources() -> int:
    patterns = ("cuda/csrc/*.cu", "cuda/csrc/*.cpp", "cuda/*.cpp")
    spec = importlib.util.find_spec("gsplat")
    places = (spec.submodule_search_locations or ()) if spec is not None else ()
    return sum(len(list(Path(place).glob(pattern))) for place in places for pattern in patterns)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        if hasattr(os, "killpg"):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.wait()
