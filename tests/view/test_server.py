"""The server answers whom it was started for alone, and takes what a page may send alone."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator

import numpy as np
import pytest

from pipelines.core.workspace import Workspace
from pipelines.view.options import ViewOptions
from pipelines.view.saved import FOLDER
from pipelines.view.server import HOST, MOST_BYTES, ViewerServer, served

CAMERA = {"rotation": [1, 0, 0, 0, -0.6, -0.8, 0, 0.8, -0.6], "position": [0, -40, 30], "fov": 0.9}
CAMERA |= {"width": 320, "height": 200}
NOWHERE = {"position_in_geo": [0, 0, 0], "cov_of_surface": [[0, 0, 0]] * 3, "cameras": []}
PICK = {**CAMERA, "x": 160, "y": 100}


@pytest.fixture(scope="module")
def server(viewed: Workspace) -> Iterator[ViewerServer]:
    with served(viewed, ViewOptions(port=8811)) as started:
        yield started


def ask(
    server: ViewerServer,
    path: str,
    body: object = None,
    *,
    method: str = "",
    key: str | None = None,
    **headers: str,
) -> tuple[int, object]:
    """Return status and document of a request."""
    connection = http.client.HTTPConnection(HOST, server.port, timeout=60)
    data = body if isinstance(body, bytes) else None if body is None else json.dumps(body).encode()
    try:
        own = {"Host": f"{HOST}:{server.port}", **headers}
        connection.request(method or ("GET" if data is None else "POST"), f"/{key or server.key}/{path}", data, own)
        response = connection.getresponse()
        content = response.read()
        assert "default-src 'none'" in response.headers["Content-Security-Policy"]
        is_json = response.headers["Content-Type"].startswith("application/json")
        return response.status, json.loads(content) if is_json else content
    finally:
        connection.close()


def test_strangers_are_refused(server: ViewerServer) -> None:
    assert server.refuses_strangers()
    own = f"http://{HOST}:{server.port}"
    assert ask(server, "scene", Origin=own)[0] == 200
    for headers in ({"Origin": "http://georef.invalid"}, {"Origin": "null"}, {"Host": "georef.invalid"}):
        assert ask(server, "scene", **headers)[0] == 403
        assert ask(server, "pick", PICK, **headers)[0] == 403
    for key in ("x", server.key[:-1], server.key + "x", server.key.swapcase()):
        assert ask(server, "scene", key=key)[0] == 403


@pytest.mark.parametrize(
    "path", ["page/../server.py", "page/%2e%2e/server.py", "page/", "page/x.js", "saved/../ingest", "nothing"]
)
def test_no_other_file_is_sent(server: ViewerServer, path: str) -> None:
    assert ask(server, path)[0] in (403, 404)


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("pick", b"{"),
        ("pick", b"[" * 100_000),
        ("pick", {**PICK, "x": float("1e300")}),
        ("pick", {**PICK, "rotation": [2, 0, 0, 0, 1, 0, 0, 0, 1]}),
        ("pick", {**PICK, "width": 10**6}),
        ("pick", {**PICK, "more": 1}),
        ("picture", {**CAMERA, "box": [0, 0, 0]}),
        ("jobs", {"kind": "volume", "points": []}),
        ("jobs", {"kind": "area", "points": [NOWHERE] * 3}),
        ("measurements", {"job": "1", "name": ""}),
        ("marks", {"point": "a", "image": "../a.jpg", "place_px": [1, 1]}),
    ],
)  # fmt: skip
def test_what_no_page_sends_is_refused_with_a_reason(server: ViewerServer, path: str, body: object) -> None:
    status, answer = ask(server, path, body)
    assert status == 400
    assert isinstance(answer, dict) and "does not take" in answer["error"]


def test_bodies_and_numbers_are_limited(server: ViewerServer) -> None:
    with pytest.raises((ConnectionError, http.client.HTTPException)):
        assert ask(server, "pick", b" " * (MOST_BYTES + 1))[0] != 200
        raise ConnectionError
    assert ask(server, "photo/99999")[0] == 422
    assert ask(server, "photo/0?px=nan")[0] == 400
    assert ask(server, "jobs/123456789012345678901234567890")[1] == {
        "state": "failed", "failure": "The viewer has forgotten this measurement. Measure it again."
    }  # fmt: skip


def test_a_measurement_from_pick_to_file(server: ViewerServer, viewed: Workspace) -> None:
    points = [
        ask(server, "pick", {**PICK, "x": x, "y": y})[1]["point"] for x, y in ((140, 90), (180, 90), (160, 120))
    ]  # type: ignore[index]
    status, job = ask(server, "jobs", {"kind": "volume", "points": points, "base": {"kind": "mean"}})
    assert status == 200 and isinstance(job, dict)
    while job["state"] == "running":
        _, job = ask(server, f"jobs/{job['number']}")  # type: ignore[assignment]
    assert job["state"] == "done"
    volume = next(each for each in job["answer"]["quantities"] if each["name"] == "volume")
    assert np.isfinite(volume["value"]) and volume["sigma"] > 0
    _, saved = ask(server, "measurements", {"job": job["number"], "name": "heap"})
    assert [each["name"] for each in saved] == ["heap"]  # type: ignore[union-attr]
    assert (viewed.root / FOLDER / "volumes.csv").is_file()
    assert ask(server, "saved/measurements.geojson")[0] == 200
    identity = saved[0]["id"]  # type: ignore[index]
    assert ask(server, f"measurements/{identity}", {"name": "pit"})[1][0]["name"] == "pit"  # type: ignore[index]
    assert ask(server, f"measurements/{identity}", method="DELETE")[1] == []
    bare = {name: value for name, value in saved[0].items() if name not in ("older", "cameras")}  # type: ignore[index]
    assert ask(server, "measurements", bare, method="PUT")[1][0]["name"] == "heap"  # type: ignore[index]
    ask(server, f"measurements/{identity}", method="DELETE")
