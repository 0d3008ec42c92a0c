"""Reading and writing of Gaussians as files."""

from __future__ import annotations

from pathlib import Path

from pipelines.formats.splat_ply import SplatArrays, read_splat_ply, write_splat_ply
from pipelines.splat.gaussians import Gaussians


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians as a 3DGS PLY; the file appears whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    write_splat_ply(path, SplatArrays(**gaussians.arrays()))


def read_gaussians(path: Path, rows: slice = slice(None)) -> Gaussians:
    """Read Gaussians from a 3DGS PLY; of a part of its rows, nothing else comes into memory.

    Raises:
        InputError: no such file, not a PLY of that form, cut off, or with values that are not finite.
    """
    return Gaussians.from_arrays(vars(read_splat_ply(path, rows)))
