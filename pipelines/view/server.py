"""The viewer's server: tornado on loopback, for whoever knows the address that was printed.

A page from elsewhere that is open in the same browser could speak with the server as well, unless its Origin is
looked at, and could pretend to come from here by a name that resolves to 127.0.0.1, unless Host is looked at.
Another program of this machine could send both, and lacks the key that is the beginning of each path.
"""

import asyncio
import contextlib
import hmac
import http.client
import json
import logging
import secrets
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler

from pipelines.core.errors import GeorefError, StorageError
from pipelines.core.json_values import JsonValue
from pipelines.core.progress import SILENT, Progress
from pipelines.core.workspace import Workspace
from pipelines.survey.saved_measurements import NamedMeasurement
from pipelines.view import requests
from pipelines.view.exports import profile_file
from pipelines.view.options import ViewOptions
from pipelines.view.saved import FILES
from pipelines.view.viewer import Viewer, jpeg_of, model_stamp
from pipelines.view.work import ViewJob

log = logging.getLogger(__name__)

HOST = "127.0.0.1"
MOST_BYTES = 1 << 20  # of a request's body
_PAGE = Path(__file__).parent / "page"
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
_FOREIGN, _TIMEOUT_S, _WATCH_S = "georef.invalid", 5.0, 2.0
_PORTS = 50  # that are tried
_MOST_PHOTO_PX = 8192
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob: data:; connect-src 'self'; form-action 'none'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
Model = TypeVar("Model", bound=BaseModel)


class ViewerServer:
    """Server of a viewer, on a thread of its own.

    Attributes:
        viewer: that answers; replaced when the model is read again.
        address: of the page, with its key.
        changed: the model was trained again since the viewer read it.
    """

    def __init__(self, viewer: Viewer, read_again: Callable[[], Viewer], port: int) -> None:
        self.viewer, self._read_again = viewer, read_again
        self.key, self.changed = secrets.token_urlsafe(16), False
        self.drawing = ThreadPoolExecutor(1, thread_name_prefix="draw")
        self.working = ThreadPoolExecutor(4, thread_name_prefix="answer")
        self._started, self._loop = threading.Event(), asyncio.new_event_loop()
        sockets, self.port = _bound(port)
        self.address = f"http://{HOST}:{self.port}/{self.key}/"
        self._thread = threading.Thread(target=self._serve, args=(sockets,), daemon=True)
        self._thread.start()
        self._started.wait()

    def _serve(self, sockets: list[socket.socket]) -> None:
        asyncio.set_event_loop(self._loop)
        logging.getLogger("tornado.access").setLevel(logging.ERROR)
        server = HTTPServer(
            Application([(r"/.*", _Handler, {"server": self})]), max_body_size=MOST_BYTES, max_header_size=1 << 14
        )
        server.add_sockets(sockets)
        self._loop.call_soon(self._started.set)
        self._loop.run_forever()
        server.stop()

    def read_again(self) -> None:
        """Replace the viewer by one of the present model."""
        former, self.viewer = self.viewer, self._read_again()
        self.changed = False
        former.close()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self.viewer.close()
        for pool in (self.drawing, self.working):
            pool.shutdown(cancel_futures=True)

    def refuses_strangers(self) -> bool:
        """Return whether another host, a page from elsewhere and an address without the key are refused."""
        host, page = f"{HOST}:{self.port}", f"/{self.key}/"
        strangers = (
            (page, {"Host": _FOREIGN}),
            (page, {"Host": host, "Origin": f"http://{_FOREIGN}"}),
            ("/", {"Host": host}),
        )
        refused = all(_status(self.port, path, headers) == HTTPStatus.FORBIDDEN for path, headers in strangers)
        return refused and _status(self.port, page, {"Host": host}) == HTTPStatus.OK


def _bound(port: int) -> tuple[list[Any], int]:
    for candidate in range(port, min(port + _PORTS, 65536)):
        with contextlib.suppress(OSError):
            sockets = bind_sockets(candidate, HOST)
            if candidate != port:
                taken = "Port %d is taken: the viewer uses port %d."
                log.warning(taken, port, candidate, extra={"code": "port-taken"})
            return sockets, candidate
    raise GeorefError(
        "no-free-port", f"Ports {port} to {port + _PORTS - 1} are taken.", remedy="Give another --port."
    )


def _status(port: int, path: str, headers: dict[str, str]) -> int:
    connection = http.client.HTTPConnection(HOST, port, timeout=_TIMEOUT_S)
    try:
        connection.request("GET", path, headers=headers)
        return connection.getresponse().status
    finally:
        connection.close()


