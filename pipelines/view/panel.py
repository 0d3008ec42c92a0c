"""Base of the viewer's panels: buttons, and one place for results and errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from pipelines.core.errors import GeorefError
from pipelines.view.tables import paragraph

if TYPE_CHECKING:
    import viser


class Panel:
    """Panel with buttons; an error of what a button does is told where results stand."""

    _result: viser.GuiHtmlHandle

    def _button(self, gui: viser.GuiApi, label: str, act: Callable[[], None]) -> None:
        gui.add_button(label).on_click(lambda _: self._safely(act))

    def _safely(self, act: Callable[[], None]) -> None:
        try:
            act()
        except GeorefError as error:
            self._tell(str(error))

    def _tell(self, sentence: str) -> None:
        self._result.content = paragraph(sentence)
