"""Geographic problems with known truth, without images: a block of cameras, fixes, and control points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from pipelines.adjust.cameras import CameraCorrections
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.systematic import SystematicErrors
from pipelines.adjust.terms import AttitudeTerm, ControlTerm, DistanceTerm, FixTerm, Term, Weighting
from pipelines.geometry.bundle import similarity_modes
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity
from pipelines.robust.statistics import outlier_gate
from tests.scenes import looking_at

SHIFT = np.array([100.0, 50.0, 20.0])
# Of an initial similarity that is far from the truth: 1 % of scale, 1°, 2 m.
LOOSE = np.diag([0.01, 0.02, 0.02, 0.02, 2.0, 2.0, 2.0]) ** 2
CENTER_M, TURN_RAD = 0.02, 3e-4


@dataclass(frozen=True)
class Block:
    """Two rings of cameras above a place, as SfM left them in `model`; corrections are N(0, I) in the basis."""

    poses: CameraPoses
    basis: np.ndarray


def make_block(images: int = 12) -> Block:
    """Cameras whose corrections have σ of `CENTER_M` and `TURN_RAD`, free of any similarity of the whole."""
    angle = np.linspace(0, 2 * np.pi, images, endpoint=False)
    center = np.column_stack([40 * np.cos(angle), 40 * np.sin(angle), 30.0 + 10 * (np.arange(images) % 2)])
    rotation = np.swapaxes(looking_at(center, np.zeros_like(center)), 1, 2)
    unit = np.tile([TURN_RAD] * 3 + [CENTER_M] * 3, images)
    modes = similarity_modes(center).reshape(-1, 7) / unit[:, None]
    free = np.linalg.qr(modes, mode="complete")[0][:, 7:]
    return Block(CameraPoses(rotation, center), (unit[:, None] * free).reshape(images, 6, -1))


@dataclass(frozen=True)
class Truth:
    """What the measurements were made of."""

    geo_from_model: Similarity
    poses: CameraPoses


def draw_truth(block: Block, rng: np.random.Generator, covariance: np.ndarray = LOOSE) -> Truth:
    """A similarity and corrections, drawn from what is known of them beforehand."""
    similarity = LearnableSimilarity(Similarity(translation=SHIFT), covariance, pivot(block))
    corrections = CameraCorrections(block.poses, block.basis)
    with torch.no_grad():
        similarity.y.copy_(torch.from_numpy(rng.normal(size=7)))
        corrections.z.copy_(torch.from_numpy(rng.normal(size=len(corrections.z))))
    return Truth(similarity.current(), corrections.current())


def pivot(block: Block) -> np.ndarray:
    """Of the similarity: the middle of the cameras in `geo`."""
    return block.poses.cam_center_in_model.mean(axis=0) + SHIFT


def fixes_of(truth: Truth, sigma_m: np.ndarray, rng: np.random.Generator) -> FixTerm:
    """All cameras' fixes, with noise of the σ (3,) that they state."""
    position = truth.geo_from_model.apply(truth.poses.cam_center_in_model)
    return FixTerm(
        torch.arange(len(position)),
        torch.from_numpy(position + sigma_m * rng.normal(size=position.shape)),
        torch.from_numpy(np.tile(np.diag(1 / sigma_m), (len(position), 1, 1))),
    )


def marks_of(truth: Truth, points_in_model: np.ndarray, sigma_m: float, rng: np.random.Generator) -> ControlTerm:
    """Control points (J, 3) seen by all cameras with exact bearings, surveyed with σ `sigma_m`."""
    count, images = len(points_in_model), len(truth.poses.cam_center_in_model)
    point, camera = np.repeat(np.arange(count), images), np.tile(np.arange(images), count)
    ray = points_in_model[point] - truth.poses.cam_center_in_model[camera]
    bearing = np.einsum("kij,kj->ki", truth.poses.cam_from_model[camera], ray)
    surveyed = truth.geo_from_model.apply(points_in_model) + sigma_m * rng.normal(size=(count, 3))
    return ControlTerm(
        torch.from_numpy(point),
        torch.from_numpy(camera),
        torch.from_numpy(bearing / np.linalg.norm(bearing, axis=1, keepdims=True)),
        torch.full((len(point),), 1e-4, dtype=torch.float64),
        torch.from_numpy(surveyed),
        torch.eye(3, dtype=torch.float64).repeat(count, 1, 1) / sigma_m,
    )


