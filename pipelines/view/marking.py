"""Marking of points in photographs: where a point must appear, what its marks give, and the files for `--gcp`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import project
from pipelines.scene.marks import MarkRays, mark_angles, mark_rays
from pipelines.scene.survey import Mark, Survey, SurveyedPoint
from pipelines.scene.trained_survey import TrainedSurvey

CONTROL, CHECK = "gcp_list.txt", "checkpoints.txt"
SIGMA_PX = 0.5  # of a mark that somebody sets with care; the survey's own marks keep theirs
_UNKNOWN = np.full(3, np.nan)


@dataclass(frozen=True)
class MarkedPoint:
    """Point with its marks.

    Attributes:
        name: of the point.
        xyz: surveyed coordinates in the CRS; None: not surveyed.
        is_check: whether it is a check point.
        marks: place in pixels of the full image, by image.
    """

    name: str
    xyz: tuple[float, float, float] | None
    is_check: bool = False
    marks: dict[str, tuple[float, float]] = field(default_factory=dict)

    def with_mark(self, image: str, place_px: tuple[float, float] | None) -> MarkedPoint:
        """Return the point with another mark in an image; None takes the mark away."""
        others = {name: place for name, place in self.marks.items() if name != image}
        return replace(self, marks=others if place_px is None else {**others, image: place_px})


def points_to_mark(survey: Survey, xyz_of: Callable[[tuple[SurveyedPoint, ...]], FloatArray]) -> list[MarkedPoint]:
    """Return the control and check points of a survey with their marks, also those with too few marks to be used.

    Args:
        survey: has the points.
        xyz_of: returns the coordinates (J, 3) of J points in the CRS.
    """
    control, check = (
        (*points, *(point for point in survey.unmarked_points if point.use == use))
        for use, points in (("control", survey.control_points), ("check", survey.check_points))
    )
    return [
        *_marked(control, xyz_of(control), is_check=False),
        *_marked(check, xyz_of(check), is_check=True),
    ]


def _marked(points: Sequence[SurveyedPoint], xyz: FloatArray, *, is_check: bool) -> list[MarkedPoint]:
    return [
        MarkedPoint(
            point.name,
            (float(row[0]), float(row[1]), float(row[2])),
            is_check,
            {mark.image: (mark.x_px, mark.y_px) for mark in point.marks},
        )
        for point, row in zip(points, xyz, strict=True)
    ]


def rays_of(point: MarkedPoint, trained: TrainedSurvey) -> MarkRays:
    """Return the rays of the marks of one point in registered images, through the trained lenses."""
    marks = tuple(Mark(image=name, x_px=x, y_px=y, sigma_px=SIGMA_PX) for name, (x, y) in point.marks.items())
    surveyed = SurveyedPoint(name=point.name, position_in_geo=(0.0, 0.0, 0.0), cov_in_geo=_IDENTITY, marks=marks)
    return mark_rays((surveyed,), trained.sparse)


def residuals_px(point_in_geo: FloatArray, rays: MarkRays, trained: TrainedSurvey) -> FloatArray:
    """Return the distances (K,) in pixels between marks and the projections of a point (3,)."""
    place = trained.geo_from_model.inverse().apply(point_in_geo[None])
    angle = mark_angles(rays, place, trained.poses.cam_from_model, trained.poses.cam_center_in_model)
    return np.asarray(angle / rays.sigma_rad * rays.sigma_px)


def appears_in(point_in_geo: FloatArray, trained: TrainedSurvey) -> list[tuple[int, FloatArray]]:
    """Return the cameras whose photograph must show a point (3,), the nearest first, with its pixel (2,) there."""
    place, poses = trained.geo_from_model.inverse().apply(point_in_geo[None])[0], trained.poses
    shown = []
    for camera in range(len(trained.sparse.image_name)):
        in_cam = poses.cam_from_model[camera] @ (place - poses.cam_center_in_model[camera])
        lens = trained.sparse.camera_of(camera)
        if in_cam[2] <= 0:
            continue
        pixel = project(lens, in_cam[None])[0]
        if np.isfinite(pixel).all() and (pixel >= 0).all() and (pixel <= [lens.width, lens.height]).all():
            shown.append((float(np.linalg.norm(in_cam)), camera, pixel))
    return [(camera, pixel) for _, camera, pixel in sorted(shown, key=lambda each: each[0])]


def mark_texts(crs: str, points: Sequence[MarkedPoint]) -> dict[str, str]:
    """Return the surveyed points with their marks as `gcp_list.txt` and `checkpoints.txt`, by name of the file.

    A point without coordinates or without marks is left out: the format has no place for it. A file without points
    is left out, too.

    Raises:
        InputError: a name or an image contains a space, which the format cannot hold.
    """
    texts = {}
    for file, is_check in ((CONTROL, False), (CHECK, True)):
        lines = [crs]
        for point in points:
            if point.is_check != is_check or point.xyz is None:
                continue
            for image, (x_px, y_px) in point.marks.items():
                bad = next((text for text in (point.name, image) if len(text.split()) != 1), None)
                if bad is not None:
                    raise InputError(f"{file} has no place for a space: rename {bad!r}")
                x, y, z = point.xyz
                lines.append(f"{x:.12g}\t{y:.12g}\t{z:.4f}\t{x_px:.3f}\t{y_px:.3f}\t{image}\t{point.name}")
        if len(lines) > 1:
            texts[file] = "\n".join(lines) + "\n"
    return texts


_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
