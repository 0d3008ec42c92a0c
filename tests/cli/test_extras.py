"""Without an extra, what needs it fails before any work, with the command that installs it; all else works."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipelines.core import extras
from pipelines.core.extras import EXTRAS, Extra, installing, module_of
from pipelines.core.workspace import Workspace
from tests.cli_runs import REPOSITORY, Georef, Result
from tests.test_architecture import inside, sources

# It defines the messages of the viewer's pages as classes of their library: only a running viewer imports it.
NEEDS_AN_EXTRA = ("pipelines.view.server",)


def hide(monkeypatch: pytest.MonkeyPatch, extra: Extra) -> None:
    for library in EXTRAS[extra][1]:
        monkeypatch.setitem(sys.modules, module_of(library), None)


@pytest.fixture
def finished(georef: Georef, workspace: Workspace, photos: Path) -> Path:
    """A workspace whose stages have all run."""
    assert georef("run", workspace.root, "--images", photos).code == 0
    return workspace.root


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ("bags", ["inspect", "flight.mcap"]),
        ("bags", ["ingest", "new", "--bag", "flight.mcap"]),
        ("bags", ["run", "new", "--bag", "flight.mcap"]),
        ("bags", ["run", "new", "--bag", "flight.mcap", "--dry-run"]),
        ("bags", ["simulate", "survey", "--bag", "mcap"]),
        ("simulator", ["simulate", "survey"]),
        ("cluster", ["cluster", "certificates", "new"]),
        ("cluster", ["cluster", "scheduler"]),
        ("cluster", ["cluster", "worker", "tcp://127.0.0.1:8786", "--insecure"]),
        ("cluster", ["batch", "missions.toml", "--cluster", "tls://head:8786"]),
    ],
    ids=lambda value: value if isinstance(value, str) else " ".join(value[:2]),
)
def test_missing_extra_is_told_before_any_work(
    real_georef: Georef,
    extra: Extra,
    words: list[str],
    photos: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    Path("flight.mcap").touch()
    Path("missions.toml").write_text(f'[missions.flight]\nimages = "{photos.name}"\n')
    before = sorted(tmp_path.rglob("*"))
    hide(monkeypatch, extra)
    assert_told(real_georef(*words, "--json"), extra)
    assert sorted(tmp_path.rglob("*")) == before


def assert_told(result: Result, extra: Extra) -> None:
    result.assert_failed(1)
    error = result.document["error"]
    assert (error["kind"], error["code"]) == ("backend", "extra-missing")
    assert installing(extra) in error["message"]
    assert all(library in error["message"] for library in EXTRAS[extra][1])


def test_viewer_without_its_extra(georef: Georef, finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "viewer")
    assert_told(georef("view", finished, "--json"), "viewer")


@pytest.mark.parametrize(
    ("extra", "stage", "option"),
    [("vectors", "export-raster", "contours"), ("reference", "evaluate", "reference")],
)
def test_option_without_its_extra(
    georef: Georef,
    finished: Path,
    photos: Path,
    extra: Extra,
    stage: str,
    option: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The stage refuses it, and so does a run before its first stage, unless the stage need not run."""
    cloud, new = finished.parent / "cloud.laz", finished.parent / "new"
    cloud.touch()
    new.mkdir()
    value = {"contours": 1, "reference": str(cloud)}[option]
    (new / "georef.toml").write_text(f"[{stage}]\n{option} = {value!r}\n")
    with monkeypatch.context() as patch:
        hide(patch, extra)
        assert_told(georef(stage, finished, f"--{option}", value, "--json"), extra)
        for dry in ((), ("--dry-run",)):
            run = georef("run", new, "--images", photos, "--deliver", "raster", *dry, "--json")
            assert_told(run, extra)
    assert list(new.iterdir()) == [new / "georef.toml"]
    assert georef(stage, finished, f"--{option}", value).code == 0
    hide(monkeypatch, extra)
    assert georef("run", finished, "--deliver", "raster").code == 0


@pytest.mark.slow
def test_core_imports_no_extra() -> None:
    """Every file but the viewer's server is imported without the libraries of the extras, and commands answer."""
    hidden = [*(module_of(library) for _, libraries in EXTRAS.values() for library in libraries), "dask", "lz4"]
    modules = [name for name in sources() if not any(inside(name, home) for home in NEEDS_AN_EXTRA)]
    code = f"""
import importlib, sys
sys.modules.update(dict.fromkeys({hidden}))
for name in {[name for name in modules if name != "georef_cli.__main__"]}:
    importlib.import_module(name)
from georef_cli.main import main
main(["doctor"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    words = " ".join(done.stdout.split())
    for extra in EXTRAS:
        assert f"extra {extra} missing: {EXTRAS[extra][0]} needs" in words


FROM_COMMIT = {"url": "https://example.org/georef.git", "vcs_info": {"vcs": "git", "commit_id": "1a2b3c4"}}


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        (
            {"url": "file:///home/me/georefgs-0.2.0-py3-none-any.whl"},
            "/home/me/georefgs-0.2.0-py3-none-any.whl[mesh]",
        ),
        ({"url": "file:///home/my%20name/georef", "dir_info": {}}, "/home/my name/georef[mesh]"),
        (
            {"url": "https://example.org/georefgs-0.2.0.tar.gz"},
            "georefgs[mesh] @ https://example.org/georefgs-0.2.0.tar.gz",
        ),
        (FROM_COMMIT, "georefgs[mesh] @ git+https://example.org/georef.git"),
        (None, "georefgs[mesh]"),
    ],
)
@pytest.mark.skipif(sys.platform == "win32", reason="the paths are of Linux")
def test_remedy_installs_from_where_the_program_came(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, origin: dict[str, object] | None, expected: str
) -> None:
    """As pip records it (PEP 610); of an index it records nothing."""
    text = None if origin is None else json.dumps(origin)
    monkeypatch.setattr(extras, "__file__", str(tmp_path / "site/pipelines/core/extras.py"))
    monkeypatch.setattr(
        extras.metadata, "distribution", lambda _name: SimpleNamespace(read_text=lambda _file: text)
    )
    assert installing("mesh") == f"pip install '{expected}'"


def test_remedy_in_a_checkout_names_it() -> None:
    assert installing("mesh") == f"pip install '{REPOSITORY}[mesh]'"
