"""Who may call whom (docs/architecture.md), read off the imports of every file.

Imports inside functions count as well: they put off the cost of a library, not the dependence on it.
"""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from georef_cli.command import COMMANDS, command_module
from pipelines.core.stages import PIPELINE

REPOSITORY = Path(__file__).parents[1]
PACKAGES = ("georef_cli", "pipelines")

# From the ground up. A file may import what lies on a lower floor, or in its own room. Rooms of one floor may use
# each other as long as no circle arises; stage rooms never do: they meet in the workspace.
FLOORS: tuple[tuple[str, ...], ...] = (
    ("pipelines.core",),
    ("pipelines.geodesy", "pipelines.geometry"),
    ("pipelines.formats",),
    ("pipelines.splat", "pipelines.survey"),
    # The adjustment, with calibrate, geolocate and init-sim3, which are its steps.
    ("pipelines.adjust",),
    ("pipelines.surface",),
    # The stage `report`, and the pages and plots that others draw with.
    ("pipelines.report",),
    ("pipelines.jobs",),
    (
        "pipelines.change",
        "pipelines.clean",
        "pipelines.compare",
        "pipelines.deliver",
        "pipelines.evaluate",
        "pipelines.ingest",
        "pipelines.sfm",
        "pipelines.simulate",
        "pipelines.train",
        "pipelines.view",
    ),
    ("georef_cli",),
)
STAGE_FLOOR = 8
STAGE_ROOMS = FLOORS[STAGE_FLOOR]
# The command line starts stages through the runner, chooses the engine, and shows products; what makes them is none
# of its business.
SEEN_BY_CLI = (
    "pipelines.core",
    "pipelines.adjust",
    "pipelines.jobs",
    "pipelines.survey",
    "georef_cli",
    *STAGE_ROOMS,
)

HOMES: dict[str, tuple[str, ...]] = {
    "click": ("georef_cli",),
    "rich": ("georef_cli",),
    "pyproj": ("pipelines.geodesy",),
    "pycolmap": ("pipelines.geometry.cameras",),
    "numba": ("pipelines.sfm.near_matches", "pipelines.splat", "pipelines.surface"),
    "gsplat": ("pipelines.splat.rasterizer.cuda_kernels",),
    "torch": (
        *("pipelines.splat", "pipelines.survey", "pipelines.surface"),
        "pipelines.jobs.machine",
        *STAGE_ROOMS,
    ),
    "filelock": ("pipelines.core",),
    "psutil": ("pipelines.core.machine",),
    "platformdirs": ("pipelines.core.machine",),
    "PIL": ("pipelines.formats.exif", "pipelines.formats.exif_writer", "pipelines.formats.sog"),
    "kornia": ("pipelines.sfm.learned_features",),
    "laspy": ("pipelines.formats",),
    "copclib": ("pipelines.formats.copc",),
    "pillow_heif": ("pipelines.formats.heif",),
    "py4dgeo": ("pipelines.surface.m3c2",),
    "plyfile": ("pipelines.formats",),
    "defusedxml": ("pipelines.formats",),
    "rosbags": ("pipelines.formats",),
    "pye57": ("pipelines.formats.e57",),
    "OpenEXR": ("pipelines.formats.depth_image",),
    "trimesh": ("pipelines.surface.mesh",),
    "embreex": ("pipelines.simulate.mesh",),
    "matplotlib": ("pipelines.report.plots",),
    "jinja2": ("pipelines.report.page",),
    "zstandard": ("pipelines.formats",),
    "rasterio": ("pipelines.formats",),
    "pyogrio": ("pipelines.formats.vector_files", "pipelines.formats.vector_source"),
    "ezdxf": ("pipelines.formats.vector_files",),
    "CSF": ("pipelines.surface.ground",),
    "tornado": ("pipelines.view.server",),
    "dask": ("pipelines.jobs",),
    "distributed": ("pipelines.jobs",),
    "cryptography": ("pipelines.jobs.cluster",),
    "fsspec": ("pipelines.jobs",),
}
# The entry point of a process whose log records go to its parent.
CHILD = "pipelines.core.child"
CORE_LIBRARIES = {"filelock", "numpy", "platformdirs", "psutil", "pydantic"}


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


