"""The predicted accuracy over the scene: a grid, as a table for other programs and as a picture for people."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.types import ByteArray, FloatArray, IntArray
from pipelines.evaluate.prediction import Prediction
from pipelines.geodesy.enu import Origin, ecef_from_enu, lla_from_ecef
from pipelines.scene.restored import Restored
from pipelines.scene.trained import Trained

_CELLS = 48  # of the longer side
_LEAST_RAYS = 3  # of an SfM point that stands for the scene
_NEIGHBOURS = 3  # SfM points that give a cell its height and its cameras
_FARTHEST_CELLS = 1.5  # from an SfM point: beyond, there is no scene
_RIM = 0.01  # share of the SfM points outside the grid on each side
_CHUNK = 256
_PLACE = ("east_m", "north_m", "up_m", "latitude_deg", "longitude_deg", "ellipsoidal_height_m")
_SIGMA = ("sigma_e_m", "sigma_n_m", "sigma_u_m", "sigma_h_m", "sigma_v_m")

Image = ByteArray
_GREY, _BLACK, _WHITE = (190, 190, 190), (0, 0, 0), (255, 255, 255)
_RED, _BLUE = (40, 40, 220), (220, 120, 30)  # OpenCV's order: blue, green, red
_SIDE_PX, _MARGIN_PX, _BAR_PX, _HEAD_PX, _FOOT_PX = 560, 20, 110, 44, 48


@dataclass(frozen=True)
class AccuracyMap:
    """Predicted standard deviations at C cells of a grid over the scene, in metres.

    Attributes:
        position_in_geo: (C, 3) middle of each cell, at the height of the scene there.
        sigma_m: (C, 3) east, north, up.
        cell: (C, 2) column from the west and row from the south.
        size_m: side of a cell.
        corner_in_geo: (2,) south-western corner of the grid.
        shape: columns and rows.
    """

    position_in_geo: FloatArray
    sigma_m: FloatArray
    cell: IntArray
    size_m: float
    corner_in_geo: FloatArray
    shape: tuple[int, int]

    @property
    def sigma_h_m(self) -> FloatArray:
        """Horizontal (C,): √(σ_E² + σ_N²)."""
        return np.asarray(np.hypot(self.sigma_m[:, 0], self.sigma_m[:, 1]))

    @property
    def sigma_v_m(self) -> FloatArray:
        """Vertical (C,)."""
        return self.sigma_m[:, 2]

    def figures(self) -> dict[str, Any]:
        """The map in short, as plain values."""
        values = {"h": self.sigma_h_m, "v": self.sigma_v_m}
        kinds: tuple[tuple[str, Callable[[FloatArray], Any]], ...] = (
            ("least", np.min),
            ("median", np.median),
            ("largest", np.max),
        )
        found = {f"{kind}_sigma_{way}_m": float(of(values[way])) for way in values for kind, of in kinds}
        return {"cells": len(self.cell), "cell_m": self.size_m, **found}


def accuracy_map(restored: Restored, prediction: Prediction) -> AccuracyMap | None:
    """Predict at the middle of each cell, seen by the cameras that see the SfM points there.

    None for a scene of too few points.
    """
    sparse, geo_from_model = restored.scene.sparse, restored.trained.geo_from_model
    rays = np.bincount(sparse.obs_point, minlength=len(sparse.point_id))
    chosen = np.flatnonzero(rays >= _LEAST_RAYS)
    if len(chosen) < _NEIGHBOURS:
        return None
    point = geo_from_model.apply(restored.scene.point_in_model[chosen])
    low, high = np.quantile(point[:, :2], [_RIM, 1 - _RIM], axis=0)
    size = float((high - low).max()) / _CELLS
    if size <= 0:
        return None
    columns, rows = np.maximum(np.ceil((high - low) / size).astype(int), 1).tolist()
    cell = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    middle = low + (cell + 0.5) * size
    distance, near = cKDTree(point[:, :2]).query(middle, k=_NEIGHBOURS)
    there = distance[:, 0] <= _FARTHEST_CELLS * size
    cell, near = cell[there], near[there]
    position = np.column_stack([middle[there], np.median(point[near, 2], axis=1)])
    sigma = _sigma(prediction, position, *_seen(sparse.obs_point, sparse.obs_image, chosen[near]))
    known = np.isfinite(sigma).all(axis=1)
    if not known.any():
        return None
    return AccuracyMap(position[known], sigma[known], cell[known], size, low, (columns, rows))


def _seen(obs_point: IntArray, obs_image: IntArray, near: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs (cell, camera), each once and by cell: the cameras that see any of the near points (C, k)."""
    order = np.argsort(obs_point, kind="stable")
    start = np.searchsorted(obs_point[order], np.arange(int(obs_point.max()) + 2))
    cameras = [
        np.unique(np.concatenate([obs_image[order[start[p] : start[p + 1]]] for p in points])) for points in near
    ]
    owner = np.repeat(np.arange(len(near)), [len(each) for each in cameras])
    return owner, np.concatenate(cameras)


