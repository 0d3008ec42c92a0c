"""The engine of WebODM in examples/webodm, called as NodeODM calls it; no part of NodeODM is needed."""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import psutil
import pytest
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from pipelines import __version__
from pipelines.geodesy.enu import ecef_from_enu
from tests import webodm_program as truth
from tests.cli_runs import REPOSITORY, Georef
from tests.scripts import load_script

ENGINE = REPOSITORY / "examples/webodm"
UUID = "5d0c4a36-94f5-4f0a-9a3e-1f2b7c6d8e90"
PATIENCE_S = 60.0
# Domains that NodeODM checks; anything else it refuses for every value.
DOMAINS = re.compile(r"<((positive |negative )?(integer|float)|percent|json|string|path)>")
SQUARE = [[[7.74, 46.01], [7.76, 46.01], [7.76, 46.03], [7.74, 46.03], [7.74, 46.01]]]

pytestmark = pytest.mark.skipif(os.name == "nt", reason="run.sh needs a shell; NodeODM on Windows calls run.bat")


@pytest.fixture(scope="module")
def engine() -> Iterator[ModuleType]:
    """The module of the engine."""
    before = list(sys.path)
    yield load_script(ENGINE / "engine.py")
    sys.path[:] = before


@pytest.fixture
def node() -> Iterator[socket.socket]:
    """The port on which the node hears of progress."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        heard.bind(("127.0.0.1", 6367))
        heard.settimeout(PATIENCE_S)
        yield heard


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The folder of a task as NodeODM has made it, beside a `georef` with fake stages."""
    folder = tmp_path / "data" / UUID
    (folder / "gcp").mkdir(parents=True)
    (folder / "images").mkdir()
    for name in truth.OMEGA_DEG:
        (folder / "images" / name).write_bytes(name.encode())
    (folder / "gcp/gcp_list.txt").write_text("EPSG:4326\n", encoding="utf-8")
    program = tmp_path / "georef"
    code = "import sys; sys.path[:0] = [{!r}]\nfrom pathlib import Path\nfrom tests.webodm_program import install\n"
    code += "install(Path({!r}))\nfrom georef_cli.main import main\nmain()\n"
    program.write_text(f"#!{sys.executable}\n" + code.format(str(REPOSITORY), str(tmp_path)), encoding="utf-8")
    program.chmod(0o755)
    return folder


def start(project: Path, *words: str, **variables: str) -> subprocess.Popen[str]:
    """Start a task as NodeODM 2.2 does: options, folder and files of the node, name; in the engine's own folder."""
    call = [str(ENGINE / "run.sh"), *words, "--project-path", str(project.parent), project.name]
    here = {
        "GEOREF_PYTHON": sys.executable,
        "GEOREF": str(project.parents[1] / "georef"),
        "ODM_NONINTERACTIVE": "1",
    }
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), **here, **variables}
    pipe = subprocess.PIPE
    return subprocess.Popen(call, cwd=ENGINE, env=environment, stdout=pipe, stderr=subprocess.STDOUT, text=True)


def run(project: Path, *words: str, **variables: str) -> tuple[int, str]:
    """Do a task; return its exit code and its console."""
    process = start(project, *words, **variables)
    console, _ = process.communicate(timeout=PATIENCE_S)
    return process.returncode, console


def heard_by(node: socket.socket) -> list[tuple[str, str, float]]:
    """Return what the node has heard: process, task and percent."""
    node.setblocking(False)
    heard = []
    while True:
        try:
            command, process, task, percent = node.recv(1000).decode().split("/")
        except BlockingIOError:
            return heard
        assert command == "PGUP"
        heard.append((process, task, float(percent)))


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


class Recorder(argparse.ArgumentParser):
    """Parser that records the form of each option as text, which is all that NodeODM knows of it."""

    def __init__(self) -> None:
        self.forms: dict[str, dict[str, str]] = {}
        super().__init__(add_help=False)

    def add_argument(self, *names: str, **form: Any) -> Any:  # type: ignore[override]
        self.forms[names[0]] = {key: str(value) for key, value in form.items()}
        return super().add_argument(*names, **form)


