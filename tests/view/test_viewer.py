"""The viewer as a command: what is missing is said, a changed model is noticed, and it ends when told to."""

from __future__ import annotations

import os
import re
import threading
import time
from pathlib import Path

import pytest

from georef_cli.main import main
from pipelines.core.errors import MissingProductError
from pipelines.core.stages import GAUSSIANS
from pipelines.core.workspace import Workspace
from pipelines.view import viewer
from pipelines.view.options import ViewOptions
from pipelines.view.viewer import serve

pytestmark = pytest.mark.usefixtures("one_thread")


def test_without_a_model_the_command_that_makes_it_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingProductError, match="georef train"):
        serve(Workspace(tmp_path), ViewOptions(), print, threading.Event())


def test_what_is_printed_and_opened_is_the_address_with_its_key(
    viewed: Workspace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    address, opened = "http://127.0.0.1:8080/key/", []
    monkeypatch.setattr(viewer, "serve", lambda _workspace, _options, ready, *_: ready(address))
    monkeypatch.setattr("webbrowser.open", opened.append)
    with pytest.raises(SystemExit) as ended:
        main(["view", str(viewed.root), "--open"])
    assert (ended.value.code, opened) == (0, [address])
    assert capsys.readouterr().out.startswith(address + " ")


def test_a_changed_model_is_noticed(
    viewed: Workspace, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(viewer, "_WATCH_S", 0.05)
    addresses: list[str] = []
    ready, ended = threading.Event(), threading.Event()

    def opened(address: str) -> None:
        addresses.append(address)
        ready.set()

    thread = threading.Thread(target=serve, args=(viewed, ViewOptions(port=8750), opened, ended))
    thread.start()
    try:
        assert ready.wait(60)
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{22}/", addresses[0])
        time.sleep(0.3)
        assert "has changed" not in caplog.text
        os.utime(viewed.path(GAUSSIANS))
        end = time.monotonic() + 20
        while not any(getattr(record, "code", "") == "model-changed" for record in caplog.records):
            assert time.monotonic() < end
            time.sleep(0.05)
    finally:
        ended.set()
        thread.join(30)
    assert not thread.is_alive()
