"""Missions of a batch: from a TOML file with defaults and differences, or from a folder of mission folders.

Input is hostile until parsed. Workspaces lie inside the folder of the file. A table may name inputs anywhere, as
`georef.toml` may. The first bad value is an error that names mission and key, before any work starts.
"""

import re
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipelines.core.errors import GeorefError, InputError
from pipelines.core.files import file_size
from pipelines.core.json_values import JsonValue
from pipelines.core.options import CONFIG_FILE, REQUESTS, input_markers, load_toml, read_requests, read_toml
from pipelines.core.sentences import fault_sentence
from pipelines.core.stages import BY_NAME, StageSpec, named_deliverables, stage_slice
from pipelines.core.staleness import Flags
from pipelines.core.validators import stays_inside
from pipelines.core.workspace import Workspace

_MAX_TOML_BYTES = 4 * 1024 * 1024
_MOST_MISSIONS = 10_000
_NAME = re.compile(r"[^\W_][\w.-]{0,99}(?<!\.)")
_OWN_KEYS = ("workspace", "to", "deliver")
# Files of a mission folder under their usual names, by option of `ingest`.
USUAL_INPUTS = {
    "images": "images",
    "trajectory": "trajectory.csv",
    "gcp": "gcp_list.txt",
    "checkpoints": "checkpoints.txt",
}

Owners = Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class Mission:
    """Mission of a batch."""

    name: str  # unique in the batch, and a name of a folder
    workspace: Workspace  # which may not exist yet
    relative_path: str  # of its workspace, relative to the folder of the batch
    last: str | None = None  # last stage to run; None: all
    deliver: str | None = None  # as for `georef run --deliver`
    flags: Mapping[str, Flags] = field(default_factory=dict, hash=False)  # by stage and field

    @property
    def stages(self) -> tuple[StageSpec, ...]:
        return (*stage_slice(None, self.last), *named_deliverables(self.deliver))


@dataclass(frozen=True)
class MissionList:
    """Missions of a batch, which has the name of its file or folder; the folder receives the table of results."""

    name: str
    folder: Path
    missions: tuple[Mission, ...]


def load_missions(
    path: Path,
    owners: Owners,
    last: str | None = None,
    deliver: str | None = None,
    flags: Mapping[str, Flags] | None = None,
) -> MissionList:
    """Return the missions of a TOML file, or of a folder; an InputError names file, mission and key.

    Args:
        owners: options that a mission may have outside the tables of its stages, with the stages that they are for.
        last, deliver, flags: as of `Mission`; they override those of every mission.
    """
    listed = _in_folder(path) if path.is_dir() else _in_file(path, owners)
    if not listed.missions:
        raise InputError("no-missions", "holds no mission.", path=path)
    missions = tuple(
        replace(
            mission,
            last=last or mission.last,
            deliver=deliver or mission.deliver,
            flags=_merged(mission.flags, flags or {}),
        )
        for mission in listed.missions
    )
    return replace(listed, missions=missions)


def _merged(flags: Mapping[str, Flags], more: Mapping[str, Flags]) -> dict[str, Flags]:
    return {stage: {**flags.get(stage, {}), **more.get(stage, {})} for stage in (*flags, *more)}


def _in_folder(folder: Path) -> MissionList:
    """Return the missions of a folder: its folders with photographs, with `georef.toml`, or begun before."""
    signs = (USUAL_INPUTS["images"], CONFIG_FILE, REQUESTS)
    missions = []
    for root in sorted(folder.iterdir()):
        if root.name.startswith(".") or not root.is_dir() or not any((root / sign).exists() for sign in signs):
            continue
        _require_name(root.name, folder, root.name)
        _require_inside(root, folder, folder, root.name)
        workspace = Workspace(root)
        known = {
            *load_toml(workspace.config_file, BY_NAME).get("ingest", {}),
            *read_requests(workspace.root).get("ingest", {}),
        }
        usual = {
            option: root / name
            for option, name in USUAL_INPUTS.items()
            if option not in known and (root / name).exists()
        }
        if "bag" in known:
            usual.pop("images", None)
        missions.append(Mission(root.name, workspace, root.name, flags={"ingest": usual}))
    return MissionList(folder.resolve().name, folder, tuple(missions))


def _in_file(path: Path, owners: Owners) -> MissionList:
    file_size(path, limit_bytes=_MAX_TOML_BYTES, kind="list of missions")
    document = read_toml(path)
    for key, value in document.items():
        if key not in ("defaults", "missions"):
            message = "is no table of missions. The tables are defaults and missions."
            raise InputError("unknown-table", message, path=path, field=key)
        if not isinstance(value, dict):
            raise InputError("not-a-table", "is not a table.", path=path, field=key)
    tables = document.get("missions", {})
    if len(tables) > _MOST_MISSIONS:
        message = f"holds too many missions: {len(tables)} (limit {_MOST_MISSIONS})."
        raise InputError("too-many-missions", message, path=path)
    defaults = _Table(path, "defaults", owners).read(document.get("defaults", {}))
    missions = tuple(_mission(path, name, table, defaults, owners) for name, table in tables.items())
    _require_own_workspaces(path, missions)
    return MissionList(path.stem, path.parent, missions)


@dataclass(frozen=True)
class _Settings:
    texts: Mapping[str, str]
    flags: Mapping[str, Flags]


