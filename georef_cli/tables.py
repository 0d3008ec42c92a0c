"""Tables for people: typed products in, rich renderables out.

They fit the width of the terminal. Text of others is shown literally and without escape sequences.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.markup import escape
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table

from pipelines.compare.table import POINT_FIGURES, REFERENCE_HEADS, Comparison, cells, reference_cells, remarks_on
from pipelines.core.figures import DEPTH_ERRORS, ERRORS, MISSING, Headline
from pipelines.core.json_values import Json, JsonValue
from pipelines.core.options import notation
from pipelines.core.plan import OptionOrigin
from pipelines.core.products import Remark
from pipelines.core.runner import Outcome
from pipelines.core.sentences import duration, printable, printable_lines
from pipelines.core.stages import BY_NAME, REPORT
from pipelines.core.staleness import StageState
from pipelines.core.workspace import Workspace
from pipelines.survey.headline import PointLine, point_lines
from pipelines.survey.lidar_report import HeldOutDepths
from pipelines.survey.reference_comparison import ReferenceComparison
from pipelines.survey.report import CheckPointErrors, EvaluationReport, read_report


class FirstThatFits:
    """Renderable that takes the first form that needs no more than the width of the terminal, or else the last."""

    def __init__(self, *forms: RenderableType) -> None:
        self._forms = forms

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        unlimited = options.update(max_width=10_000)
        for form in self._forms[:-1]:
            if Measurement.get(console, unlimited, form).maximum <= options.max_width:
                yield form
                return
        yield self._forms[-1]


class ByWidth:
    """Renderable with one form for terminals of at least so many columns, and one with fewer columns for others."""

    def __init__(self, least: int, wide: RenderableType, narrow: RenderableType) -> None:
        self._least, self._wide, self._narrow = least, wide, narrow

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self._wide if options.max_width >= self._least else self._narrow


def plain_table(
    *columns: str, header: bool = True, right: Sequence[int] = (), no_wrap: Sequence[int] = ()
) -> Table:
    """Return an empty table without lines; some columns are right-aligned, some are never wrapped."""
    table = Table(*columns, show_header=header, box=None, pad_edge=False)
    for index in right:
        table.columns[index].justify = "right"
    for index in no_wrap:
        table.columns[index].no_wrap = True
    return table


def figures(heads: Sequence[str], rows: Mapping[str, Sequence[str]]) -> FirstThatFits:
    """Return rows of figures: a line for each row, or a line for each figure where that is too wide.

    A line break in a head separates group and name. The texts of the figures are markup.
    """
    wide = plain_table("", *heads, right=range(1, len(heads) + 1), no_wrap=range(len(heads) + 1))
    for name, texts in rows.items():
        wide.add_row(name, *texts)
    tall = plain_table("", *rows, right=range(1, len(rows) + 1))
    for index, head in enumerate(heads):
        tall.add_row(head.replace("\n", " ").strip(), *(texts[index] for texts in rows.values()))
    return FirstThatFits(wide, tall)


def literal(text: str) -> str:
    """Return the rich markup that shows a text of others literally, on one line."""
    return escape(printable(text))


class Safe:
    """Renderable whose text, wherever it comes from, reaches the terminal without escapes of its own."""

    def __init__(self, renderable: RenderableType) -> None:
        self._renderable = renderable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for segment in console.render(self._renderable, options):
            yield segment if segment.control else Segment(printable_lines(segment.text), segment.style)


STATE_STYLE = {
    "current": "green",
    "stale": "yellow",
    "damaged": "red",
    "running": "cyan",
    "interrupted": "yellow",
    "failed": "red",
    "missing": "dim",
}
POINT_COLUMNS = {name: figure.label for name, figure in ERRORS.items() if name not in ("max_h_m", "max_v_m")}
SIGMA_COLUMNS = {"count": "n", "rms_h_m": "RMS H", "rms_v_m": "RMS V"}
FACTOR_COLUMNS = {
    "count": "count",
    "used": "used",
    "redundancy": "redundancy",
    "estimated": "factor",
    "applied": "applied",
    "sigma_source": "σ",
}
IMAGE_COLUMNS = {
    "views": "views",
    "psnr": "PSNR dB",
    "psnr_over_white": "over white dB",
    "psnr_covered": "covered dB",
    "covered_share": "covered share",
    "ssim": "SSIM",
    "lpips": "LPIPS",
}
DISTANCES = {
    "distance_m": "known",
    "stated_sigma_m": "σ",
    "measured_m": "measured",
    "error_m": "error",
    "sigma_m": "predicted σ",
}
DISTANCE_COLUMNS = {
    "measured": "places",
    "median_m": "median",
    "nmad_m": "NMAD",
    "rmse_m": "RMSE",
    "abs_95_m": "95 %",
    "median_lod_m": "LoD",
    "significant": "beyond LoD",
    "c2c_m": "C2C",
    "c2c_95_m": "C2C 95 %",
}
_CROSSED = "Control points, each left out in turn (cross-validation)"
# Columns of a terminal from which tables show all that they have.
WIDE = 100
_FORGET = "[dim]georef run WS --forget OPTION drops a remembered one[/]"
Renderable = Group | Table | ByWidth | FirstThatFits | str


def states(rows: Iterable[StageState], cautions: Mapping[str, Sequence[Remark]]) -> ByWidth:
    """Return the table of `georef status`: stage, state, end, duration, new cautions if any, key figure.

    A narrow terminal has no room for the end and the number of cautions, whose sentences follow the table.
    """
    narrow = plain_table("stage", "state", "took", "result", right=[2])
    heads = ("stage", "state", "finished", "took", *(["cautions"] if cautions else []), "result")
    wide = plain_table(*heads, right=range(3, len(heads) - 1))
    for row in rows:
        remarks = " · ".join(literal(text) for text in (row.key_figure, row.reason, row.interrupted) if text)
        state, took = f"[{STATE_STYLE[row.state]}]{row.state}[/]", duration(row.duration_s)
        count = [str(len(cautions.get(row.stage, ())) or "")] if cautions else []
        wide.add_row(row.stage, state, when(row.finished), took, *count, remarks)
        narrow.add_row(row.stage, state, took, remarks)
    return ByWidth(WIDE, wide, narrow)


def origins(rows: Sequence[OptionOrigin]) -> list[Renderable]:
    """Return the table of the changed options, with where their values come from."""
    if not rows:
        return ["", "[bold]Changed options[/]: none"]
    table = plain_table("stage", "option", "value", "from")
    table.columns[2].overflow = "fold"
    before = ""
    for row in rows:
        table.add_row(row.stage if row.stage != before else "", row.flag, literal(notation(row.value)), row.origin)
        before = row.stage
    return [
        "\n[bold]Changed options[/]",
        table,
        *([_FORGET] if any(row.origin == "remembered" for row in rows) else []),
    ]


def accuracy_line(headline: Headline | None) -> list[Renderable]:
    """Return the line with the accuracy of the result; none before anything states it."""
    return [] if headline is None else [f"[bold]accuracy[/] {literal(headline.text)}"]


def cautions(by_stage: Mapping[str, Sequence[Remark]]) -> list[Renderable]:
    """Return a line for each caution, with its stage and code."""
    return [
        f"[bold yellow]caution:[/] {literal(caution.text)} ({stage}, {caution.code})"
        for stage, of_stage in by_stage.items()
        for caution in of_stage
    ]


def _cameras(rows: Sequence[Json]) -> list[Renderable]:
    """Return the table of a survey's cameras, without columns that are empty for all."""
    if not rows:
        return []
    columns = {
        "camera": [str(row["camera_id"]) for row in rows],
        "model": [literal(row["make_model"]) for row in rows],
        "serial number": [literal(row["serial"]) for row in rows],
        "sensor": [literal(row["sensor"]) for row in rows],
        "lens": [literal(row["model"]) for row in rows],
        "size px": [f"{row['width']}×{row['height']}" for row in rows],
        "focal px": [f"{row['focal_px']:.1f}" for row in rows],
        "from": [literal(row["focal_source"]) for row in rows],
        "images": [str(row["images"]) for row in rows],
        "least sharp": ["" if row.get("least_sharp") is None else f"{row['least_sharp']:.2f}" for row in rows],
    }
    columns = {head: cells for head, cells in columns.items() if any(cells)}
    numbers = [index for index, head in enumerate(columns) if head in ("focal px", "images", "least sharp")]
    table = plain_table(*columns, right=numbers)
    for row in zip(*columns.values(), strict=True):
        table.add_row(*row)
    return ["", table]