@functools.cache
def imports(module: str) -> tuple[str, ...]:
    """Full names of everything that a file imports; relative imports are not used here, and fail."""
    names: list[str] = []
    for node in ast.walk(sources()[module]):
        if isinstance(node, ast.Import):
            names += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}:{node.lineno}: relative import"
            names += (f"{node.module}.{alias.name}" for alias in node.names)
    return tuple(names)


@functools.cache
def own_imports() -> list[tuple[str, str]]:
    """(importer, imported module) for all imports among our own files."""
    pairs = []
    for module in sources():
        for name in imports(module):
            if name.startswith(PACKAGES):
                pairs.append((module, name if name in sources() else name.rpartition(".")[0]))
    return pairs


def room_of(module: str) -> tuple[int, str] | None:
    """Floor and room of a module; None for the bare packages."""
    rooms = ((floor, room) for floor, members in enumerate(FLOORS) for room in members)
    return next(((floor, room) for floor, room in rooms if inside(module, room)), None)


def why_wrong(importer: str, imported: str) -> str | None:
    """Which rule an import breaks, or None."""
    above, below = room_of(importer), room_of(imported)
    if above is None or below is None or above[1] == below[1]:
        return None
    if below[0] > above[0]:
        return "points upwards"
    if above[0] == below[0] == STAGE_FLOOR:
        return "ties two stages"
    if above[1] == "georef_cli" and below[1] not in SEEN_BY_CLI:
        return "goes past the stages"
    return None


