"""Hashes of the inputs of a stage: equal hashes and equal options mean an equal product."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.files import file_size
from pipelines.core.manifest import Memo, hash_file
from pipelines.core.options import StageOptions, flag_name, input_paths
from pipelines.core.stages import ProductPart, StageSpec
from pipelines.core.workspace import Workspace

_WHOLE_BYTES = 256 * 1024 * 1024


def fingerprints(workspace: Workspace, spec: StageSpec, options: StageOptions, memo: Memo) -> dict[str, str]:
    """Return the hashes of all inputs that decide a stage's result, by product or flag.

    - Products of the workspace, or parts of them, count by content.
    - Files that the options name count by content. Those beyond 256 MiB (bags) and folders count by the name, size
      and modification time of each file: reading gigabytes for each `georef status` would be too slow.

    Args:
        workspace: holds the products.
        spec: the stage.
        options: the stage's options.
        memo: hashes of products and of their files by path, extended here: each is hashed once.

    Raises:
        MissingProductError: a product does not exist.
        InputError: a path that an option names does not exist, or a file cannot be read.
    """
    hashes: dict[str, str] = {}
    try:
        for part in spec.reads:
            hashes |= _hash_part(workspace, part, memo)
        for name, path in input_paths(options).items():
            flag = flag_name(type(options), name)
            if not path.exists():
                raise InputError("no such file or folder", path=path, field=flag)
            hashes[flag] = _hash_input(path, workspace.root, flag)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=error.filename) from error
    return hashes


def _hash_part(workspace: Workspace, part: ProductPart, memo: Memo) -> dict[str, str]:
    """Return the hash of a part and of the products that it brings; none for a missing or empty optional part."""
    try:
        path = workspace.path(part.product)
    except MissingProductError:
        if part.optional:
            return {}
        raise
    try:
        values = _values(path, part.fields)
    except ValueError:  # not JSON: the stage that reads the product raises the error
        values = None
    if values is None or (_is_empty(values) and not part.optional):
        return {part.product: _hash_product(path, memo)}
    if _is_empty(values):
        return {}
    text = json.dumps(dict(zip(part.fields, values, strict=True)), sort_keys=True)
    hashes = {part.product: hashlib.sha256(text.encode()).hexdigest()}
    for product in part.brings:
        hashes |= _hash_part(workspace, ProductPart(product, optional=True), memo)
    return hashes


def _values(path: Path, fields: Sequence[str]) -> list[Any] | None:
    """Return the values of a JSON document's fields; None if `fields` is empty."""
    if not fields:
        return None
    file_size(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    return [_value(document, field.split(".")) for field in fields]


def _value(document: Any, keys: Sequence[str]) -> Any:
    """Return the value at a path of keys, through every item of a list; None where a key is missing."""
    if not keys or document is None:
        return document
    if isinstance(document, list):
        return [_value(item, keys) for item in document]
    return _value(document.get(keys[0]), keys[1:]) if isinstance(document, dict) else None


def _is_empty(value: Any) -> bool:
    return value is None or (isinstance(value, list) and all(_is_empty(item) for item in value))


def _hash_input(path: Path, workspace_root: Path, flag: str) -> str:
    if path.is_dir():
        return _hash_listing(path, workspace_root)
    file_size(path, field=flag)
    stat = path.stat()
    if stat.st_size > _WHOLE_BYTES:
        return hashlib.sha256(f"{path.name} {stat.st_size} {stat.st_mtime_ns}".encode()).hexdigest()
    return hash_file(path, {})


def _hash_product(path: Path, memo: Memo) -> str:
    if path not in memo:
        memo[path] = _hash_folder(path, memo) if path.is_dir() else hash_file(path, memo)
    return memo[path]


def _hash_folder(path: Path, memo: Memo) -> str:
    digest = hashlib.sha256()
    for file in _files(path):
        digest.update(f"{file.relative_to(path)}={hash_file(file, memo)}\n".encode())
    return digest.hexdigest()


def _hash_listing(path: Path, workspace_root: Path) -> str:
    """Return the hash of the names, sizes and times of visible files; a workspace inside the folder is left out."""
    digest = hashlib.sha256()
    for file in _files(path):
        hidden = any(part.startswith(".") for part in file.relative_to(path).parts)
        if hidden or file.is_relative_to(workspace_root):
            continue
        stat = file.stat()
        digest.update(f"{file.relative_to(path)} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def _files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.rglob("*") if file.is_file())