class _Handler(RequestHandler):
    """One request: guarded, then answered by the method of its verb and path."""

    def initialize(self, server: ViewerServer) -> None:
        self._server, self._gone = server, False

    def set_default_headers(self) -> None:
        for name, value in _HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        hosts, origins = (self.request.headers.get_list(name) for name in ("Host", "Origin"))
        allowed = {f"{name}:{self._server.port}" for name in (HOST, "localhost")}
        given, slash, self._path = self.request.path.removeprefix("/").partition("/")
        if not (
            len(hosts) == 1
            and hosts[0] in allowed
            and all(origin == f"http://{hosts[0]}" for origin in origins)
            and slash
            and hmac.compare_digest(given.encode(errors="replace"), self._server.key.encode())
        ):
            raise HTTPError(HTTPStatus.FORBIDDEN)

    def on_connection_close(self) -> None:
        self._gone = True

    def write_error(self, status_code: int, **_kwargs: object) -> None:
        text = {403: "Open the address that georef view printed.", 404: "Not found."}.get(status_code, "Failed.")
        self._finish_json({"error": text}, status_code)

    def _finish_json(self, document: JsonValue, status: int = HTTPStatus.OK) -> None:
        self.set_status(status)
        self.set_header("Content-Type", "application/json; charset=utf-8")
        self.finish(json.dumps(document, allow_nan=False, separators=(",", ":")))

    def _body(self, model: type[Model]) -> Model:
        try:
            return model.model_validate_json(self.request.body or b"{}")
        except ValidationError as error:
            first = error.errors(include_url=False, include_context=False, include_input=False)[0]
            place = ".".join(map(str, first["loc"]))
            raise _BadRequestError(f"{place}: {first['msg']}" if place else first["msg"]) from error

    async def _answer(self, work: Callable[[], Any], pool: ThreadPoolExecutor | None = None) -> None:
        """Answer with what the work returns: bytes with their type, or a document."""

        def unless_gone() -> Any:
            return None if self._gone else work()

        try:
            found = await asyncio.get_running_loop().run_in_executor(pool or self._server.working, unless_gone)
        except _BadRequestError as error:
            self._finish_json(
                {"error": f"The page sent what the viewer does not take. {error}"}, HTTPStatus.BAD_REQUEST
            )
        except GeorefError as error:
            full = " The page keeps what it shows: make room on the disk, then try again."
            text = f"{error}{full if isinstance(error, StorageError) else ''}"
            self._finish_json({"error": text}, HTTPStatus.UNPROCESSABLE_ENTITY)
        else:
            if self._gone:
                return
            if isinstance(found, tuple):
                data, kind, name = found
                self.set_header("Content-Type", kind)
                if name:
                    self.set_header("Content-Disposition", f'attachment; filename="{name}"')
                self.finish(data)
            else:
                self._finish_json(found)

    async def get(self) -> None:
        viewer, server = self._server.viewer, self._server
        answers: dict[str, Callable[[], Any]] = {
            "scene": lambda: {**viewer.scene(), "changed": server.changed},
            "changed": lambda: {"changed": server.changed},
            "surveyed": lambda: viewer.surveyed(self._text("name")),
            "measurements": viewer.measurements,
            "points": viewer.points,
            "points/photographs": lambda: viewer.in_photographs(self._text("name")),
            "points/lines": lambda: viewer.lines(self._text("name"), int(self._number("camera"))),
            "points/place": lambda: viewer.marked(self._text("name")),
        }
        if self._path in answers:
            await self._answer(answers[self._path])
            return
        match self._path.split("/"):
            case [""]:
                self._file("index.html")
            case ["page", name]:
                self._file(name)
            case ["photo", camera] if camera.isdecimal():
                await self._answer(lambda: self._photograph(viewer, int(camera[:7])))
            case ["saved", name] if name in FILES:
                await self._answer(lambda: (viewer.saved_file(name), "application/octet-stream", name))
            case ["jobs", number] if number.isdecimal():
                await self._answer(lambda: self._job(viewer, number))
            case ["jobs", number, "csv" | "dxf" as form] if number.isdecimal():
                await self._answer(lambda: self._profile(viewer, number, form))
            case _:
                raise HTTPError(HTTPStatus.NOT_FOUND)

    async def post(self) -> None:
        viewer = self._server.viewer
        answers: dict[str, Callable[[], Any]] = {
            "pick": lambda: viewer.pick(self._body(requests.PickRequest)),
            "seen": lambda: viewer.seen_by(self._body(requests.SeenRequest)),
            "jobs": lambda: _job_json(viewer.measure(self._body(requests.MeasureRequest))),
            "proposals": lambda: _job_json(viewer.propose(self._body(requests.ProposalRequest))),
            "measurements": lambda: viewer.save(self._body(requests.SaveRequest)),
            "marks": lambda: viewer.set_mark(self._body(requests.MarkRequest)),
            "points": lambda: viewer.set_point(self._body(requests.PointRequest)),
            "points/remove": lambda: viewer.remove_point(self._body(requests.NamedRequest)),
            "points/write": viewer.write_marks,
            "read-again": self._read_again,
        }
        if self._path == "picture":
            await self._answer(lambda: self._picture(viewer), self._server.drawing)
        elif self._path in answers:
            await self._answer(answers[self._path])
        elif self._path.startswith("measurements/"):
            identity = self._path.partition("/")[2]
            await self._answer(lambda: viewer.rename(identity, self._body(requests.NamedRequest)))
        else:
            raise HTTPError(HTTPStatus.NOT_FOUND)

    async def put(self) -> None:
        if self._path != "measurements":
            raise HTTPError(HTTPStatus.NOT_FOUND)
        await self._answer(lambda: self._server.viewer.put_back(self._body(NamedMeasurement)))

    async def delete(self) -> None:
        viewer = self._server.viewer
        match self._path.split("/"):
            case ["measurements", identity]:
                await self._answer(lambda: viewer.remove(identity))
            case ["jobs", number] if number.isdecimal():
                if (job := viewer.jobs.find(int(number[:9]))) is not None:
                    job.cancelled.set()
                self._finish_json({})
            case _:
                raise HTTPError(HTTPStatus.NOT_FOUND)

    def _file(self, name: str) -> None:
        """Send a file of the page."""
        path = _PAGE / name
        if path.suffix not in _TYPES or path.parent != _PAGE or not path.is_file():
            raise HTTPError(HTTPStatus.NOT_FOUND)
        self.set_header("Content-Type", f"{_TYPES[path.suffix]}; charset=utf-8")
        self.finish(path.read_bytes())

    def _text(self, name: str) -> str:
        return self.get_query_argument(name, "")[:200]

    def _number(self, name: str, default: float = 0.0) -> float:
        try:
            value = float(self.get_query_argument(name, str(default)))
        except ValueError:
            raise HTTPError(HTTPStatus.BAD_REQUEST) from None
        if not abs(value) < 1e6:
            raise HTTPError(HTTPStatus.BAD_REQUEST)
        return value

    def _photograph(self, viewer: Viewer, camera: int) -> tuple[bytes, str, str]:
        longest = min(max(int(self._number("px", 1600)), 16), _MOST_PHOTO_PX)
        half = self._number("half")
        part = (self._number("x"), self._number("y"), min(half, 1000.0)) if half >= 1 else None
        return viewer.photograph(camera, part, longest), "image/jpeg", ""

    def _picture(self, viewer: Viewer) -> tuple[bytes, str, str]:
        """Return a head as JSON with its length before it, the JPEG, and the depth in metres as float32."""
        request = self._body(requests.PictureRequest)
        view = viewer.picture(request)
        jpeg = jpeg_of(view.rgb, request.quality)
        rows, columns = view.depth.shape
        head = json.dumps({"jpeg": len(jpeg), "depth": [columns, rows], "scale": view.scale}).encode()
        head += b" " * (-len(head) % 4)
        padded = jpeg + b"\0" * (-len(jpeg) % 4)
        data = struct.pack("<I", len(head)) + head + padded + view.depth.astype("<f4").tobytes()
        return data, "application/octet-stream", ""

    @staticmethod
    def _job(viewer: Viewer, number: str) -> dict[str, Any]:
        job = viewer.jobs.find(int(number[:9]))
        if job is None:
            return {"state": "failed", "failure": "The viewer has forgotten this measurement. Measure it again."}
        return _job_json(job)

    @staticmethod
    def _profile(viewer: Viewer, number: str, form: str) -> tuple[bytes, str, str]:
        job = viewer.jobs.find(int(number[:9]))
        profile = (job.answer or {}).get("profile") if job is not None and job.state == "done" else None
        if profile is None:
            raise _BadRequestError("There is no such profile.")
        return profile_file(profile, form, viewer.model.target)

    def _read_again(self) -> dict[str, Any]:
        self._server.read_again()
        return {}


