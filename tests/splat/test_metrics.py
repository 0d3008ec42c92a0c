"""PSNR and SSIM of images whose difference is known."""

from __future__ import annotations

import pytest
import torch

from pipelines.splat.metrics import MAX_PSNR_DB, psnr, ssim


def test_psnr_of_a_constant_difference() -> None:
    target = torch.full((8, 9, 3), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-4)
    assert psnr(target, target) == MAX_PSNR_DB
    assert psnr(target + 1e-7, target) == MAX_PSNR_DB  # would be 140 dB


def test_images_are_compared_as_they_are_shown() -> None:
    target = torch.ones(8, 9, 3)
    assert psnr(target + 5, target) == MAX_PSNR_DB
    assert ssim(target + 5, target) == pytest.approx(1.0)


def test_only_valid_pixels_count() -> None:
    target = torch.full((20, 30, 3), 0.5)
    image = target + 0.1
    image[:10] = 0.9
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[10:] = True
    assert psnr(image, target, mask) == pytest.approx(20.0, abs=1e-4)
    image[10:] = target[10:]
    assert ssim(image, target, mask) == pytest.approx(1.0)
    assert ssim(image, target) < 0.9


def test_ssim_of_constant_images_is_its_luminance_term() -> None:
    # Away from the edges there is no variance: (2 μx μy + C1) / (μx² + μy² + C1).
    image, target = torch.full((31, 31, 3), 0.6), torch.full((31, 31, 3), 0.3)
    mask = torch.zeros(31, 31, dtype=torch.bool)
    mask[5:26, 5:26] = True
    padded, against = image.clone(), target.clone()
    value = ssim(padded, against)
    expected = (2 * 0.18 + 1e-4) / (0.36 + 0.09 + 1e-4)
    # 21² of 31² windows lie inside the image; the others see its edge in both images and agree no better than 1.
    inside = 21**2 / 31**2
    assert inside * expected - (1 - inside) < value < inside * expected + (1 - inside)
    grown = torch.full((101, 101, 3), 0.6), torch.full((101, 101, 3), 0.3)
    assert ssim(*grown) == pytest.approx(expected, abs=0.05)


def test_nothing_to_compare_is_refused() -> None:
    image = torch.zeros(4, 4, 3)
    with pytest.raises(ValueError, match="no pixel"):
        psnr(image, image, torch.zeros(4, 4, dtype=torch.bool))
    with pytest.raises(ValueError, match="one shape"):
        ssim(image, torch.zeros(4, 5, 3))
