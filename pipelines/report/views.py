"""Test views as pictures, the curves of the training, and previews of the rasters."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.files import file_size
from pipelines.core.stages import BY_NAME, HILLSHADE, METRICS, ORTHOPHOTO_PREVIEW, RENDERS
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.pages.pictures import Picture, limited, picture_of, picture_of_png, read_picture
from pipelines.plots.observations import curves
from pipelines.plots.strips import without_labels
from pipelines.scene.render_files import DIFFERENCE_GAIN, render_name
from pipelines.scene.report import PhotometricFigures
from pipelines.scene.trained_model import TrainedModel

_VIEW_PX, _PREVIEW_PX = 720, 1100
_MOST_METRICS_BYTES = 256 * 1024 * 1024
_MOST_ROWS = 2000  # of the metrics that are drawn
# Curves by panel: the names in the file, and those on the page.
_PANELS: dict[str, dict[str, str]] = {
    "PSNR of the batch in dB": {"psnr": "PSNR"},
    "photometric loss": {"photometric": "loss"},
    "geographic terms": {
        "absolute": "fixes",
        "control": "control points",
        "attitude": "attitudes",
        "relative": "distances",
        "cameras": "corrections of the cameras",
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
    """Test views of an evaluated survey.

    Attributes:
        shown: views with pictures, the worst first.
        rows: name, and path of the figures, of every view.
        gain: of the difference.
        renders: number of renders that `evaluate` has saved.
    """

    shown: tuple[TestView, ...]
    rows: tuple[tuple[str, str], ...]
    gain: int
    renders: int


@dataclass(frozen=True)
class TrainingFacts:
    """Training of the model.

    Attributes:
        curves: picture; None: no metrics were kept.
        iterations, gaussians: of the result.
        max_image_size: longer side of the training photographs in pixels.
        backend: rasteriser.
        duration_s: None: not recorded.
        last_psnr: of the last batch, dB; None: no metrics.
        sh_degree: of the spherical harmonics.
    """

    curves: Picture | None
    iterations: int
    gaussians: int
    max_image_size: int
    backend: str
    duration_s: float | None
    last_psnr: float | None
    sh_degree: int


@dataclass(frozen=True)
class PreviewsFacts:
    """Previews of the rasters; None where they were not made."""

    orthophoto: Picture | None
    surface: Picture | None


def views_facts(workspace: Workspace, test: PhotometricFigures, most: int) -> ViewsFacts:
    """Return the test views of a workspace, with pictures of at most `most` of them.

    Raises:
        InputError: a render cannot be read.
    """
    views = test.per_view
    fields = {view.image: f"photometric.test.per_view.{index}" for index, view in enumerate(views)}
    worst_first = sorted(views, key=lambda view: view.psnr)
    try:
        folder = workspace.path(RENDERS)
    except MissingProductError:
        saved: dict[str, Path] = {}
    else:
        files = {view.image: folder / render_name(view.image) for view in worst_first}
        saved = {name: file for name, file in files.items() if file.is_file()}
    return ViewsFacts(
        shown=tuple(_view(name, fields[name], file) for name, file in list(saved.items())[:most]),
        rows=tuple((view.image, fields[view.image]) for view in views),
        gain=DIFFERENCE_GAIN,
        renders=len(saved),
    )


def _view(name: str, field: str, file: Path) -> TestView:
    parts = without_labels(read_picture(file), 3)
    if not parts[0].size:
        raise InputError("is no render of evaluate: run `georef evaluate --force`", path=file)
    photograph, render, difference = (picture_of(limited(part, _VIEW_PX)) for part in parts)
    return TestView(name, field, photograph, render, difference)


def training_facts(workspace: Workspace, model: TrainedModel) -> TrainingFacts:
    """Return the training of a workspace.

    Raises:
        InputError: the metrics are damaged.
    """
    manifest = workspace.manifest(BY_NAME["train"])
    try:
        rows = read_metrics(workspace.path(METRICS))
    except MissingProductError:
        rows = []
    panels = _panels(rows)
    return TrainingFacts(
        curves=picture_of_png(curves("iteration", panels)) if panels else None,
        iterations=model.iterations,
        gaussians=model.gaussians,
        max_image_size=model.max_image_size,
        backend=model.backend,
        duration_s=None if manifest is None else manifest.duration_s,
        last_psnr=rows[-1].get("psnr") if rows else None,
        sh_degree=model.sh_degree,
    )


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Return the rows of the training's metrics: numbers by name.

    A last line that an interrupted writer has left unfinished is not counted.

    Raises:
        InputError: too large, not text, or a line is no JSON object of numbers.
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
        raise InputError(f"line {lines} is no row of metrics: run `georef train --force`", path=path) from error
    return rows


def _panels(rows: list[dict[str, float]]) -> dict[str, Mapping[str, tuple[FloatArray, FloatArray]]]:
    """Return the curves that the metrics hold, by panel."""
    rows = rows[:: max(1, len(rows) // _MOST_ROWS)]
    panels: dict[str, Mapping[str, tuple[FloatArray, FloatArray]]] = {}
    for quantity, names in _PANELS.items():
        lines = {}
        for name, shown in names.items():
            values = np.array([(row["iteration"], row[name]) for row in rows if name in row]).reshape(-1, 2)
            values = values[np.isfinite(values).all(axis=1)]
            if len(values):
                lines[shown] = (values[:, 0], values[:, 1])
        if lines:
            panels[quantity] = lines
    return panels


def previews_facts(workspace: Workspace) -> PreviewsFacts:
    """Return the previews of the rasters of a workspace.

    Raises:
        InputError: a preview cannot be read.
    """
    pictures = []
    for product in (ORTHOPHOTO_PREVIEW, HILLSHADE):
        path = workspace.root / product
        pictures.append(picture_of(limited(read_picture(path), _PREVIEW_PX)) if path.is_file() else None)
    return PreviewsFacts(*pictures)
