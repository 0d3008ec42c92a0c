"""Where renders show their photographs: blurred parts are rejected, whatever the exposure; plain ones are not."""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.surface.surface_views import shows_photograph

HALF = 60


def photograph() -> np.ndarray:
    """Return a photograph with texture of 3 px (RGB), its right half plain but for noise of one grey level."""
    rng = np.random.default_rng(0)
    coarse = rng.uniform(40, 200, (30, 40, 1)).astype(np.float32)
    image = cv2.resize(coarse, (2 * HALF, 90), interpolation=cv2.INTER_CUBIC)[..., None].repeat(3, axis=2)
    image[:, HALF:] = 120 + rng.normal(0, 1, (90, HALF, 1))
    return np.clip(image, 0, 255).astype(np.uint8)


def test_likeness_does_not_depend_on_exposure() -> None:
    photo = photograph()
    assert shows_photograph(photo, photo).all()
    assert shows_photograph(np.clip(0.8 * photo + 30.0, 0, 255).astype(np.uint8), photo).all()


def test_blurred_and_foreign_texture_is_rejected() -> None:
    photo = photograph()
    inner = np.s_[10:-10, 10 : HALF - 10]
    assert not shows_photograph(cv2.GaussianBlur(photo, (0, 0), 6), photo)[inner].any()
    assert shows_photograph(cv2.GaussianBlur(photo, (0, 0), 0.5), photo)[inner].all()
    foreign = photo[::-1]
    assert shows_photograph(np.ascontiguousarray(foreign), photo)[inner].mean() < 0.05


def test_plain_parts_reject_nothing() -> None:
    photo = photograph()
    plain = np.s_[:, HALF + 10 : -10]
    assert shows_photograph(np.full_like(photo, 120), photo)[plain].all()
