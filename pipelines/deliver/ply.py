"""Export of the splat as a 3DGS PLY in real-world metres, with a sidecar that states its place on Earth.

Reads `ingest/survey.json`, `train/model.json` and `train/gaussians.ply`. Writes `export/splat.ply` and
`export/splat.ply.georef.json` (docs/formats.md).
"""

from __future__ import annotations

from pathlib import Path

from pipelines.core.stages import SPLAT
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportPlyOptions
from pipelines.deliver.splat import PlacedSplat, load_splat, splat_values
from pipelines.formats.georef_sidecar import write_sidecar
from pipelines.splat.gaussians import write_gaussians


def run(stage: StageRun, options: ExportPlyOptions) -> Summary:
    """Write the PLY and its sidecar, and return their key figures; errors as of `load_splat`."""
    splat = load_splat(stage.workspace, options)
    write_ply(splat, stage.out / Path(SPLAT).name)
    return Summary(f"{len(splat.gaussians)} Gaussians", splat_values(splat), cautions=splat.placement.cautions)


def write_ply(splat: PlacedSplat, path: Path) -> None:
    """Write a splat as PLY, and its sidecar."""
    write_gaussians(path, splat.gaussians)
    write_sidecar(splat.placement.sidecar(), path)