def test_the_node_can_read_every_option() -> None:
    source = (ENGINE / "opendm/config.py").read_text(encoding="utf-8")
    nodes = list(ast.walk(ast.parse(source)))
    imported = {name.name for node in nodes if isinstance(node, ast.Import) for name in node.names}
    imported |= {str(node.module).partition(".")[0] for node in nodes if isinstance(node, ast.ImportFrom)}
    assert imported <= sys.stdlib_module_names  # it is read by any Python, without georefgs
    module = ModuleType("config")  # which is not among sys.modules: NodeODM executes the file by itself
    exec(compile(source, "config.py", "exec"), module.__dict__)
    recorder = Recorder()
    module.config(["--project-path", "/engine", "bogusname"], parser=recorder)
    hidden = {"--project-path", "--gcp", "--geo", "--align", "--split-image-groups", "name"}
    shown = {name: form for name, form in recorder.forms.items() if name not in hidden}
    assert hidden <= set(recorder.forms)
    # What OpenDroneMap's own table has is of the same kind here; WebODM's presets give these.
    assert {"--dsm", "--dtm", "--cog", "--crop", "--boundary", "--pc-quality", "--orthophoto-resolution"} <= set(
        shown
    )
    for name, form in shown.items():
        assert name.startswith("--") and form["help"].endswith("Default: %(default)s"), name
        default = form["default"]
        if "choices" in form:
            choices = json.loads(form["choices"].replace("'", '"'))
            assert default in [*choices, ""], name
        elif form.get("action") == "store_true":
            assert default == "False", name
        else:
            assert DOMAINS.fullmatch(form["metavar"]), name
            assert form["type"] in ("<class 'int'>", "<class 'float'>", "<class 'str'>"), name
            assert default == "" or form["type"] != "<class 'str'>", name