class _BadRequestError(Exception):
    """A request that no page of the viewer makes."""


def _job_json(job: ViewJob) -> dict[str, Any]:
    return {name: getattr(job, name) for name in ("number", "state", "share", "answer", "failure")}


@contextlib.contextmanager
def served(workspace: Workspace, options: ViewOptions, progress: Progress = SILENT) -> Iterator[ViewerServer]:
    """Serve the viewer of a workspace.

    Raises:
        MissingProductError: there is no trained model; names the command that makes it.
        GeorefError: a product is damaged, no port is free, the CRS cannot be used, or strangers would be answered.
    """
    server = ViewerServer(Viewer(workspace, options, progress), lambda: Viewer(workspace, options), options.port)
    try:
        if not server.refuses_strangers():
            raise GeorefError("viewer-not-private", "This installation answers requests without the page's key.")
        yield server
    finally:
        server.close()


def serve(
    workspace: Workspace,
    options: ViewOptions,
    ready: Callable[[str], None],
    ended: threading.Event,
    progress: Progress = SILENT,
) -> None:
    """Serve the viewer of a workspace until `ended` is set; errors as of `served`.

    `ready` is called with the address, its key included, when the pages can be opened.
    """
    with served(workspace, options, progress) as server:
        ready(server.address)
        while not ended.wait(_WATCH_S):
            changed = False
            with contextlib.suppress(GeorefError, OSError):  # between the old model and the new one
                changed = model_stamp(workspace) != server.viewer.stamp
            if changed and not server.changed:
                text = "The model was trained again. The page shows the old one until it is loaded anew there."
                log.warning(text, extra={"code": "model-changed"})
            server.changed = changed
