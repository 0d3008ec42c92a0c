"""Files through an object store: folders arrive as they were, twice nothing, and nothing outside."""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pipelines.core.errors import BackendUnavailableError, InputError, StorageError
from pipelines.jobs.engine import Job
from pipelines.jobs.storage import EngineExchange, Storage, arguments_in, worker_exchange
from tests.refusals import refused

NAMES = st.text("abcé .-", min_size=1, max_size=4).filter(lambda name: name.strip(". ") == name)
FOLDERS = st.dictionaries(st.lists(NAMES, min_size=1, max_size=3).map("/".join), st.binary(max_size=20), max_size=6)


@pytest.fixture(params=["memory", "file"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Storage:
    return Storage(f"memory://{uuid.uuid4().hex}" if request.param == "memory" else (tmp_path / "store").as_uri())


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def read(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@given(before=FOLDERS, after=FOLDERS)
@example(before={"a": b""}, after={"a/a": b""})
@settings(max_examples=30, deadline=None)
def test_a_folder_arrives_as_it_was(
    tmp_path_factory: pytest.TempPathFactory, before: dict[str, bytes], after: dict[str, bytes]
) -> None:
    """Also after files have changed, come and gone."""
    storage, root = Storage(f"memory://{uuid.uuid4().hex}"), tmp_path_factory.mktemp("folders")
    for number, files in enumerate((before, after)):
        source = root / str(number)
        (source / "ws").mkdir(parents=True)
        try:
            write(source / "ws", files)
        except (FileExistsError, NotADirectoryError, IsADirectoryError):  # a name for a file and for a folder
            return
        sent = storage.send(source, "ws", "worker")
    assert set(sent.files) == set(after)
    storage.fetch(root / "target", "ws")
    assert read(root / "target/ws") == after if after else not (root / "target").exists()


def test_only_what_differs_is_copied(storage: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "a/ws", {"one": b"1", "cache/x": b"-", "two.tmp": b"-", ".lock": b"", "sub/two": b"2"})
    storage.send(tmp_path / "a", "ws", "engine")
    storage.fetch(tmp_path / "b", "ws")
    assert read(tmp_path / "b/ws") == {"one": b"1", "sub/two": b"2"}
    write(tmp_path / "b/ws", {"sub/three": b"3"})
    (tmp_path / "b/ws/one").unlink()
    copied: list[str] = []
    kind = type(storage._folder_in_store("ws")[0])
    put_file = kind.put_file
    monkeypatch.setattr(
        kind,
        "put_file",
        lambda self, path, *rest, **more: copied.append(Path(path).name) or put_file(self, path, *rest, **more),
    )
    storage.send(tmp_path / "b", "ws", "worker")
    assert copied == ["three"]
    before = storage.index("ws")
    storage.fetch(tmp_path / "a", "ws", before)
    assert (tmp_path / "a/ws/sub/three").exists()


def test_newer_files_stay_and_files_that_are_gone_go(storage: Storage, tmp_path: Path) -> None:
    write(tmp_path / "a/ws", {"edited": b"old", "partial": b"x", "own": b"mine"})
    sent = storage.send(tmp_path / "a", "ws", "engine")
    storage.fetch(tmp_path / "b", "ws")
    (tmp_path / "b/ws/partial").unlink()
    write(tmp_path / "b/ws", {"product": b"y"})
    storage.send(tmp_path / "b", "ws", "worker")
    write(tmp_path / "a/ws", {"edited": b"new", "later": b"mine"})
    later = time.time_ns() + 10**9
    os.utime(tmp_path / "a/ws/edited", ns=(later, later))
    storage.fetch(tmp_path / "a", "ws", sent)
    assert read(tmp_path / "a/ws") == {"edited": b"new", "own": b"mine", "later": b"mine", "product": b"y"}


def _edit(change: Callable[[dict[str, object]], object]) -> Callable[[bytes], bytes]:
    def edit(content: bytes) -> bytes:
        document = json.loads(content)
        change(document)
        return json.dumps(document).encode()

    return edit


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (lambda _: b"{", "index-damaged"),
        (lambda _: b"[]", "index-damaged"),
        (_edit(lambda document: document.update(files={"../../escape": [1, 1]})), "index-leaves-part"),
        (_edit(lambda document: document.update(files={"/etc/passwd": [1, 1]})), "index-leaves-part"),
        (_edit(lambda document: document.update(part="other")), "index-leaves-part"),
        (_edit(lambda document: document.update(files={"a": ["x", 1]})), "index-damaged"),
        (_edit(lambda document: document.update(format_version=2)), "index-damaged"),
    ],
)
def test_a_damaged_index_is_refused(tmp_path: Path, damage: Callable[[bytes], bytes], code: str) -> None:
    storage = Storage((tmp_path / "store").as_uri())
    write(tmp_path / "a/ws", {"one": b"1"})
    storage.send(tmp_path / "a", "ws", "engine")
    (index,) = (tmp_path / "store").glob("*.json")
    index.write_bytes(damage(index.read_bytes()))
    with refused(code, InputError):
        storage.fetch(tmp_path / "b", "ws")
    assert not (tmp_path / "b").exists()


def test_links_do_not_lead_out(tmp_path: Path) -> None:
    storage = Storage((tmp_path / "store").as_uri())
    write(tmp_path / "a/ws", {"sub/one": b"1"})
    storage.send(tmp_path / "a", "ws", "engine")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "b/ws").mkdir(parents=True)
    (tmp_path / "b/ws/sub").symlink_to(tmp_path / "elsewhere")
    with refused("path-leaves-folder", InputError):
        storage.fetch(tmp_path / "b", "ws")
    assert not read(tmp_path / "elsewhere")


