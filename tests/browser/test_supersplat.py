"""PLY and streamed SOG in SuperSplat's viewer, in headless Chromium: which way up they stand."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import torch
from playwright.sync_api import Browser

from pipelines.deliver.options import ExportPlyOptions, ExportSogOptions
from pipelines.deliver.ply import write_ply
from pipelines.deliver.sog import write_streamed
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.sh import sh_from_rgb
from tests.browser import hill
from tests.browser.chromium import served
from tests.browser.conftest import new_viewer

pytestmark = pytest.mark.browser

# The viewer's own page asks for settings; these are its makers', which look at an object from above and aside.
PAGE = """<!doctype html>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="SuperSplat/public/index.css">
<body style="margin: 0; height: 100vh">
<script type="module">
    import { createViewer } from "./SuperSplat/public/index.js";
    import { defaultSettings } from "./SuperSplat/dist/settings.js";
    window.viewer = await createViewer({
        container: document.body, contentUrl: "splat.ply", settings: defaultSettings("object"),
        renderer: "webgl", ui: false,
    });
</script>
"""


def pillar() -> Gaussians:
    """Return a pillar of 2 m in `scene`, whose upper half is red and whose lower half is blue."""
    points = np.random.default_rng(0).uniform([-0.5, -0.5, -1], [0.5, 0.5, 1], (2000, 3))
    colours = torch.from_numpy(np.where(points[:, 2:] > 0, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])).float()
    harmonics = torch.zeros(len(points), 16, 3)
    harmonics[:, 0] = sh_from_rgb(colours)
    quaternions = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(points), 4)
    log_scales = torch.full((len(points), 3), float(np.log(0.06)))
    means = torch.from_numpy(points).float()
    return Gaussians(means, quaternions, log_scales, torch.full((len(points),), 4.0), harmonics)


def towards_red_deg(browser: Browser, folder: Path, content: str) -> float:
    """Return the angle on the screen, from the right to the top, of the way from the blue to the red half."""
    (folder / "index.html").write_text(PAGE.replace("splat.ply", content))
    viewer = new_viewer(browser)
    with served(folder) as root:
        viewer.show(root)
        viewer.page.wait_for_function("window.viewer?.state.loaded")
        picture = cv2.imdecode(np.frombuffer(viewer.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        viewer.page.close()
    assert (viewer.problems, viewer.outside) == ([], [])
    assert picture is not None
    blueness = picture[..., 0].astype(int) - picture[..., 2]
    red, blue = (np.argwhere(sign * blueness > 100) for sign in (-1, 1))
    assert min(len(red), len(blue)) > 1000  # pixels: both halves are seen
    down, right = red.mean(axis=0) - blue.mean(axis=0)
    return float(np.degrees(np.arctan2(-down, right)))


@pytest.mark.parametrize(("up", "angle_deg"), [("-y", 90.0), ("y", -90.0), ("z", None)])
def test_minus_y_alone_is_upright(
    browser: Browser, tmp_path: Path, up: Literal["-y", "y", "z"], angle_deg: float | None
) -> None:
    write_ply(hill.placed(pillar()), tmp_path / "splat.ply", ExportPlyOptions(up=up))
    found_deg = towards_red_deg(browser, tmp_path, "splat.ply")
    if angle_deg is None:
        assert abs(np.sin(np.radians(found_deg))) < 0.71  # nearer to level than to upright
    else:
        # The scene's middle is rounded to 0.05 m: less than 1° seen from 3.5 m; random places add as much.
        assert found_deg == pytest.approx(angle_deg, abs=5)


def test_streamed_sog_is_upright(browser: Browser, tmp_path: Path) -> None:
    write_streamed(tmp_path, hill.placed(pillar()), ExportSogOptions())
    assert towards_red_deg(browser, tmp_path, "lod-meta.json") == pytest.approx(90, abs=5)
