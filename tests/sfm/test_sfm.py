"""Stage `sfm` on small synthetic photographs: complete, true to the scene, resumable, and picky about imports."""

from __future__ import annotations

import logging
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.products import Remark, load_json, save_json
from pipelines.core.progress import SILENT
from pipelines.core.stages import BY_NAME, SPARSE, SURVEY
from pipelines.core.staleness import status
from pipelines.core.workspace import StageRun, Workspace
from pipelines.formats.colmap import quiet_colmap, read_sparse
from pipelines.geometry.similarity import umeyama
from pipelines.sfm.colmap_reconstruction import reconstruct
from pipelines.sfm.features import SfmJob, candidate_pairs, extract_features
from pipelines.sfm.imported_model import import_model
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.stage import _summarise, run
from pipelines.sfm.unregistered import unregistered
from pipelines.survey.survey import Fix, Survey, SurveyedPoint
from tests.refusals import numbers, refused, said
from tests.sfm_scenes import CONFIG, HEIGHT, IMAGES, WIDTH, Photographs, survey_of

pycolmap = pytest.importorskip("pycolmap")
pytest.importorskip("embreex")


def test_model_is_the_scene_but_for_a_similarity(mapped: Workspace, photographs: Photographs) -> None:
    model = read_sparse(mapped.path(SPARSE))
    assert sorted(model.image_name) == photographs.names
    true = np.array([photographs.center_in_geo[name] for name in model.image_name])
    fitted = umeyama(model.cam_center_in_local, true)
    error = np.linalg.norm(fitted.apply(model.cam_center_in_local) - true, axis=1)
    # Some 400 points a photograph to 0.2 px at f = 204 px: 6 cm a point from 60 m, and weakly held heights.
    assert error.max() < 0.15


def test_summary_and_manifest_tell_how_complete_it_is(mapped: Workspace) -> None:
    manifest = mapped.manifest(BY_NAME["sfm"])
    assert manifest is not None
    assert manifest.values["registered"] == IMAGES
    assert manifest.values["not_registered"] == []
    assert manifest.values["reprojection_error_px"] < 1.0
    assert manifest.key_figure.startswith(f"{IMAGES} of {IMAGES} registered")
    assert manifest.warnings == ()


def test_colmap_opens_the_model_and_the_database(mapped: Workspace) -> None:
    assert pycolmap.Reconstruction(mapped.path(SPARSE)).num_reg_images() == IMAGES
    with closing(sqlite3.connect(mapped.path("sfm/database.db"))) as database:
        (count,) = database.execute("select count(*) from two_view_geometries where rows > 0").fetchone()
    assert count >= IMAGES - 1
    assert {path.name for path in (mapped.root / "sfm").iterdir()} == {"sparse", "database.db", "manifest.json"}


def test_continues_the_database_of_an_interrupted_run(
    mapped: Workspace, photographs: Photographs, tmp_path: Path, children_here: None
) -> None:
    out = tmp_path / "sfm.partial"
    out.mkdir()
    shutil.copy(mapped.path("sfm/database.db"), out / "database.db")
    # Killed while mapping: an old model and COLMAP's drafts lie about.
    (out / "sparse").mkdir()
    (out / "sparse" / "cameras.bin").write_bytes(b"half")
    (out / "pairs.txt").write_text("a b\n")
    (out / "mapping").mkdir()
    (out / "mapping" / "0").mkdir()
    with closing(sqlite3.connect(out / "database.db")) as database:
        database.execute("delete from two_view_geometries where pair_id in (select max(pair_id) from matches)")
        database.commit()
        before = database.execute("select image_id, length(data) from descriptors order by 1").fetchall()
    root = mapped.root
    summary = run(StageRun(Workspace(root), out, SILENT, resumed=True), CONFIG)
    assert summary.values["registered"] == IMAGES
    with closing(sqlite3.connect(out / "database.db")) as database:
        assert database.execute("select image_id, length(data) from descriptors order by 1").fetchall() == before
    assert read_sparse(out / "sparse").image_name == read_sparse(mapped.path(SPARSE)).image_name
    assert {path.name for path in out.iterdir()} == {"sparse", "database.db"}


