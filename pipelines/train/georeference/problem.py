"""Cost of a training's georeference: the adjustment's own χ², or the losses of the paper; and its optimiser.

`joint`: the measurements and the photographs' observations have made a solution, and a normal matrix N. A motion
from it costs (ξ − ξ̂)ᵀ N (ξ − ξ̂): every fix, control point, mark and attitude is in N. A training therefore starts
at the minimum of this loss, and any number of cameras moves jointly.

`paper`: L_abs and L_gcp as plain mean squares in metres (GeoRefGS section 2.4). The residuals and their derivatives
are those of the adjustment's terms, not weighted by their σ.

Beside either, in training alone: L_rel, a function of other measurements and no measurement itself, and control
points through the rendered depth.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam

from pipelines.adjust.posterior import Posterior
from pipelines.adjust.root import information_root
from pipelines.adjust.state import State, SystematicErrors
from pipelines.adjust.system import NormalMatrix, Problem, linearised, posterior_weights
from pipelines.adjust.terms import At, ControlPoints, Fixes, Term
from pipelines.core.errors import InputError
from pipelines.core.types import AutogradContext, FloatArray, IntArray
from pipelines.geometry.bundle import similarity_modes
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.statistics import root_information
from pipelines.splat.surface import depth_at
from pipelines.survey.scene import SparseScene
from pipelines.survey.solution import GeolocatedPoints, Solution
from pipelines.survey.survey import Survey
from pipelines.train.georeference.unknowns import SolutionUnknowns, TensorSimilarity, cauchy, moved_tensors
from pipelines.train.options import GeographicOptions
from pipelines.train.schedule import JointOptions
from pipelines.train.solution_state import state_of

# σ of the rendered surface at a mark, as a fraction of its distance: 12 cm at 60 m.
SURFACE_SIGMA = 2e-3
_WORTH = 0.1  # share of the fixes' information on the scale that L_rel may repeat
_PAIRS = 300
# Candidates drawn for each pair in use. The longest are used, because short pairs hardly constrain the scale.
_DRAWN = 3


@dataclass(frozen=True)
class LongPairs:
    """Distances between P pairs of intersected points, or of cameras with fixes: L_rel.

    The distances are functions of the fixes, not independent measurements.

    The points are fixed at their SfM positions. In the bundle, they would follow the corrections of the cameras,
    which keep their mean position, rotation and size (`SolutionUnknowns`). Fixed points are therefore right to
    first order for the scale, the only quantity that the pairs determine.
    """

    distance_in_model: Tensor | None  # (P,) float64; None: between the cameras below
    camera: Tensor | None  # (P, 2) int64 indices into the cameras; None: between fixed points
    distance_in_geo: Tensor  # (P,) float64 metres
    weight: Tensor  # (P,) float64, 1/σ of the measured distance in 1/m
    share: float = 1.0  # limits their information on the scale to a tenth of that of the fixes

    def __len__(self) -> int:
        return len(self.distance_in_geo)

    def residuals(self, at: SolutionUnknowns) -> Tensor:
        """Return s |x_i − x_j| − |X_i − X_j| (P,) in metres."""
        if self.camera is None:
            assert self.distance_in_model is not None
            distance = self.distance_in_model
        else:
            center = at.moved()[1]
            distance = (center[self.camera[:, 0]] - center[self.camera[:, 1]]).norm(dim=1)
        return at.similarity().scale * distance - self.distance_in_geo


def long_pairs(scene: SparseScene, fixes: Fixes, points: GeolocatedPoints | None, seed: int) -> LongPairs | None:
    """Return 300 long distances across the scene: between located points, else between cameras with fixes.

    Located points are functions of the same few fixes (`adjust.alignment`), and contain the lens's errors as well.
    Counted as independent measurements, hundreds of pairs would claim a σ of the scale many times below that of the
    fixes. Their purpose is to steady the scale, not to decide it. None: their share of the information is zero.

    There are at least two fixes; the seed is that of the pairs. An InputError: points of another model.
    """
    if points is not None and not np.array_equal(points.point_id, scene.sparse.point_id):
        raise InputError(
            "points-of-another-model",
            "The located points belong to another SfM model: run `georef geolocate` again.",
        )
    located = np.zeros(0, dtype=np.int64) if points is None else np.flatnonzero(points.inlier)
    if points is not None and len(located) >= 2:
        in_model, in_geo, cov_in_geo = scene.point_in_model, points.position_in_geo, points.cov_in_geo
        in_model, in_geo, cov_in_geo = in_model[located], in_geo[located], cov_in_geo[located]
        i, j = _longest(in_model, seed)
        pairs, inside = None, torch.from_numpy(np.linalg.norm(in_model[i] - in_model[j], axis=1))
    else:
        in_geo, cov_in_geo = fixes.position_in_geo, fixes.cov
        i, j = _longest(scene.poses.cam_center_in_model[fixes.camera], seed)
        pairs, inside = torch.from_numpy(np.column_stack([fixes.camera[i], fixes.camera[j]])), None
    apart = in_geo[i] - in_geo[j]
    distance = np.linalg.norm(apart, axis=1)
    along = apart / distance[:, None]
    variance = np.einsum("pi,pij,pj->p", along, cov_in_geo[i] + cov_in_geo[j], along)
    distances = LongPairs(inside, pairs, torch.from_numpy(distance), torch.from_numpy(variance**-0.5))
    of_pairs = float((distances.distance_in_geo * distances.weight).square().sum())
    root, place = fixes.root_information, fixes.position_in_geo
    weight = (root**2).sum(axis=(1, 2))
    arm = place - weight @ place / weight.sum()
    of_fixes = float(((root @ arm[:, :, None]) ** 2).sum())  # on ln s, about the weighted mean of the fixes
    share = min(1.0, _WORTH * of_fixes / of_pairs) if of_pairs > 0 else 0.0
    return replace(distances, share=share) if share > 0 else None


def _longest(place: FloatArray, seed: int) -> tuple[IntArray, IntArray]:
    """Return the row numbers (P,), (P,) of pairs of points (n, 3): the longest third of randomly drawn pairs."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, len(place), _DRAWN * _PAIRS)
    second = (first + rng.integers(1, len(place), len(first))) % len(place)
    length = np.linalg.norm(place[first] - place[second], axis=1)
    longest = np.sort(np.argsort(-length, kind="stable")[:_PAIRS])
    return first[longest], second[longest]


