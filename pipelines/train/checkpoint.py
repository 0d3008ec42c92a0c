"""Checkpoints: named tensors in one NPZ file without pickle, replaced in one step."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipelines.core.durable import replacing
from pipelines.core.errors import InputError
from pipelines.core.files import read_npz


def save_checkpoint(path: Path, state: Mapping[str, Tensor]) -> None:
    """Write tensors to an NPZ file, which replaces an existing file only when complete."""
    draft = path.with_suffix(".tmp")
    with replacing(path, draft), draft.open("wb") as handle:
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in state.items()}
        np.savez(handle, **arrays)  # type: ignore[arg-type]


def load_checkpoint(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a checkpoint by name.

    Raises:
        InputError: the file cannot be read as a checkpoint.
    """
    try:
        return {name: torch.from_numpy(array) for name, array in read_npz(path).items()}
    except (
        InputError,
        TypeError,
        ValueError,
    ) as error:  # torch has no complex halves, texts or foreign byte orders
        raise InputError(f"not a readable checkpoint: {error}; train without --resume") from error


def prefixed(prefix: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors with `prefix/name` for names."""
    return {f"{prefix}/{name}": tensor for name, tensor in state.items()}


def unprefixed(prefix: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin with `prefix/`, without that prefix: inverts `prefixed`."""
    return {
        name.removeprefix(f"{prefix}/"): tensor for name, tensor in state.items() if name.startswith(f"{prefix}/")
    }
