"""Headless Chromium with software rendering and without a network, and what it takes to look at a page with it."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import shutil
import subprocess
import sys
import tarfile
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import Browser, ConsoleMessage, Page, Response, Route, sync_playwright

from pipelines.core.errors import BackendUnavailableError
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.similarity import Similarity
from pipelines.report.chromium import NO_NETWORK, chromium_path

CACHE = Path(__file__).parents[2] / "build/browser"
# WebGL 2 on the CPU: the same on every machine, and no GPU is needed.
FLAGS = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    NO_NETWORK,
)
_FETCHING = threading.Lock()
# CesiumJS rebuilds a changed choice of tiles after up to 30 frames, which software draws one a second at worst.
_PATIENCE_MS = 180_000


class MissingProgramError(Exception):
    """Program that the tests need and that is not there; the message says what to install."""


@dataclass(frozen=True)
class Library:
    """Package of npm, which fetches it once into a folder that git ignores.

    Attributes:
        package: its name.
        version: of the package.
        sha512: hash of the archive that npm publishes.
        part: the package's folder that is served.
    """

    package: str
    version: str
    sha512: str
    part: str

    def folder(self) -> Path:
        """Return the folder of the part that is served.

        Raises:
            MissingProgramError: npm is missing or cannot fetch it.
        """
        folder = CACHE / f"{self.package.rpartition('/')[2]}-{self.version}"
        with _FETCHING:  # the server asks from many threads
            if not folder.is_dir():
                self._fetch(folder)
        return folder

    def _fetch(self, folder: Path) -> None:
        npm, name = shutil.which("npm"), f"{self.package}@{self.version}"
        if npm is None:
            raise MissingProgramError(f"npm is missing, which fetches {name} into {CACHE}: `apt-get install npm`")
        with tempfile.TemporaryDirectory(dir=_made(CACHE)) as draft:
            command = [npm, "pack", "--silent", name]
            done = subprocess.run(command, cwd=draft, capture_output=True, text=True, check=False)
            archive = next(Path(draft).glob("*.tgz"), None)
            if done.returncode != 0 or archive is None:
                raise MissingProgramError(f"npm could not fetch {name}: {done.stderr.strip()}")
            if hashlib.sha512(archive.read_bytes()).hexdigest() != self.sha512:
                raise MissingProgramError(f"npm did not give the published {name}")
            with tarfile.open(archive) as package:
                package.extractall(draft, filter="data")
            (Path(draft) / "package" / self.part).rename(folder)


# By the folder of the server in which they are.
LIBRARIES = {
    "Cesium": Library(
        "cesium",
        "1.145.0",
        "e80ce2c7c6f92cfa68552c7c5d0eb33f3b6996e2559aaf8210edd6dab396c6d7"
        "3a6eb8ba35cf4cbc26212a64d6d4b004c1f8ac57bcb33607ee9425f0f7ce36fa",
        "Build/Cesium",
    ),
    "Babylon": Library(
        "babylonjs",
        "9.35.0",
        "462245a71cd1c77af7da44d4e5fa2dcade15193084ba40db50fa87ca7ffb16ea"
        "21dd18deb83792f74619bbfcba808666209a7c2000024f4ec01bddff721ca7a4",
        ".",
    ),
    "BabylonLoaders": Library(
        "babylonjs-loaders",
        "9.28.0",
        "15d6bbd09da39ff4493385c2b90be4815c0ba8bba8b9f481793890b645418ce3"
        "263b774d01b4b0d4fd35b4c011fc0e04b24d205289bf41626357a8a372c84c87",
        ".",
    ),
    "SuperSplat": Library(
        "@playcanvas/supersplat-viewer",
        "1.36.2",
        "2fbc340656a00289d11d0839aa1683c8107cceb46d894f5082094d53791482ca"
        "87a6890202db9ff63e0fd24c6c51a427eb5159d6a2469112ac3826eb2c20d1d3",
        ".",
    ),
    "PlayCanvasParsers": Library(
        "playcanvas",
        "2.23.3",
        "8630dda39c85b55aff5a60e1e7da51ad3d4b0be45fa6ae155c1f17b7700c07c1"
        "9f5978fd27338cab7c7edc54e6abfd8bda0377eeaf55d4b31968bb98b21ccc5d",
        "scripts/esm/parsers",
    ),
    "Fzstd": Library(
        "fzstd",
        "0.1.1",
        "764b9548e28ac21dde6ace55909cb5016d6f1697adf1303f7c699503992b4e19"
        "7c61c39513ff19228100d7e535bc49f9724c7184b8ab49d63cdfb6b399b68d1c",
        ".",
    ),
    "Three": Library(
        "three",
        "0.187.0",
        "422bbb47e0a687c0acb59b18d6e24e4969d595fa3b66d34b57b985f0996d9372"
        "c1dc0b43bbd71166572744a90093c638cfa28ac37e73ed8ed4addee3598f1eb4",
        ".",
    ),
    "Spark": Library(
        "@sparkjsdev/spark",
        "2.2.0",
        "c1fe45d980263d79e39b6d3f3205d87abf454135f3d89382a34e47c31164683e"
        "c6ba4f6b1d53c8c1d27a7ead2817d304d2178cbd88fe4f14ba0d3aee72fcba28",
        ".",
    ),
    "Fflate": Library(
        "fflate",
        "0.8.2",
        "70f254e3b39a02809b834a41bf3b20a533e19a1a88e5e26387f248bbcb4f8f9a"
        "be4fb88bbd6fc901852a984eca381e11d59c8487305a210a50a5aadd045e73f0",
        ".",
    ),
    "SplatTransform": Library(
        "@playcanvas/splat-transform",
        "3.7.0",
        "aba4f278a6708ce4b15893cefe9cf4525bcd12ecc31e8bdd8a8ef3b8f3a15994"
        "ef5da9fbff5963be10cad6e930f7425c9b010d84c30e27e796500e04e2e6f100",
        ".",
    ),
    "Esbuild": Library(
        "esbuild-wasm",
        "0.28.2",
        "19c715c21bf79a63945501c2426d8ec7fadbcbc9ff12a530bd9c44e8f8df8a4a"
        "eafe55b0f60f565ffbbd1329169e9a2ddcaa3a8f8dba0e041d79adb158a20040",
        ".",
    ),
}


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on loopback, with each of `LIBRARIES` in a folder of its name; gives its address.

    The server is that of `python -m http.server --bind 127.0.0.1`.
    """

    class Handler(SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            first, _, rest = path.removeprefix("/").partition("/")
            library = LIBRARIES.get(first)
            self.directory = str(library.folder() if library else folder)
            return super().translate_path(f"/{rest}" if library else path)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextlib.contextmanager
def chromium() -> Iterator[Browser]:
    """Start headless Chromium."""
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium_path(), args=list(FLAGS))
        yield browser
        browser.close()