def attitudes_of(
    truth: Truth, sigma_rad: float, rng: np.random.Generator, nominal_from_true: np.ndarray | None = None
) -> AttitudeTerm:
    """Recorded rotations of all cameras, with white noise, in axes from which the cameras' are turned."""
    true = truth.geo_from_model.rotation @ np.swapaxes(truth.poses.cam_from_model, 1, 2)
    recorded = true if nominal_from_true is None else true @ nominal_from_true.T
    noise = exp_so3(sigma_rad * rng.normal(size=(len(recorded), 3)))
    return AttitudeTerm(
        torch.arange(len(recorded)),
        torch.from_numpy(recorded @ noise),
        torch.eye(3, dtype=torch.float64).repeat(len(recorded), 1, 1) / sigma_rad,
    )


def pairs_of(truth: Truth, points_in_model: np.ndarray, sigma_m: float, rng: np.random.Generator) -> DistanceTerm:
    """All distances between points (J, 3), each point located on Earth with σ `sigma_m`."""
    located = truth.geo_from_model.apply(points_in_model) + sigma_m * rng.normal(size=points_in_model.shape)
    i, j = np.triu_indices(len(located), 1)
    return DistanceTerm(
        torch.from_numpy(np.linalg.norm(points_in_model[i] - points_in_model[j], axis=1)),
        None,
        torch.from_numpy(np.linalg.norm(located[i] - located[j], axis=1)),
        torch.full((len(i), 1, 1), 1 / (np.sqrt(2) * sigma_m), dtype=torch.float64),
        1.0,
    )


def terms(*every: Term | None) -> tuple[Term, ...]:
    """Those that there are."""
    return tuple(term for term in every if term is not None)


def problem_of(
    block: Block, fixes: FixTerm | None, marks: ControlTerm | None = None, weighting: Weighting = "whitened"
) -> GeoProblem:
    """From the block as SfM left it and an initial similarity that is a guess."""
    return problem_with(block, terms(fixes, marks), weighting=weighting)


def problem_with(
    block: Block,
    measured: tuple[Term, ...],
    errors: SystematicErrors | None = None,
    *,
    weighting: Weighting = "whitened",
    learned_weights: bool = False,
) -> GeoProblem:
    """The same with any measurements, and constant errors to be estimated."""
    return GeoProblem(
        LearnableSimilarity(Similarity(translation=SHIFT), LOOSE, pivot(block)),
        CameraCorrections(block.poses, block.basis),
        measured,
        weighting=weighting,
        errors=errors,
        learned_weights=learned_weights,
    )


def descend(problem: GeoProblem, steps: int = 500, variance_rate: float = 0.01) -> None:
    """The training's own way down: Adam at its rates, which fall to a twentieth."""
    rates = {"y": 0.1, "z": 0.01, "x": 0.1, "u": variance_rate}
    adam = torch.optim.Adam([{"params": [each], "rate": rates[name]} for name, each in problem.learned().items()])
    for step in range(steps):
        for group in adam.param_groups:
            group["lr"] = group["rate"] * 0.05 ** (step / steps)
        adam.zero_grad()
        problem.loss().backward()
        adam.step()


def squared_error(truth: Similarity, found: Similarity, covariance: np.ndarray, about: np.ndarray) -> float:
    """Squared Mahalanobis distance of a similarity from the truth; the covariance (7, 7) is about the pivot."""
    away = truth @ found.inverse()
    error = np.array([np.log(away.scale), *log_so3(away.rotation), *(away.apply(about) - about)])
    return float(error @ np.linalg.solve(covariance, error))


def contradicting(problem: GeoProblem, kind: type[Term]) -> list[int]:
    """Rows of a term that contradict the present estimate at the 99.9 % level."""
    (term,) = (term for term in problem.terms if isinstance(term, kind))
    chi2 = problem.whitened(problem.estimate())[term.kind].detach().square().sum(dim=1)
    return torch.nonzero(chi2 > outlier_gate(term.dimension))[:, 0].tolist()
