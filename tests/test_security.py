"""Input is hostile until parsed: nothing is executed, nothing leaves its folder, sizes are checked first."""

from __future__ import annotations

import ast
import json
import os
import struct
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.child import python_command, python_environment
from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.core.stages import POINTS, SPARSE, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse, write_sparse
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.scene import photographs
from pipelines.survey.solution import GeolocatedPoints
from pipelines.survey.survey import FixSession, Survey
from tests.photos import Exif, gps_entries, jpeg, write_flight
from tests.refusals import numbers, refused, said
from tests.scenes import Measured, Noise, make_scene, sparse_model, survey_of, write_workspace
from tests.test_architecture import calls, imports, keyword, sources

REPOSITORY = Path(__file__).parents[1]
FORBIDDEN = {
    "eval", "exec", "compile", "pickle", "marshal", "shelve", "dill", "yaml", "subprocess", "os.system", "os.popen",
    "torch.save",
}  # fmt: skip
# Readers that unpickle unless they are told not to, and how they are told.
PICKLING = {
    "np.load": ("allow_pickle", False),
    "numpy.load": ("allow_pickle", False),
    "torch.load": ("weights_only", True),
}
# The files that start a process: this program again, for native code and for jobs; the user's browser; the
# compilers of the CUDA kernels, which are asked for their versions; and Python, which calls them, and pip.
STARTS_ITSELF = REPOSITORY / "pipelines/core/child.py"
STARTS_JOBS = REPOSITORY / "pipelines/jobs/local.py"
STARTS_A_BROWSER = REPOSITORY / "pipelines/report/chromium.py"
STARTS_A_COMPILER = REPOSITORY / "pipelines/splat/rasterizer/cuda_kernels.py"
ASKS_COMPILERS = REPOSITORY / "pipelines/splat/rasterizer/cuda_parts.py"
STARTS_WORKERS = REPOSITORY / "pipelines/jobs/dask_task.py"  # by Dask
STARTS_PIP = REPOSITORY / "pipelines/sfm/learned_weights.py"  # for weights, whose hash is known
ASKS_GIT = REPOSITORY / "pipelines/core/version.py"  # for the commit of its own checkout
STARTERS = (STARTS_ITSELF, STARTS_JOBS, STARTS_A_BROWSER, STARTS_A_COMPILER, ASKS_COMPILERS, STARTS_PIP, ASKS_GIT)
ESCAPES = ["../secret.jpg", "/etc/passwd", "a/../../secret.jpg", "", "a\nb.jpg", "a\x00b.jpg"]


def test_nothing_that_is_read_can_be_executed() -> None:
    starters = {".".join(file.relative_to(REPOSITORY).with_suffix("").parts) for file in STARTERS}
    assert starters <= set(sources())
    for module in sources():
        of_imports = {part for name in imports(module) for part in (name, name.rpartition(".")[0])}
        used = FORBIDDEN & (of_imports | {name for name, _ in calls(module)})
        assert used <= ({"subprocess"} if module in starters else set()), f"{module} uses {used}"
        for name, call in calls(module):
            if name in PICKLING:
                option, safe = PICKLING[name]
                assert keyword(call, option) is safe, f"{module}:{call.lineno} may unpickle"


@pytest.mark.parametrize(
    ("file", "arguments", "environment"),
    [
        (STARTS_ITSELF, "python_command(['-m', __name__,", "python_environment()"),
        (STARTS_JOBS, "python_command([*program,", "python_environment()"),
        (STARTS_A_COMPILER, "python_command(['-c', _COMPILE])", "_environment(draft)"),
        (ASKS_GIT, "['git', '-C', str(checkout), 'describe',", None),
        (STARTS_PIP, "python_command(['-m', 'pip', 'download',", "python_environment()"),
        (ASKS_COMPILERS, "[program, '--version']", None),
        (STARTS_A_BROWSER, "[*command, page.absolute().as_uri()]", None),
    ],
)
def test_only_this_python_and_named_programs_are_started(
    file: Path, arguments: str, environment: str | None
) -> None:
    """No module of the current folder is imported by a Python that is started: `pipelines.core.child`."""
    module = ".".join(file.relative_to(REPOSITORY).with_suffix("").parts)
    (call,) = [call for name, call in calls(module) if "subprocess" in name]
    assert ast.unparse(call.args[0]).startswith(arguments)
    options = {str(keyword.arg): ast.unparse(keyword.value) for keyword in call.keywords}
    assert "shell" not in options and options.get("env") == environment


