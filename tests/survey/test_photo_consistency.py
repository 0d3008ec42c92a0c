"""Where renders show their photographs: blurred parts are rejected, whatever the exposure; plain ones are not."""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.surface.surface_views import photo_consistent

HALF = 60


def photograph() -> np.ndarray:
    """Return a photograph with texture of 3 px (RGB), its right half plain but for noise of one grey level."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(40, 200, (30, 40, 1)).astype(np.float32)
    image = cv2.resize(coarse, (2 * HALF, 90), interpolation=cv2.INTER_CUBIC)[..., None].repeat(3, axis=2)
    image[:, HALF:] = 120 + rng.normal(0, 1, (90, HALF, 1))
    return np.clip(image, 0, 255).astype(np.uint8)


def test_exposure_has_no_influence() -> None:
    photo = photograph()
    assert photo_consistent(photo, photo).all()
    assert photo_consistent(np.clip(0.8 * photo + 30.0, 0, 255).astype(np.uint8), photo).all()


def test_blurred_and_foreign_texture_is_rejected() -> None:
    photo = photograph()
    inner = np.s_[10:-10, 10 : HALF - 10]
    assert not photo_consistent(cv2.GaussianBlur(photo, (0, 0), 6), photo)[inner].any()
    assert photo_consistent(cv2.GaussianBlur(photo, (0, 0), 0.5), photo)[inner].all()
    foreign = photo[::-1]
    assert photo_consistent(np.ascontiguousarray(foreign), photo)[inner].mean() < 0.05


def test_plain_parts_reject_nothing() -> None:
    photo = photograph()
    plain = np.s_[:, HALF + 10 : -10]
    assert photo_consistent(np.full_like(photo, 120), photo)[plain].all()
