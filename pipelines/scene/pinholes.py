"""The cameras of the undistorted photographs, with the lens as it has become."""

from __future__ import annotations

from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.lens import Lenses, refit_pinhole
from pipelines.scene.photographs import ImageCache


class Pinholes:
    """By image, the pinhole that maps a photograph's true rays to where the undistorted photograph shows them.

    Photographs are undistorted once, with SfM's lens. Another lens is another pinhole (`geometry.lens`).

    Args:
        images: the undistorted photographs.
        sfm: the lenses that they were undistorted with; None: these stay.
    """

    def __init__(self, images: ImageCache, sfm: Lenses | None = None) -> None:
        self._images, self._sfm, self._now = images, sfm, sfm
        self._fitted: dict[int, Pinhole] = {}

    def renew(self, now: Lenses) -> None:
        """Take over other lenses of the same images."""
        self._now = now
        self._fitted.clear()

    def of(self, index: int) -> Pinhole:
        """Camera of an image, at the size of the undistorted photographs."""
        if self._sfm is None or self._now is None:
            return self._images.pinhole(index)
        key = int(self._sfm.camera_id[index])  # photographs of one camera have one pinhole
        if key not in self._fitted:
            before, after = self._sfm.of(index), self._now.of(index)
            self._fitted[key] = refit_pinhole(self._images.pinhole(index), before, after)
        return self._fitted[key]