def test_one_module_knows_how_python_is_started_without_the_current_folder() -> None:
    """The compilers' environment and that of Dask's nannies are made of its own."""
    assert python_command(["-m", "x"]) == [sys.executable, "-P", "-m", "x"]
    assert python_environment()["PYTHONSAFEPATH"] == "1"
    assert "**python_environment()," in STARTS_A_COMPILER.read_text("utf-8")
    assert "os.environ.update(python_environment())" in STARTS_WORKERS.read_text("utf-8")
    files = [file for package in ("georef_cli", "pipelines") for file in (REPOSITORY / package).rglob("*.py")]
    named = {file for file in files if "sys.executable" in file.read_text("utf-8")}
    assert named == {REPOSITORY / "pipelines/core/child.py", ASKS_COMPILERS}  # which looks beside it for ninja


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    """A survey and its SfM model, as the stages leave them."""
    rng = np.random.default_rng(4)
    scene = make_scene()
    session = FixSession(receiver="RTK fixed", sigma_common_m=(0.03, 0.03, 0.05), sigma_source="default")
    survey = survey_of(scene, Noise(), Measured(), rng).model_copy(update={"sessions": (session,)})
    return write_workspace(tmp_path / "ws", survey, sparse_model(scene, Noise(), rng))


def _edited(workspace: Workspace, *keys: Any, value: Any) -> Path:
    """The survey with one value replaced by hand."""
    path = workspace.path(SURVEY)
    document = json.loads(path.read_text("utf-8"))
    place = document
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    path.write_text(json.dumps(document), "utf-8")
    return path


@pytest.mark.parametrize("name", ESCAPES)
def test_image_names_of_a_survey_stay_inside(workspace: Workspace, name: str) -> None:
    path = _edited(workspace, "images", 0, "name", value=name)
    with refused("product-invalid", InputError) as error:
        load_json(Survey, path)
    assert (error.value.path, error.value.field) == (path, "images.0.name")
    assert "leaves the folder of photographs" in error.value.message


MARK = {"image": "a.jpg", "x_px": 1.0, "y_px": 1.0, "sigma_px": 1.0}
POINT = {"name": "P1", "position_in_geo": [0, 0, 0], "cov_in_geo": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("image_dir",), "../elsewhere", r"\[image_dir\].*leaves the workspace"),
        (("images", 1, "camera_id"), 7, "which is not among the cameras"),
        (("images", 1, "name"), "DUPLICATE", "images: two have the same name"),
        (("control_points",), [{**POINT, "marks": []}] * 2, "control_points: two have the same name"),
        (("check_points",), [{**POINT, "marks": [MARK, MARK]}], r"check_points\.0\].*two are in one image"),
        (("images", 0, "fix", "cov_in_geo"), [[0.0] * 3] * 3, r"cov_in_geo\].*positive definite"),
        (
            ("images", 0, "fix", "cov_in_geo"),
            [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
            r"cov_in_geo\].*positive definite",
        ),
        (("images", 0, "fix", "position_in_geo"), [1e999, 0, 0], r"position_in_geo\.0\].*finite number"),
        (("images", 0, "attitude"), {"quat_xyzw": [0, 0, 0, 0], "sigma_deg": 1, "source": "csv"}, "length 1"),
        (("format_version",), 3, r"\[format_version\]"),
        (("format_version",), 1, "an earlier version of georef made this survey.*run `georef ingest` again"),
        (("images", 1, "fix", "session"), 1, "has session 1, which is not among the sessions"),
        (("sessions", 0, "sigma_common_m"), [0.1, -0.1, 0.1], r"sigma_common_m\.1\].*greater than or equal to 0"),
        (("surprise",), 1, r"\[surprise\].*not permitted"),
    ],
)
def test_survey_by_hand_is_checked(workspace: Workspace, keys: tuple[Any, ...], value: Any, message: str) -> None:
    if value == "DUPLICATE":
        value = load_json(Survey, workspace.path(SURVEY)).images[0].name
    path = _edited(workspace, *keys, value=value)
    with pytest.raises(InputError, match=message):
        load_json(Survey, path)


@pytest.mark.parametrize("name", ["../secret.jpg", "/etc/passwd"])
def test_image_names_of_a_colmap_model_stay_inside(workspace: Workspace, name: str) -> None:
    model = read_sparse(workspace.path(SPARSE))
    names = (name, *model.image_name[1:])
    write_sparse(type(model)(**{**vars(model), "image_name": names}), workspace.path(SPARSE))
    with refused("image-outside-folder", InputError):
        read_sparse(workspace.path(SPARSE))