def date_volumes(dates: Sequence[Json]) -> list[Renderable]:
    """Return the table of the volumes of `georef change` at each date of a chain; none: there is no chain."""
    if not dates:
        return []
    heads = ("date", "taken on", "region", "since the first (m³)", "since the date before (m³)")
    table = plain_table(*heads, right=[3, 4])
    for date in dates:
        for region in date["regions"]:
            since_first = f"{region['net_m3']:+.1f} ± {region['sigma_m3']:.1f}"
            since_before = f"{region['since_previous_m3']:+.1f} ± {region['sigma_since_previous_m3']:.1f}"
            table.add_row(
                literal(date["name"]), date["taken_on"], literal(region["name"]), since_first, since_before
            )
    return ["", table]


def outcome(workspace: Workspace, result: Outcome, *, headline: bool = True) -> list[Renderable]:
    """Return the result of one stage: headline if asked, figures, and the warnings of an earlier run."""
    manifest = result.manifest
    effort = duration(manifest.duration_s) if result.ran else "current, nothing to do"
    parts: list[Renderable] = []
    if headline:
        parts.append(f"[bold]{result.stage}[/]: {literal(manifest.key_figure)} ({effort})")
    if result.stage == "evaluate":
        parts += report(read_report(workspace.path(REPORT)))
    elif manifest.values:
        table = plain_table("", "", header=False, right=[1])  # Nested values are shown by --json only.
        for name, value in manifest.values.items():
            if isinstance(value, str | int | float) or value is None:
                table.add_row(literal(_words(name)), literal(_number(value)))
        parts.append(table)
        parts += _cameras(manifest.values.get("camera_list", ()))
        parts += date_volumes(manifest.values.get("by_date", ()))
    spec = BY_NAME.get(result.stage)  # None: a part of `blocks`, whose files only they read
    if spec is not None and (file := workspace.root / spec.product).exists():
        parts.append(f"[bold]file[/] {literal(str(file))}")
    if not result.ran:  # the warnings of a stage that just ran are on stderr already
        parts += [f"[yellow]warning:[/] {literal(warning.text)}" for warning in manifest.warnings]
    return parts


