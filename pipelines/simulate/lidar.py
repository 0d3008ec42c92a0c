"""Simulated flight of a laser scanner: strips in two directions across the town, with the errors of the instrument.

1. A line scanner sweeps its beam from side to side, ±fov across the strip.
2. Each beam has its first hit in the scene as it was at that time: with a building that was removed since, or
   without one that was added since.
3. Ranges have white noise. Beams at grazing angles, and a share of all others, do not return. One in a thousand
   returns from the air, and is classified as noise, as a producer does.
4. A strip drifts slowly, the whole cloud may be shifted, and a part of the scanner's lever arm may be missing: that
   error turns with the heading.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from pipelines.core.types import BoolArray, ByteArray, FloatArray
from pipelines.formats.las import LidarReturns, LidarWriter
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, lla_from_enu, lla_of
from pipelines.simulate.mesh import MISS, Material, Mesh, MeshBuilder, Raycaster, TextureParameters
from pipelines.simulate.options import LidarFlightOptions
from pipelines.simulate.scene import Building, SimulatedScene, joined
from pipelines.simulate.truth import TrueLidar

GROUND, BUILDING, VEGETATION, UNCLASSIFIED, NOISE = 2, 6, 5, 1, 7
_CLASS_OF = {
    Material.TERRAIN: GROUND, Material.WALL: BUILDING, Material.TILES: BUILDING, Material.FLAT_ROOF: BUILDING,
    Material.SOLAR: BUILDING, Material.LEAVES: VEGETATION,
}  # fmt: skip
_SPEED_M_S, _LINES_HZ = 8.0, 100.0
_SPACING = 0.7  # of a strip's half width, between strips
_GRAZING = 0.05  # cosine of incidence below which no beam returns
_NOISE_SHARE = 1e-3
_DRIFT_PERIODS = 1.5  # of the drift's sine, in a strip
_FIRST_S = 1000.0  # time of the first beam
_TURN_S = 20.0  # between strips
# The building that was removed, in the town's axes: on the square, south of the complex.
_REMOVED_M = ((0.0, -29.0), (44.0, 14.0, 11.0))
_ADDED = 0  # index in `scene.buildings` of the building that was added since, of the complex
_TRACK_S = 0.1  # between places of the scanner's track


@dataclass(frozen=True)
class Strip:
    """Strip of the flight, with its P returns."""

    number: int  # from 1
    position_in_geo: FloatArray  # (P, 3) metres, as measured
    classification: ByteArray  # (P,) class of LAS
    time_s: FloatArray  # (P,)
    scan_angle_deg: FloatArray  # (P,)
    of_change: BoolArray  # (P,) on the removed building, or at the place of the added one
    track_s: FloatArray  # (K,)
    track_in_geo: FloatArray  # (K, 3) true places of the scanner


class LidarFlight:
    def __init__(self, options: LidarFlightOptions, scene: SimulatedScene, seed: np.random.SeedSequence) -> None:
        self._options, self._axes = options, scene.axes
        self._rng = np.random.default_rng(seed)
        self.changed = _changed_building(options, scene)
        self.mesh = _scanned_mesh(options, scene, self.changed)
        self._rays = Raycaster(self.mesh)
        self.returns = self.returns_of_change = 0

    def strips(self) -> Iterator[Strip]:
        options = self._options
        half_width_m = options.lidar_height * np.tan(np.radians(options.lidar_fov))
        lines = max(2, int(np.ceil(2 * options.lidar_radius / (_SPACING * half_width_m))) + 1)
        offsets = np.linspace(-options.lidar_radius, options.lidar_radius, lines)
        reach_m = options.lidar_radius + half_width_m
        passes = 2 * lines * 2 * half_width_m / (2 * options.lidar_radius + 2 * half_width_m)
        start_s = _FIRST_S
        for number in range(2 * lines):
            along = self._axes[number // lines] * (1 if number % 2 else -1)
            across = np.cross(self._axes[2], along)
            begin = across * offsets[number % lines] - reach_m * along + options.lidar_height * self._axes[2]
            duration_s = 2 * reach_m / _SPEED_M_S
            beams = int(options.lidar_density / passes * 4 * reach_m * half_width_m)
            yield self._strip(number + 1, begin, along, np.linspace(start_s, start_s + duration_s, beams), start_s)
            start_s += duration_s + _TURN_S

    def truth(self) -> TrueLidar:
        options, changed = self._options, self.changed
        corners = [] if changed is None else changed.rectangle(changed.length_m / 2, changed.width_m / 2, 0.0)
        return TrueLidar(
            sigma_m=options.lidar_sigma,
            drift_m=options.lidar_drift,
            shift_in_geo_m=options.lidar_shift,
            arm_in_body_m=options.lidar_arm,
            change=options.lidar_change,
            returns=self.returns,
            returns_of_change=self.returns_of_change,
            changed_footprint=tuple((float(x), float(y)) for x, y, _ in corners),
        )

    def _strip(
        self, number: int, begin: FloatArray, along: FloatArray, time_s: FloatArray, start_s: float
    ) -> Strip:
        options, rng = self._options, self._rng
        down, right = -self._axes[2], np.cross(along, self._axes[2])
        place = begin + _SPEED_M_S * (time_s - start_s)[:, None] * along
        sweep = np.abs(2 * np.mod(time_s * _LINES_HZ, 1.0) - 1.0)  # there and back
        # The tangent sweeps evenly, so that level ground is scanned evenly.
        slope = np.tan(np.radians(options.lidar_fov)) * (2 * sweep - 1)
        beam = down + slope[:, None] * right
        beam /= np.linalg.norm(beam, axis=1, keepdims=True)
        hits = self._rays.first_hits(place, beam)
        normal = self.mesh.normals[hits.triangle, 0].astype(np.float64)
        incidence = np.abs(np.einsum("ni,ni->n", normal, beam))
        returned = (hits.triangle != MISS) & (incidence > _GRAZING) & (rng.random(len(beam)) > options.lidar_missed)
        range_m = hits.distance.astype(np.float64)
        true = place + range_m[:, None] * beam
        flat = true @ self._axes.T
        returned &= (np.abs(flat[:, :2]) < options.lidar_radius).all(axis=1)
        from_air = rng.random(len(beam)) < _NOISE_SHARE
        noisy = np.where(from_air, range_m * rng.uniform(0.3, 0.95, len(beam)), range_m)
        noisy = noisy + rng.normal(0, options.lidar_sigma, len(beam))
        measured = place + noisy[:, None] * beam + self._systematic(time_s, along, right)
        kinds = np.array([_CLASS_OF.get(material, UNCLASSIFIED) for material in Material], dtype=np.uint8)
        classes = np.where(from_air, NOISE, kinds[self.mesh.material[hits.triangle]]).astype(np.uint8)
        of_change = self._on_change(true) & ~from_air
        self.returns += int(returned.sum())
        self.returns_of_change += int((of_change & returned).sum())
        track_s = np.arange(time_s[0], time_s[-1] + _TRACK_S, _TRACK_S)
        return Strip(
            number,
            measured[returned],
            classes[returned],
            time_s[returned],
            np.degrees(np.arctan(slope))[returned],
            of_change[returned],
            track_s,
            begin + _SPEED_M_S * (track_s - start_s)[:, None] * along,
        )

    def _systematic(self, time_s: FloatArray, along: FloatArray, right: FloatArray) -> FloatArray:
        """Return the error (P, 3) in geo that neighbouring beams share."""
        options, rng = self._options, self._rng
        turns = 2 * np.pi * _DRIFT_PERIODS * (time_s - time_s[0]) / max(np.ptp(time_s), 1e-9)
        phase = rng.uniform(0, 2 * np.pi, 3)
        drift = np.sqrt(2) * options.lidar_drift * np.sin(turns[:, None] + phase)
        body = np.stack([along, right, -self._axes[2]])
        return np.asarray(drift + np.array(options.lidar_shift) - np.array(options.lidar_arm) @ body)

    def _on_change(self, point: FloatArray) -> BoolArray:
        """Return whether points (P, 3) lie on or below the changed building, but not on the ground around it."""
        if self.changed is None:
            return np.zeros(len(point), dtype=bool)
        inside = _in_footprint(self.changed, point, 0.05)
        if self._options.lidar_change == "added":
            return inside
        height_m = (point - self.changed.center) @ self.changed.axes[2]
        return np.asarray(inside & (height_m > 0.5))


def _changed_building(options: LidarFlightOptions, scene: SimulatedScene) -> Building | None:
    if options.lidar_change == "none":
        return None
    if options.lidar_change == "added":
        return scene.buildings[_ADDED]
    (x, y), (length_m, width_m, height_m) = _REMOVED_M
    foot = np.array([x, y, 0.0]) @ scene.axes
    ground = Raycaster(scene.mesh).first_hits(foot + 200.0 * scene.axes[2], -scene.axes[2:])
    foot[2] = 200.0 - float(ground.distance[0])
    return Building(foot, scene.axes, length_m, width_m, 3, (height_m - 0.3) / 3, "flat")


def _scanned_mesh(options: LidarFlightOptions, scene: SimulatedScene, changed: Building | None) -> Mesh:
    if changed is None:
        return scene.mesh
    if options.lidar_change == "removed":
        builder = MeshBuilder()
        texture = builder.add_texture(TextureParameters((0.5, 0.5, 0.5)))
        size = (changed.length_m, changed.width_m, changed.height_m)
        builder.box(changed.center, size, changed.axes, Material.FLAT_ROOF, texture)
        return joined(scene.mesh, builder.build())
    middle = scene.mesh.corners.mean(axis=1)
    gone = _in_footprint(changed, middle, 0.7) & (scene.mesh.material != Material.TERRAIN)
    return Mesh(
        **{name: values if name == "texture_params" else values[~gone] for name, values in vars(scene.mesh).items()}
    )


def _in_footprint(building: Building, point: FloatArray, margin_m: float) -> BoolArray:
    """Return whether points (P, 3) lie above or below the building's floor, widened by a margin."""
    in_building = (point - building.center) @ building.axes.T
    half = np.array([building.length_m, building.width_m]) / 2 + margin_m
    return np.asarray((np.abs(in_building[:, :2]) <= half).all(axis=1))


