"""The viewer in Chromium, worked in by mouse and keys: what is seen, measured, saved, marked; and nothing else."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import cv2
import ezdxf
import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, REPORT
from pipelines.core.workspace import Workspace
from pipelines.formats.ground_points import read_ground_points
from pipelines.survey.report import read_report
from pipelines.survey.saved_measurements import read_measurements
from pipelines.view.marking import CHECK
from pipelines.view.options import ViewOptions
from pipelines.view.pictures import Wanted
from pipelines.view.saved import FOLDER
from pipelines.view.server import ViewerServer, served
from tests.browser.viewer_page import PATIENCE_MS, Opened, opened, wait
from tests.faults.injection import filled, mounted
from tests.splat_scenes import ground_height, make_rendered
from tests.view_scenes import smooth, viewed_workspace

pytestmark = pytest.mark.browser

PIXEL_M = 0.5  # of a photograph on the ground


def on_ground(east: float, north: float) -> np.ndarray:
    return np.array([east, north, float(ground_height(np.array(east), np.array(north)))])


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The hill, evaluated."""
    made = viewed_workspace(tmp_path_factory.mktemp("view") / "hill", smooth(make_rendered()))
    run_stage(made, BY_NAME["evaluate"], {"renders": 0})
    return made


@pytest.fixture(scope="module")
def server(workspace: Workspace) -> Iterator[ViewerServer]:
    with served(workspace, ViewOptions(port=8700)) as started:
        yield started


@pytest.fixture
def hill(server: ViewerServer, browser: Browser) -> Iterator[Opened]:
    """The hill in a page of its own."""
    view = opened(server, browser)
    yield view
    view.page.close()
    assert (view.outside, view.problems) == ([], [])


def test_picture_is_the_render_and_the_mouse_moves_it(hill: Opened) -> None:
    for name in ("cameras", "points", "errors"):
        hill.page.locator(f"#overlays input[value='{name}']").uncheck()
    before = hill.camera()
    hill.page.mouse.move(400, 400)
    hill.page.mouse.wheel(0, -300)
    hill.page.mouse.down()
    hill.page.mouse.move(480, 430, steps=4)
    hill.page.mouse.up()
    hill.settle()
    camera = hill.camera()
    assert np.linalg.norm(np.subtract(camera.position, before.position)) > 1
    background = (0xDF / 255, 0xE5 / 255, 0xEA / 255)  # of the page in the light
    ours = hill.server.viewer._painter.paint(camera.camera(), Wanted(background=background)).rgb / 255.0
    png = hill.page.locator("#picture").screenshot()
    shown = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255.0
    ours, shown = (picture[60:-60, 60:-120] for picture in (ours, shown))  # cursor, scale and north lie outside
    assert ours.std() > 0.05
    assert -10 * np.log10(np.mean((shown - ours) ** 2)) > 28  # of a JPEG


def test_clicks_on_signs_give_what_evaluate_states(hill: Opened, workspace: Workspace) -> None:
    rows = {row.name: row for row in read_report(workspace.path(REPORT)).checkpoints.surface.points}
    hill.begin("point")
    for point in hill.server.viewer.survey.check_points[:4]:
        hill.click(np.array(point.position_in_geo))
        row = rows[point.name]
        wait(lambda: hill.page.locator("#results").get_by_text(point.name).count() == 1)  # noqa: B023
        assert row.de_m is not None and row.dn_m is not None and row.du_m is not None
        error = hill.measured()[0] - np.array(point.position_in_geo)
        np.testing.assert_allclose(error, [row.de_m, row.dn_m, row.du_m], atol=1e-3)


