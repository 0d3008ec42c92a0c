"""The viewer in Chromium: its picture, clicks against `evaluate`, saved points and marks; nothing but loopback."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import viser
from playwright.sync_api import Browser, Page, Route

from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, REPORT
from pipelines.core.workspace import Workspace
from pipelines.formats.ground_points import read_ground_points
from pipelines.survey.report import read_report
from pipelines.survey.survey import SurveyedPoint
from pipelines.view.loopback import start_server
from pipelines.view.marking import CHECK
from pipelines.view.options import ViewOptions
from pipelines.view.pictures import ViewerCamera, camera_of
from pipelines.view.saved import FOLDER, read_measurements
from pipelines.view.viewer import Viewer
from tests.faults.injection import filled, mounted
from tests.splat_scenes import make_rendered
from tests.view_scenes import smooth, viewed_workspace

pytestmark = pytest.mark.browser

SIZE = {"width": 1000, "height": 640}
PATIENCE_S = 60.0


@dataclass
class Opened:
    """A viewer, its server, and a page of it; `outside` are addresses beyond this machine that were asked for."""

    viewer: Viewer
    server: viser.ViserServer
    page: Page
    outside: list[str]

    @property
    def camera(self) -> ViewerCamera:
        """Camera of the page."""
        camera = camera_of(next(iter(self.server.get_clients().values())))
        assert camera is not None
        return camera

    @property
    def shown(self) -> tuple[int, int]:
        """Width and height of the picture on the page: viser draws it coarser while the machine is busy."""
        camera = self.camera
        return round(camera.width * SIZE["height"] / camera.height), SIZE["height"]

    def pixel(self, point_in_geo: np.ndarray) -> tuple[float, float]:
        """Return where a point is on the page."""
        camera, (width, height) = self.camera, self.shown
        pinhole = camera.pinhole(width, height)
        x, y, z = camera.rotation.T @ (self.viewer.overlays.place(point_in_geo) - camera.position)
        return pinhole.fx * x / z + pinhole.cx, pinhole.fy * y / z + pinhole.cy

    def tab(self, name: str) -> None:
        """Open a tab of the panel."""
        self.page.get_by_role("tab", name=name).click()

    def click(self, point_in_geo: np.ndarray) -> None:
        """Click on a point."""
        self.page.mouse.click(*self.pixel(point_in_geo))

    def press(self, label: str) -> None:
        """Press the visible button."""
        self.page.locator("button:visible").get_by_text(label, exact=True).click()

    def failures(self) -> list[str]:
        """Return what the page says that failed."""
        return self.page.locator("[data-failed]").all_text_contents()

    def measure(self, point_in_geo: np.ndarray) -> None:
        """Measure a point with a click."""
        self.viewer.click_mode.value = "measures"
        self.viewer.measuring.choose("point")
        self.tab("Measure")
        wait(lambda: self.page.locator("[data-measured]").count() == 0)
        self.click(point_in_geo)
        wait(lambda: self.page.locator("[data-measured]").count() == 1)

    def come_to_mark(self, point: SurveyedPoint) -> str:
        """Look closely at a point in the next photograph that shows it; return the photograph's name."""
        self.viewer.click_mode.value = "marks in the photograph"
        self.tab("Mark")
        self.viewer.marking.choose(point.name)
        self.press("Next photograph (N)")
        wait(lambda: self.viewer.photo.camera is not None)
        client = next(iter(self.server.get_clients().values()))
        wait(lambda: self.viewer.photo.is_at(client))
        time.sleep(1.5)
        self.click(np.array(point.position_in_geo))  # comes closer
        wait(lambda: self.camera.fov_rad < 0.3)
        time.sleep(1.5)
        return self.viewer.marking.names[self.viewer.photo.camera]

    def marks(self) -> dict[str, tuple[float, float]]:
        """Return the marks of the chosen point."""
        assert self.viewer.marking.point is not None
        return dict(self.viewer.marking.point.marks)

    def close(self) -> None:
        """Close the page and end the viewer."""
        self.page.close()
        self.viewer.close()
        self.server.stop()

    def measured(self) -> np.ndarray:
        """Return the last measured point (3,) in `geo`, as the page shows it."""
        rows = self.page.locator("[data-measured]")
        assert rows.count()
        return np.array([float(text) for text in str(rows.last.get_attribute("data-measured")).split(",")])


