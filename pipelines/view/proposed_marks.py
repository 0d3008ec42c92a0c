"""Marks that the adjusted cameras propose, as a table for `--marks`: no mark of the survey is among them.

A point is expected where its marks meet, else where it was surveyed. A quartered target near its pixel is a mark
with σ. Where there is none, what the nearest marked photograph shows is searched, as in the viewer.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.errors import GeorefError, InputError
from pipelines.core.files import replace_texts
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import ByteArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.tables import table_text
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.marks import triangulated_points, wrong_marks
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import Solution, read_sfm, read_solution
from pipelines.survey.survey import Mark, PointMarks, Survey, SurveyedPoint
from pipelines.view.mark_views import proposals
from pipelines.view.marking import SIGMA_PX, MarkedPoint, appears_in, rays_of
from pipelines.view.options import ProposalOptions
from pipelines.view.pictures import Photographs
from pipelines.view.quarters import find_quarters

FILE = "view/proposed_marks.csv"
_CORRELATED_SIGMA_PX = 1.0  # of a place that looks like that around a mark: the mark itself and the surface count


@dataclass(frozen=True)
class ProposedMark:
    """Proposed mark; `how` is `quarters` or `correlation`, `score` its likeness, 1 at the most."""

    point: str
    mark: Mark
    how: str
    score: float


@dataclass(frozen=True)
class ProposalSummary:
    """Proposed marks, and their file."""

    file: Path
    marks: int
    points: int
    quarters: int
    left_out: tuple[str, ...]  # that do not meet the other marks of their point


def propose_marks(workspace: Workspace, options: ProposalOptions, progress: Progress = SILENT) -> ProposalSummary:
    """Write the proposed marks of a workspace.

    Raises:
        MissingProductError: `init-sim3` has not run.
        InputError: no point was surveyed.
    """
    solution, survey = read_solution(workspace), load_survey(workspace)
    sparse = solution.with_lenses(read_sfm(workspace, solution))
    photograph = Photographs(workspace, survey, sparse).full
    proposed, left_out = proposed_marks(survey, solution, sparse, photograph, options.reach, progress=progress)
    rows = []
    for each in proposed:
        numbers = (each.mark.x_px, each.mark.y_px, each.mark.sigma_px)
        cells = (f"{value:.3f}" for value in numbers)
        rows.append((each.mark.image, each.point, *cells, each.how, f"{each.score:.3f}"))
    file = workspace.root / FILE
    file.parent.mkdir(exist_ok=True)
    replace_texts({file: table_text([("image", "label", "x", "y", "sigma", "how", "score"), *rows])})
    quarters = sum(each.how == "quarters" for each in proposed)
    return ProposalSummary(file, len(proposed), len({each.point for each in proposed}), quarters, left_out)


def proposed_marks(
    survey: Survey,
    solution: Solution,
    sparse: SparseModel,
    photograph: Callable[[int], ByteArray],
    reach_px: float,
    *,
    progress: Progress = SILENT,
) -> tuple[list[ProposedMark], tuple[str, ...]]:
    """Return marks of surveyed points in photographs without them, and which were left out as others contradict.

    Args:
        sparse: the SfM model with the solved lenses.
        photograph: returns that of a camera (H, W, 3) RGB; a GeorefError: it has no marks.
        reach_px: how far from its expected pixel a quartered target may be.
    """
    points = (*survey.control_points, *survey.check_points, *survey.unmarked_points)
    if not points:
        raise InputError(
            "no-ground-points", "The survey has no ground points.", remedy="Give `georef ingest` --gcp."
        )
    places = {}  # where points are expected (3,) in `geo`
    for point in points:
        pixels = {mark.image: (mark.x_px, mark.y_px) for mark in point.marks}
        by_marks = triangulated_points(solution, rays_of(MarkedPoint(point.name, None, marks=pixels), sparse))[0]
        places[point.name] = by_marks if np.isfinite(by_marks).all() else np.array(point.position_in_geo)
    proposed: list[ProposedMark] = []
    wanted: dict[int, list[tuple[str, FloatArray]]] = defaultdict(list)
    for point in points:
        marked = {mark.image for mark in point.marks}
        for camera, pixel in appears_in(places[point.name], solution, sparse):
            if sparse.image_name[camera] not in marked:
                wanted[camera].append((point.name, pixel))
    with progress.task("quartered targets", len(wanted)) as task:
        for camera, mine in wanted.items():
            proposed += _quarters(sparse.image_name[camera], mine, photograph, camera, reach_px)
            task.advance()
    proposed, left_out = _met(points, proposed, sparse)
    with progress.task("likeness", len(points)) as task:
        for point in points:
            of_point = [*point.marks, *(each.mark for each in proposed if each.point == point.name)]
            marks = {mark.image: (mark.x_px, mark.y_px) for mark in of_point}
            marked_point = MarkedPoint(point.name, None, marks=marks)
            alike = proposals(
                solution, sparse, marked_point, places[point.name], photograph, advance=lambda _: None
            )
            for each in alike if marks else ():
                x_px, y_px = each.place_px
                mark = Mark(image=each.image, x_px=x_px, y_px=y_px, sigma_px=_CORRELATED_SIGMA_PX)
                proposed.append(ProposedMark(point.name, mark, "correlation", each.score))
            task.advance()
    proposed, more = _met(points, proposed, sparse)
    return sorted(proposed, key=lambda each: (each.point, each.mark.image)), (*left_out, *more)


def _quarters(
    image: str,
    wanted: Sequence[tuple[str, FloatArray]],
    photograph: Callable[[int], ByteArray],
    camera: int,
    reach_px: float,
) -> list[ProposedMark]:
    try:
        grey = np.asarray(cv2.cvtColor(photograph(camera), cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    except GeorefError:  # a photograph that cannot be read has no proposal
        return []
    proposed = []
    for name, pixel in wanted:
        target = find_quarters(grey, pixel, reach_px)
        if target is not None:
            x_px, y_px = target.center_px.tolist()
            mark = Mark(image=image, x_px=x_px, y_px=y_px, sigma_px=target.sigma_px)
            proposed.append(ProposedMark(name, mark, "quarters", target.share))
    return proposed


def _met(
    points: Sequence[SurveyedPoint], proposed: Sequence[ProposedMark], sparse: SparseModel
) -> tuple[list[ProposedMark], tuple[str, ...]]:
    """Return the proposals but those that the other marks of their points do not meet, and these."""
    by_point: dict[str, list[Mark]] = defaultdict(list)
    for each in proposed:
        by_point[each.point].append(each.mark)
    # A mark's σ tells nothing of the cameras: none counts as better than one set by a person.
    all_marks = [
        PointMarks(
            name=point.name,
            marks=tuple(
                mark.model_copy(update={"sigma_px": max(SIGMA_PX, mark.sigma_px)})
                for mark in (*point.marks, *by_point[point.name])
            ),
        )
        for point in points
    ]
    wrong = {(mark.point, mark.image): mark.off_px for mark in wrong_marks(all_marks, sparse)}
    kept = [each for each in proposed if (each.point, each.mark.image) not in wrong]
    left_out = [
        f"{each.point} in {each.mark.image} ({wrong[each.point, each.mark.image]:.0f} px)"
        for each in proposed
        if (each.point, each.mark.image) in wrong
    ]
    return kept, tuple(left_out)
