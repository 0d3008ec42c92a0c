"""Tables of a training in blocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from georef_cli.layout import plain_table
from georef_cli.markup import shown
from georef_cli.tables import Renderable
from pipelines.core.sentences import about

if TYPE_CHECKING:
    from pipelines.scene.block_plan import BlockPlan


def plan(
    document: BlockPlan, states: Mapping[int, str], processor_s: Mapping[int, float] | None = None
) -> list[Renderable]:
    """Return the blocks of a plan, with what is known of their training.

    Args:
        document: the plan.
        states: by number of the block: `trained`, or why it must be trained.
        processor_s: predicted time of one core, by number of the block; None: unknown.
    """
    heads = ["block", "photographs", "Gaussians", "in a view", "memory"] + ["processor time"] * bool(processor_s)
    table = plain_table(*heads, "", right=list(range(len(heads))))
    for block in document.blocks:
        table.add_row(
            str(block.id),
            str(len(block.cameras)),
            f"{block.gaussians:,}".replace(",", " "),
            f"{block.visible:,.0f}".replace(",", " "),
            f"{block.peak_bytes / 2**30:.1f} GiB",
            *([about(processor_s[block.id])] if processor_s else []),
            shown(states.get(block.id, "")),
        )
    number = len(document.blocks)
    whole = f"{number} blocks of {document.photographs} photographs, {document.gaussians} Gaussians in all"
    if document.memory_bytes is not None:
        whole += f", for workers with {document.memory_bytes / 2**30:.1f} GiB"
    if processor_s:
        whole += f"; about {about(sum(processor_s.values()))} of one core for all of them"
    return [table, whole]