@dataclass(frozen=True)
class _Table:
    """Reader of `[defaults]` or of one mission's table; `owners` as of `load_missions`."""

    path: Path
    name: str
    owners: Owners

    def read(self, table: JsonValue) -> _Settings:
        """Return the content of the table, or raise an InputError for an unknown key or a bad value."""
        if not isinstance(table, dict):
            message = "is not a table."
            remedy = f"Write [{self.name}], and its options below."
            raise InputError("not-a-table", message, path=self.path, field=self.name, remedy=remedy)
        texts: dict[str, str] = {}
        flags: dict[str, dict[str, Any]] = {}
        for key, value in table.items():
            if key in _OWN_KEYS:
                texts[key] = self._mission_text(key, value)
            elif key in BY_NAME:
                if not isinstance(value, dict):
                    raise self._error("not-a-table", key, "is not a table of options.")
                given = {
                    name: self._value(BY_NAME[key], name, each, f"{key}.{name}") for name, each in value.items()
                }
                flags.setdefault(key, {}).update(given)
            elif key in self.owners:
                for owner in self.owners[key]:
                    flags.setdefault(owner, {})[key] = self._value(BY_NAME[owner], key, value, key)
            else:
                known = ", ".join((*_OWN_KEYS, *self.owners))
                message = f"is unknown. The keys are {known}, and the tables of stages: {', '.join(BY_NAME)}."
                raise self._error("unknown-option", key, message)
        return _Settings(texts, flags)

    def _mission_text(self, key: str, value: JsonValue) -> str:
        if not isinstance(value, str):
            raise self._error("not-a-text", key, "is not a text.")
        try:
            if key == "to":
                stage_slice(None, value) if value in BY_NAME else BY_NAME[value]
            elif key == "deliver":
                named_deliverables(value)
            elif not stays_inside(value):
                raise ValueError("leads out of the folder of the file. Give a relative path inside it.")
        except KeyError as error:
            raise self._error("unknown-stage", key, f"is no stage. The stages are {', '.join(BY_NAME)}.") from error
        except (GeorefError, ValueError) as error:
            code = "path-leaves-folder" if key == "workspace" else "option-invalid"
            raise self._error(code, key, str(error)) from error
        return value

    def _value(self, spec: StageSpec, option: str, value: JsonValue, key: str) -> Any:
        """Return the value of an option, with paths relative to the file made absolute."""
        if option not in spec.options.model_fields:
            known = ", ".join(spec.options.model_fields)
            raise self._error("unknown-option", key, f"is unknown. The options of {spec.name} are {known}.")
        if any(unicodedata.category(sign) in ("Cc", "Cs") for text in _texts(value) for sign in text):
            raise self._error("control-character", key, "has a control character.")
        if option in input_markers(spec.options) and isinstance(value, str):
            value = str((self.path.parent / value).absolute())
        try:
            spec.options.model_validate({option: value})
        except ValidationError as error:
            at_option = next((fault for fault in error.errors() if fault["loc"][:1] == (option,)), None)
            if at_option is not None:  # A fault of several options together is found when all are known.
                raise self._error("option-invalid", key, fault_sentence(at_option)) from error
        return value

    def _error(self, code: str, key: str, message: str) -> InputError:
        return InputError(code, message, path=self.path, field=f"{self.name}.{key}")


def _mission(path: Path, name: str, table: JsonValue, defaults: _Settings, owners: Owners) -> Mission:
    label = f"missions.{name}"
    _require_name(name, path, label)
    stated = _Table(path, label, owners).read(table)
    settings = {**defaults.texts, **stated.texts}
    flags = _merged(defaults.flags, stated.flags)
    for stage, given in flags.items():
        try:
            BY_NAME[stage].options.model_validate(given)
        except ValidationError as error:
            sentence = fault_sentence(error.errors()[0])
            raise InputError("option-invalid", sentence, path=path, field=f"{label}.{stage}") from error
    relative_path = stated.texts.get(
        "workspace", f"{defaults.texts['workspace']}/{name}" if "workspace" in defaults.texts else name
    )
    root = path.parent.absolute() / relative_path
    _require_inside(root, path.parent, path, label)
    mission = Mission(name, Workspace(root), relative_path, settings.get("to"), settings.get("deliver"), flags)
    running = {spec.name for spec in mission.stages}
    for key in table:
        stages = (key,) if key in BY_NAME else owners.get(key, ())
        if stages and not running.intersection(stages):
            text = f"is for {' and '.join(stages)}, which is not among the stages to run."
            raise InputError("stage-not-run", text, path=path, field=f"{label}.{key}")
    return mission


def _require_name(name: str, path: Path, label: str) -> None:
    if not _NAME.fullmatch(name):
        message = "cannot be the name of a mission."
        remedy = "Use letters, digits, '.', '-' and '_'."
        raise InputError("mission-name", message, path=path, field=label, remedy=remedy)


def _require_inside(root: Path, folder: Path, path: Path, label: str) -> None:
    """Refuse a workspace that a symbolic link leads out of its folder."""
    if not root.resolve().is_relative_to(folder.resolve()):
        message = "has a workspace that leads out of the folder of missions."
        raise InputError("path-leaves-folder", message, path=path, field=label)


def _require_own_workspaces(path: Path, missions: Sequence[Mission]) -> None:
    """Refuse two missions in one workspace; some file systems do not tell capitals from small letters."""
    taken: dict[str, str] = {}
    for mission in missions:
        root = str(mission.workspace.root.resolve()).casefold()
        if root in taken:
            message = f"is the workspace of {taken[root]} too. Each mission needs its own."
            raise InputError("workspace-shared", message, path=path, field=f"missions.{mission.name}.workspace")
        taken[root] = mission.name


def _texts(value: JsonValue) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, list):
        for part in value:
            yield from _texts(part)
