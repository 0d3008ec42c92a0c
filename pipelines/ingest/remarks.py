"""Remarks on a survey: assumptions, warnings of what was left out, and cautions."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from pipelines.core.products import Remark
from pipelines.survey.survey import UsedTransformation

_SHOWN = 4


@dataclass
class Remarks:
    """Assumptions, warnings and cautions, gathered while a survey is read, in order and without repeats."""

    assumptions: list[Remark] = field(default_factory=list)
    warnings: list[Remark] = field(default_factory=list)
    cautions: list[Remark] = field(default_factory=list)
    transformations: list[UsedTransformation] = field(default_factory=list)

    @property
    def by_kind(self) -> tuple[Sequence[Remark], Sequence[Remark], Sequence[Remark]]:
        """Warnings, cautions and assumptions, in the order of `core.workspace.Summary`."""
        return self.warnings, self.cautions, self.assumptions

    def assume(self, code: str, sentence: str, remedy: str = "") -> None:
        """Record what stands in for what the input does not state."""
        add(self.assumptions, Remark(code=code, sentence=sentence, remedy=remedy))

    def warn(self, code: str, sentence: str, remedy: str = "") -> None:
        add(self.warnings, Remark(code=code, sentence=sentence, remedy=remedy))

    def caution(self, code: str, sentence: str, remedy: str = "") -> None:
        """Record a limit of every result of this survey."""
        add(self.cautions, Remark(code=code, sentence=sentence, remedy=remedy))

    def warn_counted(self, code: str, items: Sequence[str], fault: str, remedy: str = "") -> None:
        """Record one warning for all items (files, or places as `file:line`), with their count and the first few.

        The fault is a sentence in the plural, without a full stop: "Empty images are left out".
        """
        if items:
            self.warn(code, f"{fault} ({len(items)}): {shortened(items)}.", remedy)


def add(remarks: list[Remark], remark: Remark) -> None:
    """Append a remark, unless it was recorded before."""
    if remark not in remarks:
        remarks.append(remark)


def shortened(items: Sequence[str]) -> str:
    """Return the first few of a list, and how many more there are."""
    more = f" and {len(items) - _SHOWN} more" if len(items) > _SHOWN else ""
    return ", ".join(items[:_SHOWN]) + more
