"""The fused photometric loss against a plain reference, its gradient, and what a mask means."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from pipelines.splat.losses import image_similarity, photometric_loss, training_background, transparency_loss


def reference_terms(x: Tensor, y: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return L1 and SSIM in the form of 3DGS: a full 11×11 convolution for each moment."""
    weight = torch.ones(x.shape[:2], dtype=x.dtype) if mask is None else mask.to(x.dtype)
    x, y = x * weight[..., None], y * weight[..., None]
    offset = torch.arange(11, dtype=x.dtype) - 5
    line = torch.exp(-(offset**2) / (2 * 1.5**2))
    window = (line[:, None] * line[None]) / line.sum() ** 2

    def blur(image: Tensor) -> Tensor:
        planes = image.permute(2, 0, 1)[:, None]
        return functional.conv2d(planes, window[None, None], padding=5)[:, 0].permute(1, 2, 0)

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    ssim = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    count = 3 * weight.sum()
    return (x - y).abs().sum() / count, (ssim * weight[..., None]).sum() / count


def image_pair(height: int, width: int, dtype: torch.dtype, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(height, width, 3, generator=generator, dtype=dtype)
    y = (x + 0.2 * torch.randn(height, width, 3, generator=generator, dtype=dtype)).clamp(0, 1)
    return x, y


def border_mask(height: int, width: int) -> Tensor:
    mask = torch.ones(height, width, dtype=torch.bool)
    mask[:3] = mask[:, -4:] = mask[height // 2, : width // 2] = False
    return mask


@pytest.mark.parametrize("size", [(1, 1), (4, 30), (11, 11), (37, 53)])
@pytest.mark.parametrize("masked", [False, True])
def test_value_and_gradient_match_plain_convolutions(size: tuple[int, int], masked: bool) -> None:
    x, y = image_pair(*size, torch.float64)
    mask = border_mask(*size) if masked and min(size) > 3 else None
    x1, x2 = x.clone().requires_grad_(), x.clone().requires_grad_()
    loss = photometric_loss(x1, y, mask)
    l1, ssim = reference_terms(x2, y, mask)
    expected = 0.8 * l1 + 0.2 * (1 - ssim)
    (3 * loss).backward()
    (3 * expected).backward()
    # The same sums in another order, in float64.
    assert loss.item() == pytest.approx(expected.item(), abs=1e-13)
    torch.testing.assert_close(x1.grad, x2.grad, rtol=0, atol=1e-13)


def test_float32_keeps_four_digits_of_the_gradient() -> None:
    # SSIM divides differences of squares of about 1 (float32 error 1e-7) by at least C2 = 9e-4.
    x, y = image_pair(48, 64, torch.float64)
    x32, x64 = x.float().requires_grad_(), x.requires_grad_()
    photometric_loss(x32, y.float()).backward()
    photometric_loss(x64, y).backward()
    error = (x32.grad - x64.grad).abs().max() / x64.grad.abs().max()
    assert error < 1e-4


def test_gradcheck() -> None:
    x, y = image_pair(13, 9, torch.float64)
    mask = border_mask(13, 9)
    assert torch.autograd.gradcheck(lambda image: photometric_loss(image, y, mask), (x.requires_grad_(),))


def test_masked_pixels_do_not_count() -> None:
    x, y = image_pair(30, 40, torch.float32)
    mask = border_mask(30, 40)
    disturbed = torch.where(mask[..., None], x, torch.full_like(x, 7.0)).requires_grad_()
    loss = photometric_loss(disturbed, y, mask)
    loss.backward()
    assert loss.item() == photometric_loss(x, y, mask).item()
    assert disturbed.grad[~mask].abs().max() == 0
    assert disturbed.grad[mask].abs().min() > 0


def test_mean_is_over_the_valid_pixels() -> None:
    x, y = torch.full((20, 20, 3), 0.5), torch.full((20, 20, 3), 0.3)
    mask = torch.zeros(20, 20, dtype=torch.bool)
    mask[5:9, 5:9] = True
    assert image_similarity(x, y, mask)[0] == pytest.approx(0.2, rel=1e-6)
    assert image_similarity(x, x, mask)[1] == pytest.approx(1.0, abs=1e-6)


def test_nothing_to_compare_is_no_loss() -> None:
    x, y = image_pair(12, 12, torch.float32)
    x.requires_grad_()
    loss = photometric_loss(x, y, torch.zeros(12, 12, dtype=torch.bool))
    loss.backward()
    assert loss.item() == 0
    assert x.grad.abs().max() == 0


def test_equal_images_have_no_loss_and_no_gradient() -> None:
    x, _ = image_pair(25, 31, torch.float64)
    y = x.clone().requires_grad_()
    loss = photometric_loss(y, x)
    loss.backward()
    assert abs(loss.item()) < 1e-14
    assert y.grad.abs().max() < 1e-15


def test_the_same_on_any_number_of_threads() -> None:
    import numba

    x, y = image_pair(64, 48, torch.float32)
    results = []
    for threads in (1, numba.get_num_threads()):
        before = numba.get_num_threads()
        numba.set_num_threads(threads)
        try:
            image = x.clone().requires_grad_()
            loss = photometric_loss(image, y)
            loss.backward()
        finally:
            numba.set_num_threads(before)
        results.append((loss.item(), image.grad.numpy()))
    assert results[0][0] == results[1][0]
    np.testing.assert_array_equal(results[0][1], results[1][1])


@pytest.mark.parametrize(
    ("shape", "target_shape", "dtype"),
    [((4, 4), (4, 4), torch.float32), ((4, 4, 3), (4, 5, 3), torch.float32), ((4, 4, 3), (4, 4, 3), torch.int32)],
)
def test_refuses_what_is_no_image_pair(
    shape: tuple[int, ...], target_shape: tuple[int, ...], dtype: torch.dtype
) -> None:
    with pytest.raises(ValueError, match="expected two"):
        photometric_loss(torch.zeros(shape, dtype=dtype), torch.zeros(target_shape, dtype=dtype))


def test_refuses_a_mask_of_another_size() -> None:
    image = torch.zeros(4, 4, 3)
    with pytest.raises(ValueError, match="bool mask"):
        photometric_loss(image, image, torch.zeros(5, 4, dtype=torch.bool))


def test_transparency_counts_pixels_of_the_mask() -> None:
    alpha = torch.tensor([[1.0, 0.5], [0.0, 0.75]], requires_grad=True)
    assert transparency_loss(alpha).item() == pytest.approx((0 + 0.5 + 1 + 0.25) / 4)
    mask = torch.tensor([[True, True], [False, True]])
    masked = transparency_loss(alpha, mask)
    assert masked.item() == pytest.approx((0 + 0.5 + 0.25) / 3)
    masked.backward()
    torch.testing.assert_close(alpha.grad, -mask.float() / 3)
    assert transparency_loss(alpha, torch.zeros_like(mask)).item() == 0


def test_backgrounds_of_a_training_have_no_shade_in_common() -> None:
    """A shade that all backgrounds were near to could be learned as a hole."""
    colours = np.array([training_background(iteration) for iteration in range(64)])
    assert colours.min() == 0 and colours.max() == 1
    np.testing.assert_allclose(colours.mean(axis=0), 0.5)
    assert colours.std(axis=0).min() > 0.3
    assert training_background(64) == training_background(0)  # few, for a GPU to keep


def test_convolution_form_for_other_devices_agrees() -> None:
    from pipelines.splat.losses import _terms_by_convolution

    x, y = image_pair(33, 21, torch.float64)
    mask = border_mask(33, 21)
    l1, ssim = _terms_by_convolution(x, y, mask)
    fused = image_similarity(x, y, mask)
    assert l1.item() == pytest.approx(fused[0], abs=1e-13)
    assert ssim.item() == pytest.approx(fused[1], abs=1e-13)


def test_convolutions_for_other_devices_are_never_rounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """cuDNN may round to TF32 whatever torch does not forbid, in the backward pass too."""
    from pipelines.splat.losses import _terms_by_convolution

    allowed, convolve = [], functional.conv2d

    def watched(*arguments: object, **options: object) -> Tensor:
        allowed.append(torch.backends.cudnn.allow_tf32)
        return convolve(*arguments, **options)

    x, y = image_pair(33, 21, torch.float64)
    fused, other = x.clone().requires_grad_(), x.clone().requires_grad_()
    mask = border_mask(33, 21)
    photometric_loss(fused, y, mask).backward()
    monkeypatch.setattr(functional, "conv2d", watched)
    before = torch.backends.cudnn.allow_tf32
    l1, ssim = _terms_by_convolution(other, y, mask)
    (0.8 * l1 + 0.2 * (1 - ssim)).backward()
    assert allowed == [False] * 4  # two of the forward pass, two of the backward pass
    assert torch.backends.cudnn.allow_tf32 == before
    torch.testing.assert_close(other.grad, fused.grad, rtol=0, atol=1e-13)