@pytest.mark.parametrize(
    "words",
    [
        "",
        "--cog --dsm --dtm --3d-tiles --crop 0 --feature-quality ultra --pc-quality lowest --max-concurrency 1",
        "--orthophoto-resolution 5 --dem-resolution 2.5 --gps-accuracy 0.5 --vertical EGM96 --gcp GCP/gcp_list.txt",
        "--fast-orthophoto --skip-report --skip-3dmodel --preset high",
        "--end-with dataset",
        "--end-with opensfm --rerun-from dataset",  # of which the latter is not used before a first run
        "--end-with odm_georeferencing --vertical ellipsoidal",
        "--end-with openmvs --crop 3",
        "--end-with odm_orthophoto --3d-tiles",
        "--align GCP/align.laz --boundary {type:Polygon,coordinates:[[[7,46],[8,46],[8,47],[7,46]]]}",
    ],
)
def test_georef_takes_what_options_become(
    engine: ModuleType, georef: Georef, project: Path, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    # Fake stages have no cameras, and what compiles and estimates for real ones takes seconds to load.
    monkeypatch.setattr("georef_cli.commands.run.evaluated_cameras", lambda _: None)
    monkeypatch.setattr("georef_cli.commands.run.announced_estimate", lambda *_, **__: None)
    monkeypatch.setitem(sys.modules, "pipelines.train.compilation", truth.no_compilation())
    (project / "gcp/align.laz").write_bytes(b"LASF")
    asked = words.replace("GCP", str(project / "gcp")).split()
    given = engine.config([*asked, "--project-path", str(project.parent), project.name])
    done = georef(*engine.run_words(given, project))
    assert done.code == 0, done.err


def test_options_reach_the_stages(engine: ModuleType, project: Path) -> None:
    def words(*asked: str) -> list[str]:
        return list(engine.run_words(engine.config([*asked, "--project-path", "/data", UUID]), project))

    both = words("--orthophoto-resolution", "10", "--dem-resolution", "4", "--dtm")
    assert "--set=export-raster.gsd=0.04" in both and "--set=export-raster.terrain=true" in both
    assert not any("gsd" in word for word in words())
    assert "--preset=standard" in words() and "--preset=high" in words("--pc-quality", "ultra")
    assert "--preset=fast" in words("--fast-orthophoto") and "--preset=smoke" in words("--preset", "smoke")
    assert {"--sigma-h=2.5", "--sigma-v=2.5"} <= set(words("--gps-accuracy", "2.5"))
    assert "--tolerance-h=0.05" in words("--tolerance-h", "0.05") and not any(
        "tolerance" in word for word in words()
    )
    assert "--set=export-spz.crop=true" in words() and "--set=export-spz.crop=true" not in words("--crop", "0")
    assert "--vertical=EGM96; rm -r /" in words("--vertical", "EGM96; rm -r /")  # one word, which georef refuses
    assert "--force" not in words("--rerun-from", "opensfm")  # nothing was run here
    (project / "workspace").mkdir()
    assert {"--from=sfm", "--force"} <= set(words("--rerun-from", "opensfm"))


def test_what_is_asked_and_not_done_is_said(engine: ModuleType, project: Path) -> None:
    def said(*asked: str) -> str:
        return " ".join(engine.remarks(engine.config([*asked, "--project-path", "/data", UUID]), project))

    assert said("--dsm", "--orthophoto-resolution", "4") == said("--split-image-groups", "") == ""
    assert "cells of 2.5 cm" in said("--orthophoto-resolution", "4", "--dem-resolution", "2.5")
    assert "not moved onto it" in said("--align", "/data/align.laz")
    assert "split-image-groups" in said("--split-image-groups", "/data/image_groups.txt")
    assert "rerun-from openmvs is not used" in said("--rerun-from", "openmvs")


@pytest.mark.parametrize(
    "document",
    [
        {"type": "Polygon", "coordinates": SQUARE},
        {
            "type": "Feature",
            "properties": {"name": "a: b, {c}"},
            "geometry": {"type": "Polygon", "coordinates": SQUARE},
        },
        {
            "type": "FeatureCollection",
            "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}},
            "features": [{"type": "Feature", "geometry": {"type": "MultiPolygon", "coordinates": [SQUARE]}}],
        },
    ],
)
@pytest.mark.parametrize("version", ["2.2.3", "2.2.4"])
def test_boundary_survives_what_nodes_do_to_it(
    engine: ModuleType, tmp_path: Path, document: dict[str, Any], version: str
) -> None:
    text = json.dumps(document)
    if version == "2.2.4":  # which removes all quotation marks
        text = text.replace('"', "")
    written = read(engine.boundary_file(text, tmp_path))
    assert written["geometry"] == {"type": "MultiPolygon", "coordinates": [SQUARE]}
    assert ("crs" in written) is ("crs" in document)
    if "crs" in document:
        assert written["crs"] == document["crs"]


@pytest.mark.parametrize(
    "text",
    [
        '{"type": "LineString", "coordinates": [[7, 46], [8, 46]]}',
        '{"type": "Point", "coordinates": [7, 46]}',
        '{"crs": {"type": "link"}, "type": "Polygon", "coordinates": [[[7, 46], [8, 46], [8, 47], [7, 46]]]}',
        "{}",
    ],
)
def test_boundary_that_is_no_area_is_refused(engine: ModuleType, tmp_path: Path, text: str) -> None:
    with pytest.raises(engine.RefusedError, match="--boundary"):
        engine.boundary_file(text, tmp_path)


@pytest.mark.slow
def test_a_task_from_call_to_files(project: Path, node: socket.socket) -> None:
    gcp = ("--gcp", str(project / "gcp/gcp_list.txt"))
    code, console = run(project, "--dsm", "--3d-tiles", "--cog", "--preset", "smoke", *gcp)
    assert code == 0, console
    assert "[INFO]" in console and "train" in console
    heard = heard_by(node)
    percents = [percent for _, _, percent in heard]
    assert {(process, task) for process, task, _ in heard} == {(heard[0][0], UUID)} and heard[0][0].isdigit()
    assert percents == sorted(percents) and percents[0] == 0.0 and percents[-1] == 90.0
    assert sum(10.0 < percent < 80.0 for percent in percents) > 10  # it rises, and does not jump

    for file in ("odm_orthophoto/odm_orthophoto.tif", "odm_dem/dsm.tif", "georef/splat.ply", "georef/splat.spz"):
        assert (project / file).is_file(), file
    for file in ("odm_georeferencing/odm_georeferenced_model.laz", "odm_georeferencing/splat.spz"):
        assert (project / file).is_file(), file
    assert (project / "3d_tiles/model/tileset.json").is_file()
    assert not (project / "odm_dem/dtm.tif").exists()  # which nobody asked for
    log = read(project / "log.json")
    assert log["success"] and [stage["name"] for stage in log["stages"]][:4] == [
        "task",
        "ingest",
        "sfm",
        "calibrate",
    ]
    assert [image["filename"] for image in read(project / "images.json")] == list(truth.OMEGA_DEG)
    stats = read(project / "odm_report/stats.json")
    assert stats["point_cloud_statistics"]["stats"]["statistic"][0]["count"] == truth.POINTS
    assert stats["odm_processing_statistics"]["average_gsd"] == pytest.approx(100.0 * truth.GSD_M)
    assert stats["processing_statistics"]["start_date"] == "14/11/2023 at 22:13:20"
    lens = next(iter(read(project / "cameras.json").values()))
    assert (lens["focal_x"], lens["c_x"], lens["c_y"], lens["k1"]) == pytest.approx((0.8, 0.01, -0.005, -0.1))

    check_places(project)

    code, console = run(project, "--dtm", "--skip-report", "--skip-3dmodel", *gcp)  # as after a restart of the task
    assert code == 0, console
    assert (project / "odm_dem/dtm.tif").is_file()
    for gone in ("odm_dem/dsm.tif", "3d_tiles/model", "odm_texturing/odm_textured_model_geo.glb"):
        assert not (project / gone).exists(), gone


def check_places(project: Path) -> None:
    """Cameras and mesh are where they are by another library."""
    to_lla = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True)
    shots = {
        shot["properties"]["filename"]: shot for shot in read(project / "odm_report/shots.geojson")["features"]
    }
    expected = to_lla.transform(truth.EASTING, truth.NORTHING)
    assert shots["down.jpg"]["geometry"]["coordinates"] == pytest.approx([*expected, 1680.0], abs=1e-8)
    assert shots["north.jpg"]["properties"]["translation"] == [truth.EASTING + 10.0, truth.NORTHING, 1680.0]
    # WebODM turns its model of a camera by the negative vector: x right, y down, z forward, in east, north, up.
    axes = {
        name: Rotation.from_rotvec(-np.array(shot["properties"]["rotation"])).as_matrix()
        for name, shot in shots.items()
    }
    np.testing.assert_allclose(axes["down.jpg"], np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    np.testing.assert_allclose(axes["north.jpg"][:, 2], [0.0, 0.5, -np.sqrt(0.75)], atol=1e-12)
    east, north = map(int, (project / "odm_georeferencing/coords.txt").read_text().splitlines()[1].split())
    assert (east, north) == (int(truth.EASTING) + 5, int(truth.NORTHING))
    assert "+proj=utm +zone=32" in (project / "odm_georeferencing/proj.txt").read_text()

    placed = corners_in_crs((project / "odm_texturing/odm_textured_model_geo.glb").read_bytes())
    to_utm = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=cart +ellps=WGS84 +step +proj=utm +zone=32 +ellps=WGS84"
    )
    there = np.column_stack(to_utm.transform(*ecef_from_enu(truth.CORNERS, truth.ORIGIN).T))
    # The Earth curves away by 14 mm at the last corner, 424 m from the middle.
    np.testing.assert_allclose(placed, there, atol=0.015)
    np.testing.assert_allclose(placed[:3], there[:3], atol=0.001)


