"""Overview of a result for people: `georef info`, and the end of `georef run`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table

from georef_cli import tables
from georef_cli.markup import shown
from georef_cli.tables import Renderable

if TYPE_CHECKING:
    from pipelines.deliver.overview import Overview

_UNITS = ("B", "kB", "MB", "GB", "TB")


def whole(result: Overview) -> list[Renderable]:
    """Return the text of `georef info`: place, accuracy, files with their use, further deliverables, cautions."""
    parts: list[Renderable] = [_headline(result), _place(result), _files(result)]
    if result.further:
        parts.append("\n[bold]Not made yet[/]")
        parts += [f"  {shown(command)}  [dim]{shown(title)}[/]" for command, title in result.further.items()]
    return [*parts, *tables.cautions(result.cautions)]


def short(result: Overview) -> list[Renderable]:
    """Return the end of `georef run`: where the result is, how good it is, where the files are, what comes next."""
    parts: list[Renderable] = ["", _headline(result), _place(result, brief=True)]
    for file in result.files:
        style = tables.STATE_STYLE.get(file.state, "dim")
        state = "" if file.state == "current" else f"[{style}]{file.state}[/] "
        parts.append(f"  {shown(str(result.workspace / file.path))}  {state}[dim]{shown(file.purpose)}[/]")
    names = ",".join(command.split()[1].removeprefix("export-") for command in result.further)
    more = f"; more: georef run {result.workspace} --deliver {names}" if names else ""
    return [*parts, f"[dim]all of it:[/] georef info {shown(str(result.workspace))}{shown(more)}"]


def size(count: int) -> str:
    """Return a number of bytes as `812 B`, `3.1 MB`."""
    thousands = min((len(str(count)) - 1) // 3, len(_UNITS) - 1)
    return f"{count / 1000**thousands:.{1 if thousands else 0}f} {_UNITS[thousands]}"


def _headline(result: Overview) -> str:
    lat, lon, _ = result.center_lla
    place = f"{abs(lat):.6f}° {'S' if lat < 0 else 'N'}, {abs(lon):.6f}° {'W' if lon < 0 else 'E'}"
    return f"[bold]{shown(str(result.workspace))}[/]: {result.gaussians} Gaussians at {place}"


def _place(result: Overview, *, brief: bool = False) -> Table:
    """Return the lines on the place on Earth and its accuracy."""
    bounds, quality = result.bounds, result.quality
    lines = {
        "longitude": f"{bounds.west:.6f} … {bounds.east:.6f}°",
        "latitude": f"{bounds.south:.6f} … {bounds.north:.6f}°",
        "height": f"{bounds.height_m[0]:.2f} … {bounds.height_m[1]:.2f} m, ellipsoidal",
    }
    if not brief:
        lines[bounds.crs] = ", ".join(
            f"{low:.{_decimals(unit)}f} … {high:.{_decimals(unit)}f} {unit}"
            for low, high, unit in zip(bounds.low, bounds.high, bounds.units, strict=True)
        )
        lines[""] = f"heights {bounds.heights}" + "".join(f"; {text}" for text in bounds.assumed)
    if quality.sigma_h_m is not None and quality.sigma_v_m is not None:
        lines["predicted σ"] = f"{quality.sigma_h_m:.3f} m H, {quality.sigma_v_m:.3f} m V, {quality.counts}"
    else:
        lines["predicted σ"] = "not known"
    if quality.rmse_h_m is not None and quality.rmse_v_m is not None:
        points = f"RMSE of {quality.check_points} check points"
        lines["measured"] = f"{quality.rmse_h_m:.3f} m H, {quality.rmse_v_m:.3f} m V, {points}"
    else:
        lines["measured"] = "nothing: no check points were evaluated"
    table = Table(show_header=False, box=None, pad_edge=False)
    for name, text in lines.items():
        table.add_row(shown(name), shown(text))
    return table


def _files(result: Overview) -> Table:
    table = Table("\nfile", "\nsize", "\nmade", "\nstate", "\nuse", box=None, pad_edge=False)
    table.columns[1].justify = "right"
    for file in result.files:
        style = tables.STATE_STYLE.get(file.state, "dim")
        table.add_row(
            shown(file.path),
            size(file.bytes),
            tables.when(file.made),
            f"[{style}]{file.state}[/]",
            shown(file.purpose),
        )
    return table


def _decimals(unit: str) -> int:
    return 6 if unit.startswith("deg") else 2
