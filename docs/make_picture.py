"""Make the pictures of the documents: `python docs/make_picture.py flight WORKSPACE --view 1`,
`orthophoto WORKSPACE`, `mesh WORKSPACE`, `report WORKSPACE`, `viewer WORKSPACE`, or `tiles FOLDER`.

`flight` needs an evaluated workspace, and shows this flight:

    georef simulate survey --images 48 --size 960x720 --seed 3
    georef run WORKSPACE --images survey/images --trajectory survey/trajectory.csv --vertical ellipsoidal \\
        --gcp survey/gcp_list.txt --checkpoints survey/checkpoints.txt \\
        --preset fast --iterations 2500 --max-image-size 720

`orthophoto` needs the rasters and `mesh` the mesh (`--deliver raster,mesh`); they show an orbit that is flown with
`--images 30 --size 640x480 --seed 21` and run likewise. `report` needs the report of any workspace, as that of
`make demo`, and `viewer` any trained one; both need Chromium. `mesh` needs the extras `mesh` and `simulator`.
`tiles` opens a page of `export-tiles --cesium ../Cesium/` with CesiumJS in the folder beside it, as in
docs/deliverables.md. The pictures of docs/real_flights.md are made by examples/flights/real_flights.py.
"""

from __future__ import annotations

import argparse
import threading
import time
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.stages import MESH_GLB
from pipelines.core.workspace import Workspace
from pipelines.report.chromium import NO_NETWORK, chromium_path
from pipelines.view.options import ViewOptions
from pipelines.view.server import served

IMAGES = Path(__file__).parent / "images"
DRAWING = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", NO_NETWORK)
_TILES_ROUNDS = 20
GAP_PX, WIDTH_PX, QUALITY = 12, 1600, 78


def compose(render: Path, accuracy: Path) -> np.ndarray:
    """Return photograph, render and accuracy map side by side, BGR.

    Args:
        render: strip of photograph, render and difference, of equal widths.
        accuracy: map of the predicted accuracy, horizontal on its left half.
    """
    strip, whole_map = cv2.imread(str(render)), cv2.imread(str(accuracy))
    if strip is None or whole_map is None:
        raise SystemExit("no pictures there: run `georef evaluate` on the workspace first")
    height, width = strip.shape[0], strip.shape[1] // 3
    rows, columns = whole_map.shape[:2]
    horizontal = whole_map[round(0.075 * rows) : round(0.905 * rows), : columns // 2]  # without title and legend
    size = (round(horizontal.shape[1] * height / horizontal.shape[0]), height)
    gap = np.full((height, GAP_PX, 3), 255, dtype=np.uint8)
    small = cv2.resize(horizontal, size, interpolation=cv2.INTER_AREA)
    picture = np.hstack([strip[:, :width], gap, strip[:, width : 2 * width], gap, small])
    return sized(picture)


def beside_hillshade(preview: Path, hillshade: Path) -> np.ndarray:
    """Return orthophoto and hillshade side by side on white, BGR, cut to what was seen."""
    parts = []
    for path in (preview, hillshade):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise SystemExit("no pictures there: run `georef export-raster` on the workspace first")
        alpha = image[..., 3:] / 255.0
        parts.append((image[..., :3] * alpha + 255 * (1 - alpha)).round().astype(np.uint8))
        rows, columns = np.nonzero(image[..., 3])
    seen = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    gap = np.full((parts[0][seen].shape[0], GAP_PX, 3), 255, dtype=np.uint8)
    return sized(np.hstack([parts[0][seen], gap, parts[1][seen]]))


def mesh_from_sides(glb: Path) -> np.ndarray:
    """Return a textured mesh from two opposite sides, BGR, shaded by the angle to the view."""
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    scene = trimesh.load_scene(glb)
    (node,) = scene.graph.nodes_geometry
    y_up, name = scene.graph[node]
    shape = scene.geometry[name]
    vertices = trimesh.transform_points(shape.vertices, y_up) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])
    body = trimesh.Trimesh(vertices, shape.faces, process=False)
    texture, rays = np.asarray(shape.visual.material.baseColorTexture.convert("RGB")), RayMeshIntersector(body)
    middle, reach = np.median(vertices, axis=0), float(np.ptp(np.quantile(vertices, [0.05, 0.95], axis=0)[:, :2]))
    width, height, sides = 1200, 840, []
    for azimuth in np.radians([-60.0, 120.0]):
        arm = reach * np.array([0.8 * np.cos(azimuth), 0.8 * np.sin(azimuth), 0.6])
        ahead = -arm / np.linalg.norm(arm)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        across, up = np.meshgrid(np.arange(width) - width / 2, height / 2 - np.arange(height))
        ray = (ahead + (across[..., None] * right + up[..., None] * np.cross(right, ahead)) / width).reshape(-1, 3)
        start = np.tile(middle + arm, (len(ray), 1))
        place, pixel, face = rays.intersects_location(start, ray, multiple_hits=False)
        share = trimesh.triangles.points_to_barycentric(vertices[shape.faces[face]], place)
        uv = np.einsum("nk,nkj->nj", share, shape.visual.uv[shape.faces[face]]) * [1, -1] + [0, 1]
        column, row = (np.clip(uv * texture.shape[1::-1], 0, np.array(texture.shape[1::-1]) - 1)).astype(int).T
        slant = np.abs(np.einsum("ni,ni->n", body.face_normals[face], ray[pixel]))
        picture = np.full((len(ray), 3), 255, dtype=np.uint8)
        shade = 0.6 + 0.4 * slant / np.linalg.norm(ray[pixel], axis=1)
        picture[pixel] = texture[row, column] * shade[:, None]
        sides.append(picture.reshape(height, width, 3)[..., ::-1])
    return sized(np.hstack([sides[0], np.full((height, GAP_PX, 3), 255, dtype=np.uint8), sides[1]]))


