"""Levels of detail in CesiumJS: from afar, fewer splats show the same scene."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser

from pipelines.splat.level_of_detail import DetailTile
from tests.browser import hill
from tests.browser.chromium import Viewer, served
from tests.browser.conftest import new_viewer, write_scene
from tests.browser.test_tiles import psnr_db

pytestmark = pytest.mark.browser

MIDDLE = np.array([0.0, 0.0, 2.0])
DISTANCES_M = (60.0, 200.0, 600.0)
GAUSSIANS = hill.make_gaussians(spacing_m=0.5)


@pytest.fixture(scope="module")
def levels(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Viewer, DetailTile]]:
    """Page of a hill of several levels, without labels, and the root of its tiles."""
    folder = tmp_path_factory.mktemp("levels")
    root = write_scene(folder, GAUSSIANS, largest_tile=1000)
    viewer = new_viewer(browser)
    with served(folder) as address:
        viewer.open(address)
        viewer.hide_labels()
        yield viewer, root
        viewer.page.close()


def test_far_views_show_fewer_splats_of_the_same_scene(levels: tuple[Viewer, DetailTile]) -> None:
    viewer, root = levels
    counts = []
    for distance_m in DISTANCES_M:
        view = hill.around(30.0, -40.0, distance_m, MIDDLE)
        viewer.stand(view.ecef_from_cam(), hill.CAMERA)
        counts.append(viewer.splats())
        shown, truth = viewer.picture(), view.render(GAUSSIANS, finer=6)
        rows, columns = np.nonzero(np.abs(truth - hill.BACKGROUND).max(axis=-1) > 0.05)
        box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        # Nothing gets darker or thinner. Cells of up to four pixels blur colours that change every six metres.
        np.testing.assert_allclose(shown[box].mean(axis=(0, 1)), truth[box].mean(axis=(0, 1)), rtol=0, atol=0.03)
        assert psnr_db(shown[box], truth[box]) > 20.0
    assert counts[0] == len(GAUSSIANS)
    assert counts[-1] == root.count < 300
    assert (np.diff(counts) < 0).all()
    assert viewer.problems == viewer.failed_tiles() == []
