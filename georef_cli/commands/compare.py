"""Command `georef compare`."""

import click

from georef_cli import boundary, options, tables
from georef_cli.command import Command
from georef_cli.display import progress_for
from georef_cli.output import document_of, print_result
from pipelines.compare.configurations import BY_CONFIGURATION, COMMON_TRAIN_OPTIONS, select_configurations
from pipelines.core.options import OptionValue
from pipelines.train.options import TrainOptions


def _compare(ctx: click.Context, **values: OptionValue) -> None:
    from pipelines.compare.stage import compare

    configurations = select_configurations(values["configs"])
    workspace = values["workspace"]
    table, finished = compare(
        workspace,
        configurations,
        options.given(ctx, COMMON_TRAIN_OPTIONS),
        force=values["force"],
        progress=progress_for(ctx.obj),
        around=boundary.logged_to_file,
    )
    stages = [{"configuration": stage.configuration, **document_of(stage.outcome)} for stage in finished]
    document = {"workspace": str(workspace.root), **table.model_dump(mode="json"), "stages": stages}
    print_result(document, *tables.comparison(table), as_json=values["as_json"])


command = Command(
    "compare",
    params=[
        options.WORKSPACE,
        click.Option(
            ["--configs"],
            default=",".join(BY_CONFIGURATION),
            help=f"Configurations to compare, with commas. [default: {','.join(BY_CONFIGURATION)}]",
        ),
        *options.stage_options(TrainOptions, COMMON_TRAIN_OPTIONS),
        options.flag("--force", text="Run the stages of the configurations even if their products are current."),
        options.JSON,
    ],
    callback=click.pass_context(_compare),
    help="""
        baseline: bundle adjustment with the fixes, then 3DGS. A: 3DGS, aligned afterwards with the fixes. B: its
        Gaussians, placed by the paper's initial similarity. C: similarity and cameras trained too, with L_abs.
        D: C with L_gcp and L_rel. E: D with a rising weight, the full method.

        Stages up to geolocate are shared, and run first where they are not current. Each configuration is kept in
        WS/compare/NAME; a second call skips what is current and resumes what was interrupted. All are trained with
        the same options: those of the last comparison and of georef train, unless given. The table is
        WS/compare/table.json, table.md and plot.png, and comparison.html shows all of it.

        \b
        Examples:
          georef compare flight --preset fast
          georef compare flight --configs baseline,A,E --preset fast --iterations 600 --max-image-size 320
          georef compare flight --configs E --json
        """,
)
