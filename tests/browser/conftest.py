"""Chromium and a tileset of the hill, opened once for all tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from pipelines.deliver.options import Compression
from pipelines.deliver.pages import write_scene_page
from pipelines.deliver.splat import codec_arrays
from pipelines.deliver.tiles import Tiling, write_tiles
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.level_of_detail import DetailTile, scene_box
from tests.browser import hill
from tests.browser.chromium import Viewer, chromium, served


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Chromium, for all tests."""
    with chromium() as started:
        yield started


@pytest.fixture(scope="session")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a server of the hill's tiles and page."""
    folder = tmp_path_factory.mktemp("tiles")
    write_scene(folder, hill.make_gaussians())
    with served(folder) as root:
        yield root


def write_scene(
    folder: Path, gaussians: Gaussians, largest_tile: int = 200_000, compression: Compression = "spz"
) -> DetailTile:
    """Write tiles and page of Gaussians of the hill; return the root of the tiles."""
    splat = hill.placed(gaussians)
    arrays = codec_arrays(splat.gaussians)
    tiling = Tiling(scene_box(arrays.means), len(arrays), largest_tile, compression)
    root = write_tiles(folder, [arrays], tiling, splat.placement.sidecar())
    write_scene_page(hill.page(splat, "Cesium/"), folder)
    return root


@pytest.fixture(scope="module")
def viewer(browser: Browser, address: str) -> Iterator[Viewer]:
    """Page of the hill, opened; closed after a module, since an open page draws all the time."""
    opened = new_viewer(browser)
    opened.open(address)
    yield opened
    opened.page.close()


def new_viewer(browser: Browser) -> Viewer:
    """Return a page that is not loaded yet, of the size of the views."""
    size = {"width": hill.CAMERA.width, "height": hill.CAMERA.height}
    return Viewer(browser.new_page(viewport=size))
