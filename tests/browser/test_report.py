"""The report and the page of a change in a browser: without a network, at two widths, light and dark, on paper."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Route

from pipelines.change.options import ChangeOptions
from pipelines.change.stage import run as run_change
from pipelines.compare.table import PAGE, ComparedRow, Comparison, PointAccuracy, write_comparison
from pipelines.core.stages import CHANGE_PAGE
from pipelines.core.workspace import StageRun
from pipelines.report.chromium import print_pdf
from pipelines.report.options import ReportOptions
from pipelines.report.stage import run
from tests.change_pairs import town_pair
from tests.evaluated_workspaces import evaluated_workspace

pytestmark = pytest.mark.browser

HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)>"
# Of every text that is drawn: the contrast of its colour against the background behind it (WCAG 2.2, 1.4.3).
CONTRASTS = """() => {
    const channels = (text) => text.match(/[\\d.]+/g).map(Number);
    const luminance = ([r, g, b]) => [r, g, b].map((v) => v / 255)
        .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
        .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
    const behind = (node) => {
        for (let at = node; at; at = at.parentElement) {
            const colour = channels(getComputedStyle(at).backgroundColor);
            if (colour.length === 3 || colour[3] === 1) return colour;
        }
        return [255, 255, 255];
    };
    const found = [];
    for (const node of document.querySelectorAll("body *")) {
        const own = [...node.childNodes].some((child) => child.nodeType === 3 && child.textContent.trim());
        if (!own || node.closest("svg") || node.closest(".skip")) continue;
        const [a, b] = [luminance(channels(getComputedStyle(node).color)), luminance(behind(node))];
        found.push((Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05));
    }
    return found;
}"""
# The deepest overlap of two neighbours in a table, a list, a grid or the text, in pixels.
OVERLAPS = """() => {
    const found = [0];
    for (const node of document.querySelectorAll("main, section, tr, dl, figure, .points, .chips, .triple")) {
        const boxes = [...node.children].map((child) => child.getBoundingClientRect());
        boxes.slice(1).forEach((box, i) => {
            const before = boxes[i];
            const wide = Math.min(before.right, box.right) - Math.max(before.left, box.left);
            const high = Math.min(before.bottom, box.bottom) - Math.max(before.top, box.top);
            found.push(Math.min(wide, high));
        });
    }
    return Math.max(...found);
}"""


# Elements that leave the printed page, A4 upright within its margins.
CUT_ON_PAPER = """() => [...document.querySelectorAll("header *, main table, main img, main p, main svg, main pre")]
    .filter((node) => node.getBoundingClientRect().right > 689)
    .map((node) => node.outerHTML.slice(0, 80))"""
# Tables that scroll in their box, by their class.
SCROLLING = """() => [...document.querySelectorAll(".scroll")]
    .filter((box) => box.scrollWidth > box.clientWidth + 1)
    .map((box) => box.firstElementChild.className)"""


@dataclass
class Opened:
    """Open page, with all that it asked for and all that went wrong.

    Attributes:
        page: of the browser.
        asked: addresses beyond the file itself.
        problems: errors of scripts and on the console, and dialogs.
    """

    page: Page
    asked: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def show(self, path: Path) -> None:
        page = self.page
        page.on("pageerror", lambda error: self.problems.append(f"script: {error}"))
        page.on("console", lambda line: self.problems.append(line.text) if line.type == "error" else None)
        page.on("dialog", lambda dialog: (self.problems.append(f"dialog: {dialog.message}"), dialog.dismiss()))
        page.route("**/*", self._file_only)
        page.goto(path.as_uri())

    def _file_only(self, route: Route) -> None:
        if route.request.url.startswith(("file://", "data:")):
            route.continue_()
            return
        self.asked.append(route.request.url)
        route.abort()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Page of a survey whose names hold scripts."""
    made = evaluated_workspace(tmp_path_factory.mktemp("report") / "flight", rename=HOSTILE)
    out = made.workspace.root / "report"
    out.mkdir()
    run(StageRun(made.workspace, out), ReportOptions())
    return out / "report.html"


@pytest.fixture(params=[(1280, "light"), (1280, "dark"), (390, "light"), (390, "dark")], ids=str)
def opened(request: pytest.FixtureRequest, browser: Browser, report: Path) -> Iterator[Opened]:
    """The page at a width in pixels, light or dark."""
    width, scheme = request.param
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True)
    page = Opened(context.new_page())
    page.show(report)
    yield page
    context.close()


