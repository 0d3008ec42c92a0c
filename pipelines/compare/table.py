"""Table of `georef compare`: the figures of each configuration, as JSON, as Markdown and as bars."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

from pipelines.core.figures import WAYS
from pipelines.core.products import Caution, Product
from pipelines.report.plots.charts import Panel
from pipelines.survey.report import CheckPointErrors
from pipelines.survey.report_parts import ReferenceComparison

REFERENCE_HEADS = ("M3C2 median", "NMAD", "F1 0.05 m", "F1 0.1 m", "F1 0.3 m")
JsonScalar = bool | int | float | str


class PointAccuracy(Product):
    """Errors of the check points in metres; None: no point was measured."""

    count: int = 0
    mean_h_m: float | None = None
    median_h_m: float | None = None
    rmse_h_m: float | None = None
    rmse_v_m: float | None = None


class SurfaceAccuracy(Product):
    """Surface against the reference cloud of `evaluate`.

    Attributes:
        median_m, nmad_m: of the distances along the normals (M3C2); None: not measured.
        f1: by threshold in metres, in the order of the report; None: no points.
    """

    median_m: float | None
    nmad_m: float | None
    f1: tuple[tuple[float, float | None], ...]


class ComparedRow(Product):
    """Row of the table: the figures of one configuration.

    Attributes:
        configuration, title, note: as in `Configuration`.
        failure: reason why there are no figures.
        test_psnr, test_ssim: means over the test views, in dB and from 0 to 1.
        test_psnr_covered: as test_psnr, over the pixels whose ground at least two training views show.
        test_covered_share: share of these pixels; the same for all configurations of one SfM model.
        camera, model: errors of the check points, triangulated and on the rendered surface.
        reference: the surface against a reference cloud; None: there is none.
        iterations, gaussians: of the training.
        training_s: duration; None if the training is that of another configuration.
        warnings: of its stages.
        cautions: of its stages, each once.
    """

    configuration: str
    title: str
    note: str
    failure: str | None = None
    test_psnr: float | None = None
    test_psnr_covered: float | None = None
    test_covered_share: float | None = None
    test_ssim: float | None = None
    camera: PointAccuracy = PointAccuracy()
    model: PointAccuracy = PointAccuracy()
    reference: SurfaceAccuracy | None = None
    iterations: int | None = None
    gaussians: int | None = None
    training_s: float | None = None
    warnings: tuple[str, ...] = ()
    cautions: tuple[Caution, ...] = ()


class Comparison(Product):
    """Table of the configurations.

    Attributes:
        format_version: version of the format.
        options: options that all trainings share.
        rows: one row for each configuration.
    """

    format_version: Literal[1] = 1
    options: dict[str, JsonScalar]
    rows: tuple[ComparedRow, ...]


def point_accuracy(errors: CheckPointErrors) -> PointAccuracy:
    """Return the figures of the check points that the table shows."""
    return PointAccuracy(
        count=errors.count,
        mean_h_m=errors.mean_h_m,
        median_h_m=errors.median_h_m,
        rmse_h_m=errors.rmse_h_m,
        rmse_v_m=errors.rmse_v_m,
    )


def surface_accuracy(reference: ReferenceComparison | None) -> SurfaceAccuracy | None:
    """Return the figures of a comparison with a reference that the table shows."""
    if reference is None:
        return None
    everywhere = reference.group("all")
    return SurfaceAccuracy(
        median_m=everywhere.m3c2.median_m,
        nmad_m=everywhere.m3c2.nmad_m,
        f1=tuple((score.threshold_m, score.f1) for score in everywhere.scores),
    )


def panels(rows: Sequence[ComparedRow]) -> tuple[Panel, ...]:
    """Return the bar charts of the table's figures."""
    members = tuple(row.configuration for row in rows)
    ways = {"camera": [row.camera for row in rows], "model": [row.model for row in rows]}
    geometry = (
        Panel(
            f"Check points, {WAYS[way]}",
            "RMSE in m",
            members,
            {
                "horizontal": [accuracy.rmse_h_m for accuracy in accuracies],
                "vertical": [accuracy.rmse_v_m for accuracy in accuracies],
            },
        )
        for way, accuracies in ways.items()
    )
    images = Panel("Test views", "PSNR in dB", members, {"PSNR": [row.test_psnr for row in rows]}, digits=2)
    return (*geometry, images)


def markdown(table: Comparison) -> str:
    """Return the table as Markdown, with notes and remarks below."""
    heads = (
        *("", "test PSNR dB", "PSNR covered", "SSIM", "triangulated RMSE H", "RMSE V"),
        *("surface median H", "RMSE H", "RMSE V", "check points", "training"),
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
    camera, model = row.camera, row.model
    counts = str(camera.count) if camera.count == model.count else f"{camera.count}, {model.count}"
    return (
        _number(row.test_psnr, 2),
        _number(row.test_psnr_covered, 2),
        _number(row.test_ssim, 4),
        *(_metres(value) for value in (camera.rmse_h_m, camera.rmse_v_m)),
        *(_metres(value) for value in (model.median_h_m, model.rmse_h_m, model.rmse_v_m)),
        counts,
        "–" if row.training_s is None else f"{row.training_s:.0f} s",
    )


def reference_cells(row: ComparedRow) -> tuple[str, ...]:
    """Return the figures of a row against the reference as text, in the order of `REFERENCE_HEADS`."""
    found = row.reference
    if found is None:
        return ("–",) * len(REFERENCE_HEADS)
    return (_metres(found.median_m), _metres(found.nmad_m), *(_number(value, 3) for _, value in found.f1))


def remarks_on(row: ComparedRow) -> tuple[str, ...]:
    """Return the reason why a row is empty, and the warnings and cautions of its stages."""
    failure = () if row.failure is None else (f"failed: {row.failure}",)
    return (*failure, *row.warnings, *(caution.sentence for caution in row.cautions))


def _line(parts: Iterable[str]) -> str:
    return "| " + " | ".join(parts) + " |"


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _metres(value: float | None) -> str:
    """Return metres as text, with tenths of a millimetre below one metre."""
    return _number(value, 4 if value is not None and value < 1 else 2)
