"""The page in one file, opened from the disk in headless Chromium: its picture, its texts, and no network."""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, Page

from pipelines.core.products import load_json, save_json
from pipelines.core.stages import SURVEY
from pipelines.core.workspace import StageRun, Workspace
from pipelines.deliver.html import run
from pipelines.deliver.options import ExportHtmlOptions
from pipelines.deliver.pages import RENDERER
from pipelines.geometry.cameras import Pinhole, pose_matrix
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.survey.solution import read_solution
from pipelines.survey.survey import Survey, SurveyedPoint
from tests.deliver.test_html import HOSTILE, with_measurements
from tests.scripts import REPOSITORY, load_script
from tests.splat_scenes import make_rendered
from tests.view_scenes import renderer_of, smooth, viewed_workspace

pytestmark = pytest.mark.browser
SIZE = (480, 360)
BACKGROUND = (0x20 / 255, 0x24 / 255, 0x2A / 255)  # of the page
# SPZ rounds colours to 1/255 and scales to 3 %; the blending is the same.
LEAST_PSNR_DB = 32.0
_PATIENCE_MS = 120_000


@dataclass
class Opened:
    """Page in the browser, its workspace, and what went wrong."""

    page: Page
    workspace: Workspace
    problems: list[str]
    asked: list[str]

    def picture(self, camera: int) -> np.ndarray:
        """Return the page's view from a photograph (H, W, 3), RGB in 0 … 1, when it has come to rest."""
        data = self.page.evaluate(
            """async (row) => {
                const view = await georef;
                view.standAt(page.cameras[row]);
                for (let still = 0, drawn = -1; still < 4;) {
                    await new Promise((done) => setTimeout(done, 400));
                    const { sorting, sortDirty } = view.spark;
                    still = view.drawn === drawn && !view.pending && !sorting && !sortDirty ? still + 1 : 0;
                    drawn = view.drawn;
                }
                view.draw();
                return view.canvas.toDataURL();
            }""",
            camera,
        )
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        return pixels[..., ::-1] / 255.0


@pytest.fixture(scope="module")
def opened(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Any:
    workspace = viewed_workspace(tmp_path_factory.mktemp("page") / "ws", smooth(make_rendered()))
    survey = load_json(Survey, workspace.path(SURVEY))
    cov = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))
    point = SurveyedPoint(name=HOSTILE, position_in_geo=(0.0, 0.0, 2.0), cov_in_geo=cov, marks=())
    save_json(survey.model_copy(update={"control_points": (point,)}), workspace.path(SURVEY))
    with_measurements(workspace, "wall", model="other")
    out = workspace.root / "html.partial"
    out.mkdir()
    run(StageRun(workspace, out), ExportHtmlOptions())
    page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    page.set_default_timeout(_PATIENCE_MS)
    problems: list[str] = []
    asked: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda line: problems.append(line.text) if line.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url[:60]))
    page.goto((out / "splat.html").as_uri())
    page.evaluate("georef")
    yield Opened(page, workspace, problems, asked)
    page.close()


def test_view_of_a_photograph_is_our_render_of_it(opened: Opened) -> None:
    trained = renderer_of(opened.workspace)
    lens = trained.sparse.camera_of(0)
    focal = lens.mean_focal_px * SIZE[1] / lens.height
    assert lens.width / lens.height == pytest.approx(SIZE[0] / SIZE[1])
    pinhole = Pinhole(*SIZE, focal, focal, SIZE[0] / 2, SIZE[1] / 2)
    for camera in (0, 5):
        pose = pose_matrix(trained.poses.cam_from_model[camera], trained.poses.cam_center_in_model[camera])
        settings = RasterSettings(trained.gaussians.sh_degree, BACKGROUND)
        render = CpuRasterizer().render(trained.gaussians, torch.tensor(pose).float(), pinhole, settings)
        ours = render.colour.clamp(0, 1).numpy()
        assert ours.std() > 0.05
        off = (opened.picture(camera) - ours)[8:-8, 8:-8]
        assert float(-10 * np.log10(np.mean(off**2))) > LEAST_PSNR_DB


def test_nothing_is_asked_of_a_network_and_nothing_fails(opened: Opened) -> None:
    assert opened.problems == []
    assert all(url.startswith(("file:", "blob:", "data:")) for url in opened.asked)


def test_texts_state_place_accuracy_and_measurements(opened: Opened) -> None:
    page = opened.page
    page.locator("#about > summary").click()
    about = page.locator("#about").inner_text()
    page.locator("#about > summary").click()
    assert "distance" in about and "5.000 ± 0.012 m" in about and "earlier training" in about
    assert page.title() == "ws" and "Accuracy" in about and "lat" in about
    page.locator("#home").click()
    assert any(label == HOSTILE for label in page.locator("#labels span").all_inner_texts())
    page.locator("#view").click(position={"x": SIZE[0] // 2, "y": SIZE[1] // 2})
    assert "lon" in page.locator("#picked").inner_text()


def test_a_photograph_is_chosen_by_name_and_left_by_turning(opened: Opened) -> None:
    page = opened.page
    name = read_solution(opened.workspace).cameras[3].name
    page.locator("#photograph").select_option(label=name)
    stood, truth = page.evaluate("async () => [(await georef).camera.position.toArray(), page.cameras[3].at]")
    assert stood == pytest.approx(truth)
    page.locator("#top").click()
    assert page.evaluate("async () => (await georef).camera.fov") == 50
    assert page.locator("#photograph").input_value() == ""


def test_the_renderer_is_what_npm_has() -> None:
    """The bundle in the package comes from the named versions, and from nothing else."""
    bundled = load_script(REPOSITORY / ".ci/renderer.py").bundle()
    assert gzip.decompress(RENDERER.read_bytes()).decode() == bundled
