"""The page of a comparison, `change.html`: figures, map, regions, profiles, and both epochs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from pipelines import __version__
from pipelines.change.grid import LOWERED, RAISED, UNCHANGED, WINDOW_PX, CommonGrid
from pipelines.change.renders import render_pair
from pipelines.change.tied import Tied
from pipelines.core.products import Remark
from pipelines.core.progress import Progress
from pipelines.core.types import ByteArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.geotiff import RasterFrame, raster_frame, read_cells, read_colours_onto, read_onto
from pipelines.report.page import Page, Picture, Section, moment, picture_of, picture_of_png
from pipelines.report.plots.changes import (
    ChangeProfile,
    change_picture,
    difference_histogram,
    inside_parts,
    profile_chart,
    scale_colours,
)
from pipelines.report.plots.charts import round_up
from pipelines.report.plots.plans import nice_number
from pipelines.survey.change_report import Change

_MAP_PX, _PROFILE_PX = 1200, 1600
_MOST_SAMPLES = 1_000_000
_PROFILES, _PROFILE_POINTS, _MOST_NUMBERS = 5, 400, 60
_BEYOND, _LEAST_BEYOND_M = 0.3, 2.0  # of a profile on each side of its region: share of its length, and least
_UNCOVERED = 205.0  # grey of what an orthophoto does not show
_SIMPLIFIED = 0.6  # pixels
_BAR_SHARE = 0.25
_FULL_COLOUR = 0.5  # quantile of the significant differences that has full colour
_STEPS = 4


@dataclass(frozen=True)
class Compared:
    """Comparison whose page is made.

    Attributes:
        folder: of the rasters that the comparison has written.
        polygons, doubtful_polygons: of the regions of `change`, and of the doubtful ones, in the CRS.
        workspaces: of the earlier and the later epoch.
    """

    folder: Path
    change: Change
    polygons: list[Any]
    grid: CommonGrid
    workspaces: tuple[Workspace, Workspace]
    tied: Tied | None = None
    doubtful_polygons: Sequence[Any] = ()

    @property
    def names(self) -> tuple[str, str]:
        before, after = (one.root.name for one in self.workspaces)
        return (before, after) if before != after else (f"{before} (earlier)", f"{after} (later)")

    @property
    def largest(self) -> list[int]:
        """Indices of the regions, the largest net volume first."""
        regions = self.change.regions
        return sorted(range(len(regions)), key=lambda index: -abs(regions[index].net_m3))

    def reduced(self) -> RasterFrame:
        """Return the frame of the comparison at the size of the page."""
        return _limited(self.grid.frame, _MAP_PX)


@dataclass(frozen=True)
class ChangeSummaryFacts:
    """Figures at the top, and what limits them: of which epoch, or of none, and a sentence."""

    names: tuple[str, str]
    applied: bool
    found: int
    given: int
    remarks: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Outline:
    """Region on the map: name, outline as the path of an SVG, and the place (x, y) of the name in pixels."""

    name: str
    path: str
    x: float
    y: float


@dataclass(frozen=True)
class MapFacts:
    """Map of the change with outlines over it; `bar_px` is the scale bar's length, that stands for `bar_m`.

    `points` are the points in common, (x, y) in pixels, and whether each agrees with the others.
    """

    picture: Picture
    outlines: tuple[Outline, ...]
    colours: tuple[str, ...]
    limit_m: float
    bar_px: float
    bar_m: float
    points: tuple[tuple[float, float, bool], ...] = ()
    doubtful: tuple[Outline, ...] = ()


@dataclass(frozen=True)
class ProfileFacts:
    """Profile through a region."""

    name: str
    index: int
    picture: Picture


@dataclass(frozen=True)
class PairFacts:
    """Two pictures of one view, the earlier first; None: there is none, for the `reason`."""

    names: tuple[str, str]
    pictures: tuple[Picture, Picture] | None
    reason: str
    about: str


def change_page(
    compared: Compared, warnings: tuple[Remark, ...], cautions: tuple[tuple[Remark, ...], ...], progress: Progress
) -> Page:
    """Return the page of a comparison, with its warnings, and with the cautions of each epoch.

    Raises as `render_pair`.
    """
    change = compared.change
    with progress.task("page", _STEPS) as task:
        seen = map_facts(compared)
        task.advance(note="map")
        histogram = histogram_picture(compared)
        profiles = profile_facts(compared)
        task.advance(note="profiles")
        photographs = orthophoto_facts(compared)
        task.advance(note="orthophotos")
        renders = render_facts(compared, progress)
        task.advance(note="renders")
    before, after = compared.names
    given = sum(region.name.startswith("P") for region in change.regions)
    remarks = [("", remark.sentence) for remark in warnings]
    remarks += [
        (f"{name}: ", remark.sentence) for name, own in zip(compared.names, cautions, strict=True) for remark in own
    ]
    summary = ChangeSummaryFacts(
        compared.names, change.registration.applied, len(change.regions) - given, given, tuple(remarks)
    )
    return Page(
        title=f"Change: {before} to {after}",
        subtitle=f"Difference of two {'surfaces' if change.of == 'surface' else 'terrain models'}, its level of "
        "detection, and what has changed",
        about={
            "Made": moment(datetime.now(UTC)),
            "Program": f"GeoRefGS {__version__}",
            "Earlier": before,
            "Later": after,
            "CRS": change.crs,
        },
        sections=(
            Section("summary", "Summary", "summary_of_change.html", summary),
            Section("map", "Map", "map.html", seen),
            Section("regions", "Regions", "regions.html", summary),
            *((Section("by-date", "Volumes by date", "by_date.html", change),) if change.by_date else ()),
            Section("profiles", "Profiles", "profiles.html", profiles),
            Section("orthophotos", "Before and after", "pair.html", photographs),
            Section("renders", "Both models from one camera", "pair.html", renders),
            Section("differences", "Differences", "differences.html", histogram),
        ),
        document=change.model_dump(mode="json"),
        script=resources.files(__package__).joinpath("templates/slider.js").read_text("utf-8"),
    )


def map_facts(compared: Compared) -> MapFacts:
    """Return the map, with the largest regions numbered."""
    frame, grid = compared.reduced(), compared.grid
    later, cell_m = grid.rasters[1], frame.step_x * grid.unit_m
    height = read_onto(later.folder / later.names[0], frame, "average") * later.unit_m
    difference = read_onto(compared.folder / "difference.tif", frame, "average")
    significant = np.isin(read_onto(compared.folder / "significant.tif", frame, "nearest"), (LOWERED, RAISED))
    beyond = np.abs(difference[significant & np.isfinite(difference)])
    limit_m = round_up(
        float(np.quantile(beyond, _FULL_COLOUR)) if len(beyond) else 3 * compared.change.median_lod_m
    )
    pixels = change_picture(height, difference, significant, cell_m, limit_m)
    outlines = tuple(
        _outline(compared.change.regions[index].name, compared.polygons[index], frame)
        for index in compared.largest[:_MOST_NUMBERS]
    )
    doubtful = tuple(
        _outline(region.name, polygon, frame)
        for region, polygon in zip(compared.change.doubtful, compared.doubtful_polygons, strict=True)
    )
    bar_m = nice_number(_BAR_SHARE * frame.columns * cell_m)
    points = common_on_map(compared, frame)
    return MapFacts(picture_of(pixels), outlines, scale_colours(), limit_m, bar_m / cell_m, bar_m, points, doubtful)


def common_on_map(compared: Compared, frame: RasterFrame) -> tuple[tuple[float, float, bool], ...]:
    """Return the points in common (x, y) in pixels of a picture over a frame, and whether each is used."""
    if compared.tied is None:
        return ()
    plan = compared.grid.crs.xyz_from_lla(compared.tied.lla())[:, :2]
    x, y = (plan[:, 0] - frame.west) / frame.step_x, (frame.north - plan[:, 1]) / frame.step_y
    inside = (x >= 0) & (x <= frame.columns) & (y >= 0) & (y <= frame.rows)
    used = compared.tied.used
    return tuple(zip(x[inside].tolist(), y[inside].tolist(), used[inside].tolist(), strict=True))


def _outline(name: str, polygon: shapely.Geometry, frame: RasterFrame) -> Outline:
    """Return the outline of a polygon of the CRS in pixels of a picture over a frame."""

    def moved(plan: FloatArray) -> NDArray[Any]:
        return np.column_stack(
            [(plan[:, 0] - frame.west) / frame.step_x, (frame.north - plan[:, 1]) / frame.step_y]
        )

    shape = shapely.transform(shapely.force_2d(polygon), moved).simplify(_SIMPLIFIED)
    parts = [part for part in getattr(shape, "geoms", [shape]) if part.geom_type == "Polygon"]
    rings = [np.array(ring.coords) for part in parts for ring in (part.exterior, *part.interiors)]
    path = " ".join(f"M{' '.join(f'{x:.1f},{y:.1f}' for x, y in ring.tolist())}Z" for ring in rings)
    middle = max(parts, key=lambda part: part.area).representative_point() if parts else shapely.Point(0, 0)
    x, y = np.clip([middle.x, middle.y], 0, [frame.columns, frame.rows]).tolist()
    return Outline(name, path, x, y)


def histogram_picture(compared: Compared) -> Picture:
    """Return the histogram of a sample of all cells that both epochs have measured."""
    difference, classes = sampled(compared.folder / "difference.tif"), sampled(compared.folder / "significant.tif")
    known = np.isfinite(difference) & (classes > 0)
    is_changed = np.isin(classes, (LOWERED, RAISED))
    stable, changed = difference[known & (classes == UNCHANGED)], difference[known & is_changed]
    lod_m = compared.change.median_lod_m
    widest = max([float(np.quantile(np.abs(part), 0.98)) for part in (stable, changed) if len(part)], default=0.0)
    return picture_of_png(difference_histogram(stable, changed, lod_m, round_up(max(widest, 2 * lod_m))))


def sampled(path: Path) -> NDArray[Any]:
    """Return the values (N,) of a regular sample of all cells of a raster, read by windows."""
    frame = raster_frame(path)
    step = max(int(np.ceil(np.sqrt(frame.rows * frame.columns / _MOST_SAMPLES))), 1)
    rows = range(0, frame.rows, WINDOW_PX)
    parts = []
    for top in rows:
        part = slice(top, min(top + WINDOW_PX, frame.rows)), slice(0, frame.columns)
        parts.append(read_cells(path, part)[0, ::step, ::step].ravel())
    return np.concatenate(parts)


def profile_facts(compared: Compared) -> tuple[ProfileFacts, ...]:
    """Return profiles along the longer axis of the largest regions, the largest first."""
    facts = []
    for index in compared.largest[:_PROFILES]:
        profile = profile_through(compared, compared.polygons[index])
        picture = picture_of_png(profile_chart(profile, compared.names))
        facts.append(ProfileFacts(compared.change.regions[index].name, index, picture))
    return tuple(facts)


def profile_through(compared: Compared, polygon: shapely.Geometry) -> ChangeProfile:
    """Return the heights of both epochs, the later one after registration, along the longer axis of a polygon."""
    grid = compared.grid
    line = _line_through(polygon, grid.unit_m)
    low, high = line.min(axis=0), line.max(axis=0)
    frame = _around(grid.frame, low, high)
    column = np.clip((line[:, 0] - frame.west) / frame.step_x, 0, frame.columns - 1).astype(np.int64)
    row = np.clip((frame.north - line[:, 1]) / frame.step_y, 0, frame.rows - 1).astype(np.int64)
    heights, sigmas = [], []
    for one in grid.rasters:
        heights.append(read_onto(one.folder / one.names[0], frame, "bilinear")[row, column] * one.unit_m)
        sigmas.append(read_onto(one.folder / one.names[1], frame, "bilinear")[row, column])
    difference = read_onto(compared.folder / "difference.tif", frame, "bilinear")[row, column]
    distance = np.linalg.norm(line - line[0], axis=1) * grid.unit_m
    inside = np.asarray(shapely.contains_xy(polygon, line[:, 0], line[:, 1]))
    later = np.where(np.isfinite(difference), heights[0] + difference, np.nan)
    return ChangeProfile(distance, np.stack([heights[0], later]), np.stack(sigmas), inside_parts(distance, inside))


def _line_through(polygon: shapely.Geometry, unit_m: float) -> FloatArray:
    """Return points (N, 2) on the longer axis of a polygon, through its middle and beyond both ends."""
    box = shapely.minimum_rotated_rectangle(shapely.force_2d(polygon))
    corner = np.array(getattr(box, "exterior", box).coords)
    sides = np.diff(corner, axis=0)
    along = sides[np.argmax(np.linalg.norm(sides, axis=1))] if len(sides) else np.array([1.0, 0.0])
    length = max(float(np.linalg.norm(along)), 1e-6)
    middle = np.array(box.centroid.coords[0])
    half = length / 2 + max(_BEYOND * length, _LEAST_BEYOND_M / unit_m)
    ends = np.linspace(-half, half, _PROFILE_POINTS)
    direction = along / length * (1 if along[0] >= 0 else -1)  # from west to east
    return np.asarray(middle + ends[:, None] * direction)


def _around(frame: RasterFrame, low: FloatArray, high: FloatArray) -> RasterFrame:
    """Return the part of a frame around places between two corners (2,), with larger cells if these are many."""
    left, top = (low[0] - frame.west) / frame.step_x, (frame.north - high[1]) / frame.step_y
    right, bottom = (high[0] - frame.west) / frame.step_x, (frame.north - low[1]) / frame.step_y
    column, row = (int(np.floor(value)) for value in (left, top))
    part = frame.part(column, row, int(np.ceil(right)) - column + 1, int(np.ceil(bottom)) - row + 1)
    return _limited(part, _PROFILE_PX)


def _limited(frame: RasterFrame, longest_px: int) -> RasterFrame:
    factor = max(max(frame.columns, frame.rows) / longest_px, 1.0)
    return frame.resized(max(round(frame.columns / factor), 1), max(round(frame.rows / factor), 1))


def orthophoto_facts(compared: Compared) -> PairFacts:
    """Return the orthophotos of both epochs over the area of the comparison."""
    frame, names = compared.reduced(), compared.names
    paths = [one.folder / "orthophoto.tif" for one in compared.grid.rasters]
    if not all(path.is_file() for path in paths):
        return PairFacts(names, None, "One of the epochs has no orthophoto.", "")
    before, after = (picture_of(_on_grey(read_colours_onto(path, frame))) for path in paths)
    return PairFacts(names, (before, after), "", "Orthophotos of both epochs over the same area, north up.")


def _on_grey(pixels: ByteArray) -> ByteArray:
    """Return colours (H, W, 3) of a picture whose further band, if there is one, is its opacity."""
    if pixels.shape[2] < 4:
        return np.ascontiguousarray(np.broadcast_to(pixels[..., :1], (*pixels.shape[:2], 3)))
    alpha = pixels[..., 3:4] / np.float32(255)
    return np.asarray((pixels[..., :3] * alpha + _UNCOVERED * (1 - alpha)).round().astype(np.uint8))


def render_facts(compared: Compared, progress: Progress) -> PairFacts:
    """Return renders of both models from the camera of the earlier epoch that looks at the largest change."""
    names, grid = compared.names, compared.grid
    west, south, east, north = grid.frame.bounds
    middle = (
        compared.polygons[compared.largest[0]].representative_point()
        if compared.largest
        else shapely.Point((west + east) / 2, (south + north) / 2)
    )
    pair = render_pair(compared.workspaces, grid, (middle.x, middle.y), progress)
    if isinstance(pair, str):
        return PairFacts(names, None, pair, "")
    about = f"Gaussians of both epochs, rendered from the camera of photograph {pair.camera} of the earlier one."
    return PairFacts(names, (picture_of(pair.before), picture_of(pair.after)), "", about)
