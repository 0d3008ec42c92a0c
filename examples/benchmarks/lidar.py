"""Surface of a simulated flight with and without measured geometry: `lidar.py OUT --help`.

    lidar.py OUT --seeds 0,1,2,3,4 --size 1200x900 --train "--preset fast --max-image-size 640"

Of each seed, the survey is simulated and reconstructed once. Trainings in OUT/seedN are then compared with the true
scene: without LiDAR; with a cloud of 2 cm; with the scanner's track, too; with Gaussians held, or rendered depths,
instead of both; and with a cloud that shows a building that has been removed since. `e57` is that cloud as two
scans with poses, `depth maps` are what a depth camera of 2 cm in the place of each photograph would measure.

Pixels of the test views, and of every fourth training view, are intersected with the true scene. They count if the
unchanged cloud has a point within 0.3 m of that place. `wall`, `roof` and `ground` are medians of the distance
between the rendered and the true surface, perpendicular to the latter, in metres; `wall > 1 m` is the share of the
walls' pixels beyond one metre, which the medians leave out; `check walls` is the median error of check points on
walls. `held-out` is the median of all classes in the test views alone, of which no depth map is used.

The registration is measured on the unchanged cloud: `shift error` is the largest component of what it finds for
that cloud, and `of 0.1 m` the largest difference between 0.1 m and what is found for it, added along each axis.
`building rejected` is the share of rejected points on the removed building, which are those further than 0.5 m from
the unchanged cloud, and `others rejected` that of all others. What stands in OUT already is not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.products import load_json
from pipelines.core.progress import SILENT
from pipelines.core.stages import BY_NAME, REPORT
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geodesy.enu import ecef_from_enu, enu_from_ecef
from pipelines.geometry.cameras import Camera, undistort
from pipelines.simulate.lidar import LidarFlight
from pipelines.simulate.mesh import MISS, Material, Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import RecordedFlight, fly_survey, write_lidar_flight
from pipelines.simulate.truth import Truth
from pipelines.surface.depth_maps import DepthMaps
from pipelines.surface.measured_cloud import CloudReader
from pipelines.surface.surface_views import model_renderer
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CloudCrs
from pipelines.survey.report import read_report
from pipelines.survey.scene import load_solved_scene, photographs
from pipelines.survey.solution import read_sfm, read_trained
from pipelines.train.lidar import compared_lidar, lidar_surface, registration_of
from pipelines.train.options import TrainOptions
from pipelines.train.stage import measured_files
from tests.geometry_files import ScanFile, write_e57

CLASSES = {
    "wall": (Material.WALL,),
    "roof": (Material.TILES, Material.FLAT_ROOF),
    "ground": (Material.TERRAIN,),
}
# Name of the training, the change since the LiDAR flight (None: without LiDAR), and options.
TRAININGS: dict[str, tuple[str | None, tuple[str, ...]]] = {
    "photographs": (None, ()),
    "lidar": ("none", ()),
    "lidar, track": ("none", ("--lidar-trajectory",)),
    "lidar, gaussians": ("none", ("--lidar-loss", "gaussians")),
    "lidar, depth": ("none", ("--lidar-loss", "depth")),
    "lidar, removed": ("removed", ()),
    "e57": ("none", ()),
    "e57, removed": ("removed", ()),
    "depth maps": ("none", ("--depth-unit", "0.002", "--depth-along", "axis")),
    "depth maps, removed": ("removed", ("--depth-unit", "0.002", "--depth-along", "axis")),
}
DEPTH_STEP_M = 0.002
STRIDE, EVERY = 2, 4  # of the pixels, and of the training views
COVERED_M = 0.3
NEAR_M = 1.0  # a larger distance is another surface
BUILDING_M = 0.5


def main() -> None:
    """Simulate, train, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--images", type=int, default=48)
    parser.add_argument("--size", default="960x720")
    parser.add_argument("--radius", default=140, type=float, help="half side of the scanned square, in metres")
    parser.add_argument("--density", default=40, type=float, help="returns for a square metre of level ground")
    parser.add_argument("--train", default="--preset fast", help="options of the trainings")
    parser.add_argument("--trainings", default=";".join(TRAININGS), help="separated by ;")
    arguments = parser.parse_args()
    rows = []
    for seed in arguments.seeds.split(","):
        for name in arguments.trainings.split(";"):
            row = measured(int(seed), name, arguments)
            print(json.dumps(row), flush=True)
            rows.append(row)
    print_medians(rows)


