"""Command `georef view`."""

import contextlib
import threading
import webbrowser

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.output import print_result
from pipelines.core.options import OptionValue
from pipelines.core.staleness import must_exist
from pipelines.core.workspace import Workspace
from pipelines.view.options import ViewOptions


def _view(ctx: click.Context, workspace: Workspace, open_page: bool, as_json: bool, **_values: OptionValue) -> None:
    from pipelines.core.extras import require

    require("viewer")
    from pipelines.view.server import serve

    must_exist(workspace)
    wanted = options.resolved(ctx, ViewOptions, workspace.config_file)

    def ready(address: str) -> None:
        print_result({"address": address}, f"{address}   (Ctrl-C ends the viewer)", as_json=as_json)
        if open_page:
            webbrowser.open(address)

    with contextlib.suppress(KeyboardInterrupt):  # the way to end it
        serve(workspace, wanted, ready, threading.Event(), progress_for(ctx.obj))


command = Command(
    "view",
    params=[
        options.WORKSPACE,
        *options.stage_options(ViewOptions),
        click.Option(["--open/--no-open", "open_page"], default=False, help="Open the page in a browser at once."),
        options.JSON,
    ],
    callback=click.pass_context(_view),
    help="""
        Points, distances, heights, areas and volumes are read from the model's own surface, as `georef evaluate`
        reads it, with σ from the joint covariance. Control points are marked in photographs, and written for --gcp.
        The page is served to this machine alone, at an address with a key. What is saved lies in the workspace's
        folder view/, at once, and several viewers may show one workspace.

        \b
        Examples:
          georef view flight
          georef view flight --open
          georef view flight --crs EPSG:32632+3855 --port 9000
          georef view flight --json
        """,
)