def test_current_while_photographs_and_places_are_the_same(mapped: Workspace, tmp_path: Path) -> None:
    """Control points, the split and σ are none of its business; a photograph, a lens or a place is."""
    root = tmp_path / "flight"
    shutil.copytree(mapped.root, root, symlinks=True)
    workspace, survey = Workspace(root), load_json(Survey, mapped.path(SURVEY))
    fix = Fix(position_in_geo=(1, 2, 3), cov_in_geo=np.eye(3).tolist(), source="csv", sigma_source="file")

    def state_with(**update: object) -> str:
        save_json(survey.model_copy(update=update), root / SURVEY)
        return status(workspace)[1].state

    point = SurveyedPoint(name="P", position_in_geo=(0, 0, 0), cov_in_geo=np.eye(3).tolist(), marks=())
    remark = Remark(code="few-fixes", sentence="Few images have a fix.")
    first, *others = survey.images
    assert state_with() == state_with(control_points=(point,), warnings=(remark,)) == "current"
    assert state_with(images=(first.model_copy(update={"split": "test"}), *others)) == "current"
    assert state_with(images=(first.model_copy(update={"fix": fix}), *others)) == "stale"
    assert state_with(images=tuple(others)) == "stale"
    prior = survey.cameras[0].model_copy(update={"params": (210.0, 120.0, 90.0, 0.0)})
    assert state_with(cameras=(prior,)) == "stale"
    (root / SURVEY).write_text("{", encoding="utf-8")
    assert status(workspace)[1].state == "stale"


def test_import_takes_over_a_model(mapped: Workspace, tmp_path: Path, children_here: None) -> None:
    out = tmp_path / "sfm.partial"
    out.mkdir()
    summary = run(StageRun(mapped, out), SfmOptions(import_model=mapped.path(SPARSE)))
    given, taken = read_sparse(mapped.path(SPARSE)), read_sparse(out / "sparse")
    assert summary.values["registered"] == IMAGES
    np.testing.assert_array_equal(taken.point_in_local, given.point_in_local)
    np.testing.assert_array_equal(taken.rotation_cam_from_local, given.rotation_cam_from_local)


def test_import_leaves_out_what_is_not_in_the_survey(mapped: Workspace, caplog: pytest.LogCaptureFixture) -> None:
    survey = load_json(Survey, mapped.path(SURVEY))
    fewer = survey.model_copy(update={"images": survey.images[:6]})
    with quiet_colmap(), caplog.at_level(logging.WARNING):
        model = import_model(mapped.path(SPARSE), fewer)
    assert model.num_reg_images() == 6
    assert "4 images of the imported model are not in the survey" in caplog.text


def test_import_of_a_foreign_model_is_refused(mapped: Workspace) -> None:
    survey = survey_of([f"other_{index}.jpg" for index in range(5)])
    with quiet_colmap(), refused("too-few-images-in-survey", InputError) as error:
        import_model(mapped.path(SPARSE), survey)
    assert numbers(error.value.message)[0] == 0


def test_import_of_something_else_is_refused(tmp_path: Path, mapped: Workspace) -> None:
    (tmp_path / "notes.txt").write_text("no model here")
    with quiet_colmap(), pytest.raises(InputError) as error:
        import_model(tmp_path, survey_of(["a.jpg"]))
    assert error.value.path == tmp_path


def test_import_of_a_truncated_model_is_refused(tmp_path: Path, mapped: Workspace) -> None:
    # COLMAP would read on past the end for ever.
    broken = tmp_path / "model"
    shutil.copytree(mapped.path(SPARSE), broken)
    points = broken / "points3D.bin"
    points.write_bytes(points.read_bytes()[:200])
    with quiet_colmap(), refused("file-cut-off", InputError):
        import_model(broken, survey_of(["a.jpg"]))


