"""Comparison with a reference: simulated surfaces with known offsets, and counts against brute force."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, REFERENCE_HISTOGRAM, REFERENCE_MAP
from pipelines.core.workspace import Workspace
from pipelines.evaluate.reference.alignment import fit_alignment
from pipelines.evaluate.reference.distances import (
    CLASSES,
    ComparisonSettings,
    SquareDistances,
    compare_square,
    kinds_of,
)
from pipelines.evaluate.reference.figures import CoreTable, DistanceTally, level_of_detection, m3c2_figures
from pipelines.evaluate.reference.normals import plane_normals
from pipelines.evaluate.reference.seen import SeenSurface, Viewpoints, seen_surface
from pipelines.evaluate.reference.tiles import TiledPoints
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geometry.similarity import perturbation
from pipelines.scene.calibrated import load_survey
from pipelines.scene.reference_report import ReferenceComparison
from pipelines.scene.report import read_report
from tests.depth_scenes import BOX_M, CAMERA, DOWN, looking_down
from tests.scene.test_measured_cloud import write_las
from tests.splat_scenes import ground_height

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
        for square in sorted(first.squares | second.squares)
    ]
    tally = DistanceTally()
    for square in squares:
        tally.add(square)
    return tally, squares


def test_offset_is_found_on_ground_roof_and_wall(tmp_path: Path) -> None:
    """The model's ground lies 3 cm low, its roof 2 cm high, its wall 6 cm behind: the sign is that of the side."""
    reference, _, kind = town(1, 0.005)
    model, normal, model_kind = town(2, 0.005)
    roof = (model_kind == BUILDING) & (normal[:, 2] == 1)
    offset = np.where(normal[:, 0] == 1, -0.06, np.where(roof, 0.02, -0.03))
    tally, _ = compared(tmp_path, model + offset[:, None] * normal, normal, reference, kind)
    cores = tally.cores()
    groups = {
        group.name: group
        for group in tally.groups(
            CoreTable(cores, level_of_detection(cores.noise_m, np.zeros(len(cores.position))))
        )
    }
    for name, expected in (("ground", -0.03), ("roof", 0.02), ("wall", -0.06)):
        figures = groups[name].m3c2
        assert figures.measured > 40
        assert figures.median_m is not None
        # Means of some 28 points with σ 5 mm each: 1 mm, of which the median over the places keeps less.
        assert figures.median_m == pytest.approx(expected, abs=2e-3)
        assert figures.significant is not None
        assert figures.significant > 0.85  # cylinders at rims hold another surface too
    assert groups["wall"].scores[0].precision == pytest.approx(0, abs=0.05)  # 5 cm, and the wall is off by 6


def test_level_of_detection_covers_noise_and_place(tmp_path: Path) -> None:
    """Surfaces of 2 cm noise, one of them off by a draw of σ 3 cm, which the caller states."""
    rng = np.random.default_rng(7)
    within_noise, within_all = [], []
    for run in range(3):
        reference, _, kind = town(10 + run, 0.02)
        model, normal, _ = town(30 + run, 0.02)
        off_m = rng.normal(0, 0.03)
        tally, _ = compared(tmp_path / str(run), model + np.array([0, 0, off_m]), normal, reference, kind)
        cores = tally.cores()
        smooth = (np.abs(cores.normal[:, 2]) > 0.99) & (
            np.abs(np.abs(cores.position[:, :2]).max(axis=1) - BOX_M) > 1
        )
        distance, noise = cores.distance_m[smooth], cores.noise_m[smooth]
        within_noise.append(np.nanmean(np.abs(distance - off_m) < level_of_detection(noise, np.zeros(len(noise)))))
        within_all.append(np.nanmean(np.abs(distance) < level_of_detection(noise, np.full(len(noise), 0.03))))
    # 95 %, less what σ estimated from 16 or more points misses.
    assert np.mean(within_noise) > 0.92
    # M3C2 adds σ of the place to that of the noise, not their squares: on the safe side.
    assert np.mean(within_all) > 0.92


