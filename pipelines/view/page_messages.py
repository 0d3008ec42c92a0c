"""Messages that a page may send: their form, and the connection that lets no other through.

viser sets any property of an element that a message names, and casts what does not fit. A forged message could so
remove an element or its callback for all pages, or leave a traceback a message.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from websockets.exceptions import ConnectionClosedError
from websockets.frames import CloseCode

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

log = logging.getLogger(__name__)

MOST_BYTES = 1 << 16  # of a message; the longest text of an element takes two thirds of it
_MOST_CHARACTERS = 10_000
_SHOWN_CHARACTERS = 120

Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]  # no NaN either
Triple = tuple[Number, Number, Number]
Pixels = Annotated[float, msgspec.Meta(ge=0, le=1 << 15)]


class _Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True, frozen=True):
    """Message of a page, as viser 1.1 names its fields."""


class _Camera(_Message, tag="ViewerCameraMessage", frozen=True):
    wxyz: tuple[Number, Number, Number, Number]
    position: Triple
    fov: Annotated[float, msgspec.Meta(gt=0, le=math.pi)]
    near: Number
    far: float
    image_height: Pixels
    image_width: Pixels
    look_at: Triple
    up_direction: Triple


class _Click(_Message, tag="ScenePointerMessage", frozen=True):
    event_type: Literal["click"]
    ray_origin: Triple
    ray_direction: Triple
    screen_pos: tuple[tuple[Number, Number]]
    modifier: Annotated[str, msgspec.Meta(max_length=40)] | None


class _Value(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    value: bool | float | Annotated[str, msgspec.Meta(max_length=_MOST_CHARACTERS)]


class _Update(_Message, tag="GuiUpdateMessage", frozen=True):
    uuid: str
    updates: _Value


class _Command(_Message, tag="CommandTriggerMessage", frozen=True):
    uuid: str


_DECODER = msgspec.msgpack.Decoder(_Camera | _Click | _Update | _Command)


class RefusedError(Exception):
    """Message that is not let through.

    Args:
        kind: of the fault: the log has one line a page and kind.
        reason: the fault in words.
    """

    def __init__(self, kind: str, reason: str) -> None:
        self.kind = kind
        super().__init__(reason)


def check_message(raw: object, elements: Mapping[str, Any], commands: Mapping[str, Any]) -> None:
    """Check a message of a page.

    Args:
        raw: the message as it arrived.
        elements: handles of viser's elements with a value, by id.
        commands: handles of the keyboard's commands, by id.

    Raises:
        RefusedError: the page may not send it.
    """
    if not isinstance(raw, bytes):
        raise RefusedError("form", "text where viser sends bytes")
    try:
        message = _DECODER.decode(raw)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise RefusedError("form", str(error)) from error
    match message:
        case _Camera(wxyz=direction) | _Click(ray_direction=direction):
            if not 0.5 < math.hypot(*direction) < 2.0:  # of length one but for rounding
                raise RefusedError("direction", f"{direction} is no direction")
        case _Update(uuid=uuid, updates=updates):
            if uuid not in elements:
                raise RefusedError("element", f"there is no element {uuid!r}")
            if not _takes(elements[uuid], updates.value):
                raise RefusedError("value", f"{updates.value!r} is no value of {elements[uuid].label!r}")
        case _Command(uuid=uuid):
            if uuid not in commands:
                raise RefusedError("element", f"there is no command {uuid!r}")


def _takes(element: Any, value: bool | float | str) -> bool:
    """Return whether a person could give an element of the viewer this value."""
    import viser

    match element:
        case viser.GuiButtonHandle():
            return value is True
        case viser.GuiCheckboxHandle():
            return isinstance(value, bool)
        case viser.GuiDropdownHandle():
            return value in element.options
        case viser.GuiSliderHandle():
            return isinstance(value, float) and element.min <= value <= element.max
        case viser.GuiTextHandle():
            return isinstance(value, str)
    return False


class CheckedConnection:
    """Connection of a page that viser reads from: refused messages never reach it.

    Args:
        connection: of the page.
        elements: handles of viser's elements with a value, by id.
        commands: handles of the keyboard's commands, by id.
    """

    def __init__(
        self, connection: ServerConnection, elements: Mapping[str, Any], commands: Mapping[str, Any]
    ) -> None:
        self._connection, self._elements, self._commands = connection, elements, commands
        self._told: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """Return the next message that the page may send."""
        while True:
            try:
                raw = await self._connection.recv()
                check_message(raw, self._elements, self._commands)
            except RefusedError as error:
                self._tell(error)
            except ConnectionClosedError as error:
                if error.sent is not None and error.sent.code == CloseCode.MESSAGE_TOO_BIG:
                    self._tell(RefusedError("size", f"more than {MOST_BYTES >> 10} KiB: its connection is closed"))
                raise
            else:
                assert isinstance(raw, bytes)
                return raw

    def _tell(self, error: RefusedError) -> None:
        if error.kind not in self._told:
            self._told.add(error.kind)
            reason = ascii(str(error))[1:-1][:_SHOWN_CHARACTERS]  # no line breaks, no signs that steer a terminal
            log.warning("a message of a page is refused: %s (more of this kind are not logged)", reason)