def corners_in_crs(data: bytes) -> np.ndarray[Any, Any]:
    """Return the vertices of a GLB as viewers place them: matrices of the nodes, and the middle of CESIUM_RTC."""
    magic, _, total = struct.unpack_from("<4sII", data)
    (length,) = struct.unpack_from("<I", data, 12)
    document = json.loads(data[20 : 20 + length])
    assert magic == b"glTF" and total == len(data) and length % 4 == 0
    points = np.frombuffer(data[28 + length :], "<f4").reshape(-1, 3)
    whole = np.eye(4)
    (index,) = document["scenes"][document["scene"]]["nodes"]
    while index is not None:
        node = document["nodes"][index]
        whole = whole @ np.array(node["matrix"]).reshape(4, 4).T
        index = node.get("children", [None])[0]
    return points @ whole[:3, :3].T + whole[:3, 3] + document["extensions"]["CESIUM_RTC"]["center"]


@pytest.mark.slow
def test_a_stopped_task_leaves_nothing_half_written_and_goes_on(project: Path, node: socket.socket) -> None:
    slow = project.parents[1] / "slow"
    slow.touch()
    process = start(project)
    training = 32.3  # percent: the sixth of fourteen stages has begun
    while float(node.recv(1000).decode().rpartition("/")[2]) < training:
        pass
    tree = psutil.Process(process.pid)
    for part in [*tree.children(recursive=True), tree]:  # as tree-kill does, all at once
        part.terminate()
    assert process.wait(PATIENCE_S) == 130
    slow.unlink()
    # What a stage has begun is kept for the next call, in a folder of its own.
    assert {path.name for path in project.rglob("*.partial")} <= {"train.partial"}
    assert not (project / "odm_orthophoto").exists()
    code, console = run(project)  # at once: it waits until georef has left the workspace
    assert code == 0, console
    assert "sfm: current" in console and (project / "odm_orthophoto/odm_orthophoto.tif").is_file()