def test_a_volume_from_its_corners_to_its_file_and_back(hill: Opened, workspace: Workspace) -> None:
    hill.begin("volume")
    corners = [on_ground(*place) for place in ((-9, -9), (9, -9), (9, 9), (-9, 9), (-12, 0))]
    hill.click_all(corners)
    hill.page.keyboard.press("Control+z")
    wait(lambda: len(hill.measured()) == 4)
    hill.page.keyboard.press("Enter")
    hill.click(on_ground(0.0, 0.0))  # not blocked by the measurement: it begins the next one
    wait(lambda: len(hill.measured()) == 1)
    hill.page.keyboard.press("Control+z")
    hill.done()
    volume, sigma = hill.quantity("volume")
    axis = np.linspace(-9, 9, 181)
    east, north = np.meshgrid(axis, axis)
    truth = float((ground_height(east, north) - ground_height(np.array(9.0), np.array(9.0))).mean()) * 324
    # A click hits a pixel of the page, 0.1 m of the ground.
    assert abs(volume - truth) < 3 * sigma + 0.03 * truth
    name = '<script>document.title = "run"</script> heap'
    hill.save(name)
    expect(hill.saved).to_have_count(1)
    assert (hill.page.title(), name in str(hill.saved.text_content())) == ("hill", True)
    hill.press("Show")
    hill.press("Delete")
    expect(hill.saved).to_have_count(0)
    hill.press("Undo (Ctrl-Z)")
    expect(hill.saved).to_have_count(1)
    (kept,) = read_measurements(workspace.root / FOLDER)
    assert (kept.name, len(kept.points), kept.quantities[2].value) == (name, 4, pytest.approx(volume))
    with hill.page.expect_download() as download:
        hill.page.get_by_role("link", name="volumes.csv").click()
    assert "POLYGON Z" in download.value.path().read_text("utf-8")
    hill.press("Delete")
    expect(hill.saved).to_have_count(0)


def test_a_profile_as_picture_table_and_drawing(hill: Opened, tmp_path: Path) -> None:
    hill.begin("profile")
    hill.click_all([on_ground(-12, 0)])
    hill.page.mouse.dblclick(*hill.pixel(on_ground(12, 0)))
    hill.done()
    assert hill.page.locator("#profile .band").count() >= 1
    with hill.page.expect_download() as download:
        hill.page.get_by_role("button", name="CSV").click()
    lines = download.value.path().read_text("utf-8").splitlines()[1:]
    along, _, _, height, _ = np.array([[float(v) for v in line.split(",")] for line in lines]).T
    assert along[-1] == pytest.approx(24.0, abs=0.5)
    truth = ground_height(along - 12, np.zeros_like(along))
    np.testing.assert_allclose(height - np.median(height - truth), truth, atol=0.5 * PIXEL_M)
    with hill.page.expect_download() as download:
        hill.page.get_by_role("button", name="DXF").click()
    download.value.save_as(tmp_path / "profile.dxf")
    layers = {line.dxf.layer for line in ezdxf.readfile(tmp_path / "profile.dxf").modelspace()}
    assert layers == {"PROFILE", "PROFILE_PLUS_SIGMA", "PROFILE_MINUS_SIGMA"}
    with hill.page.expect_download() as download:
        hill.press("SVG")
    assert "<svg" in download.value.path().read_text("utf-8")


def test_reload_back_button_and_a_second_page_keep_what_is_shown(
    hill: Opened, server: ViewerServer, browser: Browser
) -> None:
    hill.begin("distance")
    hill.click_all([on_ground(-3, -2), on_ground(4, 3)])
    hill.done()
    value, sigma = hill.quantity("distance")
    assert value == pytest.approx(float(np.linalg.norm(on_ground(4, 3) - on_ground(-3, -2))), abs=0.3)
    assert 0 < sigma < 0.3
    hill.page.locator("#overlay").focus()
    hill.page.keyboard.press("ArrowLeft")
    hill.settle()
    hill.page.keyboard.press("t")
    hill.settle()
    other = opened(server, browser)
    try:
        other.begin("area")  # a page of its own
        other.page.locator("#overlay").focus()
        other.page.keyboard.press("ArrowLeft")
        hill.page.reload()
        hill.page.wait_for_selector("body[data-ready]")
        hill.done()
        assert hill.quantity("distance")[0] == pytest.approx(value)
        assert re.search(r"view=[^&]*,90,0\.05", hill.page.url)
        expect(hill.page.get_by_role("tab", name="Measure")).to_have_attribute("aria-selected", "true")
        hill.page.go_back()
        wait(lambda: not re.search(r"view=[^&]*,90,0\.05", hill.page.url))
        assert "kind=area" in other.page.url and "kind=distance" in hill.page.url
        again = browser.new_page()
        again.goto(other.page.url)
        again.wait_for_selector("body[data-ready]")
        assert again.locator("#tab-measure").get_attribute("aria-selected") == "true"
        again.close()
    finally:
        other.page.close()


