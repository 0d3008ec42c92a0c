"""Export of the splat as SPZ, with a sidecar that states its place on Earth.

Reads `ingest/survey.json`, `train/model.json` and `train/gaussians.ply`. Writes `spz/splat.spz` and
`spz/splat.spz.georef.json` (docs/formats.md).

Readers of SPZ take its axes for right, up and back, and turn them into their own. The file's axes are therefore
east, up and south, so that every reader sees the scene upright. The rotation of the sidecar is that of these axes.
"""

from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.stages import SPZ
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportSpzOptions
from pipelines.deliver.placement import ENU_FROM_Y_UP
from pipelines.deliver.splat import codec_arrays, load_splat, splat_values
from pipelines.formats.georef_sidecar import GeorefSidecar, write_sidecar
from pipelines.formats.spz import SpzVersion, write_spz
from pipelines.formats.spz_extensions import SpzGeoreference
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import transformed


def run(stage: StageRun, options: ExportSpzOptions) -> Summary:
    """Write the SPZ file and its sidecar; errors as of `load_splat`, or an InputError: too large for the format."""
    splat = load_splat(stage.workspace, options)
    upright = transformed(splat.gaussians, Similarity(1.0, ENU_FROM_Y_UP.T))
    path = stage.out / Path(SPZ).name
    version: SpzVersion = 3 if options.spz_version == "3" else 4
    sidecar = splat.placement.sidecar(ENU_FROM_Y_UP)
    embedded = _georeference(sidecar, version) if options.embed_georeference else None
    try:
        arrays = codec_arrays(upright, options.sh_degree)
        write_spz(path, arrays, version, embedded, mip_filter=splat.mip_filter)
    except InputError as error:
        message = f"{error}. `georef export-tiles` writes scenes of any size."
        raise InputError("spz-range", message) from error
    write_sidecar(sidecar, path)
    size = path.stat().st_size
    return Summary(
        f"{len(splat.gaussians)} Gaussians, {size / 2**20:.1f} MiB",
        {
            **splat_values(splat),
            "spz_version": version,
            "georeference_embedded": embedded is not None,
            "bytes": size,
        },
        cautions=splat.placement.cautions,
    )


def _georeference(sidecar: GeorefSidecar, version: SpzVersion) -> SpzGeoreference:
    """Return the sidecar's place for the file itself; an InputError: the version or the frame has none."""
    if version != 4:
        message = "Only version 4 of SPZ holds a georeference."
        remedy = "Add --spz-version 4."
        raise InputError("spz-version", message, field="--embed-georeference", remedy=remedy)
    if sidecar.crs_id is None:
        message = "The survey has a local metric frame: there is no place on Earth to embed."
        raise InputError("not-on-earth", message, field="--embed-georeference")
    return SpzGeoreference(sidecar.crs_id, sidecar.origin, sidecar.rotation, sidecar.scale, sidecar.epoch)
