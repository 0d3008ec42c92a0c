"""Who may call whom (docs/architecture.md), read off the imports of every file.

Imports inside functions count as well: they put off the cost of a library, not the dependence on it.
"""

from __future__ import annotations

import ast
import functools
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from georef_cli.main import COMMANDS
from pipelines.stages import PIPELINE
from pipelines.stages import STAGES as ALL_STAGES

REPOSITORY = Path(__file__).parents[2]
PACKAGES = ("georef_cli", "pipelines")

FOUNDATION = {
    f"pipelines.{name}"
    for name in (
        "config", "errors", "fingerprints", "ingest_config", "interrupts", "products", "progress",
        "simulate_config", "stages", "states", "survey", "train_config", "validators", "workspace",
    )
}  # fmt: skip
# Those that make no product of the workspace are called and built as stages are.
STAGES = {
    "pipelines.calibrate", "pipelines.inspect_bag", "pipelines.simulate", *(spec.module for spec in ALL_STAGES),
}  # fmt: skip
# What runs stages, by their names: compare, on top of the runner, in several configurations.
RUNNERS = {"pipelines.runner", "pipelines.compare", "pipelines.comparison"}
# From the ground up. A file may import what lies on a lower floor.
FLOORS: tuple[set[str], ...] = (
    FOUNDATION,
    {"pipelines.geodesy", "pipelines.geometry", "pipelines.robust"},
    {"pipelines.formats", "pipelines.georef", "pipelines.splat", "pipelines.stereo"},
    {"pipelines.blocks", "pipelines.simulation"},
    STAGES,
    RUNNERS,
    {"georef_cli"},
)
GROUND, STAGE_FLOOR, RUNNER_FLOOR = 0, FLOORS.index(STAGES), FLOORS.index(RUNNERS)
# The command line starts stages through the runner; the floors in between are none of its business.
SEEN_BY_CLI = {GROUND, STAGE_FLOOR, RUNNER_FLOOR, len(FLOORS) - 1}

HOMES: dict[str, tuple[str, ...]] = {
    "click": ("georef_cli",),
    "rich": ("georef_cli",),
    "pyproj": ("pipelines.geodesy",),
    "pycolmap": ("pipelines.sfm", "pipelines.adjust", "pipelines.formats"),
    "numba": ("pipelines.splat", "pipelines.geometry", "pipelines.robust"),
    "gsplat": ("pipelines.splat.raster.cuda",),
    "torch": ("pipelines.splat", "pipelines.georef", "pipelines.blocks", *sorted(STAGES)),
    "plyfile": ("pipelines.formats",),
    "exifread": ("pipelines.formats",),
    "defusedxml": ("pipelines.formats",),
    "rosbags": ("pipelines.formats",),
    "embreex": ("pipelines.simulation",),
    "matplotlib": ("pipelines.formats.bar_plot",),
}
FOUNDATION_LIBRARIES = {"numpy", "pydantic"}


def inside(module: str, room: str) -> bool:
    return module == room or module.startswith(room + ".")


@functools.cache
def sources() -> dict[str, ast.Module]:
    """Syntax trees of all files by module name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((REPOSITORY / package).rglob("*.py")):
            parts = path.relative_to(REPOSITORY).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            found[name] = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    return found


def imports(tree: ast.AST) -> Iterator[str]:
    """Full names of everything that a file imports; relative imports are not used here, and fail."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def own_imports() -> list[tuple[str, str]]:
    """(importer, imported module) for all imports among our own files."""
    pairs = []
    for module, tree in sources().items():
        for name in imports(tree):
            if name.startswith(PACKAGES):
                target = name if name in sources() else name.rpartition(".")[0]
                pairs.append((module, target))
    return pairs


def room_of(module: str) -> tuple[int, str] | None:
    """Floor and room of a module; None for the bare packages."""
    rooms = ((floor, room) for floor, members in enumerate(FLOORS) for room in members)
    return next(((floor, room) for floor, room in rooms if inside(module, room)), None)


