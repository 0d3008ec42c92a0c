"""Scenes of the rasterisers' tests, for the tests on a GPU."""

from __future__ import annotations

from tests.splat.rasterizer.conftest import camera, leaves, loss_of, make_scene

__all__ = ["camera", "leaves", "loss_of", "make_scene"]
