"""The page around the tiles: coordinates, scale bar, north arrow, labels, links and messages."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.typing import ArrayLike

from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef
from tests.browser import hill
from tests.browser.chromium import Viewer

pytestmark = pytest.mark.browser

# East is up in this view, and south is right.
STRAIGHT_DOWN = hill.around(90.0, -90.0, 60.0, np.array([3.0, -2.0, 2.0]))
LEVEL_M = round(float(STRAIGHT_DOWN.lla[2]) - 55.0, 1)
BELOW_M = float(STRAIGHT_DOWN.lla[2]) - LEVEL_M
# Of all labels: text, and pixel of the place.
LABELS = """async () => {
    const { scene } = (await georef).widget;
    const found = [];
    for (let i = 0; i < scene.primitives.length; i += 1) {
        const labels = scene.primitives.get(i);
        if (!(labels instanceof Cesium.LabelCollection)) continue;
        for (let k = 0; k < labels.length; k += 1) {
            const { x, y } = Cesium.SceneTransforms.worldToWindowCoordinates(scene, labels.get(k).position);
            found.push({ text: labels.get(k).text, x, y });
        }
    }
    return found;
}"""


def assert_place(shown: list[float], lla: ArrayLike) -> None:
    """Compare what the page shows, longitude first and CRS behind it, with a place on Earth."""
    lat, lon, height = np.asarray(lla).tolist()
    expected = [lon, lat, height, *parse_crs(hill.SWISS).xyz_from_lla(lla)[0]]
    # The last digits that are shown: 1e-7° is 1 cm.
    assert (np.abs(np.subtract(shown, expected)) < [1e-7, 1e-7, 0.01, 0.002, 0.002, 0.002]).all()


def numbers(text: str | None) -> list[float]:
    return [float(found) for found in re.findall(r"-?\d+(?:\.\d+)?", text or "")]


@pytest.fixture
def from_above(viewer: Viewer) -> Viewer:
    """The page with a camera that looks straight down."""
    viewer.stand(STRAIGHT_DOWN.ecef_from_cam(), hill.CAMERA)
    viewer.page.fill("#level", str(LEVEL_M))
    viewer.settle()
    return viewer


def test_names_are_shown_as_text(viewer: Viewer) -> None:
    page = viewer.page
    assert page.title() == page.locator("#title").text_content() == hill.HOSTILE
    assert page.locator("img[src='x']").count() == 0
    assert [label["text"] for label in page.evaluate(LABELS)] == ["GCP 1", hill.HOSTILE, "CP 1", "CP 2"]
    assert "Control points: 2" in page.locator("#kinds").inner_text()
    assert hill.SWISS in page.locator("#facts").inner_text()


def test_labels_stand_at_the_surveyed_places(viewer: Viewer) -> None:
    view = hill.around(30.0, -40.0, 45.0, np.array([0.0, 0.0, 3.0]))
    viewer.stand(view.ecef_from_cam(), hill.CAMERA)
    shown = [[label["x"], label["y"]] for label in viewer.page.evaluate(LABELS)]
    # Both project in doubles: nothing but rounding at a distance of 6 000 km from the Earth's centre.
    np.testing.assert_allclose(shown, view.pixels(hill.marks_ecef()), rtol=0, atol=0.01)


def test_coordinates_of_the_camera(from_above: Viewer) -> None:
    assert_place(numbers(from_above.page.locator("#camera").text_content()), STRAIGHT_DOWN.lla)


def test_coordinates_of_the_cursor_are_those_of_its_ray_at_the_level(from_above: Viewer) -> None:
    right_px, down_px = 40, -30
    # The page's panels cover a view of this size: the pointer's event goes to the canvas itself.
    from_above.page.evaluate(
        """async ([x, y]) => {
            const { canvas } = (await georef).widget;
            canvas.dispatchEvent(new PointerEvent("pointermove", { clientX: x, clientY: y }));
        }""",
        [hill.CAMERA.cx + right_px, hill.CAMERA.cy + down_px],
    )
    from_above.settle()
    metre_per_px = BELOW_M / hill.CAMERA.fx
    enu = np.array([-down_px * metre_per_px, -right_px * metre_per_px, -BELOW_M])
    axes = ecef_from_enu_rotation(STRAIGHT_DOWN.lla)
    place = lla_from_ecef(ecef_from_lla(STRAIGHT_DOWN.lla) + axes @ enu)
    assert_place(numbers(from_above.page.locator("#cursor").text_content()), place)


def test_scale_bar_and_north_arrow(from_above: Viewer) -> None:
    page = from_above.page
    (metres,) = numbers(page.locator("#length").text_content())
    width_px = page.locator("#bar").evaluate("bar => parseFloat(bar.style.width)")
    assert metres / width_px == pytest.approx(BELOW_M / hill.CAMERA.fx, rel=1e-4)
    assert 50 < width_px <= 150
    assert numbers(page.locator("#arrow").get_attribute("transform")) == pytest.approx([-90.0], abs=0.01)
    page.locator("#north").evaluate("button => button.click()")
    from_above.settle()
    turned = numbers(page.locator("#arrow").get_attribute("transform"))[0]
    assert (turned + 180.0) % 360.0 == pytest.approx(180.0, abs=0.01)


def test_mouse_moves_the_view_over_the_scene(viewer: Viewer) -> None:
    """Without a globe, CesiumJS turns on the ellipsoid, which may lie kilometres below: here it is at the scene."""
    page = viewer.page
    page.set_viewport_size({"width": 1000, "height": 700})
    page.locator("#home").click()
    viewer.settle()
    place = "georef.then(({ widget: { camera } }) => { const { x, y, z } = camera.positionWC; return [x, y, z]; })"
    scene = hill.ECEF_FROM_SCENE.translation
    home = np.array(page.evaluate(place))
    page.mouse.move(500, 350)
    page.mouse.wheel(0, -300)
    viewer.settle()
    near = np.array(page.evaluate(place))
    assert 1.0 < np.linalg.norm(near - scene) < 0.9 * np.linalg.norm(home - scene)
    page.mouse.down(button="middle")
    page.mouse.move(500, 300, steps=4)
    page.mouse.up(button="middle")
    viewer.settle()
    tilted = np.array(page.evaluate(place))
    # A tilt keeps the distance to what is in the middle of the view.
    assert np.linalg.norm(tilted - near) > 1.0
    assert np.linalg.norm(tilted - scene) == pytest.approx(np.linalg.norm(near - scene), rel=0.1)
