"""Points of clouds on the disk, by squares of the plan: memory holds one square and its margin."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.types import ByteArray, Float32Array, FloatArray

Square = tuple[int, int]
_ROW = np.dtype([("position", "<f8", 3), ("normal", "<f4", 3), ("classification", "u1")])
_SPARE_BYTES = 1 << 28  # of the disk, to be left free


class TiledPoints:
    """Points in `geo` with a normal and a class, in a file a square.

    Args:
        folder: scratch folder, made if missing.
        side_m: of the squares.
    """

    def __init__(self, folder: Path, side_m: float) -> None:
        self.side_m = side_m
        self._folder = folder
        self._count: dict[Square, int] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def __len__(self) -> int:
        """Return the number of points."""
        return sum(self._count.values())

    @property
    def squares(self) -> set[Square]:
        """Squares that hold points."""
        return set(self._count)

    def append(
        self, position: FloatArray, normal: FloatArray | Float32Array | None, classification: ByteArray | None
    ) -> None:
        """Append points.

        Args:
            position: (P, 3) in geo, metres.
            normal: (P, 3); None: unknown, written as zeros.
            classification: (P,) class of LAS; None: 0.

        Raises:
            InputError: the disk is full.
        """
        rows = np.zeros(len(position), dtype=_ROW)
        if shutil.disk_usage(self._folder).free < rows.nbytes + _SPARE_BYTES:
            raise InputError("no room for the points that are compared: make room on this disk", path=self._folder)
        rows["position"] = position
        if normal is not None:
            rows["normal"] = normal
        if classification is not None:
            rows["classification"] = classification
        square = np.floor(position[:, :2] / self.side_m).astype(np.int64)
        order = np.lexsort(square.T)
        starts = np.flatnonzero(np.any(np.diff(square[order], axis=0, prepend=square[order][:1] - 1), axis=1))
        for part in np.split(order, starts[1:]) if len(order) else []:
            name = (int(square[part[0], 0]), int(square[part[0], 1]))
            with self._path(name).open("ab") as file:
                file.write(rows[part].tobytes())
            self._count[name] = self._count.get(name, 0) + len(part)

    def around(self, square: Square, margin_m: float) -> tuple[NDArray[np.void], NDArray[np.bool_]]:
        """Return the rows in a square and its margin, and which of them lie in the square itself."""
        reach = int(np.ceil(margin_m / self.side_m))
        names = [
            (square[0] + across, square[1] + along)
            for across in range(-reach, reach + 1)
            for along in range(-reach, reach + 1)
        ]
        parts = [np.fromfile(self._path(name), dtype=_ROW) for name in names if name in self._count]
        rows = np.concatenate([np.empty(0, dtype=_ROW), *parts])
        offset = rows["position"][:, :2] - self.side_m * np.array(square)
        near = ((offset >= -margin_m) & (offset < self.side_m + margin_m)).all(axis=1)
        rows, offset = rows[near], offset[near]
        return rows, np.asarray(((offset >= 0) & (offset < self.side_m)).all(axis=1))

    def _path(self, square: Square) -> Path:
        return self._folder / f"{square[0]}_{square[1]}.points"
