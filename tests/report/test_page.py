"""The page of the report: every figure is that of `evaluate`, and what is missing is said."""

from __future__ import annotations

import base64
import html
import json
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipelines.core.errors import BackendUnavailableError, InputError, MissingProductError
from pipelines.core.products import load_json, save_json
from pipelines.core.progress import SILENT
from pipelines.core.stages import ACCURACY_MAP, METRICS, RENDERS, REPORT, SURVEY
from pipelines.core.workspace import StageRun, Workspace
from pipelines.report.options import ReportOptions
from pipelines.report.page import logo_picture, value_at
from pipelines.report.points import points_facts
from pipelines.report.stage import run
from pipelines.survey.report import read_report
from pipelines.survey.survey import Survey
from tests.evaluated_workspaces import evaluated_workspace
from tests.refusals import refused
from tests.report.conftest import HOSTILE, Reported, page_of
from tests.reports import report_with
from tests.trained_workspaces import untrained


@dataclass
class Elements(HTMLParser):
    """Figures, addresses, headings and element names of a page.

    Attributes:
        figures: path in the report, whole value, and text of each element `data`.
        addresses: of everything that a browser loads or follows.
        without_text: pictures without an alternative text.
    """

    figures: list[tuple[str, Any, str]] = field(default_factory=list)
    addresses: list[str] = field(default_factory=list)
    headings: list[int] = field(default_factory=list)
    names: set[str] = field(default_factory=set)
    without_text: int = 0
    is_open: bool = False

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.names.add(tag)
        self.addresses += [value for name in ("src", "href") if (value := given.get(name)) is not None]
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag == "img" and not given.get("alt"):
            self.without_text += 1
        if tag == "data":
            self.is_open = True
            self.figures.append((str(given["data-field"]), json.loads(str(given["data-value"])), ""))

    def handle_data(self, data: str) -> None:
        if self.is_open:
            path, value, text = self.figures[-1]
            self.figures[-1] = (path, value, text + data)

    def handle_endtag(self, tag: str) -> None:
        self.is_open = self.is_open and tag != "data"


def elements(page: str) -> Elements:
    parser = Elements()
    parser.feed(page)
    return parser


def number_in(text: str) -> float:
    """Return the number of a text, in the unit of the report, which has shares and metres."""
    found = re.search(r"[−+]?[\d\u2009]+(?:\.\d+)?", text)
    assert found is not None, text
    value = float(found[0].replace("−", "-").replace("\u2009", ""))
    return value * (1e-6 if "ppm" in text else 1e-2 if "%" in text or " cm" in text else 1.0)


def test_every_figure_is_that_of_the_report_of_evaluate(reported: Reported) -> None:
    document = json.loads(reported.truth.workspace.path(REPORT).read_text("utf-8"))
    figures = elements(reported.html).figures
    assert len({path for path, _, _ in figures}) > 80
    for path, value, text in figures:
        assert value == value_at(document, path), path
        if value is None:
            assert text == "–", path
        elif isinstance(value, int | float):
            # The coarsest form: three figures behind the point, two for decibels, ratios and long distances.
            tolerance = (
                5e-8
                if "ppm" in text
                else 5.1e-3
                if abs(value) >= 10 or "dB" in text or "error_squared" in path
                else 5.1e-4
            )
            assert number_in(text) == pytest.approx(value, abs=tolerance), path


def test_page_is_one_file_without_scripts(reported: Reported) -> None:
    page = elements(reported.html)
    assert not {"script", "link", "iframe", "object", "form"} & page.names
    assert all(address.startswith(("#", "data:image/")) for address in page.addresses)
    assert "default-src 'none'" in reported.html
    anchors = set(re.findall(r'id="([^"]+)"', reported.html))
    assert {address[1:] for address in page.addresses if address.startswith("#")} <= anchors
    assert page.without_text == 0
    steps = [after - before for before, after in zip(page.headings, page.headings[1:], strict=False)]
    assert page.headings[0] == 1
    assert max(steps) == 1  # no level is left out


def test_paper_lacks_no_number_of_a_section(reported: Reported) -> None:
    """Sections that are folded on the screen are left out of the PDF: they are the last ones."""
    folded = ["folded" in attributes for attributes in re.findall(r"<section ([^>]*)>", reported.html)]
    assert any(folded) and folded == sorted(folded)


def test_sentences_on_maps_and_positions_are_true(reported: Reported) -> None:
    """Axes are those of the CRS, and the residuals are those of test views as well."""
    assert "count from the survey's origin" not in reported.html
    solved = [camera.split for camera in reported.solution.cameras]
    assert "with measured and predicted accuracy" in reported.html
    assert "test" in solved and "positions of training photographs" not in reported.html


def test_hostile_names_are_text(reported: Reported) -> None:
    assert "script" not in elements(reported.html).names
    assert reported.html.count(html.escape(HOSTILE)) > 10


