"""A cloud as prior of a training, compared with the training without it.

    python examples/benchmarks/prior.py WORKSPACE CLOUD OUT --train "--preset fast"

WORKSPACE has come to `init-sim3`. A cloud of another program lies elsewhere by metres and has another scale,
because its survey was georeferenced on its own; `georef train --lidar` refuses it then. The cloud is therefore
moved onto the model that was trained without it, by the similarity of `georef evaluate --reference-align
similarity`, before it is the prior of the second training. Both trainings are compared with the cloud, and with
the photographs of the test views. What stands in OUT already is not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement

from pipelines.core.products import load_json
from pipelines.core.stages import REPORT, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.geodesy.enu import ecef_from_enu
from pipelines.surface.measured_cloud import CloudReader
from pipelines.survey.options import CloudCrs
from pipelines.survey.report import read_report
from pipelines.survey.survey import Survey


def main() -> None:
    """Train twice, compare and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("cloud", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--train", default="--preset fast", help="options of both trainings")
    parser.add_argument("--sigma", default="0.03", help="stated σ of the cloud in metres")
    arguments = parser.parse_args()
    without = trained(arguments, "without", ())
    moved = arguments.out / "moved.ply"
    if not moved.exists():
        write_moved(without, arguments.cloud, moved)
    # `lidar_crs` states the frame in which `write_moved` writes: geocentric.
    prior = ("--lidar", moved, "--lidar-crs", "EPSG:4978", "--lidar-sigma", arguments.sigma)
    rows = {"without": without, "with": trained(arguments, "with", prior)}
    for name, workspace in rows.items():
        print(json.dumps({"training": name, **figures(workspace)}), flush=True)


def trained(arguments: argparse.Namespace, name: str, lidar: tuple[Any, ...]) -> Workspace:
    """The workspace of a training, compared with the cloud."""
    root = arguments.out / name
    if not (root / "evaluate").exists():
        root.mkdir(parents=True, exist_ok=True)
        subprocess.run(["cp", "-rn", f"{arguments.workspace}/.", str(root)], check=True)
        georef("train", root, *arguments.train.split(), *lidar, "--force")
        georef("evaluate", root, "--reference", arguments.cloud, "--reference-align", "similarity", "--force")
    return Workspace(root)


def write_moved(workspace: Workspace, cloud: Path, path: Path) -> None:
    """Write the cloud in the place of the model, in geocentric coordinates."""
    origin = load_json(Survey, workspace.path(SURVEY)).origin_on_earth
    shift = read_report(workspace.path(REPORT)).reference
    assert shift is not None and shift.shift is not None
    reference_from_model = np.vstack([shift.shift.reference_from_model, [0, 0, 0, 1]])
    model_from_reference = np.linalg.inv(reference_from_model)
    chunks = CloudReader(cloud, CloudCrs()).chunks(origin)
    points = np.concatenate([chunk.position_in_geo for chunk in chunks])
    moved = ecef_from_enu(points @ model_from_reference[:3, :3].T + model_from_reference[:3, 3], origin)
    rows = np.empty(len(moved), [("x", "f8"), ("y", "f8"), ("z", "f8")])
    for axis, name in enumerate("xyz"):
        rows[name] = moved[:, axis]
    PlyData([PlyElement.describe(rows, "vertex")]).write(path)


def figures(workspace: Workspace) -> dict[str, Any]:
    """PSNR of the test views, and the distances to the cloud, all and by slope."""
    report = read_report(workspace.path(REPORT))
    reference, test = report.reference, report.test_views
    assert reference is not None and test is not None
    by_group = {
        group.name: {
            "places": group.m3c2.measured,
            "median": group.m3c2.median_m,
            "NMAD": group.m3c2.nmad_m,
            "C2C": group.c2c.median_m,
            "F1": {score.threshold_m: score.f1 for score in group.scores},
        }
        for group in reference.groups
        if group.kind != "class"
    }
    return {"PSNR": test.psnr, "PSNR covered": test.psnr_covered, **by_group}


def georef(command: str, workspace: Path, *options: Any) -> None:
    """Run a command of georef."""
    program = [sys.executable, "-c", "from georef_cli.main import main; main()"]
    arguments = [command, str(workspace), *map(str, options)]
    if subprocess.run([*program, *arguments], stdout=subprocess.DEVNULL, check=False).returncode:
        sys.exit(f"georef {' '.join(arguments)} failed")


if __name__ == "__main__":
    main()
