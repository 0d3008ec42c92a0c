"""The whole way of a surveyor through the viewer of a simulated town, by mouse and keys.

    python -m tests.browser.test_whole_way WORKSPACE FOLDER

writes a picture of each step, of any workspace with a terrain model, contour lines and check points.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyogrio
import pytest
from playwright.sync_api import Browser, expect

from pipelines.core.stages import REPORT
from pipelines.core.workspace import Workspace
from pipelines.survey.report import read_report
from pipelines.view.options import ViewOptions
from pipelines.view.saved import FOLDER
from pipelines.view.server import served
from tests.browser.chromium import chromium
from tests.browser.viewer_page import PATIENCE_MS, Opened, opened, wait
from tests.killed import georef

pytestmark = pytest.mark.browser

_SIDE_PX = 90  # half a side of the outlines on the page, from above


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A town from twelve small photographs, with rasters of its surface and terrain and contour lines."""
    folder = tmp_path_factory.mktemp("town")
    survey, workspace = folder / "survey", Workspace(folder / "ws")
    flight = ("--flight", "grid", "--height", 60, "--radius", 16, "--images", 12, "--size", "320x240")
    georef("simulate", survey, *flight, "--samples", 1, "--sigma-survey", "0.01")
    georef(
        *("run", workspace.root, "--images", survey / "images", "--trajectory", survey / "trajectory.csv"),
        *("--gcp", survey / "gcp_list.txt", "--checkpoints", survey / "checkpoints.txt", "--preset", "smoke"),
    )
    georef("export-raster", workspace.root, "--contours", "1")
    return workspace


@pytest.fixture
def page(town: Workspace, browser: Browser) -> Iterator[Opened]:
    with served(town, ViewOptions(port=8770)) as server:
        view = opened(server, browser)
        yield view
        view.page.close()
    assert (view.outside, view.problems) == ([], [])


def test_a_surveyor_works_through_the_page(page: Opened, town: Workspace, tmp_path: Path) -> None:
    taken: list[str] = []
    whole_way(page, town, taken.append, tmp_path)
    assert len(taken) == 10


def whole_way(view: Opened, workspace: Workspace, shot: Callable[[str], object], folder: Path) -> None:
    """See, measure, save and mark as a surveyor does; `shot` is told where a step stands on the page."""
    page, viewer = view.page, view.server.viewer
    for overlay in ("contours", "boundary"):
        page.locator(f"#overlays input[value='{overlay}']").check()
    shot("1 the whole scene, with cameras, points, boundary and contour lines")
    page.select_option("#colouring", "height")
    page.keyboard.press("t")
    view.settle()
    expect(page.locator("#legend")).to_contain_text(" m")
    shot("2 heights from above")
    page.select_option("#colouring", "photographs")
    _ends_on_a_sign(view, workspace)
    shot("3 a polyline that ends on a check point's sign")
    corners = _around_the_middle(view)
    for kind in ("profile", "area"):
        view.begin(kind)
        for x, y in corners[:2] if kind == "profile" else corners:
            page.mouse.click(x, y)
        view.press("Finish (Enter)")
        view.done()
        shot(f"{3 + (kind == 'area') + 1} {kind}")
        view.save(f"its {kind}")
    _volumes_above_rasters(view, corners)
    shot("6 volume above the terrain model")
    view.save("its volume")
    expect(view.saved).to_have_count(3)
    with page.expect_download() as download:
        page.get_by_role("link", name="measurements.gpkg").click()
    download.value.save_as(folder / "measurements.gpkg")
    layers = [name for name, _ in pyogrio.list_layers(folder / "measurements.gpkg")]
    assert sum(pyogrio.read_info(folder / "measurements.gpkg", layer=name)["features"] for name in layers) == 3
    view.tab("See")
    page.get_by_label("Photographs that see what I click").check()
    view.click(viewer.frame.middle_in_geo)
    wait(lambda: page.locator("[data-seen]").count() >= 3)
    shot("7 photographs that see a place")
    view.press("Around the middle of the view")
    view.settle()
    shot("8 clipping box")
    view.come_close(viewer.survey.check_points[0].name)
    assert page.locator("[data-mark]").count() >= 2 and page.locator("#neighbours canvas").count() >= 2
    shot("9 a mark beside its neighbours")
    view.tab("See")
    page.set_viewport_size({"width": 390, "height": 760})
    page.select_option("#light", "dark")
    view.settle()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    shot("10 a narrow page in the dark")


def _ends_on_a_sign(view: Opened, workspace: Workspace) -> None:
    """A double click on the sign of a check point ends a line there, once."""
    rows = {row.name: row for row in read_report(workspace.path(REPORT)).checkpoints.surface.points}
    named = {point.name: point for point in view.server.viewer.survey.check_points}
    point, row = next(
        (point, rows[name]) for name, point in named.items() if name in rows and rows[name].de_m is not None
    )
    view.begin("polyline")
    view.click_all([np.array(view.server.viewer.frame.middle_in_geo)])
    view.page.mouse.dblclick(*view.pixel(np.array(point.position_in_geo)))
    view.done()
    assert len(view.measured()) == 2
    error = view.measured()[1] - np.array(point.position_in_geo)
    np.testing.assert_allclose(error, [row.de_m, row.dn_m, row.du_m], atol=1e-3)


def _around_the_middle(view: Opened) -> list[tuple[float, float]]:
    box = view.page.locator("#overlay").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    turns = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return [(x + _SIDE_PX * i, y + _SIDE_PX * j) for i, j in turns]


def _volumes_above_rasters(view: Opened, corners: list[tuple[float, float]]) -> None:
    """The surface stands above its own raster by nothing, and above that of the terrain by what stands there."""
    view.begin("volume")
    for base in ("dsm.tif", "dtm.tif"):
        view.page.select_option("#base-kind", base)
        if not view.measured():
            for x, y in corners:
                view.page.mouse.click(x, y)
            view.press("Finish (Enter)")
        view.done()
        volume, sigma = view.quantity("volume")
        if base == "dsm.tif":
            # Cells between the nodes of either, of which some lie on walls.
            assert abs(volume) < 3 * sigma
        else:
            assert volume > -3 * sigma


def main() -> None:
    """Write the pictures."""
    workspace, folder = Workspace(Path(sys.argv[1])), Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    with chromium() as browser, served(workspace, ViewOptions(port=8770)) as server:
        view = opened(server, browser)
        shot = lambda name: view.page.screenshot(path=folder / f"{name}.png", timeout=PATIENCE_MS)  # noqa: E731
        whole_way(view, workspace, shot, folder)
        print(f"{workspace.root / FOLDER} keeps the three measurements.")


if __name__ == "__main__":
    main()
