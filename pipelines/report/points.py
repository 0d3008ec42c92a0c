"""Control and check points: coordinates, errors, and chips: small pieces of the photographs around their marks."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipelines.adjust.posterior import Posterior
from pipelines.core.errors import InputError
from pipelines.core.plan import photograph_folder
from pipelines.core.progress import Progress
from pipelines.core.types import ByteArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import project
from pipelines.geometry.sparse_model import SparseModel
from pipelines.report.page import Picture, limited, picture_of
from pipelines.report.place import Texts, heads_of, texts_of
from pipelines.survey.marks import MarkRays, mark_rays
from pipelines.survey.photographs import decoded_photograph
from pipelines.survey.report import CheckPointErrors, EvaluationReport, PointResidual, PredictedPointError
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import TargetCrs

_SIDE_SHARE = 1 / 30  # of the longer side of the photographs
_LEAST_SIDE_PX = 96
_MOST_SHOWN_PX = 288  # stored side of a chip; the page magnifies it

Pixel = tuple[float, float]


Kind = Literal["control", "check"]


@dataclass(frozen=True)
class _Group:
    """Control or check points, with the rays of their K marks and the pixels where points project; NaN: nowhere."""

    kind: Kind
    points: tuple[SurveyedPoint, ...]
    errors: Sequence[PointResidual]
    field: str
    surveyed_in_geo: FloatArray
    rays: MarkRays
    surveyed_px: FloatArray
    adjusted_px: FloatArray


@dataclass(frozen=True)
class Chip:
    """Chip with its symbols, in pixels of the photograph from the chip's upper left corner; None: there is none.

    `distance_px` leads from the mark to the adjusted point.
    """

    image: str
    picture: Picture
    side_px: int
    mark: Pixel
    adjusted: Pixel | None
    surveyed: Pixel | None
    distance_px: float | None


def cut_chips(
    workspace: Workspace,
    survey: Survey,
    sparse: SparseModel,
    wanted: Sequence[tuple[_Group, int]],
    progress: Progress,
) -> tuple[dict[tuple[str, str], tuple[Chip, ...]], int]:
    """Return chips of marks by kind and name of points, and their side in pixels.

    Photographs are decoded one at a time, each once; an InputError: a photograph is not as surveyed.
    """
    folder = photograph_folder(workspace, survey.image_dir)
    sha256 = {image.name: image.sha256 for image in survey.images}
    side = _side_px(sparse)
    by_image: dict[int, list[tuple[_Group, int]]] = defaultdict(list)
    for group, mark in wanted:
        by_image[int(group.rays.camera[mark])].append((group, mark))
    chips: dict[tuple[str, str], list[Chip]] = defaultdict(list)
    with progress.task("image chips", len(by_image)) as task:
        for image, of_image in by_image.items():
            name = sparse.image_name[image]
            pixels = decoded_photograph(folder / name, sha256.get(name, ""))
            if pixels is None:
                message = "cannot be decoded, or has changed."
                remedy = "Restore the photograph."
                raise InputError("photograph-damaged", message, path=folder / name, remedy=remedy)
            for group, mark in of_image:
                places = np.stack([group.rays.xy_px[mark], group.adjusted_px[mark], group.surveyed_px[mark]])
                owner = group.kind, group.points[group.rays.point[mark]].name
                chips[owner].append(_cut(pixels[..., ::-1], name, places, side))
            task.advance()
    return {owner: tuple(mine) for owner, mine in chips.items()}, side


def _side_px(sparse: SparseModel) -> int:
    """Return the side of a chip, so that a target of a tenth of it is seen with what lies around it."""
    longest = max((max(camera.width, camera.height) for camera in sparse.cameras.values()), default=0)
    return max(_LEAST_SIDE_PX, 2 * round(_SIDE_SHARE * longest / 2))


def _cut(photograph: ByteArray, name: str, places: FloatArray, side: int) -> Chip:
    """Return the piece around a mark, moved into the photograph at its rim; a smaller photograph ends in black.

    The places (3, 2) are those of the mark and of the adjusted and the surveyed point; NaN: nowhere.
    """
    height, width = photograph.shape[:2]
    last = np.maximum([width, height], side) - side
    corner = np.floor(places[0] - side / 2).astype(int).clip(0, last)
    piece = np.zeros((side, side, 3), dtype=np.uint8)
    part = photograph[corner[1] : corner[1] + side, corner[0] : corner[0] + side]
    piece[: part.shape[0], : part.shape[1]] = part
    mark, *points = ((x, y) for x, y in (places - corner).tolist())
    adjusted, surveyed = ((x, y) if 0 <= x <= side and 0 <= y <= side else None for x, y in points)
    distance = float(np.hypot(*(places[1] - places[0])))
    return Chip(
        image=name,
        picture=picture_of(limited(piece, _MOST_SHOWN_PX)),
        side_px=side,
        mark=mark,
        adjusted=adjusted,
        surveyed=surveyed,
        distance_px=distance if np.isfinite(distance) else None,
    )


_MOST_CHIPS = 240


@dataclass(frozen=True)
class PointRow:
    """Surveyed point, with its coordinates in the CRS of the report."""

    name: str
    coordinates: Texts
    field: str | None  # path of its row in the report of `evaluate`, triangulated; None: it has none
    blunder: bool  # triangulated
    rejected: bool  # a control point that the solution has left out
    predicted: bool  # the row has predicted σ
    surface_field: str | None  # likewise, on the rendered surface
    rmse_px: float | None  # distance of its marks from the adjusted point; None: it is not measured
    chips: tuple[Chip, ...]


_FEW_POINTS = 12  # up to which two chips of each are printed, beyond one


@dataclass(frozen=True)
class PointsFacts:
    """Control or check points of a survey, with the heads of their coordinates' columns."""

    kind: Kind
    heads: Texts
    rows: tuple[PointRow, ...]
    chips: int  # number that is shown
    each_on_paper: int  # chips of a point that are printed
    marks: int  # number in registered photographs
    side_px: int  # of a chip, in pixels of the photographs
    surface: bool  # points were measured on the rendered surface

    @property
    def chips_on_paper(self) -> int:
        return sum(min(len(row.chips), self.each_on_paper) for row in self.rows)


