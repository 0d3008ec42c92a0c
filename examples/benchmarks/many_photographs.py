"""Time, memory and accuracy of COLMAP's mappers on flights of thousands of photographs.

    python examples/benchmarks/many_photographs.py --photographs 1000 2000 4000 --mappers incremental global

No photographs are needed. A nadir flight in lines (80 % forward and 60 % side overlap) over hills sees random
points. Each photograph has features of those that it detects, with 0.5 px of noise, and further features that match
nothing. Pairs are those that `georef sfm` would match; the rotations of their two-view geometries are off by 0.1°.
Features and matches go into COLMAP's database. Each mapper runs in a process of its own, whose peak memory is the
system's record. COLMAP's `synthesize_dataset` is of no use here: its tracks spread over all photographs, whereas
those of a flight are local, and memory and time depend on that.

`center_rms_m` has the RMS errors of the camera centres after a similarity: of the mapper, of the adjustment with
positions of 3 cm, and of the last adjustment by the photographs alone, with and without that one before it.

`--mappers memory` runs the global mapper with three iterations an adjustment, for its peak memory alone.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pipelines.core.machine import peak_memory_bytes
from pipelines.core.progress import SILENT
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.colmap import flatten, quiet_colmap
from pipelines.geometry.similarity import umeyama
from pipelines.sfm.adjustment import adjust_finally, remove_drift
from pipelines.sfm.features import select_pairs
from pipelines.sfm.mapping import MapperRun, run_mapper, triangulate

SIZE_PX, FOCAL_PX, HEIGHT_M = (1200, 900), 1000.0, 100.0
FORWARD_OVERLAP, SIDE_OVERLAP = 0.8, 0.6
HILLS_M, NOISE_PX, DETECTED, ROTATION_NOISE_DEG = 8.0, 0.5, 0.5, 0.1
NEIGHBOURS = 16
FIX_M = 0.03
FEW_ITERATIONS = 3
FEW = 500  # photographs up to which the last adjustment is also run without the positions


@dataclass(frozen=True)
class Flight:
    """Cameras of a flight: centres (N, 3) in geo, and rotations cam ← geo (N, 3, 3)."""

    center: FloatArray
    rotation: FloatArray


def flight(count: int, rng: np.random.Generator) -> Flight:
    """A square block of lines, flown to and fro, with attitudes off the nadir by 2°."""
    width, height = (side * HEIGHT_M / FOCAL_PX for side in SIZE_PX)
    step, line = height * (1 - FORWARD_OVERLAP), width * (1 - SIDE_OVERLAP)
    per_line = max(round(math.sqrt(count * line / step)), 1)
    number = np.arange(count)
    row, column = number // per_line, number % per_line
    column = np.where(row % 2 == 0, column, per_line - 1 - column)
    center = np.stack([row * line, column * step, np.full(count, HEIGHT_M)], axis=1)
    center += rng.normal(0, 0.5, center.shape)
    heading = np.where(row % 2 == 0, 0.0, 180.0)
    down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    turned = Rotation.from_euler("z", heading[:, None], degrees=True)
    tilted = Rotation.from_rotvec(rng.normal(0, np.radians(2.0), (count, 3)))
    return Flight(center, (down * turned * tilted).as_matrix())


@dataclass(frozen=True)
class Features:
    """Features of a photograph: those that belong to points, on average, and all."""

    tracked: int
    all: int


def write_database(
    colmap: Any, path: Path, flown: Flight, features: Features, rng: np.random.Generator
) -> dict[str, int]:
    """Write the flight's features and matches; return how many there are.

    Args:
        colmap: the pycolmap module.
        path: of the database.
        flown: the cameras.
        features: of a photograph.
        rng: draws points and noise.
    """
    width, height = SIZE_PX
    footprint = (width * height) * (HEIGHT_M / FOCAL_PX) ** 2
    low, high = flown.center[:, :2].min(0) - 80, flown.center[:, :2].max(0) + 80
    points = np.empty((int(features.tracked / DETECTED / footprint * np.prod(high - low)), 3))
    points[:, :2] = rng.uniform(low, high, (len(points), 2))
    points[:, 2] = HILLS_M * np.sin(points[:, 0] / 60) * np.cos(points[:, 1] / 45) + rng.normal(0, 1, len(points))
    tree = cKDTree(points[:, :2])
    reach = np.hypot(width, height) / 2 * HEIGHT_M / FOCAL_PX * 1.15
    seen: list[IntArray] = []
    camera = colmap.Camera(
        camera_id=1,
        model="OPENCV",
        width=width,
        height=height,
        params=[FOCAL_PX, FOCAL_PX, width / 2, height / 2, 0, 0, 0, 0],
    )
    camera.has_prior_focal_length = True
    with colmap.Database.open(path) as database, colmap.DatabaseTransaction(database):
        database.write_camera(camera, use_camera_id=True)
        rig = colmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        database.write_rig(rig, use_rig_id=True)
        for index, (center, rotation) in enumerate(zip(flown.center, flown.rotation, strict=True)):
            near = np.array(tree.query_ball_point(center[:2], reach))
            in_cam = (points[near] - center) @ rotation.T
            xy = in_cam[:, :2] / in_cam[:, 2:] * FOCAL_PX + np.array(SIZE_PX) / 2
            inside = ((xy > 0) & (xy < SIZE_PX)).all(1) & (rng.random(len(near)) < DETECTED)
            other = rng.uniform(0, SIZE_PX, (max(features.all - int(inside.sum()), 0), 2))
            keypoints = np.concatenate([xy[inside] + rng.normal(0, NOISE_PX, (int(inside.sum()), 2)), other])
            image = colmap.Image(name=f"{index:06d}", camera_id=1, image_id=index + 1)
            database.write_image(image, use_image_id=True)
            frame = colmap.Frame(frame_id=index + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(index + 1, keypoints.astype(np.float32))
            seen.append(near[inside])
        axis = flown.rotation[:, 2]
        pairs = select_pairs(flown.center, axis, NEIGHBOURS)
        matched = 0
        for i, j in pairs:
            _, a, b = np.intersect1d(seen[i], seen[j], return_indices=True)
            if len(a) >= 15:
                geometry = _two_view_geometry(colmap, flown, (int(i), int(j)), rng)
                geometry.inlier_matches = np.stack([a, b], 1).astype(np.uint32)
                database.write_matches(int(i) + 1, int(j) + 1, geometry.inlier_matches)
                database.write_two_view_geometry(int(i) + 1, int(j) + 1, geometry)
                matched += len(a)
    return {"pairs": len(pairs), "matches": matched, "observations": sum(map(len, seen)), "points": len(points)}


def _two_view_geometry(colmap: Any, flown: Flight, pair: tuple[int, int], rng: np.random.Generator) -> Any:
    i, j = pair
    noise = Rotation.from_rotvec(rng.normal(0, np.radians(ROTATION_NOISE_DEG), 3)).as_matrix()
    rotation = noise @ flown.rotation[j] @ flown.rotation[i].T
    baseline = flown.rotation[j] @ (flown.center[i] - flown.center[j])
    baseline /= np.linalg.norm(baseline)
    x, y, z = baseline
    geometry = colmap.TwoViewGeometry()
    geometry.config = colmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    geometry.cam2_from_cam1 = colmap.Rigid3d(colmap.Rotation3d(rotation), baseline)
    return geometry


def map_flight(mapper: str, database: Path, count: int, seed: int, threads: int) -> dict[str, Any]:
    """Map a database with a mapper in this process, and return figures of time, memory and accuracy."""
    rng = np.random.default_rng(seed)
    flown = flight(count, rng)
    measured = flown.center + rng.normal(0, FIX_M, flown.center.shape)
    fixes = {f"{index:06d}": tuple(position) for index, position in enumerate(measured)}
    with quiet_colmap() as colmap, tempfile.TemporaryDirectory() as scratch:
        before, clock = _peak_bytes(), time.monotonic()
        run = MapperRun(database, Path(scratch), Path(scratch), threads, seed)
        model = _hierarchical(colmap, run) if mapper == "hierarchical" else _largest(colmap, mapper, run)
        if model is None:
            return {"mapper": mapper, "registered": 0}
        figures = {
            "mapper": mapper,
            "registered": model.num_reg_images(),
            "observations": model.compute_num_observations(),
            "mapping_s": round(time.monotonic() - clock, 1),
            "before_mib": before >> 20,
            "peak_mapping_mib": _peak_bytes() >> 20,
        }
        errors = {"mapper": _center_rms_m(model, flown)}
        plain = colmap.Reconstruction(model) if count <= FEW else None
        clock = time.monotonic()
        sigma_m = remove_drift(colmap, model, fixes, threads)
        errors["with positions"] = _center_rms_m(model, flown)
        drift_s = time.monotonic() - clock
        others = partial(triangulate, colmap, database=database, progress=SILENT) if mapper == "global" else None
        adjust_finally(colmap, model, complete=others, threads=threads)
        errors["last"] = _center_rms_m(model, flown)
        adjustment_s = time.monotonic() - clock
        peak = _peak_bytes()
        if plain is not None:
            adjust_finally(colmap, plain, complete=others, threads=threads)
            errors["last without positions"] = _center_rms_m(plain, flown)
    return {
        **figures,
        "positions_s": round(drift_s, 1),
        "adjustment_s": round(adjustment_s - drift_s, 1),
        "sigma_m": sigma_m and round(sigma_m, 3),
        "peak_mib": peak >> 20,
        "center_rms_m": {name: round(error, 4) for name, error in errors.items()},
    }


def peak_of_global(database: Path, threads: int, seed: int) -> dict[str, Any]:
    """Run the global mapper with few iterations in this process, and return its peak memory.

    Memory depends on the sizes of the adjustments, and not on the number of their iterations.
    """
    with quiet_colmap() as colmap, tempfile.TemporaryDirectory() as scratch:
        options = colmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = threads, seed
        options.mapper.ba_num_iterations = 1
        options.mapper.bundle_adjustment.ceres.solver_options.max_num_iterations = FEW_ITERATIONS
        before, clock = _peak_bytes(), time.monotonic()
        colmap.global_mapping(database, Path(scratch), Path(scratch), options)
        seconds = time.monotonic() - clock
    peaks = {"before_mib": before >> 20, "peak_mapping_mib": _peak_bytes() >> 20}
    return {"mapper": "global, memory only", "mapping_s": round(seconds, 1), **peaks}


def _largest(colmap: Any, mapper: Any, run: MapperRun) -> Any:
    models = run_mapper(colmap, mapper, run, lambda: None)
    return models[0] if models else None


def _hierarchical(colmap: Any, run: MapperRun) -> Any:
    options = colmap.HierarchicalPipelineOptions()
    options.num_threads, options.num_workers = run.threads, run.threads
    options.incremental_options.random_seed = run.seed
    models = colmap.hierarchical_mapping(run.database, run.images, run.scratch, options).values()
    return max(models, key=lambda model: model.num_reg_images(), default=None)


def _center_rms_m(model: Any, flown: Flight) -> float:
    sparse = flatten(model)
    true = flown.center[[int(name) for name in sparse.image_name]]
    fitted = umeyama(sparse.cam_center_in_local, true)
    error = fitted.apply(sparse.cam_center_in_local) - true
    return float(np.sqrt((error**2).sum(1).mean()))


def _peak_bytes() -> int:
    return peak_memory_bytes() or 0


def main() -> None:
    """Parse the arguments, and print one line of JSON a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=int, nargs="+", default=[1000, 2000, 4000])
    parser.add_argument("--mappers", nargs="+", default=["incremental", "global"])
    parser.add_argument("--tracked", type=int, default=1000, help="features of a photograph that belong to points")
    parser.add_argument("--features", type=int, default=2000, help="all features of a photograph")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", nargs=2, metavar=("MAPPER", "DATABASE"), help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child is not None:
        mapper, database = given.child[0], Path(given.child[1])
        if mapper == "memory":
            print(json.dumps(peak_of_global(database, given.threads, given.seed)))
        else:
            print(json.dumps(map_flight(mapper, database, given.photographs[0], given.seed, given.threads)))
        return
    for count in given.photographs:
        with tempfile.TemporaryDirectory() as folder, quiet_colmap() as colmap:
            database = Path(folder) / "database.db"
            flown = flight(count, np.random.default_rng(given.seed))
            features = Features(given.tracked, given.features)
            size = write_database(colmap, database, flown, features, np.random.default_rng(given.seed))
            for mapper in given.mappers:
                words = [sys.executable, __file__, "--child", mapper, str(database), "--photographs", str(count)]
                words += ["--seed", str(given.seed), "--threads", str(given.threads)]
                done = subprocess.run(words, check=True, stdout=subprocess.PIPE, encoding="utf-8")
                print(json.dumps({"photographs": count, **size, **json.loads(done.stdout)}), flush=True)


if __name__ == "__main__":
    main()
