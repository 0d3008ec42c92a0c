"""Deterministic mutations of a file: of its bytes, its numbers, its JSON, or the content of its archive."""

from __future__ import annotations

import io
import json
import random
import re
import struct
import zipfile
from collections.abc import Callable
from typing import Any

_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_TEXTS = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e308", b"4294967296", b"68719476736", b"9" * 20, b"", b"''",
    b'"', b"[red]", b"[/]", b"\x00", b"\xff\xfe", b"../../x", b"/dev/zero", b"a" * 5000, b"[" * 3000, b"{" * 3000,
    b"{'a':" * 2000, b"- " * 3000, b"\n", b",", b";", b"+nadgrids=/dev/zero", b"\xd9\xa1", b"1_0",
)  # fmt: skip
_INTEGERS = (0, 1, 2, 127, 128, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**36, 2**62, 2**64 - 1)
_FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e308, 5e-324, 1e30)
_JSON: tuple[Any, ...] = (
    None, True, 0, -1, 1e308, 2**63, 10**400, "", "x", "[red]", "../x", "\u0000", "é" * 300, [], {}, [[]],
    [None] * 3, float("nan"), float("inf"), [0, 0, 0], [[0.0] * 3] * 3, [0.0] * 4, "EPSG:0", "nan",
)  # fmt: skip


def mutated(data: bytes, rng: random.Random) -> bytes:
    """Return the data with one to four mutations."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        data = _kind(data, rng)(data, rng)
    return data


def _kind(data: bytes, rng: random.Random) -> Callable[[bytes, random.Random], bytes]:
    if data[:4] == b"PK\x03\x04" and rng.random() < 0.8:
        return _in_archive
    if data[:1] in (b"{", b"[") and rng.random() < 0.7:
        return _in_json
    is_text = all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in data[:200])
    choices = (
        (_numbers, _numbers, _lines, _insert) if is_text else (_integers, _integers, _integers, _floats, _insert)
    )
    return rng.choice((*choices, _bits, _truncate, _splice, _insert))


def _place(data: bytes, rng: random.Random) -> int:
    """Return an offset; every other one lies in the head, where most lengths are."""
    return rng.randrange(min(len(data), rng.choice((16, 64, 256, 2**40))) or 1)


def _bits(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 2, 8))):
        changed[_place(changed, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: _place(data, rng)] if rng.random() < 0.7 else data[_place(data, rng) :]


def _splice(data: bytes, rng: random.Random) -> bytes:
    at, other = sorted((_place(data, rng), _place(data, rng)))
    block = data[at : min(other, at + 4096)] * rng.choice((1, 2, 50))
    to = _place(data, rng)
    return data[:to] + block + data[to + (len(block) if rng.random() < 0.5 else 0) :]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.choice((*_TEXTS, rng.randbytes(rng.choice((1, 4, 300))))) + data[at:]


def _integers(data: bytes, rng: random.Random) -> bytes:
    width = rng.choice((1, 2, 4, 4, 8, 8))
    value = rng.choice((*_INTEGERS, len(data), len(data) + 1, rng.getrandbits(64))) % 2 ** (8 * width)
    at = _place(data, rng)
    return data[:at] + value.to_bytes(width, rng.choice(("little", "big"))) + data[at + width :]


def _floats(data: bytes, rng: random.Random) -> bytes:
    at = _place(data, rng)
    packed = struct.pack(rng.choice(("<d", "<f")), rng.choice(_FLOATS[:5]))
    return data[:at] + packed + data[at + len(packed) :]


def _numbers(data: bytes, rng: random.Random) -> bytes:
    places = list(_NUMBER.finditer(data))
    if not places:
        return _insert(data, rng)
    place = rng.choice(places)
    return data[: place.start()] + rng.choice(_TEXTS) + data[place.end() :]


def _lines(data: bytes, rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    match rng.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, rng.choice(lines))
        case 2:
            lines[at] = b" ".join(rng.sample(words := lines[at].split(), len(words)))
        case _:
            rng.shuffle(lines)
    return b"\n".join(lines)


def _in_json(data: bytes, rng: random.Random) -> bytes:
    """Replace, remove or double one value of a document."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError):
        return _bits(data, rng)
    places = []
    pending = [document]
    while pending:
        item = pending.pop()
        keys = list(item) if isinstance(item, dict) else range(len(item)) if isinstance(item, list) else ()
        places += [(item, key) for key in keys]
        pending += [item[key] for key in keys]
    if not places:
        return _bits(data, rng)
    item, key = rng.choice(places)
    match rng.randrange(5):
        case 0:
            del item[key]
        case 1 if isinstance(item, list):
            item += [item[key]] * rng.choice((1, 100))
        case 2:
            other, name = rng.choice(places)
            item[key] = json.loads(json.dumps(other[name])) if name in other or isinstance(other, list) else None
        case _:
            item[key] = rng.choice(_JSON)
    return json.dumps(document).encode()


def _in_archive(data: bytes, rng: random.Random) -> bytes:
    """Mutate an entry of a ZIP archive, or its name, and write the archive anew: its checksums hold."""
    stream = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # an earlier mutation damaged it: any error of zipfile and its decompressors
        return _bits(data, rng)
    if not entries:
        return _bits(data, rng)
    name = rng.choice(list(entries))
    content = entries.pop(name)
    match rng.randrange(8):
        case 0:
            name += rng.choice(("x", "", "/../a"))
        case 1:
            content = rng.choice(list(entries.values()) or [b""])
        case 2 | 3:
            content = _numbers(content[:128], rng) + content[128:]  # the header
        case _:
            content = rng.choice((_bits, _integers, _floats, _truncate, _splice))(content, rng)
    with zipfile.ZipFile(stream, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for other, value in {**entries, name: content}.items():
            archive.writestr(other, value)
    return stream.getvalue()
