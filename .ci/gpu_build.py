"""Compile gsplat's kernels for one GPU, with the compilers of the extra `cuda`, and load them; needs no GPU.

`.ci/run gpu-build` calls it in an environment of its own, which has the extra and torch's build for CUDA.
"""

import inspect
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipelines.splat.rasterizer.cuda_kernels import compile_gsplat, load_gsplat
from pipelines.splat.rasterizer.cuda_parts import compiling_parts
from tests import gsplat_on_cpu

# Types of arguments, in the words of pybind11's signatures and of the stand-ins.
_KINDS = (
    ("torch.Tensor | None", "Tensor | None"), ("torch.Tensor", "Tensor"), ("CameraModelType", "str"),
    ("SupportsInt", "int"), ("SupportsFloat", "float"), ("bool", "bool"),
)  # fmt: skip


def main() -> None:
    if torch.version.cuda is None:
        raise SystemExit(f"torch {torch.__version__} is built for the CPU: this needs its build for CUDA")
    for part in compiling_parts():
        print(f"{part.name}: {part.found or part.remedy}")
    start = time.monotonic()
    print(f"compiled {compile_gsplat()} ({time.monotonic() - start:.0f} s)")
    load_gsplat()
    compared = [
        name
        for name, stand_in in inspect.getmembers(gsplat_on_cpu, inspect.isfunction)
        if name[0] != "_" and stand_in.__module__ == gsplat_on_cpu.__name__ and name != "gsplat_on_cpu"
        if same_signature(sys.modules["gsplat.csrc"], name, stand_in)
    ]
    print(f"loaded; {len(compared)} functions take the arguments of the tests' stand-ins: {', '.join(compared)}")


def same_signature(kernels: ModuleType, name: str, stand_in: Callable[..., object]) -> bool:
    """Return true: a compiled kernel takes the arguments of what the tests put in its place, in this order."""
    compiled = getattr(kernels, name, None)
    if compiled is None:
        raise SystemExit(f"the compiled library is without {name}")
    said = re.findall(r"arg\d+: (.*?)(?=, arg\d+:|\) ->)", (compiled.__doc__ or "").splitlines()[0])
    real = [next((ours for theirs, ours in _KINDS if theirs in kind), kind) for kind in said]
    ours = [str(each.annotation) for each in inspect.signature(stand_in).parameters.values()]
    # A kernel that also takes no tensor is asked with one here.
    if len(real) != len(ours) or any(a not in (b, f"{b} | None") for a, b in zip(real, ours, strict=True)):
        raise SystemExit(f"{name} takes ({', '.join(real)}); its stand-in in the tests takes ({', '.join(ours)})")
    return True


if __name__ == "__main__":
    main()