_UNITS = {"m": "m", "px": "px", "deg": "°", "s": "s", "ha": "ha", "db": "dB", "bytes": "bytes"}


def _words(name: str) -> str:
    """Return the name of a value in words, its unit in brackets: `median_sigma_m` as `median sigma (m)`."""
    words, _, ending = name.rpartition("_")
    text = name if not words or ending not in _UNITS else f"{words} ({_UNITS[ending]})"
    return text.replace("_", " ")


def outcomes(results: Sequence[Outcome]) -> Table:
    """Return the table of the results of `georef run`, a line for each stage."""
    table = plain_table("stage", "", "took", "result", right=[2])
    for result in results:
        manifest = result.manifest
        done = "[green]done[/]" if result.ran else "[dim]current[/]"
        table.add_row(result.stage, done, duration(manifest.duration_s), literal(manifest.key_figure))
        for warning in () if result.ran else manifest.warnings:
            table.add_row("", "[yellow]warning[/]", "", literal(warning.text))
    return table


def comparison(table: Comparison) -> list[Renderable]:
    """Return the tables of `georef compare`: a line for each configuration, and its distinctive features below."""
    points = [f"{way}\n{ERRORS[name].label}" for way, name in POINT_FIGURES]
    heads = ("test\nPSNR", "PSNR\ncovered", "\nSSIM", *points, "check\npoints", "\ntraining")
    rows = {literal(row.configuration): [literal(cell) for cell in cells(row)] for row in table.rows}
    notes = [f"[bold]{literal(row.configuration)}[/] {literal(f'{row.title}: {row.note}')}" for row in table.rows]
    compared = {literal(row.configuration): list(reference_cells(row)) for row in table.rows if row.reference}
    reference: list[Renderable] = [
        "",
        "[bold]Surface against the reference, metres[/]",
        figures(REFERENCE_HEADS, compared),
    ]
    remarks = [
        f"[yellow]{literal(row.configuration)}:[/] {literal(text)}"
        for row in table.rows
        for text in remarks_on(row)
    ]
    return [
        "[bold]Test views in dB, check points in metres[/]",
        figures(heads, rows),
        *(reference if compared else []),
        "",
        *notes,
        *remarks,
    ]


def topics(rows: Iterable[Json]) -> ByWidth:
    """Return the table of `georef inspect`, a line for each topic; a narrow terminal has no room for types."""
    table = plain_table(
        "topic", "type", "messages", "Hz", "span", "longest gap", "frame", "use", "", right=range(2, 6)
    )
    narrow = plain_table("topic", "messages", "Hz", "use", "", right=[1, 2])
    table.columns[0].overflow = table.columns[1].overflow = narrow.columns[0].overflow = "fold"
    for row in rows:
        span = None if row["first_s"] is None else row["last_s"] - row["first_s"]
        remarks = [
            f"{row['gaps']} gaps" if row["gaps"] else "",
            f"{row['backwards']} backwards" if row["backwards"] else "",
        ]
        remarks += ["no stamps" if row["clock"] == "recording" else "", row["problem"]]
        name, messages, rate = literal(row["name"]), str(row["messages"]), _number(row["rate_hz"])
        use = (f"[green]{literal(row['use'])}[/]", literal(", ".join(filter(None, remarks))))
        kind, times = literal(row["type"].replace("/msg/", "/")), (duration(span), duration(row["longest_gap_s"]))
        table.add_row(name, kind, messages, rate, *times, literal(row["frame"]), *use)
        narrow.add_row(name, messages, rate, *use)
    return ByWidth(WIDE, table, narrow)


