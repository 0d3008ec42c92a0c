"""Text of others in rich tables and lines: shown literally, without markup and without escape sequences."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.markup import escape
from rich.segment import Segment

from pipelines.core.printable import printable, printable_lines


def shown(text: str) -> str:
    """Return the rich markup that shows a text of others literally, on one line."""
    return escape(printable(text))


class Safe:
    """Renderable whose text, wherever it comes from, reaches the terminal without escapes of its own."""

    def __init__(self, renderable: RenderableType) -> None:
        self._renderable = renderable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the segments of the renderable, those with text made printable."""
        yield from _safe(console.render(self._renderable, options))


def _safe(segments: Iterable[Segment]) -> Iterable[Segment]:
    for segment in segments:
        if segment.control:
            yield segment
        else:
            yield Segment(printable_lines(segment.text), segment.style)