def test_page_needs_nothing_and_runs_nothing(opened: Opened) -> None:
    assert (opened.asked, opened.problems) == ([], [])
    broken = "() => [...document.images].filter((image) => !image.complete || !image.naturalWidth).length"
    assert opened.page.evaluate("() => document.images.length") >= 8
    assert opened.page.evaluate(broken) == 0
    assert opened.page.evaluate("() => document.scripts.length") == 0
    assert HOSTILE in (opened.page.locator("#check-points").text_content() or "")


def test_page_is_as_wide_as_the_window_and_legible(opened: Opened) -> None:
    width = opened.page.viewport_size or {"width": 0}
    assert opened.page.evaluate("() => document.documentElement.scrollWidth") <= width["width"]
    contrasts = np.array(opened.page.evaluate(CONTRASTS))
    assert len(contrasts) > 300
    assert contrasts.min() >= 4.5  # what WCAG's level AA demands of text
    assert opened.page.evaluate(OVERLAPS) < 1.0


def test_wide_tables_scroll_in_their_own_box(browser: Browser, report: Path) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 800}, offline=True)
    page = Opened(context.new_page())
    page.show(report)
    # Only lists of points, photographs and views are wider than a telephone: all other tables, and pictures, fit.
    classes = page.page.evaluate(SCROLLING)
    assert len(classes) >= 2
    assert {name.partition(" ")[2] for name in classes} <= {"wide", "loose"}
    inside = "() => [...document.images].every((image) => image.getBoundingClientRect().right <= innerWidth)"
    assert page.page.evaluate(inside)
    # The name of a row stays in sight when its table is scrolled.
    stays = """() => {
        const box = [...document.querySelectorAll(".scroll")].find((box) => box.querySelector(".wide"));
        box.scrollLeft = 200;
        return box.querySelector("tbody th").getBoundingClientRect().left - box.getBoundingClientRect().left;
    }"""
    assert abs(page.page.evaluate(stays)) < 2
    reachable = "() => [...document.querySelectorAll('.scroll')].every((box) => box.tabIndex === 0)"
    assert page.page.evaluate(reachable)
    context.close()


@pytest.mark.parametrize(("scheme", "paper", "ink"), [("light", 255, 60), ("dark", 24, 150)])
def test_drawings_have_the_paper_of_the_page(
    browser: Browser, report: Path, scheme: Literal["light", "dark"], paper: int, ink: int
) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme=scheme, offline=True)
    page = Opened(context.new_page())
    page.show(report)
    shot = page.page.locator("#place .chart img").screenshot()
    grey = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    assert abs(int(np.median(grey)) - paper) <= 4
    darkest, brightest = np.quantile(grey, [0.001, 0.999])
    assert (darkest < ink) if scheme == "light" else (brightest > ink)  # axes and their numbers
    # A colour with a meaning is the same in both: control points are orange.
    colours = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR)
    orange = np.abs(colours.astype(int) - [0x3B, 0x8A, 0xDD]).max(axis=2) < 12
    assert orange.sum() > 20
    context.close()


def test_no_table_is_cut_on_paper(browser: Browser, report: Path) -> None:
    context = browser.new_context(viewport={"width": 688, "height": 1000}, offline=True)  # A4 within its margins
    page = Opened(context.new_page())
    page.show(report)
    page.page.emulate_media(media="print")
    assert page.page.evaluate("() => getComputedStyle(document.querySelector('td')).display") == "table-cell"
    assert page.page.evaluate(CUT_ON_PAPER) == []
    # Paper has no folds, and what is folded on the screen is left out.
    folded = "() => [...document.querySelectorAll('.folded, summary')].filter((node) => node.offsetHeight).length"
    assert page.page.evaluate(folded) == 0
    context.close()


def test_paper_shows_as_many_pictures_as_it_says(browser: Browser, report: Path) -> None:
    """The printed text is counted against what is printed, and the screen's against what is on the screen."""
    context = browser.new_context(viewport={"width": 689, "height": 900}, offline=True)
    page = Opened(context.new_page())
    page.show(report)
    visible = "(css) => [...document.querySelectorAll(css)].filter((node) => node.offsetParent).length"
    shown = {}
    for media in ("screen", "print"):
        page.page.emulate_media(media=media)
        text = page.page.evaluate("() => document.body.innerText")
        said = [int(number) for number in re.findall(r"(\d+) of \d+ marks are shown", text)]
        chips = page.page.evaluate(visible, "figure.chip")
        assert chips == sum(said) > 0
        views = re.findall(r"Views with pictures: (\d+) of (\d+)", text)
        assert [int(number) for number, _ in views] == [page.page.evaluate(visible, ".view")]
        shown[media] = chips
        for name in (
            "Place and date",
            "Name and signature",
            "What was delivered",
            "SHA-256",
            "Triangulated points",
        ):
            assert name in text
    assert shown["print"] <= shown["screen"]
    links = page.page.evaluate(
        "() => [...document.querySelectorAll('a.term')].map((a) => decodeURIComponent(a.hash.slice(1)))"
    )
    terms = page.page.evaluate("() => [...document.querySelectorAll('.glossary > div')].map((node) => node.id)")
    assert set(links) <= set(terms) and len(set(links)) >= 10
    context.close()


