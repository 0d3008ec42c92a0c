"""Loop that draws the picture of one page: small while its camera moves, at full size when it stands."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pipelines.core.errors import GeorefError
from pipelines.view.pictures import Blend, Painter, Picture
from pipelines.view.view_frame import ViewerCamera

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

_MOVING_S = 0.12  # of drawing one picture while the camera moves
_STILL_S = 0.2  # without movement until the full picture is drawn
_LEAST_PX, _MOST_PX = 160, 1920  # of the longer side
_DEPTH_PX = 480  # of the longer side of the depth: it only decides which signs are hidden
_QUALITY_MOVING, _QUALITY_STILL = 70, 95  # of the JPEG


class PictureLoop:
    """Loop of one page, on a thread of its own.

    Args:
        client: the page.
        painter: of the pictures.
        blend: returns the photograph to blend over the picture, or None.
    """

    def __init__(self, client: viser.ClientHandle, painter: Painter, blend: Callable[[], Blend | None]) -> None:
        self._client, self._painter, self._blend = client, painter, blend
        self._changed, self._ended = threading.Event(), threading.Event()
        self._moving_px = 480.0
        self.drawn = 0  # pictures at full size
        self._thread = threading.Thread(target=self._run, daemon=True)
        client.camera.on_update(lambda _: self.wake())
        self._thread.start()
        self.wake()

    def wake(self) -> None:
        """Draw anew."""
        self._changed.set()

    def end(self) -> None:
        """End the loop."""
        self._ended.set()
        self._changed.set()

    def _run(self) -> None:
        first = True
        while True:
            self._changed.wait()
            if self._ended.is_set():
                return
            self._changed.clear()
            try:
                if not first:
                    self._draw_moving()
                if first or not self._changed.wait(_STILL_S):
                    self._draw(_MOST_PX, _QUALITY_STILL)
                    self.drawn += 1
                first = False
            except GeorefError as error:
                self._client.add_notification("No picture", str(error), color="red")
            except Exception:  # the page is gone, or the picture cannot be drawn: the next one may
                if self._ended.is_set():
                    return
                log.exception("the picture could not be drawn")

    def _draw_moving(self) -> None:
        began = time.monotonic()
        self._draw(int(self._moving_px), _QUALITY_MOVING)
        factor = np.sqrt(_MOVING_S / max(time.monotonic() - began, 1e-3))
        self._moving_px = float(np.clip(self._moving_px * np.clip(factor, 0.5, 1.3), _LEAST_PX, _MOST_PX))

    def _draw(self, longer_px: int, quality: int) -> None:
        camera = camera_of(self._client)
        if camera is None:
            return
        scale = min(1.0, longer_px / max(camera.width, camera.height))
        width, height = max(round(camera.width * scale), 1), max(round(camera.height * scale), 1)
        picture = self._painter.paint(camera, width, height, self._blend())
        self._client.scene.set_background_image(
            picture.rgb, format="jpeg", jpeg_quality=quality, depth=_small_depth(picture)
        )
        self._client.flush()


def camera_of(client: viser.ClientHandle) -> ViewerCamera | None:
    """Return the camera of a page; None before the page has told it."""
    handle = client.camera
    if handle._state.update_timestamp == 0.0 or not handle.image_width or not handle.image_height:
        return None
    return ViewerCamera(
        np.array(handle.wxyz), np.array(handle.position), float(handle.fov), handle.image_width, handle.image_height
    )


def _small_depth(picture: Picture) -> np.ndarray:
    height, width = picture.depth.shape
    scale = min(1.0, _DEPTH_PX / max(width, height))
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    return cv2.resize(picture.depth, size, interpolation=cv2.INTER_NEAREST)
