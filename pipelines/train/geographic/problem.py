"""Geographic losses of a training: their sum, their weights, their start at the adjustment, and their optimiser.

Whitened residuals make each term half of a χ², and the whole a maximum a posteriori estimate: but for L_rel and the
photographs, the loss is that of the adjustment, so that a training starts at its minimum. `paper` takes plain mean
squares in metres instead. A Cauchy kernel bounds the effect of one bad fix.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Literal, TypeVar

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust import terms as adjustment
from pipelines.adjust.state import State, SystematicErrors
from pipelines.adjust.system import Problem
from pipelines.geometry.bundle import bundle_information, coordinates_of, correction_basis
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.statistics import MEAN_WEIGHTED_CHI2
from pipelines.splat.surface import depth_at
from pipelines.survey.adjustment import GeolocatedPoints
from pipelines.train.adjusted_scene import AdjustedScene
from pipelines.train.geographic.terms import (
    ControlByDepth,
    ControlTerm,
    FixTerm,
    TensorTerm,
    control_by_depth,
    depth_residuals,
    distance_term,
    moved_tensors,
    tensor_term,
)
from pipelines.train.geographic.unknowns import (
    CameraCorrections,
    Estimate,
    LearnableErrors,
    LearnableSimilarity,
    cauchy,
)
from pipelines.train.options import GeographicOptions
from pipelines.train.schedule import JointOptions

Weighting = Literal["whitened", "paper"]
TermT = TypeVar("TermT", bound=TensorTerm)

# A learned variance stays within this factor of the stated one, or of 1 m² if residuals are not whitened.
_BOUND = {"whitened": 100.0, "paper": 1e4}
# Uncertainty of the stated variances: σ of the logarithm.
PRIOR_LOG_VARIANCE = 1.0
_VARIANCE_RATE = 0.01  # first learning rate of the log-variances


class TermWeights(torch.nn.Module):
    """Log-variances s = b tanh(u/b) of the terms, bounded by b so that no term vanishes or explodes; else s = 0.

    Kendall, Gal and Cipolla (doi 10.1109/CVPR.2018.00781, eq. 7): a term of squared residuals becomes
    e^{−s} χ² + d s with its log-variance s. Here the robust kernel is applied to e^{−s} χ², so that outliers do not
    raise the variance. The factor d is the mean of the kernel's weighted χ² under noise of the stated σ: the loss
    is then stationary at s = 0.

    Args:
        dimensions: of the residuals, by the kind of the term.
        learned: learn the variances; otherwise s = 0.
    """

    def __init__(self, dimensions: Mapping[str, int], weighting: Weighting, learned: bool) -> None:
        super().__init__()
        self.weighting, self.learned = weighting, learned
        self.bound = math.log(_BOUND[weighting])
        self._dimensions = dict(dimensions)
        self.u = torch.nn.Parameter(torch.zeros(len(dimensions) if learned else 0, dtype=torch.float64))

    def log_variance(self, kind: str) -> Tensor | None:
        """Return s of a term; None if the variances are not learned."""
        if not self.learned:
            return None
        return self.bound * torch.tanh(self.u[list(self._dimensions).index(kind)] / self.bound)

    def variance_factors(self) -> dict[str, float]:
        """Return e^s by term; empty if the variances are not learned."""
        log_variances = {kind: self.log_variance(kind) for kind in self._dimensions}
        return {kind: math.exp(float(s.detach())) for kind, s in log_variances.items() if s is not None}

    def price(self, kind: str) -> float:
        """Return d, the factor of s in the loss of one residual of a term."""
        dimension = self._dimensions[kind]
        return MEAN_WEIGHTED_CHI2[dimension] if self.weighting == "whitened" else float(dimension)

    def prior(self) -> Tensor:
        """Return the prior of the variances, a χ² of s; zero if none is stated or none learned. Scalar."""
        if not self.learned or self.weighting == "paper":
            return self.u.new_zeros(())
        s = self.bound * torch.tanh(self.u / self.bound)
        return (s / PRIOR_LOG_VARIANCE).square().sum()


class GeoProblem(torch.nn.Module):
    """Geographic losses, with the prior of bundle adjustment on the corrections of the cameras.

    Args:
        similarity: `geo_from_model`.
        cameras: poses in `model`.
        terms: the observations, at most one term of a kind; none: the loss is zero, and nothing moves.
        errors: systematic errors of the measurements; None: none.
        weighting: "whitened" (maximum a posteriori) or "paper" (plain mean squares).
        learned_weights: learn a variance factor of each term.
        control_by_depth: marks of the control points, if training projects them onto the rendered depth. Then
            `depth_loss` takes the place of the control points' term in the loss. None: the term is in it.
    """

    def __init__(
        self,
        similarity: LearnableSimilarity,
        cameras: CameraCorrections,
        terms: Sequence[TensorTerm] = (),
        *,
        errors: LearnableErrors | None = None,
        weighting: Weighting = "whitened",
        learned_weights: bool = False,
        control_by_depth: ControlByDepth | None = None,
    ) -> None:
        super().__init__()
        self.similarity, self.cameras = similarity, cameras
        self.errors = errors or LearnableErrors(SystematicErrors(), np.zeros(0), np.zeros(0))
        self.terms, self.control_by_depth = tuple(terms), control_by_depth
        self.weighting = weighting
        self.weights = TermWeights({term.kind: term.dimension for term in terms}, weighting, learned_weights)

    def term(self, kind: type[TermT]) -> TermT | None:
        """Return the term of a kind; None if there is none."""
        return next((term for term in self.terms if isinstance(term, kind)), None)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GeoProblem:
        """Move the observations between devices together with the parameters."""
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.terms = tuple(moved_tensors(term, fn) for term in self.terms)
        if self.control_by_depth is not None:
            self.control_by_depth = moved_tensors(self.control_by_depth, fn)
        return self

    def learned(self) -> dict[str, torch.nn.Parameter]:
        """Return the learned parameters by name: similarity y, cameras z, and, if any, errors x and weights u."""
        more = {"x": self.errors.x, "u": self.weights.u}
        return {"y": self.similarity.y, "z": self.cameras.z} | {k: p for k, p in more.items() if len(p)}

    def estimate(self) -> Estimate:
        """Return the present estimate, differentiable in all parameters of `learned`."""
        errors, vector = self.errors.errors, self.errors.vector()
        return Estimate(*self.cameras.moved(), self.similarity(), errors, vector, self.cameras.lens())

    def state(self) -> State:
        """Return the present values as a state of the adjustment."""
        with torch.no_grad():
            tensors = self.cameras.corrections(), self.cameras.lens(), self.errors.vector()
            return State(self.similarity.current(), *(tensor.cpu().numpy() for tensor in tensors))

    def losses(self) -> dict[str, Tensor]:
        """Return the losses by kind: of each term, a mean of ρ; of the cameras; and of the systematic errors."""
        at = self.estimate()
        values = {}
        for term in self.terms:
            in_metres = self.weighting == "paper" and term.in_metres
            residual = term.residuals(at) if in_metres else term.whitened(at)
            values[term.kind] = self._rho(term, residual).mean()
        # A problem that freezes the cameras has no z, and no loss.
        values["cameras"] = self.cameras.z.square().sum() / self._normaliser()
        if len(at.vector):
            values["errors"] = self.errors.prior() / self._normaliser()
        return values

    def loss(self) -> Tensor:
        """Return L_abs + λ_gcp L_gcp + λ_rel L_rel + λ_att L_att + the losses of cameras and errors; scalar.

        - Whitened: every χ² has the same weight. λ is therefore the number of observations of a term over the
          number of fixes, times `TensorTerm.share`, which is below 1 for L_rel only.
        - Paper: every λ is 1, and cameras and errors have no loss.
        - Control points through the rendered depth are not included: see `depth_loss`.
        """
        values = self.losses()
        whitened = self.weighting == "whitened"
        total = values["cameras"] if whitened else 0.0 * values["cameras"]
        if whitened and "errors" in values:
            total = total + values["errors"]
        for term in self.terms:
            if self.control_by_depth is None or not isinstance(term, ControlTerm):
                total = total + self._factor(term) * self._priced(term, values[term.kind])
        return total + self.weights.prior() / self._normaliser() if self.weights.learned else total

    def sees_by_depth(self, camera: int) -> bool:
        """Return whether a view has marks for `depth_loss`, and so needs a rendered depth."""
        return self.control_by_depth is not None and camera in self.control_by_depth.rows

    def depth_loss(self, camera: int, depth_m: Tensor, alpha: Tensor, pinhole: Pinhole) -> Tensor | None:
        """Return λ_gcp L_gcp of one view for control points through the rendered depth; None: it has no marks.

        The render has depths (H, W) in metres, alpha (H, W), and the pinhole of these pixels with the present lens.

        - The gradient reaches similarity, camera and Gaussians.
        - Each point has weight 1, whatever the number of its marks.
        - The loss of a view is scaled by the number of views: its mean over the views is the loss of all marks.
        - Marks on a nearly transparent render have weight 0: there is no surface yet.
        """
        marks, control = self.control_by_depth, self.term(ControlTerm)
        if marks is None or control is None or not self.sees_by_depth(camera):
            return None
        rows = marks.rows[camera]
        xy = marks.rays(rows, self.cameras.lens())
        depth, seen = depth_at(depth_m, alpha, xy, pinhole)
        surveyed = marks.position_in_geo[rows]
        if (columns := self.errors.errors.columns("earlier-date")) is not None:
            surveyed = surveyed - self.errors.vector()[columns]
        residual = depth_residuals(self.cameras.pose(camera), self.similarity(), surveyed, xy, depth)
        if self.weighting == "whitened":
            residual = (marks.root_information[rows] @ residual[:, :, None])[:, :, 0]
        share = marks.share[rows] * seen
        rho = self._priced(control, self._rho(control, residual))
        return self._factor(control) * marks.views / len(control) * (share * rho).sum()

    def _normaliser(self) -> int:
        """Return N of the means: the number of fixes, or of cameras if there is no fix."""
        fixes = self.term(FixTerm)
        return len(self.cameras.center) if fixes is None else len(fixes)

    def _factor(self, term: TensorTerm) -> float:
        """Return λ of a term."""
        return 1.0 if self.weighting == "paper" else term.share * len(term) / self._normaliser()

    def _rho(self, term: TensorTerm, residual: Tensor) -> Tensor:
        """Return ρ (M,) of residuals (M, d), divided by the learned σ of their term."""
        s = self.weights.log_variance(term.kind)
        scaled = residual if s is None else torch.exp(-0.5 * s) * residual
        chi2 = scaled.square().sum(dim=1)
        return chi2 if self.weighting == "paper" else cauchy(chi2, term.dimension)

    def _priced(self, term: TensorTerm, value: Tensor) -> Tensor:
        """Return a term's ρ plus the normalisation of its learned variance."""
        s = self.weights.log_variance(term.kind)
        return value if s is None else value + self.weights.price(term.kind) * s


