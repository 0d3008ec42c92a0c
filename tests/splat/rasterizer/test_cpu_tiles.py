"""A splat is listed in every tile and row where it reaches a pixel, and in hardly any other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.splat.rasterizer import cpu
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu_project import (
    DEPTH,
    E_LEVEL,
    E_X,
    E_XX,
    E_XY,
    E_Y,
    E_YY,
    TILE_HEIGHT,
    TILE_WIDTH,
    tile_grid,
)


@pytest.fixture
def frame(make_scene, camera, monkeypatch):
    gaussians, pose = make_scene(300, seed=21, log_scale=-1.5)
    tables = {}
    listing = cpu.list_tiles
    monkeypatch.setattr(
        cpu, "list_tiles", lambda ellipses, *rest: tables.update(e=ellipses) or listing(ellipses, *rest)
    )
    frame = cpu._RenderContext(camera, RasterSettings())
    center = -torch.linalg.solve(pose[:3, :3], pose[:3, 3])
    parameters = [tensor.numpy() for tensor in gaussians.tensors().values()]
    cpu._project(frame, parameters, pose[:3].numpy(), center.numpy())
    return frame, tables["e"]


def inside(ellipse, camera):
    """Return the mask (H, W) of the pixel centres that lie in an ellipse."""
    determinant = ellipse[E_XX] * ellipse[E_YY] - ellipse[E_XY] ** 2
    dx = np.arange(camera.width) + 0.5 - ellipse[E_X]
    dy = (np.arange(camera.height) + 0.5 - ellipse[E_Y])[:, None]
    distance = ellipse[E_YY] * dx**2 - 2 * ellipse[E_XY] * dx * dy + ellipse[E_XX] * dy**2
    return distance <= ellipse[E_LEVEL] * determinant


def test_lists_are_complete_tight_and_sorted(frame, camera):
    frame, ellipses = frame
    lists, (columns, rows) = frame.lists, tile_grid(camera.width, camera.height)
    listed = np.zeros((len(ellipses), rows * TILE_HEIGHT, columns), dtype=bool)
    for tile in range(columns * rows):
        hits = lists.hits[lists.tile_start[tile] : lists.tile_start[tile + 1]]
        splats = hits >> 16
        assert (np.diff(frame.table[splats, DEPTH]) > 0).all()  # nearest first, each once
        for hit in hits:
            top = tile // columns * TILE_HEIGHT
            listed[hit >> 16, top + (hit >> 8 & 255) : top + (hit & 255) + 1, tile % columns] = True
    wasted = 0
    for splat, ellipse in enumerate(ellipses):
        pixels = np.pad(inside(ellipse, camera), ((0, 0), (0, columns * TILE_WIDTH - camera.width)))
        touched = pixels.reshape(camera.height, columns, TILE_WIDTH).any(axis=2)
        rows_listed = listed[splat, : camera.height]
        assert not (touched & ~rows_listed).any()
        wasted += (rows_listed & ~touched).sum()
    # An ellipse may pass between pixel centres, or beside the last column of the image; else rows are exact.
    assert wasted < 0.1 * listed.sum()


def test_places_lead_back_to_the_hits(frame):
    frame, ellipses = frame
    lists = frame.lists
    assert lists.splat_start[-1] == len(lists.hits) == lists.tile_start[-1]
    for splat in range(len(ellipses)):
        places = lists.places[lists.splat_start[splat] : lists.splat_start[splat + 1]]
        assert (lists.hits[places] >> 16 == splat).all()
    assert np.array_equal(np.sort(lists.places), np.arange(len(lists.hits)))
