"""Marking of points in photographs: expected pixels of a point, rays of its marks, and the files for `--gcp`.

Marks are saved on disk as they are set. The file has one record for each changed mark and point. A record stays
until the written files are ingested and the survey has its content, so that each viewer writes the marks of all
viewers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from pipelines.core.errors import InputError
from pipelines.core.files import replace_texts
from pipelines.core.products import ImageName, Product, load_json
from pipelines.core.types import FloatArray, Vector3
from pipelines.geometry.cameras import project
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.marks import MarkRays, mark_angles, mark_rays
from pipelines.survey.solution import Solution
from pipelines.survey.survey import Mark, Survey, SurveyedPoint
from pipelines.view.saved import changing

CONTROL, CHECK, MARKS = "gcp_list.txt", "checkpoints.txt", "marks.json"
SIGMA_PX = 0.5  # of a mark that somebody sets with care; the survey's own marks keep theirs
_SAME_PX = 1e-3  # largest difference of equal places: files of marks have three decimals
_SAME_LLA = (1e-8, 1e-8, 1e-3)  # degrees, degrees, metres: a millimetre
_IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class MarkedPoint:
    """Point with its marks."""

    name: str
    xyz: tuple[float, float, float] | None  # in the CRS; None: not surveyed
    is_check: bool = False
    marks: dict[str, tuple[float, float]] = field(default_factory=dict)  # px by image

    def with_mark(self, image: str, place_px: tuple[float, float] | None) -> MarkedPoint:
        """Return the point with another mark in an image; None takes the mark away."""
        others = {name: place for name, place in self.marks.items() if name != image}
        return replace(self, marks=others if place_px is None else {**others, image: place_px})


def points_to_mark(survey: Survey, xyz_of: Callable[[tuple[SurveyedPoint, ...]], FloatArray]) -> list[MarkedPoint]:
    """Return the control and check points of a survey with their marks, also those with too few marks to be used.

    `xyz_of` returns the coordinates (J, 3) of J points in the CRS.
    """
    to_mark = []
    for use, marked in (("control", survey.control_points), ("check", survey.check_points)):
        points = (*marked, *(point for point in survey.unmarked_points if point.use == use))
        for point, (x, y, z) in zip(points, xyz_of(points).tolist(), strict=True):
            marks = {mark.image: (mark.x_px, mark.y_px) for mark in point.marks}
            to_mark.append(MarkedPoint(point.name, (x, y, z), use == "check", marks))
    return to_mark


def rays_of(point: MarkedPoint, sparse: SparseModel) -> MarkRays:
    """Return the rays of the marks of one point in registered images, through the solved lenses."""
    return mark_rays((surveyed_marks(point),), sparse, wrong=True)


def surveyed_marks(point: MarkedPoint) -> SurveyedPoint:
    """Return the point as one of a survey, for its marks alone."""
    marks = tuple(Mark(image=name, x_px=x, y_px=y, sigma_px=SIGMA_PX) for name, (x, y) in point.marks.items())
    return SurveyedPoint(name=point.name, position_in_geo=(0.0, 0.0, 0.0), cov_in_geo=_IDENTITY, marks=marks)


def residuals_px(point_in_geo: FloatArray, rays: MarkRays, solution: Solution) -> FloatArray:
    """Return the distances (K,) in pixels between marks and the projections of a point (3,)."""
    place, poses = solution.similarity.inverse().apply(point_in_geo[None]), solution.poses
    angle = mark_angles(rays, place, poses.cam_from_model, poses.cam_center_in_model)
    return np.asarray(angle / rays.sigma_rad * rays.sigma_px)


def appears_in(point_in_geo: FloatArray, solution: Solution, sparse: SparseModel) -> list[tuple[int, FloatArray]]:
    """Return the cameras whose photograph must show a point (3,), the nearest first, with its pixel (2,) there."""
    place, poses = solution.similarity.inverse().apply(point_in_geo[None])[0], solution.poses
    views = []
    for camera in range(len(sparse.image_name)):
        in_cam = poses.cam_from_model[camera] @ (place - poses.cam_center_in_model[camera])
        lens = sparse.camera_of(camera)
        if in_cam[2] <= 0:
            continue
        pixel = project(lens, in_cam[None])[0]
        if np.isfinite(pixel).all() and (pixel >= 0).all() and (pixel <= [lens.width, lens.height]).all():
            views.append((float(np.linalg.norm(in_cam)), camera, pixel))
    return [(camera, pixel) for _, camera, pixel in sorted(views, key=lambda each: each[0])]


def mark_texts(crs: str, points: Sequence[MarkedPoint]) -> dict[str, str]:
    """Return points with marks as `gcp_list.txt` and `checkpoints.txt`, by file; an InputError: a name has a space.

    A point without coordinates or without marks is left out: the format has no place for it. A file without points
    is left out, too.
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
                    raise InputError(
                        "name-with-space", f"Names in {file} cannot contain spaces.", remedy=f"Rename {bad!r}."
                    )
                x, y, z = point.xyz
                lines.append(f"{x:.12g}\t{y:.12g}\t{z:.4f}\t{x_px:.3f}\t{y_px:.3f}\t{image}\t{point.name}")
        if len(lines) > 1:
            texts[file] = "\n".join(lines) + "\n"
    return texts


class KeptPoint(Product):
    """Changed point by its name; `lla` is in degrees and ellipsoidal metres; None: as surveyed, or not surveyed."""

    point: str = Field(min_length=1)
    lla: Vector3 | None
    is_check: bool


class KeptMark(Product):
    """Changed mark of a point in an image; its place in pixels of the full image is None where it was removed."""

    point: str = Field(min_length=1)
    image: ImageName
    place_px: tuple[float, float] | None


