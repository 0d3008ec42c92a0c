"""Hashes of a stage's inputs (equal hashes and options mean an equal product), and versions of its libraries."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from pipelines import __version__
from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.core.json_values import JsonValue
from pipelines.core.manifest import FileRecord, Memo, hash_file
from pipelines.core.options import InputMarker, StageOptions, flag_name, input_markers, input_paths
from pipelines.core.product_parts import ProductPart
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import StageSpec
from pipelines.core.workspace import Workspace

# A larger file, such as a bag, counts by its size and by samples: reading gigabytes for each `georef status` would
# be too slow, and its time of modification would make a copy stale.
_WHOLE_BYTES = 256 * 1024 * 1024
_SAMPLES, _SAMPLE_BYTES = 64, 1024 * 1024
_MOST_THREADS = 4


@dataclass(frozen=True)
class Fingerprints:
    """Inputs of a stage as they are.

    Attributes:
        hashes: of all inputs that decide the stage's result, by product or flag.
        files: files in the folders that options name, by flag and path in that folder.
    """

    hashes: dict[str, str] = field(default_factory=dict)
    files: dict[str, dict[str, FileRecord]] = field(default_factory=dict)


def fingerprints(
    workspace: Workspace,
    spec: StageSpec,
    options: StageOptions,
    memo: Memo,
    *,
    known: Mapping[str, Mapping[str, FileRecord]] | None = None,
    progress: Progress = SILENT,
) -> Fingerprints:
    """Return the inputs of a stage: hashes of their content, wherever they lie.

    - Products of the workspace, or parts of them, count by content.
    - Files that the options name count by content; those beyond 256 MiB by their size and 64 samples of 1 MiB.
    - Folders that the options name count by the names and contents of the visible files in them that can matter.

    Args:
        memo: hashes of products and of their files by path, extended here: each is hashed once.
        known: earlier `files`: a file in a folder with the size and time of its record is not read again.

    Raises:
        MissingProductError: a product does not exist.
        InputError: a path that an option names does not exist, or a file cannot be read.
    """
    result = Fingerprints()
    markers = input_markers(type(options))
    try:
        for part in spec.reads:
            result.hashes.update(hashes_of(workspace, part, memo))
        for name, path in input_paths(options).items():
            flag = flag_name(type(options), name)
            if not path.exists():
                raise InputError("no-such-file", "does not exist.", path=path, field=flag)
            if markers[name].first:
                result.hashes[flag] = first_hash(Workspace(path), markers[name].first, memo)
            elif path.is_dir():
                files = _input_files(path, workspace.root, markers[name])
                records = _records(files, (known or {}).get(flag, {}), progress)
                result.files[flag] = records
                result.hashes[flag] = _hash_listing({inside: record.sha256 for inside, record in records.items()})
            else:
                file_size(path, field=flag)
                beside = {inside: _hash_file(file) for inside, file in _beside(path, markers[name]).items()}
                whole = _hash_file(path)
                result.hashes[flag] = _hash_listing({"": whole, **beside}) if beside else whole
    except OSError as error:
        raise InputError("file-unreadable", f"cannot be read: {error.strerror}.", path=error.filename) from error
    return result


def first_hash(workspace: Workspace, parts: Sequence[ProductPart], memo: Memo) -> str:
    """Return the hash of the first of some parts that a workspace has; empty: none."""
    part = next((part for part in parts if workspace.has(part.product)), None)
    return "" if part is None else hashes_of(workspace, part, memo).get(part.product, "")


def hashes_of(workspace: Workspace, part: ProductPart, memo: Memo) -> dict[str, str]:
    """Return the hash of a part and of the products read with it; none for a missing or empty optional part."""
    if part.optional and not workspace.has(part.product):
        return {}
    path = workspace.path(part.product)
    try:
        values = _values(path, part)
    except ValueError:  # not JSON: the stage that reads the product raises the error
        values = None
    if values is None or (_is_empty(values) and not part.optional):
        if path not in memo and path.is_dir():
            memo[path] = _hash_listing({name: hash_file(file, memo) for name, file in _files(path).items()})
        return {part.product: hash_file(path, memo)}
    if _is_empty(values):
        return {}
    text = json.dumps(values, sort_keys=True)
    hashes = {part.product: hashlib.sha256(text.encode()).hexdigest()}
    for product in part.brings:
        hashes |= hashes_of(workspace, ProductPart(product, optional=True), memo)
    return hashes


def _values(path: Path, part: ProductPart) -> dict[str, Any] | None:
    """Return the values of a JSON document that decide the result, by field; None if the whole document does."""
    if not part.fields and not part.without:
        return None
    file_size(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if part.fields:
        values = {name: _value(document, name.split(".")) for name in part.fields}
        further = {name: _value(document, name.split(".")) for name in part.if_any}
        return values | {name: value for name, value in further.items() if value}
    if not isinstance(document, dict):
        return None
    return {name: value for name, value in document.items() if name not in part.without}


def _value(document: JsonValue, keys: Sequence[str]) -> Any:
    """Return the value at a path of keys, through every item of a list; None where a key is missing."""
    if not keys or document is None:
        return document
    if isinstance(document, list):
        return [_value(item, keys) for item in document]
    return _value(document.get(keys[0]), keys[1:]) if isinstance(document, dict) else None


def _is_empty(value: JsonValue) -> bool:
    if isinstance(value, dict):
        return all(_is_empty(item) for item in value.values())
    return value is None or (isinstance(value, list) and all(_is_empty(item) for item in value))


def _hash_listing(hashes: Mapping[str, str]) -> str:
    lines = "".join(f"{name}={hashes[name]}\n" for name in sorted(hashes))
    return hashlib.sha256(lines.encode()).hexdigest()


def _hash_file(path: Path) -> str:
    """Return the SHA-256 of a file, or of its size and samples if it is large."""
    size = path.stat().st_size
    if size <= _WHOLE_BYTES:
        return hash_file(path, {})
    digest = hashlib.sha256(f"{size}".encode())
    with path.open("rb") as handle:
        for sample in range(_SAMPLES):
            handle.seek(sample * (size - _SAMPLE_BYTES) // (_SAMPLES - 1))
            digest.update(handle.read(_SAMPLE_BYTES))
    return digest.hexdigest()


def _records(
    files: Mapping[str, Path], known: Mapping[str, FileRecord], progress: Progress
) -> dict[str, FileRecord]:
    """Return records of files by name; an unchanged file keeps its known record and is not read."""
    records = {name: known[name] for name, file in files.items() if name in known and _is_same(known[name], file)}
    unread = {name: file for name, file in files.items() if name not in records}
    if unread:
        threads = min(_MOST_THREADS, os.cpu_count() or 1)
        with progress.task("input files", len(unread)) as task, ThreadPoolExecutor(threads) as pool:
            for name, record in zip(unread, pool.map(_record, unread.values()), strict=True):
                records[name] = record
                task.advance()
    return records


def _is_same(record: FileRecord, path: Path) -> bool:
    stat = path.stat()
    return bool(record.sha256) and (record.size, record.mtime_ns) == (stat.st_size, stat.st_mtime_ns)


def _record(path: Path) -> FileRecord:
    """Return the record of a file; an unreadable file has no hash, because the stage raises the error."""
    stat = path.stat()
    try:
        sha256 = _hash_file(path)
    except OSError:
        sha256 = ""
    return FileRecord(size=stat.st_size, mtime_ns=stat.st_mtime_ns, sha256=sha256)


def _beside(path: Path, marker: InputMarker) -> dict[str, Path]:
    """Return the files that count with a file, by their paths from its folder."""
    patterns = dict(marker.beside).get(path.suffix.lower(), ())
    companions = {
        file for pattern in patterns for file in path.parent.glob(pattern) if file.is_file() and file != path
    }
    return {Path(os.path.relpath(file, path.parent)).as_posix(): file for file in companions}


def _input_files(folder: Path, workspace_root: Path, marker: InputMarker) -> dict[str, Path]:
    """Return the visible files of a folder that can matter, by name; a workspace inside the folder is left out."""
    if marker.only:
        return {name: folder / name for name in sorted(marker.only) if (folder / name).is_file()}
    # Resolved, because `workspace/../photos` is not in the workspace.
    real_folder, workspace = folder.resolve(), workspace_root.resolve()
    return {
        name: file
        for name, file in _files(folder).items()
        if not any(part.startswith(".") for part in file.relative_to(folder).parts)
        and not (real_folder / file.relative_to(folder)).is_relative_to(workspace)
        and (not marker.suffixes or file.suffix.lower() in marker.suffixes)
    }


def _files(folder: Path) -> dict[str, Path]:
    """Return the files below a folder by their path in it, as text that JSON can hold."""
    return {
        file.relative_to(folder).as_posix().encode("utf-8", "backslashreplace").decode(): file
        for file in sorted(file for file in folder.rglob("*") if file.is_file())
    }


LIBRARIES = ("numpy", "pycolmap", "torch", "numba", "pyproj")
NOT_INSTALLED = "not installed"


def library_versions(libraries: Sequence[str] = LIBRARIES) -> dict[str, str]:
    """Return the versions by distribution, this package's first; `not installed` for a missing one."""
    versions = {"georefgs": __version__}
    for name in libraries:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = NOT_INSTALLED
    return versions
