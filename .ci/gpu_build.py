"""Compile gsplat's kernels for one GPU, with the compilers of the extra `cuda`, and load them; needs no GPU.

`.ci/run gpu-build` calls it in an environment of its own, which has the extra and torch's build for CUDA.
"""

import inspect
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from pipelines.splat.rasterizer.cuda_kernels import compile_gsplat, load_gsplat
from pipelines.splat.rasterizer.cuda_parts import compiling_parts
from tests import gsplat_on_cpu


def main() -> None:
    if torch.version.cuda is None:
        raise SystemExit(f"torch {torch.__version__} is built for the CPU: this needs its build for CUDA")
    for part in compiling_parts():
        print(f"{part.name}: {part.found or part.remedy}")
    print("compiled", compile_gsplat())
    load_gsplat()
    kernels = sys.modules["gsplat.csrc"]
    # What the tests put in place of the kernels must be what the compiled library has.
    stood_in = [name for name, _ in inspect.getmembers(gsplat_on_cpu, inspect.isfunction) if name[0] != "_"]
    missing = [name for name in stood_in if name != "gsplat_on_cpu" and not hasattr(kernels, name)]
    if missing:
        raise SystemExit(f"the compiled library is without {', '.join(missing)}")
    print("loaded, with", len(stood_in) - 1, "functions that the tests have stand-ins for")


if __name__ == "__main__":
    main()
