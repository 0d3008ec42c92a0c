"""Origin of each option's value: default, `georef.toml`, an earlier request, or the present command line."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal

from pipelines.core.options import StageOptions, flag_name, load_toml
from pipelines.core.stages import BY_NAME, StageSpec
from pipelines.core.staleness import Flags, stage_config
from pipelines.core.workspace import Workspace

Origin = Literal["default", "georef.toml", "remembered", "command line"]


@dataclass(frozen=True)
class OptionOrigin:
    """Value of an option, and where the value comes from.

    Attributes:
        stage: the subcommand.
        flag: of the command line.
        value: the resolved value.
        origin: `remembered` is a flag of an earlier command.
    """

    stage: str
    flag: str
    value: Any
    origin: Origin


def option_origins(workspace: Workspace, spec: StageSpec, flags: Flags | None = None) -> list[OptionOrigin]:
    """Return the options of a stage whose value is no default, with their origins.

    Args:
        workspace: holds `georef.toml` and the remembered options.
        spec: the stage.
        flags: the present request; None: what is remembered.

    Raises:
        InputError: an option is unknown or invalid.
    """
    remembered = workspace.requests().get(spec.name, {})
    asked = remembered if flags is None else flags
    options = stage_config(workspace, spec, asked)
    table = load_toml(workspace.config_file, BY_NAME).get(spec.name, {})
    rows = []
    for name in type(options).model_fields:
        origin: Origin = "default"
        if name in asked:
            is_old = flags is None or (name in remembered and remembered[name] == _plain(options, name))
            origin = "remembered" if is_old else "command line"
        elif name in table:
            origin = "georef.toml"
        if origin != "default":
            rows.append(OptionOrigin(spec.name, flag_name(type(options), name), getattr(options, name), origin))
    return rows


def names_of_flags(options_type: type[StageOptions], flags: Collection[str]) -> list[str]:
    """Return the fields of the flags that a user names, without dashes in front: `gcp`, `max-image-size`.

    Raises:
        ValueError: no option has one of the names.
    """
    by_flag = {flag_name(options_type, name).removeprefix("--"): name for name in options_type.model_fields}
    named = [text.removeprefix("--").replace("_", "-") for text in flags]
    unknown = [text for text in named if text not in by_flag]
    if unknown:
        raise ValueError(f"{unknown[0]!r} is no option; the options are {', '.join(by_flag)}")
    return [by_flag[text] for text in named]


def _plain(options: StageOptions, name: str) -> Any:
    """Return an option's value as JSON has it, the form in which it is remembered."""
    return options.model_dump(mode="json")[name]