def test_what_is_missing_is_said_with_what_to_do(tmp_path: Path) -> None:
    made = evaluated_workspace(tmp_path / "flight")
    root = made.workspace.root
    survey = load_json(Survey, root / SURVEY)
    images = tuple(image.model_copy(update={"timestamp_s": None}) for image in survey.images)
    bare = {"control_points": (), "check_points": (), "images": images}
    save_json(survey.model_copy(update=bare), root / SURVEY)
    save_json(report_with(), root / REPORT)
    (root / METRICS).unlink()
    for file in (root / RENDERS).iterdir():
        file.unlink()
    assert not (root / ACCURACY_MAP).exists()
    page = page_of(made)
    text = text_of(page)
    for sentence in (
        "The survey has no check points: no accuracy was measured.",
        "The survey has no control points: the recorded positions alone place it",
        "the photographs have no times of exposure",
        "No test views: no photograph was kept out of the training",
        "train/metrics.jsonl is not there",
        "The prediction cannot be compared",
        "There is no map of the predicted σ: the scene has too few points.",
        "nothing measures the accuracy: surveyed points that enter no solution would",
    ):
        assert sentence in text
    assert "with measured" not in text and "(RMSE, H: horizontal" not in text  # nothing was
    # What was not made or not asked for is no section: the client cannot make it.
    assert not {"lidar", "reference", "rasters"} & set(re.findall(r'<section id="([^"]+)"', page))
    assert_for_client(page)


def text_of(page: str) -> str:
    """The text of a page, without its style."""
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)))


def assert_for_client(page: str) -> None:
    """Require that nothing on paper tells what to type."""
    printed = re.sub(r'<details class="folded">.*?</details>', "", page, flags=re.DOTALL)
    assert len(printed) < len(page)
    assert re.search(r"georef [a-z]|(?<![\w-])--[a-z]|georef\.toml", text_of(printed)) is None


def test_page_is_for_a_client(reported: Reported) -> None:
    assert_for_client(reported.html)
    root = reported.truth.workspace.root
    assert not any(str(folder) in reported.html for folder in (root, root.parent))


def test_names_of_the_cover_are_text_and_the_logo_is_drawn_anew(tmp_path: Path) -> None:
    made = evaluated_workspace(tmp_path / "flight")
    logo = np.zeros((40, 1200, 4), np.uint8)
    logo[:, :600, 3] = 255
    cv2.imwrite(str(tmp_path / "logo.png"), logo)
    options = ReportOptions(title=HOSTILE, client=f"client {HOSTILE}", author="a&b", logo=tmp_path / "logo.png")
    page = page_of(made, options)
    head = page.partition("<nav")[0]
    assert {f"<h1>{html.escape(HOSTILE)}</h1>", f"client {html.escape(HOSTILE)}", "a&amp;b"} <= set(
        re.findall(r"<h1>.*?</h1>|client .*?(?=</dd>)|a&amp;b", head)
    )
    (address,) = re.findall(r'src="data:image/webp;base64,([^"]+)"', head)
    drawn = cv2.imdecode(np.frombuffer(base64.b64decode(address), np.uint8), cv2.IMREAD_UNCHANGED)
    assert drawn is not None and drawn.shape == (20, 600, 4)  # smaller, and still transparent
    assert drawn[:, :290, 3].min() > 250 and drawn[:, 310:, 3].max() < 5


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b"<svg onload='alert(1)'/>", "logo-not-a-picture"),
        (b"II*\x00" + bytes(100), "logo-not-a-picture"),  # TIFF
        (b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + 2 * (30_000).to_bytes(4, "big") + bytes(9), "too-many-pixels"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR" + 2 * (30).to_bytes(4, "big") + bytes(9), "not-a-picture"),
        (b"\xff\xd8\xff" + bytes(100), "not-a-picture"),
        (b"\x89PNG" + bytes(5 * 2**20), "file-too-large"),
        (b"", "file-empty"),
    ],
)
def test_hostile_logo_is_refused(tmp_path: Path, content: bytes, code: str) -> None:
    (tmp_path / "logo").write_bytes(content)
    with refused(code, InputError):
        logo_picture(tmp_path / "logo")


def test_without_evaluation_the_command_is_named(tmp_path: Path) -> None:
    made = evaluated_workspace(tmp_path / "flight")
    made.workspace.path(REPORT).unlink()
    with pytest.raises(MissingProductError, match=r"georef evaluate .*flight"):
        page_of(made)


def test_photograph_that_changed_is_refused(reported: Reported) -> None:
    survey = reported.survey
    images = tuple(image.model_copy(update={"sha256": "0" * 64}) for image in survey.images)
    changed = survey.model_copy(update={"images": images})
    with refused("photograph-changed", InputError):
        points_facts(
            reported.truth.workspace,
            changed,
            reported.posterior,
            reported.report,
            reported.crs,
            chips_a_point=1,
            progress=SILENT,
        )


def test_pdf_without_chromium_is_refused_before_the_work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CHROMIUM", raising=False)
    monkeypatch.setattr("pipelines.report.chromium._INSTALLED", ())
    with refused("chromium-missing", BackendUnavailableError):
        run(StageRun(Workspace(tmp_path), tmp_path), ReportOptions(pdf=True))


def test_before_training_the_sections_of_the_cameras_are_there(tmp_path: Path) -> None:
    made = evaluated_workspace(tmp_path / "flight")
    report = read_report(made.workspace.path(REPORT))
    alone = report.checkpoints.model_copy(update={"surface": None})
    untrained(made.workspace)
    update = {"photometric": None, "checkpoints": alone}
    save_json(report.model_copy(update=update), made.workspace.path(REPORT))
    page = page_of(made)
    sections = set(re.findall(r'<section id="([^"]+)"', page))
    assert {"summary", "accuracy", "check-points", "positions", "lenses", "photographs"} <= sections
    assert not {"test-views", "training", "lidar", "rasters", "reference"} & sections
    assert "rendered surface" not in page and "PSNR" not in page and "Test views" not in page
