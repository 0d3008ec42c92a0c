"""Lists of missions: defaults and differences, and hostile ones, whose fault is named before any work starts."""

from __future__ import annotations

import json
import re
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as settings_of_hypothesis
from hypothesis import strategies as st

from georef_cli.commands.run import OWNERS
from georef_cli.options import settings
from pipelines.core.errors import InputError
from pipelines.core.options import remember
from pipelines.core.stages import BY_NAME
from pipelines.jobs.batch import run_arguments
from pipelines.jobs.missions import load_missions
from tests.refusals import refused

REPOSITORY = Path(__file__).parents[2]
GOOD = '[missions.a]\nimages = "a"\n'


def written(folder: Path, text: str) -> Path:
    path = folder / "list.toml"
    path.write_text(text, "utf-8")
    return path


def test_differences_override_defaults(tmp_path: Path) -> None:
    text = (
        '[defaults]\npreset = "fast"\ndeliver = "raster"\n[defaults.train]\nseed = 1\nsh_degree = 2\n'
        '[missions.a]\nimages = "a"\nbackend = "cpu"\n[missions.a.train]\nseed = 5\n'
        '[missions.b]\nimages = "/photos/b"\ndeliver = "report"\nto = "evaluate"\n'
    )
    a, b = load_missions(written(tmp_path, text), OWNERS).missions
    assert a.flags == {
        "ingest": {"images": str(tmp_path / "a")},
        "train": {"preset": "fast", "backend": "cpu", "seed": 5, "sh_degree": 2},
        "evaluate": {"backend": "cpu"},
    }
    assert b.flags["ingest"] == {"images": "/photos/b"}
    assert [spec.name for spec in b.stages][-2:] == ["evaluate", "report"]
    assert (a.workspace.root, b.workspace.root) == (tmp_path / "a", tmp_path / "b")


@pytest.mark.parametrize(
    ("text", "code", "field"),
    [
        ("", "no-missions", None),
        ("[missions", "toml-invalid", None),
        ("x = 1", "unknown-table", "x"),
        ("missions = 3", "not-a-table", "missions"),
        ("[missions]\na = 3", "not-a-table", "missions.a"),
        ('[missions."../a"]', "mission-name", "missions.../a"),
        ('[missions.".a"]', "mission-name", "missions..a"),
        ('[missions."a/b"]', "mission-name", "missions.a/b"),
        ("[missions.a]\nimage = 1", "unknown-option", "missions.a.image"),
        ("[missions.a]\nseed = -1", "option-invalid", "missions.a.seed"),
        ('[missions.a]\niterations = "many"', "option-invalid", "missions.a.iterations"),
        ("[missions.a.train]\ndegree = 1", "unknown-option", "missions.a.train.degree"),
        ("[missions.a]\ntrain = 1", "not-a-table", "missions.a.train"),
        ('[defaults]\npreset = "fats"\n' + GOOD, "option-invalid", "defaults.preset"),
        ("[missions.a]\nto = 1", "not-a-text", "missions.a.to"),
        ('[missions.a]\nto = "trian"', "unknown-stage", "missions.a.to"),
        ('[missions.a]\nto = "sfm"\n[missions.a.train]\nseed = 1', "stage-not-run", "missions.a.train"),
        ('[missions.a]\ndeliver = "rasters"', "option-invalid", "missions.a.deliver"),
        ('[missions.a]\nworkspace = "../b"', "path-leaves-folder", "missions.a.workspace"),
        ('[missions.a]\nworkspace = "/tmp/b"', "path-leaves-folder", "missions.a.workspace"),
        ('[missions.a]\nimages = "a\\u0000b"', "control-character", "missions.a.images"),
        (GOOD + "[missions.A]", "workspace-shared", "missions.A.workspace"),
        (GOOD + '[missions.b]\nworkspace = "link/b"', "path-leaves-folder", "missions.b"),
    ],
)
def test_a_fault_is_named(tmp_path: Path, text: str, code: str, field: str | None) -> None:
    (tmp_path / "out").mkdir()
    folder = tmp_path / "missions"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path / "out")
    with refused(code, InputError) as error:
        load_missions(written(folder, text), OWNERS)
    assert (error.value.path, error.value.field) == (folder / "list.toml", field)


def test_the_lists_that_are_shown_are_lists(tmp_path: Path) -> None:
    shown = re.findall(r"```toml\n(.*?)```", (REPOSITORY / "docs/batch.md").read_text("utf-8"), re.DOTALL)
    lists = [load_missions(written(tmp_path, text), OWNERS) for text in shown]
    assert [mission.name for listed in lists for mission in listed.missions] == ["north", "south"]
    example = load_missions(REPOSITORY / "examples/batch/missions.toml", OWNERS)
    assert [mission.relative_path for mission in example.missions] == [
        f"workspace/{m.name}" for m in example.missions
    ]


def test_a_folder_of_mission_folders(tmp_path: Path) -> None:
    """Usual files are inputs unless `georef.toml` or an earlier command names others."""
    for name in ("a/images", "b/images", "c", "notes", ".git/images"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("a/gcp_list.txt", "b/trajectory.csv"):
        (tmp_path / name).touch()
    (tmp_path / "c/georef.toml").write_text('[ingest]\nbag = "flight.mcap"\n')
    remember(tmp_path / "b", {"ingest": {"trajectory": "/rtk.csv"}})
    flags = {mission.name: dict(mission.flags["ingest"]) for mission in load_missions(tmp_path, OWNERS).missions}
    assert flags == {
        "a": {"images": tmp_path / "a/images", "gcp": tmp_path / "a/gcp_list.txt"},
        "b": {"images": tmp_path / "b/images"},
        "c": {},
    }


def test_a_folder_that_leads_outside_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out/images").mkdir(parents=True)
    (tmp_path / "in").mkdir()
    (tmp_path / "in/a").symlink_to(tmp_path / "out")
    with refused("path-leaves-folder", InputError):
        load_missions(tmp_path / "in", OWNERS)


def _quoted(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)


# All that TOML's basic strings hold but control characters, which a list of missions refuses.
TEXTS = st.text(st.characters(exclude_categories=("Cs", "Cc")), max_size=30)


@settings_of_hypothesis(max_examples=30)
@given(crs=TEXTS, seed=st.integers(0, 10**9), check=st.lists(TEXTS, max_size=3))
def test_values_survive_the_command_line(
    tmp_path_factory: pytest.TempPathFactory, crs: str, seed: int, check: list[str]
) -> None:
    """What the list says is what `georef run --set` reads back, whatever signs are in it."""
    ingest = f"[missions.a.ingest]\ncrs = {_quoted(crs)}\ncheck = {_quoted(check)}\n"
    text = f"{ingest}[missions.a.train]\nseed = {seed}"
    (mission,) = load_missions(written(tmp_path_factory.getbasetemp(), text), OWNERS).missions
    words = run_arguments(mission)
    sets = [word for before, word in pairwise(words) if before == "--set"]
    assert settings(sets, BY_NAME.values()) == {"ingest": {"crs": crs, "check": check}, "train": {"seed": seed}}
