"""Reports of `evaluate`: made up for tests of those who read them, and as scripts read them."""

from __future__ import annotations

import json
from typing import Any

from pipelines.core.products import Remark, save_json
from pipelines.core.stages import REPORT
from pipelines.core.workspace import Workspace
from pipelines.geometry.statistics import ResidualStats
from pipelines.survey.headline import headline
from pipelines.survey.report import (
    AccuracySummary,
    AsprsStatement,
    CheckPointErrors,
    CheckPoints,
    ControlResiduals,
    CrossValidation,
    ErrorStats,
    EvaluationReport,
    Fit,
    FixResiduals,
    Photometric,
    PhotometricFigures,
    SimilaritySigma,
    read_report,
)

_NO_CLASSES = dict.fromkeys(
    ("horizontal_class", "vertical_class", "class_3d", "vegetated", "area_km2", "statement")
)


def check_points_with(**figures: Any) -> CheckPointErrors:
    """Check points with the given figures and no others; none were measured if there are no figures."""
    count = figures.get("count", 0)
    asprs = AsprsStatement(points=count, least_points=30, enough_points=count >= 30, **_NO_CLASSES)
    unknown = {"survey": None, "with_survey": None, "predicted": None, "without_blunders": None}
    nothing = {**dict.fromkeys(ErrorStats.model_fields), **unknown, "count": 0, "blunders": (), "points": ()}
    return CheckPointErrors(**{**nothing, "asprs": asprs, **figures})


def cross_validation_with(**figures: Any) -> CrossValidation:
    """Control points left out, with the given figures and no others."""
    stated = check_points_with(**figures).model_dump(exclude={"asprs"})
    return CrossValidation(**stated, reason=None)


def report_with(
    *,
    test: dict[str, Any] | None = None,
    triangulated: CheckPointErrors | None = None,
    surface: CheckPointErrors | None = None,
    crossed: CrossValidation | None = None,
    gnss: dict[str, Any] | None = None,
    scene: AccuracySummary | None = None,
    cautions: tuple[Remark, ...] = (),
) -> EvaluationReport:
    """A report with the given parts; nothing was measured of the others.

    Args:
        test: photometric figures.
        gnss: figures of the residuals of the fixes.
        scene: predicted σ; none without it.
    """
    triangulated = triangulated or check_points_with()
    scene = scene or AccuracySummary(cells=0, reason="the scene has too few points")
    no_views = dict.fromkeys(("psnr", "psnr_compensated", "ssim", "lpips"))
    no_residuals = {**dict.fromkeys(ResidualStats.model_fields), "count": 0}
    return EvaluationReport(
        headline=headline(triangulated, scene, cautions),
        area_ha=triangulated.asprs.area_km2 and 100 * triangulated.asprs.area_km2,
        photometric=Photometric(
            test=PhotometricFigures(**{"views": 0, **no_views, "per_view": (), **(test or {})})
        ),
        checkpoints=CheckPoints(triangulated=triangulated, surface=surface or check_points_with()),
        cross_validation=crossed,
        accuracy=scene,
        fit=Fit(
            gnss=FixResiduals(**{**no_residuals, "outliers": 0, **(gnss or {})}),
            gcp=ControlResiduals(**no_residuals, points=()),
        ),
        cameras=None,
        similarity=SimilaritySigma(sigma_ln_scale=1e-4, sigma_translation_m=(0.01, 0.01, 0.02)),
        cautions=cautions,
    )


def report_of(workspace: Workspace) -> dict[str, Any]:
    """The report as scripts read it; every one must survive reading and writing to the last character."""
    path = workspace.path(REPORT)
    text = path.read_text(encoding="utf-8")
    copy = workspace.root / "report_copy.json"
    save_json(read_report(path), copy)
    assert copy.read_text(encoding="utf-8") == text
    document: dict[str, Any] = json.loads(text)
    return document
