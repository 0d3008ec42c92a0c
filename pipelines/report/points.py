"""Control and check points: coordinates, errors, and image chips around their marks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipelines.core.progress import Progress
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import project
from pipelines.report.chips import Chip, WantedChip, cut_chips
from pipelines.report.coordinates import Texts, heads_of, texts_of
from pipelines.report.evaluated import EvaluatedSurvey
from pipelines.scene.marks import mark_rays
from pipelines.scene.report import PointResidual, PredictedPointError
from pipelines.scene.survey import SurveyedPoint

_MOST_CHIPS = 240

Kind = Literal["control", "check"]


@dataclass(frozen=True)
class PointRow:
    """Surveyed point.

    Attributes:
        name: as in the survey.
        coordinates: surveyed, in the CRS of the report.
        field: path of its row in the report of `evaluate`; None: it has none.
        blunder: whether it is a blunder, triangulated.
        predicted: whether the row has predicted σ.
        model_field: path of its row on the rendered surface; None: it has none.
        rmse_px: root mean square distance of its marks from the adjusted point; None: it is not measured.
        chips: of its marks.
    """

    name: str
    coordinates: Texts
    field: str | None
    blunder: bool
    predicted: bool
    model_field: str | None
    rmse_px: float | None
    chips: tuple[Chip, ...]


@dataclass(frozen=True)
class PointsFacts:
    """Control or check points of a survey.

    Attributes:
        kind: which of the two.
        heads: of the columns of the coordinates.
        rows: one for each point.
        chips: number of image chips that are shown.
        marks: number of marks in registered photographs.
        side_px: side of a chip in pixels of the photographs.
        surface: whether points were measured on the rendered surface.
    """

    kind: Kind
    heads: Texts
    rows: tuple[PointRow, ...]
    chips: int
    marks: int
    side_px: int
    surface: bool


def points_facts(
    evaluated: EvaluatedSurvey, chips_a_point: int, progress: Progress
) -> tuple[PointsFacts, PointsFacts]:
    """Return the control points and the check points of an evaluated survey.

    Args:
        evaluated: the survey.
        chips_a_point: most image chips for each point; all points together have 240 at most.
        progress: shows the photographs that chips are cut from.

    Raises:
        InputError: a photograph cannot be read, or has changed since `ingest`.
    """
    survey, report = evaluated.solved.survey, evaluated.report
    control = _Group("control", survey.control_points, report.fit.gcp.points, "fit.gcp.points")
    check = _Group("check", survey.check_points, report.checkpoints.camera.points, "checkpoints.camera.points")
    groups = (control, check)
    total = sum(len(group.points) for group in groups)
    each = min(chips_a_point, max(1, _MOST_CHIPS // total)) if total else 0
    wanted = [chip for group in groups for chip in _wanted(evaluated, group, each)]
    chips, side_px = cut_chips(evaluated, wanted[:_MOST_CHIPS], progress)
    facts = [_facts(evaluated, group, chips, side_px) for group in groups]
    return facts[0], facts[1]


@dataclass(frozen=True)
class _Group:
    kind: Kind
    points: tuple[SurveyedPoint, ...]
    errors: Sequence[PointResidual]
    field: str

    def adjusted(self) -> FloatArray:
        """Return the measured positions (J, 3) in `geo`; NaN: not measured."""
        by_name = {row.name: row for row in self.errors}
        position = np.full((len(self.points), 3), np.nan)
        for index, point in enumerate(self.points):
            row = by_name.get(point.name)
            if row is not None and row.de_m is not None and row.dn_m is not None and row.du_m is not None:
                position[index] = np.add(point.position_in_geo, (row.de_m, row.dn_m, row.du_m))
        return position


def _wanted(evaluated: EvaluatedSurvey, group: _Group, each: int) -> list[WantedChip]:
    """Return the chips of a group: for each point those photographs that show most marked points."""
    rays = mark_rays(group.points, evaluated.solved.sparse)
    adjusted = _projected(evaluated, group.adjusted()[rays.point], rays.camera)
    surveyed = np.array([point.position_in_geo for point in group.points]).reshape(-1, 3)
    on_survey = _projected(evaluated, surveyed[rays.point], rays.camera)
    popular = np.bincount(rays.camera, minlength=len(evaluated.solved.sparse.image_name))
    chips: list[WantedChip] = []
    for index, point in enumerate(group.points):
        marks = np.flatnonzero(rays.point == index)
        for mark in marks[np.argsort(-popular[rays.camera[marks]], kind="stable")][:each]:
            x_px, y_px = rays.xy_px[mark].tolist()
            chips.append(
                WantedChip(
                    (group.kind, point.name),
                    int(rays.camera[mark]),
                    (x_px, y_px),
                    _pair(adjusted[mark]),
                    _pair(on_survey[mark]),
                )
            )
    return chips


def _facts(
    evaluated: EvaluatedSurvey, group: _Group, chips: dict[tuple[str, str], tuple[Chip, ...]], side_px: int
) -> PointsFacts:
    rays = mark_rays(group.points, evaluated.solved.sparse)
    distance = rays.xy_px - _projected(evaluated, group.adjusted()[rays.point], rays.camera)
    surveyed = np.array([point.position_in_geo for point in group.points]).reshape(-1, 3)
    place = {row.name: index for index, row in enumerate(group.errors)}
    surface = evaluated.report.checkpoints.model
    by_model = {} if surface is None else {row.name: index for index, row in enumerate(surface.points)}
    rows = []
    for index, (point, coordinates) in enumerate(zip(group.points, texts_of(evaluated.crs, surveyed), strict=True)):
        at = place.get(point.name)
        row = None if at is None else group.errors[at]
        model_at = by_model.get(point.name) if group.kind == "check" else None
        squares = (distance[rays.point == index] ** 2).sum(axis=1)
        rows.append(
            PointRow(
                name=point.name,
                coordinates=coordinates,
                field=None if at is None else f"{group.field}.{at}",
                blunder=bool(getattr(row, "blunder", False)),
                predicted=isinstance(row, PredictedPointError),
                model_field=None if model_at is None else f"checkpoints.model.points.{model_at}",
                rmse_px=float(np.sqrt(squares.mean())) if len(squares) and np.isfinite(squares).all() else None,
                chips=chips.get((group.kind, point.name), ()),
            )
        )
    return PointsFacts(
        kind=group.kind,
        heads=heads_of(evaluated.crs),
        rows=tuple(rows),
        chips=sum(len(row.chips) for row in rows),
        marks=len(rays),
        side_px=side_px,
        surface=surface is not None,
    )


def _projected(evaluated: EvaluatedSurvey, point_in_geo: FloatArray, camera: np.ndarray) -> FloatArray:
    """Return the pixels (K, 2) of points (K, 3) in an adjusted camera each; NaN for points that are NaN."""
    solved = evaluated.solved
    in_model = solved.geo_from_model.inverse().apply(point_in_geo)
    pixels = np.full((len(camera), 2), np.nan)
    for row, index in enumerate(camera):
        in_cam = solved.poses.cam_from_model[index] @ (in_model[row] - solved.poses.cam_center_in_model[index])
        if in_cam[2] > 0:
            pixels[row] = project(solved.sparse.camera_of(int(index)), in_cam)
    return pixels


def _pair(values: FloatArray) -> tuple[float, float] | None:
    x, y = values.tolist()
    return (x, y) if np.isfinite([x, y]).all() else None
