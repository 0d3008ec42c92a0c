"""Map projections in closed form, from the literature: what PROJ's answers are checked against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

US_FOOT_M, FOOT_M = 1200.0 / 3937.0, 0.3048
GRS80_FLATTENING = 1.0 / 298.257222101
WGS84_FLATTENING = 1.0 / 298.257223563
AXIS_M = 6378137.0


@dataclass(frozen=True)
class TransverseMercator:
    """Krüger's series to n⁴, Karney (2011), doi 10.1007/s00190-011-0445-3; within 1e-7 m near its meridian."""

    lon_0: float
    lat_0: float = 0.0
    scale: float = 0.9996
    false_easting_m: float = 500_000.0
    false_northing_m: float = 0.0
    axis_m: float = AXIS_M
    flattening: float = WGS84_FLATTENING

    def xy_m(self, lla: np.ndarray) -> np.ndarray:
        """Easting and northing (N, 2) of latitude and longitude (N, 2 or 3)."""
        east, north = self._unit(np.radians(lla[:, 0]), np.radians(lla[:, 1] - self.lon_0))
        _, start = self._unit(np.radians(np.array([self.lat_0])), np.zeros(1))
        n = self.flattening / (2 - self.flattening)
        radius = self.scale * self.axis_m / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
        return np.stack(
            [self.false_easting_m + radius * east, self.false_northing_m + radius * (north - start)], axis=-1
        )

    def _unit(self, lat: np.ndarray, lon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        n = self.flattening / (2 - self.flattening)
        e = np.sqrt(self.flattening * (2 - self.flattening))
        alpha = (
            n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3 + 41 / 180 * n**4,
            13 / 48 * n**2 - 3 / 5 * n**3 + 557 / 1440 * n**4,
            61 / 240 * n**3 - 103 / 140 * n**4,
            49561 / 161280 * n**4,
        )
        tau = np.tan(lat)
        sigma = np.sinh(e * np.arctanh(e * tau / np.sqrt(1 + tau**2)))
        conformal = tau * np.sqrt(1 + sigma**2) - sigma * np.sqrt(1 + tau**2)
        xi = np.arctan2(conformal, np.cos(lon))
        eta = np.arcsinh(np.sin(lon) / np.hypot(conformal, np.cos(lon)))
        rows = [(a, 2 * j * xi, 2 * j * eta) for j, a in enumerate(alpha, start=1)]
        north = xi + sum(a * np.sin(x) * np.cosh(y) for a, x, y in rows)
        east = eta + sum(a * np.cos(x) * np.sinh(y) for a, x, y in rows)
        return east, north


def utm(zone: int) -> TransverseMercator:
    """A northern zone."""
    return TransverseMercator(6.0 * zone - 183.0)


def lambert_two_parallels(
    lla: np.ndarray, parallels: tuple[float, float], lat_0: float, lon_0: float, false_easting_m: float
) -> np.ndarray:
    """Lambert's conformal conic on GRS80 (N, 2), in metres: Snyder (1987), equations 15-1 … 15-10."""
    e = np.sqrt(GRS80_FLATTENING * (2 - GRS80_FLATTENING))

    def m(lat_deg: float) -> float:
        lat = np.radians(lat_deg)
        return float(np.cos(lat) / np.sqrt(1 - (e * np.sin(lat)) ** 2))

    first, second = parallels
    t_1, t_2 = _t(np.radians(first), e), _t(np.radians(second), e)
    n = (np.log(m(first)) - np.log(m(second))) / (np.log(t_1) - np.log(t_2))
    factor = AXIS_M * m(first) / (n * t_1**n)
    radius, radius_0 = factor * _t(np.radians(lla[:, 0]), e) ** n, factor * _t(np.radians(lat_0), e) ** n
    angle = n * np.radians(lla[:, 1] - lon_0)
    return np.stack([false_easting_m + radius * np.sin(angle), radius_0 - radius * np.cos(angle)], axis=-1)


def long_island(lla: np.ndarray) -> np.ndarray:
    """New York's Long Island zone on NAD83 (N, 2), in metres."""
    parallels = (41 + 2 / 60, 40 + 40 / 60)
    return lambert_two_parallels(lla, parallels, lat_0=40 + 10 / 60, lon_0=-74.0, false_easting_m=300_000.0)


def polar_stereographic_north(lla: np.ndarray) -> np.ndarray:
    """UPS North on WGS84 (N, 2), easting first: Snyder (1987), equations 21-30 … 21-33."""
    e = np.sqrt(WGS84_FLATTENING * (2 - WGS84_FLATTENING))
    radius = 2 * AXIS_M * 0.994 * _t(np.radians(lla[:, 0]), e) / np.sqrt((1 + e) ** (1 + e) * (1 - e) ** (1 - e))
    lon = np.radians(lla[:, 1])
    return 2_000_000.0 + np.stack([radius * np.sin(lon), -radius * np.cos(lon)], axis=-1)


def _t(lat: np.ndarray, e: float) -> np.ndarray:
    sine = e * np.sin(lat)
    return np.tan(np.pi / 4 - lat / 2) * ((1 + sine) / (1 - sine)) ** (e / 2)
