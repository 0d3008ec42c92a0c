"""Boundary of the program: errors become messages and exit codes, log records become lines.

Exit codes: 0 done, 1 known failure, 2 usage, 130 interrupted. An unexpected exception keeps its traceback. All
messages go to stderr; stdout is for the result.
"""

from __future__ import annotations

import codecs
import errno
import io
import logging
import os
import signal
import sys
import traceback as tracebacks
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import click

from georef_cli.verbosity import LineFormatter, Verbosity
from pipelines.core.errors import GeorefError
from pipelines.core.interrupts import SIGNALS

FAILED, INTERRUPTED = 1, 130
LOGGERS = ("pipelines", "georef_cli")
FILE_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"

log = logging.getLogger(__name__)


def guarded(group: click.Group, arguments: Sequence[str] | None) -> int:
    """Run the command line and return its exit code.

    Args:
        group: the commands.
        arguments: of the command line; None: those of the process.
    """
    try:
        _escape_on_stdout()
        with _signals_interrupt():
            code = group.main(args=arguments, prog_name=group.name, standalone_mode=False)
            sys.stdout.flush()
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        return INTERRUPTED
    except GeorefError as error:
        click.echo(f"error: {error}", err=True)
        return FAILED
    except BrokenPipeError:
        # The reader of the pipe has closed it. The rest of the buffer must not raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        click.echo(f"error: {error.filename or 'workspace'}: the disk is full", err=True)
        return FAILED
    return code if isinstance(code, int) else 0


def _escape_on_stdout() -> None:
    """Make stdout escape characters that its encoding lacks, as stderr does: a pipe on Windows has no σ."""
    if isinstance(sys.stdout, io.TextIOWrapper) and codecs.lookup(sys.stdout.encoding).name != "utf-8":
        sys.stdout.reconfigure(errors="backslashreplace")


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
    handler = _terminal_handler() if sys.stderr.isatty() else _line_handler()
    handler.setLevel(verbosity.level)
    with _attached(handler, logging.DEBUG if verbosity.verbose else logging.INFO):
        try:
            yield
        except GeorefError:
            if verbosity.traceback:
                tracebacks.print_exc()
            raise


@contextmanager
def logged_to_file(path: Path) -> Iterator[None]:
    """Append log records to the file `path` while the context lasts, and the error that ends it."""
    handler = _LateFileHandler(path)
    handler.setFormatter(logging.Formatter(FILE_FORMAT))
    with _attached(handler, logging.INFO):
        try:
            yield
        except BaseException as error:
            handler.emit_end(error)
            raise


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


def _terminal_handler() -> logging.Handler:
    from georef_cli.display import ConsoleHandler, stderr_console

    return ConsoleHandler(stderr_console())


def _line_handler() -> logging.Handler:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter())
    return handler


class _LateFileHandler(logging.FileHandler):
    """Handler that opens its file at the first record, in a workspace that exists by then.

    A command that is refused before it begins leaves neither file nor folder behind.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, mode="a", encoding="utf-8", delay=True)
        self.path = path

    def emit(self, record: logging.LogRecord) -> None:
        if self.path.parent.parent.is_dir():
            self.path.parent.mkdir(exist_ok=True)
            super().emit(record)

    def emit_end(self, error: BaseException) -> None:
        """Record the error that ended a stage."""
        known = isinstance(error, GeorefError | KeyboardInterrupt)
        text = str(error) or type(error).__name__
        self.emit(
            logging.LogRecord(
                __name__, logging.ERROR, __file__, 0, text, None,
                None if known else (type(error), error, error.__traceback__),
            )
        )  # fmt: skip