def test_a_task_waits_for_the_stopped_one(engine: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    ends = iter([(1, "busy", {}), (1, "busy", {}), (0, "", {"stages": []})])
    monkeypatch.setattr(engine, "_run_once", lambda *_: next(ends))
    monkeypatch.setattr(time, "sleep", lambda _: None)
    assert engine.run_georef([], engine.Journal({}), engine.Progress(UUID)) == (0, {"stages": []})


def no_images(project: Path) -> None:
    for photo in (project / "images").iterdir():
        photo.unlink()
    (project / "images").rmdir()


def no_memory(project: Path) -> None:
    (project.parents[1] / "no-memory").touch()


@pytest.mark.parametrize(
    ("words", "prepare", "code"),
    [
        ((), no_images, 1),
        (("--vertical", "$(touch shell)`touch shell`; touch shell"), None, 2),
        (("--boundary", '{"type": "Point"}'), None, 1),
        (("--align", "/data/align.tif"), None, 1),
        ((), no_memory, 137),
    ],
)
def test_exit_codes(
    engine: ModuleType,
    project: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    prepare: Callable[[Path], None] | None,
    code: int,
) -> None:
    if prepare is not None:
        prepare(project)
    monkeypatch.setenv("GEOREF", str(project.parents[1] / "georef"))
    monkeypatch.setattr(sys, "argv", ["run.sh", *words, "--project-path", str(project.parent), project.name])
    assert engine.main() == code
    assert "[ERROR]" in capsys.readouterr().out
    assert not Path("shell").exists() and not (project / "odm_orthophoto").exists()
    assert read(project / "log.json")["error"]["code"] == code


@pytest.mark.parametrize(
    "words",
    [("--preset", "enormous"), ("--crop", "nan"), ("--crop", "-1"), ("--vertical", "--force"), ("--other",)],
)
def test_options_that_the_node_would_refuse(
    engine: ModuleType, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    with pytest.raises(SystemExit) as ended:
        engine.config([*words, "--project-path", "/data", UUID])
    assert ended.value.code == 2 and words[0] in capsys.readouterr().err


def test_what_is_not_installed(project: Path) -> None:
    code, console = run(project, GEOREF_PYTHON="no-such-python")
    assert code == 3 and "no-such-python" in console
    code, console = run(project, GEOREF=str(project / "no-georef"))
    assert code == 3 and "no-georef" in console


@pytest.mark.parametrize("name", ["..", "../data", "/", "-j", "a/b", ""])
def test_a_task_has_the_name_of_a_folder(engine: ModuleType, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        engine.config(["--project-path", "/data", "--", name])


def test_versions() -> None:
    assert (ENGINE / "VERSION").read_text(encoding="utf-8").strip() == __version__
    assert (ENGINE / "ENGINE").read_text(encoding="utf-8").strip() == "georef"
