"""The command line as users meet it: arguments in; exit code, stdout and stderr out."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.core.sentences import printable

if TYPE_CHECKING:
    from tests.forked import ForkedProcess

REPOSITORY = Path(__file__).parents[1]
WITH_FAKES = "from tests import fakes; fakes.install(); from georef_cli.main import main; main()"


@dataclass(frozen=True)
class Result:
    """Exit of a command; error and warnings are known of a command in this process."""

    code: int
    out: str
    err: str
    error: dict[str, Any] | None = None  # JSON form of the error
    warned: tuple[str, ...] = ()  # codes of the warnings

    @property
    def document(self) -> Any:
        """stdout as the one JSON document that it must be."""
        return json.loads(self.out)

    def assert_failed(self, code: int, error_code: str | None = None) -> None:
        """The command failed with this exit code: stdout has no result, at most the document of the error.

        Of a command in this process, the code of the error can be asked for too.
        """
        if error_code is not None:
            assert self.error is not None and self.error["code"] == error_code, self.error
        assert self.code == code, self.err
        if self.out:
            assert set(self.document) == {"error"}
            error = self.document["error"]
            assert set(error) == {"kind", "code", "message", "path", "line", "field", "remedy"}
            assert (error["kind"] == "usage") is (code == 2)
            assert printable(error["message"]) in self.err


Georef = Callable[..., Result]


def start(*arguments: object, code: str = WITH_FAKES) -> subprocess.Popen[str]:
    """`georef` in a process of its own, with fake stages."""
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )


def finish(process: subprocess.Popen[str] | ForkedProcess, patience_s: float = 60.0) -> Result:
    """Wait for a process."""
    out, err = process.communicate(timeout=patience_s)
    assert process.returncode is not None
    return Result(process.returncode, out, err)


def products_in(workspace: Path) -> dict[str, bytes]:
    """Every product in a workspace."""
    kept = (path for path in sorted(workspace.rglob("*")) if path.is_file() and not path.name.startswith(".lock"))
    found = {path.relative_to(workspace).as_posix(): path.read_bytes() for path in kept}
    return {name: data for name, data in found.items() if not name.startswith(("logs/", "ingest.partial/"))}


def write_files(folder: Path, files: dict[str, bytes]) -> None:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
