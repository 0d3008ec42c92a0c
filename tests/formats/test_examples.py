"""The examples in the docstrings of the readers run, each in an empty folder, and print what stands there."""

import ast
import doctest
import importlib
from pathlib import Path

import pytest

import pipelines.formats

# Public functions of these names read a file, a part of one, or its bytes.
_NAMES = ("read_", "open_", "decode_", "load_")
WITHOUT_EXAMPLE = {
    "gopro_telemetry.read_telemetry": "a video is boxes and tables in each other, no matter of a few lines",
}


def _readers() -> dict[str, str]:
    """Return the documentation of each public reader, by its module and name."""
    return {
        f"{path.stem}.{node.name}": ast.get_docstring(node) or ""
        for path in sorted(Path(pipelines.formats.__file__).parent.glob("*.py"))
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith(_NAMES)
    }


READERS = _readers()


def test_each_reader_has_an_example() -> None:
    without = {reader for reader, text in READERS.items() if ">>> " not in text}
    assert without == WITHOUT_EXAMPLE.keys()


@pytest.mark.parametrize("reader", [reader for reader in READERS if reader not in WITHOUT_EXAMPLE])
def test_example_of_a_reader_runs(reader: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file, name = reader.split(".")
    module = importlib.import_module(f"pipelines.formats.{file}")
    (example,) = doctest.DocTestFinder(recurse=False).find(
        getattr(module, name), name, module=module, globs=dict(vars(module))
    )
    printed: list[str] = []
    results = doctest.DocTestRunner(verbose=False).run(example, out=printed.append)
    assert results.failed == 0, "".join(printed)
    assert any(line.want for line in example.examples)