def wait(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end, "the page does not get there"
        time.sleep(0.05)


def opened(workspace: Workspace, browser: Browser) -> Opened:
    server, address = start_server(8700, "hill")
    viewer = Viewer(server, workspace, ViewOptions())
    page, outside = browser.new_page(viewport=SIZE), []

    def loopback_only(route: Route) -> None:
        if route.request.url.startswith((f"http://127.0.0.1:{server.get_port()}", "data:", "blob:")):
            route.continue_()
            return
        outside.append(route.request.url)
        route.abort()

    page.route("**/*", loopback_only)
    page.goto(address)
    wait(lambda: bool(server.get_clients()) and any(loop.drawn for loop in viewer.loops.values()))
    before = 0
    while before != (
        before := sum(loop.drawn for loop in viewer.loops.values())
    ):  # the panel takes a part of the page when it is laid out
        time.sleep(1.5)
    return Opened(viewer, server, page, outside)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The hill, evaluated."""
    made = viewed_workspace(tmp_path_factory.mktemp("view") / "hill", smooth(make_rendered()))
    run_stage(made, BY_NAME["evaluate"], {"renders": 0})
    return made


@pytest.fixture(scope="module")
def hill(workspace: Workspace, browser: Browser) -> Iterator[Opened]:
    """The hill in a page."""
    view = opened(workspace, browser)
    yield view
    view.close()


def test_picture_is_the_render(hill: Opened) -> None:
    for kind in ("cameras", "points", "errors", "tie points"):
        hill.viewer.overlays.show(kind, visible=False)  # type: ignore[arg-type]
    time.sleep(2.0)
    width, height = hill.shown
    expected = hill.viewer.painter.paint(hill.camera, width, height).rgb
    png = hill.page.screenshot(clip={"x": 0, "y": 0, "width": width, "height": height})
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255.0
    for kind in ("cameras", "points", "errors"):
        hill.viewer.overlays.show(kind, visible=True)  # type: ignore[arg-type]
    # The lower half: viser's messages lie over the upper one.
    ours, theirs = expected[height // 2 :] / 255.0, shown[height // 2 :]
    exposure = float((ours * theirs).sum() / (theirs * theirs).sum())
    assert ours.std() > 0.05
    assert -10 * np.log10(np.mean((exposure * theirs - ours) ** 2)) > 25  # of a JPEG; 20 are asked for
    assert 0.9 < exposure < 1.1


def test_clicks_on_check_points_give_what_evaluate_states(hill: Opened, workspace: Workspace) -> None:
    hill.viewer.click_mode.value = "measures"
    hill.tab("Measure")
    rows = {row.name: row for row in read_report(workspace.path(REPORT)).checkpoints.surface.points}
    points = hill.viewer.model.trained.survey.check_points[:5]
    assert len(points) == 5
    for point in points:
        hill.viewer.measuring.clear()
        wait(lambda: hill.page.locator("[data-measured]").count() == 0)
        hill.click(np.array(point.position_in_geo))
        wait(lambda: hill.page.locator("[data-measured]").count() == 1)
        row = rows[point.name]
        assert row.de_m is not None and row.dn_m is not None and row.du_m is not None
        error = hill.measured() - np.array(point.position_in_geo)
        np.testing.assert_allclose(error, [row.de_m, row.dn_m, row.du_m], atol=1e-3)


def test_a_click_on_the_ground_measures_what_lies_under_it(hill: Opened) -> None:
    hill.viewer.click_mode.value = "measures"
    hill.tab("Measure")
    hill.viewer.measuring.clear()
    wait(lambda: hill.page.locator("[data-measured]").count() == 0)
    place = np.array([5.0, -6.5, 6.0 * np.exp(-(5.0**2 + 6.5**2) / 300)])
    hill.click(place)
    wait(lambda: hill.page.locator("[data-measured]").count() == 1)
    # The mouse hits a pixel, 0.07 m of the ground, and the surface is off by a part of a photograph's, 0.5 m.
    np.testing.assert_allclose(hill.measured(), place, atol=0.3)


def test_a_distance_states_its_sigma(hill: Opened) -> None:
    hill.viewer.click_mode.value = "measures"
    hill.tab("Measure")
    hill.viewer.measuring.choose("distance")
    first, second = (np.array(point.position_in_geo) for point in hill.viewer.model.trained.survey.check_points[:2])
    hill.click(first)
    wait(lambda: len(hill.viewer.measuring.points) == 1)
    hill.click(second)
    wait(lambda: hill.page.locator('[data-quantity="distance"]').count() == 1)
    row = hill.page.locator('[data-quantity="distance"]')
    value, sigma = (float(str(row.get_attribute(name))) for name in ("data-value", "data-sigma"))
    assert value == pytest.approx(float(np.linalg.norm(second - first)), abs=0.3)
    assert 0 < sigma < 0.3
    hill.viewer.measuring.choose("point")


def test_two_viewers_save_beside_each_other(hill: Opened, workspace: Workspace, browser: Browser) -> None:
    points = hill.viewer.model.trained.survey.check_points
    hill.measure(np.array(points[2].position_in_geo))
    place = hill.measured()
    name = '<script>document.title = "run"</script> corner'
    hill.page.locator("input:visible:not([aria-haspopup])").last.fill(name)
    hill.press("Save")
    wait(lambda: hill.page.locator("[data-saved]").count() == 1)
    again = opened(workspace, browser)
    try:
        again.tab("Measure")
        wait(lambda: again.page.locator("[data-saved]").count() == 1)
        assert name in str(again.page.locator("[data-saved]").text_content())
        assert again.page.title() != "run"
        saved = again.viewer.measuring.saved.all[0]
        np.testing.assert_allclose(saved.points[0].position_in_geo, place, atol=1e-6)
        assert saved.points[0].sigma_m is not None
        for view, count in ((again, 2), (hill, 3)):
            view.measure(np.array(points[count].position_in_geo))
            view.press("Save")
            wait(lambda: view.page.locator("[data-saved]").count() == count)  # noqa: B023
        assert len(read_measurements(workspace.root / FOLDER)) == 3
        again.press("Undo")  # of its saving, and of nobody else's
        wait(lambda: again.page.locator("[data-saved]").count() == 2)
        again.press("Save")
        wait(lambda: again.page.locator("[data-saved]").count() == 3)
        again.press("Delete the saved one")
        wait(lambda: again.page.locator("[data-saved]").count() == 2)
        again.press("Undo")
        wait(lambda: again.page.locator("[data-saved]").count() == 3)
        assert len(read_measurements(workspace.root / FOLDER)) == 3
    finally:
        again.close()


def test_marks_are_set_in_photographs(hill: Opened, workspace: Workspace, browser: Browser) -> None:
    point, other = hill.viewer.model.trained.survey.check_points[3:5]
    image, place = hill.come_to_mark(point), np.array(point.position_in_geo)
    before = hill.marks()[image]  # of the survey
    hill.click(place)
    wait(lambda: hill.marks()[image] != before)
    mark = hill.marks()[image]
    # From close by, a pixel of the page is a seventh of the photograph's.
    assert mark == pytest.approx(before, abs=0.5)
    hill.press("Remove the mark here")
    wait(lambda: image not in hill.marks())
    hill.press("Undo")
    wait(lambda: hill.marks().get(image) == mark)
    again = opened(workspace, browser)  # before anything is written
    try:
        again.tab("Mark")
        again.viewer.marking.choose(point.name)
        wait(lambda: again.page.get_by_text("not written yet").count() == 1)
        assert again.marks()[image] == pytest.approx(mark, abs=1e-9)
        second = again.come_to_mark(other)
        of_survey = again.marks()[second]
        again.click(np.array(other.position_in_geo))
        wait(lambda: again.marks()[second] != of_survey)
        set_by_it = again.marks()[second]
        for view in (again, hill):
            (workspace.root / FOLDER / CHECK).unlink(missing_ok=True)
            view.press("Write gcp_list.txt")
            wait((workspace.root / FOLDER / CHECK).exists)
            listed = read_ground_points(workspace.root / FOLDER / CHECK).marks
            written = {(each.name, each.image): (each.x_px, each.y_px) for each in listed}
            assert written[point.name, image] == pytest.approx(mark, abs=1e-3)
            assert written[other.name, second] == pytest.approx(set_by_it, abs=1e-3)
    finally:
        again.close()
    hill.viewer.photo.leave()
    hill.viewer.click_mode.value = "looks"


def test_a_full_disk_is_told_and_nothing_is_stored_twice(
    workspace: Workspace, browser: Browser, tmp_path: Path
) -> None:
    shutil.copytree(workspace.root, tmp_path / "ws", ignore=shutil.ignore_patterns(FOLDER))
    folder = tmp_path / "ws" / FOLDER
    with mounted(folder, "200k"):
        view = opened(Workspace(tmp_path / "ws"), browser)
        try:
            point = view.viewer.model.trained.survey.check_points[1]
            view.measure(np.array(point.position_in_geo))
            with filled(folder):
                refused(view, folder, lambda: view.press("Save"))
                assert view.page.locator("[data-measured]").count() == 1
                assert read_measurements(folder) == []
            view.press("Save")
            wait(lambda: view.page.locator("[data-saved]").count() == 1)
            assert (view.failures(), len(read_measurements(folder))) == ([], 1)
            image = view.come_to_mark(point)
            before, place = view.marks()[image], np.array(point.position_in_geo) + np.array([0.5, 0.0, 0.0])
            with filled(folder):
                refused(view, folder, lambda: view.click(place))
                assert view.marks()[image] == before
            view.click(place)
            wait(lambda: view.marks()[image] != before)
            wait(lambda: view.failures() == [])
            with filled(folder):
                refused(view, folder, lambda: view.press("Write gcp_list.txt"))
                assert not (folder / CHECK).exists()
            view.press("Write gcp_list.txt")
            wait((folder / CHECK).exists)
            wait(lambda: view.failures() == [])
        finally:
            view.close()


def refused(view: Opened, folder: Path, act: Callable[[], None]) -> None:
    """Do what the full disk refuses: the page says so, and nothing half-written is left."""
    act()
    wait(lambda: view.failures() != [])
    assert "the disk is full" in view.failures()[0]
    assert view.page.locator("[data-failed]").is_visible()
    assert not list(folder.glob("*.tmp"))


def test_no_request_leaves_this_machine(hill: Opened) -> None:
    assert hill.outside == []
