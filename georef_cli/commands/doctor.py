"""Command `georef doctor`."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from georef_cli import options
from georef_cli.command import Command
from georef_cli.layout import plain_table
from georef_cli.markup import shown
from georef_cli.output import print_json, print_rich

if TYPE_CHECKING:
    from pipelines.machine.inspection import Machine

_MOST_GRIDS = 12


def _doctor(as_json: bool) -> None:
    from pipelines.machine.inspection import inspect_machine

    machine = inspect_machine()
    if as_json:
        print_json(dataclasses.asdict(machine))
        return
    table = plain_table("", "", header=False)
    table.columns[1].overflow = "fold"
    for name, text in _lines(machine):
        table.add_row(f"[bold]{name}[/]", text)
    print_rich(table)


def _lines(machine: Machine) -> list[tuple[str, str]]:
    """Return the findings with their names; markup."""
    gpus = [f"{shown(gpu.name)}, {_gib(gpu.bytes)}" for gpu in machine.gpus] or ["none that torch sees"]
    lines = [
        ("system", shown(f"{machine.system}, Python {machine.python}")),
        ("cores", f"{machine.cores}, of which {machine.threads} are used (-j)"),
        ("memory", f"{_gib(machine.memory_bytes)}, {_gib(machine.free_bytes)} of them free"),
        ("GPU", "; ".join(gpus)),
    ]
    for backend in machine.backends:
        state = "[green]available[/]" if backend.available else f"[yellow]no[/]: {shown(backend.reason)}"
        lines.append((f"backend {backend.name}", state))
    grids = machine.grids[:_MOST_GRIDS]
    more = f" and {len(machine.grids) - len(grids)} more" if len(machine.grids) > len(grids) else ""
    none = (
        "[yellow]none[/]: heights above a geoid need its grid (pyproj sync --file NAME); ellipsoidal ones need none"
    )
    lines += [
        ("PROJ grids", shown(", ".join(grids) + more) if grids else none),
        ("in", shown(", ".join(machine.grid_folders))),
        ("Chromium", shown(machine.chromium or "not found; `georef report --pdf` needs it")),
    ]
    versions = ", ".join(f"{name} {version}" for name, version in machine.versions.items())
    return [*lines, ("versions", shown(versions))]


def _gib(count: int | None) -> str:
    return "unknown" if count is None else f"{count / 2**30:.1f} GiB"


command = Command(
    "doctor",
    params=[options.json_option()],
    callback=_doctor,
    help="""Show what this machine offers: cores, memory, GPU, backends, geoid grids, versions.

    A backend that cannot be used is named with the reason. Nothing is written.

    \b
    Examples:
      georef doctor
      georef doctor --json
    """,
)
