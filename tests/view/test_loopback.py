"""The viewer's server answers this machine alone, and finds a free port."""

from __future__ import annotations

import http.client
from collections.abc import Iterator

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from pipelines.core.errors import GeorefError
from pipelines.view import loopback
from pipelines.view.loopback import HOST, start_server


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    started = start_server(8650, "test")
    yield started
    started.stop()


def status(port: int, **headers: str) -> int:
    connection = http.client.HTTPConnection(HOST, port, timeout=5)
    connection.request("GET", "/", headers=headers)
    return connection.getresponse().status


def test_pages_of_this_machine_are_answered(server: viser.ViserServer) -> None:
    port = server.get_port()
    assert status(port) == 200
    assert status(port, Host=f"localhost:{port}") == 200
    assert status(port, Origin=f"http://{HOST}:{port}") == 200


@pytest.mark.parametrize("host", ["example.org", "example.org:{port}", "127.0.0.1", "localhost:1", ""])
def test_other_hosts_are_refused(server: viser.ViserServer, host: str) -> None:
    port = server.get_port()
    assert status(port, Host=host.format(port=port)) == 403


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
def test_other_origins_are_refused_also_by_the_websocket(server: viser.ViserServer, origin: str) -> None:
    port = server.get_port()
    text = origin.format(port=port, other=port + 1)
    assert status(port, Origin=text) == 403
    with (
        pytest.raises(InvalidStatus) as refused,
        connect(f"ws://{HOST}:{port}", origin=text, subprotocols=[_protocol()]),
    ):
        pass
    assert refused.value.response.status_code == 403
    with connect(f"ws://{HOST}:{port}", origin=f"http://{HOST}:{port}", subprotocols=[_protocol()]) as own:
        assert own.recv(timeout=5)


def _protocol():
    return f"viser-v{viser.__version__}"


def test_a_taken_port_leads_to_the_next_one(server: viser.ViserServer, caplog: pytest.LogCaptureFixture) -> None:
    second = start_server(server.get_port(), "second")
    try:
        assert second.get_port() > server.get_port()
        assert f"port {server.get_port()} is taken" in caplog.text
    finally:
        second.stop()


def test_the_server_is_bound_to_loopback(server: viser.ViserServer) -> None:
    assert server.get_host() == "127.0.0.1"


def test_no_tunnel_is_opened(server: viser.ViserServer) -> None:
    assert server.request_share_url() is None


def test_a_server_that_cannot_be_guarded_is_not_left_running(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loopback, "_is_from_here", lambda *_: True)
    with pytest.raises(GeorefError, match="pages of other sites"):
        start_server(8690, "open")
    with pytest.raises(ConnectionRefusedError):
        status(8690)
