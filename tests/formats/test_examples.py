"""The examples in the docstrings of the readers run, each in an empty folder, and print what stands there."""

import doctest
import importlib
from pathlib import Path

import pytest

READERS = {
    "gnss_logs": ("read_mrk", "read_subtitles"),
    "ground_points": (
        *("read_geo", "read_ground_points", "read_point_list", "read_point_table", "read_marks", "read_distances"),
    ),
    "rig_config": ("read_rig_config",),
    "trajectory_csv": ("read_trajectory",),
    "triangle_mesh": ("read_obj",),
}


@pytest.mark.parametrize(
    ("module", "reader"), [(module, reader) for module, readers in READERS.items() for reader in readers]
)
def test_example_of_a_reader_runs(
    module: str, reader: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = importlib.import_module(f"pipelines.formats.{module}")
    (example,) = doctest.DocTestFinder(recurse=False).find(
        getattr(found, reader), reader, module=found, globs=dict(vars(found))
    )
    printed: list[str] = []
    results = doctest.DocTestRunner(verbose=False).run(example, out=printed.append)
    assert results.attempted > 1
    assert results.failed == 0, "".join(printed)
