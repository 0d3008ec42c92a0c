"""Compare what clicks in the viewer measure with the true surface of a simulated flight.

    georef simulate survey --flight grid --images 40 --size 960x720 --seed 6
    georef run WORKSPACE --images survey/images …
    python examples/benchmarks/clicks.py WORKSPACE --flight grid --images 40 --size 960x720 --seed 6

The options are those of `georef simulate`: the same scene is built again, and the lines of sight are intersected
with it. They start near the cameras and go in all directions through the scene: no photograph was taken along them.
The columns count clicks by what the line of sight truly meets; `σ` is the predicted σ along the line, `error/σ` the
root mean square of those clicks that are off by 0.5 m at most.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geodesy.enu import ecef_from_enu, enu_from_ecef
from pipelines.simulate.mesh import MISS, Material, Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import fly_survey
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.picking import Sight, SurfacePoint
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.options import CrsOptions
from pipelines.survey.scene import photographs
from pipelines.survey.trained_survey import load_trained
from pipelines.view.measuring import MeasuringModel

_NAMES = ("scene", "flight", "images", "size", "seed")
_PIXEL_RAD = 1 / 700  # of a page of 800 px
_SCATTER_M = 8.0  # of the starts about the cameras
_NEAR_M = 0.5


def sights(model: MeasuringModel, count: int) -> list[Sight]:
    """Return lines of sight from places near the cameras to places within the scene."""
    trained, rng = model.trained, np.random.default_rng(0)
    centers = trained.poses.cam_center_in_model
    low, high = np.quantile(trained.point_in_model, [0.1, 0.9], axis=0)
    lines = []
    for _ in range(count):
        start = centers[rng.integers(len(centers))] + rng.normal(0, _SCATTER_M, 3)
        line = rng.uniform(low, high) - start
        lines.append(Sight(start, line / np.linalg.norm(line), _PIXEL_RAD))
    return lines


def main() -> None:
    """Print errors by material."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    for name in _NAMES:
        parser.add_argument(f"--{name}", default=SimulateOptions.model_fields[name].default)
    parser.add_argument("--clicks", type=int, default=300)
    args = parser.parse_args()
    workspace = Workspace(args.workspace)
    trained = load_trained(workspace)
    images = photographs(trained.sfm, trained.survey, workspace, trained.model.max_image_size)
    model = MeasuringModel(workspace, ModelRenderer(trained, images, rasterizer("cpu")), CrsOptions())
    world = fly_survey(SimulateOptions.model_validate({name: getattr(args, name) for name in _NAMES})).world
    mesh = world.scene.mesh
    rays = Raycaster(mesh)

    def in_world(point_in_geo: FloatArray) -> FloatArray:
        return enu_from_ecef(ecef_from_enu(point_in_geo, trained.survey.origin), world.origin)

    rows = []
    for sight in sights(model, args.clicks):
        point = model.reader.under(sight)
        if not isinstance(point, SurfacePoint):
            continue
        start = in_world(trained.geo_from_model.apply(sight.start_in_model[None]))
        line = in_world(point.position_in_geo[None]) - start
        distance = float(np.linalg.norm(line))
        hit = rays.first_hits(start, line / distance)
        if hit.triangle[0] == MISS:
            continue
        cov, along = model.jointly([point]).cov_in_geo, line[0] / distance
        sigma = float("nan") if cov is None else float(np.sqrt(along @ cov @ along))
        material = int(np.asarray(mesh.material)[hit.triangle[0]])
        rows.append((material, distance - float(hit.distance[0]), sigma))
    table = np.array(rows)
    print(f"{len(rows)} of {args.clicks} clicks measured; metres")
    print(f"{'':10s}{'clicks':>8s}{'median':>9s}{'> 0.5 m':>9s}{'σ':>8s}{'error/σ':>9s}")
    for material in np.unique(table[:, 0]):
        error, sigma_m = table[table[:, 0] == material, 1], table[table[:, 0] == material, 2]
        near = np.abs(error) <= _NEAR_M
        ratio = np.sqrt(np.mean((error[near] / sigma_m[near]) ** 2)) if near.any() else float("nan")
        print(
            f"{Material(int(material)).name.lower():10s}{len(error):8d}{np.median(np.abs(error)):9.3f}"
            f"{np.mean(~near):9.0%}{np.median(sigma_m):8.3f}{ratio:9.2f}"
        )


if __name__ == "__main__":
    main()
