"""Point clouds as COPC 1.0 (copc.io): one LAZ file whose points lie in an octree, for viewers that load parts.

Points, dimensions and CRS are those of a LAZ file. A node holds at most one point in each cell of its grid, chosen
at random; the others lie in its children. A node of few points holds all of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pipelines.core.extras import require
from pipelines.core.files import replacing
from pipelines.core.types import FloatArray, IntArray

_SPAN = 128  # cells along each side of a node
_FEW = 5_000  # points that a node holds whole
_DEEPEST = 13  # with 7 bits of a cell, codes of 20 bits an axis


def write_copc(laz: Path, path: Path) -> int:
    """Write the points of a LAZ file as COPC, and return the number of nodes; the file appears whole or not at all.

    All points are in memory.

    Raises:
        BackendUnavailableError: the extra `copc` is missing.
    """
    require("copc")
    import copclib
    import laspy

    cloud = laspy.read(laz)
    records, xyz = cloud.points.array, np.asarray(cloud.xyz)
    low, half = xyz.min(axis=0), max(float(np.ptp(xyz, axis=0).max()) / 2, float(cloud.header.scales.max()))
    given = copclib.LazReader(str(laz)).laz_config
    head = given.las_header
    # copclib 2.6 reads the CRS at the place of another record where a file has several.
    wkt = next((vlr.string for vlr in cloud.header.vlrs.get("WktCoordinateSystemVlr")), "")
    config = copclib.CopcConfigWriter(head.point_format_id, head.scale, head.offset, wkt, given.extra_bytes_vlr)
    middle = low + half
    info = config.copc_info
    info.center_x, info.center_y, info.center_z = middle.tolist()
    info.halfsize, info.spacing = half, 2 * half / _SPAN
    config.las_header.min, config.las_header.max = (
        copclib.Vector3(*bound.tolist()) for bound in (low, xyz.max(axis=0))
    )
    count = 0
    with replacing(path) as draft:
        writer = copclib.FileWriter(str(draft), config)
        for key, rows in _nodes(xyz, low, 2 * half):
            writer.AddNode(copclib.VoxelKey(*key), copclib.VectorChar(records[rows].view(np.int8)))
            count += 1
        writer.Close()
    return count


def _nodes(xyz: FloatArray, low: FloatArray, side: float) -> Iterator[tuple[tuple[int, int, int, int], IntArray]]:
    """Yield the key (depth, x, y, z) and the rows of each node of points (N, 3) in a cube, parents first."""
    remaining = np.random.default_rng(0).permutation(len(xyz))
    for depth in range(_DEEPEST + 1):
        cells = 2**depth * _SPAN
        cell = np.clip(np.floor((xyz[remaining] - low) / side * cells).astype(np.int64), 0, cells - 1)
        node, owner, members = np.unique(_code(cell // _SPAN), return_inverse=True, return_counts=True)
        taken = members[owner] <= _FEW
        taken[np.unique(_code(cell), return_index=True)[1]] = True
        if depth == _DEEPEST:
            taken[:] = True
        order = np.argsort(owner[taken], kind="stable")
        rows, held = remaining[taken][order], owner[taken][order]
        ends = np.searchsorted(held, np.arange(len(node) + 1))
        for number, code in enumerate(node.tolist()):
            key = (depth, code >> 40, code >> 20 & 0xFFFFF, code & 0xFFFFF)
            yield key, rows[ends[number] : ends[number + 1]]
        remaining = remaining[~taken]
        if not len(remaining):
            return


def _code(cell: IntArray) -> IntArray:
    return np.asarray(cell[:, 0] << 40 | cell[:, 1] << 20 | cell[:, 2])
