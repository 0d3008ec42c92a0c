"""Rounds of an alignment: lenses that cannot be, models apart placed by positions, added features."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.progress import SILENT
from pipelines.core.types import Vector3
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import umeyama
from pipelines.sfm import colmap_reconstruction, rounds
from pipelines.sfm.colmap_database import add_features, has_added_features, verified_matches, write_frame
from pipelines.sfm.features import SfmJob, verify_matches
from pipelines.sfm.lens_check import lenses_astray
from pipelines.sfm.mapping import map_database
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.parts import join_parts
from pipelines.sfm.unregistered import unregistered
from pipelines.survey.survey import Attitude, Fix, Survey
from tests.refusals import logged_codes, numbers, said
from tests.sfm_scenes import survey_of

pytestmark = pytest.mark.usefixtures("one_thread")

pycolmap = pytest.importorskip("pycolmap")

IMAGES = 16
METRES = 20.0  # a unit of the true model
SIGMA_M = 0.5
SIZE = (1024, 768)


def true_model(images: int = IMAGES, *, on_a_line: bool = False) -> Any:
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, images, 150
    options.num_points2D_without_point3D = 0
    model = pycolmap.synthesize_dataset(options)
    if on_a_line:
        for number, image_id in enumerate(sorted(model.reg_image_ids())):
            frame = model.frames[model.images[image_id].frame_id]
            rotation = frame.rig_from_world.rotation
            place = np.array([0.5 * number, 0.0, 8.0])
            frame.rig_from_world = pycolmap.Rigid3d(rotation, -rotation.matrix() @ place)
    return model


def surveyed(model: Any, *, attitudes: bool = True, sigma_m: float = SIGMA_M, seed: int = 0) -> Survey:
    """The survey of a model in which metres are `METRES` and the axes are those of geo."""
    rng = np.random.default_rng(seed)
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    survey = survey_of([image.name for image in images])
    camera = next(iter(model.cameras.values()))
    prior = survey.cameras[0].model_copy(
        update={
            "width": camera.width,
            "height": camera.height,
            "params": tuple(camera.params),
            "model": camera.model_name,
        }
    )
    rows = []
    for row, image in zip(survey.images, images, strict=True):
        position = METRES * image.projection_center() + rng.normal(0, sigma_m, 3)
        geo_from_cam = image.cam_from_world().rotation.matrix().T
        covariance = tuple(tuple(line) for line in (sigma_m**2 * np.eye(3)).tolist())
        fix = Fix(position_in_geo=vector(position), cov_in_geo=covariance, source="csv", sigma_source="file")
        attitude = Attitude(
            quat_xyzw=tuple(quat_xyzw_from_matrix(geo_from_cam).tolist()), sigma_deg=3.0, source="csv"
        )
        rows.append(row.model_copy(update={"fix": fix, "attitude": attitude if attitudes else None}))
    return survey.model_copy(update={"images": tuple(rows), "cameras": (prior,)})


def vector(values: Any) -> Vector3:
    x, y, z = map(float, values)
    return x, y, z


def own_frame(seed: int) -> Any:
    """The frame of a model, from that of the truth."""
    rng = np.random.default_rng(seed)
    quaternion = rng.normal(size=4)
    rotation = pycolmap.Rotation3d(quaternion / np.linalg.norm(quaternion))
    return pycolmap.Sim3d(rng.uniform(0.2, 5.0), rotation, rng.normal(size=3))


def part_of(model: Any, images: list[int], seed: int) -> Any:
    """Some photographs of a model with their points, in a frame of its own."""
    part = type(model)(model)
    for image_id in set(part.reg_image_ids()) - set(images):
        part.deregister_frame(part.images[image_id].frame_id)
    part.transform(own_frame(seed))
    return part


@pytest.mark.parametrize("on_a_line", [False, True])
def test_models_apart_are_placed_by_positions(on_a_line: bool) -> None:
    """Positions of σ 0.5 m, and attitudes where these lie on one line, place each model to a few σ / √N."""
    truth = true_model(on_a_line=on_a_line)
    survey, ids = surveyed(truth), sorted(truth.reg_image_ids())
    models = [part_of(truth, ids[:9], 1), part_of(truth, ids[8:], 2)]  # one photograph is in both, as of COLMAP
    points = [model.num_points3D() for model in models]
    whole, parts = join_parts(pycolmap, models, survey)
    assert [(part.photographs, part.apart) for part in parts] == [(7, "")]
    assert sorted(whole.reg_image_ids()) == ids
    # Points of the shared photograph stay with the first model: its observations count once.
    assert points[0] < whole.num_points3D() <= sum(points)
    assert whole.is_valid()
    frame = own_frame(1)
    solved = np.array([whole.images[key].projection_center() for key in ids])
    true = np.array([frame * truth.images[key].projection_center() for key in ids])
    error_m = (solved - true) / frame.scale * METRES
    # The models are some 100 m wide; σ of a turn is about σ / (√N · 30 m), at an arm of up to 100 m, of both.
    assert np.abs(error_m).max() < 4 * SIGMA_M


def test_a_second_model_of_the_same_photographs_is_no_part() -> None:
    """The mapper may begin a second model of photographs that the first one has, too."""
    truth = true_model()
    ids = sorted(truth.reg_image_ids())
    whole, parts = join_parts(pycolmap, [part_of(truth, ids, 1), part_of(truth, ids[3:8], 2)], surveyed(truth))
    assert (whole.num_reg_images(), parts) == (IMAGES, ())


def test_a_model_that_positions_do_not_place_stays_apart() -> None:
    truth = true_model(on_a_line=True)
    ids = sorted(truth.reg_image_ids())
    models = [part_of(truth, ids[:9], 1), part_of(truth, ids[9:], 2)]
    whole, parts = join_parts(pycolmap, models, surveyed(truth, attitudes=False))
    assert whole.num_reg_images() == 9
    assert [part.photographs for part in parts] == [7]
    assert parts[0].apart


def test_a_model_beside_its_positions_stays_apart() -> None:
    """Positions that belong to other photographs fit worse than their σ: nothing is placed by them."""
    truth = true_model()
    ids = sorted(truth.reg_image_ids())
    survey = surveyed(truth)
    moved = [image.fix for image in survey.images[9:]]
    swapped = [
        row.model_copy(update={"fix": fix})
        for row, fix in zip(survey.images[9:], moved[3:] + moved[:3], strict=True)
    ]
    wrong = survey.model_copy(update={"images": (*survey.images[:9], *swapped)})
    _, parts = join_parts(pycolmap, [part_of(truth, ids[:9], 1), part_of(truth, ids[9:], 2)], wrong)
    assert parts[0].apart


@pytest.mark.parametrize(
    ("change", "astray"),
    [
        ({}, False),
        ({"f": 1.08}, False),  # as rounded as a focal length in millimetres is
        ({"f": 1.3}, True),
        ({"f": 0.7}, True),
        ({"k1": 0.1, "k2": -0.05}, False),
        ({"k1": 1.15, "k2": -6.6}, True),  # rays turn back before the rim
    ],
)
def test_lenses_that_cannot_be(change: dict[str, float], astray: bool) -> None:
    truth = true_model()
    survey = surveyed(truth)
    prior = survey.cameras[0].model_copy(update={"params": (900.0, 512.0, 384.0, 0.0), "focal_source": "exif"})
    survey = survey.model_copy(update={"cameras": (prior,)})
    camera = next(iter(truth.cameras.values()))
    f = 900.0 * change.get("f", 1.0)
    camera.model = pycolmap.CameraModelId.OPENCV
    camera.params = [f, f, 512.0, 384.0, change.get("k1", 0.0), change.get("k2", 0.0), 0.0, 0.0]
    assert bool(lenses_astray(truth, survey)) == astray
    assumed = survey.model_copy(update={"cameras": (prior.model_copy(update={"focal_source": "assumed"}),)})
    assert bool(lenses_astray(truth, assumed)) == ("k2" in change and astray)


def matched(tmp_path: Path, truth: Any) -> SfmJob:
    """A database with features without descriptors, matched by truth, beside one of SIFT's that matches nothing."""
    survey = surveyed(truth)
    job = SfmJob(survey, tmp_path, tmp_path / "database.db", SfmOptions(camera_model="SIMPLE_RADIAL", threads=1))
    with pycolmap.Database.open(job.database):
        pass
    images = [truth.images[key] for key in sorted(truth.reg_image_ids())]
    write_frame(pycolmap, job.database, survey, range(len(images)), job.options)
    row_of: list[dict[int, int]] = []
    places = {}
    nothing = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, np.zeros((1, 128), np.uint8))
    for index, image in enumerate(images):
        seen = [point for point in image.points2D if point.has_point3D()]
        row_of.append({point.point3D_id: row for row, point in enumerate(seen)})
        places[index] = np.array([point.xy for point in seen])
        with pycolmap.Database.open(job.database) as database:
            database.write_keypoints(index + 1, np.array([[5.0, 5.0, 1.0, 0.0, 0.0, 1.0]], np.float32))
            database.write_descriptors(index + 1, nothing)
    assert not has_added_features(pycolmap, job.database)
    matches = {}
    for a in range(len(images)):
        for b in range(a + 1, len(images)):
            common = sorted(set(row_of[a]) & set(row_of[b]))
            matches[a, b] = np.array([(row_of[a][point], row_of[b][point]) for point in common])
    add_features(pycolmap, job.database, places, matches)
    assert has_added_features(pycolmap, job.database)
    verify_matches(pycolmap, job, np.array(sorted(matches)), SILENT)
    found = verified_matches(pycolmap, job.database)
    assert all(found[pair] == len(rows) for pair, rows in matches.items())
    return job


