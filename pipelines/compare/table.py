"""Table of `georef compare`: the figures of each configuration, as JSON, Markdown, bars and a page."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal

from pipelines import __version__
from pipelines.core.figures import ERRORS, MISSING, WAYS
from pipelines.core.files import replace_text
from pipelines.core.products import Product, Remark
from pipelines.report.page import Page, Section, png_file, render_page
from pipelines.report.plots.charts import BarChart, write_bars
from pipelines.survey.reference_comparison import ReferenceComparison

# Errors of the check points that the table shows: the way of measuring (key of `WAYS`), field of `PointAccuracy`.
POINT_FIGURES = (
    ("triangulated", "rmse_h_m"),
    ("triangulated", "rmse_v_m"),
    ("surface", "median_h_m"),
    ("surface", "rmse_h_m"),
    ("surface", "rmse_v_m"),
)
REFERENCE_HEADS = ("M3C2 median", "NMAD", "F1 0.05 m", "F1 0.1 m", "F1 0.3 m")
JsonScalar = bool | int | float | str


class PointAccuracy(Product):
    """Errors of the check points in metres; None: no point was measured."""

    count: int = 0
    mean_h_m: float | None = None
    median_h_m: float | None = None
    rmse_h_m: float | None = None
    rmse_v_m: float | None = None


class ComparedSurface(Product):
    """Surface against the reference cloud of `evaluate`: M3C2 distances, and F1 by threshold in metres."""

    median_m: float | None
    nmad_m: float | None
    f1: tuple[tuple[float, float | None], ...]


class ComparedRow(Product):
    """Row of the table: the figures of one configuration.

    Attributes:
        failure: reason why there are no figures.
        test_psnr, test_ssim: means over the test views, in dB and from 0 to 1.
        test_psnr_covered: as test_psnr, over the pixels whose ground at least two training views show.
        test_covered_share: share of these pixels; the same for all configurations of one SfM model.
        triangulated, surface: errors of the check points, triangulated and on the rendered surface.
        reference: the surface against a reference cloud; None: there is none.
        training_s: duration; None if the training is that of another configuration.
        warnings, cautions: of its stages; a caution once.
    """

    configuration: str
    title: str
    note: str
    failure: str | None = None
    test_psnr: float | None = None
    test_psnr_covered: float | None = None
    test_covered_share: float | None = None
    test_ssim: float | None = None
    triangulated: PointAccuracy = PointAccuracy()
    surface: PointAccuracy = PointAccuracy()
    reference: ComparedSurface | None = None
    iterations: int | None = None
    gaussians: int | None = None
    training_s: float | None = None
    warnings: tuple[Remark, ...] = ()
    cautions: tuple[Remark, ...] = ()


class Comparison(Product):
    """Table of the configurations, with the options that all trainings share."""

    format_version: Literal[1] = 1
    options: dict[str, JsonScalar]
    rows: tuple[ComparedRow, ...]


def compared_surface(reference: ReferenceComparison | None) -> ComparedSurface | None:
    """Return distances and scores of the whole surface against a reference cloud; None without a comparison."""
    if reference is None:
        return None
    everywhere = next(group for group in reference.groups if group.name == "all")
    return ComparedSurface(
        median_m=everywhere.m3c2.median_m,
        nmad_m=everywhere.m3c2.nmad_m,
        f1=tuple((score.threshold_m, score.f1) for score in everywhere.scores),
    )


def bar_charts(rows: Sequence[ComparedRow]) -> tuple[BarChart, ...]:
    """Return the charts of a comparison, with a bar for each configuration: RMSE of check points, PSNR, time."""
    members = tuple(row.configuration for row in rows)
    geometry = (
        BarChart(
            f"Check points, {words}",
            "RMSE in m",
            members,
            {
                direction: [getattr(getattr(row, way), name) for row in rows]
                for direction, name in (("horizontal", "rmse_h_m"), ("vertical", "rmse_v_m"))
            },
        )
        for way, words in WAYS.items()
    )
    images = BarChart("Test views", "PSNR in dB", members, {"PSNR": [row.test_psnr for row in rows]}, digits=2)
    return (*geometry, images)


def markdown(table: Comparison) -> str:
    """Return the table as Markdown, with notes and remarks below."""
    heads = (
        *("", "test PSNR dB", "PSNR covered", "SSIM"),
        *(f"{way} {ERRORS[name].label}" for way, name in POINT_FIGURES),
        *("check points", "training"),
    )
    lines = [
        "# Comparison\n",
        "Check points, which entered no solve, in metres: *triangulated*, their image marks intersected with "
        "the cameras, and on the rendered *surface*, where that of the Gaussians lies behind the marks. *PSNR "
        "covered*: over the pixels of the test views whose ground at least two training views show.\n",
        _line(heads),
        _line(["---", *["---:"] * (len(heads) - 1)]),
        *(_line([f"**{row.configuration}**", *cells(row)]) for row in table.rows),
        "",
        *(f"- **{row.configuration}** {row.title}: {row.note}." for row in table.rows),
    ]
    if any(row.reference for row in table.rows):
        lines += ["", "Surface against the reference cloud, in metres:", "", _line(["", *REFERENCE_HEADS])]
        lines += [_line(["---", *["---:"] * len(REFERENCE_HEADS)])]
        lines += [_line([f"**{row.configuration}**", *reference_cells(row)]) for row in table.rows]
    remarks = [(row.configuration, text) for row in table.rows for text in remarks_on(row)]
    if remarks:
        lines += ["", "Remarks:", "", *(f"- {name}: {text}" for name, text in remarks)]
    options = ", ".join(f"{name} {value}" for name, value in table.options.items())
    return "\n".join([*lines, "", f"All trained with: {options or 'the default options'}."]) + "\n"


def cells(row: ComparedRow) -> tuple[str, ...]:
    """Return the figures of a row as text.

    PSNR, that of covered pixels, SSIM; check points triangulated and on the surface, and their number; time.
    """
    points, on_surface = row.triangulated.count, row.surface.count
    return (
        _text(row.test_psnr, 2),
        _text(row.test_psnr_covered, 2),
        _text(row.test_ssim, 4),
        *(_text(getattr(getattr(row, way), name)) for way, name in POINT_FIGURES),
        str(points) if points == on_surface else f"{points}, {on_surface}",
        MISSING if row.training_s is None else f"{row.training_s:.0f} s",
    )


def reference_cells(row: ComparedRow) -> tuple[str, ...]:
    """Return the figures of a row against the reference as text, in the order of `REFERENCE_HEADS`."""
    reference = row.reference
    if reference is None:
        return (MISSING,) * len(REFERENCE_HEADS)
    return (_text(reference.median_m), _text(reference.nmad_m), *(_text(value, 3) for _, value in reference.f1))


def remarks_on(row: ComparedRow) -> tuple[str, ...]:
    """Return the reason why a row is empty, and the warnings and cautions of its stages."""
    failure = () if row.failure is None else (f"failed: {row.failure}",)
    return (*failure, *(remark.text for remark in (*row.warnings, *row.cautions)))


def _line(parts: Iterable[str]) -> str:
    return "| " + " | ".join(parts) + " |"


def _text(value: float | None, decimals: int | None = None) -> str:
    """Return a number as text; without decimals, metres, with tenths of a millimetre below one metre."""
    if value is None:
        return MISSING
    return f"{value:.{decimals or (4 if value < 1 else 2)}f}"


JSON, MARKDOWN, PLOT, PAGE = "table.json", "table.md", "plot.png", "comparison.html"
_PACKAGE = __name__.rpartition(".")[0]  # its folder `templates` has the sections of the page


def write_comparison(folder: Path, table: Comparison, survey: str) -> None:
    """Write `table.json`, `table.md`, `plot.png` and `comparison.html`, unless the files already hold this table.

    `survey` is the name of the workspace, for the page.
    """
    json_path, markdown_path, page_path = folder / JSON, folder / MARKDOWN, folder / PAGE
    json_text, markdown_text = table.model_dump_json(indent=1) + "\n", markdown(table)
    is_held = _holds(json_path, json_text) and _holds(markdown_path, markdown_text)
    if is_held and (folder / PLOT).exists() and page_path.exists():
        return
    write_bars(folder / PLOT, bar_charts(table.rows))
    replace_text(page_path, render_page(comparison_page(table, folder / PLOT, survey), _PACKAGE))
    replace_text(markdown_path, markdown_text)
    replace_text(json_path, json_text)


def comparison_page(table: Comparison, plot: Path, survey: str) -> Page:
    """Return the page of a comparison, with the PNG of its bars and the name of the workspace."""
    names = ", ".join(row.configuration for row in table.rows)
    facts: dict[str, Any] = {
        "points": {
            f"{way}.{name}": f"{WAYS[way]}: {ERRORS[name].label} in {ERRORS[name].unit}"
            for way, name in POINT_FIGURES
        },
        "rows": table.rows,
        "bars": png_file(plot),
        "remarks": [(row, remarks_on(row)) for row in table.rows if remarks_on(row)],
        "options": table.options,
    }
    return Page(
        title=f"Comparison: {survey}",
        subtitle="One survey, trained and measured in several configurations",
        about={"Program": f"GeoRefGS {__version__}", "Configurations": names},
        sections=(
            Section("figures", "Figures", "figures.html", facts),
            Section("configurations", "Configurations", "configurations.html", facts),
        ),
        document=table.model_dump(mode="json"),
    )


def _holds(path: Path, text: str) -> bool:
    return path.exists() and path.read_text(encoding="utf-8") == text
