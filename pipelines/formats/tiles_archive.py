"""3D Tiles Archive Format 1.3 (.3tz): a tileset in one file, a ZIP with an index of its entries.

Entries are stored as they are, so that a reader may map a tile. The last one, `@3dtilesIndex1@`, has a record of
24 bytes for each other: MD5 of its path, then the place of its local header, little-endian. Records are sorted by
the hash, taken as two little-endian integers of 64 bits. Entries have no times: the same tileset gives the same
bytes.
"""

import hashlib
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path

from pipelines.core.files import replacing

INDEX = "@3dtilesIndex1@"


def write_tiles_archive(path: Path, folder: Path, files: Iterable[str]) -> None:
    """Write files of a folder, by their paths in it, as a 3TZ; the archive appears whole or not at all.

    Args:
        path: ends with `.3tz`.
        files: with `/`; `tileset.json` is among them, and none is an archive itself.

    Raises:
        OSError: a file cannot be read, or the archive cannot be written.
    """
    records = []
    with replacing(path) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_STORED) as archive:
        for name in files:
            entry = zipfile.ZipInfo(name)
            archive.writestr(entry, (folder / name).read_bytes())
            digest = hashlib.md5(name.encode(), usedforsecurity=False).digest()
            records.append((*struct.unpack("<QQ", digest), entry.header_offset))
        index = b"".join(struct.pack("<QQQ", *record) for record in sorted(records))
        archive.writestr(zipfile.ZipInfo(INDEX), index)
