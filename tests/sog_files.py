"""Reading of SOG by the rules of its specification, one value after the other."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pipelines.formats.splat_ply import SplatArrays


def pixels(folder: Path, name: str, count: int) -> np.ndarray:
    """Return the first pixels (count, channels) of a picture, row by row."""
    with Image.open(folder / name) as picture:
        assert picture.format == "WEBP"
        array = np.asarray(picture).astype(int)
    return array.reshape(-1, array.shape[2])[:count]


def read_sog(folder: Path) -> SplatArrays:
    meta: dict[str, Any] = json.loads((folder / "meta.json").read_text())
    assert meta["version"] == 2
    count = meta["count"]
    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    lower, upper = (pixels(folder, name, count) for name in meta["means"]["files"])
    n = low + (high - low) * (lower + 256 * upper) / 65535
    means = np.sign(n) * (np.exp(np.abs(n)) - 1)
    scales = np.array(meta["scales"]["codebook"])[pixels(folder, meta["scales"]["files"][0], count)]
    colours = pixels(folder, meta["sh0"]["files"][0], count)
    opacity = np.clip(colours[:, 3] / 255, 1e-6, 1 - 1e-6)
    sh = np.array(meta["sh0"]["codebook"])[colours[:, None, :3]]
    if "shN" in meta:
        part = meta["shN"]
        coefficients = (part["bands"] + 1) ** 2 - 1
        labels = pixels(folder, part["files"][1], count)
        label = labels[:, 0] + 256 * labels[:, 1]
        assert label.max() < part["count"]
        with Image.open(folder / part["files"][0]) as picture:
            palette = np.asarray(picture).astype(int)
        assert palette.shape[1] == 64 * coefficients
        column = (label % 64)[:, None] * coefficients + np.arange(coefficients)
        higher = np.array(part["codebook"])[palette[(label // 64)[:, None], column]]
        sh = np.concatenate([sh, higher], axis=1)
    quats = np.zeros((count, 4))
    for row, (a, b, c, tag) in enumerate(pixels(folder, meta["quats"]["files"][0], count)):
        smaller = (np.array([a, b, c]) / 255 - 0.5) * np.sqrt(2)
        others = [index for index in range(4) if index != tag - 252]
        quats[row, others] = smaller
        quats[row, tag - 252] = np.sqrt(max(0.0, 1 - (smaller**2).sum()))
    logits = np.log(opacity / (1 - opacity))
    return SplatArrays(*(array.astype(np.float32) for array in (means, quats, scales, logits, sh)))
