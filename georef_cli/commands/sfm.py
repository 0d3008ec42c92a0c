"""Command `georef sfm`."""

from typing import Any

import click

from georef_cli.display import progress_for
from georef_cli.engines import ENGINE, asked_engine
from georef_cli.output import print_json
from georef_cli.stage import StageCommand

_CHUNK = click.Option(
    ["--chunk"],
    metavar="NAME",
    help="Work on this chunk of a large survey only, beside a `georef sfm` that has planned it.",
)


class _SfmCommand(StageCommand):
    def act(self, ctx: click.Context, **values: Any) -> None:
        name = values.pop("chunk")
        if name is None:
            with asked_engine(values):
                super().act(ctx, **values)
            return
        from pipelines.sfm.chunks import work_chunk

        worked = work_chunk(values["workspace"], name, progress_for(ctx.obj))
        if values["as_json"]:
            print_json({"chunk": name, "ran": worked})


command = _SfmCommand(
    "sfm",
    """
    Which images are matched follows from their positions and view directions. Features and matches of a large
    survey are computed in chunks, as many at a time as cores and memory allow; a finished chunk is kept when the
    command is interrupted. The result is a COLMAP model, sfm/sparse, which COLMAP itself opens; --import takes
    the cameras that COLMAP, Metashape, PIX4Dmatic (OPF), OpenSfM, OpenDroneMap, nerfstudio or RealityScan has
    solved.

    \b
    Examples:
      georef sfm flight
      georef sfm flight --mapper global --max-image-size 1600
      georef sfm flight --import colmap/sparse/0
      georef sfm flight --import cameras.xml
      georef sfm flight --cluster tls://scheduler:8786 --certificates certificates
    """,
    extra=[_CHUNK, *ENGINE],
)