def refining_problem(
    adjusted: AdjustedScene,
    measured: Problem,
    options: GeographicOptions,
    points: GeolocatedPoints | None = None,
    seed: int = 0,
) -> GeoProblem:
    """Return the problem of a training that refines similarity, cameras, lens and systematic errors.

    With `paper` the lens stays, because plain mean squares compare no lens with the photographs. L_rel uses the
    points of `geolocate`, None: the cameras and their fixes; an InputError: points of another model.
    """
    scene, state, record = adjusted.scene, adjusted.state(measured.errors), adjusted.adjustment.geo_from_model
    terms: list[TensorTerm] = []
    by_depth = None
    for term in measured.measured:
        if isinstance(term, adjustment.LocalFrame):
            continue  # the gauge: no loss depends on it, so that nothing moves it
        if isinstance(term, adjustment.ControlPoints) and options.gcp_mode == "depth":
            by_depth, on_surface = control_by_depth(scene, adjusted.survey, term)
            terms.append(tensor_term(on_surface, measured.errors))
        else:
            terms.append(tensor_term(term, measured.errors))
        if isinstance(term, adjustment.Fixes) and options.distance_loss and len(term) > 1:
            distances = distance_term(scene, term, points, seed)
            terms += [] if distances is None else [distances]
    lens_follows = options.geo_weighting == "whitened"
    bundle = scene.bundle if lens_follows else bundle_information(scene.network)
    basis = correction_basis(bundle, lens_follows=lens_follows)
    z = coordinates_of(scene.bundle, state.correction)
    lens = basis.lens_matrix if lens_follows else np.zeros((len(state.lens), len(z)))
    return GeoProblem(
        LearnableSimilarity(state.geo_from_model, np.array(record.covariance), np.array(record.pivot)),
        CameraCorrections(scene.poses, basis.matrix, lens, state, z),
        terms,
        errors=LearnableErrors(measured.errors, *adjusted.error_estimates(measured.errors)),
        weighting=options.geo_weighting,
        learned_weights=options.variance_factors == "learned",
        control_by_depth=by_depth,
    )


