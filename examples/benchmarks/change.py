"""Change between two simulated surveys against the truth: `python examples/benchmarks/change.py OUT --help`.

For each seed, three flights over one town are simulated and reconstructed: the first, a later one after changes,
and a later one without any. Prints, for the changed pair, precision and recall of the significant cells, and the
volumes with their errors; for the unchanged pair the false alarms. What stands in OUT already is not made again.

With `--earlier`, the later flights are adjusted onto the first by points in common, without control points, and
nothing is registered: the difference of the unchanged ground is then stated with its σ, and with what a
registration would have found.

A cell has truly changed if its height differs by more than `--least`, and is to be found if it differs by more than
its level of detection too. Cells that both epochs measure count. The truth is looked up where the first survey sees
it: the error of its place on Earth, which both epochs share or which their registration leaves, is no change.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.ndimage import map_coordinates

from pipelines.core.products import load_json
from pipelines.core.types import FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.formats.geotiff import RasterFrame, raster_frame, read_cells
from pipelines.formats.vector_files import feature, features_text
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import ecef_from_enu, ecef_from_lla, enu_from_ecef, lla_from_ecef
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.simulate.stage import TRUE_HEIGHTS, TRUTH
from pipelines.simulate.truth import TrueChange, Truth
from pipelines.survey.area import ground_sampling_m
from pipelines.survey.change_report import Change
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_trained

EPOCHS: dict[str, Sequence[str]] = {
    "first": (),
    "changed": ("--epoch", "2"),
    "same": ("--epoch", "2", "--changes", "none"),
}
CHANGED = (2, 3)  # classes of significant.tif
_UNCHANGED_M = 0.001
_RIM_M = 1.5  # of the given polygons around the true outlines, beyond every error of a wall


@dataclass(frozen=True)
class VolumeError:
    """Net volume of a region, and the true one in its polygon; `name` R: found, P: given."""

    name: str
    kind: str
    net_m3: float
    true_m3: float
    sigma_m3: float

    @property
    def normalised(self) -> float:
        return (self.net_m3 - self.true_m3) / self.sigma_m3


@dataclass(frozen=True)
class PairFigures:
    """Figures of a seed; shares of one."""

    seed: int
    cell_m: float
    precision: float
    recall: float
    false_alarms: float
    doubtful: int
    regions_of_no_change: int
    volumes: tuple[VolumeError, ...]
    unmeasured: tuple[str, ...]
    lod_m: float
    gsd_m: float
    # Of the unchanged pair: what a registration finds (east, north, up), and σ of the difference, h and v.
    stable_shift_m: tuple[float, float, float]
    stable_sigma_m: tuple[float, float] | None
    # Of the changed pair: later minus earlier error of cameras, east and north; of unchanged ground, up (median).
    stable_error_m: tuple[float, float, float]
    common_points: int


def main() -> None:
    """Print a line a seed, and one a volume."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", default="5", help="seeds of the towns, with commas")
    parser.add_argument("--images", default="24", help="photographs of each flight")
    parser.add_argument("--size", default="480x360", help="of the photographs")
    parser.add_argument("--flights", default="", help="further options of georef simulate for all flights")
    parser.add_argument("--later", default="", help="and for the later ones, such as --common-error 0,0,0.03")
    parser.add_argument("--earlier", action="store_true", help="adjust the later flights onto the first")
    parser.add_argument("--no-control", action="store_true", help="reconstruct without the control points")
    parser.add_argument("--train", default="--preset fast --iterations 1200", help="options of georef run")
    parser.add_argument("--change", help="options of georef change; --stable-auto, or none with --earlier")
    parser.add_argument("--least", type=float, default=0.1, help="height in metres from which a cell has changed")
    parser.add_argument("--json", type=Path, help="file that keeps the figures")
    args = parser.parse_args()
    if args.change is None:
        args.change = "" if args.earlier else "--stable-auto"
    args.no_control |= args.earlier
    every: list[PairFigures] = []
    for seed in map(int, args.seeds.split(",")):
        figures = measured_pair(args, seed, args.out / f"seed_{seed}")
        every.append(figures)
        print(
            f"seed {seed}, cells of {figures.cell_m:.2f} m: precision {figures.precision:.3f}, recall "
            f"{figures.recall:.3f}, {figures.doubtful} doubtful regions; without change {figures.false_alarms:.2%} "
            f"false alarms, {figures.regions_of_no_change} regions; level of detection {figures.lod_m:.3f} m, GSD "
            f"{figures.gsd_m:.3f} m"
        )
        if figures.stable_sigma_m is not None:
            east, north, up = figures.stable_error_m
            print(
                f"  {figures.common_points} points in common; unchanged ground {east:+.3f}, {north:+.3f}, "
                f"{up:+.3f} m apart, by a registration {figures.stable_shift_m[2]:+.3f} m up, "
                f"σ {figures.stable_sigma_m[0]:.3f} m horizontal, {figures.stable_sigma_m[1]:.3f} m vertical"
            )
        for one in figures.volumes:
            print(
                f"  {one.name} {one.kind}: {one.net_m3:.1f} ± {one.sigma_m3:.1f} m³, true {one.true_m3:.1f} m³, "
                f"error/σ {one.normalised:+.1f}"
            )
        if figures.unmeasured:
            print(f"  without a volume, by the share that is known: {', '.join(figures.unmeasured)}")
    _print_all(every)
    if args.json:
        args.json.write_text(json.dumps([asdict(one) for one in every], indent=1) + "\n", "utf-8")


