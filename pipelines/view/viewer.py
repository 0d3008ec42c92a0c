"""The viewer: a trained model in the browser, on loopback, with what measures in it."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.errors import GeorefError
from pipelines.core.extras import require
from pipelines.core.manifest import hash_file
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import GAUSSIANS, MODEL, REPORT
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.headline import headline_of
from pipelines.survey.report import EvaluationReport, read_report
from pipelines.survey.scene import photographs
from pipelines.survey.trained_survey import load_trained
from pipelines.view.mark_panel import MarkPanel
from pipelines.view.measure_panel import MeasurePanel
from pipelines.view.measuring import MeasuringModel
from pipelines.view.options import ViewOptions
from pipelines.view.overlays import OverlayKind, Overlays, PointColour
from pipelines.view.photo_view import PhotoView
from pipelines.view.pictures import Painter, Photographs, PictureLoop, ViewFrame, camera_of, frame_of
from pipelines.view.saved import FOLDER, paragraph

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

_WATCH_S = 2.0
_FIRST_S = 20.0  # in which a page is expected to be opened
_FOV_RAD = 0.9
ClickMode = Literal["looks", "measures", "marks in the photograph"]


class Viewer:
    """Viewer of a workspace, until the model changes.

    Attributes:
        click_mode: what a click in the scene does.
        loops: of the open pages, by the number of the page.

    Raises:
        MissingProductError: there is no trained model; names the command that makes it.
        GeorefError: a product is damaged, or the CRS cannot be used.
    """

    def __init__(
        self, server: viser.ViserServer, workspace: Workspace, options: ViewOptions, progress: Progress = SILENT
    ) -> None:
        self._server = server
        self.stamp = model_stamp(workspace)
        with progress.task("reading the model", 2) as task:
            trained = load_trained(workspace)
            task.advance()
            images = photographs(trained.sfm, trained.survey, workspace, trained.model.max_image_size)
            self._renderer = ModelRenderer(trained, images, rasterizer(options.backend, progress))
            self.model = MeasuringModel(workspace, self._renderer, options)
            task.advance()
        self.frame: ViewFrame = frame_of(trained)
        self.painter = Painter(self._renderer, Photographs(workspace, trained), self.frame)
        self.loops: dict[int, PictureLoop] = {}
        self._lock, self._first_drawn = threading.Lock(), threading.Event()
        self.overlays = Overlays(server, trained, self.frame)
        self.photo = PhotoView(server, trained, self.frame, self.overlays, self.wake)
        self._build(workspace, workspace.root / FOLDER)
        server.scene.on_click()(self._clicked)

        def prepare_clicks() -> None:
            """Sort the Gaussians after the first picture, so that neither it nor the first click waits."""
            self._first_drawn.wait(_FIRST_S)
            _ = self._renderer.blocks

        threading.Thread(target=prepare_clicks, daemon=True).start()
        server.on_client_connect(self._connected)
        server.on_client_disconnect(self._left)
        for client in server.get_clients().values():
            self._connected(client)

    def _build(self, workspace: Workspace, folder: Path) -> None:
        gui, trained = self._server.gui, self.model.trained
        self._notice = gui.add_html("")
        gui.add_html(accuracy_html(workspace))
        self.click_mode = gui.add_dropdown("A click", get_args(ClickMode), hint="What a click in the scene does")
        tabs = gui.add_tab_group()
        with tabs.add_tab("See"):
            self._build_look(workspace)
        with tabs.add_tab("Measure"):
            self.measuring = MeasurePanel(
                self._server, self.model, self.overlays, folder, hash_file(workspace.path(MODEL), {})
            )
        with tabs.add_tab("Mark"):
            self.marking = MarkPanel(self._server, self.model, self.photo, folder)
            gui.add_button("Measure with the marked point").on_click(lambda _: self._take_marked())
        survey = trained.survey
        self.overlays.add_cameras()
        self.overlays.add_surveyed(survey.control_points, "control")
        self.overlays.add_surveyed(survey.check_points, "check")
        self._colour_points()

    def _build_look(self, workspace: Workspace) -> None:
        gui = self._server.gui
        names = self.model.trained.sparse.image_name
        self._photo = gui.add_dropdown("Photograph", names, hint="Or click on a camera")
        gui.add_button("Fly there").on_click(lambda _: self.photo.show(names.index(self._photo.value)))
        share = gui.add_slider("Photograph over splat", 0.0, 1.0, 0.05, 1.0)
        gui.add_button("Leave the photograph").on_click(lambda _: self._leave())
        switches: tuple[tuple[str, OverlayKind, bool], ...] = (
            ("Cameras", "cameras", True),
            ("Control and check points", "points", True),
            ("Errors of the points", "errors", True),
            ("SfM points", "tie points", False),
        )
        for label, kind, visible in switches:
            self._add_switch(label, kind, visible)
        self._colour = gui.add_dropdown("Colour of the SfM points", get_args(PointColour))
        self._legend = gui.add_html(self._errors(workspace))
        self._colour.on_update(lambda _: self._colour_points())

        def blend() -> None:
            self.photo.share = float(share.value)
            self.wake()

        share.on_update(lambda _: blend())

    def _add_switch(self, label: str, kind: OverlayKind, visible: bool) -> None:
        box = self._server.gui.add_checkbox(label, visible)
        box.on_update(lambda _: self.overlays.show(kind, box.value))
        self.overlays.show(kind, visible)

    def _errors(self, workspace: Workspace) -> str:
        """Draw the errors of control and check points, and return a sentence about the arrows."""
        try:
            report = read_report(workspace.path(REPORT))
        except GeorefError:
            return paragraph("No errors are shown: `georef evaluate` measures them.")
        errors = _point_errors(self.model, report)
        if not errors:
            return paragraph("No control or check point has an error to show.")
        enlarged = self.overlays.add_errors(errors)
        return paragraph(f"Arrows: triangulated error, × {enlarged:g}. Orange: control points and test views.")

    def _colour_points(self) -> None:
        grid: AccuracyGrid | None = None
        if self._colour.value != "of the photographs" and self.model.posterior is not None:
            grid = self.model.posterior.grid
        limits = self.overlays.add_points(self._colour.value, grid)
        if limits is not None:
            low, high = limits
            self._legend.content = paragraph(
                f"predicted σ of the SfM points: dark {low:.3f} m, bright {high:.3f} m"
            )

    def _leave(self) -> None:
        self.photo.leave()
        for client in self._server.get_clients().values():
            self._stand_above(client)

    def _take_marked(self) -> None:
        point = self.marking.measured()
        if point is not None:
            self.measuring.add_point(point)

    def wake(self) -> None:
        """Draw the pictures of all pages anew."""
        for loop in tuple(self.loops.values()):
            loop.changed.set()

    def _connected(self, client: viser.ClientHandle) -> None:
        with self._lock:
            if client.client_id in self.loops:
                return
            self._stand_above(client)
            self.loops[client.client_id] = PictureLoop(
                client, self.painter, lambda: self.photo.blend, self._first_drawn.set
            )

    def _left(self, client: viser.ClientHandle) -> None:
        with self._lock:
            loop = self.loops.pop(client.client_id, None)
        if loop is not None:
            loop.end()

    def _stand_above(self, client: viser.ClientHandle) -> None:
        """Put a page's camera in the south of the scene, looking down on it."""
        with client.atomic():
            client.camera.fov = _FOV_RAD
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position = (0.0, -14.0, 12.0)
            client.camera.look_at = (0.0, 0.0, 0.0)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        camera = camera_of(event.client)
        if camera is None:
            return
        start, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        direction /= np.linalg.norm(direction)
        if self.click_mode.value == "marks in the photograph":
            self._mark(event.client, direction)
            return
        sight = self.frame.sight(camera, start, direction)
        hit = self.overlays.hit(start, direction, sight.pixel_rad)
        if isinstance(hit, int) and self.click_mode.value == "looks":
            self._photo.value = self.model.trained.sparse.image_name[hit]  # type: ignore[misc]
            self.photo.show(hit)
        elif isinstance(hit, str):
            self.measuring.add_surveyed(hit)
        elif self.click_mode.value == "measures":
            self.measuring.add_sight(sight)

    def _mark(self, client: viser.ClientHandle, direction: np.ndarray) -> None:
        """Come closer at the first click in a photograph, and mark at the second."""
        if self.photo.camera is None or not self.photo.is_at(client):
            self.marking.turn(0 if self.photo.camera is not None else 1)
        elif not self.photo.come_closer(client, direction):
            self.marking.add(self.photo.camera, self.photo.in_cam(direction))

    def tell_change(self, read_again: Callable[[], None]) -> None:
        """Tell all pages that the model has changed, and offer to read it again."""
        sentence = "The model has changed since it was read: measurements are those of the old one."
        self._notice.content = paragraph(sentence, mark="notice")
        self._server.gui.add_button("Read the model again").on_click(lambda _: read_again())

    def close(self) -> None:
        """End the pictures, and empty the pages."""
        for loop in tuple(self.loops.values()):
            loop.end()
        self._server.scene.remove_click_callback("all")
        self._server.scene.reset()
        self._server.gui.reset()


