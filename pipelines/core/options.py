"""Options of the stages, each with its default, range and meaning in one place.

Precedence: default < the workspace's `georef.toml` (one table a stage) < flags remembered in `requests.json` < flag
(`resolve`, `remembered`). The command line derives its flags from the classes of options, so that a default exists
once. Unknown keys and values out of range are errors that name the key.

Options hold parsed values. An option that users write as text (`0.1,0,-0.3`, `2s`, `auto`) has a type with two
annotations: `from_text` parses the text of a flag, of `georef.toml` and of an earlier version's manifest; `WRITTEN`
marks the flag as text for the command line.
"""

import json
import os
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from pipelines.core.errors import InputError
from pipelines.core.extras import Extra, require
from pipelines.core.files import file_size, replace_text
from pipelines.core.json_values import JsonValue
from pipelines.core.product_parts import ProductPart
from pipelines.core.sentences import fault_sentence
from pipelines.core.types import Vector3
from pipelines.core.validators import require_text

OptionValue = Any  # of its field's type, or as a file or the command line has it

CONFIG_FILE = "georef.toml"
_MAX_TOML_BYTES = 1024 * 1024
# A mission's option has four parts: missions.NAME.STAGE.OPTION.
_MOST_PARTS, _INTEGERS = 16, 1 << 63
_LONG_KEY = re.compile(rf"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){{{_MOST_PARTS}}}""")


@dataclass(frozen=True)
class InputMarker:
    """Mark of a path whose content decides the stage's result: its fingerprint enters the manifest.

    In a folder, files with the suffixes, in lower case, count; without any, all do. With `only`, the files at these
    places in the folder count, as far as there are any; with `first`, of a workspace, the first of these products
    that it has. Files `beside` a file count with it: by its suffix, in lower case, patterns in its folder.
    """

    suffixes: frozenset[str] = frozenset()
    only: frozenset[str] = frozenset()
    first: tuple[ProductPart, ...] = ()
    beside: tuple[tuple[str, tuple[str, ...]], ...] = ()


class WrittenMarker:
    """Mark of an option that users write as text; `notation` gives the text of its value."""


@dataclass(frozen=True)
class ExtraMarker:
    """Mark of an option that needs an extra of the installation where it is given."""

    extra: Extra


@dataclass(frozen=True)
class NeedMarker:
    """Mark of an option of which some values need what a machine may lack.

    `require` takes the value, and raises a BackendUnavailableError that names what is missing.
    """

    require: Callable[[Any], None]


class EffortMarker:
    """Mark of an option that changes the time or the messages of a stage, and not its result."""


class HiddenMarker:
    """Mark of an option that no user needs: it is valid everywhere, and help and documentation leave it out."""


InputPath = Annotated[Path, InputMarker()]
WRITTEN = WrittenMarker()
EFFORT = EffortMarker()
HIDDEN = HiddenMarker()


class StageOptions(BaseModel):
    """Base of all stage options: immutable, no unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def from_text(parse: Callable[[str], object]) -> BeforeValidator:
    """Return a validator that parses texts; other values (a TOML array, a manifest's JSON) pass unparsed."""
    return BeforeValidator(lambda value: parse(value) if isinstance(value, str) else value)


def listed_names(text: str, known: Collection[str], otherwise: str = "") -> tuple[str, ...]:
    """Return the names in a text with commas; a ValueError, ended by `otherwise`, names one that is not known."""
    names = tuple(text.split(","))
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"{unknown[0]!r} is none of {', '.join(known)}{otherwise}")
    return names


def notation(value: object) -> str:
    """Return an option's value as a user writes it: `0.1,0,-0.3`, `2s`, `auto`."""
    if isinstance(value, tuple):
        return ",".join(notation(part) for part in value)
    return f"{value:.15g}" if isinstance(value, float) else str(value)


def triple_of(text: str) -> tuple[float, ...]:
    """Return the three numbers of a text with commas; a ValueError: it has others."""
    parts = text.split(",")
    if len(parts) != 3:
        raise ValueError(f"{text!r} is not three numbers with commas, such as 46.02,7.75,1620")
    return tuple(float(part) for part in parts)


def _finite(numbers: Vector3) -> Vector3:
    if not all(abs(number) < 1e6 for number in numbers):
        raise ValueError("each number must be below 1000000 in magnitude")
    return numbers


def _on_earth(position: Vector3) -> Vector3:
    lat, lon, alt = position
    if abs(lat) > 90 or abs(lon) > 180 or not -1000 <= alt <= 10000:
        raise ValueError(
            "the range is −90 … 90° of latitude, −180 … 180° of longitude and −1000 … 10000 m of height"
        )
    return position