def _print_all(every: Sequence[PairFigures]) -> None:
    """Print the worst town of each figure, and the errors of all volumes over their σ."""
    ratios = [one.normalised for figures in every for one in figures.volumes if one.name.startswith("P")]
    apart = np.abs([one.stable_error_m for one in every]) / np.array([[one.gsd_m] for one in every])
    print(
        f"of {len(every)} towns at worst: precision {min(one.precision for one in every):.3f}, recall "
        f"{min(one.recall for one in every):.3f}, false alarms {max(one.false_alarms for one in every):.2%}, "
        f"level of detection {max(one.lod_m / one.gsd_m for one in every):.1f} GSD, unchanged ground "
        f"{apart[:, :2].max():.2f} GSD apart horizontally and {apart[:, 2].max():.2f} vertically; volumes in given "
        f"polygons: error/σ {np.sqrt(np.mean(np.square(ratios))):.2f} over {len(ratios)}"
    )


def measured_pair(args: argparse.Namespace, seed: int, folder: Path) -> PairFigures:
    """Make what is missing in a folder, and return the figures of its pairs."""
    for name, epoch in EPOCHS.items():
        survey, workspace = folder / f"survey_{name}", folder / name
        if not survey.exists():
            flight = ["--flight", "grid", "--images", args.images, "--size", args.size, "--seed", str(seed)]
            _georef(
                "simulate", survey, *flight, *epoch, *args.flights.split(), *(args.later.split() if epoch else ())
            )
        _georef(
            *("run", workspace, "--images", survey / "images", "--trajectory", survey / "trajectory.csv"),
            *(("--earlier", folder / "first") if args.earlier and epoch else ()),
            *("--vertical", "ellipsoidal", *(() if args.no_control else ("--gcp", survey / "gcp_list.txt"))),
            *(*args.train.split(), "--deliver", "raster"),
        )
    truth = load_json(Truth, folder / "survey_changed" / TRUTH)
    assert truth.change is not None
    polygons = folder / "polygons.geojson"
    true_from_seen = placing_error(folder)
    polygons.write_text(features_text(_true_polygons(truth, truth.change, true_from_seen.inverse())), "utf-8")
    _georef("change", folder / "first", folder / "changed", "--regions", polygons, *args.change.split())
    _georef("change", folder / "first", folder / "same", *args.change.split())
    classes = read_cells(folder / "changed/change/significant.tif")[0]
    difference = read_cells(folder / "changed/change/difference.tif")[0]
    lod = read_cells(folder / "changed/change/lod.tif")[0]
    risen = true_difference(truth, truth.change, folder, true_from_seen)
    counts = (classes > 0) & np.isfinite(risen)
    marked, changed = np.isin(classes, CHANGED) & counts, np.abs(risen) > args.least
    stable = counts & (np.abs(risen) < _UNCHANGED_M)
    change = load_json(Change, folder / "changed/change/change.json")
    still = read_cells(folder / "same/change/significant.tif")[0]
    same = load_json(Change, folder / "same/change/change.json")
    return PairFigures(
        seed=seed,
        cell_m=change.cell_m,
        precision=float(changed[marked].mean()),
        recall=float(marked[counts & changed & (np.abs(risen) > lod)].mean()),
        false_alarms=float(np.isin(still[still > 0], CHANGED).mean()),
        doubtful=len(change.doubtful),
        regions_of_no_change=len(same.regions),
        volumes=tuple(_volume_errors(truth, change, folder, true_from_seen, risen)),
        unmeasured=tuple(f"{name} ({share:.0%})" for name, share in change.unmeasured.items()),
        lod_m=change.median_lod_m,
        gsd_m=_ground_sampling_m(Workspace(folder / "first")) or float("nan"),
        stable_shift_m=same.registration.shift_m,
        stable_sigma_m=None if same.common is None else (same.common.sigma_h_m, same.common.sigma_v_m),
        stable_error_m=(*_camera_error(folder)[:2], float(np.median((difference - risen)[stable]))),
        common_points=0 if same.common is None else same.common.used,
    )


def _ground_sampling_m(workspace: Workspace) -> float | None:
    model = read_trained(workspace)
    return ground_sampling_m(model, read_sfm(workspace, model))


def placing_error(folder: Path) -> Similarity:
    """Return what moves places as the first survey sees them to where they are, in the `geo` of the truth."""
    return umeyama(*_cameras(folder, "first"))


