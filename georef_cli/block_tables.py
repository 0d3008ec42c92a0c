"""Tables of a training in blocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from georef_cli.layout import plain_table
from georef_cli.markup import shown
from georef_cli.tables import Renderable

if TYPE_CHECKING:
    from pipelines.scene.block_plan import BlockPlan


def plan(document: BlockPlan, states: Mapping[int, str]) -> list[Renderable]:
    """Return the blocks of a plan, with what is known of their training.

    Args:
        document: the plan.
        states: by number of the block: `trained`, or why it must be trained.
    """
    table = plain_table("block", "photographs", "Gaussians", "in a view", "memory", "", right=[0, 1, 2, 3, 4])
    for block in document.blocks:
        table.add_row(
            str(block.id),
            str(len(block.cameras)),
            f"{block.gaussians:,}".replace(",", " "),
            f"{block.visible:,.0f}".replace(",", " "),
            f"{block.peak_bytes / 2**30:.1f} GiB",
            shown(states.get(block.id, "")),
        )
    number = len(document.blocks)
    whole = f"{number} blocks of {document.photographs} photographs, {document.gaussians} Gaussians in all"
    if document.memory_bytes is not None:
        whole += f", for workers with {document.memory_bytes / 2**30:.1f} GiB"
    return [table, whole]