def accuracy_html(workspace: Workspace) -> str:
    """Return the accuracy of the result as HTML; empty where nothing states it."""
    headline = headline_of(workspace)
    return "" if headline is None else paragraph(f"The {headline.sentence}.", mark="accuracy")


def _point_errors(model: MeasuringModel, report: EvaluationReport) -> list[tuple[FloatArray, FloatArray]]:
    """Return the surveyed and the triangulated place (3,) in `geo` of control and check points."""
    survey = model.trained.survey
    place = {p.name: np.array(p.position_in_geo) for p in (*survey.control_points, *survey.check_points)}
    rows = [*report.checkpoints.triangulated.points, *report.fit.gcp.points]
    return [
        (place[row.name], place[row.name] + np.array([row.de_m, row.dn_m, row.du_m]))
        for row in rows
        if row.name in place and row.de_m is not None and row.dn_m is not None and row.du_m is not None
    ]


def model_stamp(workspace: Workspace) -> tuple[int, ...]:
    """Return what changes when the model is trained again; a MissingProductError: there is no trained model."""
    return tuple(workspace.path(product).stat().st_mtime_ns for product in (MODEL, GAUSSIANS))


def serve(
    workspace: Workspace,
    options: ViewOptions,
    ready: Callable[[str], None],
    ended: threading.Event,
    progress: Progress = SILENT,
) -> None:
    """Serve the viewer of a workspace until `ended` is set.

    `ready` is called with the address, its key included, when the pages can be opened.

    Raises:
        BackendUnavailableError: viser is not installed.
        MissingProductError: there is no trained model; names the command that makes it.
        GeorefError: a product is damaged, no port is free, or the CRS cannot be used.
    """
    require("viewer")
    from pipelines.view.loopback import start_server, stop_server

    model_stamp(workspace)
    server, address = start_server(options.port, f"georef view {workspace.root.name}", dark=options.dark)
    try:
        viewer = Viewer(server, workspace, options, progress)
        ready(address)
        again = threading.Event()
        told = False
        while not ended.wait(_WATCH_S):
            if again.is_set():
                again.clear()
                viewer.close()
                viewer, told = Viewer(server, workspace, options, progress), False
            changed = False
            with contextlib.suppress(GeorefError, OSError):  # between the old model and the new one
                changed = model_stamp(workspace) != viewer.stamp
            if changed and not told:
                told = True
                text = "The model was trained again. The page shows the old one until it is loaded anew there."
                log.warning(text, extra={"code": "model-changed"})
                viewer.tell_change(again.set)
    finally:
        stop_server(server)
