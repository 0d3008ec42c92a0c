"""Panel of the viewer in which points, distances, areas and volumes are measured, named, saved and deleted."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from pipelines.geodesy.enu import lla_from_enu
from pipelines.surface.picking import NoSurface, Sight, SurfacePoint
from pipelines.survey.marks import mark_rays
from pipelines.survey.survey import SurveyedPoint
from pipelines.view import saved
from pipelines.view.mark_panel import Panel
from pipelines.view.measuring import MeasuringModel
from pipelines.view.overlays import Overlays
from pipelines.view.quantities import BaseKind, BasePlane, Quantity, distances, length

if TYPE_CHECKING:
    import viser

_LEAST = {"point": 1, "distance": 2, "polyline": 2, "area": 3, "volume": 3}  # points of a measurement
_MOST = {"point": 1, "distance": 2}
_CLOSED = ("area", "volume")
_BASES: tuple[BaseKind, ...] = get_args(BaseKind)


class MeasurePanel(Panel):
    """Panel of the measurements; `folder` has the saved ones."""

    def __init__(
        self, server: viser.ViserServer, model: MeasuringModel, overlays: Overlays, folder: Path, model_hash: str
    ) -> None:
        self._model, self._overlays, self._hash = model, overlays, model_hash
        self._names = model.trained.sparse.image_name
        survey = model.trained.survey
        self._surveyed = {point.name: point for point in (*survey.control_points, *survey.check_points)}
        self.points: tuple[SurfacePoint, ...] = ()
        self._kind: saved.Kind = "point"
        self._quantities: tuple[Quantity, ...] = ()
        self._id = saved.new_id()
        self._lock = threading.RLock()
        self.saved, self._drawn = saved.SavedMeasurements(folder), 0
        self._history = saved.History()
        self._build(server)
        self._show_saved()

    def choose(self, kind: saved.Kind) -> None:
        """Begin a measurement of a kind."""
        with self._lock:
            self.kind.value = kind  # type: ignore[misc]
            self.clear()

    def _build(self, server: viser.ViserServer) -> None:
        gui = server.gui
        self.kind = gui.add_dropdown("Measure", get_args(saved.Kind), hint="What the clicks in the scene make up")
        self._base = gui.add_dropdown("Base of a volume", _BASES)
        self._add_results(gui)
        self._name = gui.add_text("Name", "")
        self._button(gui, "Save", self.save)
        self._button(gui, "Take the last point back", self.take_back)
        self._button(gui, "Clear", self.clear)
        self._button(gui, "Undo", self.undo, hint="Brings back what was removed, cleared or deleted, step by step")
        self._list = gui.add_html("")
        self._chosen = gui.add_dropdown("Saved", ("—",))
        self._button(gui, "Delete the saved one", self._delete)
        self.kind.on_update(lambda _: self._change_kind())
        self._base.on_update(lambda _: self._compute())
        self._result.content = self._hint()

    def add_sight(self, sight: Sight) -> None:
        """Measure the surface under a line of sight."""
        with self._lock:
            self._add(self._model.reader.under(sight), "")

    def add_surveyed(self, name: str) -> None:
        """Measure a surveyed point behind its marks, as `evaluate` does on the rendered surface."""
        with self._lock:
            point = self._surveyed[name]
            rays = mark_rays((point,), self._model.trained.sparse)
            self._add(self._model.reader.behind_marks(rays), self._against_survey(point))

    def add_point(self, point: SurfacePoint) -> None:
        """Add a point that was measured elsewhere, such as in marked photographs."""
        with self._lock:
            self._add(point, "")

    def _add(self, point: SurfacePoint | NoSurface, note: str) -> None:
        if isinstance(point, NoSurface):
            self._tell(f"Nothing measured: {point.reason}.")
            return
        kept = () if len(self.points) >= _MOST.get(self._kind, 10_000) else self.points
        self._replace("point", self._kind, (*kept, point), note)

    def _replace(self, step: str, kind: saved.Kind, points: tuple[SurfacePoint, ...], note: str = "") -> None:
        """Replace kind and points of the present measurement, as a step that can be undone under its name."""
        former_kind, former = self._kind, self.points
        if points or former:
            self._history.add(step, lambda: self._show(former_kind, former))
        self._show(kind, points, note)

    def _show(self, kind: saved.Kind, points: tuple[SurfacePoint, ...], note: str = "") -> None:
        self._kind, self.points = kind, points
        self.kind.value = kind  # type: ignore[misc]
        self._compute(note)

    def _change_kind(self) -> None:
        with self._lock:
            if self.kind.value != self._kind:
                self._replace("points of another kind", self.kind.value, ())

    def _compute(self, note: str = "") -> None:
        kind = self._kind
        self._quantities = ()
        if len(self.points) >= _LEAST[kind]:
            if kind in _CLOSED:
                self._tell("Reading the surface …")
            self._quantities = self._measured(kind)
        places = np.array([point.position_in_geo for point in self.points])
        self._overlays.show_measured("now", places, closed=kind in _CLOSED and len(self.points) > 2)
        self._result.content = self._described(note)

    def _measured(self, kind: saved.Kind) -> tuple[Quantity, ...]:
        if kind == "distance":
            return distances(self._model.jointly(self.points))
        if kind == "polyline":
            return length(self._model.jointly(self.points))
        if kind == "area":
            return self._model.area(self.points)
        if kind == "volume":
            base: BaseKind = self._base.value
            return self._model.volume(self.points, BasePlane(base))
        return ()

    def _against_survey(self, point: SurveyedPoint) -> str:
        """Return the coordinates of a surveyed point as surveyed and as triangulated, as HTML."""
        rays = mark_rays((point,), self._model.trained.sparse)
        camera, cov = self._model.triangulated(rays)
        rows = [saved.PlaceRow("surveyed", np.array(point.position_in_geo), np.sqrt(np.diag(point.cov_in_geo)))]
        if np.isfinite(camera).all():
            rows.append(saved.PlaceRow("triangulated", camera, None if cov is None else np.sqrt(np.diag(cov))))
        title = saved.paragraph(f"{point.name}: {len(rays.point)} marks; below, on the rendered surface")
        return title + saved.place_table(self._model.target, rows)

    def _described(self, note: str) -> str:
        """Return the present measurement as HTML."""
        if not self.points:
            return note + self._hint()
        rows = [
            saved.PlaceRow(str(number), point.position_in_geo, self._model.place(point)[1])
            for number, point in enumerate(self.points, start=1)
        ]
        views = ", ".join(str(len(point.cameras)) for point in self.points)
        reason = self._model.without_sigma
        return (
            note
            + saved.place_table(self._model.target, rows, marked="measured")
            + saved.paragraph(f"photographs that agree: {views}")
            + saved.quantity_table(self._quantities)
            + (saved.paragraph(f"No σ is stated: {reason}.") if reason else "")
        )

    def _hint(self) -> str:
        crs = self._model.target.crs
        lines = [
            "Click in the scene, or on the sign of a surveyed point.",
            f"Coordinates: {crs.name}; heights: {crs.vertical.name}.",
            *(f"Assumed: {text}." for text in self._model.target.assumed),
        ]
        return "".join(map(saved.paragraph, lines))

    def take_back(self) -> None:
        """Take the last point of the measurement back."""
        with self._lock:
            self._replace("removal of a point", self._kind, self.points[:-1])

    def clear(self) -> None:
        """Begin a new measurement."""
        with self._lock:
            self._replace("clearing", self._kind, ())

    def undo(self) -> None:
        """Undo the last step: a point, its removal, clearing, saving, deleting; a GeorefError: it was not."""
        with self._lock:
            step = self._history.undo()
            self._result.content = self._described(
                saved.paragraph(f"Undone: {step}." if step else "Nothing to undo.")
            )

    def save(self) -> None:
        """Save the present measurement under its name; a GeorefError: it was not saved, and why."""
        with self._lock:
            kind, points = self._kind, self.points
            if len(points) < _LEAST[kind]:
                self._tell(f"A {kind} needs {_LEAST[kind]} points before it can be saved.")
                return
            measurement = saved.NamedMeasurement(
                id=self._id,
                name=self._name.value.strip()[:200] or f"{kind} {len(self.saved.all) + 1}",
                kind=kind,
                crs=self._model.target.crs.name,
                model=self._hash,
                points=tuple(self._saved_point(point) for point in points),
                quantities=self._quantities,
            )
            self.saved.put(measurement)
            self._history.add(f"saving of {measurement.name}", lambda: self._unsave(measurement, points))
            self._id = saved.new_id()
            self._name.value = ""  # type: ignore[misc]
            self._show(kind, ())
            self._show_saved()

    def _unsave(self, measurement: saved.NamedMeasurement, points: tuple[SurfacePoint, ...]) -> None:
        self.saved.remove(measurement)
        self._show_saved()
        self._show(measurement.kind, points)

    def _saved_point(self, point: SurfacePoint) -> saved.SavedPoint:
        xyz, sigma_m = self._model.place(point)
        lla = lla_from_enu(point.position_in_geo[None], self._model.trained.survey.origin)[0]
        rows = [tuple(map(float, row)) for row in point.cov_of_surface]
        return saved.SavedPoint.model_validate(
            {
                "position_in_geo": point.position_in_geo.tolist(),
                "cov_of_surface": rows,
                "images": [self._names[camera] for camera in point.cameras],
                "xyz": xyz.tolist(),
                "sigma_m": None if sigma_m is None else sigma_m.tolist(),
                "lla": lla.tolist(),
            }
        )

    def _delete(self) -> None:
        with self._lock:
            titles = [_title(number, each) for number, each in enumerate(self.saved.all)]
            if self._chosen.value not in titles:
                return
            row = titles.index(self._chosen.value)
            measurement = self.saved.all[row]
            self.saved.remove(measurement)
            self._history.add(f"deletion of {measurement.name}", lambda: self._put_back(measurement, row))
            self._show_saved()

    def _put_back(self, measurement: saved.NamedMeasurement, row: int) -> None:
        self.saved.put(measurement, row)
        self._show_saved()

    def _show_saved(self) -> None:
        for number in range(self._drawn):
            self._overlays.show_measured(f"saved{number}", np.zeros((0, 3)))
        rows = []
        for number, measurement in enumerate(self.saved.all):
            places = np.array([point.position_in_geo for point in measurement.points])
            self._overlays.show_measured(f"saved{number}", places, closed=measurement.kind in _CLOSED)
            values = "; ".join(saved.quantity_text(each) for each in measurement.quantities[:3])
            older = "" if measurement.model == self._hash else " (measured in an earlier model)"
            rows.append((measurement.name, measurement.name + older, values))
        self._drawn = len(rows)
        self._list.content = saved.saved_table(rows)
        self._chosen.options = tuple(_title(number, each) for number, each in enumerate(self.saved.all)) or ("—",)


def _title(number: int, measurement: saved.NamedMeasurement) -> str:
    return f"{number + 1}: {measurement.name}"
