"""Facts of several sections: solution, report of `evaluate`, observations; test views, curves of the training."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size
from pipelines.core.stages import BY_NAME, METRICS, RENDERS, REPORT
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import project_each
from pipelines.geometry.intersection import refined_points
from pipelines.geometry.network import Network, has_positive_depth
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.report.page import Picture, limited, picture_of, picture_of_png, read_picture
from pipelines.report.plots.charts import curves, without_labels
from pipelines.survey.area import LEAST_RAYS, without_outliers
from pipelines.survey.photographs import DIFFERENCE_GAIN, render_name
from pipelines.survey.report import EvaluationReport, PhotometricFigures, read_report
from pipelines.survey.scene import network_of
from pipelines.survey.solution import Solution, TrainedModel, read_solution


def read_evaluated(workspace: Workspace) -> tuple[Solution, EvaluationReport]:
    """Return the solution that `evaluate` has seen, and its report; errors as of the `run` of a stage."""
    report = read_report(workspace.path(REPORT))
    manifest = workspace.manifest(BY_NAME["evaluate"])  # None: a report put there by hand
    initial = manifest is not None and manifest.config.get("similarity") == "initial"
    return read_solution(workspace, similarity="initial" if initial else "trained"), report


def adjusted_network(solution: Solution, sfm: SparseModel) -> Network:
    """Return the image observations with solved cameras and lenses, and points where these see them, in `model`."""
    network = network_of(solution.with_lenses(sfm), solution.poses, solution.point_in_model(sfm))
    return replace(network, point_in_world=refined_points(network).point_in_world)


def reprojection_residuals(network: Network) -> FloatArray:
    """Return projected minus observed (M, 2) in pixels; NaN where a point lies behind its camera."""
    ray = network.point_in_world[network.obs_point] - network.cam_center_in_world[network.obs_image]
    ray_in_cam = np.einsum("mij,mj->mi", network.cam_from_world[network.obs_image], ray)
    projected = project_each(network.cameras, network.camera_id[network.obs_image], ray_in_cam)
    return np.asarray(np.where(has_positive_depth(network)[:, None], projected - network.obs_xy_px, np.nan))


def seen_scene(network: Network, geo_from_model: Similarity) -> FloatArray:
    """Return the points (N, 3) in `geo` that three photographs of a network show, without highest and lowest."""
    points = geo_from_model.apply(network.point_in_world)
    return without_outliers(points[np.bincount(network.obs_point, minlength=len(points)) >= LEAST_RAYS])


_VIEW_PX = 560
_MOST_METRICS_BYTES = 256 * 1024 * 1024
_MOST_ROWS = 2000  # of the metrics that are drawn
# Curves by panel: the names in the file, and those on the page.
_PANELS: dict[str, dict[str, str]] = {
    "PSNR of the batch in dB": {"psnr": "PSNR"},
    "photometric loss": {"photometric": "loss"},
    "geographic terms": {
        "solution": "motion from the solution",
        "absolute": "fixes",
        "control": "control points",
        "control_by_depth": "control points by depth",
        "relative": "distances",
    },
    "Gaussians": {"gaussians": "Gaussians"},
}


@dataclass(frozen=True)
class TestView:
    """Test view: path of its figures in the report of `evaluate`, photograph, render and difference."""

    name: str
    field: str
    photograph: Picture
    render: Picture
    difference: Picture


@dataclass(frozen=True)
class ViewsFacts:
    """Test views: those with pictures, the worst first; name, and path of the figures, of all.

    `renders` is the number of renders that `evaluate` has saved, `gain` that of the difference; `most_on_paper`
    views are printed with pictures.
    """

    pictured: tuple[TestView, ...]
    rows: tuple[tuple[str, str], ...]
    gain: int
    renders: int
    most_on_paper: int = 2


@dataclass(frozen=True)
class TrainingFacts:
    """Training of the model, with its curves; None: no metrics were kept, or the duration was not recorded."""

    model: TrainedModel
    curves: Picture | None
    duration_s: float | None


def views_facts(workspace: Workspace, test: PhotometricFigures, most: int) -> ViewsFacts:
    """Return the test views of a workspace, with pictures of at most `most` of them."""
    views = test.per_view
    fields = {view.image: f"photometric.test.per_view.{index}" for index, view in enumerate(views)}
    worst_first = sorted(views, key=lambda view: view.psnr)
    files = {view.image: workspace.root / RENDERS / render_name(view.image) for view in worst_first}
    saved = {name: file for name, file in files.items() if file.is_file()}
    return ViewsFacts(
        pictured=tuple(_view(name, fields[name], file) for name, file in list(saved.items())[:most]),
        rows=tuple((view.image, fields[view.image]) for view in views),
        gain=DIFFERENCE_GAIN,
        renders=len(saved),
    )


def _view(name: str, field: str, file: Path) -> TestView:
    parts = without_labels(read_picture(file), 3)
    if not parts[0].size:
        message = "is no render of `georef evaluate`."
        remedy = "Run `georef evaluate --force`."
        raise InputError("not-a-render", message, path=file, remedy=remedy)
    photograph, render, difference = (picture_of(limited(part, _VIEW_PX)) for part in parts)
    return TestView(name, field, photograph, render, difference)


def training_facts(workspace: Workspace, model: TrainedModel) -> TrainingFacts:
    """Return what the section on the training shows: model, curves over the iterations, time in seconds."""
    manifest, metrics = workspace.manifest(BY_NAME["train"]), workspace.root / METRICS
    panels = _panels(read_metrics(metrics)) if metrics.is_file() else {}
    return TrainingFacts(
        model=model,
        curves=picture_of_png(curves("iteration", panels)) if panels else None,
        duration_s=None if manifest is None else manifest.duration_s,
    )


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Return the rows of the training's metrics: numbers by name. An InputError: too large, or a line is no row.

    A last line that an interrupted writer has left unfinished is not counted.
    """
    file_size(path, limit_bytes=_MOST_METRICS_BYTES, kind="file of metrics")
    rows, lines = [], 0
    try:
        for line in path.read_text(encoding="utf-8").splitlines():
            lines += 1
            if line.endswith("}"):
                row = {name: float(value) for name, value in json.loads(line).items()}
                rows.append(row | {"iteration": row["iteration"]})
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError) as error:
        message = "is no row of metrics."
        remedy = "Run `georef train --force`."
        raise InputError("metrics-row", message, path=path, line=lines, remedy=remedy) from error
    return rows


def _panels(rows: list[dict[str, float]]) -> dict[str, Mapping[str, tuple[FloatArray, FloatArray]]]:
    """Return the curves that the metrics hold, by panel."""
    rows = rows[:: max(1, len(rows) // _MOST_ROWS)]
    panels: dict[str, Mapping[str, tuple[FloatArray, FloatArray]]] = {}
    for quantity, names in _PANELS.items():
        lines = {}
        for name, label in names.items():
            values = np.array([(row["iteration"], row[name]) for row in rows if name in row]).reshape(-1, 2)
            values = values[np.isfinite(values).all(axis=1)]
            if len(values):
                lines[label] = (values[:, 0], values[:, 1])
        if lines:
            panels[quantity] = lines
    return panels
