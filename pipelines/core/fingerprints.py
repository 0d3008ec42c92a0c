"""What decides a stage's result, as hashes: equal hashes and equal options mean an equal product."""

from __future__ import annotations

import hashlib
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.options import StageOptions, flag_name, input_paths
from pipelines.core.products import load_json
from pipelines.core.stages import SURVEY, StageSpec
from pipelines.core.workspace import Workspace
from pipelines.scene.survey import Survey

Memo = dict[Path, str]
_WHOLE_BYTES = 256 * 1024 * 1024


def fingerprints(workspace: Workspace, spec: StageSpec, config: StageOptions, memo: Memo) -> dict[str, str]:
    """Hashes of everything that decides a stage's result, by product or flag.

    Workspace products by content; files that the options name by content, those beyond 256 MiB (bags) and folders
    by the name, size and modification time of each file (reading gigabytes at each look would be too slow). Of the
    survey, sfm reads the photographs, their cameras, and the positions and attitudes as recorded.

    Args:
        memo: hashes found so far; a product that several stages read is hashed once.

    Raises:
        MissingProductError: a product is not there.
        InputError: a path that an option names does not exist, or something cannot be read.
    """
    try:
        found = {product: _hash_read(workspace, spec, product, memo) for product in spec.reads}
        for name, path in input_paths(config).items():
            flag = flag_name(type(config), name)
            if not path.exists():
                raise InputError("no such file or folder", path=path, field=flag)
            found[flag] = _hash_input(path, workspace.root)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=error.filename) from error
    return found


def product_hash(workspace: Workspace, product: str) -> str:
    """The hash of a product by content.

    Raises:
        MissingProductError: it is not there.
    """
    return _hash_product(workspace.path(product), {})


def layout_of(survey: Survey) -> str:
    """Hash of a survey's positions and attitudes as they were recorded, whatever was applied to them after sfm."""
    if survey.rig is not None and survey.rig.layout:
        return survey.rig.layout
    layout = [
        (image.fix and image.fix.position_in_geo, image.attitude and image.attitude.quat_xyzw)
        for image in survey.images
    ]
    return hashlib.sha256(repr(layout).encode()).hexdigest()


def _hash_read(workspace: Workspace, spec: StageSpec, product: str, memo: Memo) -> str:
    path = workspace.path(product)
    if not (spec.photographs_only and product == SURVEY):
        return _hash_product(path, memo)
    try:
        survey = load_json(Survey, path)
    except InputError:  # the stage will tell
        return _hash_product(path, memo)
    cameras = [camera.model_dump() for camera in survey.cameras]
    images = [(image.name, image.camera_id, image.sha256) for image in survey.images]
    return hashlib.sha256(repr((survey.image_dir, cameras, images, layout_of(survey))).encode()).hexdigest()


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
