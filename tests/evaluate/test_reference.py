"""Comparison with a reference: simulated surfaces with known offsets, and counts against brute force."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from scipy.stats import t as student_t

from pipelines.core.errors import InputError
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, CLOUD, REFERENCE_HISTOGRAM, REFERENCE_MAP
from pipelines.core.workspace import Workspace
from pipelines.evaluate.reference_distances import (
    CLASSES,
    ComparisonSettings,
    CorePoints,
    DistanceTally,
    SquareDistances,
    compare_square,
    kinds_of,
    m3c2_figures,
    m3c2_level_of_detection,
)
from pipelines.geometry.similarity import perturbation
from pipelines.surface.m3c2 import CONFIDENCE_95, TiledPoints, plane_normals
from pipelines.surface.registration import fit_alignment
from pipelines.surface.visibility import SeenSurface, Viewpoints, seen_surface
from pipelines.survey.report import read_report
from tests.depth_scenes import BOX_M, CAMERA, DOWN, looking_down
from tests.survey.test_measured_cloud import write_las

GROUND, BUILDING = 2, 6
CENTERS = np.array(looking_down(8))
SPACING_M = 0.2
SQUARE_M = 16.0
EVALUATE = BY_NAME["evaluate"]


def grid(reach_m: float, rng: np.random.Generator) -> np.ndarray:
    axis = np.arange(-reach_m, reach_m, SPACING_M)
    place = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return place + rng.uniform(0, SPACING_M, place.shape)


def town(seed: int, noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points on level ground and on the box with its walls, their normals and classes."""
    rng = np.random.default_rng(seed)
    ground = grid(12.0, rng)
    ground = ground[np.abs(ground).max(axis=1) > BOX_M]
    roof = grid(BOX_M, rng)
    side = grid(BOX_M, rng)
    side = side[side[:, 1] > -BOX_M]
    wall = np.column_stack([np.full(len(side), BOX_M), side[:, 0], (side[:, 1] + BOX_M) / 2])
    flat = np.column_stack([np.zeros(2), np.zeros(2), np.ones(2)])
    parts = [
        (np.column_stack([ground, np.zeros(len(ground))]), flat[0], GROUND),
        (np.column_stack([roof, np.full(len(roof), BOX_M)]), flat[1], BUILDING),
        (wall, np.array([1.0, 0.0, 0.0]), BUILDING),
    ]
    position = np.concatenate([place for place, _, _ in parts])
    normal = np.concatenate([np.tile(direction, (len(place), 1)) for place, direction, _ in parts])
    kind = np.concatenate([np.full(len(place), code, np.uint8) for place, _, code in parts])
    return position + rng.normal(0, noise_m, len(position))[:, None] * normal, normal, kind


def tiled(folder: Path, position: np.ndarray, normal: np.ndarray | None, kind: np.ndarray | None) -> TiledPoints:
    points = TiledPoints(folder, SQUARE_M)
    for rows in np.array_split(np.random.default_rng(0).permutation(len(position)), 3):
        points.append(
            position[rows], None if normal is None else normal[rows], None if kind is None else kind[rows]
        )
    return points


def everything(position: np.ndarray) -> SeenSurface:
    """Return maps whose tolerance lets every point be seen."""
    centers = np.array([[x, y, 60.0] for x in (-3.0, 0.0, 3.0) for y in (-3.0, 3.0)])
    views = Viewpoints(np.tile(DOWN, (len(centers), 1, 1)), centers, (CAMERA,) * len(centers))
    return SeenSurface(seen_surface(views, position, 0.25).views, 1.0)


def compared(
    folder: Path, model: np.ndarray, model_normal: np.ndarray, reference: np.ndarray, kind: np.ndarray
) -> tuple[DistanceTally, list[SquareDistances]]:
    first = tiled(folder / "reference", reference, None, kind)
    second = tiled(folder / "model", model, model_normal, None)
    settings = ComparisonSettings(0.01, 3 * SPACING_M, 1.0)
    squares = [
        compare_square(square, first, second, everything(reference), settings)
        for square in sorted({*first.count, *second.count})
    ]
    tally = DistanceTally()
    for square in squares:
        tally.add(square)
    return tally, squares


def apart_from_edges(cores: CorePoints, kind: str) -> np.ndarray:
    """Return which places of a kind lie more than 1 m from its edges.

    That is beyond the radius of the cylinders (0.6 m), and of the neighbours that give a normal (16, half a radius
    apart: 0.68 m): all these points belong to one plane.
    """
    place = cores.position
    if kind == "wall":
        inner = (np.abs(place[:, 1]) < BOX_M - 1) & (np.abs(place[:, 2] - BOX_M / 2) < BOX_M / 2 - 1)
    else:
        inner = np.abs(np.abs(place[:, :2]).max(axis=1) - BOX_M) > 1
    return inner & (cores.kinds.of_class == CLASSES.index(kind))