def circles(arrows: Mapping[str, set[str]]) -> list[set[str]]:
    """Members of each circle: the strongly connected parts of more than one member (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[set[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in sorted(arrows.get(node, ())):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            part = {stack.pop()}
            while node not in part:
                part.add(stack.pop())
            if len(part) > 1:
                found.append(part)

    for node in sorted(arrows):
        if node not in index:
            visit(node)
    return found


def test_every_file_has_a_room() -> None:
    homeless = [name for name in sources() if room_of(name) is None and name not in PACKAGES]
    assert not homeless, f"give it a floor in this test and in docs/architecture.md: {homeless}"


def test_arrows_point_down() -> None:
    pairs = ((importer, imported, why_wrong(importer, imported)) for importer, imported in own_imports())
    assert [f"{importer} → {imported} {rule}" for importer, imported, rule in pairs if rule] == []


def test_rooms_form_no_circle() -> None:
    arrows: dict[str, set[str]] = {}
    for importer, imported in own_imports():
        above, below = room_of(importer), room_of(imported)
        if above and below and above[1] != below[1]:
            arrows.setdefault(above[1], set()).add(below[1])
    assert circles(arrows) == []


def test_files_form_no_circle() -> None:
    """Imports inside functions count: a circle of files is one thing that was cut in two at the wrong place."""
    arrows: dict[str, set[str]] = {}
    for importer, imported in own_imports():
        arrows.setdefault(importer, set()).add(imported)
    assert circles(arrows) == []


@pytest.mark.parametrize(
    ("importer", "imported", "rule"),
    [
        ("pipelines.core.runner", "pipelines.survey.survey", "points upwards"),
        ("pipelines.geometry.intersection", "pipelines.formats.colmap", "points upwards"),
        ("pipelines.evaluate.stage", "pipelines.train.trainer", "ties two stages"),
        ("pipelines.compare.stage", "pipelines.evaluate.report", "ties two stages"),
        ("pipelines.formats.ground_points", "pipelines.ingest.survey_assembly", "points upwards"),
        ("georef_cli.tables", "pipelines.splat.gaussians", "goes past the stages"),
        ("pipelines.train.stage", "pipelines.survey.scene", None),
        ("georef_cli.commands.run", "pipelines.core.runner", None),
    ],
)
def test_a_planted_import_is_judged(importer: str, imported: str, rule: str | None) -> None:
    """The rule itself: a check that finds nothing must be one that would."""
    assert why_wrong(importer, imported) == rule


def test_a_planted_circle_is_found() -> None:
    arrows = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": set()}
    assert circles(arrows) == [{"a", "b", "c"}]


@pytest.mark.parametrize("library", HOMES)
def test_library_stays_at_home(library: str) -> None:
    users = {module for module in sources() for name in imports(module) if inside(name, library)}
    strangers = [user for user in sorted(users) if not any(inside(user, home) for home in HOMES[library])]
    assert strangers == []


# Names that several files have: what the runner calls of a stage, what the command line asks of a command.
PROTOCOLS = {"run", "command"}


def public(module: str) -> Iterator[ast.ClassDef | ast.FunctionDef]:
    """Classes and functions of a file that others may use."""
    for node in sources()[module].body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            yield node


def test_a_public_name_exists_once() -> None:
    files: dict[str, list[str]] = {}
    for module in sources():
        for node in public(module):
            files.setdefault(node.name, []).append(module)
    shared = {name: modules for name, modules in files.items() if len(modules) > 1 and name not in PROTOCOLS}
    assert shared == {}


def test_public_functions_say_what_they_return() -> None:
    silent = [
        f"{module}.{node.name}"
        for module in sources()
        for node in public(module)
        if isinstance(node, ast.FunctionDef) and ast.get_docstring(node) is None
    ]
    assert silent == []


@pytest.mark.parametrize(
    ("formula", "home"),
    [
        (r"np\.linalg\.cholesky\((?!normal)", "geometry/statistics.py"),  # the root of a covariance
        (r"np\.eye\(3\) - direction", "geometry/intersection.py"),  # projections across rays
        (r"\b_?(SIGMA|PRIOR)_(ARM_M|BORESIGHT_RAD)\b.* = ", "adjust/state.py"),
        (r"\bprior\b.*=.*_OBSERVED_PART|_OBSERVED_PART.* = ", "adjust/state.py"),  # the rule of what is observed
        (r"^    estimate: MountParameters", "ingest/options.py"),  # the option that names it
    ],
    ids=["roots", "rays", "prior", "rule", "option"],
)
def test_formula_is_written_once(formula: str, home: str) -> None:
    files = (REPOSITORY / "pipelines").rglob("*.py")
    assert [str(path) for path in files if re.search(formula, path.read_text("utf-8"), re.MULTILINE)] == [
        str(REPOSITORY / "pipelines" / home)
    ]


# The solution of a survey is one type. Survey, scene, observations and Gaussians stand beside it, in no wrapper.
# Training moves in the coordinates of its normal matrix, and has no second form of its unknowns.
FORMER_WRAPPERS = {
    "Adjustment",
    "AdjustedScene",
    "CameraCorrections",
    "CorrectionBasis",
    "Estimated",
    "EvaluatedSurvey",
    "InitialSimilarity",
    "JointAdjustment",
    "LearnableSimilarity",
    "MOST_JOINT_CAMERAS",
    "SolvedSurvey",
    "TrainedSurvey",
}


def names_in(source: str, sought: set[str]) -> set[str]:
    """Which of the names a module defines, imports or uses."""
    if not any(name in source for name in sought):  # parsing takes a hundred times as long
        return set()
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.alias):
            found.add(node.name)
        elif isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
    return found & sought


def test_a_solution_is_one_type() -> None:
    names = {"b", "D", "f", "G"}
    assert names_in("from a import b as c\nclass D:\n    e: f.G", {*names, "h"}) == names
    files = [path for name in (*PACKAGES, "tests", "examples") for path in (REPOSITORY / name).rglob("*.py")]
    again = {str(path): names_in(path.read_text("utf-8"), FORMER_WRAPPERS) for path in files}
    assert {path: names for path, names in again.items() if names} == {}


def classes_in(tree: ast.Module) -> dict[str, ast.ClassDef]:
    """All classes of a module by name."""
    return {node.name: node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def measured_again(kinds: set[str], tree: ast.Module) -> set[str]:
    """Which classes of a module are called after a kind of measurement, such as `TensorFixes`."""
    return {name for name in classes_in(tree) if name.endswith(tuple(kinds))}


def test_training_measures_nothing_a_second_time() -> None:
    """A measurement is a term of the adjustment: training is held to it by the normal matrix."""
    terms = classes_in(sources()["pipelines.adjust.terms"])
    kinds = {name for name, node in terms.items() if any(dotted(base).endswith("Term") for base in node.bases)}
    assert {"Fixes", "ControlPoints", "Attitudes", "Distances"} < kinds
    assert measured_again(kinds, ast.parse("class TensorFixes: ...")) == {"TensorFixes"}
    training = {module: tree for module, tree in sources().items() if inside(module, "pipelines.train")}
    again = {module: measured_again(kinds, tree) for module, tree in training.items()}
    assert {module: names for module, names in again.items() if names} == {}


# Names by which the adjustment is solved. Others read the solution that it has stored.
SOLVERS = {"minimise", "linearised", "problem_of", "SparseCholesky"}
# The baseline of the comparison adjusts on its own.
WHERE_SOLVED = ("pipelines.adjust.", "pipelines.train.", "pipelines.geometry.", "pipelines.sfm.prior_adjustment")


def solvers_in(tree: ast.Module) -> set[str]:
    """Names of the solver that a module imports or calls."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
    return found & SOLVERS


