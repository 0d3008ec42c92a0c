"""Scenes of the rasterisers' tests, for the tests on a GPU."""

from __future__ import annotations

from tests.splat.rasterizer.conftest import camera, make_scene

__all__ = ["camera", "make_scene"]