Triple = Annotated[Vector3, from_text(triple_of), AfterValidator(_finite), WRITTEN]
# Latitude and longitude in degrees, ellipsoidal height in metres.
PlaceOnEarth = Annotated[Vector3, from_text(triple_of), AfterValidator(_finite), AfterValidator(_on_earth), WRITTEN]

OptionsT = TypeVar("OptionsT", bound=StageOptions)


def flag_name(options_type: type[StageOptions], name: str) -> str:
    """Return the command-line flag of a field: its name with dashes, or the flag that the field states."""
    info = options_type.model_fields.get(name)
    extra = info.json_schema_extra if info is not None else None
    stated = extra.get("flag") if isinstance(extra, dict) else None
    return str(stated) if stated else "--" + name.replace("_", "-")


def input_markers(options_type: type[StageOptions]) -> dict[str, InputMarker]:
    """Return the marks of the options that are paths whose content decides the stage's result, by field."""
    return {
        name: mark
        for name, info in options_type.model_fields.items()
        for mark in marks_of(info)
        if isinstance(mark, InputMarker)
    }


def input_paths(options: StageOptions) -> dict[str, Path]:
    """Return the paths among the options whose content decides the stage's result, by field."""
    paths = {name: getattr(options, name) for name in input_markers(type(options))}
    return {name: Path(path) for name, path in paths.items() if path is not None}


def decisive_fields(options_type: type[StageOptions]) -> list[str]:
    """Return the options whose values decide a stage's result: all but those of effort, and paths of inputs."""
    fields = options_type.model_fields
    inputs = input_markers(options_type)
    return [name for name, info in fields.items() if name not in inputs and EFFORT not in marks_of(info)]


def require_available(options: StageOptions) -> None:
    """Raise a BackendUnavailableError if an option needs an extra, or a device, that this machine lacks."""
    for name, info in type(options).model_fields.items():
        value = getattr(options, name)
        for mark in marks_of(info) if value is not None else ():
            if isinstance(mark, ExtraMarker):
                require(mark.extra)
            elif isinstance(mark, NeedMarker):
                mark.require(value)


def as_flags(options: StageOptions, names: Collection[str]) -> str:
    """Return options as the words of a command line: `--preset fast --no-dense`, `--forget crop-size` for none."""
    words = []
    for name in names:
        flag, value = flag_name(type(options), name), getattr(options, name)
        if value is None:
            words += ["--forget", flag.removeprefix("--")]
        elif isinstance(value, bool):
            words.append(flag if value else f"--no-{flag.removeprefix('--')}")
        else:
            words += [flag, notation(value)]
    return " ".join(words)


def names_of_flags(options_type: type[StageOptions], flags: Collection[str]) -> list[str]:
    """Return the fields of flags as a user names them (`gcp`, `max-image-size`); a ValueError: one is unknown."""
    by_flag = {flag_name(options_type, name).removeprefix("--"): name for name in options_type.model_fields}
    named = [text.removeprefix("--").replace("_", "-") for text in flags]
    unknown = [text for text in named if text not in by_flag]
    if unknown:
        raise ValueError(f"{unknown[0]!r} is no option. The options are {', '.join(by_flag)}.")
    return [by_flag[text] for text in named]


def resolve(
    options_type: type[OptionsT],
    table: Mapping[str, OptionValue],
    flags: Mapping[str, OptionValue],
    toml: Path,
    *,
    stage: str | None = None,
) -> OptionsT:
    """Return validated options: default < `table` < `flags`; an InputError names file, table and key, or the flag.

    Args:
        table: the stage's table in `georef.toml`; its relative paths are relative to the folder of that file.
        flags: options that the user gave as flags, now or before, by field.
        toml, stage: path of `georef.toml`, and name of the table, for errors.
    """
    inputs = input_markers(options_type)
    anchored = {
        key: str(toml.parent / value) if isinstance(value, str) and key in inputs else value
        for key, value in table.items()
    }
    try:
        options = options_type.model_validate({**anchored, **flags})
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][0]) if first["loc"] else "?"
        from_file = key in table and key not in flags
        known = ", ".join(sorted(options_type.model_fields))
        code, message, remedy = "option-invalid", fault_sentence(first), ""
        if first["type"] == "extra_forbidden":
            code, message = "unknown-option", f"is unknown. The options are {known}."
            remembered_in = toml.parent / REQUESTS
            if not from_file and remembered_in.exists():  # what the command line offers is known
                remedy = f"An earlier version of GeoRefGS has remembered it: delete it from {remembered_in}."
        in_file = key if stage is None else f"{stage}.{key}"
        name = in_file if from_file else flag_name(options_type, key)
        raise InputError(code, message, path=toml if from_file else None, field=name, remedy=remedy) from error
    for name in options_type.model_fields:
        value = getattr(options, name)
        if isinstance(value, Path):
            require_text(value, flag_name(options_type, name))
    return options


