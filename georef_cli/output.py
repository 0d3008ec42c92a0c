"""Results on stdout: a short text for people, such as the overview of `georef info`, or one JSON document."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console, RenderableType
from rich.table import Table
from rich.text import Text

from georef_cli import tables
from georef_cli.tables import ByWidth, Renderable, Safe, literal, plain_table
from pipelines.core.errors import GeorefError
from pipelines.core.json_values import JsonValue
from pipelines.core.products import Remark, dump_json, union
from pipelines.core.runner import Outcome
from pipelines.core.stages import ADJUSTMENT, MODEL, REPORT
from pipelines.core.staleness import cautions_by_stage, document_of_cautions
from pipelines.core.workspace import Workspace
from pipelines.survey.headline import headline_of

if TYPE_CHECKING:
    from pipelines.deliver.overview import Overview
    from pipelines.survey.report import EvaluationReport

log = logging.getLogger(__name__)

_UNITS = ("B", "kB", "MB", "GB", "TB")


def overview_text(result: Overview) -> list[Renderable]:
    """Return the text of `georef info`: place, accuracy, files with their use, further deliverables, cautions."""
    wide = plain_table("\nfile", "\nsize", "\nmade", "\nstate", "\nuse", right=[1])
    narrow = plain_table("\nfile", "\nsize", "\nstate", "\nuse", right=[1])
    for file in result.files:
        name, count, use = literal(file.path), size(file.bytes), literal(file.description)
        state = f"[{tables.STATE_STYLE.get(file.state, 'dim')}]{file.state}[/]"
        wide.add_row(name, count, tables.when(file.made), state, use)
        narrow.add_row(name, count, state, use)
    parts: list[Renderable] = [*_headline(result), _place_table(result), ByWidth(tables.WIDE, wide, narrow)]
    if result.further:
        parts.append("\n[bold]Not made yet[/]")
        parts += [
            f"  {literal(spec.command(result.workspace))}  [dim]{literal(spec.title)}[/]" for spec in result.further
        ]
    return [*parts, *tables.cautions(result.cautions)]


def run_summary(result: Overview) -> list[Renderable]:
    """Return the end of `georef run`: where the result is, how good it is, where the files are, what comes next."""
    workspace = result.workspace
    files = plain_table("", "", header=False)
    files.columns[0].overflow = "fold"
    for file in result.files:
        style = tables.STATE_STYLE.get(file.state, "dim")
        state = "" if file.state == "current" else f"[{style}]{file.state}[/] "
        files.add_row(f"  {literal(file.path)}", f"{state}[dim]{literal(file.description)}[/]")
    names = ",".join(spec.name.removeprefix("export-") for spec in result.further)
    further = {
        f"georef view {workspace}": "see it in a browser, and measure in it",
        f"georef info {workspace}": "sizes and states of the files",
        f"georef evaluate {workspace}": "all figures of test views, check points and fit",
        **({f"georef run {workspace} --deliver {names}": "further deliverables"} if names else {}),
    }
    steps = [f"  {literal(command)}  [dim]{use}[/]" for command, use in further.items()]
    parts: list[Renderable] = ["", *_headline(result), _place_table(result, brief=True)]
    return [*parts, f"\n[bold]Files[/] in {literal(str(workspace))}", files, "\n[bold]Next[/]", *steps]


def size(count: int) -> str:
    """Return a number of bytes as `812 B`, `3.1 MB`."""
    thousands = min((len(str(count)) - 1) // 3, len(_UNITS) - 1)
    return f"{count / 1000**thousands:.{1 if thousands else 0}f} {_UNITS[thousands]}"


def _headline(result: Overview) -> list[str]:
    """Return whether the result is that of the present inputs and options, its size and place, interrupted runs."""
    location = f"in a {result.bounds.crs}"
    if result.center_lla is not None:
        lat, lon, _ = result.center_lla
        location = f"at {abs(lat):.6f}° {'S' if lat < 0 else 'N'}, {abs(lon):.6f}° {'W' if lon < 0 else 'E'}"
    state = ""
    if result.outdated:
        first, *others = result.outdated
        more = f"; and {', '.join(row.stage for row in others)}" if others else ""
        why = literal(f"{first.stage}: {first.reason}{more}")
        state = f" is [{tables.STATE_STYLE[first.state]}]{first.state}[/] ({why})"
    return [
        f"[bold]{literal(str(result.workspace))}[/]{state}: {result.gaussians} Gaussians {location}",
        *(f"[yellow]{stage}[/]: {literal(progress)}" for stage, progress in result.interrupted.items()),
    ]


def _place_table(result: Overview, *, brief: bool = False) -> Table:
    """Return the lines on the place on Earth and its accuracy."""
    bounds, accuracy = result.bounds, result.accuracy
    lines, on_earth = {}, bounds.on_earth
    if on_earth is not None:
        lines = {
            "longitude": f"{on_earth.west:.6f} … {on_earth.east:.6f}°",
            "latitude": f"{on_earth.south:.6f} … {on_earth.north:.6f}°",
            "height": f"{on_earth.height_m[0]:.2f} … {on_earth.height_m[1]:.2f} m, ellipsoidal"
            + ", if the assumed datum is right" * on_earth.datum_assumed,
        }
    lines |= {
        bounds.crs: ", ".join(
            f"{low:.{decimals}f} … {high:.{decimals}f} {unit}"
            for low, high, unit in zip(bounds.low, bounds.high, bounds.units, strict=True)
            for decimals in [6 if unit.startswith("deg") else 2]
        ),
    }
    if not brief:
        lines[""] = f"heights {bounds.heights}" + "".join(f"; {text}" for text in bounds.assumed)
    lines["accuracy"] = "not known yet: georef evaluate states it" if accuracy is None else accuracy.text
    if accuracy is not None and accuracy.kind != "measured" and on_earth is not None:
        lines["accuracy"] += "; check points measure it (--checkpoints, --check)"
    if result.area_ha is not None:
        lines["area"] = f"{result.area_ha:.3g} ha"
    if result.psnr is not None:
        lines["test views"] = f"PSNR {result.psnr:.2f} dB"
    table = plain_table("", "", header=False)
    for name, text in lines.items():
        table.add_row(literal(name), literal(text))
    return table


PIPED_WIDTH = 120


def print_json(document: JsonValue) -> None:
    """Write a document to stdout as JSON."""
    click.echo(dump_json(document))


def print_result(document: JsonValue, *parts: RenderableType, as_json: bool) -> None:
    """Print the result of a command in one of its two forms."""
    if as_json:
        print_json(document)
    else:
        print_rich(*parts)


def print_rich(*parts: RenderableType) -> None:
    """Print renderables: in colour on a terminal, plain elsewhere."""
    console = Console(
        width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False, emoji=False, file=sys.stdout
    )
    for part in parts:
        console.print(Safe(part if not isinstance(part, str) else Text.from_markup(part, emoji=False)))


def document_of(outcome: Outcome) -> dict[str, Any]:
    """Return the JSON form of what a stage came to."""
    manifest = outcome.manifest
    return {
        "stage": outcome.stage,
        "ran": outcome.ran,
        "key_figure": manifest.key_figure,
        "values": manifest.values,
        "warnings": [remark.model_dump() for remark in manifest.warnings],
        "duration_s": manifest.duration_s,
    }


def print_outcome(
    workspace: Workspace, outcome: Outcome, *more: RenderableType, as_json: bool, logged: bool
) -> None:
    """Print the result of a stage, what more there is to show of it, and the cautions that the stage adds.

    The JSON document has those of the whole workspace. `logged`: the log on the same terminal has the headline.
    """
    cautions = cautions_by_stage(workspace)
    if as_json:
        print_json({**document_of(outcome), "cautions": document_of_cautions(cautions)})
    else:
        added = {outcome.stage: cautions.get(outcome.stage, ())}
        print_rich(*tables.outcome(workspace, outcome, headline=not logged), *more, *tables.cautions(added))


def print_outcomes(
    workspace: Workspace,
    outcomes: Sequence[Outcome],
    result: Overview | None,
    solved: EvaluationReport | None = None,
    *,
    cautions: Mapping[str, tuple[Remark, ...]] | None = None,
    as_json: bool,
    logged: bool,
) -> None:
    """Print the results of several stages, the overview of the whole if there is one, and last the cautions.

    `solved` is the evaluation of cameras without training. `cautions` of stages stand beside those of the products.
    `logged`: the log on the same terminal has shown the rest.
    """
    cautions = with_evaluation({**cautions_by_stage(workspace), **(cautions or {})}, solved)
    if as_json:
        stages = [document_of(outcome) for outcome in outcomes]
        document = {"workspace": str(workspace.root), "stages": stages, "result": result and result.feature()}
        if solved is not None:
            document["evaluation"] = solved.model_dump(mode="json")
        print_json({**document, "cautions": document_of_cautions(cautions)})
        return
    if not logged:
        print_rich(tables.outcomes(outcomes))
    if result is not None:
        print_rich(*run_summary(result))
    else:
        if solved is not None:
            print_rich(*tables.report(solved), *tables.error_tables(solved))
        print_rich(*tables.accuracy_line(headline_of(workspace) if solved is None else solved.headline))
        if logged:
            print_rich(f"[bold]Next[/]: georef run {literal(str(workspace.root))} completes it")
    print_rich(*tables.cautions(cautions))


def evaluated_cameras(workspace: Workspace, *, with_area: bool = True) -> EvaluationReport | None:
    """Return the evaluation of the cameras alone; without its area, which takes longest, where nobody shows it.

    Nothing is written. The cameras measure the check points as they will after training, to within the changes of
    the adjustment there.

    None: a model is trained, there is a report of `georef evaluate`, or the cameras cannot be evaluated.
    """
    if workspace.has(MODEL) or workspace.has(REPORT) or not workspace.has(ADJUSTMENT):
        return None
    from pipelines.adjust.solution import posterior_of
    from pipelines.evaluate.options import EvaluateOptions
    from pipelines.evaluate.stage import area_of_interest, evaluate
    from pipelines.survey.navigation import load_survey
    from pipelines.survey.solution import read_sfm, read_solution

    try:
        solution = read_solution(workspace)
        sfm, survey = read_sfm(workspace, solution), solution.weighted(load_survey(workspace))
        posterior, options = posterior_of(workspace, solution, sfm), EvaluateOptions()
        area = area_of_interest(options, workspace, solution, sfm, survey) if with_area else None
        return evaluate(survey, posterior, options, area=area)
    except GeorefError as error:  # The stages have succeeded all the same.
        log.debug("no evaluation of the cameras: %s", error)
        return None


def with_evaluation(
    cautions: Mapping[str, tuple[Remark, ...]], solved: EvaluationReport | None
) -> dict[str, tuple[Remark, ...]]:
    """Return the cautions by stage, with those that the evaluation of the cameras adds."""
    if solved is None:
        return dict(cautions)
    carried = union(*cautions.values())
    added = tuple(caution for caution in solved.cautions if caution not in carried)
    return {**cautions, **({"evaluation": added} if added else {})}
