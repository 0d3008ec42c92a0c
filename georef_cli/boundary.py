"""Boundary of the program: errors become messages and exit codes, log records become lines.

Exit codes: 0 done, 1 known failure, 2 usage, 130 interrupted. An unexpected exception keeps its traceback. All
messages go to stderr; stdout is for the result, or with `--json` for the error as one JSON document. With
`--json-progress` each line of stderr is JSON, the error too.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import sys
import traceback as tracebacks
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType, TracebackType
from typing import IO, TYPE_CHECKING, TextIO

import click

from georef_cli.native_lines import SentLines, native_lines_caught_up
from georef_cli.verbosity import LineFormatter, SafeFormatter, StderrSender, Verbosity, stderr_sender
from pipelines.core.errors import GeorefError, InputError, storage_error
from pipelines.core.progress import AT_END, SIGNALS
from pipelines.core.sentences import printable, printable_lines

if TYPE_CHECKING:
    from pipelines.core.stages import StageSpec
    from pipelines.core.workspace import Workspace

log = logging.getLogger(__name__)

FAILED, USAGE, INTERRUPTED = 1, 2, 130
ErrorDocument = dict[str, str | int | None]


@dataclass(frozen=True)
class Exit:
    """Exit of a command by an exception: exit code, text for stderr, and JSON form."""

    code: int
    message: str
    error: ErrorDocument


def exit_of(error: BaseException) -> Exit | None:
    """Return the exit by a known exception; None for one that nobody foresaw."""
    if isinstance(error, click.Abort | KeyboardInterrupt):
        said = "interrupted. What is done is kept: the same command continues."
        return Exit(INTERRUPTED, said, _document("interrupted", "interrupted"))
    if isinstance(error, click.ClickException):
        text, context, param = io.StringIO(), getattr(error, "ctx", None), getattr(error, "param", None)
        error.show(text)
        field = param.opts[-1] if isinstance(param, click.Option) else getattr(error, "option_name", None)
        document = _document("usage" if error.exit_code == USAGE else "failed", error.format_message())
        document |= {"field": field, "remedy": None if context is None else f"{context.command_path} --help"}
        return Exit(error.exit_code, printable_lines(text.getvalue().rstrip("\n")), document)
    known = error if isinstance(error, GeorefError) else storage_error(error)
    if known is None:
        return None
    usage = isinstance(known, InputError) and known.is_usage
    return Exit(USAGE if usage else FAILED, f"error: {printable(str(known))}", known.document())


def _document(kind: str, message: str) -> ErrorDocument:
    """Return the JSON form of a failure that is no `GeorefError`: its kind is its code."""
    return {"kind": kind, "code": kind, "message": message, **dict.fromkeys(("path", "line", "field", "remedy"))}


LOGGERS = ("pipelines", "georef_cli")
FILE_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


def guarded(group: click.Group, arguments: Sequence[str] | None) -> int:
    """Run the command line, by default that of the process, and return its exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    if "--json-progress" not in words:
        return _guarded(group, arguments, "--json" in words)
    sender = stderr_sender()
    with contextlib.redirect_stderr(SentLines(sender)):  # Each line is a message, also those of Python itself.
        return _guarded(group, arguments, "--json" in words, sender)


def _guarded(
    group: click.Group, arguments: Sequence[str] | None, as_json: bool, sender: StderrSender | None = None
) -> int:
    try:
        if isinstance(sys.stdout, io.TextIOWrapper):
            # As on stderr, characters that the encoding lacks are escaped: a pipe on Windows has no σ.
            sys.stdout.reconfigure(errors="backslashreplace")
        with _signals_interrupt():
            code = group.main(args=arguments, prog_name=group.name, standalone_mode=False)
            sys.stdout.flush()
    except BrokenPipeError:
        _drop_stdout()  # Its reader has closed the pipe.
        return FAILED
    except (Exception, KeyboardInterrupt) as error:
        ended = exit_of(error)
        document = _document("defect", f"{type(error).__name__}: {error}") if ended is None else ended.error
        if as_json:
            from pipelines.core.products import dump_json  # here, because it imports the validation library

            with contextlib.suppress(OSError):  # Stdout may be what has failed.
                click.echo(dump_json({"error": document}))
        if sender is not None:
            text = printable_lines(tracebacks.format_exc().rstrip("\n")) if ended is None else ended.message
            with contextlib.suppress(KeyboardInterrupt):  # Nobody reads it.
                sender.send("error", error_kind=document["kind"], text=text)
        elif ended is None:
            raise
        else:
            _print_error(ended.message)
        _drop_stdout()
        return FAILED if ended is None else ended.code
    return code if isinstance(code, int) else 0


