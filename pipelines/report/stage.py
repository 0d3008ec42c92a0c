"""Report of a survey, which a surveyor hands to a client: cover, verdicts, accuracy, and an appendix.

Reads survey, SfM model, adjustment and the report of `evaluate`; trained model, test views, accuracy map, metrics
and LiDAR of the training, previews of the rasters, and the change since an earlier survey, where there are any.
Writes `report/report.html` and, on request, `report/report.pdf`.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from pipelines import __version__
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.solution import posterior_of
from pipelines.core.files import replace_text
from pipelines.core.products import Remark, union
from pipelines.core.stages import REPORT_PAGE
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.report.accuracy import accuracy_facts
from pipelines.report.cameras import (
    CamerasFacts,
    LensesFacts,
    OverlapFacts,
    cameras_facts,
    lenses_facts,
    overlap_facts,
)
from pipelines.report.chromium import chromium_path, print_pdf
from pipelines.report.cover import cover_facts
from pipelines.report.options import ReportOptions
from pipelines.report.page import Page, Section, moment, render_page
from pipelines.report.place import place_facts
from pipelines.report.points import points_facts
from pipelines.report.record import (
    RecordFacts,
    change_facts,
    delivered_facts,
    lidar_facts,
    measured_share,
    record_facts,
    reference_facts,
)
from pipelines.report.verdicts import Measured, Verdict, verdicts
from pipelines.report.views import adjusted_network, read_evaluated, seen_scene, training_facts, views_facts
from pipelines.survey.navigation import load_survey
from pipelines.survey.report import EvaluationReport
from pipelines.survey.solution import Solution, TrainedModel, read_sfm
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs, usable_crs

_ROOM = __name__.rpartition(".")[0]
_STEPS = 9


def run(stage: StageRun, options: ReportOptions) -> Summary:
    """Write the report, and return its key figures; a BackendUnavailableError: `--pdf` without a Chromium."""
    if options.pdf:
        chromium_path()  # a missing browser is told before the work begins
    with stage.progress.task("covariances of cameras and lenses", 1) as task:
        solution, report = read_evaluated(stage.workspace)
        sfm, survey = read_sfm(stage.workspace, solution), solution.weighted(load_survey(stage.workspace))
        posterior = posterior_of(stage.workspace, solution, sfm)
        task.advance()
    crs = usable_crs(options, survey.origin, solution.center_in_geo, survey.vertical)
    page, summary = report_page(stage, survey, report, posterior, crs=crs, options=options)
    html = stage.out / REPORT_PAGE.rpartition("/")[2]
    replace_text(html, render_page(page, _ROOM))
    if options.pdf:
        with stage.progress.task("PDF") as task:
            print_pdf(html, html.with_suffix(".pdf"))
            task.advance()
    levels = [verdict.level for verdict in summary.verdicts]
    counts = {level: levels.count(level) for level in ("good", "fair", "poor", "unknown")}
    size_mb = html.stat().st_size / 1e6
    return Summary(
        f"{', '.join(f'{count} {level}' for level, count in counts.items() if count)}; {size_mb:.1f} MB",
        {**counts, "bytes": html.stat().st_size, "pdf": options.pdf, "crs": crs.crs.name},
        cautions=summary.cautions,
    )


_ACCURACY = {
    "measured": "with measured and predicted accuracy",
    "predicted": "with predicted accuracy: nothing has measured it",
    "unknown": "without a statement of accuracy",
}


def report_page(
    stage: StageRun,
    survey: Survey,
    report: EvaluationReport,
    posterior: Posterior,
    *,
    crs: TargetCrs,
    options: ReportOptions,
) -> tuple[Page, SummaryFacts]:
    """Return the report of a survey, and what its cover and verdicts say."""
    workspace, solution = stage.workspace, posterior.solution
    network = adjusted_network(solution, posterior.sparse)
    scene = seen_scene(network, solution.similarity)
    with stage.progress.task("sections", _STEPS) as task:
        place = place_facts(survey, solution, scene, crs)
        task.advance(note="place")
        cameras = cameras_facts(survey, posterior, crs)
        task.advance(note="positions")
        overlap = overlap_facts(posterior, network, scene, crs)
        task.advance(note="overlap")
        lenses = lenses_facts(survey, posterior, network)
        task.advance(note="lenses")
        control, check = points_facts(
            workspace, survey, posterior, report, crs, chips_a_point=options.chips, progress=stage.progress
        )
        task.advance(note="points")
        accuracy = accuracy_facts(workspace, report, survey.check_points)
        task.advance(note="accuracy")
        of_gaussians, training = _sections_of_gaussians(workspace, solution, report, options)
        task.advance(note="views")
        record = record_facts(workspace, survey)
        change = change_facts(workspace, record)
        delivered = delivered_facts(workspace)
        task.advance(note="delivered files")
        task.advance(note="record")
    what = "3D Gaussian splat" if of_gaussians else "cameras"
    summary = summary_facts(
        survey, solution, report, cameras=cameras, overlap=overlap, lenses=lenses, record=record,
        delivered=measured_share(workspace),
    )  # fmt: skip
    page = Page(
        title=options.title or f"Survey report: {workspace.root.name}",
        subtitle=f"{what} in a local metric frame, not on Earth, with predicted accuracy"
        if survey.origin is None
        else f"Georeferenced {what}, {_ACCURACY[report.headline.kind]}",
        about={"Made": moment(datetime.now(UTC)), "Program": f"GeoRefGS {__version__}"},
        cover=cover_facts(
            workspace, survey, posterior, report, options, crs=crs, scene=scene, overlap=overlap, lenses=lenses
        ),
        sections=(
            Section("summary", "Summary", "summary.html", summary),
            Section("delivered", "What was delivered", "delivered.html", delivered),
            Section("accuracy", "Accuracy", "accuracy.html", accuracy),
            Section("check-points", "Check points", "points.html", check),
            Section("control-points", "Control points", "points.html", control),
            Section("place", "Local frame" if survey.origin is None else "Place on Earth", "place.html", place),
            Section("positions", "Positions of the photographs", "positions.html", cameras),
            Section("overlap", "Overlap and matches", "overlap.html", overlap),
            Section("lenses", "Residuals in the image, and lenses", "lenses.html", lenses),
            *of_gaussians,
            *([] if change is None else [Section("change", "Change", "change.html", change)]),
            Section("processing", "Appendix: processing", "record.html", record),
            Section("photographs", "Appendix: photographs", "photographs.html", cameras),
            Section("glossary", "Glossary", "glossary.html", bool(of_gaussians)),
            *training,  # last: paper leaves it out, and shall not lack a number
        ),
        document=report.model_dump(mode="json"),
    )
    return page, summary


def _sections_of_gaussians(
    workspace: Workspace, model: Solution, report: EvaluationReport, options: ReportOptions
) -> tuple[tuple[Section, ...], tuple[Section, ...]]:
    """Return the sections on what the Gaussians show, and those of the appendix on their training.

    There are none before training, or if `evaluate` has not seen the Gaussians; none on what was not compared.
    """
    test = report.test_views
    if test is None or not isinstance(model, TrainedModel):
        return (), ()
    views, training = views_facts(workspace, test, options.views), training_facts(workspace, model)
    lidar = lidar_facts(workspace)
    sections = [Section("test-views", "Test views", "views.html", views)]
    if report.reference is not None:
        reference = reference_facts(workspace)
        sections.append(Section("reference", "Surface against a reference", "reference.html", reference))
    if lidar is not None:
        sections.append(Section("lidar", "LiDAR in the training", "lidar.html", lidar))
    return tuple(sections), (Section("training", "Appendix: training", "training.html", training, folded=True),)


@dataclass(frozen=True)
class SummaryFacts:
    """Summary of an evaluated survey: traffic lights, cautions, and the accuracy in words."""

    verdicts: tuple[Verdict, ...]
    cautions: tuple[Remark, ...]
    accuracy: str


def summary_facts(
    survey: Survey,
    solution: Solution,
    report: EvaluationReport,
    *,
    cameras: CamerasFacts,
    overlap: OverlapFacts,
    lenses: LensesFacts,
    record: RecordFacts,
    delivered: tuple[float, float] | None,
) -> SummaryFacts:
    """Return the summary of an evaluated survey, of which it needs the facts of four sections."""
    cautions = union(solution.cautions, report.cautions)
    measured = Measured(
        photographs=len(survey.images),
        registered=lenses.photographs,
        enough_share=overlap.enough_share,
        enough=overlap.enough,
        parts=overlap.parts,
        rmse_px=lenses.rmse_px,
        fixes=report.fit.gnss.count + report.fit.gnss.outliers,
        fix_outliers=report.fit.gnss.outliers,
        control_points=len(survey.control_points) - report.fit.gcp.outliers,
        control_outliers=report.fit.gcp.outliers,
        check_points=len(survey.check_points),
        stale=tuple(stage.name for stage in record.stages if stage.state in ("stale", "damaged")),
        outliers=tuple(outlier.name for outlier in cameras.outliers),
        rejected=tuple(solution.control_outliers),
        largest_fix=cameras.largest_fix,
        delivered=delivered,
    )
    return SummaryFacts(
        verdicts=verdicts(report, measured, cautions),
        cautions=cautions,
        accuracy=report.headline.text,
    )
