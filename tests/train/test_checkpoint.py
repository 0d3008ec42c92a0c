"""Checkpoints: what is saved comes back, and a file is whole or the old one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.errors import InputError
from pipelines.train.trainer import load_checkpoint, prefixed, save_checkpoint, unprefixed
from tests.refusals import refused

pytestmark = pytest.mark.usefixtures("one_thread")


def test_tensors_come_back_bit_for_bit(tmp_path: Path) -> None:
    state = {
        "iteration": torch.tensor(7),
        "a/means": torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).requires_grad_(),
        "a/steps": torch.arange(4, dtype=torch.int32),
        "generator": torch.Generator().manual_seed(3).get_state(),
        "empty": torch.zeros(0, dtype=torch.float64),
    }
    save_checkpoint(tmp_path / "c.npz", state)
    found = load_checkpoint(tmp_path / "c.npz")
    assert set(found) == set(state)
    for name, tensor in state.items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor.detach())
    assert [path.name for path in tmp_path.iterdir()] == ["c.npz"]


def test_failed_save_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "c.npz"
    save_checkpoint(path, {"iteration": torch.tensor(1)})

    def full(*_: object, **__: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="no space"):
        save_checkpoint(path, {"iteration": torch.tensor(2)})
    assert int(load_checkpoint(path)["iteration"]) == 1


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 and no more", b"\x93NUMPY"])
def test_damaged_files_are_told(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "c.npz"
    path.write_bytes(content)
    with refused("checkpoint-damaged", InputError):
        load_checkpoint(path)


def test_pickles_are_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "c.npz"
    np.savez(path, evil=np.array([object()], dtype=object))
    with refused("checkpoint-damaged", InputError):
        load_checkpoint(path)


def test_prefixes_keep_parts_apart() -> None:
    one, two = {"x": torch.tensor(1)}, {"x": torch.tensor(2), "y": torch.tensor(3)}
    both = {**prefixed("one", one), **prefixed("two", two)}
    assert set(both) == {"one/x", "two/x", "two/y"}
    assert unprefixed("one", both) == one
    assert unprefixed("two", both) == two