Record = KeptPoint | KeptMark
Key = tuple[str, ImageName | None]  # what a record is about: a point, or its mark in an image


class KeptRecords(Product):
    """Content of the file, and whether the files for `--gcp` have all of it."""

    format_version: Literal[1] = 1
    is_written: bool = True
    points: tuple[KeptPoint, ...] = ()
    marks: tuple[KeptMark, ...] = ()


class KeptMarks:
    """Points of a workspace with their marks, as surveyed and changed in its viewers; an InputError: a bad file.

    Args:
        lla_of, xyz_of: convert points (N, 3) from the viewer's CRS to latitude, longitude, height, and back.

    Attributes:
        points: all points, those of the survey first.
        is_written: whether the files for `--gcp` have all changes.
    """

    def __init__(
        self,
        folder: Path,
        surveyed: Sequence[MarkedPoint],
        lla_of: Callable[[FloatArray], FloatArray],
        xyz_of: Callable[[FloatArray], FloatArray],
    ) -> None:
        self._folder, self._lla_of, self._xyz_of = folder, lla_of, xyz_of
        self._surveyed = {point.name: point for point in surveyed}
        self.read()

    def read(self) -> None:
        """Read the file again, which another viewer may have changed."""
        self._take(*self._read())

    def set_mark(self, point: str, image: str, place_px: tuple[float, float] | None) -> None:
        """Set the mark of a point in an image, or remove it (None); a GeorefError: nothing was changed, and why."""
        self._change({(point, image): KeptMark(point=point, image=image, place_px=place_px)})

    def set_point(self, name: str, xyz: tuple[float, float, float] | None, *, is_check: bool) -> None:
        """Make a point, or change its place in the CRS (None: not) and use; a GeorefError: nothing was changed."""
        if len(name.split()) != 1:
            raise InputError(
                "name-with-space",
                f"Names in {CONTROL} and {CHECK} cannot contain spaces.",
                remedy=f"Rename {name!r}.",
            )
        former = self._records.get((name, None))
        lla = former.lla if isinstance(former, KeptPoint) else None
        if xyz is not None:
            lat, lon, height = self._lla_of(np.array([xyz]))[0].tolist()
            lla = (lat, lon, height)
        self._change({(name, None): KeptPoint(point=name, lla=lla, is_check=is_check)})

    def remove_point(self, name: str) -> None:
        """Remove a point that was made here, with its marks; a GeorefError: nothing was changed, and why."""
        if name in self._surveyed:
            raise InputError(
                "point-of-survey",
                f"{name} is a point of the survey.",
                remedy="Remove its marks, or run `georef ingest` without the point.",
            )
        self._change(dict.fromkeys(key for key in self._records if key[0] == name))

    def write(self, crs: str) -> list[Path]:
        """Write points and marks for `--gcp` and `--checkpoints`; return the files. A GeorefError: not written."""
        with changing(self._folder):
            self._take(*self._read())
            texts = {self._folder / name: text for name, text in mark_texts(crs, self.points).items()}
            if texts:
                self._save(self._records, is_written=True, others=texts)
        return list(texts)

    def _change(self, wanted: Mapping[Key, Record | None]) -> None:
        """Set records of the file, or drop them (None)."""
        with changing(self._folder):
            records, _ = self._read()
            for key in wanted:
                records.pop(key, None)
            records |= {key: record for key, record in wanted.items() if record is not None}
            self._save(records, is_written=False)

    def _save(
        self, records: dict[Key, Record], *, is_written: bool, others: Mapping[Path, str] | None = None
    ) -> None:
        content = KeptRecords(
            is_written=is_written,
            points=tuple(each for each in records.values() if isinstance(each, KeptPoint)),
            marks=tuple(each for each in records.values() if isinstance(each, KeptMark)),
        )
        replace_texts({**(others or {}), self._folder / MARKS: content.model_dump_json(indent=1) + "\n"})
        self._take(records, is_written)

    def _read(self) -> tuple[dict[Key, Record], bool]:
        """Return the records of the file that the survey has not taken over, and whether all are written."""
        path = self._folder / MARKS
        content = load_json(KeptRecords, path) if path.exists() else KeptRecords()
        stored: Sequence[Record] = (*content.points, *content.marks)
        records: dict[Key, Record] = {}
        for record in stored:
            if not self._is_surveyed(record):
                records[record.point, record.image if isinstance(record, KeptMark) else None] = record
        return records, content.is_written

    def _is_surveyed(self, record: Record) -> bool:
        """Return whether the survey says what a record says."""
        surveyed = self._surveyed.get(record.point)
        if isinstance(record, KeptMark):
            place = None if surveyed is None else surveyed.marks.get(record.image)
            if place is None or record.place_px is None:
                return place is record.place_px
            return bool(np.abs(np.subtract(place, record.place_px)).max() < _SAME_PX)
        if surveyed is None or surveyed.is_check != record.is_check:
            return False
        if surveyed.xyz is None or record.lla is None:
            return record.lla is None
        apart = np.abs(self._lla_of(np.array([surveyed.xyz]))[0] - record.lla)
        return bool((apart < _SAME_LLA).all())

    def _take(self, records: dict[Key, Record], is_written: bool) -> None:
        points = dict(self._surveyed)
        for record in records.values():
            point = points.get(record.point, MarkedPoint(record.point, None))
            if isinstance(record, KeptMark):
                points[record.point] = point.with_mark(record.image, record.place_px)
            else:
                xyz = point.xyz if record.lla is None else tuple(self._xyz_of(np.array([record.lla]))[0].tolist())
                points[record.point] = replace(point, xyz=xyz, is_check=record.is_check)
        self._records, self.points, self.is_written = records, tuple(points.values()), is_written