def report(document: EvaluationReport) -> list[Renderable]:
    """Return the tables of a report: test views, check points, cross-validation, σ, residuals of the fit.

    A residual of the fit is not an accuracy, and a control point is not a check point: they never share a table.
    """
    ways: Mapping[Any, CheckPointErrors] = document.checkpoints.by_way
    crossed, test, cameras = document.cross_validation, document.test_views, document.cameras
    fit = {"gnss": dict(document.fit.gnss), "gcp": dict(document.fit.gcp)}
    factors: dict[str, dict[str, Any]] = {factor.group: dict(factor) for factor in document.variance_factors}
    tables = (
        _rows("Test views", {} if test is None else {"test": dict(test)}, IMAGE_COLUMNS),
        _rows(
            "Errors of the check points, metres", {way: dict(errors) for way, errors in ways.items()}, POINT_COLUMNS
        ),
        _accuracy(ways),
        _rows(f"{_CROSSED}, metres", {} if crossed is None else {"left out": dict(crossed)}, POINT_COLUMNS),
        None
        if crossed is None or crossed.reason is None
        else Group(f"\n[bold]{_CROSSED}[/]", f"not possible: {literal(crossed.reason)}"),
        *(Group(f"[bold]required accuracy[/] {literal(test.sentence)}") for test in document.tolerances),
        *_against_reference(document.reference),
        _held_out(document.held_out),
        _rows("Known distances, metres", _distances(document), DISTANCES),
        _rows("Predicted σ, metres", {} if cameras is None else {"cameras": dict(cameras)}, SIGMA_COLUMNS),
        _rows("Residuals of the fit (not an accuracy), metres", fit, POINT_COLUMNS),
        _rows("Variance factors: estimated over stated variance (tie points: in px²)", factors, FACTOR_COLUMNS),
    )
    return [table for table in tables if table is not None]


def _distances(document: EvaluationReport) -> dict[str, dict[str, Any]]:
    """Return the known distances by name and use: those that entered the solution, and those that check it."""
    return {
        f"{distance.name} ({'rejected' if distance.rejected else distance.use})": dict(distance)
        for distance in document.distances
    }


def _against_reference(reference: ReferenceComparison | None) -> list[Group | None]:
    """Return the tables of the comparison with a reference cloud; none without it."""
    if reference is None:
        return []
    distances, scores = {}, {}
    for group in reference.groups:
        m3c2, c2c = group.m3c2, group.c2c
        distances[group.name] = {**dict(m3c2), "c2c_m": c2c.median_m, "c2c_95_m": c2c.abs_95_m}
        scores[group.name] = {
            f"{key} {score.threshold_m:g}": value for score in group.scores for key, value in score
        }
    moved = "" if reference.aligned == "none" else f" after moving it ({reference.aligned})"
    columns = {key: key.replace(" ", "\n") for row in scores.values() for key in row if "threshold" not in key}
    return [
        _rows(f"Model minus {literal(reference.name)}{moved} (M3C2, C2C), metres", distances, DISTANCE_COLUMNS),
        _rows("Shares within 0.05, 0.1, 0.3 m", scores, columns),
    ]


def _held_out(depths: HeldOutDepths | None) -> Group | None:
    """Return the errors at measured points that the training was not given; None without any."""
    if depths is None:
        return None
    columns = {key: figure.label for key, figure in DEPTH_ERRORS.items()}
    rows = {"depth maps before": dict(depths.before), "trained model after": dict(depths.after)}
    title = f"Errors at measured points, held out of the training ({depths.share:.0%}), metres"
    return _rows(title, rows, columns)


