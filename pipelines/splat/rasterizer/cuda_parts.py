"""Parts that the cuda backend needs on a machine: where each was found, or how to get it.

gsplat's wheel holds the sources of its kernels, which the first use compiles. The extra `cuda` brings the compiler
as wheels, in the version of CUDA that torch is built for. torch looks for no compiler there: `toolkit_home` does.
"""

import ctypes
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import torch

from pipelines.core.extras import Part, installing

_WINDOWS = sys.platform == "win32"
_DRIVER = "nvcuda.dll" if _WINDOWS else "libcuda.so.1"
_NVCC = "nvcc.exe" if _WINDOWS else "nvcc"
# A header of each package that gsplat's and torch's sources include, by the wheel that holds it.
_HEADERS = {
    "cuda_runtime.h": "nvidia-cuda-runtime",
    "crt/host_config.h": "nvidia-cuda-crt",
    "cuda/std/type_traits": "nvidia-cuda-cccl",
    "cublas_v2.h": "nvidia-cublas",
    "cusolverDn.h": "nvidia-cusolver",
    "cusparse.h": "nvidia-cusparse",
}
_EXTRA = installing("cuda")


def running_parts() -> tuple[Part, ...]:
    """Return the parts that every use of the backend needs, in the order in which to install them.

    Without a CUDA build of torch or a driver, nothing is said of devices: there cannot be any.
    """
    base = (_driver(), _torch_build())
    device = () if lacking(base) is not None else (_device(),)
    return (*base, *device, gsplat())


def compiling_parts() -> tuple[Part, ...]:
    """Return the parts that compile gsplat's kernels, in the order in which to install them."""
    compiler = _nvcc()
    headers = () if compiler.found is None else (_headers(),)
    return (compiler, *headers, _host_compiler(), _ninja(), _python_headers())


def gsplat() -> Part:
    """Return gsplat with its version, or the command that installs it."""
    try:
        return Part("gsplat", f"gsplat {metadata.version('gsplat')}", "")
    except metadata.PackageNotFoundError:
        return Part("gsplat", None, _EXTRA)


def lacking(parts: tuple[Part, ...]) -> str | None:
    """Return what is missing of the parts, each with its remedy, as one text; None: nothing."""
    missing = [f"no {part.name}: {part.remedy}" for part in parts if part.found is None]
    return "; ".join(missing) or None


def toolkit_home() -> Path | None:
    """Return the folder of the CUDA toolkit to compile with; None: there is no nvcc.

    The variable CUDA_HOME decides, if it is set. Else a toolkit with headers precedes one without, and the wheels
    of torch's version of CUDA precede toolkits of the system, whose version may differ.
    """
    homes = [home for home in _homes() if (home / "bin" / _NVCC).is_file()]
    whole = (home for home in homes if (home / "include" / "cuda_runtime.h").is_file())
    return next(whole, homes[0] if homes else None)


def tool_folders() -> tuple[Path, ...]:
    """Return the folders of programs of this environment, which are on PATH only if it was activated."""
    return (Path(sysconfig.get_path("scripts")), Path(sys.executable).parent)


def _homes() -> Iterator[Path]:
    named = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    if named:
        yield Path(named)
        return
    major = (torch.version.cuda or "").partition(".")[0]
    wheels = importlib.util.find_spec("nvidia")
    for folder in (wheels.submodule_search_locations or ()) if wheels is not None else ():
        yield Path(folder) / f"cu{major}"
    on_path = shutil.which("nvcc")
    if on_path is not None:
        yield Path(on_path).resolve().parents[1]
    yield Path("/usr/local/cuda")


def _torch_build() -> Part:
    name = "CUDA build of torch"
    if torch.version.cuda is None:
        remedy = f"torch {torch.__version__} is built for the CPU: install its build for CUDA (pytorch.org)"
        return Part(name, None, remedy)
    return Part(name, f"torch {torch.__version__} for CUDA {torch.version.cuda}", "")


