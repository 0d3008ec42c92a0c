"""The viewer's server: viser on loopback, for pages of this machine alone.

viser serves its own page and speaks with it through a websocket. A page from elsewhere that is open in the same
browser could speak with it as well, unless its Origin is looked at, and could pretend to come from here by a name
that resolves to 127.0.0.1, unless Host is looked at. viser looks at neither.
"""

from __future__ import annotations

import contextlib
import functools
import http.client
import io
import logging
from collections.abc import Iterator
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from pipelines.core.errors import BackendUnavailableError, GeorefError

if TYPE_CHECKING:
    import viser

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
_FOREIGN = "georef.invalid"
_TIMEOUT_S = 5.0


def start_server(port: int, title: str, *, dark: bool = False) -> viser.ViserServer:
    """Start a server on loopback, at a port or, if that is taken, the next free one.

    Args:
        port: the wanted port.
        title: of the page.
        dark: whether its panel is light on dark.

    Raises:
        BackendUnavailableError: viser is not installed.
        GeorefError: no port is free, or the server would answer pages from elsewhere.
    """
    server = _start(port, title)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large", dark_mode=dark)
    server.gui.main_panel.dock_right()
    if not _refuses_strangers(server.get_port()):
        stop_server(server)
        raise GeorefError(
            "this version of viser cannot be kept from answering pages of other sites: install viser 1.1 "
            "(pip install --constraint constraints.txt georefgs)"
        )
    if server.get_port() != port:
        log.warning("port %d is taken: the viewer is at port %d", port, server.get_port())
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server, without what viser prints about it."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _start(port: int, title: str) -> viser.ViserServer:
    try:
        import viser
    except ImportError as error:
        raise BackendUnavailableError(f"viser cannot be imported ({error}): pip install georefgs") from error

    class Server(viser.ViserServer):
        """Server that opens no tunnel to the Internet when a page asks for one."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            """Return None."""
            return None

    with _checked_connections(), contextlib.redirect_stdout(io.StringIO()):  # viser prints a banner
        return Server(host=HOST, port=port, label=title, verbose=False)


@contextlib.contextmanager
def _checked_connections() -> Iterator[None]:
    """Let servers that start meanwhile answer nothing but pages of this machine."""
    from websockets.asyncio import server

    original = server.serve

    @functools.wraps(original)
    def serve(handler: Any, host: str, port: int, *, process_request: Any, **settings: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            if not _is_from_here(request.headers, port):
                return connection.respond(HTTPStatus.FORBIDDEN, "this server answers pages of this machine only\n")
            return process_request(connection, request)

        return original(handler, host, port, process_request=checked, **settings)

    server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = original  # type: ignore[misc]


def _is_from_here(headers: Any, port: int) -> bool:
    """Return whether a request was sent to this machine by name, and by a page of this server or by none."""
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    own = {f"{name}:{port}" for name in (HOST, "localhost")}
    return len(hosts) == 1 and hosts[0] in own and all(origin == f"http://{hosts[0]}" for origin in origins)


def _refuses_strangers(port: int) -> bool:
    """Return whether the server refuses a request for another host, and one of a page from elsewhere."""
    own = f"{HOST}:{port}"
    strangers = ({"Host": _FOREIGN}, {"Host": own, "Origin": f"http://{_FOREIGN}"})
    return all(_status(port, headers) == HTTPStatus.FORBIDDEN for headers in strangers) and (
        _status(port, {"Host": own}) == HTTPStatus.OK
    )


def _status(port: int, headers: dict[str, str]) -> int:
    connection = http.client.HTTPConnection(HOST, port, timeout=_TIMEOUT_S)
    try:
        connection.request("GET", "/", headers=headers)
        return connection.getresponse().status
    finally:
        connection.close()
