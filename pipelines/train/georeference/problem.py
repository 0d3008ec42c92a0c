"""What a training's georeference costs: the adjustment's own χ², or the losses of the paper; and its optimiser.

`joint`: the measurements and the photographs' observations have made a solution, and a normal matrix N. A motion
from it costs (ξ − ξ̂)ᵀ N (ξ − ξ̂): every fix, control point, mark and attitude is in N. A training therefore starts
at the minimum of this loss, and any number of cameras moves jointly.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pipelines.adjust.posterior import Posterior
from pipelines.adjust.root import information_root
from pipelines.adjust.state import State, SystematicErrors
from pipelines.adjust.system import NormalMatrix, Problem, linearised, posterior_weights
from pipelines.adjust.terms import ControlPoints, Fixes
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.surface import depth_at
from pipelines.survey.adjustment import GeolocatedPoints
from pipelines.survey.scene import Scene
from pipelines.survey.solution import Solution
from pipelines.survey.survey import Survey
from pipelines.train.georeference.beside import DepthMarks, LongPairs, depth_marks, depth_residuals, long_pairs
from pipelines.train.georeference.paper import PaperLosses
from pipelines.train.georeference.unknowns import SolutionUnknowns, cauchy, moved_tensors
from pipelines.train.options import GeographicOptions
from pipelines.train.schedule import JointOptions
from pipelines.train.solution_state import state_of


class GeoProblem(torch.nn.Module):
    """Geographic losses of the unknowns.

    Args:
        unknowns: similarity, cameras, lens, systematic errors.
        normaliser: number of fixes, or of cameras if there is no fix: losses are means over them.
        pairs: of L_rel; None: it is not used.
        marks: of the control points, if training projects them onto the rendered depth (`depth_loss`).
        paper: losses of the paper in place of the χ² of the adjustment.
    """

    def __init__(
        self,
        unknowns: SolutionUnknowns,
        normaliser: int,
        *,
        pairs: LongPairs | None = None,
        marks: DepthMarks | None = None,
        paper: PaperLosses | None = None,
    ) -> None:
        super().__init__()
        self.unknowns, self.normaliser = unknowns, normaliser
        self.pairs, self.marks, self.paper = pairs, marks, paper

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GeoProblem:
        """Move the observations between devices together with the parameters."""
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.pairs = None if self.pairs is None else moved_tensors(self.pairs, fn)
        self.marks = None if self.marks is None else moved_tensors(self.marks, fn)
        return self

    def losses(self) -> dict[str, Tensor]:
        """Return the losses by kind, as means: `solution` or those of the paper, and `relative`."""
        at = self.unknowns
        values = {"solution": at.chi2() / self.normaliser} if self.paper is None else self.paper.losses(at)
        if self.pairs is not None:
            residual = self.pairs.residuals(at)
            squares = residual.square() if self.paper else cauchy((self.pairs.weight * residual).square(), 1)
            values["relative"] = squares.mean()
        return values

    def loss(self) -> Tensor:
        """Return the sum of the losses; scalar.

        - The χ² has weight 1, and L_rel that of its number of pairs over the number of fixes, times its share.
        - Paper: every weight is 1.
        - Control points through the rendered depth are not included: see `depth_loss`.
        """
        values = self.losses()
        if self.paper is None and self.pairs is not None:
            values["relative"] = self.pairs.share * len(self.pairs) / self.normaliser * values["relative"]
        total = 0.0 * self.unknowns.chi2()
        for value in values.values():
            total = total + value
        return total

    def sees_by_depth(self, camera: int) -> bool:
        """Return whether a view has marks for `depth_loss`, and so needs a rendered depth."""
        return self.marks is not None and camera in self.marks.rows

    def depth_loss(self, camera: int, depth_m: Tensor, alpha: Tensor, pinhole: Pinhole) -> Tensor | None:
        """Return L_gcp of one view for control points through the rendered depth; None: it has no marks.

        The render has depths (H, W) in metres, alpha (H, W), and the pinhole of these pixels with the present lens.

        - The gradient reaches similarity, camera and Gaussians.
        - Each point has weight 1, whatever the number of its marks.
        - The loss of a view is scaled by the number of views: its mean over the views is the loss of all marks.
        - Marks on a nearly transparent render have weight 0: there is no surface yet.
        """
        marks, at = self.marks, self.unknowns
        if marks is None or not self.sees_by_depth(camera):
            return None
        rows = marks.rows[camera]
        xy = marks.rays(rows, at.lens())
        depth, seen = depth_at(depth_m, alpha, xy, pinhole)
        surveyed = marks.position_in_geo[rows]
        if marks.earlier is not None:
            surveyed = surveyed - at.errors()[marks.earlier]
        residual = depth_residuals(at.pose(camera), at.similarity(), surveyed, xy, depth)
        if self.paper is not None:
            rho = residual.square().sum(dim=1)
        else:
            rho = cauchy((marks.root_information[rows] @ residual[:, :, None])[:, :, 0].square().sum(dim=1), 3)
        over = marks.points if self.paper else self.normaliser
        return marks.views / over * (marks.share[rows] * seen * rho).sum()


def refining_problem(
    posterior: Posterior,
    survey: Survey,
    scene: Scene,
    measured: Problem,
    options: GeographicOptions,
    *,
    points: GeolocatedPoints | None = None,
    seed: int = 0,
) -> GeoProblem:
    """Return the problem of a training that refines similarity, cameras, lens and systematic errors.

    With `paper` lens and systematic errors stay, because plain mean squares compare no lens with the photographs.
    With control points by depth or without them, the χ² is that of all other measurements. L_rel uses the points of
    `geolocate`, None: the cameras and their fixes.

    Raises:
        DegenerateGeometryError: the other measurements leave the similarity open.
        InputError: the points are those of another model.
    """
    start, fixes = state_of(posterior.solution, scene, measured.errors), measured.term(Fixes.kind)
    control, plain = measured.term(ControlPoints.kind), options.georeference == "paper"
    marks = None
    if options.gcp_mode == "depth" and isinstance(control, ControlPoints):
        marks = depth_marks(scene, survey, control, measured.errors)
    held = tuple(term for term in measured.measured if marks is None or term is not control)
    normal = _normal_of(posterior, replace(measured, measured=held), start)
    root = information_root(normal, posterior.followed, posterior.lens, len(measured.errors), frozen_border=plain)
    pairs = None
    if isinstance(fixes, Fixes) and options.distance_loss and len(fixes) > 1:
        pairs = long_pairs(scene, fixes, points, seed)
    return GeoProblem(
        SolutionUnknowns(scene.poses, start, root, posterior.lens),
        len(scene.sparse.image_name) if fixes is None else len(fixes),
        pairs=pairs,
        marks=marks,
        paper=PaperLosses(measured, control_points=marks is None) if plain else None,
    )


def _normal_of(posterior: Posterior, held: Problem, start: State) -> NormalMatrix:
    """Return the normal matrix beside a solution; without its control points, if those in use have none."""
    normal, border = posterior.normal, len(posterior.lens) + len(held.errors)
    in_solution = any(one.kind == "control point" and one.used for one in posterior.solution.measurements)
    same_measurements = held.term(ControlPoints.kind) is not None or not in_solution
    # With multipliers of the SfM points' mean, or without.
    if same_measurements and len(normal.corner) in (border, border + 14):
        return normal
    near = linearised(held, start)
    return near.normal(posterior_weights(near.residuals))


def frozen_problem(solution: Solution, scene: Scene) -> GeoProblem:
    """Return the problem of a training that freezes similarity, cameras and lens at a solution."""
    poses = solution.poses
    state = replace(
        state_of(solution, scene, SystematicErrors()), correction=np.zeros((len(poses.cam_from_model), 6))
    )
    return GeoProblem(SolutionUnknowns.frozen(poses, state), len(poses.cam_from_model))


_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


class GeographicAdam:
    """Adam for what all views share: the coordinates of the unknowns, in units of their σ."""

    def __init__(self, problem: GeoProblem, options: JointOptions, device: torch.device) -> None:
        self._w, self._rate, self._device = problem.unknowns.w, options.solution_rate, device
        # One kernel for the short vector on a GPU, in place of a dozen whose launches take longer than their work.
        self.adam = torch.optim.Adam([self._w], fused=device.type == "cuda")

    def named(self) -> dict[str, Tensor]:
        """Return the unknowns by what they are called in messages."""
        return {"similarity and cameras": self._w} if len(self._w) else {}

    def step(self, factor: float) -> None:
        """Move all unknowns by their gradients, at their rate times `factor`."""
        for group in self.adam.param_groups:
            group["lr"] = factor * self._rate
        self.adam.step()

    def state(self) -> dict[str, Tensor]:
        """Return unknowns and moments by name, for a checkpoint."""
        moments = self.adam.state[self._w].items()
        return {"w": self._w, **{f"w_{key}": torch.as_tensor(value) for key, value in moments}}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        with torch.no_grad():
            self._w.copy_(state["w"])
        # A fused Adam keeps its count of steps on the device.
        self.adam.state[self._w] = {
            key: state[f"w_{key}"].to(self._device) for key in _MOMENTS if f"w_{key}" in state
        }
