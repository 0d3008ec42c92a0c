"""Options of any stage as texts: `--set train.sh_degree=1`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from pipelines.core.options import input_markers, parse_toml
from pipelines.core.stages import StageSpec


def set_option() -> click.Option:
    """Return the option `--set`."""
    return click.Option(
        ["--set", "settings"],
        multiple=True,
        metavar="STAGE.OPTION=VALUE",
        help="Set any option of a stage by its key in georef.toml (`--set train.sh_degree=1`).  [repeatable]",
    )


def settings(texts: Iterable[str], stages: Iterable[StageSpec]) -> dict[str, dict[str, Any]]:
    """Return the options that texts set, by stage and field.

    Args:
        texts: `stage.field=value`; the value is one of TOML, or else a plain text. Paths become absolute.
        stages: that will run.

    Raises:
        click.UsageError: no such form, stage or option.
    """
    by_name = {spec.name: spec for spec in stages}
    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        stage, _, name = key.partition(".")
        if not equals or not name:
            raise click.UsageError(f"--set: {text!r} is not of the form stage.option=value, like train.sh_degree=1")
        if stage not in by_name:
            raise click.UsageError(f"--set: {stage!r} is not among the stages to run: {', '.join(by_name)}")
        options = by_name[stage].options
        if name not in options.model_fields:
            raise click.UsageError(
                f"--set: {stage} has no option {name!r}; it has {', '.join(options.model_fields)}"
            )
        parsed = _value(value)
        is_path = name in input_markers(options) and isinstance(parsed, str)
        found.setdefault(stage, {})[name] = Path(parsed).absolute() if is_path else parsed
    return found


def _value(text: str) -> Any:
    """Return a value of TOML; a text that is none, or more than one, as it is."""
    try:
        document = parse_toml(f"value = {text}")
    except ValueError:
        return text
    return document["value"] if len(document) == 1 else text
