"""PLY of 3D Gaussian Splatting: binary little-endian float32, as viewers and trainers exchange it.

Properties: `x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3`. Opacity is a logit, scales are
natural logarithms, the rotation is wxyz, `f_rest` is ordered by channel, the normals are zero. A comment says which
Gaussians need the mip filter, in the words of Brush.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib import recfunctions
from plyfile import PlyData, PlyElement, PlyParseError

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading, replacing
from pipelines.core.types import Float32Array, Rows

_HEADER_LIMIT = 64 * 1024
_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALE = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
MIP_COMMENT = "SplatRenderMode: mip"
_REST_COUNTS = (0, 9, 24, 45)  # degree 0 to 3: three channels of (degree + 1)² − 1
# Kind of numpy of each type; its digit is the width in bytes.
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2", "int16": "i2",
    "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class SplatArrays(Rows):
    """N Gaussians as float32 arrays; names and shapes are those of `pipelines.splat.gaussians.Gaussians`."""

    means: Float32Array
    quats_wxyz: Float32Array
    log_scales: Float32Array
    logit_opacities: Float32Array
    sh: Float32Array


def write_splat_ply(path: Path, splat: SplatArrays, *, mip_filter: bool = False) -> None:
    """Write Gaussians, trained with the mip filter or not; the file appears whole or not at all.

    Raises:
        ValueError: shapes do not agree.
    """
    count, coefficients = len(splat), splat.sh.shape[1]
    rest_count = 3 * (coefficients - 1)
    if rest_count not in _REST_COUNTS or splat.sh.shape != (count, coefficients, 3):
        raise ValueError(f"expected spherical harmonics (N, 1 | 4 | 9 | 16, 3), got {splat.sh.shape}")
    rest = [f"f_rest_{i}" for i in range(rest_count)]
    names = [*_POSITION, *_NORMAL, *_DC, *rest, "opacity", *_SCALE, *_ROTATION]
    rows = np.empty((count, len(names)), dtype="<f4")
    rows[:, :3], rows[:, 3:6], rows[:, 6:9] = splat.means, 0.0, splat.sh[:, 0]
    rows[:, 9 : 9 + rest_count] = splat.sh[:, 1:].transpose(0, 2, 1).reshape(count, rest_count)
    rows[:, 9 + rest_count] = splat.logit_opacities
    rows[:, 10 + rest_count : 13 + rest_count], rows[:, 13 + rest_count :] = splat.log_scales, splat.quats_wxyz
    vertices = rows.view([(name, "<f4") for name in names]).reshape(count)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        comments = [MIP_COMMENT] if mip_filter else []
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=comments).write(str(draft))


def join_splat_plys(parts: Sequence[Path], path: Path, *, mip_filter: bool = False) -> int:
    """Write the Gaussians of files of one SH degree into one file, and return their number.

    No more than one part is in memory; the file appears whole or not at all.

    Raises:
        InputError: a part is not a PLY of that form, or has other properties than the first one.
    """
    plys = [_read_rows(part) for part in parts]
    for ply in plys[1:]:
        if ply.names != plys[0].names:
            message = f"The PLY has other properties than {parts[0]}: the two cannot be joined."
            raise InputError("properties-differ", message, path=ply.path)
    count = sum(len(ply.rows) for ply in plys)
    with replacing(path) as draft, draft.open("wb") as stream:
        lines = ["ply", "format binary_little_endian 1.0", *([f"comment {MIP_COMMENT}"] if mip_filter else [])]
        lines += [f"element vertex {count}"]
        lines += [*(f"property float {name}" for name in plys[0].names), "end_header\n"]
        stream.write("\n".join(lines).encode("ascii"))
        for ply in plys:
            _columns(ply, ply.names).astype("<f4", copy=False).tofile(stream)
    return count


def read_splat_ply(path: Path, rows: slice = slice(None)) -> SplatArrays:
    """Read Gaussians of any SH degree from 0 to 3, all or some rows; other properties are ignored.

    Raises:
        InputError: no such file, not a PLY of that form, cut off, or with values that are not finite.

    Examples:
        >>> shapes = (1, 3), (1, 4), (1, 3), (1,), (1, 1, 3)  # mean, rotation, ln σ, logit of opacity, harmonics
        >>> splat = SplatArrays(*(np.ones(shape, np.float32) for shape in shapes))
        >>> write_splat_ply(Path("splat.ply"), splat)
        >>> read = read_splat_ply(Path("splat.ply"))
        >>> read.means.tolist(), read.log_scales.tolist()
        ([[1.0, 1.0, 1.0]], [[1.0, 1.0, 1.0]])
    """
    ply = _read_rows(path, rows)
    rest_count = sum(name.startswith("f_rest_") for name in ply.names)
    if rest_count not in _REST_COUNTS:
        counts = ", ".join(map(str, _REST_COUNTS))
        message = f"The PLY has {rest_count} SH coefficients above degree 0; degrees 0 to 3 have {counts}."
        raise InputError("sh-coefficients", message, path=path, field="f_rest")
    higher = _columns(ply, tuple(f"f_rest_{i}" for i in range(rest_count)))
    higher = higher.reshape(len(higher), 3, rest_count // 3)
    dc = _columns(ply, _DC)[:, None, :]
    return SplatArrays(
        means=_columns(ply, _POSITION),
        quats_wxyz=_columns(ply, _ROTATION),
        log_scales=_columns(ply, _SCALE),
        logit_opacities=_columns(ply, ("opacity",))[:, 0],
        sh=np.concatenate([dc, higher.transpose(0, 2, 1)], axis=1),
    )


def read_centres(path: Path) -> Float32Array:
    """Read the centres (N, 3) of Gaussians alone, as `read_splat_ply`: the other properties stay unread.

    Examples:
        >>> shapes = (1, 3), (1, 4), (1, 3), (1,), (1, 1, 3)  # mean, rotation, ln σ, logit of opacity, harmonics
        >>> splat = SplatArrays(*(np.ones(shape, np.float32) for shape in shapes))
        >>> write_splat_ply(Path("splat.ply"), splat)
        >>> read_centres(Path("splat.ply")).tolist()
        [[1.0, 1.0, 1.0]]
    """
    return _columns(_read_rows(path), _POSITION)


def read_logit_opacities(path: Path) -> Float32Array:
    """Read the logits (N,) of the opacities of Gaussians alone, as `read_splat_ply`.

    Examples:
        >>> shapes = (1, 3), (1, 4), (1, 3), (1,), (1, 1, 3)  # mean, rotation, ln σ, logit of opacity, harmonics
        >>> splat = SplatArrays(*(np.ones(shape, np.float32) for shape in shapes))
        >>> write_splat_ply(Path("splat.ply"), splat)
        >>> read_logit_opacities(Path("splat.ply")).tolist()
        [1.0]
    """
    return _columns(_read_rows(path), ("opacity",))[:, 0]


@dataclass(frozen=True)
class _PlyRows:
    """Rows (N, K) of a file and the names of their columns."""

    path: Path
    names: tuple[str, ...]
    rows: Float32Array


def _read_rows(path: Path, rows: slice = slice(None)) -> _PlyRows:
    _check_header(path)
    try:
        vertices = PlyData.read(str(path), mmap="r")["vertex"].data
    except (PlyParseError, ValueError, OverflowError, KeyError) as error:
        raise InputError("file-damaged", f"The PLY file is damaged: {error}", path=path) from error
    # With one type for all columns, as the format demands, this is a view; a file of mixed types is converted.
    values = recfunctions.structured_to_unstructured(vertices[rows], dtype=np.float32)
    return _PlyRows(path, tuple(vertices.dtype.names), values)


def _columns(ply: _PlyRows, names: tuple[str, ...]) -> Float32Array:
    missing = [name for name in names if name not in ply.names]
    if missing:
        message = "The property is missing: this PLY does not hold Gaussians."
        raise InputError("not-gaussians", message, path=ply.path, field=missing[0])
    index = [ply.names.index(name) for name in names]
    first = index[0] if index else 0
    span = slice(first, first + len(index))
    in_order = index == list(range(*span.indices(len(ply.names))))
    values = np.array(ply.rows[:, span] if in_order else ply.rows[:, index], dtype=np.float32)
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        message = (
            f"{int((~finite).sum())} of {len(values)} Gaussians have values that are not finite; "
            f"the first is number {int(np.argmin(finite))}"
        )
        raise InputError("values-not-finite", message, path=ply.path, field=" ".join(names[:4]))
    return values


def ply_header(path: Path) -> tuple[list[list[str]], int, int]:
    """Return the words of each line of a PLY's header, the bytes before its body, and those of the whole file.

    Raises:
        InputError: no such file, or not a PLY.
    """
    size = file_size(path)
    with reading(path), path.open("rb") as stream:
        start = stream.read(_HEADER_LIMIT)
    head, end, rest = start.partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", errors="replace").splitlines()]
    if not end or lines[:1] != [["ply"]]:
        raise InputError("not-a-ply", "The file is not a PLY file.", path=path)
    return lines, len(head) + len(end) + (2 if rest[:1] == b"\r" else 1), size


def _check_header(path: Path) -> None:
    """Refuse, before memory is allocated, a file whose size differs from the promise of its header."""
    lines, offset, size = ply_header(path)
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise InputError("ply-format", "The format of the PLY is not binary_little_endian 1.0.", path=path)
    elements = [line for line in lines if line[:1] == ["element"]]
    if len(elements) != 1 or elements[0][1:2] != ["vertex"] or len(elements[0]) != 3:
        raise InputError("ply-elements", "The PLY has elements other than one, vertex.", path=path)
    properties = [line for line in lines if line[:1] == ["property"]]
    widths = [int(PLY_TYPES.get(line[1], "i0")[1]) if len(line) == 3 else 0 for line in properties]
    if not widths or 0 in widths:
        raise InputError("ply-properties", "The PLY has no properties, or some without a fixed size.", path=path)
    promised = int(elements[0][2]) if elements[0][2].isdecimal() and len(elements[0][2]) < 16 else -1
    if promised < 1 or promised * sum(widths) != size - offset:
        message = (
            f"The header promises {elements[0][2][:20]} Gaussians of {sum(widths)} bytes, the file holds "
            f"{max(size - offset, 0)} bytes: it is empty, cut off or damaged."
        )
        raise InputError("size-differs", message, path=path)
