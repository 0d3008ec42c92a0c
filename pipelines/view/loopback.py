"""The viewer's server: viser on loopback, for whoever knows the address that was printed.

viser serves its own page and speaks with it through a websocket. A page from elsewhere that is open in the same
browser could speak with it as well, unless its Origin is looked at, and could pretend to come from here by a name
that resolves to 127.0.0.1, unless Host is looked at. Another program of this machine could send both, and lacks the
key that is the path of the address; viser's page hands it on to its websocket. viser looks at none of the three.

viser also sets any property of an element that a message names, and casts what does not fit. A forged message could
so remove an element or its callback for all pages, or leave a traceback a message. Known messages alone pass.
"""

import contextlib
import functools
import hmac
import http.client
import io
import logging
import math
import secrets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from typing import Annotated, Any, Literal

import msgspec
import viser
from websockets.asyncio import server as websockets_server
from websockets.exceptions import ConnectionClosedError
from websockets.frames import CloseCode

from pipelines.core.errors import GeorefError

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
_FOREIGN = "georef.invalid"
_TIMEOUT_S = 5.0
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
    """Message that is not let through, with the kind of its fault: the log has one line a page and kind."""

    def __init__(self, kind: str, reason: str) -> None:
        self.kind = kind
        super().__init__(reason)


@dataclass
class Doorkeeper:
    """What the server admits: addresses that begin with the key, values of viser's elements and commands, by id."""

    key: str = field(default_factory=lambda: secrets.token_urlsafe(16), repr=False)
    elements: Mapping[str, Any] = field(default_factory=dict)
    commands: Mapping[str, Any] = field(default_factory=dict)


def check_message(raw: object, keeper: Doorkeeper) -> None:
    """Check a message as a page sent it; a RefusedError: the page may not send it."""
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
            if uuid not in keeper.elements:
                raise RefusedError("element", f"there is no element {uuid!r}")
            if not _takes(keeper.elements[uuid], updates.value):
                raise RefusedError("value", f"{updates.value!r} is no value of {keeper.elements[uuid].label!r}")
        case _Command(uuid=uuid):
            if uuid not in keeper.commands:
                raise RefusedError("element", f"there is no command {uuid!r}")


def _takes(element: Any, value: bool | float | str) -> bool:
    """Return whether a person could give an element of the viewer this value."""
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
    """Connection of a page that viser reads from: refused messages never reach it."""

    def __init__(self, connection: websockets_server.ServerConnection, keeper: Doorkeeper) -> None:
        self._connection, self._keeper = connection, keeper
        self._told: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._connection, name)

    async def recv(self) -> bytes:
        """Return the next message that the page may send."""
        while True:
            try:
                raw = await self._connection.recv()
                check_message(raw, self._keeper)
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
            log.warning(
                "A message of a browser page was refused: %s. Further ones of this kind are not logged.",
                reason, extra={"code": "page-message-refused"},
            )  # fmt: skip


def start_server(port: int, title: str, *, dark: bool = False) -> tuple[viser.ViserServer, str]:
    """Start a server on loopback, at a port or, if that is taken, the next free one; return it with its address.

    Raises:
        GeorefError: no port is free, or the server would answer strangers.
    """
    keeper = Doorkeeper()
    server = _start(port, title, keeper)
    keeper.elements, keeper.commands = server.gui._gui_input_handle_from_uuid, server.gui._command_handle_from_uuid
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", dark_mode=dark)
    server.gui.main_panel.dock_right()
    if not _refuses_strangers(server.get_port(), keeper.key):
        stop_server(server)
        raise GeorefError(
            "viewer-not-private",
            "This version of viser answers requests without the key of the page. Install viser 1.1.",
        )
    if server.get_port() != port:
        taken = "Port %d is taken: the viewer uses port %d."
        log.warning(taken, port, server.get_port(), extra={"code": "port-taken"})
    return server, f"http://{HOST}:{server.get_port()}/{keeper.key}/"


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server, without what viser prints about it."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _start(port: int, title: str, keeper: Doorkeeper) -> viser.ViserServer:
    class Server(viser.ViserServer):
        """Server that opens no tunnel to the Internet when a page asks for one."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    with _checked_connections(keeper), contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        return Server(host=HOST, port=port, label=title, verbose=False)


@contextlib.contextmanager
def _checked_connections(keeper: Doorkeeper) -> Iterator[None]:
    """Let servers that start meanwhile answer whom the doorkeeper admits, and hear what a page may send."""
    original, protocol = websockets_server.serve, f"viser-v{viser.__version__}"

    @functools.wraps(original)
    def serve(handler: Any, host: str, port: int, *, process_request: Any, **settings: Any) -> Any:
        def admitted(connection: Any, request: Any) -> Any:
            given, _, path = request.path.partition("?")[0].removeprefix("/").partition("/")
            has_key = hmac.compare_digest(given.encode(errors="replace"), keeper.key.encode())
            if has_key and _is_from_here(request.headers, port):
                return process_request(connection, replace(request, path=f"/{path}"))
            return connection.respond(HTTPStatus.FORBIDDEN, "open the address that georef view printed\n")

        async def heard(connection: Any) -> None:
            if connection.subprotocol == protocol:  # viser prints a line about every other one
                await handler(CheckedConnection(connection, keeper))

        limited = {**settings, "max_size": MOST_BYTES}
        return original(heard, host, port, process_request=admitted, **limited)

    websockets_server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets_server.serve = original  # type: ignore[misc]


def _is_from_here(headers: Any, port: int) -> bool:
    """Return whether a request was sent to this machine by name, and by a page of this server or by none."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    own = {f"{name}:{port}" for name in (HOST, "localhost")}
    return len(hosts) == 1 and hosts[0] in own and all(origin == f"http://{hosts[0]}" for origin in origins)


def _refuses_strangers(port: int, key: str) -> bool:
    """Return whether the server refuses another host, a page from elsewhere and an address without its key."""
    own, page = f"{HOST}:{port}", f"/{key}/"
    strangers = (
        (page, {"Host": _FOREIGN}),
        (page, {"Host": own, "Origin": f"http://{_FOREIGN}"}),
        ("/", {"Host": own}),
    )
    refused = all(_status(port, path, headers) == HTTPStatus.FORBIDDEN for path, headers in strangers)
    return refused and _status(port, page, {"Host": own}) == HTTPStatus.OK


def _status(port: int, path: str, headers: dict[str, str]) -> int:
    connection = http.client.HTTPConnection(HOST, port, timeout=_TIMEOUT_S)
    try:
        connection.request("GET", path, headers=headers)
        return connection.getresponse().status
    finally:
        connection.close()
