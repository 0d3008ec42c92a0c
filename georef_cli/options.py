"""Options of the commands: those that commands share, and those of a stage, also as texts (`--set`).

A stage's options are derived from its class of options (names, types, meaning, defaults): each is defined once.
"""

import inspect
import logging
import types
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import click
from pydantic.fields import FieldInfo

from pipelines.core.options import (
    HIDDEN,
    WRITTEN,
    OptionsT,
    StageOptions,
    flag_name,
    input_markers,
    marks_of,
    names_of_flags,
    notation,
    parse_toml,
    resolve,
)
from pipelines.core.stages import StageSpec
from pipelines.core.workspace import Workspace

log = logging.getLogger(__name__)

_BOUNDS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
FILE, FOLDER = (click.Path(file_okay=is_file, resolve_path=True, path_type=Path) for is_file in (True, False))


def flag(*names: str, text: str) -> click.Option:
    """Return an option without a value; `text` is its help."""
    return click.Option(names, is_flag=True, help=text)


WORKSPACE = click.Argument(
    ["workspace"],
    type=FOLDER,
    callback=lambda _ctx, _param, root: Workspace(root),
    metavar="WS",
)
JSON = flag("--json", "as_json", text="Print the result as one JSON document.")
DRY_RUN = flag("--dry-run", text="Show what would be run, why, and how long; run nothing.")
FORGET = click.Option(
    ["--forget"],
    multiple=True,
    metavar="OPTION",
    help="Forget this option of earlier commands (`--forget gcp`), or `all`.  [repeatable]",
)
SET = click.Option(
    ["--set", "settings"],
    multiple=True,
    metavar="STAGE.OPTION=VALUE",
    help="Set any option of a stage by its key in georef.toml (`--set train.sh_degree=1`).  [repeatable]",
)


def help_of(options_type: type[StageOptions]) -> str:
    """Return what `--help` says of a stage: the docstring of its options without their own title."""
    text = inspect.cleandoc(options_type.__doc__ or "").partition("\n\n")[2]
    return text.replace("\nExamples:\n", "\n\b\nExamples:\n")


def forgotten(options_type: type[StageOptions], names: Iterable[str]) -> list[str]:
    """Return the fields that the user names with `--forget`; `all` stands for each of them."""
    if "all" in (named := list(names)):
        return list(options_type.model_fields)
    try:
        return names_of_flags(options_type, named)
    except ValueError as error:
        raise click.UsageError(f"--forget: {error}") from error


def stage_options(options_type: type[StageOptions], only: Iterable[str] | None = None) -> list[click.Option]:
    """Return the click options of all fields, or of the fields named in `only`; `--threads` is for all commands."""
    names = [name for name in options_type.model_fields if name != "threads"] if only is None else list(only)
    return [stage_option(options_type, name) for name in names]


def stage_option(options_type: type[StageOptions], name: str) -> click.Option:
    """Return the click option of a field; it has no default of its own: its help states the field's."""
    info, flag = options_type.model_fields[name], flag_name(options_type, name)
    help_text = " ".join(filter(None, [info.description, _default_and_range(info)]))
    hidden = HIDDEN in marks_of(info)
    if WRITTEN in marks_of(info):
        return click.Option([flag, name], type=click.STRING, default=None, help=help_text, hidden=hidden)
    kind: Any = info.annotation
    if get_origin(kind) in (Union, types.UnionType):
        (kind,) = [member for member in get_args(kind) if member is not type(None)]
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if kind is bool:
        return click.Option(
            [f"{flag}/--no-{flag.removeprefix('--')}", name],
            is_flag=True,
            default=None,
            help=help_text,
            hidden=hidden,
        )
    if get_origin(kind) is tuple:
        return click.Option(
            [flag, name],
            multiple=True,
            type=_click_type(get_args(kind)[0]),
            help=help_text + "  [repeatable]",
            hidden=hidden,
        )
    return click.Option([flag, name], type=_click_type(kind), default=None, help=help_text, hidden=hidden)


def resolved(ctx: click.Context, options_type: type[OptionsT], toml: Path) -> OptionsT:
    """Return the options of a command that is no stage: default < flags; `toml` is named in errors."""
    return resolve(options_type, {}, given(ctx, options_type.model_fields), toml)


def given(ctx: click.Context, names: Iterable[str]) -> dict[str, Any]:
    """Return the values that the user gave; `georef.toml` and the defaults determine all others.

    `--threads` took effect when it was parsed, and is no value of the command.
    """
    return {
        name: ctx.params[name]
        for name in names
        if name in ctx.params and ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
    }


def _click_type(kind: type) -> click.ParamType[Any]:
    if get_origin(kind) is Literal:
        return click.Choice(get_args(kind))
    if kind is Path:
        return FILE
    known: dict[type, click.ParamType[Any]] = {int: click.INT, float: click.FLOAT, str: click.STRING}
    return known[kind]


def _default_and_range(info: FieldInfo) -> str:
    """Return the default and range of a field as `[default: 1200; ≥ 128]`; empty without any."""
    parts, default = [], info.default
    if WRITTEN in marks_of(info):
        default = notation(default) if default not in (None, ()) else None
    elif isinstance(default, bool):
        default = "on" if default else "off"
    if default not in (None, ()):
        parts.append(f"default: {default}")
    for bound, sign in _BOUNDS.items():
        parts += [f"{sign} {getattr(mark, bound)}" for mark in info.metadata if hasattr(mark, bound)]
    return f" [{'; '.join(parts)}]" if parts else ""


# A script may give all its runs the same options, and end some of them early.
NOT_REACHED = "%s is for %s, which this run does not reach: it is not used, and not remembered."


def settings(
    texts: Iterable[str], stages: Iterable[StageSpec], later: Iterable[StageSpec] = ()
) -> dict[str, dict[str, Any]]:
    """Return the options that texts set, by stage and field, of stages that will run; a click.UsageError: no such.

    A text is `stage.field=value`; the value is one of TOML, or else a plain text. Paths become absolute. Options of
    `later` stages, which this run does not reach, are named in a warning.
    """
    running = [spec.name for spec in stages]
    by_name = {spec.name: spec for spec in (*stages, *later)}
    by_stage: dict[str, dict[str, Any]] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        stage, _, name = key.partition(".")
        if not equals or not name:
            raise click.UsageError(
                f"--set: {text!r} has not the form stage.option=value, such as train.sh_degree=1."
            )
        if stage not in by_name:
            raise click.UsageError(f"--set: {stage!r} is not among the stages to run ({', '.join(running)}).")
        options = by_name[stage].options
        if name not in options.model_fields:
            raise click.UsageError(
                f"--set: {stage} has no option {name!r}. Its options are {', '.join(options.model_fields)}."
            )
        if stage not in running:
            log.warning(NOT_REACHED, f"--set {key}", stage, extra={"code": "option-not-used"})
            continue
        parsed = _value(value)
        is_path = name in input_markers(options) and isinstance(parsed, str)
        by_stage.setdefault(stage, {})[name] = Path(parsed).absolute() if is_path else parsed
    return by_stage


def _value(text: str) -> Any:
    """Return a value of TOML; a text that is none, or more than one, as it is."""
    try:
        document = parse_toml(f"value = {text}")
    except ValueError:
        return text
    return document["value"] if len(document) == 1 else text
