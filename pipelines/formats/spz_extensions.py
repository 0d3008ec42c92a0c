"""Extensions of SPZ files: the axes of their Gaussians, and their place on Earth.

Extensions are records of a type, a length and a payload, one after the other: in version 4 between the plain header
and the table of sizes, before in the stream behind the sections. Records of unknown types are skipped.

`SPZ_NIANTIC_georeference` is a proposal of the format's authors that is not part of the format yet
(github.com/nianticlabs/spz, pull request 105 of 22 September 2026): p_crs = scale · R(quat) p + origin, where p has
the axes right, up, back. Its layout has changed under one version number. The newest is written. The earlier ones
are read too; length and values tell them apart.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.types import Quaternion, Vector3

GEOREFERENCE, _AXES = 0x4E530001, 0xADBE0003
_RIGHT_UP_BACK = 4
_RECORD = struct.Struct("<II")  # type, length of the payload
MOST_BYTES = 1 << 21  # of all extensions: a proposal allows 1 MiB for the text of a CRS
_HAS_EPOCH = 0x1
_CODE, _PROJJSON = 0, 1  # syntaxes of the CRS
_UNIT_TOLERANCE = 1e-6
_PLACE = "3d 4d d d"  # origin, quaternion xyzw, scale, epoch
_NEWEST = struct.Struct("<BBH" + _PLACE)  # version, flags, length of the CRS; the CRS follows
_WITH_PROVENANCE = struct.Struct("<BBHI" + _PLACE)  # also the length of a second CRS, which names no target
_WITH_EPSG = struct.Struct(
    "<BBHI" + _PLACE + "I"
)  # version, flags, unused, EPSG code; length of a WKT, which follows


@dataclass(frozen=True)
class SpzGeoreference:
    """Similarity p_crs = scale · R(quat) p + origin from the axes right, up, back to a geocentric CRS.

    Attributes:
        crs: `AUTHORITY:CODE`, or PROJJSON for a target without a code.
        origin: metres.
        epoch: decimal year at which the coordinates are valid; None: not stated.
    """

    crs: str
    origin: Vector3
    quat_xyzw: Quaternion
    scale: float = 1.0
    epoch: float | None = None


def encode_georeference(georeference: SpzGeoreference) -> bytes:
    """Return the record of a georeference as the proposal has it now; an InputError: a value that it refuses."""
    if fault := _fault(georeference):
        raise InputError("spz-georeference", f"The georeference has {fault}.")
    crs = georeference.crs.encode()
    flags = (_HAS_EPOCH if georeference.epoch is not None else 0) | _syntax(georeference.crs) << 1
    epoch = math.nan if georeference.epoch is None else georeference.epoch
    values = (*georeference.origin, *georeference.quat_xyzw, georeference.scale, epoch)
    payload = _NEWEST.pack(1, flags, len(crs), *values) + crs
    return _RECORD.pack(GEOREFERENCE, len(payload)) + payload


def georeference_in(extensions: bytes, path: Path | None = None) -> SpzGeoreference | None:
    """Return the georeference in the extensions of a file; None: there is none. An InputError: it is damaged."""
    for kind, payload in _records(extensions, path):
        if kind == GEOREFERENCE:
            return _decoded(payload, path)
    return None


def require_known_axes(extensions: bytes, path: Path | None = None) -> None:
    """Refuse Gaussians whose stated axes are not right, up, back: an InputError; also one of damaged records."""
    records = list(_records(extensions, path))
    if not records:
        raise InputError("spz-extensions", "The SPZ file promises extensions, and has none.", path=path)
    for kind, payload in records:
        if kind == _AXES and payload != struct.pack("<I", _RIGHT_UP_BACK):
            message = "The SPZ file states other axes than right, up, back."
            remedy = "Write it with those."
            raise InputError("spz-axes", message, path=path, remedy=remedy)


def _records(extensions: bytes, path: Path | None) -> Iterator[tuple[int, bytes]]:
    offset = 0
    while offset < len(extensions):
        if len(extensions) - offset < _RECORD.size:
            raise InputError("file-damaged", "An extension of the SPZ file is cut off.", path=path)
        kind, size = _RECORD.unpack_from(extensions, offset)
        offset += _RECORD.size
        if size > len(extensions) - offset:
            message = f"Extension {kind:#010x} promises {size} bytes; {len(extensions) - offset} are left."
            raise InputError("file-damaged", message, path=path)
        yield kind, extensions[offset : offset + size]
        offset += size


def _decoded(payload: bytes, path: Path | None) -> SpzGeoreference:
    faults = []
    for layout in (_newest, _with_provenance, _with_epsg):
        georeference = layout(payload)
        fault = "another length" if georeference is None else _fault(georeference)
        if georeference is not None and not fault:
            return georeference
        faults.append(fault)
    raise InputError("spz-georeference", f"The georeference in the SPZ file has {faults[0]}.", path=path)


def _newest(payload: bytes) -> SpzGeoreference | None:
    if len(payload) < _NEWEST.size:
        return None
    version, flags, length, *values = _NEWEST.unpack_from(payload)
    crs = payload[_NEWEST.size :]
    return _placed(version, flags, values, crs) if len(crs) == length and flags >> 1 & 3 <= _PROJJSON else None


def _with_provenance(payload: bytes) -> SpzGeoreference | None:
    if len(payload) < _WITH_PROVENANCE.size:
        return None
    version, flags, length, other, *values = _WITH_PROVENANCE.unpack_from(payload)
    texts = payload[_WITH_PROVENANCE.size :]
    return _placed(version, flags, values, texts[:length]) if len(texts) == length + other else None


def _with_epsg(payload: bytes) -> SpzGeoreference | None:
    if len(payload) < _WITH_EPSG.size:
        return None
    version, flags, _, code, *values, length = _WITH_EPSG.unpack_from(payload)
    return (
        _placed(version, flags, values, f"EPSG:{code}".encode())
        if len(payload) == _WITH_EPSG.size + length
        else None
    )


def _placed(version: int, flags: int, values: list[float], crs: bytes) -> SpzGeoreference | None:
    x, y, z, *quat, scale, epoch = values
    try:
        text = crs.decode()
    except UnicodeDecodeError:
        return None
    if version != 1:
        return None
    i, j, k, w = quat
    return SpzGeoreference(text, (x, y, z), (i, j, k, w), scale, epoch if flags & _HAS_EPOCH else None)


def _syntax(crs: str) -> int:
    return _PROJJSON if crs.startswith("{") else _CODE


def _fault(georeference: SpzGeoreference) -> str:
    """Return which value no reader may accept; empty: none."""
    parts = georeference.crs.split(":")
    plain = all("!" <= char <= "~" and char != "@" for char in georeference.crs)
    if _syntax(georeference.crs) == _CODE and not (plain and len(parts) == 2 and all(parts)):
        return f"a CRS that is no AUTHORITY:CODE: {georeference.crs!r}"
    if len(georeference.crs.encode()) > 0xFFFF:
        return "a CRS of more than 65535 bytes"
    if not all(map(math.isfinite, georeference.origin)):
        return "an origin that is not finite"
    if not abs(math.hypot(*georeference.quat_xyzw) - 1) <= _UNIT_TOLERANCE:
        return "a rotation that is no unit quaternion"
    if not (math.isfinite(georeference.scale) and georeference.scale > 0):
        return f"a scale of {georeference.scale:g}"
    if georeference.epoch is not None and not math.isfinite(georeference.epoch):
        return "an epoch that is not finite"
    return ""
