"""Products that are missing, damaged or of something else, as a user of the later stages meets them."""

from __future__ import annotations

import os
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.core.products import load_json, save_json, save_npz
from pipelines.core.stages import ADJUSTMENT, BY_NAME, GAUSSIANS, MODEL, POINTS, REPORT, SPARSE, SURVEY
from pipelines.geometry.similarity import Similarity
from pipelines.survey.solution import GeolocatedPoints
from pipelines.survey.survey import Survey
from tests.cli_runs import Georef, products_in, write_files
from tests.photos import jpeg
from tests.refusals import numbers
from tests.scenes import Measured, Noise, make_scene, sparse_model, survey_of, trained_model, write_workspace

pytestmark = pytest.mark.usefixtures("children_here")


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """A workspace with a survey and an SfM model, as put there by hand."""
    rng = np.random.default_rng(4)
    scene = make_scene()
    survey = survey_of(scene, Noise(), Measured(), rng)
    return write_workspace(tmp_path / "ws", survey, sparse_model(scene, Noise(), rng)).root


@pytest.mark.parametrize(
    ("stage", "gone", "product", "maker"),
    [
        ("sfm", "ingest", SURVEY, "ingest"),
        ("geolocate", "sfm", SPARSE, "sfm"),
        ("init-sim3", "geolocate", POINTS, "geolocate"),
        ("train", "sim3", ADJUSTMENT, "init-sim3"),
        ("evaluate", "sim3", ADJUSTMENT, "init-sim3"),
        ("export-ply", "train", MODEL, "train"),
    ],
)
def test_upstream_missing(real_georef: Georef, made: Path, stage: str, gone: str, product: str, maker: str) -> None:
    shutil.rmtree(made / gone, ignore_errors=True)
    result = real_georef(stage, made)
    result.assert_failed(1, "missing-product")
    last = result.err.splitlines()[-1]
    assert last.startswith(f"error: {product} ") and f"`georef {maker} {made}`" in last


DAMAGED = (
    ("geolocate", SURVEY, b"{", None, "product-invalid"),
    ("geolocate", SURVEY, b"\xff", None, "not-utf8"),
    ("geolocate", SURVEY, b"{}", "origin", "product-invalid"),
    ("geolocate", f"{SPARSE}/images.bin", b"\xff" * 40, None, "file-cut-off"),
    ("geolocate", f"{SPARSE}/cameras.bin", b"", None, "file-cut-off"),
    ("init-sim3", POINTS, b"PK\x03\x04", None, "npz-damaged"),
    ("train", ADJUSTMENT, b"[]", None, "product-invalid"),
    ("evaluate", MODEL, b'{"format_version": 1}', "geo_from_model", "product-invalid"),
    ("export-ply", MODEL, b"nonsense", None, "product-invalid"),
)


@pytest.mark.parametrize("case", DAMAGED, ids=lambda case: f"{case[0]}-{case[1]}-{case[2][:4]!r}")
def test_damaged_product(real_georef: Georef, made: Path, case: tuple[str, str, bytes, str | None, str]) -> None:
    stage, product, data, field, code = case
    needed = [part.product for part in BY_NAME[stage].reads if not part.optional]
    absent = [read for read in needed if not (made / read).exists()]
    write_files(made, dict.fromkeys(absent, b"") | {product: data})
    result = real_georef(stage, made)
    result.assert_failed(1, code)
    assert result.error is not None
    assert (result.error["path"], result.error["field"]) == (str(made / product), field)
    assert "Traceback" not in result.err


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"ply\n", "not-a-ply"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n",
            "ply-format",
        ),
        (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 9999999999\nproperty float x\nend_header\n",
            "size-differs",
        ),
    ],
    ids=["no PLY", "text", "forged"],
)
def test_damaged_gaussians(real_georef: Georef, made: Path, data: bytes, code: str) -> None:
    save_json(trained_model(Similarity()), made / MODEL)
    write_files(made, {GAUSSIANS: data})
    result = real_georef("export-ply", made)
    result.assert_failed(1, code)
    assert not (made / "export").exists()


@pytest.mark.parametrize("content", [b"nonsense", b"[]", b'{"photometric": {}}'])
def test_report_that_was_replaced(real_georef: Georef, made: Path, content: bytes) -> None:
    """Put there by hand, it is kept; but it cannot be shown."""
    products = [part.product for part in BY_NAME["evaluate"].reads if not part.optional]
    absent = [product for product in products if not (made / product).exists()]
    write_files(made, dict.fromkeys(absent, b"") | {REPORT: content})
    result = real_georef("evaluate", made)
    result.assert_failed(1, "report-invalid")
    assert result.error is not None and result.error["path"] == str(made / REPORT)
    assert "`georef evaluate --force`" in result.error["remedy"]
    assert (made / REPORT).read_bytes() == content


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_cuda_without_gpu(real_georef: Georef, made: Path) -> None:
    """Asked for in so many words, the GPU is not replaced by something slower."""
    survey = load_json(Survey, made / SURVEY)
    save_json(survey.model_copy(update={"image_dir": str(made.parent)}), made / SURVEY)
    size = (survey.cameras[0].width, survey.cameras[0].height)
    write_files(made.parent, {image.name: jpeg(index, size) for index, image in enumerate(survey.images)})
    assert real_georef("run", made, "--to", "init-sim3").code == 0
    result = real_georef("train", made, "--backend", "cuda", "--preset", "smoke")
    result.assert_failed(1)
    assert "error: The cuda backend cannot be used: no " in result.err.splitlines()[-1]
    assert "Install NVIDIA's driver" in result.err.splitlines()[-1]
    assert not (made / "train").exists()


