"""Pairs of workspaces with the rasters of a town at two epochs, whose change is known in each cell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from pipelines.adjust.relative import Solved
from pipelines.change.datum import load_epoch
from pipelines.change.grid import MEASURED
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import COMMON_POINTS, MODEL
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import sidecar_path
from pipelines.formats.geotiff import Band, RasterFrame, RasterKind, write_mosaic, write_part
from pipelines.geodesy.vertical import parse_vertical
from pipelines.survey.area import corners, scene_points
from pipelines.survey.common_points import CommonPoints, solution_hash
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CrsOptions
from pipelines.survey.solution import TrainedModel, read_sfm, read_solution
from pipelines.survey.target_crs import target_crs
from tests.once import fill_folder
from tests.trained_workspaces import trained_workspace, write_adjustment

SIDE, CELL_M, NOISE_M, GROUND_M = 360, 0.25, 0.03, 1600.0
HOLE_CELLS = 3  # beside the eastern walls of the later epoch, which are interpolated


@dataclass(frozen=True)
class TownPair:
    """Heights (H, W) of both epochs as they are, and workspaces that have measured them."""

    before: FloatArray
    after: FloatArray
    workspaces: tuple[Workspace, Workspace]

    @property
    def risen_m(self) -> FloatArray:
        return self.after - self.before


def town_heights(*, changed: bool, half_cells: int = 0, seed: int = 4) -> tuple[FloatArray, BoolArray]:
    """Return heights (H, W) of a town on a slope, and where houses stand, moved east by halves of a cell.

    Changed, the first house is gone, another stands in the south, and a pit and a heap of 1.5 m are there.
    """
    rng, fine = np.random.default_rng(seed), 2 * SIDE
    row, column = np.indices((fine, fine), dtype=np.float64)
    ground, house = GROUND_M + 0.02 * column * CELL_M / 2, np.zeros((fine, fine), dtype=bool)
    roofs = ground.copy()
    for number in range(16):
        top, left = (40 + 150 * np.array(divmod(number, 4)) + rng.integers(0, 40, 2)).tolist()
        (deep, wide), high = rng.integers(50, 90, 2).tolist(), rng.uniform(4, 12)
        if number == 15 or (changed and number == 0):
            continue
        place = (slice(top, top + deep), slice(left + half_cells, left + half_cells + wide))
        roofs[place], house[place] = GROUND_M + high, True
    if changed:
        place = (slice(530, 600), slice(530 + half_cells, 610 + half_cells))
        roofs[place], house[place] = GROUND_M + 7.0, True
    for sign, middle in ((-1.0, (690, 200)), (1.0, (690, 420))):
        reach = np.minimum(np.hypot(row - middle[0], column - middle[1]) / 28.0, 1.0)
        roofs += (1.5 if changed else 0.0) * sign * (0.5 + 0.5 * np.cos(np.pi * reach))
    return roofs[::2, ::2], house[::2, ::2]


def town_pair(root: Path, *, changed: bool, half_cells: int = 1, shift_m: float = 0.0) -> TownPair:
    """Return a town that the later epoch has measured `shift_m` higher, and its walls `half_cells` halves of a cell
    further east.
    """
    before, _ = town_heights(changed=False)
    after, _ = town_heights(changed=changed)

    def write(folder: Path) -> None:
        write_dates(folder, before, changed=changed, half_cells=half_cells, shift_m=shift_m)

    fill_folder(root, ("town", changed, half_cells, shift_m), write)
    return TownPair(before, after, (Workspace(root / "spring"), Workspace(root / "autumn")))


def write_dates(root: Path, before: FloatArray, *, changed: bool, half_cells: int, shift_m: float) -> None:
    seen, house = town_heights(changed=changed, half_cells=half_cells)
    hole = np.zeros(house.shape, dtype=bool)
    for shift in range(1, HOLE_CELLS + 1):
        hole[:, shift:] |= house[:, :-shift] & ~house[:, shift:]
    blurred = gaussian_filter(seen, HOLE_CELLS)
    rng = np.random.default_rng(1)
    epoch_workspace(root / "spring", before, np.ones(before.shape, dtype=bool), rng)
    epoch_workspace(root / "autumn", np.where(hole, blurred, seen) + shift_m, ~hole, rng)


def epoch_workspace(root: Path, height_m: FloatArray, measured: BoolArray, rng: np.random.Generator) -> Workspace:
    """Return a workspace with the rasters of a surface (H, W) with noise, and an orthophoto of its heights."""
    _, workspace = trained_workspace(root)
    solution, survey = read_solution(workspace), load_survey(workspace)
    box = corners(scene_points(solution, read_sfm(workspace, solution)))
    options = CrsOptions(crs="EPSG:32632", vertical=parse_vertical("ellipsoidal"))
    target = target_crs(options, survey.origin, box, survey.vertical)
    east, north, _ = target.xyz_from_geo(np.zeros((1, 3)))[0].tolist()
    rows, columns = height_m.shape
    west, top = east - columns * CELL_M / 2, north + rows * CELL_M / 2
    frame = RasterFrame(target.crs.wkt1, west, top, CELL_M, CELL_M, columns, rows)
    folder = root / "raster"
    folder.mkdir()
    noise = gaussian_filter(rng.normal(0, 1, height_m.shape), 1.5)
    values = height_m + NOISE_M * noise / noise.std()
    south, east_end = top - rows * CELL_M, west + columns * CELL_M
    sidecar = target.sidecar([[west, south, values.min()], [east_end, top, values.max()]], None, None, ())
    grey = np.clip((height_m - GROUND_M) * 12 + 90, 0, 255).astype(np.uint8)
    colour = cv2.applyColorMap(grey, cv2.COLORMAP_BONE)
    rasters = {
        "dsm": values[None],
        "sigma_v": np.full((1, *values.shape), NOISE_M),
        "measured": np.where(measured, MEASURED, 0).astype(np.uint8)[None],
        "orthophoto": np.concatenate([colour, np.full((*grey.shape, 1), 255, np.uint8)], axis=2).transpose(2, 0, 1),
    }
    for name, cells in rasters.items():
        part = folder / f"{name}.part.tif"
        write_part(part, cells.astype(cells.dtype if cells.dtype == np.uint8 else np.float32), frame)
        write_mosaic(folder / f"{name}.tif", [(part, 0, 0)], frame, _kind(cells), {})
        part.unlink()
        save_json(sidecar, sidecar_path(folder / f"{name}.tif"))
    return workspace


def _kind(cells: NDArray[Any]) -> RasterKind:
    colours: tuple[Literal["Red", "Green", "Blue", "Alpha"], ...] = ("Red", "Green", "Blue", "Alpha")
    bands = tuple(Band(name, colour=name) for name in colours) if len(cells) == 4 else (Band("value"),)
    return RasterKind("uint8" if cells.dtype == np.uint8 else "float32", bands)


def tie(after: Workspace, before: Workspace) -> None:
    """Adjust an epoch onto another, all points of which it has in common."""
    epoch = load_epoch(before)
    date = Solved(epoch.posterior, epoch.survey.origin_on_earth)
    ids = epoch.posterior.sparse.point_id
    position, cov = date.placed(ids)
    similarity, pivot = date.similarity_in_ecef
    CommonPoints(
        point_id=ids,
        earlier_point_id=ids,
        matches=np.full(len(ids), 3),
        position_in_ecef=position,
        cov_in_ecef=cov,
        sigma_m=date.sigma_m,
        cov_similarity=similarity,
        pivot_in_ecef=pivot,
        spread=np.asarray(1.0),
        found=np.asarray(len(ids)),
        factor=np.asarray(1.0),
        checked=np.asarray(True),
        earlier=str(before.root),
        solution=solution_hash(before),
    ).save(after.root / COMMON_POINTS)
    model = load_json(TrainedModel, after.path(MODEL))
    save_json(model.model_copy(update={"tied": True}), after.root / MODEL)
    nudge_first_camera(after, sum(after.root.name.encode()))
    write_adjustment(after)


def nudge_first_camera(workspace: Workspace, nanometres: int) -> None:
    """Move a camera of a solution, as another solution does: those of these workspaces are alike."""
    model = load_json(TrainedModel, workspace.path(MODEL))
    first, *others = model.cameras
    x, y, z = first.translation
    moved = first.model_copy(update={"translation": (x + 1e-9 * nanometres, y, z)})
    save_json(model.model_copy(update={"cameras": (moved, *others)}), workspace.root / MODEL)
