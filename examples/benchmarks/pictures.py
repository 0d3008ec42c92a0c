"""Measure what people look at, the orthophoto's detail and seams and the splat's opacity:

    georef run WORKSPACE … && georef export-raster WORKSPACE --source
    python examples/benchmarks/pictures.py WORKSPACE

- Detail: squares of 4 m around the control and check points that lie on level ground, less the mean over 1.3 m.
  They are compared with the photograph that sees the point most steeply, past the surface model, blurred to the
  raster's cells: contrast is the ratio of both standard deviations, r their correlation.
- Seams: the step between two neighbouring cells, in grey levels, where they come from different photographs, and
  between neighbours of one photograph 2 to 4 cells beside; both where no height changes by 0.5 m within 2 m.
- Opacity: PSNR of the exported PLY (of the model, without one) in the middle two thirds of the test views' sides,
  where two training views see the ground, over black and over white, and α there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import rasterio
import torch

from pipelines.core.stages import SPLAT
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.deliver.placement import solved_placement
from pipelines.evaluate.photometric import TrainingCoverage
from pipelines.geometry.cameras import pose_matrix
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.exposure import with_affine
from pipelines.splat.gaussians import read_gaussians
from pipelines.splat.metrics import psnr
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.surface_views import model_renderer
from pipelines.survey.area import corners, scene_points
from pipelines.survey.headline import headline_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CrsOptions
from pipelines.survey.scene import photographs
from pipelines.survey.solution import TrainedModel, read_sfm, read_trained
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs, target_crs

PATCH_M, BROAD_M = 4.0, 1.3
LEVEL_M = 1.0  # of the surface around a point from its height
STEP_M, AROUND_M = 0.5, 2.0  # of heights near a seam
ORTHOPHOTO, DSM = "raster/orthophoto.tif", "raster/dsm.tif"


@dataclass(frozen=True)
class Patch:
    """Detail of the orthophoto around a point, against that of a photograph seen under an angle to the vertical."""

    name: str
    contrast: float
    correlation: float
    oblique_deg: float


@dataclass(frozen=True)
class Seams:
    """Mean steps between neighbouring cells in grey levels: `cells` at changes of the photograph, and others."""

    cells: int
    at: float
    beside: float


@dataclass(frozen=True)
class Opacity:
    """PSNR over black and over white in dB, and quantiles of α."""

    black: float
    white: float
    alpha_1_percent: float
    alpha_5_percent: float


def patches(workspace: Workspace) -> list[Patch]:
    """Return the detail around every control and check point on level ground inside of the orthophoto."""
    model = read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    with rasterio.open(workspace.path(ORTHOPHOTO)) as raster:
        rgba, grid, crs = raster.read().astype(np.float64), raster.transform, raster.crs.to_string()
    with rasterio.open(workspace.path(DSM)) as raster:
        surface = raster.read(1)
    around = corners(scene_points(model, sfm))
    target = target_crs(CrsOptions(crs=crs), survey.origin, around, survey.vertical)
    photos = _Photographs(workspace, model, sfm, survey)
    half, broad = round(PATCH_M / 2 / grid.a), round(BROAD_M / grid.a) | 1
    found = []
    for point in (*survey.control_points, *survey.check_points):
        (east, north, height), *_ = target.xyz_from_geo(np.array([point.position_in_geo]))
        column, row = (int(cell) for cell in ~grid @ (east, north))
        reach = half + broad
        rows, columns = slice(row - reach, row + reach + 1), slice(column - reach, column + reach + 1)
        inside = reach <= row < surface.shape[0] - reach and reach <= column < surface.shape[1] - reach
        if not inside or not rgba[3, rows, columns].all():
            continue
        if not np.abs(surface[rows, columns] - height).max() <= LEVEL_M:
            continue
        at = np.stack(_middles(grid, rows, columns), axis=-1)
        xyz = np.concatenate([at, np.full((*at.shape[:2], 1), height)], axis=-1)
        hidden = partial(_hidden, surface, grid, target, np.array([east, north, height]))
        seen = photos.steepest(target.geo_from_xyz(xyz.reshape(-1, 3)), float(grid.a), at.shape[:2], hidden)
        if seen is None:
            continue
        grey, oblique_deg = seen
        ours, theirs = (_detail(each, broad, half) for each in (rgba[:3, rows, columns].mean(axis=0), grey))
        correlation = float(np.corrcoef(ours.ravel(), theirs.ravel())[0, 1])
        found.append(Patch(point.name, float(ours.std() / theirs.std()), correlation, oblique_deg))
    return found


def _hidden(
    surface: FloatArray, grid: rasterio.Affine, target: TargetCrs, point: FloatArray, center_in_geo: FloatArray
) -> bool:
    """Return whether a surface stands between a point in the CRS and a camera."""
    arm = target.xyz_from_geo(center_in_geo[None])[0] - point
    along = np.arange(PATCH_M / 2, max(np.hypot(*arm[:2]), PATCH_M), grid.a) / np.hypot(*arm[:2])
    line = point + along[:, None] * arm
    column, row = (np.floor(cells).astype(int) for cells in ~grid @ (line[:, 0], line[:, 1]))
    inside = (row >= 0) & (row < surface.shape[0]) & (column >= 0) & (column < surface.shape[1])
    return bool((surface[row[inside], column[inside]] > line[inside, 2]).any())


def _middles(grid: rasterio.Affine, rows: slice, columns: slice) -> tuple[FloatArray, FloatArray]:
    """Return the easting and northing (H, W) of cells' middles."""
    row, column = np.mgrid[rows, columns] + 0.5
    return grid.c + grid.a * column + grid.b * row, grid.f + grid.d * column + grid.e * row