def test_added_features_make_a_model(tmp_path: Path) -> None:
    """Features without descriptors are verified and mapped like SIFT's."""
    truth = true_model(8)
    job = matched(tmp_path, truth)
    models, _ = map_database(pycolmap, job, SILENT, lens_held=True)
    solved = np.array([models[0].images[key].projection_center() for key in sorted(models[0].reg_image_ids())])
    true = np.array([truth.images[key].projection_center() for key in sorted(truth.reg_image_ids())])
    # Without noise: the error is that of keypoints in float32.
    assert np.abs(umeyama(solved, true).apply(solved) - true).max() < 1e-3
    kept = next(iter(models[0].cameras.values()))
    assert list(kept.params) == pytest.approx(list(job.survey.cameras[0].params))


def test_features_that_connect_two_groups_become_points_within_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two groups have features of their own, and others in common that learned matches alone connect.

    A photograph of the second group joins the model of the first if their common features are points of it, so if
    these are matched within the first group, too.
    """
    truth = true_model(12)
    ids = sorted(truth.reg_image_ids())
    survey = surveyed(truth)
    survey = survey.model_copy(
        update={"images": tuple(one.model_copy(update={"fix": None}) for one in survey.images)}
    )
    job = SfmJob(survey, tmp_path, tmp_path / "database.db", SfmOptions(camera_model="SIMPLE_RADIAL", threads=1))
    with pycolmap.Database.open(job.database):
        pass
    write_frame(pycolmap, job.database, survey, range(len(ids)), job.options)
    place = [{one.point3D_id: one.xy for one in truth.images[key].points2D if one.has_point3D()} for key in ids]
    everywhere = sorted(set.intersection(*(set(each) for each in place)))
    own, common = everywhere[:-40], everywhere[-40:]
    assert len(own) >= rounds._ENOUGH_MATCHES
    rows = np.arange(len(own))[:, None].repeat(2, axis=1)
    group = [range(6), range(6, 12)]
    within = [(a, b) for each in group for a in each for b in each if a < b]
    with pycolmap.Database.open(job.database) as database:
        for index, each in enumerate(place):
            at = np.array([[*each[point], 1.0, 0.0, 0.0, 1.0] for point in own], np.float32)
            database.write_keypoints(index + 1, at)
            nothing = np.zeros((len(own), 128), np.uint8)
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(index + 1, pycolmap.FeatureDescriptors(kind, nothing))
        for a, b in within:
            database.write_matches(a + 1, b + 1, rows.astype(np.uint32))
    verify_matches(pycolmap, job, np.array(within), SILENT)

    def add_learned(colmap: Any, job: SfmJob, pairs: np.ndarray, progress: Any) -> int:
        asked = [(a, b) for a, b in pairs.tolist()]
        places = {i: np.array([place[i][point] for point in common]) for i in {i for pair in asked for i in pair}}
        same = np.arange(len(common))[:, None].repeat(2, axis=1)
        add_features(colmap, job.database, places, dict.fromkeys(asked, same))
        verify_matches(colmap, job, pairs, progress)
        return len(asked)

    monkeypatch.setattr(rounds, "missing_for_learned", lambda: None)
    monkeypatch.setattr("pipelines.sfm.learned_features.add_learned", add_learned)
    assert map_database(pycolmap, job, SILENT)[0][0].num_reg_images() == len(group[0])
    model = rounds.map_in_rounds(pycolmap, job, SILENT).models[0]
    assert sorted(model.reg_image_ids()) == ids
    solved = np.array([model.images[key].projection_center() for key in ids])
    true = np.array([truth.images[key].projection_center() for key in ids])
    # Without noise: the error is that of keypoints in float32, and of a lens that is solved.
    assert np.abs(umeyama(solved, true).apply(solved) - true).max() < 1e-2


def test_what_is_joined_is_told_with_the_size_of_each_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    truth = true_model()
    ids = sorted(truth.reg_image_ids())
    job = matched(tmp_path, true_model(8))
    job = replace(job, survey=surveyed(truth))
    models = [part_of(truth, ids[:9], 1), part_of(truth, ids[9:], 2)]
    monkeypatch.setattr(rounds, "map_database", lambda *_, **__: (models, "incremental"))
    monkeypatch.setattr(rounds, "missing_for_learned", lambda: "an extra")
    assert rounds.map_in_rounds(pycolmap, job, SILENT).registered == IMAGES
    (told,) = [record for record in caplog.records if getattr(record, "code", "") == "survey-in-parts"]
    assert numbers(told.getMessage()) == [2, 9, IMAGES - 9]


def test_a_model_of_fewer_features_than_its_database_has_reasons(tmp_path: Path) -> None:
    """Where a later round adds features and is no better, the model of the earlier one is kept."""
    truth = true_model(8)
    ids = sorted(truth.reg_image_ids())
    job = matched(tmp_path, truth)
    models, _ = map_database(pycolmap, job, SILENT, lens_held=True)
    short = type(models[0])()
    for camera in models[0].cameras.values():
        short.add_camera(camera)
        short.add_rig(next(iter(models[0].rigs.values())))
    for image_id in ids[:-1]:
        image = models[0].images[image_id]
        frame = pycolmap.Frame(frame_id=image.frame_id, rig_id=1)
        frame.add_data_id(image.data_id)
        frame.rig_from_world = image.cam_from_world()
        short.add_frame(frame)
        few = np.array([point.xy for point in image.points2D])[:5]
        kept = pycolmap.Image(image.name, keypoints=few, camera_id=image.camera_id, image_id=image_id)
        kept.frame_id = image.frame_id
        short.add_image(kept)
        short.register_frame(image.frame_id)
    sentence = said(unregistered(pycolmap, job.database, short), "photographs-not-registered")
    assert truth.images[ids[-1]].name in sentence and "of which 0 are points of the model" in sentence


def test_a_lens_that_is_refused_stays_as_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A last adjustment that finds a lens that cannot be is taken back, with the points that fitted it."""
    job = matched(tmp_path, true_model(8))
    for module in (rounds, colmap_reconstruction):
        monkeypatch.setattr(module, "lenses_astray", lambda model, survey: {1: "another focal length"})
    # A rolling shutter is corrected by further adjustments.
    monkeypatch.setattr(
        colmap_reconstruction, "correct_tie_points", lambda model, survey, adjust: (adjust(model) or model, None)
    )
    monkeypatch.setattr(
        colmap_reconstruction,
        "reconstruct",
        lambda colmap, job, _: colmap_reconstruction.map_matches(colmap, job, SILENT),
    )
    model = colmap_reconstruction.ColmapReconstructor().reconstruct(job, SILENT)
    assert logged_codes(caplog) == ["lens-held"]
    kept = next(iter(model.cameras.values()))
    assert list(kept.params) == pytest.approx(list(job.survey.cameras[0].params), abs=1e-9)
    assert model.compute_mean_reprojection_error() < 1e-2