def _sigma(prediction: Prediction, position: FloatArray, owner: IntArray, camera: IntArray) -> FloatArray:
    parts = []
    for first in range(0, len(position), _CHUNK):
        mine = (owner >= first) & (owner < first + _CHUNK)
        cov = prediction.of_scene(position[first : first + _CHUNK], owner[mine] - first, camera[mine])
        parts.append(np.sqrt(np.diagonal(cov, axis1=1, axis2=2)))
    return np.concatenate(parts)


def write_area(found: AccuracyMap, trained: Trained, out: Path) -> None:
    """Write the grid as `accuracy.csv` and `accuracy.png` into a folder."""
    survey = trained.survey
    write_csv(found, survey.origin, out / "accuracy.csv")
    signs = Signs(
        trained.geo_from_model.apply(trained.poses.cam_center_in_model),
        np.array([point.position_in_geo for point in survey.control_points]).reshape(-1, 3),
        np.array([point.position_in_geo for point in survey.check_points]).reshape(-1, 3),
    )
    write_png(found, signs, out / "accuracy.png")


def write_csv(found: AccuracyMap, origin: Origin, path: Path) -> None:
    """Write the grid as a table, a line a cell, in `geo` and on the ellipsoid."""
    lla = lla_from_ecef(ecef_from_enu(found.position_in_geo, origin))
    values = np.column_stack([found.sigma_m, found.sigma_h_m, found.sigma_v_m])
    with path.open("w", encoding="utf-8", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(_PLACE + _SIGMA)
        for place, geodetic, sigma in zip(found.position_in_geo, lla, values, strict=True):
            writer.writerow(
                [f"{value:.3f}" for value in place]
                + [f"{geodetic[0]:.8f}", f"{geodetic[1]:.8f}", f"{geodetic[2]:.3f}"]
                + [f"{value:.5f}" for value in sigma]
            )


@dataclass(frozen=True)
class Signs:
    """What to mark on the picture, each (K, 2 or 3) in geo."""

    cameras: FloatArray
    control: FloatArray
    check: FloatArray


def write_png(found: AccuracyMap, signs: Signs, path: Path) -> None:
    """Draw σ horizontal and vertical side by side, north up, with cameras, control and check points."""
    panels = [
        _panel(found, values, signs, title)
        for values, title in ((found.sigma_h_m, "sigma H"), (found.sigma_v_m, "sigma V"))
    ]
    cv2.imwrite(str(path), np.concatenate(panels, axis=1))


@dataclass(frozen=True)
class _View:
    """Where metres are on a panel."""

    low: FloatArray  # (2,) geo, lower left
    scale: float  # pixels a metre
    height_px: int

    def at(self, place: FloatArray) -> tuple[int, int]:
        x, y = (np.asarray(place)[:2] - self.low) * self.scale
        return round(_MARGIN_PX + x), round(_HEAD_PX + self.height_px - y)


def _panel(found: AccuracyMap, values: FloatArray, signs: Signs, title: str) -> Image:
    grid_high = found.corner_in_geo + np.array(found.shape) * found.size_m
    places = [found.corner_in_geo[None], grid_high[None]]
    places += [np.asarray(group)[:, :2] for group in (signs.cameras, signs.control, signs.check) if len(group)]
    low, high = np.concatenate(places).min(axis=0), np.concatenate(places).max(axis=0)
    scale = _SIDE_PX / float((high - low).max())
    width, height = (max(round(side), 120) for side in ((high - low) * scale).tolist())
    view = _View(low, scale, height)
    image: Image = np.full((_HEAD_PX + height + _FOOT_PX, width + 2 * _MARGIN_PX + _BAR_PX, 3), 255, dtype=np.uint8)
    cv2.rectangle(image, view.at(low), view.at(high), _GREY, -1)
    least, most = float(values.min()), float(values.max())
    colour = _colours((values - least) / max(most - least, 1e-12))
    for (column, row), shade in zip(found.cell.tolist(), colour.tolist(), strict=True):
        corner = found.corner_in_geo + found.size_m * np.array([column, row])
        cv2.rectangle(image, view.at(corner), view.at(corner + found.size_m), shade, -1)
    _draw_signs(image, view, signs)
    _draw_bar(image, (width + 2 * _MARGIN_PX, _HEAD_PX, height), least, most)
    _text(image, f"{title} (predicted, 1 sigma)", (_MARGIN_PX, 28), 0.6)
    _draw_legend(image, view, width)
    return image


def _colours(share: FloatArray) -> Image:
    """Viridis (N, 3) of values in [0, 1]."""
    grey = np.clip(np.rint(255 * share), 0, 255).astype(np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_VIRIDIS), dtype=np.uint8)[:, 0]