def test_faults_of_the_store_are_told() -> None:
    with refused("extra-missing", BackendUnavailableError) as error:
        Storage("dropbox://x").check()
    assert "dropbox" in str(error.value)
    with refused("storage-unreachable", StorageError) as error:
        Storage("nosuch://x").check()
    assert "nosuch" in str(error.value)


class TestExchange:
    """A job goes from the engine's folder to a worker's scratch folder and back."""

    @pytest.fixture
    def job(self, tmp_path: Path) -> Job:
        write(tmp_path / "base", {"photos/a.jpg": b"a", "ws/georef.toml": b"#", "private/x": b"-"})
        base = tmp_path / "base"
        return Job("job", ("run", f"{base}/ws"), 0, folder=base, writes=base / "ws", reads=(base / "photos",))

    def test_named_parts_go_and_results_come_back(self, storage: Storage, job: Job, tmp_path: Path) -> None:
        engine, scratch = EngineExchange(storage), tmp_path / "scratch"
        parcel = engine.send(job, "1")
        with worker_exchange(parcel, scratch):
            assert read(scratch) == {"photos/a.jpg": b"a", "ws/georef.toml": b"#"}
            assert arguments_in(parcel, job.arguments, scratch) == ["run", f"{scratch}/ws"]
            write(scratch, {"ws/product": b"p", "photos/thumbnail": b"t"})
        assert not scratch.exists()
        engine.collect(job)
        assert (tmp_path / "base/ws/product").read_bytes() == b"p"
        assert not (tmp_path / "base/photos/thumbnail").exists(), "the job writes nothing there"

    def test_results_of_a_killed_engine_are_collected_later(
        self, storage: Storage, job: Job, tmp_path: Path
    ) -> None:
        with worker_exchange(EngineExchange(storage).send(job, "1"), tmp_path / "scratch"):
            write(tmp_path / "scratch", {"ws/product": b"p"})
        EngineExchange(storage).send(job, "2")
        assert (tmp_path / "base/ws/product").read_bytes() == b"p"

    def test_a_lost_worker_has_put_back_its_checkpoint(
        self, storage: Storage, job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("pipelines.jobs.storage._SAVE_EVERY_S", 0.05)
        engine = EngineExchange(storage)
        with pytest.raises(RuntimeError), worker_exchange(engine.send(job, "1"), tmp_path / "scratch"):
            write(tmp_path / "scratch", {"ws/train.partial/checkpoint.npz": b"c"})
            deadline = time.monotonic() + 10
            while (index := storage.index("ws")) is None or len(index.files) < 2:
                assert time.monotonic() < deadline
                time.sleep(0.02)
            raise RuntimeError("lost: nothing more is put back")
        with worker_exchange(engine.send(job, "2"), tmp_path / "other"):
            assert (tmp_path / "other/ws/train.partial/checkpoint.npz").read_bytes() == b"c"

    def test_a_worker_that_was_given_up_changes_nothing(self, storage: Storage, job: Job, tmp_path: Path) -> None:
        """It was cut off, and another worker has begun; then it comes back with what it has."""
        engine = EngineExchange(storage)
        with (
            refused("attempt-superseded", StorageError),
            worker_exchange(engine.send(job, "1"), tmp_path / "cut off"),
        ):
            write(tmp_path / "cut off", {"ws/product": b"old"})
            with worker_exchange(engine.send(job, "2"), tmp_path / "other"):
                write(tmp_path / "other", {"ws/product": b"new"})
        engine.collect(job)
        assert (tmp_path / "base/ws/product").read_bytes() == b"new"

    def test_what_lies_outside_is_refused(self, storage: Storage, tmp_path: Path) -> None:
        job = Job("job", (), 0, folder=tmp_path / "base", writes=tmp_path / "base/ws", reads=(tmp_path / "photos",))
        with refused("path-leaves-folder", InputError):
            EngineExchange(storage).send(job, "1")
        with refused("storage-not-supported", InputError) as error:
            EngineExchange(storage).send(Job("job", (), 0), "1")
        assert error.value.field == "--storage"
