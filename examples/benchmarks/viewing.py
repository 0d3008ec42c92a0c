"""Time the viewer of a large model: python examples/benchmarks/viewing.py WORKSPACE.

The workspace is copied, and its Gaussians are split into many small ones that show the same scene. First without a
browser: the time until the viewer could send its first pictures, and until it has answered clicks. Then in headless
Chromium, whose software rendering takes the same cores all the time: from the start of `georef view` until the page
shows a picture, and from clicks until the page shows the measured point. Needs Chromium and the extra `dev`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from playwright.sync_api import Page, sync_playwright

from pipelines.core.stages import GAUSSIANS, MODEL, STAGES
from pipelines.core.workspace import Workspace
from pipelines.report.chromium import chromium_path
from pipelines.splat.gaussians import Gaussians, read_gaussians, write_gaussians
from pipelines.view.loopback import start_server, stop_server
from pipelines.view.options import ViewOptions
from pipelines.view.pictures import ViewerCamera
from pipelines.view.viewer import Viewer
from tests.browser.chromium import FLAGS

_SIZE = {"width": 1280, "height": 800}
_SOUTH_WXYZ = np.array([-0.4178568, 0.9085129, 0.0, 0.0])  # looking down on the scene from the south
_PANEL_PX = 420
_LEAST_CONTRAST = 20.0  # standard deviation of a picture, of 255


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


def wait_for_picture(page: Page, patience_s: float = 120.0) -> None:
    """Wait until the page shows a picture."""
    end = time.perf_counter() + patience_s
    clip = {"x": 0, "y": 200, "width": _SIZE["width"] - _PANEL_PX, "height": 500}
    while time.perf_counter() < end:
        png = page.screenshot(clip=clip)  # type: ignore[arg-type]
        picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
        if picture is not None and picture.std() > _LEAST_CONTRAST:
            return
    raise TimeoutError("the page shows no picture")


def clicked_s(page: Page, x: float, y: float) -> float | None:
    """Return the time from a click to the answer; None: nothing was measured."""
    shown = "() => document.querySelector('[data-measured]')?.getAttribute('data-measured') ?? ''"
    before = page.evaluate(shown)
    began = time.perf_counter()
    page.mouse.click(x, y)
    while time.perf_counter() < began + 3:
        if page.evaluate(shown) not in ("", before):
            return time.perf_counter() - began
    return None


def time_server(workspace: Workspace, clicks: int) -> None:
    """Print the times of the viewer's own work, without a browser."""
    began = time.perf_counter()
    server, _ = start_server(8080, "benchmark")
    viewer = Viewer(server, workspace, ViewOptions())
    camera = ViewerCamera(_SOUTH_WXYZ, np.array([0.0, -14.0, 12.0]), 0.9, _SIZE["width"], _SIZE["height"])
    times = [time.perf_counter()]
    for width, height in ((480, 300), (1280, 800)):
        viewer.painter.paint(camera, width, height)
        times.append(time.perf_counter())
    made, coarse, full = (each - began for each in times)
    print(f"without a browser: read after {made:.1f} s, coarse picture {coarse:.1f} s, full picture {full:.1f} s")
    viewer.click_mode.value = "measures"  # type: ignore[misc]
    taken = []
    pinhole = camera.pinhole(camera.width, camera.height)
    for x, y in np.random.default_rng(0).uniform([400, 250], [900, 600], (clicks, 2)):
        direction = camera.rotation @ pinhole.rays([x, y])
        sight = viewer.frame.sight(camera, camera.position, direction / np.linalg.norm(direction))
        start = time.perf_counter()
        viewer.measuring.add_sight(sight)
        taken.append(time.perf_counter() - start)
    print(
        f"without a browser: click answered in {np.median(taken):.3f} s, slowest {np.max(taken):.3f} s", flush=True
    )
    viewer.close()
    stop_server(server)


def time_viewer(process: subprocess.Popen[str], page: Page, began: float, clicks: int) -> None:
    """Print the times of a viewer that was started at `began`."""
    assert process.stdout is not None
    address = ""
    while '"address"' not in address:
        address += process.stdout.readline()
    served = time.perf_counter()
    page.goto(address.split('"')[3])
    wait_for_picture(page)
    print(f"served after {served - began:.1f} s, picture after {time.perf_counter() - began:.1f} s", flush=True)
    page.locator("input[aria-haspopup]:visible").first.click()
    page.get_by_role("option", name="measures").click()
    page.get_by_role("tab", name="Measure").click()
    time.sleep(30)  # σ are computed beside the first pictures
    places = np.random.default_rng(0).uniform([250, 250], [650, 600], (clicks, 2))
    taken = [each for x, y in places if (each := clicked_s(page, x, y)) is not None]
    median, slowest = float(np.median(taken)), float(np.max(taken))
    print(f"{len(taken)} of {clicks} clicks measured: median {median:.3f} s, slowest {slowest:.3f} s")


def main() -> None:
    """Print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--clicks", type=int, default=30)
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
        time_server(Workspace(copy), args.clicks)
        browser = driver.chromium.launch(executable_path=chromium_path(), args=list(FLAGS))
        page = browser.new_page(viewport=_SIZE)  # type: ignore[arg-type]
        command = [
            sys.executable,
            "-c",
            "from georef_cli.main import main; main()",
            "-q",
            "view",
            str(copy),
            "--json",
        ]
        began = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                time_viewer(process, page, began, args.clicks)
            finally:
                process.terminate()
        browser.close()


if __name__ == "__main__":
    main()