def test_marks_are_set_disagree_and_are_written(hill: Opened, workspace: Workspace) -> None:
    point = hill.server.viewer.survey.check_points[3]
    image = hill.come_close(point.name)
    row = hill.page.locator(f'[data-mark="{image}"]')
    before = np.array([float(v) for v in str(row.get_attribute("data-px")).split(",")])
    assert hill.page.locator("#neighbours canvas").count() >= 3
    middle = hill.page.locator("#sheet").bounding_box()
    assert middle is not None
    # Photographs of 96 px fill the page: a click marks at once. First beside the point, by 12 px of the photograph.
    scale = min(middle["width"] / 96, (middle["height"] - 175) / 72)
    left = middle["x"] + middle["width"] / 2 - 48 * scale
    top = middle["y"] + (middle["height"] - 174) / 2 - 36 * scale
    off = np.array([12.0 if before[0] < 60 else -12.0, 8.0 if before[1] < 40 else -8.0])
    hill.page.mouse.click(*(np.array([left, top]) + scale * (before + off)).tolist())
    expect(row).to_have_class("wrong", timeout=PATIENCE_MS)
    hill.press("Write gcp_list.txt")
    expect(hill.page.locator("#question")).to_contain_text(image)
    hill.press("No")
    assert not (workspace.root / FOLDER / CHECK).exists()
    hill.page.mouse.click(*(np.array([left, top]) + scale * before).tolist())
    expect(row).not_to_have_class("wrong", timeout=PATIENCE_MS)
    mark = np.array([float(v) for v in str(row.get_attribute("data-px")).split(",")])
    np.testing.assert_allclose(mark, before, atol=0.5)
    hill.page.reload()
    hill.page.wait_for_selector("body[data-ready]")
    expect(row).to_have_count(1)
    again = np.array([float(v) for v in str(row.get_attribute("data-px")).split(",")])
    np.testing.assert_allclose(again, mark, atol=1e-9)
    hill.press("Write gcp_list.txt")
    wait((workspace.root / FOLDER / CHECK).exists)
    listed = read_ground_points(workspace.root / FOLDER / CHECK).marks
    written = {(each.name, each.image): (each.x_px, each.y_px) for each in listed}
    assert written[point.name, image] == pytest.approx(tuple(mark), abs=1e-3)
    hill.press(f"Remove the mark in {image}")
    expect(row).to_have_count(0)
    hill.press("Undo (Ctrl-Z)")
    expect(row).to_have_count(1)
    hill.press("Measure it")
    wait(lambda: len(hill.measured()) == 1)
    np.testing.assert_allclose(hill.measured()[0], point.position_in_geo, atol=0.5)


def test_marks_are_proposed(hill: Opened) -> None:
    point = hill.server.viewer.survey.check_points[2]
    hill.come_close(point.name)
    rows = hill.page.locator("[data-mark]")
    places = {str(row.get_attribute("data-mark")): str(row.get_attribute("data-px")) for row in rows.all()}
    for image in list(places)[2:]:
        hill.press(f"Remove the mark in {image}")
        expect(hill.page.locator(f'[data-mark="{image}"]')).to_have_count(0)
    hill.press("Propose marks")
    expect(hill.page.locator("#proposals .note").first).to_contain_text("Accept or refuse", timeout=PATIENCE_MS)
    proposed = [str(each.get_attribute("data-proposed")) for each in hill.page.locator("[data-proposed]").all()]
    assert len(proposed) >= 2
    hill.page.locator(f'[data-proposed="{proposed[0]}"]').get_by_role("button", name="Refuse").click()
    hill.page.locator(f'[data-proposed="{proposed[1]}"]').get_by_role("button", name="Accept").click()
    row = hill.page.locator(f'[data-mark="{proposed[1]}"]')
    expect(row).to_have_count(1, timeout=PATIENCE_MS)
    found, true = (
        np.array([float(v) for v in text.split(",")])
        for text in (str(row.get_attribute("data-px")), places[proposed[1]])
    )
    assert np.linalg.norm(found - true) < 1.0  # a template of 29 px covers a third of these photographs
    assert hill.page.locator(f'[data-mark="{proposed[0]}"]').count() == 0


