"""Forged messages: the panel keeps working, and the log has one line a page and kind."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import pytest
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from pipelines.view.loopback import start_server, stop_server
from tests.refusals import logged_codes

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [0, -14, 12.5],
    "fov": 0.9,
    "near": 0.01,
    "far": 1000,
    "image_height": 300,
    "image_width": 400,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}
CLICK = {
    "type": "ScenePointerMessage",
    "event_type": "click",
    "ray_origin": [0, 0, 0],
    "ray_direction": [0, 0, 1],
    "screen_pos": [[0.5, 0.5]],
    "modifier": None,
}


class Panel:
    """One element of each sort that the viewer has, and what was called."""

    def __init__(self) -> None:
        self.server, address = start_server(8770, "panel")
        self.address = address.replace("http://", "ws://")
        gui = self.server.gui
        self.button = gui.add_button("Save")
        self.box = gui.add_checkbox("Cameras", True)
        self.list = gui.add_dropdown("Kind", ("point", "area"))
        self.slider = gui.add_slider("Share", 0.0, 1.0, 0.05, 0.5)
        self.text = gui.add_text("Name", "")
        self.called: list[str] = []
        self.button.on_click(lambda _: self.called.append("button"))
        self.list.on_update(lambda _: self.called.append("list"))
        gui.add_command("Next", hotkey="N").on_trigger(lambda _: self.called.append("command"))
        self.server.scene.on_click()(lambda _: self.called.append("click"))

    @property
    def values(self) -> tuple[Any, ...]:
        return (self.box.value, self.list.value, self.slider.value, self.text.value)

    def page(self) -> ClientConnection:
        return connect(self.address, subprotocols=[f"viser-v{viser.__version__}"])

    def command_id(self) -> str:
        return next(iter(self.server.gui._command_handle_from_uuid))


@pytest.fixture
def panel() -> Iterator[Panel]:
    made = Panel()
    yield made
    stop_server(made.server)


def update(element: Any, **updates: Any) -> dict[str, Any]:
    return {"type": "GuiUpdateMessage", "uuid": element._impl.uuid, "updates": updates}


def send(page: ClientConnection, *messages: Any) -> None:
    for message in messages:
        page.send(message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message))


def wait(holds: Callable[[], bool]) -> None:
    end = time.monotonic() + 10
    while not holds():
        assert time.monotonic() < end, "the panel does not answer"
        time.sleep(0.01)


def forged(panel: Panel) -> list[Any]:
    """Messages that no page sends, three kinds of them thousands of times."""
    nan, far = float("nan"), [1e12, 0, 0]
    properties = ("removed", "update_cb", "is_button", "sync_cb", "props", "uuid", "parent_container_id", "nothing")
    return [
        *(update(panel.button, **{name: True}) for name in properties),
        *(update(panel.list, value="point", update_cb=[]) for _ in range(1000)),
        *(update(panel.list, value=value) for value in ("nonsense", 3, True, None, ["point"], {"a": 1})),
        *(update(panel.slider, value=value) for value in (nan, float("inf"), -1, 1.01, "0.5", True, [0.5])),
        *(update(panel.text, value=value) for value in ("x" * 20_000, 5, b"bytes", None)),
        *(update(panel.box, value=value) for value in ("", 0.0, 1, [])),
        *(update(panel.button, value=value) for value in (False, 1, "yes")),
        *({"type": "GuiUpdateMessage", "uuid": f"unknown{n}", "updates": {"value": 1}} for n in range(2000)),
        *({"type": "CommandTriggerMessage", "uuid": f"unknown{n}"} for n in range(500)),
        *({**CAMERA, name: value} for name, value in (("fov", nan), ("position", far), ("wxyz", [0, 0, 0, 0]))),
        *({**CAMERA, name: value} for name, value in (("image_width", 10**9), ("wxyz", "abcd"), ("more", 1))),
        *({**CLICK, name: value} for name, value in (("ray_direction", [0, 0, 0]), ("ray_origin", None))),
        {**CLICK, "event_type": "rect-select", "screen_pos": []},
        {"type": "ShareUrlRequest"},
        {"type": "FileTransferStartUpload", "source_component_uuid": panel.button._impl.uuid},
        *(b"\xc1" * n for n in range(1, 1000)),
        b"\x91" * 60_000,
        b"",
        "text\r\nof \x1b[31mits own",
    ]


def test_forged_messages_change_nothing_and_leave_a_line_a_kind(
    panel: Panel, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    before = panel.values
    caplog.set_level(logging.WARNING)
    with panel.page() as page, panel.page() as person:
        send(person, CAMERA)
        send(page, CAMERA, *forged(panel), update(panel.text, value="heard"))
        wait(lambda: panel.text.value == "heard")
        assert (*panel.values[:3], "") == before
        assert panel.called == []
        # What a person does works as before, from both pages.
        for number, each in enumerate((page, person), start=1):
            send(each, update(panel.button, value=True), update(panel.list, value="area"), CLICK)
            send(
                each,
                update(panel.list, value="point"),
                {"type": "CommandTriggerMessage", "uuid": panel.command_id()},
            )
            wait(lambda: len(panel.called) == 5 * number)  # noqa: B023
        assert sorted(set(panel.called)) == ["button", "click", "command", "list"]
        send(person, update(panel.slider, value=1), update(panel.box, value=False))
        wait(lambda: panel.values[:3] == (False, "point", 1.0))
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == 4, lines  # form, element, value, direction
    assert logged_codes(caplog) == 4 * ["page-message-refused"]
    assert all(line.isprintable() for line in lines)
    assert not any(record.exc_info for record in caplog.records)
    output = capfd.readouterr()
    assert "Traceback" not in output.err and output.out == ""


def test_a_huge_message_ends_its_connection_alone(panel: Panel, caplog: pytest.LogCaptureFixture) -> None:
    with panel.page() as page, panel.page() as person:
        send(person, CAMERA)
        send(page, bytes(1 << 20))
        with pytest.raises(ConnectionClosed):
            while True:
                page.recv(timeout=10)
        send(person, update(panel.text, value="still here"))
        wait(lambda: panel.text.value == "still here")
    assert [record.getMessage().split(": ")[1][:16] for record in caplog.records] == ["more than 64 KiB"]


def test_pages_of_another_version_are_not_heard(panel: Panel, capfd: pytest.CaptureFixture[str]) -> None:
    for protocols in (["viser-v0.1"], None):
        with connect(panel.address, subprotocols=protocols) as page, pytest.raises(ConnectionClosed):
            page.recv(timeout=10)
    assert capfd.readouterr().out == ""