def _driver() -> Part:
    name, version = "NVIDIA driver", ctypes.c_int(0)
    try:
        ctypes.CDLL(_DRIVER).cuDriverGetVersion(ctypes.byref(version))
    except (OSError, AttributeError):
        remedy = (
            f"{_DRIVER} was not found. Install NVIDIA's driver. Give a container the GPU (docker run --gpus all)."
        )
        return Part(name, None, remedy)
    major, minor = version.value // 1000, version.value % 1000 // 10
    needed = int((torch.version.cuda or "0").partition(".")[0])
    if major < needed:
        remedy = f"it knows CUDA {major}.{minor}, torch is built for {torch.version.cuda}. Update the driver"
        return Part(f"{name} for CUDA {needed}", None, remedy)
    return Part(name, f"for CUDA {major}.{minor}", "")


def _device() -> Part:
    # is_available is False as well if the driver does not start: then names cannot be asked for.
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if count == 0:
        hidden = os.environ.get("CUDA_VISIBLE_DEVICES")
        remedy = "torch sees none" if hidden is None else f"torch sees none (CUDA_VISIBLE_DEVICES={hidden!r})"
        return Part("CUDA device", None, f"{remedy}. nvidia-smi lists those that the driver sees")
    return Part("CUDA device", ", ".join(torch.cuda.get_device_name(index) for index in range(count)), "")


def _nvcc() -> Part:
    name, home = "CUDA compiler (nvcc)", toolkit_home()
    if home is None:
        return Part(name, None, f"{_EXTRA}, or name a CUDA toolkit in the variable CUDA_HOME")
    version = _version_of(home / "bin" / _NVCC, r"release (\d+\.\d+)")
    if version is None:
        return Part(name, None, f"{home / 'bin' / _NVCC} does not run: {_EXTRA}")
    needed = torch.version.cuda or version
    if version.partition(".")[0] != needed.partition(".")[0]:
        remedy = f"{home} is CUDA {version}, torch is built for {needed}: {_EXTRA}"
        return Part(f"CUDA compiler (nvcc) of CUDA {needed}", None, remedy)
    return Part(name, f"nvcc {version} in {home}", "")


def _headers() -> Part:
    home = toolkit_home()
    assert home is not None  # the compiler was found
    places = (home / "include", home / "include" / "cccl")
    absent = [
        wheel for header, wheel in _HEADERS.items() if not any((place / header).is_file() for place in places)
    ]
    if absent:
        return Part("CUDA headers", None, f"{home} is without those of {', '.join(absent)}: {_EXTRA}")
    return Part("CUDA headers", str(home / "include"), "")


def _host_compiler() -> Part:
    name = "C++ compiler"
    if _WINDOWS:
        path = shutil.which("cl")
        remedy = "install Visual Studio's Build Tools, and run georef in their command prompt"
        return Part(name, path, "" if path else remedy)
    # torch compiles with CXX, nvcc with g++.
    programs = [os.environ.get("CXX", "c++"), "g++"]
    paths = [shutil.which(program) for program in programs]
    absent = [program for program, path in zip(programs, paths, strict=True) if path is None]
    if absent or paths[1] is None:
        remedy = "install g++ (apt-get install g++, or dnf install gcc-c++)"
        return Part(name, None, f"{' and '.join(dict.fromkeys(absent))} missing. {remedy.capitalize()}")
    version = _version_of(Path(paths[1]), r"(\d+\.\d+\.\d+)")
    return Part(name, f"g++ {version or ''} in {paths[1]}", "")


def _ninja() -> Part:
    path = shutil.which("ninja", path=os.pathsep.join([*map(str, tool_folders()), os.environ.get("PATH", "")]))
    return Part("ninja", path, "" if path else "pip install ninja")


def _python_headers() -> Part:
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    remedy = f"{header} was not found. Install Python's headers (apt-get install python3-dev)"
    found = str(header) if header.is_file() else None
    return Part("header of Python", found, "" if found else remedy)


def _version_of(program: Path, pattern: str) -> str | None:
    try:
        done = subprocess.run(
            [program, "--version"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    version = re.search(pattern, done.stdout)
    return version.group(1) if version else None
