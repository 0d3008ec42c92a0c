"""Export of the splat as a 3DGS PLY in real-world metres, with a sidecar that states its place on Earth.

Reads `ingest/survey.json`, `train/model.json` and `train/gaussians.ply`. Writes `export/splat.ply` and
`export/splat.ply.georef.json` (docs/formats.md).

The file's axes are those of its viewer: Gaussians are turned as a whole, and the sidecar's rotation and covariance
are those of the file's axes.
"""

from pathlib import Path

import numpy as np

from pipelines.core.stages import SPLAT
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportPlyOptions, PlyOptions
from pipelines.deliver.placement import ENU_FROM_Y_UP
from pipelines.deliver.splat import PlacedSplat, load_splat, splat_values
from pipelines.formats.georef_sidecar import write_sidecar
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import transformed, write_gaussians

# By the axis that points up. Columns: the file's x, y and z, along east, north and up.
ENU_FROM_AXES = {"y": ENU_FROM_Y_UP, "-y": ENU_FROM_Y_UP @ np.diag([1.0, -1.0, -1.0])}


def run(stage: StageRun, options: ExportPlyOptions) -> Summary:
    """Write the PLY and its sidecar, and return their key figures; errors as of `load_splat`."""
    splat = load_splat(stage.workspace, options)
    write_ply(splat, stage.out / Path(SPLAT).name, options)
    return Summary(f"{len(splat.gaussians)} Gaussians", splat_values(splat), cautions=splat.placement.cautions)


def write_ply(splat: PlacedSplat, path: Path, options: PlyOptions) -> None:
    """Write a splat as PLY along the axes of the options, and its sidecar."""
    axes, gaussians = ENU_FROM_AXES.get(options.up), splat.gaussians
    if axes is not None:
        gaussians = transformed(gaussians, Similarity(1.0, axes.T))
    write_gaussians(path, gaussians, mip_filter=splat.mip_filter)
    write_sidecar(splat.placement.sidecar(axes), path)
