"""Evaluated workspaces for the tests of the report: a true scene, its photographs, and made-up errors."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.cautions import Caution
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import METRICS, RENDERS, REPORT, SURVEY
from pipelines.core.types import Vector3
from pipelines.core.workspace import Workspace
from pipelines.plots.strips import labelled
from pipelines.scene.render_files import write_render
from pipelines.scene.report import (
    PredictedPointError,
    PredictedSigma,
    ViewFigures,
    write_report,
)
from pipelines.scene.survey import Survey, SurveyedPoint
from tests.reports import check_points_with, report_with
from tests.scenes import TrueScene
from tests.trained_workspaces import trained_workspace

CHECK_POINTS = 3
ERROR_M: Vector3 = (0.0123456789, -0.02, 0.033)
GREY = 90


@dataclass(frozen=True)
class Evaluated:
    """True scene, and its workspace as `evaluate` leaves it."""

    scene: TrueScene
    workspace: Workspace


def evaluated_workspace(root: Path, rename: str = "") -> Evaluated:
    """Return a workspace whose check points all have the error `ERROR_M`.

    Args:
        root: of the workspace.
        rename: text around the names of surveyed points, and in the texts of cautions and assumptions.
    """
    scene, workspace = trained_workspace(root)
    survey = load_json(Survey, workspace.path(SURVEY))
    points = [_renamed(point, rename) for point in survey.control_points]
    changed = {
        "image_dir": "photos",
        "control_points": tuple(points[CHECK_POINTS:]),
        "check_points": tuple(points[:CHECK_POINTS]),
        "assumptions": (f"the ground is flat {rename}",),
    }
    survey = survey.model_copy(update=changed)
    save_json(survey, root / SURVEY)
    _write_photographs(scene, root / "photos")
    rows = tuple(
        PredictedPointError(
            name=point.name,
            rays=len(point.marks),
            de_m=ERROR_M[0],
            dn_m=ERROR_M[1],
            du_m=ERROR_M[2],
            blunder=False,
            sigma_e_m=0.01,
            sigma_n_m=0.02,
            sigma_u_m=0.03,
        )
        for point in survey.check_points
    )
    figures = {f"rmse_{axis}_m": abs(value) for axis, value in zip(("e", "n", "v"), ERROR_M, strict=True)} | {
        "rmse_h_m": float(np.hypot(*ERROR_M[:2])),
        "count": CHECK_POINTS,
    }
    predicted = PredictedSigma(
        count=CHECK_POINTS, rms_h_m=0.02, rms_v_m=0.03, normalised_error_squared={"e": 0.5, "n": 0.7, "u": 1.1}
    )
    photometric = {"psnr": 23.456789, "psnr_compensated": 24.0, "ssim": 0.81, "lpips": None}
    views = (ViewFigures(image=scene.names[2], **photometric),)
    report = report_with(
        camera=check_points_with(points=rows, predicted=predicted, **figures),
        model=check_points_with(points=rows, **figures),
        test={**photometric, "views": 1, "lpips_reason": "none", "per_view": views},
        cautions=(Caution(code="made-up", sentence=f"Nothing is real here {rename}."),),
    )
    (root / REPORT).parent.mkdir(parents=True)
    write_report(report, root / REPORT)
    (root / RENDERS).mkdir()
    pictures = [np.full((30, 40, 3), GREY, dtype=np.uint8)] * 3
    write_render(root / RENDERS, scene.names[2], labelled(pictures, ("photograph", "render", "difference")))
    metrics = [{"iteration": 10 * step, "psnr": 10.0 + step, "gaussians": 100 + step} for step in range(1, 5)]
    (root / METRICS).write_text("".join(json.dumps(row) + "\n" for row in metrics), "utf-8")
    return Evaluated(scene, workspace)


def _renamed(point: SurveyedPoint, text: str) -> SurveyedPoint:
    return point.model_copy(update={"name": f"{text}{point.name}"})


def _write_photographs(scene: TrueScene, folder: Path) -> None:
    """Write grey photographs with a white square of 5 px around each true mark of a surveyed point."""
    folder.mkdir()
    _, image, xy = scene.pixels(scene.gcp_in_geo)
    for index, name in enumerate(scene.names):
        picture = np.full((scene.camera.height, scene.camera.width, 3), GREY, dtype=np.uint8)
        for x, y in np.floor(xy[image == index]).astype(int):
            picture[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] = 255
        cv2.imwrite(str(folder / name), picture)