def measured(seed: int, name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """The figures of one training."""
    home, (change, options) = arguments.out / f"seed{seed}", TRAININGS[name]
    given = {"images": arguments.images, "size": arguments.size, "seed": seed, "lidar_radius": arguments.radius}
    given["lidar_density"] = arguments.density
    flight = fly_survey(SimulateOptions.model_validate(given))
    survey, base = home / "survey", home / "reconstruction"
    if not survey.exists():
        georef("simulate", survey, "--images", arguments.images, "--size", arguments.size, "--seed", seed)
    if not (base / "sim3").exists():
        files = ("--images", survey / "images", "--trajectory", survey / "trajectory.csv")
        checks = ("--gcp", survey / "gcp_list.txt", "--checkpoints", survey / "checkpoints.txt")
        georef("run", base, *files, *checks, "--vertical", "ellipsoidal", "--to", "init-sim3")
    workspace = home / name.replace(", ", "_")
    if not (workspace / "evaluate").exists():
        subprocess.run(["cp", "-rn", f"{base}/.", str(workspace)], check=True)
        lidar: tuple[Any, ...] = ()
        if change is not None:
            cloud = geometry_of(name, flight, given, home, change)
            track = (cloud.with_name("lidar_trajectory.csv"),) if "--lidar-trajectory" in options else ()
            lidar = ("--lidar", cloud, "--lidar-sigma", "0.02", *options, *track)
        georef("train", workspace, *arguments.train.split(), *lidar)
        georef("evaluate", workspace)
    cloud = cloud_of(flight, given, home, "none")
    row = {"seed": seed, "training": name, **figures(Workspace(workspace), flight, survey, cloud)}
    if change is not None:
        row |= comparison(
            Workspace(workspace), flight, cloud, geometry_of(name, flight, given, home, change), change != "none"
        )
    return row


def geometry_of(name: str, flight: RecordedFlight, given: dict[str, Any], home: Path, change: str) -> Path:
    """The measured geometry of a training, written if it is not there yet."""
    if name.startswith("depth maps"):
        return depth_maps_of(flight, given, home / f"depths_{change}", change)
    cloud = cloud_of(flight, given, home, change)
    return e57_of(cloud, flight) if name.startswith("e57") else cloud


def e57_of(cloud: Path, flight: RecordedFlight) -> Path:
    """The cloud as two scans with poses, in Earth-centred coordinates."""
    path = cloud.with_suffix(".e57")
    if not path.exists():
        chunks = list(CloudReader(cloud, CloudCrs()).chunks(flight.world.origin))
        points = ecef_from_enu(np.concatenate([chunk.position_in_geo for chunk in chunks]), flight.world.origin)
        middle, half = points.mean(axis=0).round(), len(points) // 2
        quat = (np.cos(0.3), 0.0, 0.0, np.sin(0.3))
        write_e57(
            path, [ScanFile(points[:half], quat, middle), ScanFile(points[half:], center=middle)], crs="EPSG:4978"
        )
    return path


def depth_maps_of(flight: RecordedFlight, given: dict[str, Any], folder: Path, change: str) -> Path:
    """Depth maps of all photographs from their true places, as PNG of 16 bits, with noise of 2 cm along the ray."""
    if folder.exists():
        return folder
    options = SimulateOptions.model_validate({**given, "lidar_change": change})
    rays = Raycaster(LidarFlight(options, flight.world.scene, flight.lidar_seed).mesh)
    truth, rng = flight.recording.truth, np.random.default_rng(0)
    camera = Camera(truth.lens.model, truth.lens.width, truth.lens.height, np.array(truth.lens.params))
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    slope = undistort(camera, np.stack([x, y], axis=-1).reshape(-1, 2))
    in_cam = np.column_stack([slope, np.ones(len(slope))])
    length = np.linalg.norm(in_cam, axis=1)
    draft = folder.with_name(folder.name + ".partial")
    draft.mkdir(parents=True, exist_ok=True)
    for name, center, turn in zip(truth.images, truth.centers, truth.cam_from_enu, strict=True):
        direction = (in_cam / length[:, None]) @ np.array(turn)
        hits = rays.first_hits(np.array(center), direction)
        true_m = rays.exact_distance(np.array(center), direction, hits)
        depth = np.where(hits.triangle == MISS, 0.0, true_m + rng.normal(0, 0.02, len(true_m))) / length
        counts = np.rint(np.nan_to_num(depth) / DEPTH_STEP_M)
        counts = np.where((counts > 0) & (counts < 65535), counts, 0).astype(np.uint16)  # the range of the camera
        cv2.imwrite(str((draft / name).with_suffix(".png")), counts.reshape(camera.height, camera.width))
    draft.rename(folder)
    return folder


def cloud_of(flight: RecordedFlight, given: dict[str, Any], home: Path, change: str) -> Path:
    """The cloud of a LiDAR flight, written if it is not there yet."""
    folder = home / f"cloud_{change}"
    if not (folder / "lidar.laz").exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_lidar_flight(SimulateOptions.model_validate({**given, "lidar_change": change}), flight, folder)
    return folder / "lidar.laz"


def figures(workspace: Workspace, flight: RecordedFlight, survey: Path, cloud: Path) -> dict[str, Any]:
    """Medians of the surface's errors by class, and the figures of `evaluate`."""
    report, truth = read_report(workspace.path(REPORT)), load_json(Truth, survey / "truth.json")
    on_surface, views = report.checkpoints.surface, report.test_views
    assert on_surface is not None and views is not None
    on_wall = {target.name for target in truth.targets if target.surface == "wall"}
    walls = [point for point in on_surface.points if point.name in on_wall and point.de_m is not None]
    errors = [np.linalg.norm([point.de_m or 0.0, point.dn_m or 0.0, point.du_m or 0.0]) for point in walls]
    distance, material, is_test = surface_errors(workspace, flight, cloud)
    near = np.abs(distance) < NEAR_M
    by_class = {
        kind: round(float(np.median(np.abs(distance[near & np.isin(material, materials)]))), 4)
        for kind, materials in CLASSES.items()
    }
    return {
        **by_class,
        "wall bias": round(float(np.median(distance[near & (material == Material.WALL)])), 4),
        "wall > 1 m": round(float(1 - near[material == Material.WALL].mean()), 4),
        "held-out": round(float(np.median(np.abs(distance[near & is_test]))), 4),
        "check walls": round(float(np.median(errors)), 4) if errors else None,
        "test PSNR": views.psnr,
    }


def comparison(
    workspace: Workspace, flight: RecordedFlight, unchanged: Path, used: Path, changed: bool
) -> dict[str, Any]:
    """Errors of the registration, and shares of rejected points, by the stage's own functions."""
    manifest = workspace.manifest(BY_NAME["train"])
    assert manifest is not None
    options = TrainOptions.model_validate(manifest.config)
    solution, survey, scene = load_solved_scene(workspace)
    images = photographs(scene.sparse, survey, workspace, options.effort.max_image_size)
    images.build(SILENT)
    maps, files = DepthMaps(workspace.cache / "surface", scene, images), measured_files(options, scene)
    assert files is not None
    maps.build(SILENT)
    compared = compared_lidar(
        options, files, maps, survey,
        track=None, georeference=solution.geo_from_model, seed=options.seed, progress=SILENT,
    )  # fmt: skip
    if not changed:
        found = compared.registration.shift_m
        off = []
        for axis in 0.1 * np.eye(3):
            moved = compared.cloud.moved(axis)
            again = registration_of(moved, compared.surface_in_model, compared.views, options.seed)
            off.append(np.abs(again.shift_m - found - axis).max())
        return {"shift error": round(float(np.abs(found).max()), 4), "of 0.1 m": round(float(max(off)), 4)}
    judged = lidar_surface(compared, files, survey, options, None)
    in_geo = scene.geo_from_model.apply(judged.cloud.position_in_model)
    place = enu_from_ecef(ecef_from_enu(in_geo, survey.origin_on_earth), flight.world.origin)
    gap, _ = points_of(unchanged, flight).query(place, distance_upper_bound=BUILDING_M)
    building, rejected = np.isinf(gap), judged.verdict.rejected
    shares = {"building rejected": rejected[building], "others rejected": rejected[~building]}
    return {name: round(float(mask.mean()), 4) for name, mask in shares.items()}


def points_of(cloud: Path, flight: RecordedFlight) -> cKDTree:
    """Points of a cloud, in the frame of the flight's world."""
    chunks = CloudReader(cloud, CloudCrs()).chunks(flight.world.origin)
    return cKDTree(np.concatenate([chunk.position_in_geo for chunk in chunks]))


def surface_errors(
    workspace: Workspace, flight: RecordedFlight, cloud: Path
) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """Rendered minus true surface where the cloud covers it, along the outward normal (K,), and materials (K,).

    The last array (K,) says which pixels are of test views.
    """
    covered, model = points_of(cloud, flight), read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    renderer = model_renderer(workspace, model, sfm, survey)
    mesh, origin = flight.world.scene.mesh, flight.world.origin
    rays = Raycaster(mesh)
    distances, materials, tests = [], [], []
    shown: dict[str, list[int]] = {"test": [], "train": []}
    for index, camera in enumerate(model.cameras):
        shown[camera.split].append(index)
    for index in [*shown["test"], *shown["train"][::EVERY]]:
        pose = renderer.pose(index)
        depth = renderer.depth_m(index)[::STRIDE, ::STRIDE]
        row, column = np.nonzero(depth)
        pixel = STRIDE * np.stack([column, row], axis=1) + 0.5
        ray = pose.pinhole.rays(pixel) @ pose.cam_from_model
        place = pose.center_in_model + depth[row, column, None] * ray
        in_model = np.concatenate([pose.center_in_model[None], place])
        in_geo = model.similarity.apply(in_model)
        true_frame = enu_from_ecef(ecef_from_enu(in_geo, survey.origin_on_earth), origin)
        center, place = true_frame[0], true_frame[1:]
        direction = (place - center) / np.linalg.norm(place - center, axis=1, keepdims=True)
        hits = rays.first_hits(center, direction)
        true_m = rays.exact_distance(center, direction, hits)
        slant = np.abs(np.einsum("ni,ni->n", mesh.normals[hits.triangle, 0], direction))
        found = np.flatnonzero(hits.triangle != MISS)
        gap, _ = covered.query(center + true_m[found, None] * direction[found], distance_upper_bound=COVERED_M)
        found = found[np.isfinite(gap)]
        off = (true_m - np.linalg.norm(place - center, axis=1)) * slant
        distances.append(off[found])
        materials.append(np.asarray(mesh.material)[hits.triangle[found]])
        tests.append(np.full(len(found), index in shown["test"]))
    return np.concatenate(distances), np.concatenate(materials), np.concatenate(tests)


def georef(command: str, workspace: Path, *options: Any) -> None:
    """Run a command of georef."""
    program = [sys.executable, "-c", "from georef_cli.main import main; main()"]
    arguments = [command, str(workspace), *map(str, options)]
    if subprocess.run([*program, *arguments], stdout=subprocess.DEVNULL, check=False).returncode:
        sys.exit(f"georef {' '.join(arguments)} failed")


def print_medians(rows: list[dict[str, Any]]) -> None:
    """Medians over the seeds, as a Markdown table."""
    keys = [key for key in dict.fromkeys(key for row in rows for key in row) if key not in {"seed", "training"}]
    print("\n| training | " + " | ".join(keys) + " |\n|---" + "|---" * len(keys) + "|")
    for name in dict.fromkeys(row["training"] for row in rows):
        mine = [row for row in rows if row["training"] == name]
        known = [[row[key] for row in mine if row.get(key) is not None] for key in keys]
        cells = [f"{np.median(values):.3f}" if values else "–" for values in known]
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