def frozen_problem(adjusted: AdjustedScene) -> GeoProblem:
    """Return the problem of a training that freezes similarity, cameras and lens at the adjustment."""
    record, poses = adjusted.adjustment.geo_from_model, adjusted.adjustment.poses
    state = replace(adjusted.state(SystematicErrors()), correction=np.zeros((len(poses.cam_from_model), 6)))
    return GeoProblem(
        LearnableSimilarity(state.geo_from_model, np.array(record.covariance), np.array(record.pivot)),
        CameraCorrections.frozen(poses, state),
    )


_NAMES = {
    "y": "the similarity",
    "z": "the cameras",
    "x": "the systematic errors",
    "u": "the weights of the losses",
}
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


class GeographicAdam:
    """Adam for what all views share: moments and rates of the unknowns of a problem."""

    def __init__(self, problem: GeoProblem, options: JointOptions, device: torch.device) -> None:
        self._problem, self._device = problem, device
        rates = {
            "y": options.similarity_rate,
            "z": options.camera_rate,
            "x": options.similarity_rate,
            "u": _VARIANCE_RATE,
        }
        # One kernel for each of these short vectors on a GPU, in place of a dozen whose launches take longer than
        # their work.
        self.adam = torch.optim.Adam(
            [{"params": [parameter], "rate": rates[name]} for name, parameter in problem.learned().items()],
            fused=device.type == "cuda",
        )

    def named(self) -> dict[str, Tensor]:
        """Return the unknowns by what they are called in messages."""
        return {_NAMES[name]: parameter for name, parameter in self._problem.learned().items()}

    def step(self, factor: float) -> None:
        """Move all unknowns by their gradients, at their rates times `factor`."""
        for group in self.adam.param_groups:
            group["lr"] = factor * group["rate"]
        self.adam.step()

    def state(self) -> dict[str, Tensor]:
        """Return unknowns and moments by name, for a checkpoint."""
        parameters = self._problem.learned()
        state: dict[str, Tensor] = {**parameters}
        for name, parameter in parameters.items():
            moments = self.adam.state[parameter]
            state |= {f"{name}_{key}": torch.as_tensor(value) for key, value in moments.items()}
        return state

    def restore(self, state: Mapping[str, Tensor]) -> None:
        for name, parameter in self._problem.learned().items():
            with torch.no_grad():
                parameter.copy_(state[name])
            # A fused Adam keeps its count of steps on the device.
            self.adam.state[parameter] = {
                key: state[f"{name}_{key}"].to(self._device) for key in _MOMENTS if f"{name}_{key}" in state
            }