def test_scores_are_those_of_brute_force(tmp_path: Path) -> None:
    reference, _, kind = (values[::5] for values in town(3, 0.04))
    model, normal, _ = (values[::4] for values in town(4, 0.04))
    part = model[:, 0] < 6  # the model has a hole, which recall must count
    model, normal = model[part], normal[part]
    tally, squares = compared(tmp_path, model, normal, reference, kind)
    assert len(squares) > 3  # points near the borders have their nearest in another square
    between = np.linalg.norm(model[:, None] - reference[None], axis=2)
    to_reference, to_model = between.min(axis=1), between.min(axis=0)
    (everywhere, *_) = tally.groups(CoreTable(tally.cores(), tally.cores().noise_m))
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
    np.testing.assert_allclose(fit.shift.enu_m, shift, atol=0.01)
    assert max(fit.shift.sigma_m) < 0.02


def test_similarity_between_clouds_is_found() -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform(-30, 30, (20_000, 2))
    hills = np.column_stack([place, 3 * np.sin(place[:, 0] / 4) + 2 * np.cos(place[:, 1] / 3)])
    true = perturbation(np.array([0.01, 0.002, -0.003, 0.02, 0.3, -0.4, 2.0]), np.zeros(3))
    model = true.inverse().apply(hills[::4])
    fit = fit_alignment(model, hills[1::2], plane_normals(hills[1::2], 0.6), 0.6, "similarity")
    assert fit is not None
    # Planes through points 0.6 m apart cut the hills' bends by centimetres.
    np.testing.assert_allclose(fit.reference_from_model.apply(model), hills[::4], atol=0.1)
    assert fit.shift.scale_ppm == pytest.approx(1e4, rel=0.05)


def test_classes_are_ground_roof_wall_and_vegetation() -> None:
    up, across = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
    kinds = kinds_of(
        np.array([2, 6, 6, 3, 4, 5, 9, 2], np.uint8), np.array([up, up, across, up, up, across, up, [np.nan] * 3])
    )
    names = [CLASSES[index] for index in kinds.of_class]
    assert names == ["ground", "roof", "wall", "vegetation", "vegetation", "vegetation", "other", "ground"]
    assert kinds.of_slope.tolist() == [0, 0, 3, 0, 0, 3, 0, 4]


def test_unmeasured_distances_have_no_figures() -> None:
    figures = m3c2_figures(np.full(3, np.nan), np.full(3, np.nan))
    assert (figures.core_points, figures.measured, figures.median_m) == (3, 0, None)


@pytest.mark.usefixtures("one_thread")
def test_trained_hill_against_the_true_hill(altered: Workspace, tmp_path: Path) -> None:
    """The command, from the file to the pictures: a reference that lies 0.3 m above the true hill."""
    off_m, crs, file = 0.3, "EPSG:4978", tmp_path / "hill.laz"
    origin = load_survey(altered).origin
    place = np.random.default_rng(3).uniform(-25, 25, (10_000, 2))
    hill = np.column_stack([place, ground_height(*place.T) + off_m])
    write_las(file, parse_crs(crs).xyz_from_lla(lla_from_enu(hill, origin)), crs=None)

    def comparison(**flags: object) -> ReferenceComparison:
        run_stage(altered, EVALUATE, {"renders": 0, "reference": file, "reference_crs": crs, **flags})
        reference = read_report(altered.path("evaluate/report.json")).reference
        assert reference is not None
        return reference

    here = comparison(reference_sigma=1.0)
    everywhere = here.group("all")
    assert here.shift is not None
    # The hill is made of level discs of 0.9 m, so that the surface is true to a pixel.
    assert here.shift.enu_m[2] == pytest.approx(off_m, abs=here.model_spacing_m)
    assert everywhere.m3c2.median_m == pytest.approx(-here.shift.enu_m[2], abs=0.1)
    assert everywhere.m3c2.significant == 0  # σ of the reference explains all
    moved = comparison(reference_align="shift")
    assert moved.group("all").m3c2.median_m == pytest.approx(0, abs=0.1)
    for product in (REFERENCE_MAP, REFERENCE_HISTOGRAM):
        assert altered.path(product).read_bytes().startswith(b"\x89PNG")
    assert not (altered.root / "evaluate" / "reference").exists()


def test_reference_without_crs_is_refused(altered: Workspace, tmp_path: Path) -> None:
    write_las(tmp_path / "hill.laz", np.zeros((5, 3)), crs=None)
    with pytest.raises(InputError, match="--reference-crs"):
        run_stage(altered, EVALUATE, {"renders": 0, "reference": tmp_path / "hill.laz"})
