"""The user's cache of compiled kernels: one for all checkouts, and never a kernel of other sources."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from pipelines.core.lock import WriteLock
from pipelines.core.progress import SILENT
from pipelines.splat import kernel_cache
from pipelines.train import compilation

KERNEL = "from pipelines.callee import (\n    three,\n)\n"
CALLEE = "from pipelines import constants\n"


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with a kernel that calls a function of another module, which takes a constant of a third."""
    home = tmp_path / "clone"
    for name, text in {"kernel": KERNEL, "callee": CALLEE, "constants": "A = 1\n", "other": "B = 1\n"}.items():
        (home / "pipelines").mkdir(parents=True, exist_ok=True)
        (home / "pipelines" / f"{name}.py").write_text(text)
    monkeypatch.setattr(kernel_cache, "_HOME", home)
    kernel_cache._digest.cache_clear()
    return home


def digest(home: Path) -> str:
    kernel_cache._digest.cache_clear()
    return kernel_cache._digest(home / "pipelines/kernel.py")


@pytest.mark.parametrize(
    ("name", "counts"), [("kernel", True), ("callee", True), ("constants", True), ("other", False)]
)
def test_sources_of_a_kernel_name_its_folder(tree: Path, name: str, counts: bool) -> None:
    before = digest(tree)
    path = tree / "pipelines" / f"{name}.py"
    path.write_text(path.read_text() + "# changed\n")
    assert (digest(tree) != before) == counts


def test_another_clone_has_the_same_folder(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = digest(tree)
    other = Path(shutil.copytree(tree, tree.parent / "other"))
    os.utime(other / "pipelines/kernel.py", (1, 1))
    monkeypatch.setattr(kernel_cache, "_HOME", other)
    assert digest(other) == before


def double(x: int) -> int:
    return 2 * x


def compiled(monkeypatch: pytest.MonkeyPatch, folder: Path):  # type: ignore[no-untyped-def]
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder))
    monkeypatch.setattr(kernel_cache, "_HOME", Path(__file__).parents[2])
    return kernel_cache.kernel()(double)


def test_second_process_loads_what_the_first_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = compiled(monkeypatch, tmp_path)
    assert (first(3), sum(first.stats.cache_misses.values())) == (6, 1)
    second = compiled(monkeypatch, tmp_path)
    assert (second(4), sum(second.stats.cache_hits.values())) == (8, 1)


@pytest.mark.parametrize("harm", ["damaged", "of others", "not writable"])
def test_cache_that_cannot_be_used_costs_a_compilation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, harm: str
) -> None:
    first = compiled(monkeypatch, tmp_path)
    assert first(3) == 6
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    if harm == "damaged":
        for file in folder.iterdir():
            file.write_bytes(b"\x80\x04no pickle")
    elif harm == "of others":
        folder.chmod(0o777)
    else:
        shutil.rmtree(folder)
        folder.write_text("a file where the folder must be")
    again = compiled(monkeypatch, tmp_path)
    assert (again(5), sum(again.stats.cache_hits.values())) == (10, 0)


def test_folders_used_longest_ago_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(70):
        (tmp_path / f"{number:016x}").mkdir()
        os.utime(tmp_path / f"{number:016x}", (number, number))
    assert compiled(monkeypatch, tmp_path)(3) == 6
    left = sorted(path.name for path in tmp_path.iterdir())
    assert len(left) == 60 and f"{10:016x}" not in left and f"{69:016x}" in left


def test_compilation_of_all_kernels_leaves_a_stamp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By which a later run need not start it."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernel_cache._digest.cache_clear()
    stamp = kernel_cache.compilation_stamp("pipelines.train.compilation")
    assert not stamp.exists()
    monkeypatch.setattr(compilation, "_match", lambda: None)
    monkeypatch.setattr(compilation, "_render", lambda: None)
    compilation.compile_kernels()
    assert stamp.is_file() and tmp_path in stamp.parents


def test_a_child_beside_another_compilation_ends_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each run of a batch starts one: those beside the first would only wait for it."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    kernel_cache._digest.cache_clear()
    steps: list[str] = []
    monkeypatch.setattr(compilation, "_match", lambda: steps.append("stereo"))
    monkeypatch.setattr(compilation, "_render", lambda: steps.append("rendering"))
    with WriteLock(kernel_cache.cache_folder()).hold("the compilation of kernels"):
        compilation.compile_in_child({}, SILENT)
        assert steps == []
    compilation.compile_in_child({}, SILENT)
    assert steps == ["stereo", "rendering"]
