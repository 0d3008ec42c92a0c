"""Command `georef export-ply`: the splat as trained, or with --measurable a second file to measure in."""

from typing import Any

import click

from georef_cli import options
from georef_cli.stage import StageCommand
from pipelines.deliver.options import MeasurableOptions

_DOC = """
    The PLY is in an East-North-Up frame in metres; --up turns it for viewers whose y axis points up or down.
    FILE.georef.json beside it states the place of the file's frame on Earth, and its accuracy.

    --measurable writes a second file beside the first, measurable/splat.measurable.ply, for viewers that measure by
    the centres of Gaussians: small discs on the surface replace the Gaussians about it. It is several times larger
    and looks a little worse. Its options in georef.toml are those of [export-measurable].

    \b
    Examples:
      georef export-ply flight
      georef export-ply flight --to splat.ply --min-opacity 0.02
      georef export-ply flight --up -y --to supersplat.ply
      georef export-ply flight --measurable
    """
_OF_MEASURABLE = ("disc_spacing", "appearance_passes")
_MEASURABLE = StageCommand("export-measurable", _DOC, delivers="file")


class PlyCommand(StageCommand):
    """Command of the stage `export-ply`, or with --measurable of `export-measurable`."""

    def invoke(self, ctx: click.Context) -> Any:
        if ctx.params.pop("measurable"):
            return _MEASURABLE.invoke(ctx)
        if given := options.given(ctx, _OF_MEASURABLE):
            flag = options.stage_option(MeasurableOptions, next(iter(given))).opts[0]
            raise click.UsageError(f"{flag} is for --measurable, which is not given.")
        return super().invoke(ctx)


command = PlyCommand(
    "export-ply",
    _DOC,
    extra=[
        options.flag(
            "--measurable",
            text="Write splat.measurable.ply, with discs on the surface, for viewers that measure by centres.",
        ),
        *options.stage_options(MeasurableOptions, _OF_MEASURABLE),
    ],
    delivers="file",
)
