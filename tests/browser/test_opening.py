"""Opening of the page: by a link to a view, and with a message where something is missing."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from pipelines.deliver.options import CESIUM
from pipelines.deliver.pages import write_scene_page
from tests.browser import hill
from tests.browser.chromium import served
from tests.browser.conftest import new_viewer, write_scene

pytestmark = pytest.mark.browser


def test_link_opens_the_view_that_it_names(browser: Browser, address: str) -> None:
    lat, lon, height = hill.around(90.0, -60.0, 60.0, hill.COMPASS).lla.tolist()
    viewer = new_viewer(browser)
    viewer.open(f"{address}#view={lon:.8f},{lat:.8f},{height:.3f},90.000,-60.000")
    viewer.settle()
    shown = re.findall(r"\d+\.\d+", viewer.page.locator("#camera").text_content() or "")
    assert (np.abs(np.array(shown[:3], dtype=float) - [lon, lat, height]) < [1e-7, 1e-7, 0.01]).all()
    turned = re.findall(r"-?[\d.]+", viewer.page.locator("#arrow").get_attribute("transform") or "")
    assert float(turned[0]) == pytest.approx(-90.0, abs=0.01)
    viewer.page.close()


@pytest.mark.parametrize("cesium", [CESIUM, "nowhere/"], ids=["no network", "no such folder"])
def test_page_says_that_the_library_is_missing(browser: Browser, tmp_path: Path, cesium: str) -> None:
    write_scene_page(hill.page(hill.placed(hill.make_gaussians()), cesium), tmp_path)
    viewer = new_viewer(browser)
    with served(tmp_path) as root:
        viewer.show(root)
        message = viewer.page.locator("#message")
        message.wait_for()
        assert "CesiumJS could not be loaded" in message.inner_text()
        assert "--cesium" in message.inner_text()
    viewer.page.close()
    if cesium == CESIUM:
        assert f"{CESIUM}Cesium.js" in viewer.outside


def test_page_says_which_tile_is_missing(browser: Browser, tmp_path: Path) -> None:
    write_scene(tmp_path, hill.make_gaussians())
    for content in (tmp_path / "content").iterdir():
        content.unlink()
    viewer = new_viewer(browser)
    with served(tmp_path) as root:
        viewer.show(root)
        message = viewer.page.locator("#message")
        message.wait_for()
        assert re.search(r"content/.*glb could not be loaded", message.inner_text())
    viewer.page.close()


def test_page_runs_no_other_script_and_asks_nobody_else(browser: Browser, address: str) -> None:
    """By its own policy: a script in a name that came through, a script of another server, an answer sent away."""
    viewer = new_viewer(browser)
    viewer.page.goto(address)
    refused = viewer.page.evaluate(
        """async () => {
            const refused = [];
            document.addEventListener("securitypolicyviolation", (event) => refused.push(event.effectiveDirective));
            document.body.insertAdjacentHTML("beforeend", "<img src=x onerror='injected = 1'>");
            for (const change of [{ textContent: "injected = 1" }, { src: "https://elsewhere.example/a.js" }]) {
                document.head.append(Object.assign(document.createElement("script"), change));
            }
            await fetch("https://elsewhere.example/").catch(() => 0);
            await new Promise((done) => setTimeout(done, 500));
            return [typeof injected, ...refused.sort()];
        }"""
    )
    viewer.page.close()
    assert refused == ["undefined", "connect-src", "script-src-attr", "script-src-elem", "script-src-elem"]
