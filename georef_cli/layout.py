"""Tables that fit the width of the terminal, and text of others, shown literally and without escape sequences."""

from collections.abc import Mapping, Sequence

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.markup import escape
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table

from pipelines.core.sentences import printable, printable_lines


class FirstThatFits:
    """Renderable that takes the first form that needs no more than the width of the terminal, or else the last."""

    def __init__(self, *forms: RenderableType) -> None:
        self._forms = forms

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        unlimited = options.update(max_width=10_000)
        for form in self._forms[:-1]:
            if Measurement.get(console, unlimited, form).maximum <= options.max_width:
                yield form
                return
        yield self._forms[-1]


class ByWidth:
    """Renderable with one form for terminals of at least so many columns, and one with fewer columns for others."""

    def __init__(self, least: int, wide: RenderableType, narrow: RenderableType) -> None:
        self._least, self._wide, self._narrow = least, wide, narrow

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield self._wide if options.max_width >= self._least else self._narrow


def plain_table(
    *columns: str, header: bool = True, right: Sequence[int] = (), no_wrap: Sequence[int] = ()
) -> Table:
    """Return an empty table without lines; some columns are right-aligned, some are never wrapped."""
    table = Table(*columns, show_header=header, box=None, pad_edge=False)
    for index in right:
        table.columns[index].justify = "right"
    for index in no_wrap:
        table.columns[index].no_wrap = True
    return table


def figures(heads: Sequence[str], rows: Mapping[str, Sequence[str]]) -> FirstThatFits:
    """Return rows of figures: a line for each row, or a line for each figure where that is too wide.

    A line break in a head separates group and name. The texts of the figures are markup.
    """
    wide = plain_table("", *heads, right=range(1, len(heads) + 1), no_wrap=range(len(heads) + 1))
    for name, cells in rows.items():
        wide.add_row(name, *cells)
    tall = plain_table("", *rows, right=range(1, len(rows) + 1))
    for index, head in enumerate(heads):
        tall.add_row(head.replace("\n", " ").strip(), *(cells[index] for cells in rows.values()))
    return FirstThatFits(wide, tall)


def shown(text: str) -> str:
    """Return the rich markup that shows a text of others literally, on one line."""
    return escape(printable(text))


class Safe:
    """Renderable whose text, wherever it comes from, reaches the terminal without escapes of its own."""

    def __init__(self, renderable: RenderableType) -> None:
        self._renderable = renderable

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for segment in console.render(self._renderable, options):
            yield segment if segment.control else Segment(printable_lines(segment.text), segment.style)