def test_points_of_another_model(real_georef: Georef, made: Path) -> None:
    assert real_georef("geolocate", made).code == 0
    points = GeolocatedPoints.load(made / POINTS)
    fewer = {name: value if isinstance(value, str) else value[:-1] for name, value in vars(points).items()}
    save_npz(made / POINTS, vars(GeolocatedPoints(**fewer)))
    (made / "geolocate/manifest.json").unlink()  # put there by hand
    result = real_georef("init-sim3", made)
    result.assert_failed(1)
    assert "`georef geolocate" in result.err.splitlines()[-1]


@pytest.mark.parametrize(
    ("files", "code"),
    [
        ({"notes.txt": b"hello"}, "not-a-colmap-model"),
        (dict.fromkeys(("cameras.bin", "images.bin", "points3D.bin"), b"\xff" * 64), "file-cut-off"),
        ({"cameras.txt": b"1 PINHOLE x\n", "images.txt": b"", "points3D.txt": b""}, "model-unreadable"),
    ],
    ids=["no model", "forged", "text without numbers"],
)
def test_import_of_something_else(real_georef: Georef, made: Path, files: dict[str, bytes], code: str) -> None:
    write_files(made.parent / "model", files)
    before = products_in(made)
    result = real_georef("sfm", made, "--import", made.parent / "model", "--force")
    result.assert_failed(1, code)
    assert str(made.parent / "model") in result.err.splitlines()[-1]
    kept = {name: data for name, data in products_in(made).items() if not name.startswith("sfm.partial/")}
    assert {name: data for name, data in kept.items() if name != "requests.json"} == before


def test_import_of_a_project_and_of_a_forged_track(real_georef: Georef, made: Path) -> None:
    """The model lies in `sparse/0`. COLMAP would read a track of 2³⁶ images for ever."""
    project = made.parent / "project"
    model = project / "sparse/0"
    shutil.copytree(made / SPARSE, model)
    assert real_georef("sfm", made, "--import", project, "--force").code == 0
    points = bytearray((model / "points3D.bin").read_bytes())
    struct.pack_into("<Q", points, 8 + 43, 2**36)
    (model / "points3D.bin").write_bytes(points)
    result = real_georef("sfm", made, "--import", project, "--force")
    result.assert_failed(1)
    assert "points3D.bin: The file is shorter than its number of records" in result.err.splitlines()[-1]


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes in folders")
@pytest.mark.parametrize(
    ("stage", "product"), [("geolocate", SURVEY), ("geolocate", f"{SPARSE}/images.bin"), ("init-sim3", POINTS)]
)
def test_pipe_in_place_of_a_product(real_georef: Georef, made: Path, stage: str, product: str) -> None:
    (made / product).parent.mkdir(exist_ok=True)
    (made / product).unlink(missing_ok=True)
    os.mkfifo(made / product)
    result = real_georef(stage, made)
    result.assert_failed(1, "not-a-file")
    assert result.error is not None and result.error["path"] == str(made / product)


def test_import_of_another_flight(real_georef: Georef, made: Path) -> None:
    survey = load_json(Survey, made / SURVEY)
    others = [image.model_copy(update={"name": f"frame_{n}.jpg"}) for n, image in enumerate(survey.images, 5000)]
    save_json(survey.model_copy(update={"images": tuple(others)}), made / SURVEY)
    shutil.copytree(made / SPARSE, made.parent / "model")
    result = real_georef("sfm", made, "--import", made.parent / "model", "--force")
    result.assert_failed(1)
    assert result.error is not None and result.error["path"] == str(made.parent / "model")
    assert numbers(result.error["message"])[0] == 0  # images


def test_residual_larger_than_allowed(real_georef: Georef, made: Path) -> None:
    assert real_georef("geolocate", made).code == 0
    assert real_georef("init-sim3", made).code == 0
    before = (made / ADJUSTMENT).read_bytes()
    result = real_georef("init-sim3", made, "--max-residual", "0.000001")
    result.assert_failed(1)
    assert "--max-residual" in result.err.splitlines()[-1]
    assert (made / ADJUSTMENT).read_bytes() == before


def test_photographs_that_are_gone(real_georef: Georef, made: Path) -> None:
    result = real_georef("sfm", made, "--force")
    result.assert_failed(1)
    assert "photographs" in result.err.splitlines()[-1]
    assert real_georef("geolocate", made).code == 0  # the model that was there is kept