def test_file_names_with_blanks(photographs: Photographs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """COLMAP's lists of pairs cannot hold them; the pairs asked for are matched all the same, and no others."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in photographs.names[:5]:
        shutil.copy(photographs.folder / name, photos / f"# flight 1 {name}")
    survey = survey_of(sorted(path.name for path in photos.iterdir()))
    asked = np.array([(0, 1), (1, 2), (2, 3), (3, 4), (0, 2), (1, 3), (2, 4)])
    monkeypatch.setattr("pipelines.sfm.colmap_reconstruction.candidate_pairs", lambda *_: asked)
    job = SfmJob(survey, photos, tmp_path / "database.db", CONFIG)
    with quiet_colmap() as colmap:
        model, _ = reconstruct(colmap, job, SILENT)
    names = {image.name for image in survey.images}
    assert {image.name for image in model.images.values()} <= names
    assert model.num_reg_images() >= 3
    with pycolmap.Database.open(job.database) as database:
        assert {image.name for image in database.read_all_images()} == names
        assert database.num_matched_image_pairs() == len(asked)


def test_run_that_was_killed_while_matching_is_continued(mapped: Workspace, tmp_path: Path) -> None:
    """Photographs then go by numbers, for COLMAP's lists of pairs."""
    shutil.copy(mapped.path("sfm/database.db"), tmp_path / "database.db")
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        for number, image in enumerate(sorted(database.read_all_images(), key=lambda image: image.name)):
            image.name = f"{number:06d}"
            database.update_image(image)
    survey = load_json(Survey, mapped.path(SURVEY))
    with quiet_colmap() as colmap:
        job = SfmJob(survey, mapped.root / "photos", tmp_path / "database.db", CONFIG)
        model, _ = reconstruct(colmap, job, SILENT)
    assert {image.name for image in model.images.values()} == {image.name for image in survey.images}
    with pycolmap.Database.open(job.database) as database:
        assert database.num_images() == IMAGES


def test_missing_photographs_are_named(mapped: Workspace, tmp_path: Path) -> None:
    survey = survey_of(["gone.jpg", *[image.name for image in load_json(Survey, mapped.path(SURVEY)).images]])
    job = SfmJob(survey, mapped.root / "photos", tmp_path / "database.db", CONFIG)
    with (
        quiet_colmap() as colmap,
        refused("photograph-missing", InputError) as error,
    ):
        reconstruct(colmap, job, SILENT)
    assert error.value.path == job.images / "gone.jpg" and numbers(error.value.message) == [1]


def test_photographs_that_were_replaced_after_ingest_are_refused(photographs: Photographs, tmp_path: Path) -> None:
    survey = survey_of(photographs.names)
    others = tuple(image.model_copy(update={"sha256": "0" * 64}) for image in survey.images)
    job = SfmJob(survey.model_copy(update={"images": others}), photographs.folder, tmp_path / "database.db", CONFIG)
    with (
        quiet_colmap() as colmap,
        refused("photograph-changed", InputError) as error,
    ):
        reconstruct(colmap, job, SILENT)
    assert error.value.path == photographs.folder / photographs.names[0]


def test_photographs_without_overlap_are_refused(tmp_path: Path) -> None:
    photos, rng = tmp_path / "photos", np.random.default_rng(0)
    photos.mkdir()
    for index in range(3):
        noise = rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        cv2.imwrite(str(photos / f"{index}.png"), noise)
    job = SfmJob(survey_of(["0.png", "1.png", "2.png"]), photos, tmp_path / "database.db", CONFIG)
    with quiet_colmap() as colmap, refused("no-matches", DegenerateGeometryError):
        reconstruct(colmap, job, SILENT)


def test_few_registered_is_a_loud_warning_and_two_an_error(mapped: Workspace, photographs: Photographs) -> None:
    model = pycolmap.Reconstruction(mapped.path(SPARSE))
    more = [*photographs.names, *(f"lost_{index}.png" for index in range(3))]
    summary = _summarise(model, survey_of(more))
    assert summary.values["not_registered"] == ["lost_0.png", "lost_1.png", "lost_2.png"]
    assert numbers(said(summary.warnings, "few-photographs-registered"))[:2] == [10, 13]
    assert _summarise(model, survey_of(more[:12])).warnings == ()  # 10 of 12: above 80 %
    short = pycolmap.Reconstruction(model)
    for image in list(short.images.values())[2:]:
        short.deregister_frame(image.frame_id)
    with refused("too-few-registered", DegenerateGeometryError) as error:
        _summarise(short, survey_of(photographs.names))
    assert numbers(str(error.value)) == [2, 10]


def test_each_photograph_that_is_not_registered_has_a_reason(mapped: Workspace, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(mapped.path(SPARSE))
    assert unregistered(pycolmap, mapped.path("sfm/database.db"), model) == ()
    image = min(model.images.values(), key=lambda each: each.name)
    name, image_id = image.name, image.image_id
    model.deregister_frame(image.frame_id)
    sentence = said(unregistered(pycolmap, mapped.path("sfm/database.db"), model), "photographs-not-registered")
    assert name in sentence and "which do not agree" in sentence
    # Its points are still those of the others: it was registered by more than COLMAP needs.
    assert numbers(sentence.partition(": ")[2])[0] > 30
    database = tmp_path / "database.db"
    shutil.copy(mapped.path("sfm/database.db"), database)
    with closing(sqlite3.connect(database)) as opened:
        opened.execute("delete from two_view_geometries where pair_id / 2147483647 = ?", (image_id,))
        opened.execute("delete from two_view_geometries where pair_id % 2147483647 = ?", (image_id,))
        opened.commit()
    assert "no verified matches" in said(unregistered(pycolmap, database, model), "photographs-not-registered")


def test_global_mapper(mapped: Workspace, tmp_path: Path) -> None:
    shutil.copy(mapped.path("sfm/database.db"), tmp_path / "database.db")
    survey = load_json(Survey, mapped.path(SURVEY))
    config = CONFIG.model_copy(update={"mapper": "global"})
    with quiet_colmap() as colmap:
        job = SfmJob(survey, mapped.root / "photos", tmp_path / "database.db", config)
        model, _ = reconstruct(colmap, job, SILENT)
    assert model.num_reg_images() == IMAGES


def test_pairs_of_a_small_or_unlocated_survey_are_all() -> None:
    survey = survey_of([f"{index}.jpg" for index in range(30)])
    assert len(candidate_pairs(survey, CONFIG)) == 435
    assert len(candidate_pairs(survey.model_copy(update={"images": survey.images[:5]}), CONFIG)) == 10


def test_features_of_large_photographs_are_looked_for_at_their_own_size(
    photographs: Photographs, tmp_path: Path
) -> None:
    assert not SfmOptions().doubles((5472, 3648))
    assert SfmOptions().doubles((640, 480)) and SfmOptions(max_image_size=900).doubles((5472, 3648))
    found = {}
    for doubled in ("yes", "no"):
        survey = survey_of(photographs.names[:1])
        options = SfmOptions(doubled=doubled, threads=1)  # type: ignore[arg-type]
        job = SfmJob(survey, photographs.folder, tmp_path / f"{doubled}.db", options)
        extract_features(pycolmap, job, [0], SILENT)
        with closing(sqlite3.connect(job.database)) as database:
            rows, columns, data = database.execute("select rows, cols, data from keypoints").fetchone()
        points = np.frombuffer(data, np.float32).reshape(rows, columns)
        found[doubled] = np.hypot(points[:, 2], points[:, 4])  # x, y, and the affine shape, row by row
    # The smallest scales, of one to two pixels, are those that a doubled photograph adds: most of all features.
    assert found["yes"].min() < 1.6 < found["no"].min()
    assert len(found["no"]) < 0.6 * len(found["yes"])