@dataclass
class Viewer:
    """Open page, with all that went wrong in it.

    Attributes:
        page: of the browser.
        problems: errors of scripts and on the console, failed tiles and requests.
        outside: addresses beyond this machine that were asked for; all were refused.
    """

    page: Page
    problems: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)

    def show(self, address: str) -> None:
        """Load the page."""
        page = self.page
        page.on("pageerror", lambda error: self.problems.append(f"script: {error}"))
        page.on("console", self._heard)
        page.on("requestfailed", lambda request: self.problems.append(f"request: {request.url}"))
        page.on("response", self._answered)
        page.route("**/*", self._loopback_only)
        page.goto(address, timeout=_PATIENCE_MS)  # the first load may fetch a library by npm

    def open(self, address: str) -> None:
        """Load the page, and wait until it has opened the tileset."""
        self.show(address)
        self.page.evaluate(
            """async () => {
                const { tileset } = await georef;
                window.failedTiles = [];
                tileset.tileFailed.addEventListener(({ url, message }) => failedTiles.push(`${url}: ${message}`));
            }"""
        )

    def hide_labels(self) -> None:
        """Hide the labels of the surveyed points, which no splat shows."""
        for box in self.page.locator("#kinds input").all():
            box.uncheck()

    def _heard(self, line: ConsoleMessage) -> None:
        if line.type == "error":
            self.problems.append(f"console: {line.text}")

    def _answered(self, response: Response) -> None:
        if response.status >= 400:
            self.problems.append(f"{response.status}: {response.url}")

    def _loopback_only(self, route: Route) -> None:
        if route.request.url.startswith(("http://127.0.0.1:", "data:", "blob:")):
            route.continue_()
            return
        self.outside.append(route.request.url)
        route.abort()

    def failed_tiles(self) -> list[str]:
        """Return the tiles that could not be loaded."""
        return list(self.page.evaluate("failedTiles"))

    def stand(self, ecef_from_cam: Similarity, camera: Pinhole) -> None:
        """Put Cesium's camera where a pinhole camera is; the principal point must be in the middle.

        Args:
            ecef_from_cam: its pose; the camera's axes are x right, y down, z forward.
            camera: of the view's size.
        """
        assert (camera.cx, camera.cy) == (camera.width / 2, camera.height / 2) and camera.fx == camera.fy
        longer = max(camera.width, camera.height)
        self.page.set_viewport_size({"width": camera.width, "height": camera.height})
        self.page.evaluate(
            """async ({ position, direction, up, fov }) => {
                const { widget } = await georef;
                const vector = (values) => Cesium.Cartesian3.fromArray(values);
                widget.resize();
                widget.camera.frustum.fov = fov;
                widget.camera.setView({
                    destination: vector(position), orientation: { direction: vector(direction), up: vector(up) },
                });
            }""",
            {
                "position": ecef_from_cam.translation.tolist(),
                "direction": ecef_from_cam.rotation[:, 2].tolist(),
                "up": (-ecef_from_cam.rotation[:, 1]).tolist(),
                "fov": 2 * float(np.arctan(longer / 2 / camera.fx)),
            },
        )
        self.settle()

    def settle(self) -> None:
        """Wait until the tiles of the view are loaded, their splats are sorted, and the picture stands still."""
        self.page.evaluate(
            """async (patience) => {
                const { widget, tileset } = await georef;
                const end = performance.now() + patience;
                let before, state, still = 0;
                while (still < 3) {
                    if (performance.now() > end) throw new Error(`the view does not come to rest: ${state}`);
                    await new Promise(requestAnimationFrame);
                    const splats = tileset.gaussianSplatPrimitive;
                    const drawn = tileset._selectedTiles.reduce((sum, tile) => sum + tile.content.pointsLength, 0);
                    const idle = tileset.tilesLoaded && drawn > 0 && splats.isStable && splats._numSplats === drawn
                        && !splats._needsSnapshotRebuild && splats._sorterState === 0;  // 0: IDLE
                    state = `${tileset.tilesLoaded} ${drawn} ${splats?._numSplats} ${splats?._sorterState}`;
                    widget.render();
                    const now = idle ? widget.canvas.toDataURL() : undefined;
                    still = now !== undefined && now === before ? still + 1 : 0;
                    before = now;
                }
            }""",
            _PATIENCE_MS,
        )

    def splats(self) -> int:
        """Return the number of splats in the tiles of the view."""
        count = (
            "async () => (await georef).tileset._selectedTiles.reduce((sum, t) => sum + t.content.pointsLength, 0)"
        )
        return int(self.page.evaluate(count))

    def picture(self) -> np.ndarray:
        """Return the drawn scene (H, W, 3) without the page's panels, RGB in 0 … 1."""
        data = self.page.evaluate(
            "async () => { const { widget } = await georef; widget.render(); return widget.canvas.toDataURL(); }"
        )
        png = np.frombuffer(base64.b64decode(data.partition(",")[2]), np.uint8)
        pixels = cv2.imdecode(png, cv2.IMREAD_COLOR)
        assert pixels is not None
        return pixels[..., ::-1] / 255.0


if __name__ == "__main__":
    try:
        print(", ".join(map(str, [chromium_path(), *(library.folder() for library in LIBRARIES.values())])))
    except (MissingProgramError, BackendUnavailableError) as error:
        sys.exit(f"browser tests: {error}")