def _cameras(folder: Path, epoch: str) -> tuple[FloatArray, FloatArray]:
    """Return the solved and the true centres (N, 3) of an epoch's cameras, in the `geo` of the truth."""
    truth, workspace = load_json(Truth, folder / f"survey_{epoch}" / TRUTH), Workspace(folder / epoch)
    solution, survey = read_trained(workspace), load_survey(workspace)
    center = dict(zip(truth.images, truth.centers, strict=True))
    seen = enu_from_ecef(ecef_from_enu(solution.center_in_geo, survey.origin_on_earth), truth.origin)
    return seen, np.array([center[camera.name] for camera in solution.cameras])


def _camera_error(folder: Path) -> tuple[float, float, float]:
    """Return the mean error (east, north, up) of the later cameras, less that of the first survey there."""
    true_from_seen, (seen, true) = placing_error(folder), _cameras(folder, "changed")
    east, north, up = (true_from_seen.apply(seen) - true).mean(axis=0).tolist()
    return east, north, up


def true_difference(truth: Truth, change: TrueChange, folder: Path, true_from_seen: Similarity) -> FloatArray:
    """Return the true later minus earlier height (H, W) in metres of the cells of a comparison; NaN: not known."""
    frame = raster_frame(folder / "changed/change/difference.tif")
    row, column = np.indices((frame.rows, frame.columns)).reshape(2, -1)
    geo = _in_geo(truth, frame, row, column, true_from_seen)
    heights = np.load(folder / "survey_changed" / TRUE_HEIGHTS)
    place = [(geo[:, axis] - change.corner[axis]) / change.cell_m - 0.5 for axis in (1, 0)]
    risen = map_coordinates(heights["after"] - heights["before"], place, order=0, cval=np.nan)
    return np.asarray(risen.reshape(frame.rows, frame.columns), dtype=np.float64)


def _true_polygons(truth: Truth, change: TrueChange, seen_from_true: Similarity) -> list[dict[str, Any]]:
    """Return the outlines of the true changes with a rim, where the first survey sees them, in WGS84."""
    found = []
    for region in change.regions:
        ring = np.array(shapely.Polygon(region.outline).buffer(_RIM_M).exterior.coords)
        seen = seen_from_true.apply(np.column_stack([ring, np.zeros(len(ring))]))
        lla = lla_from_ecef(ecef_from_enu(seen, truth.origin))
        shape = shapely.geometry.mapping(shapely.Polygon(lla[:, [1, 0]]))
        found.append(feature(shape, {"kind": region.kind}))
    return found


def _volume_errors(
    truth: Truth, found: Change, folder: Path, true_from_seen: Similarity, risen: FloatArray
) -> list[VolumeError]:
    """Return the volumes of all regions, and the true ones of their cells with a height of both epochs.

    What an epoch has not measured is in no volume, as `known_share` says. `risen` (H, W) is the true difference.
    """
    assert truth.change is not None
    regions = json.loads((folder / "changed/change/regions.geojson").read_text("utf-8"))["features"]
    difference = folder / "changed/change/difference.tif"
    frame, known = raster_frame(difference), np.isfinite(read_cells(difference)[0]) & np.isfinite(risen)
    row, column = np.nonzero(known)
    cells = _in_geo(truth, frame, row, column, true_from_seen)
    errors = []
    for one, region in zip(regions, found.regions, strict=True):
        outline = shapely.transform(
            shapely.geometry.shape(one["geometry"]),
            lambda lon_lat: true_from_seen.apply(
                enu_from_ecef(
                    ecef_from_lla(np.column_stack([lon_lat[:, ::-1], np.full(len(lon_lat), truth.origin.alt_m)])),
                    truth.origin,
                )
            )[:, :2],
        )
        inside = shapely.contains_xy(outline, *cells.T)
        true_m3 = float(risen[row, column][inside].sum()) * found.cell_m**2
        kinds = [each.kind for each in truth.change.regions if shapely.Polygon(each.outline).intersects(outline)]
        kind = " and ".join(kinds) or "no change"
        errors.append(VolumeError(region.name, kind, region.net_m3, true_m3, region.sigma_m3))
    return errors


def _in_geo(
    truth: Truth, frame: RasterFrame, row: IntArray, column: IntArray, true_from_seen: Similarity
) -> FloatArray:
    """Return east and north (K, 2) in the `geo` of the truth of cells of a raster of the first survey."""
    plan = [frame.west + (column + 0.5) * frame.step_x, frame.north - (row + 0.5) * frame.step_y]
    lla = parse_crs(frame.wkt).lla_from_xyz(np.column_stack([*plan, np.zeros(len(row))]))
    lla[:, 2] = truth.origin.alt_m
    return true_from_seen.apply(enu_from_ecef(ecef_from_lla(lla), truth.origin))[:, :2]


def _georef(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "georef_cli", *map(str, words)], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
