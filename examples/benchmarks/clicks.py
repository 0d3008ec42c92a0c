"""Compare what clicks in the viewer measure with the true surface of a simulated flight.

    georef simulate survey --flight grid --images 40 --size 960x720 --seed 6
    georef run WORKSPACE --images survey/images …
    python examples/benchmarks/clicks.py WORKSPACE --flight grid --images 40 --size 960x720 --seed 6

The options are those of `georef simulate`: the same scene is built again, and the lines of sight are intersected
with it. They start near the cameras and go in all directions through the scene: no photograph was taken along them.
The columns count clicks by what the line of sight truly meets; `σ` is the predicted σ along the line, `error/σ` the
root mean square of those clicks that are off by 0.5 m at most.

Then squares and lines at random places, whose true corners are clicked on from such places: volumes over the best
plane of the rim, and areas, against those of the true corners and surface; profiles against the true surface below
them. Squares on which the true surface has a step of more than 3 m between neighbouring samples are left out: a
fraction of a pixel decides there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geodesy.enu import ecef_from_enu, enu_from_ecef
from pipelines.simulate.mesh import MISS, Material, Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import fly_survey
from pipelines.surface.picking import Sight, SurfacePoint
from pipelines.surface.surface_views import model_renderer
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CrsOptions
from pipelines.survey.solution import read_sfm, read_trained
from pipelines.view.measuring import Fineness, MeasuringModel, WantedBase
from pipelines.view.quantities import rim_base

_NAMES = ("scene", "flight", "images", "size", "seed")
_PIXEL_RAD = 1 / 700  # of a page of 800 px
_SCATTER_M = 8.0  # of the starts about the cameras
_NEAR_M = 0.5
_INNER, _MOST_STEP_M = 25, 3.0  # true samples along a side of a square, and the largest step between them
_HIDDEN_M = 1.0  # a corner that is read further off is hidden by something else


def sights(model: MeasuringModel, count: int) -> list[Sight]:
    """Return lines of sight from places near the cameras to places within the scene."""
    renderer, rng = model.reader.renderer, np.random.default_rng(0)
    centers = renderer.poses.cam_center_in_model
    low, high = np.quantile(model.solution.point_in_model(renderer.sfm), [0.1, 0.9], axis=0)
    lines = []
    for _ in range(count):
        start = centers[rng.integers(len(centers))] + rng.normal(0, _SCATTER_M, 3)
        line = rng.uniform(low, high) - start
        lines.append(Sight(start, line / np.linalg.norm(line), _PIXEL_RAD))
    return lines


def compare_quantities(model: MeasuringModel, count: int, true_up: Callable[[FloatArray], FloatArray]) -> None:
    """Print error/σ of areas, volumes and profiles, pooled; `true_up` returns true heights (N,) at plans (N, 2)."""
    renderer, rng = model.reader.renderer, np.random.default_rng(1)
    tie_points = renderer.geo_from_model.apply(model.solution.point_in_model(renderer.sfm))
    low, high = np.quantile(tie_points[:, :2], [0.2, 0.8], axis=0)
    model_from_geo = renderer.geo_from_model.inverse()
    ratios: dict[str, list[float]] = {"area": [], "volume": [], "profile": []}
    centers = renderer.poses.cam_center_in_model
    tried = 0
    while len(ratios["volume"]) < count and tried < 20 * count:
        tried += 1
        half, turn = rng.uniform(3, 12), rng.uniform(0, np.pi / 2)
        spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        plan = rng.uniform(low, high) + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ spin.T
        inner = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, _INNER)]), axis=-1).reshape(-1, 2)
        places = plan.mean(axis=0) + half * (1 - 1 / _INNER) * inner @ spin.T
        up, at_corner = true_up(places), true_up(plan)
        grid = up.reshape(_INNER, _INNER)
        steps = max(np.abs(np.diff(grid, axis=axis)).max() for axis in (0, 1))
        if not np.isfinite(up).all() or not np.isfinite(at_corner).all() or steps > _MOST_STEP_M:
            continue
        true_corners = np.column_stack([plan, at_corner])
        start = centers[rng.integers(len(centers))] + rng.normal(0, _SCATTER_M, 3)
        lines = model_from_geo.apply(true_corners) - start
        sights = [Sight(start, line / np.linalg.norm(line), _PIXEL_RAD) for line in lines]
        points = [point for point in map(model.reader.under, sights) if isinstance(point, SurfacePoint)]
        read = np.array([point.position_in_geo for point in points]).reshape(-1, 3)
        if len(points) < 4 or np.linalg.norm(read - true_corners, axis=1).max() > _HIDDEN_M:
            continue
        found = {each.name: each for each in model.volume(points, WantedBase(), Fineness())}
        area = {each.name: each for each in model.area(points, Fineness())}["horizontal area"]
        base = rim_base("plane", np.column_stack([plan, at_corner]), places).height_m
        true = 4 * half**2 * float((up - base).mean())
        if "volume" not in found or found["volume"].sigma is None or area.sigma is None:
            continue
        ratios["volume"].append((found["volume"].value - true) / found["volume"].sigma)
        ratios["area"].append((area.value - 4 * half**2) / area.sigma)
        line = model.profile(points[:2], Fineness())
        along = read[0, :2] + (line.along_m / line.along_m[-1])[:, None] * (read[1, :2] - read[0, :2])
        level = model.target.xyz_from_geo(np.column_stack([along, true_up(along)]))[:, 2]
        error = line.height - level
        near = np.abs(error) <= _NEAR_M
        ratios["profile"].append(float(np.sqrt(np.mean((error[near] / line.sigma_m[near]) ** 2))))
    for name, values in ratios.items():
        z = np.array(values)
        pooled, middle = float(np.sqrt(np.mean(z**2))), float(np.median(np.abs(z)))
        print(f"{name:8s}{len(z):4d}: error/σ {pooled:.2f}, median |error/σ| {middle:.2f}")


def main() -> None:
    """Print errors by material, and of quantities."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    for name in _NAMES:
        parser.add_argument(f"--{name}", default=SimulateOptions.model_fields[name].default)
    parser.add_argument("--clicks", type=int, default=300)
    parser.add_argument("--outlines", type=int, default=30)
    args = parser.parse_args()
    workspace = Workspace(args.workspace)
    solution, survey = read_trained(workspace), load_survey(workspace)
    sfm = read_sfm(workspace, solution)
    renderer = model_renderer(workspace, solution, sfm, survey, backend="cpu")
    model = MeasuringModel(workspace, survey, renderer, CrsOptions())
    world = fly_survey(SimulateOptions.model_validate({name: getattr(args, name) for name in _NAMES})).world
    mesh = world.scene.mesh
    rays = Raycaster(mesh)

    def in_world(point_in_geo: FloatArray) -> FloatArray:
        return enu_from_ecef(ecef_from_enu(point_in_geo, survey.origin_on_earth), world.origin)

    rows = []
    for sight in sights(model, args.clicks):
        point = model.reader.under(sight)
        if not isinstance(point, SurfacePoint):
            continue
        start = in_world(renderer.geo_from_model.apply(sight.start_in_model[None]))
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

    def true_up(plan: FloatArray) -> FloatArray:
        high, deep = (in_world(np.column_stack([plan, np.full(len(plan), up)])) for up in (300.0, -300.0))
        line = (deep - high) / np.linalg.norm(deep - high, axis=1, keepdims=True)
        hits = rays.first_hits(high, line)
        return np.where(hits.triangle == MISS, np.nan, 300.0 - hits.distance.astype(np.float64))

    compare_quantities(model, args.outlines, true_up)


if __name__ == "__main__":
    main()