def test_a_place_is_seen_coloured_and_cut_out(hill: Opened) -> None:
    hill.page.get_by_label("Photographs that see what I click").check()
    hill.click(on_ground(2, 6))
    wait(lambda: hill.page.locator("[data-seen]").count() >= 3)
    widths = [float(str(text).split(" ")[0]) for text in hill.page.locator("#strip figcaption").all_text_contents()]
    assert widths == sorted(widths) and widths[0] == pytest.approx(1000 * PIXEL_M, rel=0.3)
    cursor = hill.page.locator("#cursor")
    hill.page.mouse.move(*hill.pixel(on_ground(0, 0)))
    true = hill.server.viewer.model.target.xyz_from_geo(on_ground(0, 0)[None])[0]
    shown = [float(text) for text in re.findall(r"\d+\.\d+", str(cursor.text_content()))]
    np.testing.assert_allclose(shown, true, atol=0.4)
    legend = hill.page.locator("#legend")
    for colouring, unit in (
        ("sigma", r"predicted σ.*\d m"),
        ("views", "photographs that see it"),
        ("height", r"height.*\d m"),
    ):
        hill.page.select_option("#colouring", colouring)
        # The legend of a picture asked for before may still arrive.
        expect(legend).to_have_text(re.compile(unit), timeout=PATIENCE_MS)
    expect(legend).to_contain_text("grey: not known")
    low, high = (float(text) for text in re.findall(r"-?\d+\.\d", str(legend.text_content())))
    level = float(true[2] - on_ground(0, 0)[2])
    assert low - level == pytest.approx(0.0, abs=0.7) and 3 < high - level < 7
    hill.press("Around the middle of the view")
    hill.settle()
    hill.page.mouse.move(5, 400)
    assert cursor.text_content() == ""  # cut away
    assert "box=" in hill.page.url


COLOUR = "(name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim()"
COLOURS = ("ink", "soft", "paper", "raised", "main", "on-main", "alarm")
PAIRS = [(ink, paper) for paper in ("paper", "raised") for ink in ("ink", "soft")]
PAIRS += [("main", "paper"), ("on-main", "main"), ("alarm", "paper")]


def test_keys_and_a_narrow_dark_page(server: ViewerServer, browser: Browser) -> None:
    view = opened(server, browser, {"width": 390, "height": 760}, color_scheme="dark")
    page = view.page
    try:
        assert not page.locator("#panel").is_visible()
        for key, name in (("2", "measure"), ("3", "mark"), ("1", "see")):
            page.keyboard.press(key)
            expect(page.locator(f"#tab-{name}")).to_have_attribute("aria-selected", "true")
        page.keyboard.press("?")
        expect(page.locator("#help")).to_be_visible()
        page.keyboard.press("Escape")
        page.locator("#fold").focus()
        page.keyboard.press("Enter")
        expect(page.locator("#panel")).to_be_visible()
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        page.keyboard.press("2")
        page.locator("#overlay").focus()
        page.keyboard.press("Space")  # measures the middle of the scene
        wait(lambda: len(view.measured()) == 1)
        page.keyboard.press("1")
        for light in ("dark", "light"):
            page.select_option("#light", light)
            colour = {name: page.evaluate(COLOUR, f"--{name}") for name in COLOURS}
            for ink, paper in PAIRS:
                assert contrast(colour[ink], colour[paper]) >= 4.5, (light, ink, paper)
    finally:
        page.close()
    assert (view.outside, view.problems) == ([], [])


def contrast(first: str, second: str) -> float:
    """Return the ratio of WCAG 2.2 of two colours (#rrggbb)."""

    def luminance(colour: str) -> float:
        channels = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    low, high = sorted([luminance(first), luminance(second)])
    return (high + 0.05) / (low + 0.05)