CLOUD, TRACK = "lidar.laz", "lidar_trajectory.csv"
_CRS = "EPSG:4979"
_LON_LAT_ALT = [1, 0, 2]
_WRITTEN = date(2026, 1, 1)  # the same options give the same bytes


@contextmanager
def lidar_files(folder: Path, origin: Origin) -> Iterator[Callable[[Strip], None]]:
    """Yield a function that appends a strip to the cloud and to the scanner's track, both complete at the end."""
    near = lla_of(origin)[_LON_LAT_ALT]
    crs = parse_crs(_CRS)
    writer = LidarWriter(
        folder / CLOUD, wkt1=crs.wkt1, angular=True, near=near, software="georef simulate", written=_WRITTEN
    )
    with writer as cloud, (folder / TRACK).open("w", encoding="utf-8") as track:
        track.write("timestamp,latitude,longitude,altitude\n")

        def write(strip: Strip) -> None:
            position = lla_from_enu(strip.position_in_geo, origin)[:, _LON_LAT_ALT]
            cloud.write(
                LidarReturns(position, strip.classification, strip.time_s, strip.scan_angle_deg, strip.number)
            )
            places = lla_from_enu(strip.track_in_geo, origin)
            for time_s, (lat, lon, alt) in zip(strip.track_s, places, strict=True):
                track.write(f"{time_s:.3f},{lat:.10f},{lon:.10f},{alt:.4f}\n")

        yield write
