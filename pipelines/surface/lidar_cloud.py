"""LiDAR cloud of the scene: points with the planes around them, in `model`, and the track of its scanner."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, ByteArray, FloatArray, IntArray, Rows, joined_rows
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, ecef_from_lla, enu_from_ecef
from pipelines.geometry.trajectory import Trajectory
from pipelines.surface.measured_cloud import MeasuredCloud, MeasuredFiles, Thinning, read_thinned
from pipelines.survey.options import CloudCrs
from pipelines.survey.scene import SparseScene
from pipelines.survey.survey import Survey

_WGS84 = "EPSG:4979"
_MAX_GAP_S = 2.0
_LEAST_COVERED = 0.5  # of the points: with fewer, the clocks differ


@dataclass(frozen=True)
class ScannerTrack:
    """Places of a scanner by time, in geo."""

    trajectory: Trajectory

    @classmethod
    def read(cls, path: Path, stated: CloudCrs, origin: Origin) -> ScannerTrack:
        """Return the track of a CSV file on the clock of the cloud's points; an InputError: a bad file, no times.

        The file has time, and latitude, longitude, altitude or x, y, z. A track without a CRS has the cloud's.
        """
        table = read_trajectory(path)
        if table.time_s is None:
            raise InputError("no-timestamps", "has no column `timestamp`.", path=path, field="--lidar-trajectory")
        text = _WGS84 if table.geographic else stated.crs
        if text is None:
            raise InputError(
                "crs-unknown",
                "has projected coordinates: state their CRS with --lidar-crs.",
                path=path,
                field="--lidar-trajectory",
            )
        lla = parse_crs(text, vertical=stated.vertical, path=path).lla_from_xyz(table.xyz, path=path)
        order = np.argsort(table.time_s, kind="stable")
        time_s, first = np.unique(table.time_s[order], return_index=True)
        place = enu_from_ecef(ecef_from_lla(lla), origin)[order][first]
        return cls(Trajectory.from_samples(time_s, position=place, max_gap_s=_MAX_GAP_S))

    def at(self, gps_time_s: FloatArray) -> FloatArray:
        """Return the scanner's places (P, 3) at times (P,), NaN where unknown; an InputError: most are unknown."""
        known = np.isfinite(gps_time_s)
        place = np.full((len(gps_time_s), 3), np.nan)
        place[known] = self.trajectory.at(gps_time_s[known]).position
        covered = float(np.isfinite(place[:, 0]).mean())
        if covered < _LEAST_COVERED:
            raise InputError(
                "times-outside-trajectory",
                f"covers the times of {covered:.0%} of the points only: its clock is not that of the LiDAR, or it "
                "belongs to another flight.",
                field="--lidar-trajectory",
            )
        return place


_NEIGHBOURS = 12
_SQUARE_VOXELS = 20.0  # side of the squares that are held out, which hold whole neighbourhoods
_MOST_POINTS = 3_000_000
_MARGIN = 0.1  # of the scene's size, around its points
_SCENE_SHARE = 0.01  # of the SfM points on each side may lie outside the scene
_BATCH = 100_000
_ABOVE_M, _BELOW_M = 500.0, 500.0  # a wrong datum must show itself, not lie outside the box


@dataclass(frozen=True)
class LidarCloud(Rows):
    """P points."""

    position_in_model: FloatArray  # (P, 3) metres, moved along the normal onto the plane through the neighbours
    normal_in_model: FloatArray  # (P, 3) unit vectors of these planes, with an arbitrary sign
    roughness_m: FloatArray  # (P,) RMS of the neighbours about that plane
    reach_m: FloatArray  # (P,) distance to the furthest of these neighbours
    classification: ByteArray  # (P,) class of LAS
    voxel_m: float  # distance between the points, about
    scanner_in_model: FloatArray | None = None  # (P, 3) at the time of each point; NaN, None: unknown

    def moved(self, shift: FloatArray) -> LidarCloud:
        scanner = None if self.scanner_in_model is None else self.scanner_in_model + shift
        return replace(self, position_in_model=self.position_in_model + shift, scanner_in_model=scanner)

    def incidence(self) -> FloatArray:
        """Return the cosine of the angle between beam and normal (P,), from 0: grazing; NaN where unknown."""
        if self.scanner_in_model is None:
            return np.full(len(self), np.nan)
        beam = self.scanner_in_model - self.position_in_model
        along = np.abs(np.einsum("pi,pi->p", beam, self.normal_in_model))
        return np.asarray(along / np.linalg.norm(beam, axis=1))


