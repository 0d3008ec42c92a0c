"""Flights without attitudes whose fixes drift, and the tilt that a survey of them ends with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import Posterior
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.survey import Fix, FixSession, Survey
from tests.drawn_surveys import rows_of
from tests.scenes import Measured, Noise, TrueScene, sparse_model, survey_of

STEP_S = 2.5
WHITE_M = (1.0, 1.0, 1.5)
STATED_M = (2.5, 2.5, 5.0)


@dataclass(frozen=True)
class Drift:
    """Errors of the fixes: climb of the heights over the flight in metres, random walks in m/√s, by axis.

    `lean_deg` is the σ of a tilt that all photographs share, `wobble_deg` that of each; `pitch_deg` is the camera's
    from a view straight down; `headings` is False for lines that are all flown with the nose to the same side.
    """

    climb_m: float = 0.0
    walk: tuple[float, float] = (0.0, 0.0)
    lean_deg: float = 2.5
    wobble_deg: float = 2.5
    pitch_deg: float = 0.0
    headings: bool = True
    receiver: str = "single-frequency"
    times: bool = True


def flight(of: Drift, rng: np.random.Generator, lines: int = 5, each: int = 8) -> TrueScene:
    """Return lines to and fro at 70 m, above nearly level ground."""
    line, along = np.divmod(np.arange(lines * each), each)
    east = np.where(line % 2, each - 1 - along, along) * 14.0 - 7.0 * (each - 1)
    center = np.column_stack([east, (line - (lines - 1) / 2) * 22.0, np.full(len(east), 70.0)])
    center += rng.normal(0, 1.0, center.shape)
    ahead = np.where((line % 2 == 1) & of.headings, -1.0, 1.0)
    nose = np.column_stack([ahead, np.zeros(len(ahead)), np.zeros(len(ahead))])
    down = np.broadcast_to([0.0, 0.0, -1.0], nose.shape)
    level = np.stack([np.cross(-nose, down), -nose, down], axis=-1)
    lean = exp_so3(np.append(rng.normal(0, np.radians(of.lean_deg), 2), 0.0))
    held = rng.normal(0, np.radians(of.wobble_deg), (len(east), 3)) * [1, 1, 0.5]
    turned = lean @ level @ exp_so3([np.radians(of.pitch_deg), 0.0, 0.0]) @ exp_so3(held)
    ground = np.column_stack([rng.uniform(-80, 80, 400), rng.uniform(-75, 75, 400), rng.uniform(0, 4, 400)])
    return TrueScene(center, turned, ground, np.zeros((0, 3)))


def survey_with(of: Drift, scene: TrueScene, rng: np.random.Generator) -> Survey:
    """Return the survey of a flight, with drifting fixes of metres, or with the receiver's own σ for RTK."""
    survey = survey_of(scene, Noise(), Measured(attitudes=False), rng)
    count = len(scene.center_in_geo)
    time_s = STEP_S * np.arange(count)
    walk = np.cumsum(rng.normal(size=(count, 3)), axis=0) * STEP_S**0.5 * [of.walk[0], of.walk[0], of.walk[1]]
    error = walk - walk.mean(axis=0) + rng.normal(size=(count, 3)) * WHITE_M
    error[:, 2] += of.climb_m * (time_s / time_s[-1] - 0.5)
    cov = rows_of(np.diag(np.square(STATED_M)))
    images = tuple(
        image.model_copy(
            update={
                "timestamp_s": float(at) if of.times else None,
                "fix": Fix(position_in_geo=tuple(place), cov_in_geo=cov, source="exif", sigma_source="default"),
            }
        )
        for image, at, place in zip(survey.images, time_s, scene.center_in_geo + error, strict=True)
    )
    session = FixSession(receiver=of.receiver, sigma_common_m=(1.5, 1.5, 3.0), sigma_source="default")
    return survey.model_copy(update={"images": images, "sessions": (session,), "default_sigmas": ("fixes",)})


@dataclass(frozen=True)
class Solved:
    """What a survey ends with, and the truth."""

    scene: TrueScene
    model: SparseModel
    posterior: Posterior

    @property
    def codes(self) -> set[str]:
        return {caution.code for caution in self.posterior.solution.cautions}

    @property
    def geo_from_local(self) -> Similarity:
        return Similarity.from_record(self.posterior.solution.similarity_from_local())

    @property
    def tilt_rad(self) -> np.ndarray:
        """Tilt (2,) about east and north of the solution against the truth."""
        turn = self.geo_from_local.rotation @ self.scene.geo_from_local.rotation.T
        return np.asarray(log_so3(turn)[:2])

    @property
    def cov_of_tilt(self) -> np.ndarray:
        return self.posterior.of_similarity[1:3, 1:3]

    @property
    def normalised(self) -> float:
        """Squared tilt over its covariance, of expectation 1."""
        return float(self.tilt_rad @ np.linalg.solve(self.cov_of_tilt, self.tilt_rad) / 2)


def solved(of: Drift, seed: int) -> Solved:
    """Return the solution of a draw."""
    rng = np.random.default_rng(seed)
    scene = flight(of, rng)
    model = sparse_model(scene, Noise(pixel_px=0.3), rng)
    survey = survey_with(of, scene, rng)
    points = geolocate(survey, model, GeolocateOptions()).points
    posterior, _ = estimate_similarity(survey, model, points, InitSim3Options())
    return Solved(scene, model, posterior)