def test_a_full_disk_is_told_and_nothing_is_stored_twice(
    workspace: Workspace, browser: Browser, tmp_path: Path
) -> None:
    shutil.copytree(workspace.root, tmp_path / "ws", ignore=shutil.ignore_patterns(FOLDER))
    folder = tmp_path / "ws" / FOLDER
    with mounted(folder, "400k"), served(Workspace(tmp_path / "ws"), ViewOptions(port=8750)) as server:
        view = opened(server, browser)
        try:
            view.begin("point")
            view.click_all([on_ground(3, 3)])
            view.done()
            with filled(folder):
                view.save("first")
                failed = view.page.locator(".notice.failed")
                expect(failed).to_contain_text("the disk is full", timeout=PATIENCE_MS)
                assert (len(view.measured()), read_measurements(folder)) == (1, [])
                assert not list(folder.glob("*.tmp"))
            view.save("first")
            expect(view.saved).to_have_count(1)
            assert len(read_measurements(folder)) == 1
        finally:
            view.page.close()


def test_the_first_view_is_the_area_from_above(hill: Opened) -> None:
    """North is up, the whole outline is in the picture and fills it, and nothing leans; names do not overlap."""
    hill.go()
    rings = np.array([corner for ring in hill.server.viewer.scene()["boundary"] for corner in ring])
    camera = hill.camera().camera()
    np.testing.assert_allclose(camera.rotation[2], [0, 0, -1], atol=1e-9)
    if len(rings):
        pixels = camera.pinhole().project((rings - camera.position) @ camera.rotation.T)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        assert (low > 0).all() and high[0] < camera.width and high[1] < camera.height
        assert max((high - low) / (camera.width, camera.height)) > 0.85
    # Ten metres of height move a place at the rim by less than 3 % of them.
    foot, top = (
        camera.pinhole().project(camera.rotation @ (np.array([20.0, 15.0, up]) - camera.position)) for up in (0, 10)
    )
    metre_px = camera.pinhole().fx / np.linalg.norm(camera.position - [20.0, 15.0, 0.0])
    assert np.linalg.norm(np.subtract(top, foot)) < 0.3 * metre_px
    assert "--" not in str(hill.page.locator("#accuracy").text_content())


def test_points_are_dragged_undone_and_done_again(hill: Opened) -> None:
    hill.go()
    hill.begin("distance")
    hill.click_all([on_ground(-8, 2), on_ground(6, 4)])
    hill.done()
    before = hill.measured()
    hill.page.mouse.move(*hill.pixel(on_ground(6, 4)))
    hill.page.mouse.down()
    hill.page.mouse.move(*hill.pixel(on_ground(8, 3)), steps=4)
    hill.page.mouse.move(*hill.pixel(on_ground(9, -3)), steps=4)
    hill.page.mouse.up()
    wait(lambda: np.linalg.norm(hill.measured()[1] - before[1]) > 3)
    moved = hill.measured()
    np.testing.assert_allclose(moved[1][:2], [9, -3], atol=PIXEL_M)
    np.testing.assert_array_equal(moved[0], before[0])
    hill.page.keyboard.press("Control+z")
    wait(lambda: np.allclose(hill.measured()[1], before[1]))
    hill.page.keyboard.press("Control+Shift+z")
    wait(lambda: np.allclose(hill.measured()[1], moved[1]))
    hill.done()
    length, sigma = hill.quantity("horizontal distance")
    assert length == pytest.approx(np.hypot(17, 5), abs=2 * PIXEL_M)
    pixel_m = (
        np.linalg.norm(np.diff([hill.camera().camera().position, np.zeros(3)], axis=0))
        / hill.camera().camera().pinhole().fx
    )
    assert sigma > pixel_m  # of two clicks, 0.8 px each along the line


