"""Headline, figures, warnings and cautions of an evaluation."""

from __future__ import annotations

from typing import Any

from pipelines.core.sentences import listed
from pipelines.core.workspace import Summary
from pipelines.evaluate.asprs import LEAST_POINTS, few_points
from pipelines.scene.report import CheckPointErrors, CheckPoints, EvaluationReport, PhotometricFigures


def summarise(report: EvaluationReport) -> Summary:
    """Return headline, figures, warnings and cautions of a report, for the command line."""
    test, ways = report.photometric.test, _by_way(report.checkpoints)
    parts = [_test_views(test)]
    parts += [f"check points by {way} {errors.mean_h_m:.3f} m H" for way, errors in ways.items() if errors.count]
    values: dict[str, Any] = {
        "views": test.views,
        "psnr": test.psnr,
        "psnr_covered": test.psnr_covered,
        "covered_share": test.covered_share,
        "psnr_compensated": test.psnr_compensated,
        "ssim": test.ssim,
    }
    for way, errors in ways.items():
        values |= {
            f"{way}_count": errors.count,
            f"{way}_mean_h_m": errors.mean_h_m,
            f"{way}_rmse_h_m": errors.rmse_h_m,
            f"{way}_rmse_v_m": errors.rmse_v_m,
            f"{way}_rmse_3d_m": errors.rmse_3d_m,
        }
    return Summary(", ".join(parts), values, _warnings(report), report.cautions)


def _test_views(test: PhotometricFigures) -> str:
    if test.psnr is None:
        return "no test views"
    if test.psnr_covered is None or test.covered_share is None:
        return f"test PSNR {test.psnr:.2f} dB"
    return f"test PSNR {test.psnr:.2f} dB, {test.psnr_covered:.2f} dB on the {test.covered_share:.0%} covered"


def _by_way(checkpoints: CheckPoints) -> dict[str, CheckPointErrors]:
    return {"camera": checkpoints.camera, "model": checkpoints.model}


def _warnings(report: EvaluationReport) -> tuple[str, ...]:
    warnings = []
    count = report.checkpoints.camera.count
    if 0 < count < LEAST_POINTS:
        warnings.append(few_points(count))
    for way, errors in _by_way(report.checkpoints).items():
        if errors.blunders:
            warnings.append(
                f"by {way}, {len(errors.blunders)} of {errors.count} check points are off by more than three times "
                f"the class that the others meet: {listed(errors.blunders)}"
            )
    crossed = report.cross_validation
    if crossed is not None and crossed.reason is not None:
        warnings.append(f"no cross-validation: {crossed.reason}")
    return tuple(warnings)