def test_offset_is_found_on_ground_roof_and_wall(tmp_path: Path) -> None:
    """The model's ground lies 3 cm low, its roof 2 cm high, its wall 6 cm behind: the sign is that of the side."""
    reference, _, kind = town(1, 0.005)
    model, normal, model_kind = town(2, 0.005)
    roof = (model_kind == BUILDING) & (normal[:, 2] == 1)
    offset = np.where(normal[:, 0] == 1, -0.06, np.where(roof, 0.02, -0.03))
    tally, _ = compared(tmp_path, model + offset[:, None] * normal, normal, reference, kind)
    cores = tally.cores()
    lod_m = m3c2_level_of_detection(cores.noise_m, np.zeros(len(cores.position)))
    groups = {group.name: group for group in tally.groups(cores, lod_m)}
    for name, expected in (("ground", -0.03), ("roof", 0.02), ("wall", -0.06)):
        inner = apart_from_edges(cores, name)
        assert inner.sum() > 20
        # Means of 28 points with σ 5 mm in each cloud: σ of a distance is 1.3 mm, each offset is 15 σ or more, and
        # the power of the test is 1.
        assert (np.abs(cores.distance_m[inner]) > lod_m[inner]).all()
        # t with 54 degrees of freedom exceeds 6 once in five million.
        assert (np.abs(cores.distance_m[inner] - expected) < 6 * cores.noise_m[inner]).all()
        figures = groups[name].m3c2
        assert figures.measured == figures.core_points
        assert figures.median_m is not None
        # 0.6 m or more from its edges lies 60 % of the wall. If all other places erred to one side, the median
        # would be the quantile 0.83 of those, 1 σ off.
        assert figures.median_m == pytest.approx(expected, abs=2e-3)
        # What stays below its level lies at an edge, where a cylinder holds two surfaces: its roughness is that of
        # their distance, many times the noise of 1.3 mm.
        missed = (cores.kinds.of_class == CLASSES.index(name)) & (np.abs(cores.distance_m) <= lod_m)
        assert (cores.noise_m[missed] > 0.01).all()
        assert figures.significant == pytest.approx(1 - missed.sum() / figures.measured)
    assert groups["wall"].scores[0].precision == pytest.approx(0, abs=0.05)  # 5 cm, and the wall is off by 6


def test_level_of_detection_covers_noise_and_place(tmp_path: Path) -> None:
    """Surfaces of 2 cm noise: at the same height, and apart by as much as σ 3 cm of the place explains."""
    limit_m = CONFIDENCE_95 * 0.03
    within_noise, within_all = [], []
    for run, off_m in enumerate((0.0, limit_m, -limit_m)):
        reference, _, kind = town(10 + run, 0.02)
        model, normal, _ = town(30 + run, 0.02)
        tally, _ = compared(tmp_path / str(run), model + np.array([0, 0, off_m]), normal, reference, kind)
        cores = tally.cores()
        level = apart_from_edges(cores, "ground") | apart_from_edges(cores, "roof")
        distance, noise = cores.distance_m[level], cores.noise_m[level]
        within_noise.append(
            np.mean(np.abs(distance - off_m) < m3c2_level_of_detection(noise, np.zeros(len(noise))))
        )
        within_all.append(np.mean(np.abs(distance) < m3c2_level_of_detection(noise, np.full(len(noise), 0.03))))
    # σ is estimated from 28 points of each cloud: |t| with 54 degrees of freedom is below 1.96 in 94.5 % of places.
    # Cylinders overlap: one place in π is independent, which gives the shares σ of 0.45 % (three runs).
    inside = 1 - 2 * student_t.sf(CONFIDENCE_95, 54)
    sigma = np.sqrt(inside * (1 - inside) / (3 * level.sum() / np.pi))
    assert np.mean(within_noise) == pytest.approx(inside, abs=3 * sigma)
    # M3C2 adds σ of the place to that of the noise, not their squares: at the limit, one tail alone leads outside.
    inside = 1 - student_t.sf(CONFIDENCE_95, 54)
    sigma = np.sqrt(inside * (1 - inside) / (2 * level.sum() / np.pi))
    assert within_all[0] > inside
    assert np.mean(within_all[1:]) == pytest.approx(inside, abs=3 * sigma)