def test_what_was_saved_is_shown(hill: Opened) -> None:
    hill.go()
    hill.begin("distance")
    hill.click_all([on_ground(-8, 2), on_ground(6, 4)])
    hill.done()
    hill.page.evaluate("() => location.hash")
    hill.save("wall")
    wait(lambda: hill.saved.filter(has_text="wall").count() == 1)
    assert "saved" in parse_qs(urlparse(hill.page.url).fragment)["shown"][0].split(",")
    hill.tab("See")
    hill.page.get_by_label("saved measurements").uncheck()
    hill.tab("Measure")
    before = hill.camera()
    hill.saved.filter(has_text="wall").get_by_role("button", name="Show").click()
    hill.settle()
    assert "saved" in parse_qs(urlparse(hill.page.url).fragment)["shown"][0].split(",")
    assert hill.camera().camera().position.tolist() != before.camera().position.tolist()
    hill.saved.filter(has_text="wall").get_by_role("button", name="Delete").click()


def test_sigma_of_clicks_is_that_of_a_persons_pixel(hill: Opened) -> None:
    """Thirty distances whose ends are clicked a whole pixel beside the place, or on it: error over σ."""
    hill.go()
    for name in ("cameras", "points"):  # a click on one of them measures that
        hill.page.locator(f"#overlays input[value='{name}']").uncheck()
    rng, ratios = np.random.default_rng(5), []
    hill.begin("distance")
    for _ in range(30):
        ends = [on_ground(*rng.uniform(-11, 11, 2)) for _ in range(2)]
        for number, end in enumerate(ends, start=1):
            x, y = np.array(hill.pixel(end)) + rng.integers(-1, 2, 2)
            hill.page.mouse.click(x, y)
            wait(lambda: len(hill.measured()) == number)  # noqa: B023
        hill.done()
        length, sigma = hill.quantity("horizontal distance")
        ratios.append((length - np.linalg.norm((ends[1] - ends[0])[:2])) / sigma)
        hill.press("New (Esc)")
        wait(lambda: not hill.measured())
    assert 0.7 < float(np.sqrt(np.mean(np.square(ratios)))) < 1.4


def test_a_click_outside_the_area_is_told(hill: Opened) -> None:
    hill.go()
    rings = hill.server.viewer.scene()["boundary"]
    low, high = np.array(rings[0]).min(axis=0), np.array(rings[0]).max(axis=0)
    middle = hill.server.viewer.frame.middle_in_geo
    inside = (low + high)[:2] / 2 + middle[:2]
    outside = np.array([high[0] + middle[0] + 1.5, inside[1]])
    told = hill.page.locator(".notice").filter(has_text="outside the area of interest")
    hill.begin("point")
    hill.click_all([on_ground(*inside)])
    assert told.count() == 0
    hill.begin("point")
    hill.click_all([on_ground(*outside)])
    expect(told).to_have_count(1)


def test_a_change_of_tab_draws_nothing_anew(hill: Opened) -> None:
    hill.go()
    asked: list[str] = []
    hill.page.on("request", lambda request: asked.append(request.url) if "/picture" in request.url else None)
    for name in ("Measure", "Mark", "See"):
        hill.tab(name)
        hill.settle()
    assert asked == []
    hill.page.locator("#overlay").focus()
    with hill.page.expect_request("**/picture", timeout=PATIENCE_MS):
        hill.page.keyboard.press("ArrowLeft")
    hill.settle()
    assert asked


def test_results_are_above_the_fold_of_a_phone(server: ViewerServer, browser: Browser) -> None:
    view = opened(server, browser, {"width": 390, "height": 760})
    page = view.page
    try:
        page.locator("#fold").click()
        view.begin("distance")
        view.settle()
        ends = [on_ground(-8, 2), on_ground(6, 4)]
        panel = page.locator("#panel").bounding_box()
        assert panel is not None and all(view.pixel(end)[1] < panel["y"] for end in ends)
        view.click_all(ends)
        view.done()
        row = page.locator('[data-quantity="distance"]')
        box = row.bounding_box()
        assert (
            box is not None and box["y"] >= 0 and box["y"] + box["height"] <= 760 and box["x"] + box["width"] <= 390
        )
        hit = "([x, y]) => document.elementFromPoint(x, y)?.closest('[data-quantity]') !== null"
        assert page.evaluate(hit, [box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])  # nothing over it
        assert page.evaluate("() => document.querySelector('#panel').scrollTop") == 0
    finally:
        page.close()
    assert (view.outside, view.problems) == ([], [])
