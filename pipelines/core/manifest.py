"""Manifest of a stage's folder: how its product was made, and the hashes by which damage is recognised."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, FiniteFloat, model_validator

from pipelines.core.files import file_size
from pipelines.core.products import Remark

MANIFEST = "manifest.json"
Memo = dict[Path, str]


class FileRecord(BaseModel):
    """File of a product as the stage wrote it: size in bytes, time of modification, SHA-256."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    size: int
    mtime_ns: int
    sha256: str


class Manifest(BaseModel):
    """Record of how a product was made.

    Attributes:
        product_version: of the form of the product.
        config: resolved options by field.
        inputs: SHA-256 by product or flag, from `fingerprints`.
        started: UTC.
        key_figure, values, cautions: as of the stage's `Summary`.
        files: files of the product by path in the stage's folder; empty in manifests of earlier versions.
        input_files: files in the folders that options name, by flag and path in that folder.
    """

    model_config = ConfigDict(extra="forbid")

    format_version: Literal[1] = 1
    stage: str
    product_version: int = 1
    config: dict[str, Any]
    inputs: dict[str, str]
    versions: dict[str, str]
    started: datetime
    duration_s: FiniteFloat
    key_figure: str
    values: dict[str, Any]
    warnings: tuple[Remark, ...]
    cautions: tuple[Remark, ...] = ()
    files: dict[str, FileRecord] = {}
    input_files: dict[str, dict[str, FileRecord]] = {}

    @model_validator(mode="after")
    def _ends_in_the_calendar(self) -> Manifest:
        try:
            _ = self.finished
        except OverflowError as error:
            raise ValueError("duration_s: ends beyond the calendar") from error
        return self

    @property
    def finished(self) -> datetime:
        """Time at which the stage ended, UTC."""
        return self.started + timedelta(seconds=self.duration_s)


def record_files(folder: Path, left_out: Iterable[str]) -> dict[str, FileRecord]:
    """Return the records of the files below a stage's folder; `left_out` are those that other programs change."""
    records = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        inside = path.relative_to(folder)
        if inside.as_posix() == MANIFEST or any(inside.is_relative_to(name) for name in left_out):
            continue
        stat = path.stat()
        records[inside.as_posix()] = FileRecord(
            size=stat.st_size, mtime_ns=stat.st_mtime_ns, sha256=hash_file(path, {})
        )
    return records


def damaged_files(folder: Path, manifest: Manifest, memo: Memo, *, by_content: bool) -> list[str]:
    """Return the files of a product, by their path in the stage's folder, that differ from their records.

    Missing files do not count: a missing product makes its stage stale, and any other file may be deleted.

    Args:
        memo: hashes of files by path, extended here.
        by_content: whether a file whose size and time of modification are unchanged is hashed too.
    """
    return [
        name
        for name, record in manifest.files.items()
        if (folder / name).is_file() and not _is_intact(folder / name, record, memo, by_content=by_content)
    ]


def _is_intact(path: Path, record: FileRecord, memo: Memo, *, by_content: bool) -> bool:
    try:
        stat = path.stat()
        if stat.st_size != record.size:
            return False
        if stat.st_mtime_ns == record.mtime_ns and not by_content:
            return True
        return hash_file(path, memo) == record.sha256
    except OSError:  # A disk that fails while the file is read.
        return False


def hash_file(path: Path, memo: Memo) -> str:
    """Return the SHA-256 of a file, from the memo if it is there; the memo is extended."""
    if path not in memo:
        file_size(path)
        with path.open("rb") as handle:
            memo[path] = hashlib.file_digest(handle, "sha256").hexdigest()
    return memo[path]
