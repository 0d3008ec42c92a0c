"""Tables of the viewer's panels, as HTML; all texts of the survey are escaped."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipelines.core.types import FloatArray
from pipelines.scene.target_crs import TargetCrs
from pipelines.view.quantities import Quantity

_TEXT = "font-size:0.85em;margin:0.4em 0.8em"
_ALARM = "padding:0.4em 0.6em;border-left:0.3em solid #d33;background:rgba(221,51,51,0.12);font-weight:600"
_TABLE = "width:100%;font-size:0.8em;border-spacing:0.3em 0.1em;font-variant-numeric:tabular-nums;text-align:right"


@dataclass(frozen=True)
class PlaceRow:
    """Place (3,) in `geo` with σ (3,) east, north, up in metres, or None."""

    name: str
    position_in_geo: FloatArray
    sigma_m: FloatArray | None


def paragraph(text: str, mark: str = "note") -> str:
    """Return a paragraph; `data-…` of the name `mark` lets scripts find it."""
    return f'<p data-{mark}="yes" style="{_TEXT}">{html.escape(text)}</p>'


def failure(text: str) -> str:
    """Return a paragraph that stands out."""
    return f'<p data-failed="yes" role="alert" style="{_TEXT};{_ALARM}">{html.escape(text)}</p>'


def place_table(target: TargetCrs, rows: Sequence[PlaceRow], marked: str = "place") -> str:
    """Return places with their coordinates in the CRS.

    Args:
        target: the CRS.
        rows: the places.
        marked: name of the attribute `data-…` that holds a row's metres in `geo`, for scripts.
    """
    crs = target.crs
    names = ("longitude", "latitude", "height") if crs.is_geographic else ("easting", "northing", "height")
    heads = "".join(f"<th>{name} ({html.escape(unit)})</th>" for name, unit in zip(names, crs.units, strict=True))
    decimals = (8, 8, 3) if crs.is_geographic else (3, 3, 3)
    lines = []
    for row in rows:
        xyz = target.xyz_from_geo(row.position_in_geo[None])[0]
        cells = "".join(f"<td>{value:.{digits}f}</td>" for value, digits in zip(xyz, decimals, strict=True))
        data = ",".join(f"{value:.6f}" for value in row.position_in_geo)
        lines.append(f'<tr data-{marked}="{data}"><th>{html.escape(row.name)}</th>{cells}</tr>')
        if row.sigma_m is not None:
            cells = "".join(f"<td>±{value:.3f}</td>" for value in row.sigma_m)
            lines.append(f"<tr><th>σ E, N, U (m)</th>{cells}</tr>")
    return _table(f"<tr><th></th>{heads}</tr>{''.join(lines)}")


def quantity_text(quantity: Quantity) -> str:
    """Return a quantity with its σ and unit in one line."""
    sigma = "" if quantity.sigma is None else f" ± {quantity.sigma:.3f}"
    return f"{quantity.name} {quantity.value:.3f}{sigma} {quantity.unit}"


def quantity_table(quantities: Sequence[Quantity]) -> str:
    """Return quantities with their σ; empty without any."""
    rows = []
    for each in quantities:
        sigma = "" if each.sigma is None else f"±{each.sigma:.3f}"
        data = f'data-quantity="{html.escape(each.name)}" data-value="{each.value:.6f}"'
        data += "" if each.sigma is None else f' data-sigma="{each.sigma:.6f}"'
        cells = f"<td>{each.value:.3f}</td><td>{sigma}</td><td>{html.escape(each.unit)}</td>"
        rows.append(f"<tr {data}><th>{html.escape(each.name)}</th>{cells}</tr>")
    return _table("".join(rows)) if rows else ""


def saved_table(rows: Sequence[tuple[str, str, str]]) -> str:
    """Return saved measurements: name, what is shown of it, values."""
    if not rows:
        return "<p>Nothing saved yet.</p>"
    lines = [
        f'<tr data-saved="{html.escape(name)}"><th>{html.escape(shown)}</th><td>{html.escape(values)}</td></tr>'
        for name, shown, values in rows
    ]
    return _table("".join(lines))


def mark_table(marks: Mapping[str, tuple[float, float]], residual_px: Mapping[str, float]) -> str:
    """Return the marks of a point by image, with their residuals where the point is determined."""
    lines = []
    for image, (x, y) in marks.items():
        residual = f"{residual_px[image]:.2f}" if image in residual_px else ""
        name = html.escape(image)
        cells = f"<td>{x:.2f}</td><td>{y:.2f}</td><td>{residual}</td>"
        lines.append(f'<tr data-mark="{name}" data-px="{x:.3f},{y:.3f}"><th>{name}</th>{cells}</tr>')
    heads = "<tr><th>mark in</th><th>x (px)</th><th>y (px)</th><th>residual (px)</th></tr>"
    return _table(heads + "".join(lines))


def _table(rows: str) -> str:
    return f'<table style="{_TABLE}">{rows}</table>'