def test_nobody_solves_to_read() -> None:
    planted = ast.parse("from pipelines.adjust import system\nsystem.minimise(problem)")
    assert solvers_in(planted) == {"minimise"}
    solving = {module: names for module, tree in sources().items() if (names := solvers_in(tree))}
    assert {name: names for name, names in solving.items() if not name.startswith(WHERE_SOLVED)} == {}


def test_core_is_light() -> None:
    for module in sources():
        if inside(module, "pipelines.core"):
            libraries = {name.partition(".")[0] for name in imports(module)}
            assert libraries <= {*sys.stdlib_module_names, *CORE_LIBRARIES, "pipelines"}, module


def test_building_the_commands_imports_nothing_heavy() -> None:
    """What a stage computes with is imported when it runs: `georef --help` and `status` answer at once."""
    modules = [f"georef_cli.commands.{command_module(name)}" for name in COMMANDS]
    code = f"import importlib, sys; [importlib.import_module(name) for name in {modules}]; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=REPOSITORY)
    assert not {"torch", "pycolmap", "numba", "matplotlib", "scipy", "cv2", "pyproj"} & set(done.stdout.split())


def test_table_of_commands_is_complete() -> None:
    """Every module in commands/ holds commands, and every command has its module."""
    modules = {path.stem for path in (REPOSITORY / "georef_cli/commands").glob("*.py")} - {"__init__"}
    assert modules == set(map(command_module, COMMANDS))
    assert {spec.name for spec in PIPELINE} <= set(COMMANDS)


def dotted(node: ast.expr) -> str:
    """A name with its attributes, `a.b.c`, with `?` for what is not a name."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


@functools.cache
def calls(module: str) -> list[tuple[str, ast.Call]]:
    """All calls of a file with the dotted name of what is called."""
    return [(dotted(node.func), node) for node in ast.walk(sources()[module]) if isinstance(node, ast.Call)]


def keyword(call: ast.Call, name: str) -> object:
    found = next((word.value for word in call.keywords if word.arg == name), None)
    return found.value if isinstance(found, ast.Constant) else None


def test_no_shell_is_called_and_the_library_talks_through_logs() -> None:
    """No print and no log handlers in the library. What could execute data: `test_security.py`."""
    wrong = []
    for module in sources():
        for name, call in calls(module):
            of_shell = name == "os.system" or keyword(call, "shell") is True
            talks = name in ("print", "sys.exit", "logging.basicConfig")
            handles = name.endswith(".addHandler") and module != CHILD
            if of_shell or ((talks or handles) and inside(module, "pipelines")):
                wrong.append(f"{module}:{call.lineno}: {name}")
    assert wrong == []
