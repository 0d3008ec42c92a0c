"""Panel of the viewer in which points are marked in photographs, and the marks are written for `--gcp`."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.core.errors import GeorefError, StorageError
from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import distort
from pipelines.surface.picking import SurfacePoint
from pipelines.survey.marks import bearings_at
from pipelines.survey.survey import SurveyedPoint
from pipelines.view.marking import KeptMarks, MarkedPoint, appears_in, points_to_mark, rays_of, residuals_px
from pipelines.view.measuring import MeasuringModel
from pipelines.view.photo_view import PhotoView
from pipelines.view.saved import PlaceRow, failure, mark_table, paragraph, place_table

if TYPE_CHECKING:
    import viser


_NONE = "—"
_NO_POINT = "Make a point first: its name, and its coordinates if it was surveyed."


class Panel:
    """Panel with buttons and results; the error of a button's action is shown above the results, which stay."""

    _result: viser.GuiHtmlHandle
    _failed: viser.GuiHtmlHandle

    def _add_results(self, gui: viser.GuiApi) -> None:
        self._failed, self._result = gui.add_html(""), gui.add_html("")

    def _button(self, gui: viser.GuiApi, label: str, act: Callable[[], None], hint: str | None = None) -> None:
        gui.add_button(label, hint=hint).on_click(lambda _: self._safely(act))

    def _safely(self, act: Callable[[], None]) -> None:
        try:
            act()
        except GeorefError as error:
            stays = " The page keeps what it shows: make room on the disk, then try again."
            self._failed.content = failure(f"Not done: {error}.{stays if isinstance(error, StorageError) else ''}")
        else:
            self._failed.content = ""

    def _tell(self, sentence: str) -> None:
        self._result.content = paragraph(sentence)


