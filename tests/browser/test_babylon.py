"""Uncompressed glb in Babylon.js, in headless Chromium: the same picture as our own render."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser

from pipelines.deliver.splat import codec_arrays
from pipelines.deliver.tiles import write_glb
from tests.browser import hill
from tests.browser.chromium import served
from tests.browser.conftest import new_viewer
from tests.browser.test_tiles import VIEWS, psnr_db

pytestmark = pytest.mark.browser

PAGE = """<!doctype html>
<link rel="icon" href="data:,">
<body style="margin: 0"><canvas style="width: 100vw; height: 100vh; display: block"></canvas>
<script src="Babylon/babylon.js"></script>
<script src="BabylonLoaders/babylon.glTF2FileLoader.min.js"></script>
<script>
    const vector = (values) => BABYLON.Vector3.FromArray(values);
    const engine = new BABYLON.Engine(document.querySelector("canvas"), true, { preserveDrawingBuffer: true });
    const scene = new BABYLON.Scene(engine);
    scene.useRightHandedSystem = true;
    const camera = new BABYLON.FreeCamera("camera", BABYLON.Vector3.Zero(), scene);
    async function show({ eye, target, up, fov, background }) {
        scene.clearColor = new BABYLON.Color4(...background, 1);
        [camera.position, camera.upVector, camera.fov, camera.minZ] = [vector(eye), vector(up), fov, 0.1];
        camera.setTarget(vector(target));
        const { meshes } = await BABYLON.SceneLoader.ImportMeshAsync("", "", "splat.glb", scene);
        let frames = 0;  // in which the splats are sorted
        await new Promise((done) => engine.runRenderLoop(() => { scene.render(); if (++frames > 40) done(); }));
        return meshes.map((mesh) => mesh.getClassName());
    }
</script>
"""
GLTF_FROM_FILE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
# Babylon.js widens Gaussians by 0.3 px² as we do, and nothing is rounded: 40 to 46 dB are left by the edges of α.
LEAST_PSNR_DB = 38.0


@pytest.mark.parametrize("name", ["from the south", "near"])
def test_uncompressed_splat_is_our_render(browser: Browser, tmp_path: Path, name: str) -> None:
    gaussians, view = hill.make_gaussians(), VIEWS[name]
    placed = hill.placed(gaussians)
    write_glb(tmp_path / "splat.glb", codec_arrays(placed.gaussians), compression="none")
    (tmp_path / "index.html").write_text(PAGE)
    file_from_cam = placed.placement.sidecar().ecef_from_file().inverse() @ view.ecef_from_cam()
    eye, axes = GLTF_FROM_FILE @ file_from_cam.translation, GLTF_FROM_FILE @ file_from_cam.rotation
    stand = {
        "eye": eye.tolist(),
        "target": (eye + axes[:, 2]).tolist(),
        "up": (-axes[:, 1]).tolist(),
        "fov": 2 * math.atan(hill.CAMERA.height / 2 / hill.CAMERA.fy),
        "background": hill.BACKGROUND,
    }
    viewer = new_viewer(browser)
    with served(tmp_path) as root:
        viewer.show(root)
        meshes = viewer.page.evaluate("show", stand)
        picture = cv2.imdecode(np.frombuffer(viewer.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        viewer.page.close()
    assert (viewer.problems, viewer.outside) == ([], [])
    assert "GaussianSplattingMesh" in meshes
    assert picture is not None
    assert psnr_db(picture[..., ::-1] / 255.0, view.render(gaussians)) > LEAST_PSNR_DB
