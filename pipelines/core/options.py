"""Options, each with its default, range and meaning in one place, and how they are given.

Precedence: default < the workspace's `georef.toml` (one table a stage) < command-line flag. The command line
derives its flags from these classes, so that a default exists once. Unknown keys and values out of range are
errors that name the key. Stages with many options have a file of their own: `ingest_config.py`,
`train_config.py`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from pipelines.core.errors import InputError

CONFIG_FILE = "georef.toml"
AUTO = "auto"
RigParameter = Literal["time-offset", "boresight", "lever-arm"]
RIG_PARAMETERS: tuple[RigParameter, ...] = get_args(RigParameter)


class InputMarker:
    """Marks a path whose content decides the stage's result: its fingerprint enters the manifest."""


InputPath = Annotated[Path, InputMarker()]


class StageOptions(BaseModel):
    """Base of all stage options: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def rig_parameters(text: str) -> str:
    """The text, if it is parameters of the rig with commas between.

    Raises:
        ValueError: it is not.
    """
    unknown = [name for name in text.split(",") if name not in RIG_PARAMETERS]
    if unknown:
        raise ValueError(f"{unknown[0]!r} is none of {', '.join(RIG_PARAMETERS)}")
    return text


def on_earth(text: str) -> str:
    """The text, if it is latitude,longitude,height of a place on Earth.

    Raises:
        ValueError: it is not.
    """
    lat, lon, alt = triple(text)
    if abs(lat) > 90 or abs(lon) > 180 or not -1000 <= alt <= 10000:
        raise ValueError("latitude −90 … 90, longitude −180 … 180, height −1000 … 10000")
    return text


def triple(text: str) -> tuple[float, float, float]:
    """Three finite numbers written with commas.

    Raises:
        ValueError: anything else.
    """
    parts = text.split(",")
    if len(parts) != 3:
        raise ValueError("three numbers with commas, like 46.02,7.75,1620")
    x, y, z = (float(part) for part in parts)
    if not all(abs(number) < 1e6 for number in (x, y, z)):
        raise ValueError("three finite numbers")
    return x, y, z


ConfigT = TypeVar("ConfigT", bound=StageOptions)


def flag_name(config_type: type[StageOptions], name: str) -> str:
    """The command-line flag of a field: its name with dashes, or what the field says."""
    info = config_type.model_fields.get(name)
    extra = info.json_schema_extra if info is not None else None
    stated = extra.get("flag") if isinstance(extra, dict) else None
    return str(stated) if stated else "--" + name.replace("_", "-")


def input_paths(config: StageOptions) -> dict[str, Path]:
    """The paths among a config's values whose content decides the stage's result, by field."""
    fields = type(config).model_fields
    return {
        name: Path(value)
        for name, info in fields.items()
        if _is_input(info) and (value := getattr(config, name)) is not None
    }


def resolve(config_type: type[ConfigT], table: Mapping[str, Any], flags: Mapping[str, Any], toml: Path) -> ConfigT:
    """Merge default < `table` of `toml` < `flags` into a validated config.

    Relative paths in the table are relative to the folder of `toml`.

    Raises:
        InputError: an unknown key or a value out of range; names the file (or flag) and the key.
    """
    merged = {**_anchored(config_type, table, toml.parent), **flags}
    try:
        return config_type.model_validate(merged)
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0]) if first["loc"] else "?"
        from_file = key in table and key not in flags
        known = ", ".join(sorted(config_type.model_fields))
        hint = f"unknown key; known keys: {known}" if first["type"] == "extra_forbidden" else first["msg"]
        name = key if from_file else flag_name(config_type, key)
        raise InputError(hint, path=toml if from_file else None, field=name) from error


def load_toml(path: Path, stages: Collection[str]) -> dict[str, dict[str, Any]]:
    """Read `georef.toml` into a table for each stage; a missing file is an empty one.

    Raises:
        InputError: not TOML, or a table that names no stage.
    """
    if not path.exists():
        return {}
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"not valid TOML: {error}", path=path) from error
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", path=path) from error
    for name, table in document.items():
        if name not in stages:
            raise InputError(f"unknown table; the stages are {', '.join(stages)}", path=path, field=name)
        if not isinstance(table, dict):
            raise InputError("expected a table of options", path=path, field=name)
    return document


def _is_input(info: FieldInfo) -> bool:
    """Whether a field is an `InputPath`, also where `InputPath | None` hides the marker in a union's member."""
    members = getattr(info.annotation, "__args__", ())
    marks = [*info.metadata, *(mark for member in members for mark in getattr(member, "__metadata__", ()))]
    return any(isinstance(mark, InputMarker) for mark in marks)


def _anchored(config_type: type[StageOptions], table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The table with its input paths made absolute."""
    fields = config_type.model_fields
    return {
        key: str(folder / value) if isinstance(value, str) and key in fields and _is_input(fields[key]) else value
        for key, value in table.items()
    }