def _detail(grey: FloatArray, broad: int, half: int) -> FloatArray:
    """Return the middle of a picture, less its means over `broad` cells."""
    fine = grey - cv2.boxFilter(grey, -1, (broad, broad))
    middle = slice(len(grey) // 2 - half, len(grey) // 2 + half + 1)
    return fine[middle, middle]


class _Photographs:
    """Training photographs at their full size, without lens and exposure."""

    def __init__(self, workspace: Workspace, model: TrainedModel, sfm: SparseModel, survey: Survey) -> None:
        largest = max(max(camera.width, camera.height) for camera in sfm.cameras.values())
        self._model, self._images = model, photographs(model.with_lenses(sfm), survey, workspace, largest)

    def steepest(
        self, place: FloatArray, cell_m: float, shape: tuple[int, int], hidden: Callable[[FloatArray], bool]
    ) -> tuple[FloatArray, float] | None:
        """Return the grey levels (H, W) of places in `geo` in the steepest photograph, and its angle; None: unseen.

        A photograph that is finer than the cells is blurred by the difference.
        """
        model, best = self._model, None
        poses, geo_from_model = model.poses, model.similarity
        in_model, middle = geo_from_model.inverse().apply(place), place.mean(axis=0)
        for camera in model.indices("train"):
            center = poses.cam_center_in_model[camera]
            pinhole = self._images.pinhole(camera)
            pixel = pinhole.project((in_model - center) @ poses.cam_from_model[camera].T)
            if not pinhole.contains(pixel).all():
                continue
            center_in_geo = geo_from_model.apply(center[None])[0]
            arm = middle - center_in_geo
            distance_m = float(np.linalg.norm(arm))
            steep = float(-arm[2] / distance_m)
            if (best is None or steep > best[0]) and not hidden(center_in_geo):
                best = steep, camera, pixel, distance_m / pinhole.fx
        if best is None:
            return None
        steep, camera, pixel, pixel_m = best
        photo = self._images.decoded(camera)
        # Both pixel and cell are boxes, of a variance of a twelfth of their squared width.
        variance = ((cell_m / pixel_m) ** 2 - 1) / 12
        if variance > 0.01:
            photo = cv2.GaussianBlur(photo, (0, 0), variance**0.5).astype(np.uint8)
        rgb = self._images.sampled(camera, photo, pixel.reshape(*shape, 2).astype(np.float32)).astype(np.float64)
        exposure = model.cameras[camera].exposure
        if exposure is not None:
            gain, offset = np.split(np.array(exposure), [3], axis=1)
            rgb = (rgb - 255 * offset[:, 0]) @ np.linalg.inv(gain).T
        return rgb.mean(axis=-1), float(np.degrees(np.arccos(steep)))


def seams(workspace: Workspace) -> Seams:
    """Return the steps where the photograph changes, and beside; the rasters need a `source.tif`."""
    folder = workspace.path(ORTHOPHOTO).parent
    with rasterio.open(folder / "orthophoto.tif") as raster:
        grey, cell_m = raster.read([1, 2, 3]).astype(np.float64).mean(axis=0), raster.transform.a
    with rasterio.open(folder / "source.tif") as raster:
        source = raster.read(1).astype(np.int64)
    with rasterio.open(workspace.path(DSM)) as raster:
        height = raster.read(1)
    window = np.ones((2 * round(AROUND_M / cell_m) + 1,) * 2, np.uint8)
    known = np.where(np.isfinite(height) & (height > -1e4), height, 1e9).astype(np.float32)
    level = cv2.dilate(known, window) - cv2.erode(known, window) < STEP_M
    at, beside = [], []
    for axis in (0, 1):
        step = np.abs(np.diff(grey, axis=axis))
        first, second = (np.delete(source, end, axis=axis) for end in (-1, 0))
        whole = (first > 0) & (second > 0) & np.delete(level, 0, axis=axis)
        change = whole & (first != second)
        at.append(step[change])
        beside.append(step[whole & _within(change, 4) & ~_within(change, 1)])
    steps, others = np.concatenate(at), np.concatenate(beside)
    return Seams(len(steps), float(steps.mean()), float(others.mean()))


def _within(cells: BoolArray, distance: int) -> BoolArray:
    return cv2.dilate(cells.astype(np.uint8), np.ones((2 * distance + 1,) * 2, np.uint8)) > 0


def opacity(workspace: Workspace) -> Opacity:
    """Return how the splat looks over black and over white."""
    model = read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    renderer = model_renderer(workspace, model, sfm, survey, backend="cpu")
    images, poses = renderer.images, renderer.poses
    images.build()
    backend = rasterizer("cpu")  # of the written splat, which says itself how it was trained
    coverage = TrainingCoverage(renderer)
    headline = headline_of(workspace)
    placed = solved_placement(model, survey, renderer.gaussians.means.numpy(), headline).file_from_model
    gaussians = read_gaussians(workspace.root / SPLAT)
    figures, alphas = [], []
    for camera in model.indices("test"):
        photo = torch.from_numpy(np.array(images.image(camera))).float() / 255
        used = torch.from_numpy(np.array(images.mask(camera)))
        covered = coverage.covered(camera)
        used = used if covered is None else used & covered
        height, width = used.shape
        middle = torch.zeros_like(used)
        middle[height // 6 : -(height // 6), width // 6 : -(width // 6)] = True
        used &= middle
        rotation = poses.cam_from_model[camera] @ placed.rotation.T
        center = placed.apply(poses.cam_center_in_model[camera][None])[0]
        pose = torch.from_numpy(pose_matrix(rotation, center)).float()
        exposure = model.cameras[camera].exposure
        with torch.no_grad():
            render = backend.render(gaussians, pose, renderer.images.pinhole(camera), RasterSettings())
        over = []
        for background in (0.0, 1.0):
            colour = render.colour + background * (1 - render.alpha)[..., None]
            if exposure is not None:
                colour = with_affine(colour, torch.tensor(exposure))
            over.append(psnr(colour.clamp(0, 1), photo, used))
        figures.append(over)
        alphas.append(render.alpha[used].numpy())
    black, white = np.mean(figures, axis=0)
    low, higher = np.quantile(np.concatenate(alphas), [0.01, 0.05])
    return Opacity(float(black), float(white), float(low), float(higher))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    workspace = Workspace(parser.parse_args().workspace)
    found = patches(workspace)
    for patch in found:
        print(
            f"{patch.name}: contrast {patch.contrast:.3f}, r {patch.correlation:.3f}, "
            f"seen {patch.oblique_deg:.0f}° from the vertical"
        )
    if found:
        contrast, correlation = np.array([(patch.contrast, patch.correlation) for patch in found]).T
        print(
            f"{len(found)} points: contrast {np.median(contrast):.3f} in the median, "
            f"{contrast.min():.3f} at least; "
            f"r {np.median(correlation):.3f} in the median, {correlation.min():.3f} at least"
        )
    if (workspace.path(ORTHOPHOTO).parent / "source.tif").exists():
        steps = seams(workspace)
        print(f"seams: {steps.cells} cells, steps of {steps.at:.2f} grey levels, {steps.beside:.2f} beside")
    if (workspace.root / SPLAT).exists():
        seen = opacity(workspace)
        print(
            f"opacity: {seen.black:.2f} dB over black, {seen.white:.2f} dB over white; 1 % of alpha is below "
            f"{seen.alpha_1_percent:.3f}, 5 % below {seen.alpha_5_percent:.3f}"
        )


if __name__ == "__main__":
    main()