def points_facts(
    workspace: Workspace,
    survey: Survey,
    posterior: Posterior,
    report: EvaluationReport,
    crs: TargetCrs,
    *,
    chips_a_point: int,
    progress: Progress,
) -> tuple[PointsFacts, PointsFacts]:
    """Return the control and check points of an evaluated survey, with 240 chips at most."""
    sparse, surface = posterior.sparse, report.checkpoints.surface
    checked = report.checkpoints.triangulated.points
    groups = (
        _group(posterior, "control", survey.control_points, report.fit.gcp.points, "fit.gcp.points"),
        _group(posterior, "check", survey.check_points, checked, "checkpoints.triangulated.points"),
    )
    total = sum(len(group.points) for group in groups)
    each = min(chips_a_point, max(1, _MOST_CHIPS // total)) if total else 0
    wanted = [chip for group in groups for chip in _wanted(group, each, sparse)]
    chips, side_px = cut_chips(workspace, survey, sparse, wanted[:_MOST_CHIPS], progress)
    rejected = posterior.solution.control_outliers
    control = _facts(groups[0], crs, chips, side_px, surface=surface, rejected=rejected)
    return control, _facts(groups[1], crs, chips, side_px, surface=surface)


def _group(
    posterior: Posterior,
    kind: Kind,
    points: tuple[SurveyedPoint, ...],
    errors: Sequence[PointResidual],
    field: str,
) -> _Group:
    by_name = {row.name: row.error_m for row in errors}
    surveyed = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
    error = np.array([by_name.get(point.name) or (np.nan,) * 3 for point in points]).reshape(-1, 3)
    rays = mark_rays(points, posterior.sparse, wrong=True)
    surveyed_px, adjusted_px = (
        _projected(posterior, place[rays.point], rays.camera) for place in (surveyed, surveyed + error)
    )
    return _Group(kind, points, errors, field, surveyed, rays, surveyed_px, adjusted_px)


def _wanted(group: _Group, each: int, sparse: SparseModel) -> list[tuple[_Group, int]]:
    """Return the marks of a group to show: whole chips first, then photographs that show most marked points."""
    rays, margin = group.rays, _side_px(sparse) / 2
    cameras = [sparse.camera_of(int(image)) for image in rays.camera]
    size = np.array([(camera.width, camera.height) for camera in cameras]).reshape(-1, 2)
    is_cut = np.any((rays.xy_px < margin) | (rays.xy_px > size - margin), axis=1)
    popular = np.bincount(rays.camera, minlength=len(sparse.image_name))[rays.camera]
    chosen = []
    for index in range(len(group.points)):
        marks = np.flatnonzero(rays.point == index)
        chosen += [(group, int(mark)) for mark in marks[np.lexsort((-popular[marks], is_cut[marks]))][:each]]
    return chosen


def _facts(
    group: _Group,
    crs: TargetCrs,
    chips: dict[tuple[str, str], tuple[Chip, ...]],
    side_px: int,
    *,
    surface: CheckPointErrors | None,
    rejected: tuple[str, ...] = (),
) -> PointsFacts:
    distance = group.rays.xy_px - group.adjusted_px
    place = {row.name: index for index, row in enumerate(group.errors)}
    on_surface = {} if surface is None else {row.name: index for index, row in enumerate(surface.points)}
    rows = []
    texts = texts_of(crs, group.surveyed_in_geo)
    for index, (point, coordinates) in enumerate(zip(group.points, texts, strict=True)):
        at = place.get(point.name)
        row = None if at is None else group.errors[at]
        surface_at = on_surface.get(point.name) if group.kind == "check" else None
        squares = (distance[group.rays.point == index] ** 2).sum(axis=1)
        rows.append(
            PointRow(
                name=point.name,
                coordinates=coordinates,
                field=None if at is None else f"{group.field}.{at}",
                blunder=bool(getattr(row, "blunder", False)),
                rejected=point.name in rejected,
                predicted=isinstance(row, PredictedPointError),
                surface_field=None if surface_at is None else f"checkpoints.surface.points.{surface_at}",
                rmse_px=float(np.sqrt(squares.mean())) if len(squares) and np.isfinite(squares).all() else None,
                chips=chips.get((group.kind, point.name), ()),
            )
        )
    return PointsFacts(
        kind=group.kind,
        heads=heads_of(crs),
        rows=tuple(rows),
        chips=sum(len(row.chips) for row in rows),
        marks=len(group.rays.point),
        side_px=side_px,
        surface=surface is not None,
        each_on_paper=2 if len(rows) <= _FEW_POINTS else 1,
    )


def _projected(posterior: Posterior, point_in_geo: FloatArray, camera: np.ndarray) -> FloatArray:
    """Return the pixels (K, 2) of points (K, 3) in an adjusted camera each; NaN for points that are NaN."""
    poses, in_model = posterior.solution.poses, posterior.solution.similarity.inverse().apply(point_in_geo)
    pixels = np.full((len(camera), 2), np.nan)
    for row, index in enumerate(camera):
        in_cam = poses.cam_from_model[index] @ (in_model[row] - poses.cam_center_in_model[index])
        if in_cam[2] > 0:
            pixels[row] = project(posterior.sparse.camera_of(int(index)), in_cam)
    return pixels
