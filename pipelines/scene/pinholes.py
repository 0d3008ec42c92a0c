"""Cameras of the undistorted photographs under a lens that has changed since."""

from __future__ import annotations

from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.lens import Lenses, refit_pinhole
from pipelines.scene.photographs import ImageCache


class Pinholes:
    """Pinhole of each image, which maps the rays of the present lens to pixels of the undistorted photograph.

    Photographs are undistorted once, with SfM's lens. A change of the lens is expressed as another pinhole
    (`geometry.lens`).

    Args:
        images: the undistorted photographs.
        sfm: the lenses with which they were undistorted; None: the lenses never change.
    """

    def __init__(self, images: ImageCache, sfm: Lenses | None = None) -> None:
        self._images, self._sfm, self._now = images, sfm, sfm
        self._fitted: dict[int, Pinhole] = {}

    def renew(self, now: Lenses) -> None:
        """Set the present lenses of the images."""
        self._now = now
        self._fitted.clear()

    def of(self, index: int) -> Pinhole:
        """Return the camera of an image, at the size of the undistorted photographs."""
        if self._sfm is None or self._now is None:
            return self._images.pinhole(index)
        key = int(self._sfm.camera_id[index])  # Photographs of one camera share a pinhole.
        if key not in self._fitted:
            before, after = self._sfm.of(index), self._now.of(index)
            self._fitted[key] = refit_pinhole(self._images.pinhole(index), before, after)
        return self._fitted[key]