def _draw_signs(image: Image, view: _View, signs: Signs) -> None:
    for place in signs.cameras:
        cv2.drawMarker(image, view.at(place), _BLACK, cv2.MARKER_CROSS, 7, 1)
    for group, colour in ((signs.check, _BLUE), (signs.control, _RED)):
        for place in group:
            cv2.circle(image, view.at(place), 4, _WHITE, -1, cv2.LINE_AA)
            cv2.circle(image, view.at(place), 3, colour, -1, cv2.LINE_AA)


def _draw_bar(image: Image, place: tuple[int, int, int], least: float, most: float) -> None:
    x, y, height = place
    bar = _colours(np.linspace(1, 0, height))
    image[y : y + height, x : x + 16] = bar[:, None]
    for share in (0.0, 0.5, 1.0):
        value = least + share * (most - least)
        text = f"{value:.3f} m" if value < 10 else f"{value:.1f} m"
        _text(image, text, (x + 20, round(y + 5 + (1 - share) * (height - 6))), 0.45)


def _draw_legend(image: Image, view: _View, width: int) -> None:
    y = _HEAD_PX + view.height_px + 30
    length = 10.0 ** np.floor(np.log10(width / view.scale / 3))
    cv2.line(image, (_MARGIN_PX, y), (_MARGIN_PX + round(length * view.scale), y), _BLACK, 2)
    _text(image, f"{length:g} m", (_MARGIN_PX, y - 8), 0.45)
    x = _MARGIN_PX + width // 3
    cv2.drawMarker(image, (x, y - 4), _BLACK, cv2.MARKER_CROSS, 7, 1)
    _text(image, "camera", (x + 8, y), 0.45)
    cv2.circle(image, (x + 80, y - 4), 3, _RED, -1, cv2.LINE_AA)
    _text(image, "control", (x + 88, y), 0.45)
    cv2.circle(image, (x + 155, y - 4), 3, _BLUE, -1, cv2.LINE_AA)
    _text(image, "check", (x + 163, y), 0.45)


def _text(image: Image, text: str, at: tuple[int, int], size: float) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, _BLACK, 1, cv2.LINE_AA)
