"""Geographic problem of a training, set up from the products of earlier stages and the options of training."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.adjust.cameras import CameraCorrections, HeldCorrections
from pipelines.adjust.control_by_depth import ControlByDepth
from pipelines.adjust.measurements import attitude_term, control_by_depth, control_term, distance_term, fix_term
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.similarity_fit import RotationPrior
from pipelines.adjust.start import begin, bias_pays
from pipelines.adjust.systematic import SystematicErrors
from pipelines.adjust.terms import AttitudeTerm, ControlTerm, DistanceTerm, FixTerm, PlaneTerm, Term
from pipelines.core.errors import InputError
from pipelines.geometry.bundle_information import BundleInformation
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.similarity import moved_pivot
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.initial_similarity import InitialSimilarity
from pipelines.scene.scene import Scene
from pipelines.scene.survey import Survey

# With fewer control points, a bias of the fixes cannot be separated from a blunder of a control point.
_LEAST_CONTROL = 3


def geo_problem(
    scene: Scene,
    survey: Survey,
    initial: InitialSimilarity,
    options: GeographicOptions,
    *,
    points: GeolocatedPoints | None = None,
    planes: PlaneTerm | None = None,
    seed: int = 0,
) -> GeoProblem:
    """Return the problem of similarity, cameras and constant errors under the survey's measurements.

    Args:
        scene: cameras and points at the start of the training.
        survey: the measurements.
        initial: similarity of `init-sim3`; the measurements that it has rejected stay out.
        options: which measurements are used, their weights, and the constant errors to estimate.
        points: of `geolocate`, for L_rel; None: L_rel uses the cameras and their fixes.
        planes: of a LiDAR whose shift is a constant error; None: none.
        seed: of the random pairs for L_rel.

    Raises:
        InputError: a constant error is to be estimated, but its measurements were not recorded; or `points` belongs
            to another model.
        ConvergenceError: sparse equations do not settle.
    """
    bundle = scene.bundle if options.solves_once(len(scene.sparse.image_name)) else None
    record = initial.geo_from_local
    pivot = scene.geo_from_model.apply(scene.poses.cam_center_in_model[scene.train]).mean(axis=0)
    covariance = moved_pivot(np.array(record.covariance), record.pivot, pivot)
    terms = SurveyTerms()
    if options.geo_loss:
        terms = _terms_of(scene, _without_rejected(survey, initial), options, points, seed)
    terms = replace(terms, planes=planes)
    problem = GeoProblem(
        LearnableSimilarity(scene.geo_from_model, covariance, pivot, _attitude(scene, initial)),
        _corrections(scene, options, bundle),
        terms.present,
        weighting=options.weighting,
        hold_prior=_leaves_open(terms, initial),
        errors=_errors(terms, options) if options.geo_loss else SystematicErrors(lidar=planes is not None),
        learned_weights=options.loss_weights == "learned",
        control_by_depth=terms.control_by_depth,
        bundle=bundle,
    )
    if len(problem.errors):
        saved = begin(problem)
        if options.estimate == "auto" and problem.errors.flights:
            _drop_idle_bias(problem, saved)
    return problem


def _drop_idle_bias(problem: GeoProblem, saved: float) -> None:
    """Leave biases that are not evident out of a problem, whose errors have lowered −2 ln likelihood by `saved`."""
    with_bias = problem.errors
    problem.errors = SystematicErrors(lidar=problem.term(PlaneTerm) is not None)
    others = begin(problem) if len(problem.errors) else 0.0
    if bias_pays(with_bias, saved - others):
        problem.errors = with_bias


def _corrections(scene: Scene, options: GeographicOptions, bundle: BundleInformation | None) -> CameraCorrections:
    """Return the corrections that the options allow to cameras and lens.

    With `paper` the lens stays, because plain mean squares hold no lens to the photographs.
    """
    count = len(scene.sparse.image_name)
    if bundle is not None:
        return CameraCorrections.held(
            scene.poses, HeldCorrections(np.zeros((count, 6)), np.zeros(len(bundle.lens)))
        )
    if not options.optimize_cameras:
        return CameraCorrections(scene.poses, np.zeros((count, 6, 0)))
    follows = options.weighting == "whitened"
    basis = scene.correction_basis if follows else scene.correction_basis_through_sfm_lens
    return CameraCorrections(scene.poses, basis.matrix, basis.lens_matrix if follows else None)


def _attitude(scene: Scene, initial: InitialSimilarity) -> RotationPrior | None:
    """Return the rotation geo ← model of the recorded attitudes, if the initial similarity needed them."""
    if initial.attitude is None:
        return None
    geo_from_local = matrix_from_quat_xyzw(initial.attitude.quat_xyzw)
    return RotationPrior(geo_from_local @ scene.model_from_local.rotation.T, np.array(initial.attitude.cov_rad2))


@dataclass(frozen=True)
class SurveyTerms:
    """Terms of a survey; None: the survey has no measurement of the kind, or the options exclude it."""

    fixes: FixTerm | None = None
    control: ControlTerm | None = None
    distances: DistanceTerm | None = None
    attitudes: AttitudeTerm | None = None
    control_by_depth: ControlByDepth | None = None
    planes: PlaneTerm | None = None

    @property
    def present(self) -> tuple[Term, ...]:
        """Terms of the loss and the posterior."""
        every = (self.fixes, self.control, self.distances, self.attitudes, self.planes)
        return tuple(term for term in every if term is not None)


def _without_rejected(survey: Survey, initial: InitialSimilarity) -> Survey:
    """Return the survey without the measurements that `init-sim3` has rejected."""
    bad_fixes, bad_points = set(initial.gnss_outliers), set(initial.control_outliers)
    return survey.model_copy(
        update={
            "images": tuple(
                image.model_copy(update={"fix": None}) if image.name in bad_fixes else image
                for image in survey.images
            ),
            "control_points": tuple(point for point in survey.control_points if point.name not in bad_points),
        }
    )


def _leaves_open(terms: SurveyTerms, initial: InitialSimilarity) -> bool:
    """Return whether the observations leave part of the similarity to its prior."""
    if initial.layout == "line":
        return terms.attitudes is None
    return terms.fixes is None and not _determined_by(terms.control)


def _determined_by(control: ControlTerm | None) -> bool:
    """Return whether the control points alone determine all seven unknowns of the similarity."""
    return control is not None and len(control) >= _LEAST_CONTROL


def _terms_of(
    scene: Scene, survey: Survey, options: GeographicOptions, points: GeolocatedPoints | None, seed: int
) -> SurveyTerms:
    fixes = fix_term(scene, survey)
    control = control_term(scene, survey) if options.gcp_loss else None
    by_depth = None
    if control is not None and options.gcp_mode == "depth":
        by_depth, control = control_by_depth(scene, survey, control)
    distances = distance_term(scene, fixes, points, seed) if fixes is not None and options.rel_loss else None
    attitudes = attitude_term(scene, survey) if "boresight" in options.estimated else None
    return SurveyTerms(fixes, control, distances, attitudes, by_depth)


def _errors(terms: SurveyTerms, options: GeographicOptions) -> SystematicErrors:
    """Return the constant errors to estimate; `auto` gives the bias if control points can reveal it.

    Raises:
        InputError: the measurements that the error belongs to were not recorded.
    """
    fixes, attitudes, wanted = terms.fixes, terms.attitudes, options.estimated
    if options.estimate == "auto":
        possible = options.weighting == "whitened" and fixes is not None and _determined_by(terms.control)
        wanted = ("bias",) if possible else ()
    for name, source, what in (
        ("bias", fixes, "positions"),
        ("lever-arm", fixes, "positions"),
        ("boresight", attitudes, "attitudes"),
    ):
        if name in wanted and source is None:
            raise InputError(f"{name} cannot be estimated: no {what} were recorded", field="--estimate")
    flights = 1 if fixes is None or fixes.flight is None else int(fixes.flight.max()) + 1
    return SystematicErrors(
        flights if "bias" in wanted else 0,
        arm="lever-arm" in wanted,
        attitude_sigma_rad=None
        if attitudes is None
        else float((1.0 / attitudes.root_information[:, 0, 0]).median()),
        lidar=terms.planes is not None,
    )