def _print_error(text: str) -> None:
    """Print a line on stderr, which may lie on the disk that is full."""
    with contextlib.suppress(OSError):
        click.echo(text, err=True)


def _drop_stdout() -> None:
    """Drop a result that stdout cannot take, lest it raise again at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def safe_traceback(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    """Print the traceback of an exception that nobody foresaw, as Python does, but safe for a terminal."""
    _print_error(printable_lines("".join(tracebacks.format_exception(kind, error, traceback)).rstrip("\n")))


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Make every signal that asks for termination act as Ctrl-C, so that a stage can save its work."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in SIGNALS if number != signal.SIGINT}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def logged_to_stderr(verbosity: Verbosity) -> Iterator[None]:
    """Print log records on stderr while the context lasts, and the traceback of its error if asked."""
    with _attached(_handler(verbosity), logging.DEBUG if verbosity.verbose else logging.INFO):
        try:
            yield
        except GeorefError:
            if verbosity.traceback:
                safe_traceback(*sys.exc_info())
            raise


@contextmanager
def logged_to_file(workspace: Workspace, spec: StageSpec) -> Iterator[None]:
    """Append log records to the log of a stage while the context lasts, and the error that ends it."""
    handler = _LateFileHandler(workspace, spec)
    handler.setFormatter(SafeFormatter(FILE_FORMAT))
    with _attached(handler, logging.INFO):
        try:
            yield
        except BaseException as error:
            native_lines_caught_up()
            handler.emit_end(error)
            raise
        native_lines_caught_up()


@contextmanager
def _attached(handler: logging.Handler, level: int) -> Iterator[None]:
    root = logging.getLogger()
    levels = {name: logging.getLogger(name).level for name in LOGGERS}
    root.addHandler(handler)
    for name in LOGGERS:
        logger = logging.getLogger(name)
        logger.setLevel(min(level, logger.level or level))
    try:
        yield
    finally:
        root.removeHandler(handler)
        handler.close()
        for name, before in levels.items():
            logging.getLogger(name).setLevel(before)


def _handler(verbosity: Verbosity) -> logging.Handler:
    """Return the handler of stderr: messages for a program, lines above the bars of a terminal, or plain lines."""
    handler: logging.Handler
    if verbosity.json_progress:
        from pipelines.core.child import SentRecords

        handler = SentRecords(stderr_sender())
        handler.setFormatter(SafeFormatter())
    elif sys.stderr.isatty():
        from georef_cli.display import STDERR, ConsoleHandler

        handler = ConsoleHandler(STDERR)
    else:
        handler = _StderrHandler(sys.stderr)
        handler.setFormatter(LineFormatter())
    handler.setLevel(verbosity.level)
    handler.addFilter(lambda record: not getattr(record, AT_END, False))  # The result on stdout ends with it.
    return handler


class _StderrHandler(logging.StreamHandler[TextIO]):
    """Handler that writes lines to stderr, and drops those for which a full disk has no room."""

    def handleError(self, record: logging.LogRecord) -> None:
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)


class _LateFileHandler(logging.Handler):
    """Handler that opens its file when the workspace has its first product, or else at the end of the command.

    A command that is refused leaves neither file nor folder behind. A log that cannot be written is no error:
    stderr has the same lines.
    """

    def __init__(self, workspace: Workspace, spec: StageSpec) -> None:
        super().__init__()
        self.path = workspace.log_file(spec)
        self._workspace = workspace
        self._held_back: list[str] = []
        self._file: IO[bytes] | None = None
        self._failed = False

    def emit(self, record: logging.LogRecord) -> None:
        self._held_back.append(self.format(record) + "\n")
        if self._file is not None or self._workspace.has_product():
            self._write()

    def _write(self) -> None:
        lines, self._held_back = self._held_back, []
        if self._failed:
            return
        try:
            if self._file is None:
                self.path.parent.mkdir(exist_ok=True)
                self._file = self.path.open("ab", buffering=0)
            self._file.write("".join(lines).encode("utf-8", "backslashreplace"))
        except OSError:
            self._failed = True

    def close(self) -> None:
        """Write what was held back, unless the command was refused, and close the file."""
        if self._held_back and self._workspace.has_begun():
            self._write()
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
        super().close()

    def emit_end(self, error: BaseException) -> None:
        known = isinstance(error, GeorefError | KeyboardInterrupt)
        text = str(error) or type(error).__name__
        self.emit(
            logging.LogRecord(
                __name__, logging.ERROR, __file__, 0, text, None,
                None if known else (type(error), error, error.__traceback__),
            )
        )  # fmt: skip