def parts_of_report(page: Path) -> np.ndarray:
    """Return the summary of a report, beside its plan and image chips, BGR."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium_path(), args=[NO_NETWORK])
        tab = browser.new_page(viewport={"width": 1120, "height": 1240})
        tab.goto(page.absolute().as_uri())
        shots = [tab.screenshot()]
        shots += [tab.locator(part).first.screenshot() for part in ("#place figure", "#check-points .chips")]
        browser.close()
    summary, plan, chips = (decoded(shot) for shot in shots)
    chips = chips[: summary.shape[0] - plan.shape[0] * chips.shape[1] // plan.shape[1] - GAP_PX]
    plan = cv2.resize(plan, (chips.shape[1], plan.shape[0] * chips.shape[1] // plan.shape[1]))
    gap = np.full((GAP_PX, chips.shape[1], 3), 255, dtype=np.uint8)
    right = np.vstack([plan, gap, chips])[: summary.shape[0]]
    short = np.full((summary.shape[0] - right.shape[0], right.shape[1], 3), 255, dtype=np.uint8)
    between = np.full((summary.shape[0], GAP_PX, 3), 255, dtype=np.uint8)
    return sized(np.hstack([summary, between, np.vstack([right, short])]))


def viewer_pages(workspace: Workspace) -> dict[str, np.ndarray]:
    """Return pages of the viewer, BGR: measuring, marking, and a profile in the dark."""
    from playwright.sync_api import Page, sync_playwright

    pictures = {}

    def settled(page: Page) -> np.ndarray:
        time.sleep(1.0)
        page.wait_for_selector("body[data-drawn=full]", timeout=30_000)
        return sized(decoded(page.screenshot()))

    with served(workspace, ViewOptions()) as server, sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium_path(), args=list(DRAWING))
        page = browser.new_page(viewport={"width": 1280, "height": 760})
        page.goto(f"{server.address}#tab=measure&kind=volume&shown=points,errors,boundary")
        page.wait_for_selector("body[data-ready]", timeout=30_000)
        settled(page)
        for place in ((346, 256), (576, 256), (614, 442), (371, 461)):
            page.mouse.click(*place)
            time.sleep(1.0)
        page.keyboard.press("Enter")
        page.wait_for_selector("#results[data-state=done]", timeout=30_000)
        pictures["viewer"] = settled(page)
        page.select_option("#light", "dark", force=True)
        page.get_by_text("profile", exact=True).click()
        time.sleep(1.0)
        page.mouse.click(317, 458)
        time.sleep(2.0)
        page.mouse.click(590, 510)
        time.sleep(2.0)
        page.keyboard.press("Enter")
        page.wait_for_selector("#results[data-state=done]", timeout=30_000)
        pictures["profile"] = settled(page)
        page.select_option("#light", "light", force=True)
        page.get_by_role("tab", name="Mark").click()
        page.keyboard.press("n")
        page.wait_for_selector("body[data-sheet]", timeout=30_000)
        time.sleep(2.0)
        pictures["marking"] = sized(decoded(page.screenshot()))
        browser.close()
    return pictures


def tiles_page(folder: Path) -> np.ndarray:
    """Return the page of tiles in CesiumJS, BGR."""
    from playwright.sync_api import sync_playwright

    handler = partial(SimpleHTTPRequestHandler, directory=str(folder.absolute().parent))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium_path(), args=list(DRAWING))
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(f"http://127.0.0.1:{server.server_port}/{folder.name}/")
        shot = b""
        for _ in range(_TILES_ROUNDS):  # finer tiles come after coarser ones, and splats are sorted beside
            page.evaluate(
                "async () => { const { tileset } = await georef;"
                " while (!tileset.tilesLoaded) await new Promise((next) => setTimeout(next, 500)); }"
            )
            time.sleep(10.0)
            shot, before = page.screenshot(timeout=120_000), shot
            if shot == before:  # it stands still
                break
        browser.close()
    server.shutdown()
    server.server_close()
    return decoded(shot)


def decoded(png: bytes) -> np.ndarray:
    """Return a picture (H, W, 3), BGR."""
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def sized(picture: np.ndarray) -> np.ndarray:
    """Return a picture at the width of the documents' pictures."""
    scale = WIDTH_PX / picture.shape[1]
    return cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", choices=["flight", "orthophoto", "mesh", "report", "viewer", "tiles"])
    parser.add_argument("workspace", type=Path, help="workspace; for tiles, the folder with index.html")
    parser.add_argument("--view", type=int, default=0, help="number of the test view")
    options = parser.parse_args()
    IMAGES.mkdir(exist_ok=True)
    if options.picture == "viewer":
        for name, shot in viewer_pages(Workspace(options.workspace)).items():
            cv2.imwrite(str(IMAGES / f"{name}.jpg"), shot, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        return
    if options.picture == "report":
        page = options.workspace / "report" / "report.html"
        if not page.exists():
            raise SystemExit("no report there: run `georef report` on the workspace first")
        picture = parts_of_report(page)
    elif options.picture == "tiles":
        picture = sized(tiles_page(options.workspace))
    elif options.picture == "mesh":
        picture = mesh_from_sides(Workspace(options.workspace).path(MESH_GLB))
    elif options.picture == "orthophoto":
        rasters = options.workspace / "raster"
        picture = beside_hillshade(rasters / "preview.png", rasters / "hillshade.png")
    else:
        renders = sorted((options.workspace / "evaluate" / "renders").glob("*.png"))
        if not renders:
            raise SystemExit("no renders there: run `georef evaluate` on the workspace first")
        picture = compose(renders[options.view], options.workspace / "evaluate" / "accuracy.png")
    cv2.imwrite(str(IMAGES / f"{options.picture}.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
