"""Time the viewer of a large model: python examples/benchmarks/viewing.py WORKSPACE.

The workspace is copied, and its Gaussians are split into many small ones that show the same scene. Then: the time
from the start until a page in headless Chromium shows its first picture; pictures a second while the mouse turns
the whole scene, with the coarser models of motion and with the trained model alone; and, without the page, the time
of pictures, clicks, and the volume over 1 000 m² in the middle of the scene. Needs Chromium and the extra `dev`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from playwright.sync_api import Page, sync_playwright

from pipelines.core.stages import GAUSSIANS, MODEL, STAGES
from pipelines.core.workspace import Workspace
from pipelines.report.chromium import chromium_path
from pipelines.splat.gaussians import Gaussians, read_gaussians, write_gaussians
from pipelines.surface.picking import Sight, SurfacePoint
from pipelines.view.measuring import ESTIMATE, Fineness, WantedBase
from pipelines.view.motion import MotionModels
from pipelines.view.options import ViewOptions
from pipelines.view.pictures import ViewerCamera, ViewFrame, Wanted
from pipelines.view.server import served
from pipelines.view.viewer import Viewer
from tests.browser.chromium import FLAGS

_SIZE = {"width": 1280, "height": 800}


def split(gaussians: Gaussians, count: int) -> Gaussians:
    """Return at least `count` Gaussians: each as several smaller ones, spread over it."""
    parts = -(-count // len(gaussians))
    rng = torch.Generator().manual_seed(0)
    rows = torch.arange(len(gaussians)).repeat_interleave(parts)
    many = gaussians.select(rows)
    w, x, y, z = torch.nn.functional.normalize(many.quats_wxyz, dim=1).unbind(1)
    local = torch.randn(len(rows), 3, generator=rng) * torch.exp(many.log_scales) * 0.8
    axis = torch.stack([x, y, z], dim=1)
    turned = local + 2 * torch.cross(axis, torch.cross(axis, local, dim=1) + w[:, None] * local, dim=1)
    many.means = many.means + turned
    many.log_scales = many.log_scales - float(np.log(parts)) / 2
    return many


def pages_camera(frame: ViewFrame) -> ViewerCamera:
    """Return the camera of a page that was just opened: from the south, looking down on the whole scene."""
    pitch = np.radians(42.0)
    forward = np.array([0.0, np.cos(pitch), -np.sin(pitch)])
    rotation = np.stack([[1.0, 0.0, 0.0], np.cross(forward, [1.0, 0.0, 0.0]), forward])
    return ViewerCamera(rotation, -1.7 * frame.radius_m * forward, 0.9, _SIZE["width"], _SIZE["height"])


_COUNTED = """() => {
    window.widths = [];
    const drawImage = CanvasRenderingContext2D.prototype.drawImage;
    CanvasRenderingContext2D.prototype.drawImage = function (...given) {
        if (this.canvas.id === "picture") widths.push(this.canvas.width);
        return drawImage.apply(this, given);
    };
}"""


def time_motion(page: Page, viewer: Viewer, seconds: float) -> None:
    """Print how many pictures a second a page shows of the whole scene while the mouse turns it."""
    viewer._sorting.join()
    page.keyboard.press("h")
    page.evaluate(_COUNTED)
    made = viewer._painter._motion
    assert made is not None
    for name, motion in (("coarser models", made), ("trained model alone", MotionModels(made._models[0]))):
        viewer._painter._motion = motion
        page.mouse.move(600, 400)
        page.mouse.down()
        for lasts in (3.0, seconds):  # the first adapts the size of the pictures
            began, step = time.perf_counter(), 0
            page.evaluate("() => { widths.length = 0; }")
            while time.perf_counter() - began < lasts:
                page.mouse.move(600 + 120 * np.sin(step / 20), 400 + 20 * np.cos(step / 20))
                step += 1
                time.sleep(0.02)
        page.mouse.up()
        widths = page.evaluate("widths")
        taken = time.perf_counter() - began
        wide = f"{np.median(widths):.0f} pixels wide" if widths else "none"
        print(f"moving, {name}: {len(widths) / taken:.1f} pictures/s, {wide}; load {os.getloadavg()[0]:.1f}")
        page.wait_for_selector("body[data-drawn=full]", timeout=120_000)
    viewer._painter._motion = made


def time_answers(viewer: Viewer, clicks: int) -> None:
    """Print the times of pictures, clicks, and a volume of 1 000 m²."""
    camera = pages_camera(viewer.frame)
    for width, height in ((480, 300), (1280, 800)):
        start = time.perf_counter()
        viewer._painter.paint(replace(camera, width=width, height=height), Wanted())
        print(f"picture of {width}x{height}: {time.perf_counter() - start:.2f} s")
    taken, reader = [], viewer.model.reader
    for x, y in np.random.default_rng(0).uniform([400, 250], [900, 600], (clicks, 2)):
        start = time.perf_counter()
        reader.under(viewer.frame.sight(camera, x, y))
        taken.append(time.perf_counter() - start)
    print(f"click: median {np.median(taken):.3f} s, slowest {np.max(taken):.3f} s")
    down = np.array([0.0, 0.0, -1.0])
    middle, half = viewer.frame.middle_in_geo, np.sqrt(1000.0) / 2
    model_from_geo = viewer.solution.similarity.inverse()
    corners = []
    for x, y in ((-half, -half), (half, -half), (half, half), (-half, half)):
        start_at = middle + np.array([x, y, 2 * viewer.frame.radius_m])
        point = reader.under(Sight(model_from_geo.apply(start_at[None])[0], model_from_geo.rotation @ down, 1e-3))
        assert isinstance(point, SurfacePoint), "the middle of the scene has no surface: give another workspace"
        corners.append(point)
    for name, fineness in (("first estimate", ESTIMATE), ("result", Fineness())):
        start = time.perf_counter()
        found = viewer.model.volume(corners, WantedBase(), fineness)
        volume = next(each for each in found if each.name == "volume")
        print(f"volume of 1000 m², {name}: {time.perf_counter() - start:.2f} s, {volume.value:.1f} m³")


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--clicks", type=int, default=30)
    parser.add_argument("--seconds", type=float, default=20.0, help="of each motion")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as place, sync_playwright() as driver:
        copy = Path(place) / "large"
        folders = {spec.folder for spec in STAGES} & {"ingest", "sfm", "calibrate", "geolocate", "sim3", "train"}
        for name in sorted(folders):
            if (args.workspace / name).exists():
                shutil.copytree(args.workspace / name, copy / name, ignore=shutil.ignore_patterns("checkpoint.npz"))
        for name in ("requests.json", "georef.toml"):
            if (args.workspace / name).exists():
                shutil.copy(args.workspace / name, copy)
        many = split(read_gaussians(args.workspace / GAUSSIANS), args.gaussians)
        write_gaussians(copy / GAUSSIANS, many)
        document = json.loads((copy / MODEL).read_text("utf-8"))
        (copy / MODEL).write_text(json.dumps({**document, "gaussians": len(many)}), "utf-8")
        print(f"{len(many):,} Gaussians", flush=True)
        began = time.perf_counter()
        with served(Workspace(copy), ViewOptions()) as server:
            print(f"read and served after {time.perf_counter() - began:.1f} s")
            browser = driver.chromium.launch(executable_path=chromium_path(), args=list(FLAGS))
            page = browser.new_page(viewport=_SIZE)  # type: ignore[arg-type]
            page.goto(server.address)
            page.wait_for_selector("body[data-drawn]", timeout=120_000)
            print(f"first picture in the page after {time.perf_counter() - began:.1f} s")
            time_motion(page, server.viewer, args.seconds)
            browser.close()
            time_answers(server.viewer, args.clicks)


if __name__ == "__main__":
    main()