def test_a_model_with_images_of_another_survey_is_not_read_from(workspace: Workspace) -> None:
    model = read_sparse(workspace.path(SPARSE))
    survey = load_json(Survey, workspace.path(SURVEY))
    fewer = survey.model_copy(update={"images": survey.images[1:]})
    with refused("images-not-in-survey", InputError) as error:
        photographs(model, fewer, workspace, 64)
    assert numbers(error.value.message)[0] == 1 and "sfm --import" in error.value.remedy


def test_cached_photographs_are_named_by_hash(tmp_path: Path, workspace: Workspace) -> None:
    model = read_sparse(workspace.path(SPARSE))
    survey = load_json(Survey, workspace.path(SURVEY)).model_copy(update={"image_dir": str(tmp_path / "photos")})
    camera = model.camera_of(0)
    for name in model.image_name:
        file = tmp_path / "photos" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(jpeg(size=(camera.width, camera.height)))
    photographs(model, survey, workspace, 64).build()
    names = [path.name for path in workspace.cache.rglob("*") if path.is_file()]
    assert len(names) == len(model.image_name)
    assert all(len(name) == 36 and name.endswith(".npy") for name in names)


def test_a_photograph_that_is_gone_is_told(workspace: Workspace) -> None:
    survey = load_json(Survey, workspace.path(SURVEY))
    with refused("photograph-missing", InputError) as error:
        photographs(read_sparse(workspace.path(SPARSE)), survey, workspace, 64).build()
    assert "No such file" in error.value.message and "georef ingest" in error.value.remedy


def _points(count: int) -> dict[str, np.ndarray]:
    return {
        "point_id": np.arange(count),
        "position_in_geo": np.zeros((count, 3)),
        "cov_in_geo": np.zeros((count, 3, 3)),
        "ray_count": np.ones(count, np.int32),
        "max_angle_deg": np.ones(count),
        "condition": np.ones(count),
        "inlier": np.ones(count, bool),
        "rotation_source": np.array("sfm"),
    }


@pytest.mark.parametrize(
    ("name", "value", "code", "field", "words"),
    [
        ("position_in_geo", np.zeros((3, 2)), "array-form", "position_in_geo", "(3, 2)"),
        ("inlier", np.ones(2, bool), "array-form", "inlier", "(2,)"),
        ("point_id", np.zeros(3), "array-form", "point_id", "(3,) float64"),
        ("condition", np.array([{}] * 3, dtype=object), "npz-damaged", None, "allow_pickle=False"),
    ],
)
def test_points_by_hand_are_checked(
    tmp_path: Path, name: str, value: np.ndarray, code: str, field: str | None, words: str
) -> None:
    path = tmp_path / Path(POINTS).name
    np.savez(path, **{**_points(3), name: value})
    with refused(code, InputError) as error:
        GeolocatedPoints.load(path)
    assert (error.value.path, error.value.field) == (path, field) and words in error.value.message


def test_an_array_that_claims_to_be_huge_is_refused(tmp_path: Path) -> None:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,), }".ljust(117) + b"\n"
    path = tmp_path / "points.npz"
    np.savez(path, **{key: array for key, array in _points(3).items() if key != "condition"})
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("condition.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    with refused("npz-damaged", InputError):
        GeolocatedPoints.load(path)


def test_names_that_are_no_text_are_left_out_of_a_survey(tmp_path: Path) -> None:
    write_flight(tmp_path, 3)
    photograph = jpeg(9, exif=Exif(gps=gps_entries(46.02, 7.75)))
    (tmp_path / "new\nline.jpg").write_bytes(photograph)
    Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.jpg")).write_bytes(photograph)
    survey = survey_and_track(IngestOptions(images=tmp_path), None)[0]
    assert len(survey.images) == 3
    assert numbers(said(survey.warnings, "image-name-not-text"))[0] == 2.0


def test_links_that_leave_the_folder_are_left_out(tmp_path: Path) -> None:
    write_flight(tmp_path / "photos", 3)
    (tmp_path / "private.jpg").write_bytes(jpeg(9))
    (tmp_path / "photos/link.jpg").symlink_to(tmp_path / "private.jpg")
    survey = survey_and_track(IngestOptions(images=tmp_path / "photos"), None)[0]
    assert "(1): link.jpg." in said(survey.warnings, "image-link-outside")
