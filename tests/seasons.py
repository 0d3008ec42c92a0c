"""One town in two seasons: photographs of summer, and of winter with other textures and in another light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.simulate.lens import Renderer, Sensor
from pipelines.simulate.mesh import Material
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import fly_survey
from pipelines.simulate.textures import GroundPlan, TextureSamples, albedo, fbm, mix
from pipelines.survey.survey import Attitude, Survey
from tests.sfm_scenes import survey_of

# Share of a surface that is under snow, where the drifts are of mean thickness. Walls stay bare.
_SNOW = {
    Material.TERRAIN: 0.5,
    Material.TILES: 0.5,
    Material.FLAT_ROOF: 0.57,
    Material.PLAIN: 0.33,
    Material.LEAVES: 0.23,
    Material.CAR: 0.4,
    Material.SOLAR: 0.33,
}
_DRIFTS_M = (5.0, 2.2, 1.0, 0.45, 0.2)
_DRIFTED = 0.9  # of the share, for a drift of the largest thickness
_WHITE = np.array([0.66, 0.69, 0.74], dtype=np.float32)
_TURNED_RAD, _LOW_RAD = 2.2, 0.45  # of the sun in winter: from that in summer, and above the horizon


def wintry_albedo(samples: TextureSamples, material: np.ndarray, plan: GroundPlan) -> np.ndarray:
    """Albedo (N, 3) of the same surfaces under drifts of snow, which lie alike in all photographs of the winter."""
    color = albedo(samples, material, plan)
    drift = fbm(samples.u + np.float32(411.0), samples.v - np.float32(273.0), _DRIFTS_M, samples.pixel)
    rough = fbm(samples.v + np.float32(97.0), samples.u, _DRIFTS_M[1:], samples.pixel)
    for kind, share in _SNOW.items():
        own = np.nonzero(material == kind)[0]
        lies = np.clip(np.float32(share) + np.float32(_DRIFTED) * drift[own], 0.0, 0.97)
        white = _WHITE * (1 + np.float32(0.25) * rough[own])[:, None]
        color[own] = mix(color[own], white, lies)
    return color


def winter_sun(sun: np.ndarray) -> np.ndarray:
    """Direction to a lower sun, in another quarter of the sky."""
    angle = np.arctan2(sun[1], sun[0]) + _TURNED_RAD
    return np.array([np.cos(_LOW_RAD) * np.cos(angle), np.cos(_LOW_RAD) * np.sin(angle), np.sin(_LOW_RAD)])


def photographed_in_two_seasons(options: SimulateOptions, folder: Path) -> tuple[Survey, dict[str, np.ndarray]]:
    """Write photographs of one flight of which every second shows the winter; return their survey and true centres.

    The survey has attitudes, and no positions.
    """
    flight = fly_survey(options)
    world, rng = flight.world, np.random.default_rng(1)
    winter = Renderer(replace(world.scene, sun=winter_sun(world.scene.sun)), world.lens, int(options.samples))
    names = [f"{'winter' if number % 2 else 'summer'}_{number:02d}.png" for number in range(len(world.poses))]
    folder.mkdir()
    for number, (name, pose) in enumerate(zip(names, world.poses, strict=True)):
        sensor = Sensor(1.1 * float(np.exp(rng.normal(0, 0.08))), (1.0, 1.0, 1.0), options.noise)
        if number % 2:
            with patch("pipelines.simulate.lens.albedo", wintry_albedo):
                rgb = winter.photograph(pose, sensor, rng)
        else:
            rgb = flight.renderer.photograph(pose, sensor, rng)
        cv2.imwrite(str(folder / name), rgb[..., ::-1])
    survey = survey_of(names, folder.name)
    (width, height), focal_px = options.size_px, world.lens.focal_px
    params = (focal_px, width / 2, height / 2, 0.0)
    prior = survey.cameras[0].model_copy(update={"width": width, "height": height, "params": params})
    turned = [tuple(quat_xyzw_from_matrix(pose.geo_from_cam).tolist()) for pose in world.poses]
    attitudes = [Attitude(quat_xyzw=quat, sigma_deg=2.0, source="csv") for quat in turned]
    images = tuple(
        image.model_copy(update={"attitude": attitude})
        for image, attitude in zip(survey.images, attitudes, strict=True)
    )
    centers = {name: pose.center for name, pose in zip(names, world.poses, strict=True)}
    return survey.model_copy(update={"cameras": (prior,), "images": images}), centers