def test_pdf_is_printed(report: Path, tmp_path: Path) -> None:
    pdf = tmp_path / "report.pdf"
    print_pdf(report, pdf)
    data = pdf.read_bytes()
    assert data.startswith(b"%PDF-")
    assert 5 <= data.count(b"/Type /Page\n") + data.count(b"/Type /Page ") <= 12
    assert [path.name for path in tmp_path.iterdir()] == ["report.pdf"]


def test_comparison_has_the_same_frame(browser: Browser, tmp_path: Path) -> None:
    accuracy = PointAccuracy(count=3, mean_h_m=0.012, median_h_m=0.01, rmse_h_m=0.015, rmse_v_m=0.02)
    rows = (
        ComparedRow(
            configuration="A", title="plain", note="as in the paper", triangulated=accuracy, test_psnr=25.0
        ),
        ComparedRow(configuration="B", title=HOSTILE, note=HOSTILE, failure=f"it diverged {HOSTILE}"),
    )
    write_comparison(tmp_path, Comparison(options={"preset": "fast"}, rows=rows), "flight")
    context = browser.new_context(viewport={"width": 390, "height": 800}, offline=True)
    page = Opened(context.new_page())
    page.show(tmp_path / PAGE)
    assert (page.asked, page.problems) == ([], [])
    assert page.page.evaluate("() => document.documentElement.scrollWidth") <= 390
    assert (
        page.page.locator("data[data-field='rows.0.triangulated.rmse_h_m']").get_attribute("data-value") == "0.015"
    )
    assert page.page.locator("img").count() == 1
    context.close()


@pytest.fixture(scope="module")
def change_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Page of a town at two dates, where a house is gone, another is new, and there are a pit and a heap."""
    before, after = town_pair(tmp_path_factory.mktemp("change"), changed=True).workspaces
    (out := after.root / "change").mkdir()
    run_change(StageRun(after, out), ChangeOptions(before=before.root, stable_auto=True))
    return out / Path(CHANGE_PAGE).name


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (1280, "dark"), (390, "light"), (390, "dark")])
def test_change_page_is_whole_and_legible(
    browser: Browser, change_page: Path, width: int, scheme: Literal["light", "dark"]
) -> None:
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True)
    opened = Opened(context.new_page())
    opened.show(change_page)
    page = opened.page
    assert (opened.asked, opened.problems) == ([], [])
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    assert page.evaluate("() => [...document.images].every((image) => image.complete && image.naturalWidth)")
    assert page.evaluate("() => [...document.images].every((i) => i.getBoundingClientRect().right <= innerWidth)")
    assert np.array(page.evaluate(CONTRASTS)).min() >= 4.5
    # Four regions, on the map, in the table and with a profile each.
    for place in ("#regions tbody tr", ".map svg path"):
        assert page.locator(place).count() == 4
    assert page.locator("#profiles img").count() >= 4
    context.close()


def test_slider_of_a_change_moves_by_mouse_and_by_keys(browser: Browser, change_page: Path) -> None:
    context = browser.new_context(viewport={"width": 1000, "height": 900}, offline=True)
    opened = Opened(context.new_page())
    opened.show(change_page)
    figure = opened.page.locator(".compare").first
    figure.scroll_into_view_if_needed()

    def shown() -> np.ndarray:
        picture = cv2.imdecode(np.frombuffer(figure.locator(".over").screenshot(), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        return picture[40:-40].astype(float)  # the names stand on the rim

    slider = figure.locator("input")
    pictures = []
    for value in ("0", "100"):
        slider.evaluate(f"(node) => {{ node.value = {value}; node.dispatchEvent(new Event('input')); }}")
        pictures.append(shown())
    later, earlier = pictures
    assert np.abs(later - earlier).mean() > 1
    slider.focus()
    for _ in range(50):
        opened.page.keyboard.press("ArrowLeft")
    assert slider.input_value() == "50"
    half = shown()
    middle = half.shape[1] // 2
    assert np.abs(half - earlier)[:, : middle - 20].mean() < 0.5
    assert np.abs(half - later)[:, middle + 20 :].mean() < 0.5
    box = slider.bounding_box()
    assert box is not None
    opened.page.mouse.click(box["x"] + 0.8 * box["width"], box["y"] + box["height"] / 2)
    assert abs(int(slider.input_value()) - 80) <= 2
    context.close()