@dataclass(frozen=True)
class DepthMarks:
    """Image marks of the control points, K in all, each projected onto the rendered surface on its own."""

    camera: Tensor  # (K,) int64 indices
    xy: Tensor  # (K, 2) float64, x/z and y/z of the marks' rays
    xy_by_lens: Tensor  # (K, 2, L) float64, derivative of `xy` by the lens parameters
    position_in_geo: Tensor  # (K, 3) float64 metres, surveyed
    root_information: Tensor  # (K, 3, 3) float64 of survey, mark and surface together, in 1/m
    share: Tensor  # (K,) float64, one over the number of marks of the same point
    points: int  # J, of the control points
    views: int  # training views, all rendered equally often
    rows: dict[int, slice]  # slice of the K marks, by camera
    earlier: slice | None = None  # place of the earlier date's error among the systematic errors

    def rays(self, rows: slice, lens: Tensor) -> Tensor:
        """Return the rays x/z and y/z (K', 2) of a slice of the marks, to first order in the lens change (L,)."""
        return self.xy[rows] + self.xy_by_lens[rows] @ lens if len(lens) else self.xy[rows]


def depth_marks(scene: SparseScene, survey: Survey, marks: ControlPoints, errors: SystematicErrors) -> DepthMarks:
    """Return the marks of the control points for projection onto the rendered surface.

    The surface's error has a σ of `SURFACE_SIGMA` times the distance, along each axis. All marks of a point share
    this error, because they show one piece of the surface. Marks in test views are not rendered.
    """
    order = np.argsort(marks.camera, kind="stable")
    order = order[np.isin(marks.camera[order], scene.train)]
    point, camera, bearing = marks.point[order], marks.camera[order], marks.bearing_in_cam[order]
    center = scene.geo_from_model.apply(scene.poses.cam_center_in_model)[camera]
    distance = np.linalg.norm(marks.position_in_geo[point] - center, axis=1)
    surveyed = {each.name: np.array(each.cov_in_geo) for each in survey.control_points}
    lateral, surface = marks.sigma_rad[order] * distance, SURFACE_SIGMA * distance
    of_survey = np.array([surveyed[name] for name in marks.name])[point]
    of_mark = of_survey + (lateral**2 + surface**2)[:, None, None] * np.eye(3)
    by_lens, z = marks.bearing_by_lens[order], bearing[:, 2:, None]
    count = np.bincount(point, minlength=len(marks))
    seen = [np.searchsorted(camera, [index, index + 1]).tolist() for index in np.unique(camera)]
    return DepthMarks(
        camera=torch.from_numpy(camera),
        xy=torch.from_numpy(bearing[:, :2] / bearing[:, 2:]),
        xy_by_lens=torch.from_numpy(by_lens[:, :2] / z - bearing[:, :2, None] * by_lens[:, 2:] / z**2),
        position_in_geo=torch.from_numpy(marks.position_in_geo[point]),
        root_information=torch.from_numpy(root_information(of_mark)),
        share=torch.from_numpy(1.0 / count[point]),
        points=len(marks),
        views=len(scene.train),
        earlier=errors.columns("earlier-date"),
        rows={int(index): slice(*ends) for index, ends in zip(np.unique(camera), seen, strict=True)},
    )


