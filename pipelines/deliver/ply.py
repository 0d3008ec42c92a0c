"""Export of the splat as a 3DGS PLY in real-world metres, with a sidecar that states its place on Earth.

Reads `ingest/survey.json`, `train/model.json` and `train/gaussians.ply`; with --measurable also the photographs and
`sfm/sparse`. Writes `export/splat.ply` and `export/splat.ply.georef.json` (docs/formats.md).
"""

from __future__ import annotations

from pipelines.core.stages import SPLAT
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportPlyOptions
from pipelines.deliver.splat import load_splat, placed_splat
from pipelines.formats.georef_sidecar import write_sidecar
from pipelines.splat.storage import write_gaussians


def run(stage: StageRun, options: ExportPlyOptions) -> Summary:
    """Write the PLY and its sidecar, and return their key figures.

    Raises:
        MissingProductError: ingest or train has not been run.
        InputError: a product is damaged.
        DegenerateGeometryError: no Gaussian is opaque enough.
        GeorefError: as `measurable_splat`.
    """
    if options.measurable:
        from pipelines.deliver.measurable import measurable_splat

        measurable = measurable_splat(stage, options)
        trained = measurable.trained
        splat = placed_splat(trained.gaussians, trained.model, trained.survey, options, measurable.gaussians)
        key_figure, values = measurable.figures(splat.figures)
    else:
        splat = load_splat(stage.workspace, options)
        key_figure, values = splat.figures.key_figure(), splat.figures.values()
    path = stage.out / SPLAT.rpartition("/")[2]
    write_gaussians(path, splat.gaussians)
    write_sidecar(splat.placement.sidecar(), path)
    return Summary(key_figure, values, cautions=splat.placement.cautions)
