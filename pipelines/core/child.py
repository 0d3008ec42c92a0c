"""Processes that this program starts: how Python is called, what they tell, and native code in a child.

A process tells the one that has started it its log and its progress as lines of JSON. Native code hears no signals
while it works, and its failed checks abort the process. In a child both are harmless: an interrupt kills the child
at once, and a crash becomes one error.
"""

import contextlib
import importlib
import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, Any, TextIO

from pipelines.core import errors
from pipelines.core.files import storage_failure_of
from pipelines.core.json_values import JsonValue
from pipelines.core.progress import SILENT, Progress, ProgressTask

log = logging.getLogger(__name__)


# A process whose parent was killed saves its work and ends within so long; the command given again waits for that.
ORPHAN_S = 5.0


class MessageSender:
    """Sender of messages to the receiver that reads a stream; also the `Progress` of its process, and its tasks."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._lock = stream, threading.Lock()

    def send(self, kind: str, **content: JsonValue) -> None:
        """Send one message; an OSError: nobody reads the stream."""
        with self._lock:
            self._stream.write(json.dumps({"kind": kind, **content}) + "\n")
            self._stream.flush()

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
        self.send("begin", name=name, total=total)
        try:
            yield self
        finally:
            self.send("end")

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        self.send("advance", steps=steps, note=note, left_s=left_s)


class SentRecords(logging.Handler):
    """Log handler that sends records to the process that has started this one."""

    def __init__(self, sender: MessageSender) -> None:
        super().__init__()
        self._sender = sender

    def emit(self, record: logging.LogRecord) -> None:
        self._sender.send("log", name=record.name, level=record.levelno, text=self.format(record))


class MessageReceiver:
    """Receiver that shows the tasks of another process, and logs its records as those of this process."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._open: list[tuple[AbstractContextManager[ProgressTask], ProgressTask]] = []

    def take(self, message: Mapping[str, JsonValue]) -> bool:
        """Return whether a message was one of progress or of the log, and act on it."""
        match message["kind"]:
            case "log":
                self.log(message["name"], message["level"], message["text"])
            case "begin":
                context = self._progress.task(message["name"], message["total"])
                self._open.append((context, context.__enter__()))
            case "advance":
                self._open[-1][1].advance(message["steps"], message["note"], message["left_s"])
            case "end":
                self._open.pop()[0].__exit__(None, None, None)
            case _:
                return False
        return True

    def log(self, name: str, level: int, text: str) -> None:
        logging.getLogger(name).log(level, "%s", text)

    def close(self) -> None:
        """Close the tasks that the other process has left open."""
        while self._open:
            self._open.pop()[0].__exit__(None, None, None)


# Arguments of Python that start the command line.
THIS_PROGRAM = ("-m", "georef_cli")
_HOME = Path(__file__).parents[2]


def python_command(arguments: Sequence[str]) -> list[str]:
    """Return the command that runs this Python with arguments, such as `-m` and a module.

    Python looks for modules in the current folder first when it is started with `-m` or `-c`. That folder belongs
    to the photographs, and a `queue.py` among them is a file of the user, not code of this program.
    """
    return [sys.executable, "-P", *arguments]


def python_environment() -> dict[str, str]:
    """Return this environment, in which Python finds the modules that this process finds, and none beside the data.

    The safe path is also a variable, for what libraries start by themselves: Dask's nannies spawn their workers.
    A checkout that is itself the current folder comes last, behind the standard library and installed packages.
    """
    path = [entry for entry in sys.path if Path(entry).is_absolute() and not _is_current(Path(entry))]
    if _is_current(_HOME):
        path.append(str(_HOME))
    return {**os.environ, "PYTHONSAFEPATH": "1", "PYTHONPATH": os.pathsep.join(path)}


def _is_current(folder: Path) -> bool:
    try:
        return folder.samefile(os.curdir)
    except OSError:  # Python lists a `python311.zip` that does not exist.
        return False


_LIBRARY = "pipelines"
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of Linux
_MOST_OF_A_LINE = 300


