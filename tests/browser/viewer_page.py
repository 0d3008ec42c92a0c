"""The viewer's page in Chromium, worked in by mouse and keys."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from urllib.parse import parse_qs, urlparse

import numpy as np
from playwright.sync_api import Browser, Locator, Page, Route

from pipelines.view.requests import CameraRequest
from pipelines.view.server import ViewerServer

SIZE = {"width": 1280, "height": 800}
PATIENCE_MS = 60_000


@dataclass
class Opened:
    """Page of a viewer; `outside` are addresses beyond this machine that were asked for, `problems` its errors."""

    server: ViewerServer
    page: Page
    outside: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def go(self, fragment: str = "") -> None:
        """Open the page, and wait for a full picture."""
        self.page.goto(self.server.address + fragment)
        self.page.wait_for_selector("body[data-ready]", timeout=PATIENCE_MS)
        self.settle()

    def settle(self) -> None:
        """Wait until the picture stands."""
        time.sleep(0.3)
        self.page.wait_for_selector("body[data-drawn=full]", timeout=PATIENCE_MS)

    def camera(self) -> CameraRequest:
        """Return the camera that the address tells, on its own way: heading, pitch and distance of a target."""
        given = parse_qs(urlparse(self.page.url).fragment)["view"][0].split(",")
        x, y, z, distance, heading, pitch, fov = map(float, given)
        h, p = np.radians([heading, pitch])
        forward = np.array([np.cos(p) * np.sin(h), np.cos(p) * np.cos(h), -np.sin(p)])
        right = np.array([np.cos(h), -np.sin(h), 0.0])
        rotation = np.stack([right, np.cross(forward, right), forward])
        box = self.page.locator("#overlay").bounding_box()
        assert box is not None
        return CameraRequest.model_validate(
            {
                "rotation": rotation.ravel().tolist(),
                "position": (np.array([x, y, z]) - distance * forward).tolist(),
                "fov": fov,
                "width": round(box["width"]),
                "height": round(box["height"]),
            }
        )

    def pixel(self, point_in_geo: np.ndarray) -> tuple[float, float]:
        """Return where a point is on the page."""
        camera = self.camera().camera()
        place = self.server.viewer.frame.from_geo(np.asarray(point_in_geo, dtype=float))
        x, y = camera.pinhole().project(camera.rotation @ (place - camera.position))
        return float(x), float(y)

    def click(self, point_in_geo: np.ndarray, **options: int) -> None:
        self.page.mouse.click(*self.pixel(point_in_geo), **options)  # type: ignore[arg-type]

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def press(self, label: str) -> None:
        self.page.get_by_role("button", name=label, exact=True).locator("visible=true").first.click()

    def measured(self) -> list[np.ndarray]:
        """Return the measured points (3,) in `geo` that the page shows."""
        texts = self.page.evaluate(
            "() => [...document.querySelectorAll('[data-measured]')].map((row) => row.dataset.measured)"
        )
        return [np.array([float(value) for value in text.split(",")]) for text in texts]

    def begin(self, kind: str) -> None:
        """Begin a measurement of a kind."""
        self.tab("Measure")
        self.page.get_by_text(kind, exact=True).locator("visible=true").first.click()
        if not self.page.locator("#clear").is_disabled():
            self.press("New (Esc)")
        wait(lambda: not self.measured())

    def click_all(self, points: list[np.ndarray]) -> None:
        before = len(self.measured())
        for number, point in enumerate(points, start=1):
            self.click(point)
            wait(lambda: len(self.measured()) == before + number)  # noqa: B023

    def quantity(self, name: str) -> tuple[float, float]:
        row = self.page.locator(f'[data-quantity="{name}"]')
        return float(str(row.get_attribute("data-value"))), float(str(row.get_attribute("data-sigma")))

    def done(self) -> None:
        self.page.wait_for_selector("#results[data-state=done]", timeout=PATIENCE_MS)

    def save(self, name: str) -> None:
        self.page.fill("#save-name", name)
        self.press("Save")

    @property
    def saved(self) -> Locator:
        return self.page.locator("[data-saved]")

    def come_close(self, point_name: str) -> str:
        """Show the next photograph of a point, and come close to the blue cross; return the photograph's name."""
        self.tab("Mark")
        self.page.select_option("#points", point_name)
        self.page.keyboard.press("n")
        self.page.wait_for_selector("body[data-sheet]", timeout=PATIENCE_MS)
        time.sleep(1.0)
        return str(self.page.locator("#mark-hint").text_content()).removeprefix("Shown: ").partition(". ")[0]


def wait(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_MS / 1000
    while not holds():
        assert time.monotonic() < end, "the page does not get there"
        time.sleep(0.05)


def opened(server: ViewerServer, browser: Browser, size: dict[str, int] = SIZE, **options: str) -> Opened:
    page = browser.new_page(viewport=size, **options)  # type: ignore[arg-type]
    view = Opened(server, page)

    def loopback_only(route: Route) -> None:
        if route.request.url.startswith((f"http://127.0.0.1:{server.port}/", "data:", "blob:")):
            route.continue_()
            return
        view.outside.append(route.request.url)
        route.abort()

    page.route("**/*", loopback_only)
    page.on("pageerror", lambda error: view.problems.append(str(error)))
    page.on("console", lambda line: view.problems.append(line.text) if line.type == "error" else None)
    view.go()
    return view
