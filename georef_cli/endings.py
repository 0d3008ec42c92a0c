"""Ends of commands: exit code, message for people and document for programs of each kind of exception."""

from __future__ import annotations

import io
from dataclasses import dataclass

import click

from pipelines.core.errors import GeorefError, InputError, storage_error
from pipelines.core.printable import printable, printable_lines

FAILED, USAGE, INTERRUPTED = 1, 2, 130
ErrorDocument = dict[str, str | int | None]


@dataclass(frozen=True)
class Ending:
    """End of a command by an exception.

    Attributes:
        code: exit code.
        message: text for stderr.
        error: JSON form: code, message, path, line, field, hint.
    """

    code: int
    message: str
    error: ErrorDocument


def ending_of(error: BaseException) -> Ending | None:
    """Return the end of a command by a known exception; None for one that nobody foresaw."""
    if isinstance(error, click.Abort | KeyboardInterrupt):
        return Ending(INTERRUPTED, "interrupted", _document("interrupted", "interrupted"))
    if isinstance(error, click.ClickException):
        return _of_click(error)
    known = error if isinstance(error, GeorefError) else storage_error(error)
    if known is None:
        return None
    usage = isinstance(known, InputError) and known.is_usage
    return Ending(USAGE if usage else FAILED, f"error: {printable(str(known))}", known.document())


def defect_document(error: BaseException) -> ErrorDocument:
    """Return the JSON form of an exception that nobody foresaw."""
    return _document("defect", f"{type(error).__name__}: {error}")


def _of_click(error: click.ClickException) -> Ending:
    text = io.StringIO()
    error.show(text)
    context = getattr(error, "ctx", None)
    param = getattr(error, "param", None)
    field = param.opts[-1] if isinstance(param, click.Option) else None
    document = _document("usage" if error.exit_code == USAGE else "failed", error.format_message())
    document["field"] = field or getattr(error, "option_name", None)
    document["hint"] = None if context is None else f"{context.command_path} --help"
    return Ending(error.exit_code, printable_lines(text.getvalue().rstrip("\n")), document)


def _document(code: str, message: str) -> ErrorDocument:
    return {"code": code, "message": message, "path": None, "line": None, "field": None, "hint": None}
