"""The viewer's server answers whoever has its address, on this machine, and finds a free port."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from pipelines.view import loopback
from pipelines.view.loopback import HOST, start_server, stop_server
from tests.refusals import logged_codes, refused


@pytest.fixture(scope="module")
def started() -> Iterator[tuple[viser.ViserServer, str]]:
    server, address = start_server(8650, "test")
    yield server, address
    stop_server(server)


@pytest.fixture
def server(started: tuple[viser.ViserServer, str]) -> viser.ViserServer:
    return started[0]


@pytest.fixture
def path(started: tuple[viser.ViserServer, str]) -> str:
    return urlsplit(started[1]).path


def status(port: int, path: str, **headers: str) -> int:
    connection = http.client.HTTPConnection(HOST, port, timeout=5)
    connection.request("GET", path, headers=headers)
    return connection.getresponse().status


def refusal(port: int, path: str, origin: str | None = None) -> int:
    """Status with which a websocket's handshake is refused."""
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(f"ws://{HOST}:{port}{path}", origin=origin, subprotocols=[_protocol()]),
    ):
        pass
    return refused.value.response.status_code


def test_pages_of_this_machine_are_answered(server: viser.ViserServer, path: str) -> None:
    port = server.get_port()
    assert status(port, path) == 200
    assert status(port, path + "?darkMode=1", Host=f"localhost:{port}") == 200
    assert status(port, path.rstrip("/"), Origin=f"http://{HOST}:{port}") == 200


def test_without_its_key_nothing_is_answered(server: viser.ViserServer, path: str) -> None:
    key, port = path.strip("/"), server.get_port()
    assert len(key) >= 22  # 128 bits
    other = ("A" if key[0] != "A" else "B") + key[1:]
    for wrong in (
        "/",
        "/index.html",
        f"/{other}/",
        f"/{key[:-1]}/",
        f"/{key}x",
        f"/x/{key}/",
        f"/?{key}",
        "/%C3%A9/",
    ):
        assert status(port, wrong) == 403, wrong
        assert refusal(port, wrong) == 403, wrong
    second, address = start_server(8660, "second")
    stop_server(second)
    assert key not in address


@pytest.mark.parametrize("host", ["example.org", "example.org:{port}", "127.0.0.1", "localhost:1", ""])
def test_other_hosts_are_refused(server: viser.ViserServer, path: str, host: str) -> None:
    port = server.get_port()
    assert status(port, path, Host=host.format(port=port)) == 403


@pytest.mark.parametrize(
    "origin",
    [
        "http://example.org",
        "null",
        "https://127.0.0.1:{port}",
        "http://127.0.0.1:{other}",
        "http://localhost:{port}",
    ],
)
def test_other_origins_are_refused_also_by_the_websocket(server: viser.ViserServer, path: str, origin: str) -> None:
    port = server.get_port()
    text = origin.format(port=port, other=port + 1)
    assert status(port, path, Origin=text) == 403
    assert refusal(port, path, text) == 403
    own = f"http://{HOST}:{port}"
    with connect(f"ws://{HOST}:{port}{path}", origin=own, subprotocols=[_protocol()]) as page:
        assert page.recv(timeout=5)


def _protocol():
    return f"viser-v{viser.__version__}"


def test_a_taken_port_leads_to_the_next_one(server: viser.ViserServer, caplog: pytest.LogCaptureFixture) -> None:
    second, address = start_server(server.get_port(), "second")
    try:
        assert second.get_port() > server.get_port()
        assert address.startswith(f"http://{HOST}:{second.get_port()}/")
        assert logged_codes(caplog) == ["port-taken"]
    finally:
        stop_server(second)


def test_the_server_is_bound_to_loopback(server: viser.ViserServer) -> None:
    assert server.get_host() == "127.0.0.1"


def test_no_tunnel_is_opened(server: viser.ViserServer) -> None:
    assert server.request_share_url() is None


@pytest.mark.parametrize(("name", "careless"), [("_is_from_here", True), ("hmac.compare_digest", True)])
def test_a_server_that_cannot_be_guarded_is_not_left_running(
    monkeypatch: pytest.MonkeyPatch, name: str, careless: bool
) -> None:
    monkeypatch.setattr(f"{loopback.__name__}.{name}", lambda *_: careless)
    with refused("viewer-not-private"):
        start_server(8690, "open")
    with pytest.raises(ConnectionRefusedError):
        status(8690, "/")