def read_cloud(
    files: MeasuredFiles,
    scene: SparseScene,
    survey: Survey,
    pixel_m: float,
    *,
    progress: Progress = SILENT,
    track: ScannerTrack | None = None,
    held_out: float = 0.0,
) -> tuple[LidarCloud, LidarCloud | None]:
    """Return the points of the clouds in the scene, as dense as pixels of `pixel_m` on the surface resolve it.

    The second cloud has the points of the squares that are `held_out`, a share of all squares; None: there are too
    few to tell their planes, and the first cloud has all points. No plane counts points of the other cloud.

    Raises:
        InputError: as `read_thinned` and `ScannerTrack.at`, or too few points in the scene.
    """
    in_geo = scene.geo_from_model.apply(scene.point_in_model)
    low, high = np.quantile(in_geo, [_SCENE_SHARE, 1 - _SCENE_SHARE], axis=0)
    margin = _MARGIN * float((high - low)[:2].max())
    low, high = low - np.array([margin, margin, _BELOW_M]), high + np.array([margin, margin, _ABOVE_M])
    cloud = read_thinned(files, survey.origin_on_earth, Thinning(pixel_m, _MOST_POINTS, low, high), progress)
    if len(cloud) <= 10 * _NEIGHBOURS:
        raise InputError(
            "no-overlap",
            f"Only {len(cloud)} points lie in the scene of the photographs: check the cloud's place and its CRS "
            "(--lidar-crs).",
            field="--lidar",
        )
    model_from_geo = scene.geo_from_model.inverse()
    places = _stations_of(files, cloud) if track is None else track.at(cloud.gps_time_s)
    scanner = None if places is None else model_from_geo.apply(places)
    held = in_held_out_squares(cloud.position_in_geo, _SQUARE_VOXELS * cloud.voxel_m, held_out)
    if held.sum() <= _NEIGHBOURS or (~held).sum() <= 10 * _NEIGHBOURS:
        held[:] = False

    def part(rows: BoolArray) -> LidarCloud:
        place = model_from_geo.apply(cloud.position_in_geo[rows])
        planes = planes_of(place, cloud.classification[rows], cloud.voxel_m, cloud.weight[rows])
        return replace(planes, scanner_in_model=None if scanner is None else scanner[rows])

    return part(~held), part(held) if held.any() else None


def in_held_out_squares(position: FloatArray, side_m: float, share: float) -> BoolArray:
    """Return which points (P, 3) lie in the squares of the plan that are held out: the same in every run.

    A hash of the square's place decides, so that neither the order of the points nor their number counts.
    """
    east, north = np.floor(position[:, :2] / side_m).astype(np.int64).astype(np.uint64).T
    mixed = east * np.uint64(0x9E3779B97F4A7C15) ^ north * np.uint64(0xC2B2AE3D27D4EB4F)
    mixed = (mixed ^ mixed >> np.uint64(29)) * np.uint64(0xBF58476D1CE4E5B9)
    return np.asarray((mixed ^ mixed >> np.uint64(32)) / 2.0**64 < share)


def joined_clouds(first: LidarCloud, second: LidarCloud) -> LidarCloud:
    """Return the points of both clouds, without the places of their scanners."""
    return joined_rows([replace(cloud, scanner_in_model=None) for cloud in (first, second)])


def _stations_of(files: MeasuredFiles, cloud: MeasuredCloud) -> FloatArray | None:
    """Return the places (P, 3) from which points were measured, NaN where unknown; None: nowhere known."""
    stations = files.stations_in_geo
    if stations is None:
        return None
    return np.where((cloud.station >= 0)[:, None], stations[cloud.station], np.nan)


def planes_of(
    position: FloatArray, classification: ByteArray, voxel_m: float, weight: IntArray | None = None
) -> LidarCloud:
    """Return points (P, 3), P ≥ 12, in `model`, about a voxel apart, with the plane through the neighbours of each.

    Each stands for a number of measured points, its weight (P,); None: 1. Where a noisy surface lies near a border
    of voxels, the few points beyond the border have as many voxels as the many before it: with equal weights the
    plane would lie beside the surface, by up to a third of the noise's σ.
    """
    count = np.ones(len(position)) if weight is None else weight.astype(np.float64)
    tree = cKDTree(position)
    normal, roughness, reach = np.empty_like(position), np.empty(len(position)), np.empty(len(position))
    onto_plane = np.empty_like(position)
    for first in range(0, len(position), _BATCH):
        rows = slice(first, first + _BATCH)
        distance, nearest = tree.query(position[rows], k=_NEIGHBOURS)
        around, share = position[nearest], count[nearest] / count[nearest].sum(axis=1, keepdims=True)
        middle = np.einsum("pk,pki->pi", share, around)
        arm = around - middle[:, None]
        spread, axes = np.linalg.eigh(np.einsum("pk,pki,pkj->pij", share, arm, arm))
        off = np.einsum("pi,pi->p", position[rows] - middle, axes[:, :, 0])
        onto_plane[rows] = position[rows] - off[:, None] * axes[:, :, 0]
        normal[rows], roughness[rows] = axes[:, :, 0], np.sqrt(np.maximum(spread[:, 0], 0))
        reach[rows] = distance[:, -1]
    return LidarCloud(onto_plane, normal, roughness, reach, classification, voxel_m)
