"""LPIPS against the network written with torch's modules, on random weights (the real ones are not shipped)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from pipelines.core.errors import InputError
from pipelines.splat.metrics import Lpips, _shapes
from tests.refusals import refused

VGG16 = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512)
TAKEN = (3, 8, 15, 22, 29)  # the last ReLU before each pooling


def vgg_layers() -> nn.Sequential:
    layers: list[nn.Module] = []
    channels = 3
    for width in VGG16:
        if isinstance(width, str):
            layers.append(nn.MaxPool2d(2))
        else:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
    return nn.Sequential(*layers)


def distance(layers: nn.Sequential, lins: list[Tensor], image: Tensor, target: Tensor) -> Tensor:
    """Return the distance by its definition: Σ over layers of the mean over pixels of w · (x̂ − ŷ)²."""
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, y = (((2 * value - 1 - shift) / scale).permute(2, 0, 1)[None] for value in (image, target))
    total = torch.zeros(())
    for index, layer in enumerate(layers):
        x, y = layer(x), layer(y)
        if index in TAKEN:
            difference = nn.functional.normalize(x, dim=1) - nn.functional.normalize(y, dim=1)
            weight = lins[TAKEN.index(index)].reshape(1, -1, 1, 1)
            total = total + (weight * difference**2).sum(dim=1).mean()
    return total


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> tuple[nn.Sequential, list[Tensor], Path]:
    torch.manual_seed(0)
    layers = vgg_layers()
    lins = [torch.rand(channels) for channels in (64, 128, 256, 512, 512)]
    arrays = {f"lin{i}.model.1.weight": lin.reshape(1, -1, 1, 1).numpy() for i, lin in enumerate(lins)}
    for index, layer in enumerate(layers):
        if isinstance(layer, nn.Conv2d):
            number = 1 + sum(index > taken for taken in TAKEN)
            arrays[f"net.slice{number}.{index}.weight"] = layer.weight.detach().numpy()
            arrays[f"net.slice{number}.{index}.bias"] = layer.bias.detach().numpy()
    path = tmp_path_factory.mktemp("lpips") / "weights.npz"
    np.savez(path, **arrays)
    return layers, lins, path


def test_distance_is_that_of_the_definition(network: tuple[nn.Sequential, list[Tensor], Path]) -> None:
    layers, lins, path = network
    generator = torch.Generator().manual_seed(1)
    image, target = torch.rand(2, 37, 33, 3, generator=generator)
    lpips = Lpips(path)
    with torch.no_grad():
        expected = distance(layers, lins, image, target).item()
    assert expected > 1e-3
    assert lpips(image, target) == pytest.approx(expected, rel=1e-4)
    assert lpips(image, image) == 0
    with pytest.raises(ValueError, match="16 px"):
        lpips(image[:8], target[:8])


def test_pixels_outside_the_mask_are_equal(network: tuple[nn.Sequential, list[Tensor], Path]) -> None:
    lpips = Lpips(network[2])
    image, target = torch.rand(2, 37, 33, 3, generator=torch.Generator().manual_seed(1))
    mask = torch.ones(37, 33, dtype=torch.bool)
    mask[:, :8] = False
    spoilt = image.clone()
    spoilt[:, :8] = 1.0
    assert lpips(spoilt, target, mask) == lpips(image, target, mask)
    assert 0 < lpips(image, target, mask) < lpips(image, target)
    assert lpips(image, target, ~torch.ones_like(mask)) == 0


def test_files_that_are_no_weights_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.npz"
    np.savez(path, something=np.zeros(3))
    with pytest.raises(InputError, match=r"net\.slice1\.0\.weight"):
        Lpips(path)
    np.savez(path, **dict.fromkeys(_shapes(), np.zeros(3)))
    with refused("lpips-weights", InputError) as error:
        Lpips(path)
    assert error.value.path == path and error.value.field in _shapes()
    path.write_bytes(b"PK\x03\x04 not an archive")
    with refused("npz-damaged", InputError):
        Lpips(path)
