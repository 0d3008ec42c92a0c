"""Time the intersection of a million points with five rays each: `python examples/benchmarks/geolocate.py`."""

from __future__ import annotations

import argparse
import os
import time

import numpy as np

from pipelines.geometry.intersection import Rays, UncertainCameras, intersect_rays
from pipelines.geometry.rotations import exp_so3, geo_from_cam


def survey(
    points: int, rays_each: int, outliers: float, rng: np.random.Generator
) -> tuple[np.ndarray, Rays, UncertainCameras]:
    """A grid flight of 400 nadir views 80 m above `points` points, with consumer errors."""
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20)), axis=-1).reshape(-1, 2) * 15.0
    center = np.column_stack([grid, np.full(len(grid), 80.0)])
    rotation = np.broadcast_to(geo_from_cam([0.0, -90.0, 0.0]), (len(center), 3, 3))
    truth = np.column_stack([rng.uniform(0, 285, (points, 2)), rng.uniform(0, 10, points)])
    cell = np.clip(np.rint(truth[:, :2] / 15).astype(int), 2, 17)
    step = np.array([rng.choice(25, rays_each, replace=False) for _ in range(1000)])[np.arange(points) % 1000]
    view = (cell[:, 1:] + step // 5 - 2) * 20 + cell[:, :1] + step % 5 - 2
    owner, view = np.repeat(np.arange(points), rays_each), view.ravel()
    in_cam = np.einsum("mji,mj->mi", rotation[view], truth[owner] - center[view])
    sigma_position, sigma_attitude, sigma_ray = np.array([1.5, 1.5, 3.0]), np.radians(0.5), 0.7 / 3000
    fixes = center + rng.normal(size=center.shape) * sigma_position
    bad = rng.random(len(center)) < outliers
    fixes[bad] += 15.0
    views = UncertainCameras(
        center_in_geo=fixes,
        rotation_geo_from_cam=exp_so3(rng.normal(0, sigma_attitude, center.shape)) @ rotation,
        cov_center_in_geo=np.tile(np.diag(sigma_position**2), (len(center), 1, 1)),
        sigma_attitude_rad=np.full(len(center), sigma_attitude),
        sigma_ray=np.full(len(center), sigma_ray),
    )
    xy = in_cam[:, :2] / in_cam[:, 2:] + rng.normal(0, sigma_ray, (len(owner), 2))
    return truth, Rays(owner.astype(np.int64), view.astype(np.int64), xy), views


def main() -> None:
    """Print the time and the errors with and without outlying fixes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--rays", type=int, default=5)
    options = parser.parse_args()
    print(f"{options.points} points, {options.rays} rays each, {os.cpu_count()} cores")
    for outliers in (0.0, 0.05, 0.15):
        truth, rays, views = survey(options.points, options.rays, outliers, np.random.default_rng(0))
        clock = time.perf_counter()
        found = intersect_rays(rays, views, options.points)
        seconds = time.perf_counter() - clock
        good = found.consistent
        error = np.linalg.norm(found.position_in_geo - truth, axis=1)
        print(
            f"{outliers:4.0%} fixes off by 26 m: {seconds:5.1f} s, {good.mean():.1%} consistent, "
            f"median error {np.median(error[good]):.2f} m, 95 % {np.quantile(error[good], 0.95):.2f} m"
        )


if __name__ == "__main__":
    main()
