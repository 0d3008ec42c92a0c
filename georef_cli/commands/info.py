"""Command `georef info`."""

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.output import overview_text, print_result
from pipelines.core.options import OptionValue
from pipelines.core.staleness import must_exist
from pipelines.core.workspace import Workspace
from pipelines.survey.options import CrsOptions


def _info(ctx: click.Context, workspace: Workspace, as_json: bool, **_values: OptionValue) -> None:
    from pipelines.deliver.overview import overview

    must_exist(workspace)
    result = overview(workspace, options.resolved(ctx, CrsOptions, workspace.config_file))
    print_result(result.feature(), *overview_text(result), as_json=as_json)


command = Command(
    "info",
    params=[options.WORKSPACE, *options.stage_options(CrsOptions), options.JSON],
    callback=click.pass_context(_info),
    help="""
        Its accuracy and what else can be made are stated, too. The bounds hold 98 % of the Gaussians along each
        coordinate. With --json: a GeoJSON feature, the bounds as its polygon. Nothing is written.

        \b
        Examples:
          georef info flight
          georef info flight --crs EPSG:32632+3855
          georef info flight --json > flight.geojson
        """,
)
