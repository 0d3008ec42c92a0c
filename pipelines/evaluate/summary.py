"""Headline, figures, warnings and cautions of an evaluation."""

from __future__ import annotations

from typing import Any

from pipelines.core.figures import WAYS
from pipelines.core.sentences import listed
from pipelines.core.workspace import Summary
from pipelines.evaluate.asprs import few_points
from pipelines.scene.report import EvaluationReport, PhotometricFigures


def summarise(report: EvaluationReport) -> Summary:
    """Return headline, figures, warnings and cautions of a report, for the command line."""
    test = report.test_views
    values: dict[str, Any] = {"accuracy": report.headline.model_dump()}
    if test is not None:
        values |= {
            "views": test.views,
            "psnr": test.psnr,
            "psnr_covered": test.psnr_covered,
            "covered_share": test.covered_share,
            "psnr_compensated": test.psnr_compensated,
            "ssim": test.ssim,
        }
    for way, errors in report.checkpoints.by_way.items():
        values |= {
            f"{way}_count": errors.count,
            f"{way}_mean_h_m": errors.mean_h_m,
            f"{way}_rmse_h_m": errors.rmse_h_m,
            f"{way}_rmse_v_m": errors.rmse_v_m,
            f"{way}_rmse_3d_m": errors.rmse_3d_m,
        }
    key_figure = f"{report.headline.sentence}; {_test_views(test)}"
    return Summary(key_figure, values, _warnings(report), report.cautions)


def _test_views(test: PhotometricFigures | None) -> str:
    if test is None:
        return "cameras alone, not trained yet"
    if test.psnr is None:
        return "no test views"
    if test.psnr_covered is None or test.covered_share is None:
        return f"test PSNR {test.psnr:.2f} dB"
    return f"test PSNR {test.psnr:.2f} dB, {test.psnr_covered:.2f} dB on the {test.covered_share:.0%} covered"


def _warnings(report: EvaluationReport) -> tuple[str, ...]:
    warnings = []
    asprs = report.checkpoints.camera.asprs
    if asprs.points and not asprs.enough_points:
        warnings.append(few_points(asprs))
    for way, errors in report.checkpoints.by_way.items():
        if errors.blunders:
            warnings.append(
                f"{WAYS[way]}, {len(errors.blunders)} of {errors.count} check points are off by more than three "
                f"times the class that the others meet: {listed(errors.blunders)}"
            )
    crossed = report.cross_validation
    if crossed is not None and crossed.reason is not None:
        warnings.append(f"no cross-validation: {crossed.reason}")
    return tuple(warnings)
