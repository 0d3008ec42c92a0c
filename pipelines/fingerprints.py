"""What decides a stage's result, as hashes: equal hashes and equal options mean an equal product."""

from __future__ import annotations

import hashlib
from pathlib import Path

from pipelines.config import StageConfig, flag_name, input_paths
from pipelines.errors import InputError
from pipelines.stages import StageSpec
from pipelines.workspace import Workspace

Memo = dict[Path, str]
_WHOLE_BYTES = 256 * 1024 * 1024


def fingerprints(workspace: Workspace, spec: StageSpec, config: StageConfig, memo: Memo) -> dict[str, str]:
    """Hashes of everything that decides a stage's result, by product or flag.

    Workspace products by content; files that the options name by content, those beyond 256 MiB (bags) and folders
    by the name, size and modification time of each file (reading gigabytes at each look would be too slow).

    Args:
        memo: hashes found so far; a product that several stages read is hashed once.

    Raises:
        MissingProductError: a product is not there.
        InputError: a path that an option names does not exist, or something cannot be read.
    """
    try:
        found = {product: _hash_product(workspace.path(product), memo) for product in spec.reads}
        for name, path in input_paths(config).items():
            flag = flag_name(type(config), name)
            if not path.exists():
                raise InputError("no such file or folder", path=path, field=flag)
            found[flag] = _hash_input(path, workspace.root)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=error.filename) from error
    return found


def _hash_input(path: Path, workspace_root: Path) -> str:
    if path.is_dir():
        return _hash_listing(path, workspace_root)
    stat = path.stat()
    if stat.st_size > _WHOLE_BYTES:
        return hashlib.sha256(f"{path.name} {stat.st_size} {stat.st_mtime_ns}".encode()).hexdigest()
    return _hash_file(path)


def _hash_file(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def _hash_product(path: Path, memo: Memo) -> str:
    if path not in memo:
        memo[path] = _hash_file(path) if path.is_file() else _hash_folder(path)
    return memo[path]


def _hash_folder(path: Path) -> str:
    digest = hashlib.sha256()
    for file in _files(path):
        digest.update(f"{file.relative_to(path)}={_hash_file(file)}\n".encode())
    return digest.hexdigest()


def _hash_listing(path: Path, workspace_root: Path) -> str:
    """Hash of the visible files' names, sizes and times; a workspace inside the folder is no input of itself."""
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