def run_in_child(
    task: str,
    arguments: Mapping[str, JsonValue],
    remedy: str,
    progress: Progress = SILENT,
    *,
    writes: Path | None = None,
) -> Any:
    """Return the result of a function that runs in a child process, whose log and progress appear as this one's.

    Args:
        task: `module:function`; the function takes a document and a `Progress`, and returns a document.
        remedy: sentence on what to do if the child crashes.
        writes: folder that native code writes into; None: it writes nothing.

    Raises:
        GeorefError: raised by the function, with its message.
        StorageError: native code could not write.
        CrashError: the child ended without a result.
        ResourceError: the system killed the child, as it does when memory is short.
        RuntimeError: any other exception of the function, with its traceback.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as native_log:
        process = subprocess.Popen(
            python_command(["-m", __name__, task, str(os.getpid())]),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=native_log,
            encoding="utf-8",
            env=python_environment(),
        )
        try:
            return _follow(process, arguments, progress)
        except EOFError:
            crash = _crash(process.wait(), native_log, remedy)
            storage = _storage_failure(native_log, writes)
            raise storage or crash from None
        except RuntimeError as defect:
            storage = errors.storage_error_in(str(defect), writes) if writes is not None else None
            raise storage or _storage_failure(native_log, writes) or defect from None
        finally:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                assert pipe is not None
                with contextlib.suppress(OSError):
                    pipe.close()


def start_in_child(task: str) -> None:
    """Start a function in a child process that nobody waits for. It ends with this process; its errors are dropped.

    The function is as for `run_in_child`, without arguments.
    """

    def run() -> None:
        with contextlib.suppress(errors.GeorefError, RuntimeError, OSError):
            run_in_child(task, {}, "")

    threading.Thread(target=run, daemon=True).start()


def _follow(process: subprocess.Popen[str], arguments: Mapping[str, JsonValue], progress: Progress) -> Any:
    """Hand over the arguments, and follow the child's messages to its result; an EOFError: it ended without one."""
    assert process.stdin is not None
    assert process.stdout is not None
    document = {"arguments": arguments, "level": logging.getLogger(_LIBRARY).getEffectiveLevel()}
    try:
        process.stdin.write(json.dumps(document) + "\n")
        process.stdin.flush()  # It stays open: the child ends when it is closed.
    except BrokenPipeError as error:
        raise EOFError from error
    receiver = MessageReceiver(progress)
    try:
        for line in process.stdout:
            message = json.loads(line)
            if receiver.take(message):
                continue
            if message["kind"] == "result":
                return message["result"]
            raise _error(message)
    finally:
        receiver.close()
    raise EOFError


def _storage_failure(native_log: IO[str], folder: Path | None) -> errors.StorageError | None:
    """Return why native code could not write into a folder, by its messages or by trial; None: it could."""
    if folder is None:
        return None
    native_log.seek(0)
    return errors.storage_error_in(native_log.read(), folder) or storage_failure_of(folder)


def _error(message: Mapping[str, JsonValue]) -> Exception:
    if message["kind"] != "error":
        return RuntimeError(f"in a child process:\n{message['text']}")
    kind = getattr(errors, message["type"], errors.GeorefError)
    if issubclass(kind, errors.InputError):
        where = {name: message[name] for name in ("path", "line", "field")}
        return kind(message["code"], message["message"], **where, remedy=message["remedy"] or "")
    kind = errors.GeorefError if kind is errors.MissingProductError else kind
    error: errors.GeorefError = kind(message["code"], message["message"], remedy=message["remedy"] or "")
    return error


def _content(error: errors.GeorefError) -> dict[str, Any]:
    """Return what a message tells of an error; its own kind is another."""
    return {name: value for name, value in error.document().items() if name != "kind"}


def _crash(code: int, native_log: IO[str], remedy: str) -> errors.GeorefError:
    native_log.seek(0)
    lines = [line.strip() for line in native_log if line.strip()]
    for line in lines[-50:]:
        log.debug("the child process wrote: %s", line)
    if code == -signal.SIGKILL:
        message = f"The system killed the computation, as it does when memory is short. {remedy}"
        return errors.ResourceError("out-of-memory", message)
    end = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    # glog begins the line of a failed check with F and the date; the first line is the cause of those below.
    checks = [line for line in lines if line[:1] == "F" and line[1:5].isdigit()]
    cause = (checks or lines[-1:] or ["no message"])[0].rpartition("] ")[2]
    message = f"A native library crashed ({end}: {cause[:_MOST_OF_A_LINE]}). {remedy}"
    return errors.CrashError("library-crashed", message)


def _main(task: str, parent: str) -> None:
    """Run a function and send its result: entry point of the child."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent decides what an interrupt of both ends.
    messages = MessageSender(os.fdopen(os.dup(1), "w", encoding="utf-8"))
    os.dup2(2, 1)  # Native libraries write to stdout, too.
    document = json.loads(sys.stdin.readline())
    _end_with(int(parent))
    logger = logging.getLogger(_LIBRARY)
    logger.setLevel(document["level"])
    logger.addHandler(SentRecords(messages))
    logger.propagate = False
    module, _, name = task.partition(":")
    try:
        result = getattr(importlib.import_module(module), name)(document["arguments"], messages)
        messages.send("result", result=result)
    except errors.GeorefError as error:
        messages.send("error", type=type(error).__name__, **_content(error))
    except MemoryError:
        text = "The memory of this machine is too small: use smaller or fewer photographs."
        messages.send("error", type="ResourceError", **_content(errors.ResourceError("out-of-memory", text)))
    except Exception as error:
        storage = errors.storage_error(error)
        if storage is not None:
            messages.send("error", type="StorageError", **_content(storage))
        else:
            messages.send("defect", text=traceback.format_exc())
    sys.stderr.flush()
    os._exit(0)  # The watching thread and native threads are not waited for.


def _end_with(parent: int) -> None:
    """End this process when its parent ends, also while native code holds the interpreter."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)

    def watch() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    _main(*sys.argv[1:])