def _rows(title: str, rows: Mapping[str, Mapping[str, JsonValue]], columns: Mapping[str, str]) -> Group | None:
    """Return a table under its title, with the rows and columns that have a figure; None without any."""
    known = {name: row for name, row in rows.items() if any(row.get(key) for key in columns)}
    heads = {key: head for key, head in columns.items() if any(row.get(key) is not None for row in known.values())}
    if not heads:
        return None
    cells = {literal(name): [literal(_number(row.get(key))) for key in heads] for name, row in known.items()}
    return Group(f"\n[bold]{title}[/]", figures(tuple(heads.values()), cells))


def _accuracy(ways: Mapping[str, CheckPointErrors]) -> Group | None:
    """Return the accuracy by the check points after the standard, beside the prediction."""
    rows = {}
    for way, errors in ways.items():
        total, asprs, predicted = errors.with_survey, errors.asprs, errors.predicted
        if total is None:
            continue
        rows[way] = {
            **{ERRORS[key].label: getattr(total, key) for key in ("rmse_h_m", "rmse_v_m", "rmse_3d_m")},
            "vegetated V": None if asprs.vegetated is None else asprs.vegetated.rmse_v_m,
            "class H": asprs.horizontal_class,
            "class V": asprs.vertical_class,
            "class 3D": asprs.class_3d,
            "σ H": None if predicted is None else predicted.rms_h_m,
            "σ V": None if predicted is None else predicted.rms_v_m,
        }
    columns = {head: head for row in rows.values() for head in row}
    return _rows("Accuracy with the check points' own survey (ASPRS), and their predicted σ, metres", rows, columns)


def _number(value: JsonValue) -> str:
    if value is None:
        return MISSING
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3f}"
    return str(value)


def when(moment: datetime | None) -> str:
    """Return a time as people write it, in the local zone; empty for None."""
    return "" if moment is None else moment.astimezone().strftime("%Y-%m-%d %H:%M")


_TITLES = {
    "check": "Check points one by one, metres",
    "left out": "Control points one by one, each left out in turn, metres",
    "fit": "Residuals of control points one by one (not an accuracy), metres",
}

_BLUNDER = "[red]![/] off by more than three times the class that the other points meet"


def error_tables(report: EvaluationReport) -> list[Group]:
    """Return the tables of the errors of a report; none of a kind of points that there is not."""
    lines, tables = point_lines(report), []
    for name, title in _TITLES.items():
        of_group = [line for line in lines if name == (line.use if name == "check" else line.way)]
        if of_group:
            tables.append(Group(f"\n[bold]{title}[/]", _table(of_group, with_way=name == "check")))
    return [*tables, *([Group(_BLUNDER)] if any(line.is_blunder for line in lines) else [])]


def coordinate_tables(report: EvaluationReport) -> list[Group]:
    """Return the check points in the CRS of `--crs`, as surveyed and as measured; nothing without that option."""
    listed = report.coordinates
    if listed is None:
        return []
    table = plain_table("point", "", "x", "y", "z", right=range(2, 5), no_wrap=range(2, 5))
    table.add_row("origin", "", *listed.texts(listed.origin))
    for point in listed.points:
        for way, xyz in (
            ("surveyed", point.surveyed),
            ("triangulated", point.triangulated),
            ("surface", point.surface),
        ):
            name = literal(point.name) if way == "surveyed" else ""
            table.add_row(name, way, *(text or MISSING for text in listed.texts(xyz)))
    units = listed.units[0] if len(set(listed.units)) == 1 else ", ".join(listed.units)
    title = f"Check points in {literal(listed.crs)}, {literal(units)}; x is the easting or longitude"
    return [Group(f"\n[bold]{title}[/]", table, f"Heights: {literal(listed.heights)}.")]


def _table(lines: Sequence[PointLine], *, with_way: bool) -> Table:
    has_sigma = any(line.sigma_m is not None for line in lines)
    first = ["point", *(["measured"] if with_way else [])]
    heads = [*first, "rays", "E", "N", "U", "H", *(["σ H", "σ U"] if has_sigma else [])]
    table = plain_table(*heads, "", right=range(len(first), len(heads)), no_wrap=range(1, len(heads)))
    for line in lines:
        error, sigma = line.row.error_m, line.sigma_m
        lengths = [MISSING] * 4 if error is None else [*(f"{value:+.3f}" for value in error), _length(error[:2])]
        predicted = [MISSING] * 2 if sigma is None else [_length(sigma[:2]), f"{sigma[2]:.3f}"]
        table.add_row(
            literal(line.row.name),
            *([line.way] if with_way else []),
            str(line.row.rays),
            *lengths,
            *(predicted if has_sigma else []),
            "[red]![/]" if line.is_blunder else "",
        )
    return table


def _length(values: Sequence[float]) -> str:
    return f"{math.hypot(*values):.3f}"