def test_every_file_has_a_room() -> None:
    homeless = [name for name in sources() if room_of(name) is None and name not in PACKAGES]
    assert not homeless, f"give it a floor in this test and in docs/architecture.md: {homeless}"


def test_arrows_point_down() -> None:
    wrong = []
    for importer, imported in own_imports():
        above, below = room_of(importer), room_of(imported)
        if above is None or below is None:
            continue
        same_room = above[1] == below[1]
        upwards = below[0] > above[0]
        between_stages = above[0] == below[0] == STAGE_FLOOR and not same_room
        past_the_runner = above[1] == "georef_cli" and below[0] not in SEEN_BY_CLI
        runner_knows_stage = above[1] == "pipelines.runner" and below[0] not in (GROUND, RUNNER_FLOOR)
        runner_knows_stage |= above[0] == RUNNER_FLOOR and below[0] == STAGE_FLOOR
        if upwards or between_stages or past_the_runner or runner_knows_stage:
            wrong.append(f"{importer} → {imported}")
    assert wrong == []


def test_rooms_form_no_circle() -> None:
    arrows: dict[str, set[str]] = {}
    for importer, imported in own_imports():
        above, below = room_of(importer), room_of(imported)
        if above and below and above[1] != below[1]:
            arrows.setdefault(above[1], set()).add(below[1])
    done: set[str] = set()

    def visit(room: str, path: tuple[str, ...]) -> None:
        assert room not in path, " → ".join((*path, room))
        if room not in done:
            for other in sorted(arrows.get(room, ())):
                visit(other, (*path, room))
            done.add(room)

    for room in sorted(arrows):
        visit(room, ())


@pytest.mark.parametrize("library", HOMES)
def test_library_stays_at_home(library: str) -> None:
    users = {module for module, tree in sources().items() for name in imports(tree) if inside(name, library)}
    strangers = [user for user in sorted(users) if not any(inside(user, home) for home in HOMES[library])]
    assert strangers == []


def test_foundation_is_light() -> None:
    for module in FOUNDATION | {"pipelines.runner"}:
        libraries = {name.partition(".")[0] for name in imports(sources()[module])}
        assert libraries <= {*sys.stdlib_module_names, *FOUNDATION_LIBRARIES, "pipelines"}, module


def test_command_line_imports_no_stage_ahead_of_time() -> None:
    """At module level a command may import no stage: building the command must not cost its libraries."""
    for module, tree in sources().items():
        if inside(module, "georef_cli"):
            ahead = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
            names = [name for node in ahead for name in imports(node)]
            assert not [name for name in names if any(inside(name, stage) for stage in STAGES)], module


def test_table_of_commands_is_complete() -> None:
    """Every module in commands/ is a command, and every command has its module."""
    modules = {path.stem for path in (REPOSITORY / "georef_cli/commands").glob("*.py")} - {"__init__"}
    assert modules == {entry.module for entry in COMMANDS.values()}
    assert {spec.name for spec in PIPELINE} <= set(COMMANDS)


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    """All calls with the dotted name of what is called."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def keyword(call: ast.Call, name: str) -> object:
    found = next((word.value for word in call.keywords if word.arg == name), None)
    return found.value if isinstance(found, ast.Constant) else None


@pytest.mark.parametrize("module", sorted(sources()))
def test_files_are_read_safely_and_talk_through_logs(module: str) -> None:
    """No code from data: no pickle, no eval. No print and no log handlers in the library."""
    tree = sources()[module]
    assert not {"pickle", "marshal", "shelve", "dill"} & {name.partition(".")[0] for name in imports(tree)}
    for name, call in calls(tree):
        where = f"{module}:{call.lineno}"
        assert name not in ("eval", "exec", "os.system"), where
        assert keyword(call, "shell") is not True, where
        if name in ("np.load", "numpy.load"):
            assert keyword(call, "allow_pickle") is False, where
        if name == "torch.load":
            assert keyword(call, "weights_only") is True, where
        if inside(module, "pipelines"):
            assert name not in ("print", "sys.exit", "logging.basicConfig"), where
            assert not name.endswith(".addHandler"), where