def depth_residuals(
    pose: tuple[Tensor, Tensor],
    geo_from_model: TensorSimilarity,
    position_in_geo: Tensor,
    xy: Tensor,
    depth_m: Tensor,
) -> Tensor:
    """Return T(c_i + R_iᵀ z (x, y, 1)) − X_j (K, 3) in metres, of the K marks of one camera.

    T is `geo_from_model`; the pose has a rotation cam ← model (3, 3) and a centre (3,). Each mark has the surveyed
    position (K, 3), its ray x/z and y/z (K, 2), and the rendered depth (K,) along the camera's z axis.
    """
    rotation, center = pose
    ray = torch.nn.functional.pad(xy, (0, 1), value=1.0)
    point = center + (depth_m[:, None] * ray) @ rotation
    return geo_from_model.apply(point) - position_in_geo


NAMES = {Fixes.kind: "absolute", ControlPoints.kind: "control"}


class _MeanSquares(torch.autograd.Function):
    """Mean squared residuals (T,) of T terms, of the corrections (n, 6) and the similarity (7,) of the whole."""

    @staticmethod
    def forward(ctx: AutogradContext, corrections: Tensor, whole: Tensor, at: At, terms: Sequence[Term]) -> Tensor:
        modes = similarity_modes(at.center)
        by_corrections = np.zeros((len(terms), *corrections.shape))
        values = np.zeros(len(terms))
        for row, term in enumerate(terms):
            slopes = term.slopes(at)
            values[row] = (slopes.residual**2).sum(axis=1).mean()
            scaled = 2.0 / len(term) * slopes.residual[slopes.row]
            np.add.at(by_corrections[row], slopes.camera, np.einsum("ed,edx->ex", scaled, slopes.by_pose))
        # A similarity of the whole moves the cameras by its modes.
        by_whole = np.einsum("tnx,nxs->ts", by_corrections, modes)
        ctx.save_for_backward(*(torch.from_numpy(by).to(corrections.device) for by in (by_corrections, by_whole)))
        return torch.from_numpy(values).to(corrections.device)

    @staticmethod
    def backward(ctx: AutogradContext, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        (gradient,) = gradients
        by_corrections, by_whole = ctx.saved_tensors
        return (gradient[:, None, None] * by_corrections).sum(dim=0), gradient @ by_whole, None, None


class PaperLosses:
    """L_abs of the fixes and L_gcp of the control points of a problem, as functions of the unknowns."""

    def __init__(self, problem: Problem, *, control_points: bool) -> None:
        kinds = (Fixes.kind, ControlPoints.kind) if control_points else (Fixes.kind,)
        self._problem = problem
        self._terms = tuple(term for term in problem.measured if term.kind in kinds)

    def losses(self, at: SolutionUnknowns) -> dict[str, Tensor]:
        """Return the losses by their names."""
        if not self._terms:
            return {}
        squares = _MeanSquares.apply(  # type: ignore[no-untyped-call]
            at.corrections(), at.common_motion(), self._problem.at(at.state()), self._terms
        )
        return {NAMES[term.kind]: squares[row] for row, term in enumerate(self._terms)}


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
    scene: SparseScene,
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


def frozen_problem(solution: Solution, scene: SparseScene) -> GeoProblem:
    """Return the problem of a training that freezes similarity, cameras and lens at a solution."""
    poses = solution.poses
    state = replace(
        state_of(solution, scene, SystematicErrors()), correction=np.zeros((len(poses.cam_from_model), 6))
    )
    return GeoProblem(SolutionUnknowns.frozen(poses, state), len(poses.cam_from_model))


_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


class GeographicAdam:
    """Adam for what all views share: the coordinates of the unknowns, in units of their σ.

    By torch's function: its class loads torch's compiler, for two seconds.
    """

    def __init__(self, problem: GeoProblem, options: JointOptions, device: torch.device) -> None:
        self._w, self._rate, self._device = problem.unknowns.w, options.solution_rate, device
        self._moments = {name: torch.zeros_like(self._w) for name in _MOMENTS}
        self._moments["step"] = torch.zeros((), device=device)

    def clear(self) -> None:
        """Forget the gradients."""
        self._w.grad = None

    def named(self) -> dict[str, Tensor]:
        """Return the unknowns by what they are called in messages."""
        return {"similarity and cameras": self._w} if len(self._w) else {}

    def step(self, factor: float) -> None:
        """Move all unknowns by their gradients, at their rate times `factor`."""
        if self._w.grad is None:
            return
        step, average, square = (self._moments[name] for name in _MOMENTS)
        # One kernel for the short vector on a GPU, in place of a dozen whose launches take longer than their work.
        fused = self._device.type == "cuda"
        with torch.no_grad():
            adam(
                [self._w], [self._w.grad], [average], [square], [], [step],
                foreach=False, fused=fused, amsgrad=False, beta1=0.9, beta2=0.999, lr=factor * self._rate,
                weight_decay=0.0, eps=1e-8, maximize=False,
            )  # fmt: skip

    def state(self) -> dict[str, Tensor]:
        """Return unknowns and moments by name, for a checkpoint."""
        return {"w": self._w, **{f"w_{name}": values for name, values in self._moments.items()}}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        with torch.no_grad():
            self._w.copy_(state["w"])
            for name, values in self._moments.items():
                values.copy_(state.get(f"w_{name}", torch.zeros_like(values)))
