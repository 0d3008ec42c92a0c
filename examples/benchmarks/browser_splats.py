"""Time Gaussians drawn by the browser itself: python examples/benchmarks/browser_splats.py WORKSPACE.

The renderer is Spark on three.js, from npm, with the blending cut-offs, the dilation and the depth order of ours,
in headless Chromium with SwiftShader. Its picture is compared with the viewer's, unless the Gaussians are split.
Needs Chromium, npm and the extra `dev`.
"""

from __future__ import annotations

import argparse
import base64
import os
import tempfile
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Page
from viewing import pages_camera, split

from pipelines.core.workspace import Workspace
from pipelines.deliver.splat import codec_arrays
from pipelines.formats.spz import write_spz
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians, transformed
from pipelines.surface.surface_views import model_renderer
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_trained
from pipelines.view.pictures import Painter, Photographs, ViewerCamera, Wanted, frame_of
from tests.browser.chromium import chromium, served

_PAGE = """<!doctype html><link rel="icon" href="data:,"><canvas id="canvas"></canvas>
<script type="importmap">{"imports": {"three": "./Three/build/three.module.js",
    "three/addons/": "./Three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "./Spark/dist/spark.module.js";
THREE.ColorManagement.enabled = false;
const canvas = document.getElementById("canvas");
const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
const gl = renderer.getContext(), names = gl.getExtension("WEBGL_debug_renderer_info");
window.card = gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
scene.add(new SparkRenderer({ renderer, preBlurAmount: 0.3, blurAmount: 0, sortRadial: false, accumExtSplats: true,
    maxStdDev: Math.sqrt(2 * Math.log(255)), minAlpha: 1 / 255, maxPixelRadius: 4096 }));
const fileBytes = new Uint8Array(await (await fetch("splat.spz")).arrayBuffer());
const mesh = new SplatMesh({ fileBytes, fileType: "spz", extSplats: true });
await mesh.initialized;
scene.add(mesh);
window.draw = async ({ rotation: r, position: p, fov, width, height }) => {
    const began = performance.now();
    renderer.setSize(width, height, false);
    Object.assign(camera, { fov: fov * 180 / Math.PI, aspect: width / height, near: 0.1, far: 1e5 });
    camera.matrixAutoUpdate = false;
    camera.updateProjectionMatrix();
    camera.matrix.set(r[0], -r[3], -r[6], p[0], r[1], -r[4], -r[7], p[1], r[2], -r[5], -r[8], p[2], 0, 0, 0, 1);
    camera.updateMatrixWorld(true);
    renderer.render(scene, camera);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));  // waits for the picture
    await new Promise(requestAnimationFrame);
    return performance.now() - began;
};
window.ready = true;
</script>"""


def request_of(camera: ViewerCamera) -> dict[str, object]:
    return {
        "rotation": camera.rotation.ravel().tolist(),
        "position": camera.position.tolist(),
        "fov": camera.fov_rad,
        "width": camera.width,
        "height": camera.height,
    }


def drawn(page: Page, camera: ViewerCamera) -> np.ndarray:
    """Return the browser's picture (H, W, 3) of a camera, RGB in 0 … 1, when its Gaussians are sorted."""
    for _ in range(4):
        page.evaluate("draw", request_of(camera))
        page.wait_for_timeout(2000)
    data = page.evaluate("document.getElementById('canvas').toDataURL()")
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(data.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    return pixels[..., ::-1] / 255.0


def turned(camera: ViewerCamera, degrees: float) -> ViewerCamera:
    """Return a camera that has gone around the middle of the scene."""
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    about = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    return ViewerCamera(
        camera.rotation @ about.T, about @ camera.position, camera.fov_rad, camera.width, camera.height
    )


def main() -> None:
    """Print the times and the PSNR."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--gaussians", type=int, default=0, help="split to at least so many")
    parser.add_argument("--size", default="480x300")
    parser.add_argument("--pictures", type=int, default=3)
    args = parser.parse_args()
    workspace = Workspace(args.workspace)
    model = read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    renderer = model_renderer(workspace, model, sfm, survey, backend="cpu")
    frame = frame_of(model, sfm)
    gaussians: Gaussians = renderer.gaussians
    if args.gaussians > len(gaussians):
        gaussians = split(gaussians, args.gaussians)
    first = pages_camera(frame)
    width, height = map(int, args.size.split("x"))
    camera = ViewerCamera(first.rotation, first.position, first.fov_rad, width, height)
    with tempfile.TemporaryDirectory() as place, chromium() as browser:
        view_from_model: Similarity = frame.view_from_model
        write_spz(Path(place) / "splat.spz", codec_arrays(transformed(gaussians, view_from_model)))
        (Path(place) / "index.html").write_text(_PAGE, "utf-8")
        with served(Path(place)) as root:
            page = browser.new_page(viewport={"width": max(width, 64), "height": max(height, 64)})
            page.on("pageerror", lambda error: print(f"script: {error}"))
            page.set_default_timeout(600_000)
            page.goto(root)
            page.wait_for_function("window.ready")
            print(f"{len(gaussians):,} Gaussians, {args.size}, {page.evaluate('card')}", flush=True)
            shown = drawn(page, camera)
            times = [page.evaluate("draw", request_of(turned(camera, 5.0 * (k + 1)))) for k in range(args.pictures)]
            print(
                f"a picture by the browser: median {np.median(times) / 1000:.2f} s; load {os.getloadavg()[0]:.1f}"
            )
    if gaussians is renderer.gaussians:
        painter = Painter(renderer, Photographs(workspace, survey, renderer.sparse), frame, None)
        ours = painter.paint(camera, Wanted()).rgb / 255.0
        print(f"PSNR against the viewer's picture: {-10 * np.log10(np.mean((shown - ours) ** 2)):.1f} dB")


if __name__ == "__main__":
    main()
