"""Tiles and their page in CesiumJS, in headless Chromium: complete, at the right place, in the right colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from tests.browser import hill
from tests.browser.chromium import Viewer, served
from tests.browser.conftest import new_viewer, write_scene

pytestmark = pytest.mark.browser

FROM_ABOVE = hill.around(0.0, -90.0, 60.0, np.array([0.0, 0.0, 4.0]))
VIEWS = {
    "from the south": hill.around(0.0, -35.0, 55.0, np.array([0.0, 0.0, 3.0])),
    "from the east": hill.around(270.0, -25.0, 50.0, np.array([0.0, 0.0, 3.0])),
    "from the north-west": hill.around(135.0, -50.0, 60.0, np.array([2.0, 1.0, 2.0])),
    "from above": FROM_ABOVE,
    "near": hill.around(20.0, -40.0, 25.0, np.array([-6.0, -4.0, 1.0])),
}
# SPZ rounds harmonics to 1/16 and 1/8, scales to 3 %. CesiumJS cuts Gaussians at 2.8 standard deviations, and adds
# 0.02 px² to their screen covariance where our renders add 0.3 px². All of it together leaves 34 to 36 dB here.
LEAST_PSNR_DB = 30.0
LEAST_PLAIN_PSNR_DB = 42.0  # 8-bit colours, and single pixels at the edges: 45 to 50 dB


def psnr_db(first: np.ndarray, second: np.ndarray) -> float:
    return float(-10 * np.log10(np.mean((first - second) ** 2)))


@pytest.fixture(autouse=True, scope="module")
def without_labels(viewer: Viewer) -> None:
    viewer.hide_labels()


@pytest.mark.parametrize("name", VIEWS)
def test_view_from_a_known_place_is_our_render_from_there(viewer: Viewer, name: str) -> None:
    viewer.stand(VIEWS[name].ecef_from_cam(), hill.CAMERA)
    ours = VIEWS[name].render(hill.make_gaussians())
    assert ours.std() > 0.1  # there is something to see
    assert psnr_db(viewer.picture(), ours) > LEAST_PSNR_DB


@pytest.mark.parametrize("largest_tile", [200_000, 500])
def test_plain_tiles_are_the_picture_of_spz(
    browser: Browser, viewer: Viewer, tmp_path: Path, largest_tile: int
) -> None:
    """In one tile and in several: our render, but for what SPZ rounds."""
    gaussians = hill.make_gaussians()
    write_scene(tmp_path, gaussians, largest_tile, "none")
    plain = new_viewer(browser)
    with served(tmp_path) as root:
        plain.open(root)
        plain.hide_labels()
        for name in ("from the south", "near"):
            for opened in (viewer, plain):
                opened.stand(VIEWS[name].ecef_from_cam(), hill.CAMERA)
            assert psnr_db(viewer.picture(), plain.picture()) > LEAST_PSNR_DB
            assert psnr_db(plain.picture(), VIEWS[name].render(gaussians)) > LEAST_PLAIN_PSNR_DB
        assert (plain.failed_tiles(), plain.problems, plain.outside) == ([], [], [])
        plain.page.close()


def centroids(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the centres (N, 2) of the magenta around pixels (N, 2), whose own centre is at (0.5, 0.5)."""
    magenta = np.clip(picture[..., [0, 2]].min(axis=-1) - picture[..., 1] - 0.35, 0, None)
    y, x = np.mgrid[: magenta.shape[0], : magenta.shape[1]] + 0.5
    found = []
    for place in near:
        weight = magenta * (np.hypot(x - place[0], y - place[1]) < 12)
        assert weight.sum() > 2, "no mark is there"
        found.append([(weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()])
    return np.array(found)


@pytest.mark.parametrize("name", ["from the south", "from above"])
def test_marks_are_seen_within_a_pixel_of_their_surveyed_places(viewer: Viewer, name: str) -> None:
    viewer.stand(VIEWS[name].ecef_from_cam(), hill.CAMERA)
    expected = VIEWS[name].pixels(hill.marks_ecef())
    off_px = np.linalg.norm(centroids(viewer.picture(), expected) - expected, axis=1)
    assert off_px.max() < 0.25  # 8-bit colours


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 180.0, 270.0])
def test_every_side_shows_its_own_colour(viewer: Viewer, heading_deg: float) -> None:
    """The ball's red tells how far the view points east, green north, blue up: harmonics keep their directions."""
    view = hill.around(heading_deg, -20.0, 40.0, hill.COMPASS)
    viewer.stand(view.ecef_from_cam(), hill.CAMERA)
    middle = viewer.picture()[170:190, 230:250].mean(axis=(0, 1))
    # A harmonic of degree 1 is rounded to 1/16: its colour to 0.49 / 32. Rays beside the axis and α add as much.
    np.testing.assert_allclose(middle, hill.compass_colour(view), rtol=0, atol=0.035)


def test_nothing_failed_and_nothing_was_asked_of_the_network(viewer: Viewer) -> None:
    assert viewer.failed_tiles() == []
    assert viewer.problems == []
    assert viewer.outside == []
