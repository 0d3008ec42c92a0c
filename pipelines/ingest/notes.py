"""Notes on the way to a survey: assumptions, and rows or files that were left out and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from pipelines.core.products import Caution

_SHOWN = 4


@dataclass
class Notes:
    """Assumptions, warnings and cautions, gathered while a survey is read, in order and without repeats."""

    assumptions: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    cautions: list[Caution] = field(default_factory=list)

    def assume(self, text: str) -> None:
        """Record an assumption."""
        if text not in self.assumptions:
            self.assumptions.append(text)

    def warn(self, text: str) -> None:
        """Record a warning."""
        if text not in self.warnings:
            self.warnings.append(text)

    def caution(self, caution: Caution) -> None:
        """Record a limit of every result of this survey."""
        if caution not in self.cautions:
            self.cautions.append(caution)

    def warn_counted(self, items: Sequence[str], singular: str, plural: str) -> None:
        """Record one warning for all items (files, or places as `file:line`), with their count and the first few.

        The fault of one, e.g. "image is empty and was left out", is `singular`, and that of many is `plural`.
        """
        if items:
            self.warn(f"{len(items)} {singular if len(items) == 1 else plural}: {shortened(items)}")


def shortened(items: Sequence[str]) -> str:
    """Return the first few of a list, and how many more there are."""
    more = f" and {len(items) - _SHOWN} more" if len(items) > _SHOWN else ""
    return ", ".join(items[:_SHOWN]) + more