class MarkPanel(Panel):
    """Panel of the marks; `folder` has their files."""

    def __init__(self, server: viser.ViserServer, model: MeasuringModel, photo: PhotoView, folder: Path) -> None:
        self._model, self._photo = model, photo
        survey, crs = model.trained.survey, model.target.crs
        self.names = model.trained.sparse.image_name
        self._kept = KeptMarks(folder, points_to_mark(survey, self._xyz), crs.lla_from_xyz, crs.xyz_from_lla)
        self._lock = threading.RLock()
        self._build(server.gui)
        self._show()

    def _xyz(self, points: tuple[SurveyedPoint, ...]) -> FloatArray:
        position = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
        return self._model.target.xyz_from_geo(position) if len(position) else position

    def _build(self, gui: viser.GuiApi) -> None:
        self._chosen = gui.add_dropdown("Point", self._options(), hint="Point that the clicks mark")
        self._add_results(gui)
        self._button(gui, "Next photograph (N)", lambda: self.turn(1))
        self._button(gui, "Previous photograph (B)", lambda: self.turn(-1))
        self._button(gui, "Whole photograph (M)", self._photo.whole)
        self._button(gui, "Remove the mark here", self._remove)
        self._button(gui, "Undo", self.undo, hint="Takes back the last mark, removal or point, step by step")
        with gui.add_folder("New point, or its coordinates", expand_by_default=False):
            self._new_name = gui.add_text("Name", "")
            self._coordinates = gui.add_text("x y z", "", hint="In the CRS of the viewer; empty: not surveyed")
            self._is_check = gui.add_checkbox("Check point", False)
            self._button(gui, "Set", self._set)
            self._button(gui, "Remove the chosen point", self._remove_point)
        self._button(gui, "Write gcp_list.txt", self._write)
        self._chosen.on_update(lambda _: self._show())
        gui.add_command("Next photograph", hotkey="N").on_trigger(lambda _: self.turn(1))
        gui.add_command("Previous photograph", hotkey="B").on_trigger(lambda _: self.turn(-1))
        gui.add_command("Whole photograph", hotkey="M").on_trigger(lambda _: self._photo.whole())

    def _options(self) -> tuple[str, ...]:
        return tuple(point.name for point in self._kept.points) or (_NONE,)

    @property
    def point(self) -> MarkedPoint | None:
        return next((point for point in self._kept.points if point.name == self._chosen.value), None)

    def choose(self, name: str) -> None:
        """Choose the point that clicks mark."""
        self._chosen.value = name  # type: ignore[misc]
        self._show()

    def turn(self, step: int) -> None:
        """Show the next photograph in which the point must appear, or the one before."""
        with self._lock:
            point = self.point
            if point is None:
                self._tell(_NO_POINT)
                return
            place = self._expected(point)
            shown = [camera for camera, _ in appears_in(place, self._model.trained)] if place is not None else []
            cameras = shown or list(range(len(self.names)))
            present = self._photo.camera
            number = (cameras.index(present) + step) % len(cameras) if present in cameras else 0
            self._photo.show(cameras[number])
            self._show()

    def add(self, camera: int, direction_in_cam: FloatArray) -> None:
        """Mark the chosen point at the pixel of a direction (3,) in the shown camera; a failure is shown."""
        with self._lock:
            point = self.point
            if point is None:
                self._tell(_NO_POINT)
                return
            lens = self._model.trained.sparse.camera_of(camera)
            x_px, y_px = distort(lens, direction_in_cam[:2] / direction_in_cam[2]).tolist()
            if not (0 <= x_px <= lens.width and 0 <= y_px <= lens.height):
                self._tell("This place is outside the photograph.")
                return
            self._safely(lambda: self._set_mark(point.name, self.names[camera], (x_px, y_px)))

    def measured(self) -> SurfacePoint | None:
        """Return the chosen point, triangulated; None with fewer than two marks."""
        point = self.point
        if point is None:
            return None
        rays = rays_of(point, self._model.trained)
        place, cov = self._model.triangulated(rays)
        if not np.isfinite(place).all():
            return None
        return SurfacePoint(place, np.zeros((3, 3)) if cov is None else cov, rays.camera)

    def _set_mark(self, name: str, image: str, place_px: tuple[float, float] | None) -> None:
        self._kept.set_mark(name, image, place_px)
        self._show_points(name)

    def _remove(self) -> None:
        with self._lock:
            point, camera = self.point, self._photo.camera
            if point is not None and camera is not None and self.names[camera] in point.marks:
                self._set_mark(point.name, self.names[camera], None)

    def _remove_point(self) -> None:
        with self._lock:
            if self.point is not None:
                self._kept.remove_point(self.point.name)
                self._show_points()

    def undo(self) -> None:
        """Undo the last change of marks or points; a GeorefError: the change could not be kept, and why."""
        with self._lock:
            step = self._kept.history.undo()
            self._show_points(note=f"Undone: {step}." if step else "Nothing to undo.")

    def _show_points(self, name: str | None = None, note: str = "") -> None:
        """Update the list of points, and choose one; None: keep the choice if that point still exists."""
        options = self._options()
        if options != self._chosen.options:
            self._chosen.options = options
        if name is not None:
            self._chosen.value = name  # type: ignore[misc]
        self._show(note)

    def _set(self) -> None:
        name = self._new_name.value.strip()[:200]
        if not name:
            self._tell("A point needs a name.")
            return
        xyz = None
        if texts := self._coordinates.value.replace(",", " ").split():
            try:
                x, y, z = (float(text) for text in texts)
                if not np.isfinite([x, y, z]).all():
                    raise ValueError
            except ValueError:
                self._tell("Coordinates are three numbers: x y z in the CRS of the viewer.")
                return
            xyz = (x, y, z)
        with self._lock:
            self._kept.set_point(name, xyz, is_check=self._is_check.value)
            self._show_points(name)

    def _expected(self, point: MarkedPoint) -> FloatArray | None:
        """Return where a point must be (3,) in `geo`: by its marks, or by its survey."""
        by_marks, _ = self._model.triangulated(rays_of(point, self._model.trained))
        if np.isfinite(by_marks).all():
            return by_marks
        return None if point.xyz is None else self._model.target.geo_from_xyz(np.array([point.xyz]))[0]

    def _write(self) -> None:
        with self._lock:
            files = self._kept.write(self._model.target.crs.name)
            self._show_points()
        if not files:
            self._tell("No point has both coordinates and marks: nothing to write.")
            return
        names, heights = ", ".join(map(str, files)), self._model.target.crs.vertical.name
        self._result.content = paragraph(f"Written: {names}. Heights: {heights}.", mark="written")

    def _show(self, note: str = "") -> None:
        """Show the chosen point: its marks, what they give, and where it must appear in the photograph."""
        with self._lock:
            point = self.point
            self._photo.draw(*self._crosses(point))
            if point is None:
                self._tell(f"{note} No point yet: make one below.".lstrip())
                return
            rays = rays_of(point, self._model.trained)
            place, cov = self._model.triangulated(rays)
            rows, residuals = [], {}
            if point.xyz is not None:
                surveyed = self._model.target.geo_from_xyz(np.array([point.xyz]))[0]
                rows.append(PlaceRow("surveyed", surveyed, None))
            if np.isfinite(place).all():
                rows.append(PlaceRow("triangulated", place, None if cov is None else np.sqrt(np.diag(cov))))
                errors = residuals_px(place, rays, self._model.trained)
                residuals = {self.names[camera]: error for camera, error in zip(rays.camera, errors, strict=True)}
            lines = [note] if note else []
            if self._photo.camera is not None:
                lines.append(f"Shown: {self.names[self._photo.camera]}")
            if not self._kept.is_written:
                lines.append("Changes of marks are kept; gcp_list.txt is not written yet.")
            shown = "".join(map(paragraph, lines))
            places = place_table(self._model.target, rows, marked="marked") if rows else ""
            self._result.content = shown + places + mark_table(point.marks, residuals)

    def _crosses(self, point: MarkedPoint | None) -> tuple[FloatArray | None, FloatArray | None, list[FloatArray]]:
        """Return directions (3,) in the shown camera of the mark and the expected place, and epipolar lines.

        Each line (2, 3) in `model` is the line of sight of a mark in another photograph.
        """
        camera, trained = self._photo.camera, self._model.trained
        if point is None or camera is None:
            return None, None, []
        mark, own = None, point.marks.get(self.names[camera])
        if own is not None:
            mark = bearings_at(trained.sparse, camera, np.array([own]))[0]
        place = self._expected(point)
        expected = None
        if place is not None:
            in_model = trained.geo_from_model.inverse().apply(place[None])[0]
            expected = trained.poses.cam_from_model[camera] @ (in_model - trained.poses.cam_center_in_model[camera])
        lines = []
        rays = rays_of(point, trained)
        for other, bearing in zip(rays.camera.tolist(), rays.bearing_in_cam, strict=True):
            if other != camera:
                center = trained.poses.cam_center_in_model[other]
                along = trained.poses.cam_from_model[other].T @ bearing
                lines.append(np.stack([center, center + self._photo.reach_m * along]))
        return mark, expected, lines