@pytest.mark.parametrize("height_m", [0.01, 0.03])
def test_dense_noise_shifts_no_distance(tmp_path: Path, height_m: float) -> None:
    """A reference of 20 points within the cell of one of the model's, just above a border of voxels (height 0)."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-6, 6, (72_000, 2))
    reference = np.column_stack([place, height_m + rng.normal(0, 0.02, len(place))])
    model = np.column_stack([place[::20], height_m + rng.normal(0, 0.001, len(place[::20]))])
    up = np.tile([0.0, 0.0, 1.0], (len(model), 1))
    tally, _ = compared(tmp_path, model, up, reference, np.full(len(reference), GROUND, np.uint8))
    cores = tally.cores()
    # The mean has σ 0.02 m / √72 000. One point a voxel would be off by 6 to 20 mm.
    assert cores.distance_m.mean() == pytest.approx(0, abs=5 * 0.02 / np.sqrt(len(reference)))


@pytest.mark.slow
def test_scores_are_those_of_brute_force(tmp_path: Path) -> None:
    reference, _, kind = (values[::5] for values in town(3, 0.04))
    model, normal, _ = (values[::4] for values in town(4, 0.04))
    part = model[:, 0] < 6  # the model has a hole, which recall must count
    model, normal = model[part], normal[part]
    tally, squares = compared(tmp_path, model, normal, reference, kind)
    assert len(squares) > 3  # points near the borders have their nearest in another square
    between = np.linalg.norm(model[:, None] - reference[None], axis=2)
    to_reference, to_model = between.min(axis=1), between.min(axis=0)
    (everywhere, *_) = tally.groups(tally.cores(), tally.cores().noise_m)
    assert everywhere.c2c.count == len(model)
    assert everywhere.seen_points == len(reference)
    for score in everywhere.scores:
        precision, recall = (to_reference <= score.threshold_m).mean(), (to_model <= score.threshold_m).mean()
        assert score.precision == pytest.approx(precision)
        assert score.recall == pytest.approx(recall)
        assert score.f1 == pytest.approx(2 * precision * recall / (precision + recall))
    assert everywhere.c2c.median_m == pytest.approx(np.median(to_reference), abs=1e-3)
    assert everywhere.c2c.mean_m == pytest.approx(to_reference.mean(), abs=1e-3)


def test_points_under_a_roof_and_beside_the_photographs_are_not_seen() -> None:
    reference, _, _ = town(5)
    rng = np.random.default_rng(0)
    under = np.column_stack([rng.uniform(-2.5, 2.5, (200, 2)), np.zeros(200)])
    beside = np.column_stack([rng.uniform(60, 80, (200, 2)), np.zeros(200)])
    views = Viewpoints(np.tile(DOWN, (8, 1, 1)), CENTERS, (CAMERA,) * 8)
    seen = seen_surface(views, np.concatenate([reference, under, beside]), SPACING_M)
    open_ground = reference[(reference[:, 2] == 0) & (np.abs(reference[:, :2]).max(axis=1) > BOX_M + 5)]
    roof = reference[(reference[:, 2] == BOX_M) & (np.abs(reference[:, :2]).max(axis=1) < BOX_M - 1)]
    assert seen.sees(open_ground).all()
    assert seen.sees(roof).all()
    assert not seen.sees(under).any()
    assert not seen.sees(beside).any()


def test_shift_between_clouds_is_found_with_its_sigma() -> None:
    reference, _, _ = town(6, 0.01)
    model, _, _ = town(7, 0.01)
    shift = np.array([0.12, -0.2, 0.35])
    model = model[np.linalg.norm(model, axis=1) < 11]
    # Only one wall looks east: without one that looks north, nothing fixes that axis.
    north = model[np.abs(model[:, 0] - BOX_M) < 0.1][:, [1, 0, 2]]
    other = reference[np.abs(reference[:, 0] - BOX_M) < 0.1][:, [1, 0, 2]]
    reference = np.concatenate([reference, other])
    fit = fit_alignment(
        np.concatenate([model, north]) - shift, reference, plane_normals(reference, SPACING_M), SPACING_M, "shift"
    )
    assert fit is not None
    found = fit[1]
    # A wall's 800 pairs of σ 1 cm each fix their axis to half a millimetre, and the stated σ says so.
    assert (np.abs(found.enu_m - shift) < 4 * np.array(found.sigma_m)).all()
    assert max(found.sigma_m) < 1e-3


def test_a_plane_fixes_no_shift() -> None:
    plane = np.column_stack([grid(12.0, np.random.default_rng(0)), np.zeros(120**2)])
    assert fit_alignment(plane[::2], plane[1::2], plane_normals(plane[1::2], SPACING_M), SPACING_M, "shift") is None


def test_similarity_between_clouds_is_found() -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform(-30, 30, (20_000, 2))
    hills = np.column_stack([place, 3 * np.sin(place[:, 0] / 4) + 2 * np.cos(place[:, 1] / 3)])
    true = perturbation(np.array([0.01, 0.002, -0.003, 0.02, 0.3, -0.4, 2.0]), np.zeros(3))
    model = true.inverse().apply(hills[::4])
    fit = fit_alignment(model, hills[1::2], plane_normals(hills[1::2], 0.6), 0.6, "similarity")
    assert fit is not None
    similarity, found = fit
    # Planes through points 0.6 m apart cut the hills' bends by up to 9 cm, crests and troughs alike: 3 cm (RMS) in
    # each of 36 parts of 10 m are 5 mm in their mean. At 30 m, 1 cm is 300 ppm of scale.
    np.testing.assert_allclose(similarity.apply(model), hills[::4], atol=0.01)
    assert found.scale_ppm == pytest.approx(1e6 * np.expm1(0.01), abs=300)
    np.testing.assert_array_equal(found.reference_from_model, similarity.matrix()[:3])


def test_classes_are_ground_roof_wall_and_vegetation() -> None:
    up, across = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    kinds = kinds_of(
        np.array([2, 6, 6, 3, 4, 5, 9, 2], np.uint8), np.array([up, up, across, up, up, across, up, [np.nan] * 3])
    )
    names = [CLASSES[index] for index in kinds.of_class]
    assert names == ["ground", "roof", "wall", "vegetation", "vegetation", "vegetation", "other", "ground"]
    assert kinds.of_slope.tolist() == [0, 0, 3, 0, 0, 3, 0, 4]


def test_no_place_where_the_reference_was_cut_is_compared(tmp_path: Path) -> None:
    """The ground has a step of 0.3 m where the reference was cut: beyond it there is only the model."""
    rng = np.random.default_rng(0)
    model = grid(10.0, rng)
    model = np.column_stack([model, rng.normal(np.where(model[:, 0] > 5, -0.3, 0.0), 0.001)])
    reference, radius_m = model[model[:, 0] <= 5], 3 * SPACING_M
    up, other = np.tile([0.0, 0.0, 1.0], (len(model), 1)), np.zeros(len(reference), np.uint8)
    clouds = tiled(tmp_path / "reference", reference, None, other), tiled(tmp_path / "model", model, up, None)
    box = np.array([-10.0, -10.0, -1.0]), np.array([5.0, 10.0, 1.0])
    distance = {}
    for cut in (None, box):
        settings = ComparisonSettings(0.01, radius_m, 1.0, cut)
        names = sorted({*clouds[0].count, *clouds[1].count})
        squares = [compare_square(name, *clouds, everything(reference), settings) for name in names]
        distance[cut is None] = np.concatenate([square.cores.distance_m for square in squares])
    # Half of a cylinder at the cut is model alone, 0.3 m lower; elsewhere both clouds are the same.
    assert np.nanmin(distance[True]) < -0.1
    assert len(distance[False]) > 100
    np.testing.assert_allclose(distance[False][np.isfinite(distance[False])], 0, atol=1e-6)


def test_unmeasured_distances_have_no_figures() -> None:
    figures = m3c2_figures(np.full(3, np.nan), np.full(3, np.nan))
    assert (figures.core_points, figures.measured, figures.median_m) == (3, 0, None)


@pytest.mark.usefixtures("one_thread")
def test_surface_against_itself_raised(altered: Workspace, tmp_path: Path) -> None:
    """The command, from the file to the pictures: the reference is the model's own cloud, 0.3 m higher."""
    off_m, file = 0.3, tmp_path / "raised.laz"
    run_stage(altered, BY_NAME["export-cloud"], {})
    cloud = laspy.read(altered.path(CLOUD))
    cloud.z += off_m
    cloud.write(file)

    flags = {"renders": 0, "reference": file, "reference_align": "shift", "reference_sigma": 0.01}
    run_stage(altered, EVALUATE, flags)
    reference = read_report(altered.path("evaluate/report.json")).reference
    assert reference is not None
    assert reference.shift is not None
    # The same surface but for the millimetres of the LAZ file.
    np.testing.assert_allclose(reference.shift.enu_m, (0, 0, off_m), atol=1e-3)
    assert max(reference.shift.sigma_m) < 1e-3
    figures = next(group for group in reference.groups if group.name == "all").m3c2
    # Few of the hill's places have less than four points of each cloud.
    assert figures.measured > 0.95 * figures.core_points
    assert figures.median_m == pytest.approx(0, abs=1e-3)
    assert figures.median_lod_m is not None
    assert figures.median_lod_m > CONFIDENCE_95 * 0.01
    assert figures.significant == 0  # unchanged
    for product in (REFERENCE_MAP, REFERENCE_HISTOGRAM):
        assert altered.path(product).read_bytes().startswith(b"\x89PNG")
    assert not (altered.root / "evaluate" / "reference").exists()


def test_reference_without_crs_is_refused(altered: Workspace, tmp_path: Path) -> None:
    write_las(tmp_path / "hill.laz", np.zeros((5, 3)), crs=None)
    with pytest.raises(InputError, match="--reference-crs"):
        run_stage(altered, EVALUATE, {"renders": 0, "reference": tmp_path / "hill.laz"})