def read_toml(path: Path) -> dict[str, Any]:
    """Return the document of a TOML file, whose size was checked before."""
    try:
        return parse_toml(path.read_text(encoding="utf-8-sig"))
    except ValueError as error:
        raise InputError("toml-invalid", f"is not valid TOML: {error}.", path=path) from error
    except OSError as error:
        raise InputError("file-unreadable", f"cannot be read: {error.strerror}.", path=path) from error


def parse_toml(text: str) -> dict[str, Any]:
    """Return a document of TOML; a ValueError: none, a key of more than 16 parts, or an integer beyond 64 bits.

    Keys with dots cost the square of their parts in time and memory, and are bounded first.
    """
    key = _LONG_KEY.search(text)
    if key is not None:
        line = text.count("\n", 0, key.start()) + 1
        raise ValueError(f"a key has more than {_MOST_PARTS} parts (at line {line})")
    try:
        document = tomllib.loads(text)
        _require_integers(document)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError as error:
        raise ValueError("values are nested too deeply") from error
    except ValueError as error:  # Python refuses to read more digits than a few thousand.
        raise ValueError("an integer is beyond 64 bits") from error
    return document


def _require_integers(value: JsonValue) -> None:
    """Refuse integers beyond 64 bits, which TOML does not have."""
    if isinstance(value, int) and not -_INTEGERS <= value < _INTEGERS:
        raise ValueError
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    for part in parts:
        _require_integers(part)


def load_toml(path: Path, stages: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return the tables of `georef.toml`, if there is one, by stage; an InputError: no TOML, or no such stage."""
    if not path.exists():
        return {}
    file_size(path, limit_bytes=_MAX_TOML_BYTES)
    document = read_toml(path)
    for name, table in document.items():
        if name not in stages:
            raise InputError(
                "unknown-stage", f"is no stage. The stages are {', '.join(stages)}.", path=path, field=name
            )
        if not isinstance(table, dict):
            raise InputError("not-a-table", "is not a table of options.", path=path, field=name)
    return document


def marks_of(info: FieldInfo) -> list[object]:
    """Return a field's marks, with those that `… | None` hides in a member of the union."""
    members = getattr(info.annotation, "__args__", ())
    return [*info.metadata, *(mark for member in members for mark in getattr(member, "__metadata__", ()))]


REQUESTS = "requests.json"
_PLACE = "workspace"  # no stage has this name


def remembered(
    root: Path,
    stages: Iterable[str],
    flags: Mapping[str, Mapping[str, OptionValue]],
    forget: Mapping[str, Collection[str]] | None = None,
) -> dict[str, dict[str, Any]]:
    """Return by stage the options last requested, but those to forget, overridden by flags."""
    requested = {}
    before = read_requests(root)
    for stage in stages:
        forgotten = (forget or {}).get(stage, ())
        kept = {name: value for name, value in before.get(stage, {}).items() if name not in forgotten}
        requested[stage] = {**kept, **flags.get(stage, {})}
    return requested


def read_requests(root: Path) -> dict[str, dict[str, Any]]:
    """Return the options of the last requests, by stage, for `georef run`; an InputError: the file is damaged.

    Input paths are remembered as absolute paths, with the place of the workspace. A path that is gone after the
    workspace was moved is looked for where it would lie if it had been moved along.
    """
    path = root / REQUESTS
    if not path.exists():
        return {}
    file_size(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(
            "requests-damaged", "is not valid JSON.", path=path, remedy="Delete it, and give the options again."
        ) from error
    if not isinstance(document, dict) or not all(isinstance(flags, dict) for flags in document.values()):
        raise InputError(
            "requests-damaged",
            "has no options by stage.",
            path=path,
            remedy="Delete it, and give the options again.",
        )
    former_root = document.pop(_PLACE, {}).get("root")
    if not isinstance(former_root, str) or former_root == str(root):
        return document
    return {
        stage: {name: _moved(value, Path(former_root), root) for name, value in flags.items()}
        for stage, flags in document.items()
    }


def remember(root: Path, flags: Mapping[str, Mapping[str, OptionValue]]) -> None:
    """Record the options that some stages are requested with, by stage."""
    requested = {**read_requests(root), **flags}
    document = {**{stage: dict(given) for stage, given in requested.items()}, _PLACE: {"root": str(root)}}
    replace_text(root / REQUESTS, json.dumps(document, indent=1, default=str) + "\n")


def _moved(value: JsonValue, before: Path, root: Path) -> Any:
    """Return a path that is gone as it lies beside a workspace that was at `before`; any other value as it is."""
    if not isinstance(value, str) or not Path(value).is_absolute():
        return value
    try:
        beside = Path(os.path.normpath(root / os.path.relpath(value, before)))
        return str(beside) if not Path(value).exists() and beside.exists() else value
    except (OSError, ValueError):  # no path of this system
        return value
