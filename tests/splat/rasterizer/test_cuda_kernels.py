"""What the cuda backend needs, on made-up machines, and the compilation of its kernels by a made-up gsplat."""

from __future__ import annotations

import ctypes
import subprocess
import sys
import sysconfig
import threading
import time
from importlib import metadata
from types import SimpleNamespace

import pytest
import torch

from pipelines.core.errors import BackendUnavailableError, InputError
from pipelines.core.progress import SILENT
from pipelines.splat.rasterizer import cuda_kernels, cuda_parts
from pipelines.splat.rasterizer.backends import chosen_backend, rasterizer
from pipelines.splat.rasterizer.cuda_kernels import compile_gsplat, kernels_file, kernels_ready, missing_for_cuda
from tests.refusals import refused

HEADERS = ("cuda_runtime.h", "crt/host_config.h", "cccl/cuda/std/type_traits", "cublas_v2.h", "cusolverDn.h")
# Stands for gsplat: its import "compiles" as long as the test wants, and leaves a library that Python can load.
BACKEND = """
import os, pathlib, time
folder = pathlib.Path(os.environ["TORCH_EXTENSIONS_DIR"]) / "gsplat_cuda"
folder.mkdir()
(folder / "a.o").touch()
with open(os.environ["SPY"], "a") as spy:
    spy.write(os.environ["CUDA_HOME"] + "|" + os.environ["TORCH_CUDA_ARCH_LIST"] + "\\n")
while not os.path.exists(os.environ["GO"]):
    time.sleep(0.02)
if "FAIL" in os.environ:
    print("a.cu(3): error: no such thing")
    raise SystemExit(1)
(folder / "gsplat_cuda.so").write_text("library")
_C = object()
"""


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine with everything but compiled kernels: a driver, a GPU, gsplat, a compiler in wheels."""
    home = tmp_path / "nvidia" / "cu13"
    for name in (*HEADERS, "cusparse.h"):
        (home / "include" / name).parent.mkdir(parents=True, exist_ok=True)
        (home / "include" / name).touch()
    (home / "lib").mkdir()
    (home / "lib" / "libcudart.so.13").touch()
    nvcc = home / "bin" / "nvcc"
    nvcc.parent.mkdir()
    nvcc.write_text("#!/bin/sh\necho Cuda compilation tools, release 13.0, V13.0.88\n")
    nvcc.chmod(0o755)
    package = tmp_path / "site" / "gsplat"
    (package / "cuda" / "csrc").mkdir(parents=True)
    for name in ("__init__.py", "cuda/__init__.py", "cuda/csrc/a.cu", "cuda/csrc/b.cpp", "cuda/ext.cpp"):
        (package / name).touch()
    (package / "cuda" / "_backend.py").write_text(BACKEND)
    (tmp_path / "site" / "gsplat-1.5.3.dist-info").mkdir()
    (tmp_path / "site" / "gsplat-1.5.3.dist-info" / "METADATA").write_text("Name: gsplat\nVersion: 1.5.3\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)
    (tmp_path / "empty").mkdir()
    monkeypatch.setattr(cuda_parts, "_homes", lambda: iter([tmp_path / "empty", home]))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda index: "GPU")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (8, 9))
    driver = SimpleNamespace(version=13010)

    def version_of_driver(reference) -> int:
        reference._obj.value = driver.version
        return 0

    library = SimpleNamespace(cuDriverGetVersion=version_of_driver)
    native = SimpleNamespace(c_int=ctypes.c_int, byref=ctypes.byref, CDLL=lambda name: library)
    monkeypatch.setattr(cuda_parts, "ctypes", native)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("GO", str(tmp_path / "go"))
    monkeypatch.setenv("SPY", str(tmp_path / "spy"))
    for name in ("TORCH_EXTENSIONS_DIR", "TORCH_CUDA_ARCH_LIST", "CXX", "CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    return SimpleNamespace(root=tmp_path, home=home, nvcc=nvcc, package=package, driver=driver)


def test_nothing_is_missing(machine):
    parts = (*cuda_parts.running_parts(), *cuda_parts.compiling_parts())
    assert [part.name for part in parts if part.found is None] == []
    assert missing_for_cuda() is None
    assert chosen_backend("cuda") == chosen_backend("auto") == "cuda"
    assert chosen_backend("cpu") == "cpu"


def _no_driver(name):
    raise OSError(name)


def _no_gsplat(patch):
    def version(name):
        raise metadata.PackageNotFoundError(name)

    missing = SimpleNamespace(version=version, PackageNotFoundError=metadata.PackageNotFoundError)
    patch.setattr(cuda_parts, "metadata", missing)


def _no_python_headers(patch):
    folders = SimpleNamespace(get_paths=lambda: {"include": "/nowhere"}, get_path=sysconfig.get_path)
    patch.setattr(cuda_parts, "sysconfig", folders)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda m, p: p.setattr(torch.version, "cuda", None), "no CUDA build of torch: .* is built for the CPU"),
        (
            lambda m, p: p.setattr(cuda_parts.ctypes, "CDLL", _no_driver),
            "no NVIDIA driver: .* Install NVIDIA",
        ),
        (lambda m, p: setattr(m.driver, "version", 12040), "it knows CUDA 12.4, torch is built for 13.0"),
        (lambda m, p: p.setattr(torch.cuda, "device_count", lambda: 0), "no CUDA device: torch sees none"),
        (lambda m, p: _no_gsplat(p), r"no gsplat: pip install '.*\[cuda\]'"),
        (lambda m, p: m.nvcc.unlink(), r"no CUDA compiler \(nvcc\): pip install '.*\[cuda\]'"),
        (lambda m, p: p.setattr(torch.version, "cuda", "12.8"), "is CUDA 13.0, torch is built for 12.8"),
        (lambda m, p: (m.home / "include" / HEADERS[2]).unlink(), "without those of nvidia-cuda-cccl"),
        (lambda m, p: p.setenv("CXX", "no-such-compiler"), r"no C\+\+ compiler: no-such-compiler missing"),
        (lambda m, p: _no_python_headers(p), "no header of Python: .* python3-dev"),
    ],
)
def test_one_missing_part_is_named_alone(machine, monkeypatch, change, told):
    """The message of `train --backend cuda` names that part, with its remedy, and no other."""
    change(machine, monkeypatch)
    with pytest.raises(BackendUnavailableError, match=told):
        rasterizer("cuda")
    parts = (*cuda_parts.running_parts(), *cuda_parts.compiling_parts())
    assert len([part for part in parts if part.found is None]) == 1


def test_auto_says_why_the_gpu_is_idle(machine, caplog):
    machine.nvcc.unlink()
    assert chosen_backend("auto") == "cpu"
    assert "the GPU is not used: no CUDA compiler" in caplog.text


def test_auto_without_a_gpu_is_silent(machine, monkeypatch, caplog):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert rasterizer("auto").name == "cpu"
    assert caplog.text == ""


def test_named_toolkit_decides(machine, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("CUDA_HOME", str(machine.root / "empty"))
    assert cuda_parts.toolkit_home() is None
    monkeypatch.setenv("CUDA_HOME", str(machine.home))
    assert cuda_parts.toolkit_home() == machine.home


def test_kernels_are_compiled_once_with_progress(machine):
    class Bar:
        done, notes = 0, []

        def task(self, name, total=None):
            assert total == 4  # three sources, and the link
            return self

        def advance(self, steps=1, note="", left_s=None):
            Bar.done += steps

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

    (machine.root / "go").touch()
    library = compile_gsplat(Bar())
    assert library == kernels_file()
    assert kernels_ready() == str(library)
    assert library.read_text() == "library"
    assert library.parent.name == "8.9"
    assert [path.name for path in library.parent.iterdir() if path.is_dir()] == []
    assert compile_gsplat(SILENT) == library
    assert (machine.root / "spy").read_text() == f"{machine.home}|8.9\n"


def test_kernels_of_another_gpu_do_not_count(machine, monkeypatch):
    (machine.root / "go").touch()
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.0 8.6+PTX")
    assert compile_gsplat().parent.name == "8.0_8.6"
    assert kernels_file() is None
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (8, 6))
    assert kernels_file() is not None


def test_without_gpu_the_architecture_must_be_named(machine, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with refused("gpu-unknown", InputError) as error:
        compile_gsplat()
    assert "TORCH_CUDA_ARCH_LIST" in str(error.value)
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "../../etc")
    with refused("compute-capability", InputError):
        compile_gsplat()
    (machine.root / "go").touch()
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "9.0")
    assert compile_gsplat() == kernels_file()


def test_failed_compilation_leaves_a_log_and_no_library(machine, monkeypatch):
    (machine.root / "go").touch()
    monkeypatch.setenv("FAIL", "1")
    with pytest.raises(BackendUnavailableError, match=r"a\.cu\(3\): error: no such thing.*compile\.log"):
        compile_gsplat()
    assert kernels_file() is None


def test_interrupt_ends_the_compilers(machine, monkeypatch):
    """Two seconds after the start the user interrupts: no process of the compilation lives on."""
    begun = []

    def popen(*arguments, **options):
        begun.append(subprocess.Popen(*arguments, **options))
        return begun[-1]

    def interrupt(seconds):
        if (machine.root / "spy").exists():
            raise KeyboardInterrupt
        time.sleep(0.05)

    monkeypatch.setattr(cuda_kernels, "subprocess", SimpleNamespace(**{**vars(subprocess), "Popen": popen}))
    monkeypatch.setattr(cuda_kernels, "time", SimpleNamespace(sleep=interrupt))
    with pytest.raises(KeyboardInterrupt):
        compile_gsplat()
    assert begun[0].poll() is not None
    assert kernels_file() is None


def test_second_process_waits_for_the_first(machine):
    """Both ask at once; one compiles, and both get the library."""
    found = []
    askers = [threading.Thread(target=lambda: found.append(compile_gsplat())) for _ in range(2)]
    for asker in askers:
        asker.start()
    (machine.root / "go").touch()
    for asker in askers:
        asker.join()
    assert len(set(found)) == 1
    assert len((machine.root / "spy").read_text().splitlines()) == 1


def test_backend_names():
    with refused("rasteriser-unknown", BackendUnavailableError):
        rasterizer("vulkan")
