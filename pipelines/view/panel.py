"""Base of the viewer's panels: buttons, one place for results, and one for what failed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from pipelines.core.errors import GeorefError, StorageError
from pipelines.view.tables import failure, paragraph

if TYPE_CHECKING:
    import viser


class Panel:
    """Panel with buttons; an error of what a button does is told above the results, and leaves them as they are."""

    _result: viser.GuiHtmlHandle
    _failed: viser.GuiHtmlHandle

    def _add_results(self, gui: viser.GuiApi) -> None:
        self._failed, self._result = gui.add_html(""), gui.add_html("")

    def _button(self, gui: viser.GuiApi, label: str, act: Callable[[], None], hint: str | None = None) -> None:
        gui.add_button(label, hint=hint).on_click(lambda _: self._safely(act))

    def _safely(self, act: Callable[[], None]) -> None:
        try:
            act()
        except GeorefError as error:
            stays = " The page keeps what it shows: make room on the disk, then try again."
            self._failed.content = failure(f"Not done: {error}.{stays if isinstance(error, StorageError) else ''}")
        else:
            self._failed.content = ""

    def _tell(self, sentence: str) -> None:
        self._result.content = paragraph(sentence)
