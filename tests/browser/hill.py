"""A scene of a few thousand Gaussians with known places and colours, its survey, and cameras known on Earth.

Everything is true in `scene`: East-North-Up axes at the survey's origin, but moved to the middle of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pipelines.deliver.options import PageOptions, SplatOptions
from pipelines.deliver.pages import ScenePage, scene_page
from pipelines.deliver.placement import solved_placement
from pipelines.deliver.splat import PlacedSplat, placed_splat
from pipelines.geodesy.enu import (
    Origin,
    ecef_from_enu,
    ecef_from_enu_rotation,
    ecef_from_lla,
    lla_from_ecef,
    lla_of,
)
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians, transformed
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.sh import sh_from_rgb
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.survey.target_crs import target_crs
from tests.scenes import trained_model

ORIGIN = Origin(lat_deg=46.0, lon_deg=7.75, alt_m=1600.0)
# Kilometres from the survey's origin, where vertical and north have visibly turned.
GEO_FROM_SCENE = Similarity(1.0, np.eye(3), np.array([2500.0, -1800.0, 25.0]))
GEO_FROM_MODEL = GEO_FROM_SCENE @ Similarity(1.3, exp_so3([0.4, -1.1, 2.0]), np.array([3.0, -2.0, 1.0]))
ECEF_FROM_SCENE = (
    Similarity(1.0, ecef_from_enu_rotation(lla_of(ORIGIN)), ecef_from_enu(np.zeros(3), ORIGIN)) @ GEO_FROM_SCENE
)
CAMERA = Pinhole(480, 360, 420.0, 420.0, 240.0, 180.0)
BACKGROUND = (0x20 / 255, 0x24 / 255, 0x2A / 255)  # of the page
HALF_SIDE_M = 24.0
# Marks float above the ground, so that views from above show them whole.
MARKS = np.array([[-14.0, -9.0, 4.0], [13.0, -12.0, 4.5], [10.0, 13.0, 4.0], [-12.0, 11.0, 5.0]])
MARK_SIGMA_M = 0.35
COMPASS, COMPASS_RADIUS_M = np.array([0.0, 0.0, 12.0]), 3.0
_CONTRAST = 0.4
_BAND1 = 0.4886025119029199
SWISS = "EPSG:2056"
HOSTILE = '</script><img src=x onerror="document.title=1">'


@dataclass(frozen=True)
class View:
    """Camera of known longitude, latitude and ellipsoidal height.

    Attributes:
        lla: latitude, longitude in degrees, height in metres.
        heading_deg: from north over east.
        pitch_deg: above the horizon.
    """

    lla: np.ndarray
    heading_deg: float
    pitch_deg: float

    def ecef_from_cam(self) -> Similarity:
        """Return the pose; the camera's axes are x right, y down, z forward."""
        rotation = ecef_from_enu_rotation(self.lla) @ _enu_from_cam(self.heading_deg, self.pitch_deg)
        return Similarity(1.0, rotation, ecef_from_lla(self.lla))

    def pixels(self, ecef: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) of places (N, 3) on Earth."""
        x, y, z = self.ecef_from_cam().inverse().apply(ecef).T
        return np.stack([CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy], axis=1)

    def render(self, gaussians: Gaussians, finer: int = 1) -> np.ndarray:
        """Return our own render (H, W, 3) of Gaussians in `scene`, in 0 … 1.

        Args:
            gaussians: to render.
            finer: number of pixels, along each side, whose mean is a pixel of the result. Our rasteriser makes
                Gaussians wider by half a pixel, which is too much for those that are smaller than a pixel.
        """
        cam_from_scene = self.ecef_from_cam().inverse() @ ECEF_FROM_SCENE
        matrix = torch.from_numpy(cam_from_scene.matrix()).float()
        camera = Pinhole(**{name: value * finer for name, value in vars(CAMERA).items()})
        colour = CpuRasterizer().render(gaussians, matrix, camera, RasterSettings(background=BACKGROUND)).colour
        pixels = colour.clamp(0, 1).numpy().reshape(CAMERA.height, finer, CAMERA.width, finer, 3)
        return pixels.mean(axis=(1, 3), dtype=np.float64)


def around(heading_deg: float, pitch_deg: float, distance_m: float, target: np.ndarray) -> View:
    """Return the view along a heading and a pitch of a place in `scene`, from a distance."""
    spot = ECEF_FROM_SCENE.apply(target[None])[0]
    forward = ecef_from_enu_rotation(lla_from_ecef(spot)) @ _enu_from_cam(heading_deg, pitch_deg)[:, 2]
    return View(lla_from_ecef(spot - distance_m * forward), heading_deg, pitch_deg)


def make_gaussians(spacing_m: float = 1.2) -> Gaussians:
    """Return the Gaussians in `scene`: coloured ground, magenta marks, and a ball that tells directions."""
    return Gaussians.concatenate([_ground(spacing_m), _marks(), _compass()])


def compass_colour(view: View) -> np.ndarray:
    """Return the colour that the ball shows in a view: more red eastwards, green northwards, blue upwards."""
    east_north_up = _enu_from_cam(view.heading_deg, view.pitch_deg)[:, 2]
    return 0.5 + _CONTRAST * east_north_up


def marks_ecef() -> np.ndarray:
    """Return the surveyed places (4, 3) of the marks on Earth."""
    return ECEF_FROM_SCENE.apply(MARKS)


def survey() -> Survey:
    """Return the survey: two control points and two check points where the marks are, one of a hostile name."""
    names = ("GCP 1", HOSTILE, "CP 1", "CP 2")
    points = [
        SurveyedPoint(name=name, position_in_geo=tuple(place), cov_in_geo=_COVARIANCE, marks=())
        for name, place in zip(names, GEO_FROM_SCENE.apply(MARKS).tolist(), strict=True)
    ]
    return Survey(
        origin=ORIGIN,
        source_crs="EPSG:4979",
        vertical=VerticalDatum(name="ellipsoidal", stated=True),
        image_dir=".",
        cameras=(),
        images=(),
        control_points=tuple(points[:2]),
        check_points=tuple(points[2:]),
    )


def placed(gaussians: Gaussians) -> PlacedSplat:
    """Return Gaussians in `scene` as a deliverable gets them: from a model of another scale and turn."""
    in_model = transformed(gaussians, GEO_FROM_MODEL.inverse() @ GEO_FROM_SCENE)
    return placed_splat(
        in_model,
        solved_placement(trained_model(GEO_FROM_MODEL), survey(), in_model.means.numpy(), None),
        SplatOptions(),
    )


def page(splat: PlacedSplat, cesium: str) -> ScenePage:
    """Return the page of a splat, with coordinates in the Swiss CRS."""
    target = target_crs(PageOptions(crs=SWISS), ORIGIN, GEO_FROM_SCENE.translation[None], survey().vertical)
    means = splat.gaussians.means.numpy()
    return scene_page(HOSTILE, splat.placement, means, survey=survey(), target=target, cesium=cesium)


_COVARIANCE = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 0.0, 1e-4))


def _enu_from_cam(heading_deg: float, pitch_deg: float) -> np.ndarray:
    heading, pitch = np.radians([heading_deg, pitch_deg])
    right = [np.cos(heading), -np.sin(heading), 0.0]
    forward = [np.cos(pitch) * np.sin(heading), np.cos(pitch) * np.cos(heading), np.sin(pitch)]
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _ground(spacing_m: float) -> Gaussians:
    rng = np.random.default_rng(8)
    along = np.arange(-HALF_SIDE_M, HALF_SIDE_M + 0.01, spacing_m)
    east, north = (axis.ravel() for axis in np.meshgrid(along, along))
    patch = rng.uniform([0.15, 0.6, 0.15], [0.85, 0.95, 0.85], (9, 9, 3))  # green enough to tell marks from it
    row, column = (((axis + HALF_SIDE_M) // 6).astype(int) for axis in (north, east))
    sh = rng.normal(0, 0.06, (len(east), 16, 3))
    sh[:, 0] = sh_from_rgb(torch.from_numpy(patch[row, column])).numpy()
    up = 4.0 * np.exp(-(east**2 + north**2) / 150.0)
    return _made(np.stack([east, north, up], axis=1), np.array([0.6, 0.6, 0.12]) * spacing_m, sh)


def _marks() -> Gaussians:
    sh = np.zeros((len(MARKS), 16, 3))
    sh[:, 0] = sh_from_rgb(torch.tensor([1.0, 0.0, 1.0])).numpy()
    return _made(MARKS, np.full(3, MARK_SIGMA_M), sh)


def _compass() -> Gaussians:
    count = 400
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))  # a Fibonacci sphere
    up = 1 - (2 * np.arange(count) + 1) / count
    ring = np.sqrt(1 - up**2)
    sh = np.zeros((count, 16, 3))
    sh[:, 3, 0], sh[:, 1, 1], sh[:, 2, 2] = np.array([-1, -1, 1]) * _CONTRAST / _BAND1  # −x, −y, z of the basis
    place = np.stack([ring * np.cos(turn), ring * np.sin(turn), up], axis=1)
    return _made(COMPASS + COMPASS_RADIUS_M * place, np.full(3, 0.4), sh)


def _made(means: np.ndarray, sigma_m: np.ndarray, sh: np.ndarray) -> Gaussians:
    count = len(means)
    return Gaussians(
        means=torch.from_numpy(means).float(),
        quats_wxyz=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(sigma_m)).float().repeat(count, 1),
        logit_opacities=torch.full((count,), 4.0),
        sh=torch.from_numpy(sh).float(),
    )
