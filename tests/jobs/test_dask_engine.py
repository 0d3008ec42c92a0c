"""The engine of a cluster: a real scheduler and two workers, with jobs that are quick or wait for the test."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from distributed import LocalCluster, Security

from pipelines.core import child
from pipelines.core.errors import ClusterError, InputError
from pipelines.core.progress import SILENT, ProgressTask
from pipelines.jobs import cluster as cluster_access
from pipelines.jobs.cluster import ClusterAddress, Worker, make_certificates, worker_for
from pipelines.jobs.dask_engine import DaskEngine
from pipelines.jobs.engine import Job, JobEnd
from tests.clusters import PATIENCE_S, RunningCluster, greeting, running_cluster
from tests.refusals import refused

PROGRAM = "import sys; exec(sys.argv[1])"
GIB = 1 << 30
MESSAGES = """
import json, os, pathlib, sys, time
def send(kind, **content): print(json.dumps({"kind": kind, **content}), file=sys.stderr, flush=True)
def advance(steps, note): send("advance", steps=steps, note=note, left_s=None)
send("begin", name="stages", total=2)
advance(0, "train")
"""
# Counts to 60 in a file, as a training goes from checkpoint to checkpoint; tells every step it takes.
COUNTING = """
import signal
path, steps, pid = [pathlib.Path(sys.argv[2]) / name for name in ("count", "steps", "pid")]
signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
count = int(path.read_text()) if path.exists() else 0
pid.write_text(str(os.getppid()))
while count < 60:
    time.sleep(0.03)
    with steps.open("a") as handle: handle.write(f"{count}\\n")
    count += 1
    draft = path.with_suffix(f".{os.getpid()}")
    draft.write_text(str(count))
    draft.replace(path)
    advance(0, str(count))
"""


@pytest.fixture(scope="module")
def threads(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ClusterAddress]:
    """A cluster in threads of this process, with a certificate: it starts at once, and cannot be killed."""
    folder = tmp_path_factory.mktemp("certificates")
    make_certificates(folder)
    certificate, key = str(folder / "cluster.pem"), str(folder / "cluster.key")
    roles = {
        f"tls_{role}_{part}": path
        for role in ("scheduler", "worker", "client")
        for part, path in (("cert", certificate), ("key", key))
    }
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=False,
        protocol="tls",
        security=Security(tls_ca_file=certificate, require_encryption=True, **roles),
        dashboard_address=None,
        resources={"MEMORY": 4 * GIB, "CORES": 1},
    ) as running:
        yield ClusterAddress(running.scheduler_address, folder)


@pytest.fixture
def cluster(threads: ClusterAddress, monkeypatch: pytest.MonkeyPatch) -> ClusterAddress:
    """The same with jobs of these tests."""
    monkeypatch.setattr(child, "THIS_PROGRAM", ("-c", PROGRAM))
    return threads


@pytest.fixture(scope="module")
def real_cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCluster]:
    with running_cluster(tmp_path_factory.mktemp("cluster"), PROGRAM) as running:
        yield running


def job(name: str, code: str = "", *arguments: str, gib: float = 0.0, folder: Path | None = None) -> Job:
    return Job(name, (MESSAGES + code, *arguments), int(gib * GIB), folder=folder)


def ends_of(cluster: ClusterAddress, *jobs: Job) -> dict[str, JobEnd]:
    ends: list[JobEnd] = []
    DaskEngine(cluster).run("jobs", jobs, ends.append, SILENT)
    assert len(ends) == len(jobs)
    return {end.job.name: end for end in ends}


def wait_for(path: Path) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while not path.exists() or not path.read_text():
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return path.read_text()


class TestCluster:
    def test_each_end_is_told_and_none_stops_another(
        self, cluster: ClusterAddress, caplog: pytest.LogCaptureFixture, tmp_path: Path
    ) -> None:
        """Bad input fails once; a crash may belong to the machine, and is tried on the other one, then again."""
        tries = "open(sys.argv[2], 'a').write('x');"
        failing = "print('error: No such file.', file=sys.stderr); sys.exit(1)"
        ends = ends_of(
            cluster,
            job("crash", tries + "import signal; os.kill(os.getpid(), signal.SIGABRT)", f"{tmp_path}/crash"),
            job("input", tries + "send('error', error_kind='input');" + failing, f"{tmp_path}/input"),
            job("larger than any worker", gib=99.0),
            job("done", "send('log', name='x', level=30, text='look out'); advance(1, ''); send('end')"),
        )
        assert {name: (end.code, end.step) for name, end in ends.items()} == {
            "crash": (-signal.SIGABRT, "train"),
            "input": (1, "train"),
            "larger than any worker": (0, "train"),
            "done": (0, "train"),
        }
        assert ends["input"].error == "No such file." and (tmp_path / "input").read_text() == "x"
        assert ends["crash"].error.startswith("failed 3 times") and (tmp_path / "crash").read_text() == "xxx"
        assert "SIGABRT" in ends["crash"].error
        assert "done: look out" in caplog.text

    def test_progress_travels(self, cluster: ClusterAddress) -> None:
        seen: list[tuple[str, int | None, int, str]] = []

        class Recorder:
            @contextmanager
            def task(self, name: str, total: int | None = None) -> Iterator[ProgressTask]:
                class Task:
                    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
                        seen.append((name, total, steps, note))

                yield Task()

        many = "[advance(1, f'{n} dB') for n in range(5000)]; send('end')"
        DaskEngine(cluster).run("jobs", [job("a", many)], lambda end: None, Recorder())
        assert sum(steps for name, total, steps, _ in seen if (name, total) == ("a", 2)) == 5000
        assert len(seen) < 500, "steps that follow each other travel together"
        assert ("jobs", 1, 1, "") in seen

    def test_a_busy_folder_is_waited_for(
        self, cluster: ClusterAddress, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """Four times busy: more often than a failure is forgiven."""
        monkeypatch.setattr("pipelines.jobs.dask_engine._BUSY_PAUSE_S", 0.05)
        busy = "open(sys.argv[2], 'a').write('x')\n"
        busy += "if len(open(sys.argv[2]).read()) < 5: send('error', error_kind='busy'); sys.exit(1)"
        assert ends_of(cluster, job("busy", busy, str(tmp_path / "tries")))["busy"].is_done
        assert (tmp_path / "tries").read_text() == "xxxxx"

    def test_ctrl_c_stops_the_jobs(self, cluster: ClusterAddress, tmp_path: Path) -> None:
        def interrupt() -> None:
            wait_for(tmp_path / "count")
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=interrupt).start()
        ends: list[JobEnd] = []
        jobs = [job("count", COUNTING, str(tmp_path)), *(job(f"{n}", "time.sleep(9)") for n in range(3))]
        with pytest.raises(KeyboardInterrupt):
            DaskEngine(cluster).run("jobs", jobs, ends.append, SILENT)
        assert [end.job.name for end in ends if end.is_interrupted and end.job.name == "count"] == ["count"]
        assert len(ends) == 2, "two workers: two of the four had begun"
        assert int((tmp_path / "count").read_text()) < 60

    def test_commands_share_the_workers(
        self, cluster: ClusterAddress, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """A job that waits behind those of another command has not begun, and does not hold up Ctrl-C."""
        monkeypatch.setattr("pipelines.jobs.dask_engine._START_PATIENCE_S", 0.3)
        waiting = "pathlib.Path(sys.argv[2], str(os.getpid())).touch()\n"
        waiting += "while not pathlib.Path(sys.argv[2], 'go').exists(): time.sleep(0.02)"
        others: list[JobEnd] = []
        jobs = [job(name, waiting, str(tmp_path)) for name in ("a", "b")]
        other = threading.Thread(target=DaskEngine(cluster).run, args=("jobs", jobs, others.append, SILENT))
        other.start()
        deadline = time.monotonic() + PATIENCE_S
        while len(list(tmp_path.iterdir())) < 2:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()
        ends: list[JobEnd] = []
        with pytest.raises(KeyboardInterrupt):
            DaskEngine(cluster).run("jobs", [job("mine", "pass")], ends.append, SILENT)
        assert [end.is_interrupted for end in ends] == [True]
        (tmp_path / "go").touch()
        other.join()
        assert [end.is_done for end in others] == [True, True]

    def test_a_worker_that_does_not_share_the_folder_gets_no_jobs(
        self, cluster: ClusterAddress, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """Lest it makes a workspace on its own disk, which nobody finds."""
        monkeypatch.setattr("pathlib.Path.touch", lambda path: None)  # the token is on another disk
        with refused("no-worker", ClusterError) as error:
            ends_of(cluster, job("a", folder=tmp_path))
        assert str(tmp_path) in str(error.value)

    def test_a_stranger_is_refused(
        self, cluster: ClusterAddress, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """By the engine, which knows its scheduler by the certificate."""
        monkeypatch.setattr(cluster_access, "_CONNECT_S", 1.0)
        make_certificates(tmp_path)
        for stranger in (
            ClusterAddress(cluster.url, tmp_path),
            ClusterAddress(cluster.url.replace("tls", "tcp")),
        ):
            with refused("no-scheduler", ClusterError):
                DaskEngine(stranger).together([])

    def test_the_scheduler_hears_its_own_only(self, cluster: ClusterAddress, tmp_path: Path) -> None:
        """One who accepts every scheduler hears nothing from it, with another certificate or with none."""
        assert cluster.certificates is not None
        make_certificates(tmp_path)
        assert greeting(cluster.port, cluster.certificates)
        assert greeting(cluster.port, tmp_path) == b""
        assert greeting(cluster.port, None) == b""


@pytest.mark.slow
class TestKills:
    def test_a_killed_worker_loses_one_step(self, real_cluster: RunningCluster, tmp_path: Path) -> None:
        """The process is told by its broken pipe; another worker goes on from the file."""

        def kill() -> None:
            wait_for(tmp_path / "count")
            os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        ends = ends_of(real_cluster.address, job("count", COUNTING, str(tmp_path), folder=tmp_path))
        killer.join()
        assert ends["count"].is_done
        steps = [int(line) for line in (tmp_path / "steps").read_text().split()]
        assert sorted(set(steps)) == list(range(60))
        assert len(steps) <= 60 + 3  # the step of the kill, and those until the process met its broken pipe
        assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []

    def test_a_job_that_kills_its_workers_is_named(self, real_cluster: RunningCluster) -> None:
        """Three workers die of it; the other job finishes."""
        real_cluster.wait_for_workers(2)
        ends = ends_of(
            real_cluster.address,
            job("killer", "import signal; os.kill(os.getppid(), signal.SIGKILL)"),
            job("other"),
        )
        assert ends["other"].is_done
        assert ends["killer"].error.startswith("failed 3 times") and "worker was lost" in ends["killer"].error
        real_cluster.wait_for_workers(2)


@pytest.mark.parametrize(
    ("address", "has_certificate", "fault"),
    [
        ("tcp://10.0.0.7:8786", False, "needs --certificates"),
        ("head", False, "needs --certificates"),
        ("tls://127.0.0.1", False, "needs --certificates"),
        ("tcp://head:8786", True, "is not encrypted"),
        ("ucx://head", True, "is not an address"),
        ("tls://", True, "is not an address"),
        ("tls://head:port", True, "port"),
        ("localhost:1234", False, None),
        ("[::1]:8786", False, None),
        ("head", True, None),
    ],
)
def test_nothing_goes_unencrypted_to_another_machine(
    tmp_path: Path, address: str, has_certificate: bool, fault: str | None
) -> None:
    if has_certificate:
        make_certificates(tmp_path)
    folder = tmp_path if has_certificate else None
    if fault is None:
        assert ClusterAddress(address, folder).url.startswith("tls" if has_certificate else "tcp")
    else:
        with pytest.raises(ValueError, match=fault):
            ClusterAddress(address, folder)


def test_the_key_is_for_its_owner(tmp_path: Path) -> None:
    make_certificates(tmp_path)
    if os.name == "posix":
        assert (tmp_path / "cluster.key").stat().st_mode & 0o077 == 0
        (tmp_path / "cluster.key").chmod(0o644)
        with refused("key-open", InputError) as error:
            ClusterAddress("tls://head", tmp_path)
        assert error.value.path == tmp_path / "cluster.key"
    (tmp_path / "cluster.pem").unlink()
    with refused("certificate-missing", InputError) as error:
        ClusterAddress("tls://head", tmp_path)
    assert "cluster.pem" in error.value.message


class TestPlaces:
    SMALL = Worker("a", "a", 2, 8 * GIB, 0)
    LARGE = Worker("b", "b", 4, 32 * GIB, 1)

    def place(self, new: Job, running: dict[str, list[Job]], avoided: set[str] | None = None) -> str | None:
        workers = {worker.address: worker for worker in (self.SMALL, self.LARGE)}
        found = worker_for(new, workers, running, avoided or set())
        return None if found is None else found.address

    def test_memory_gpu_and_slots_are_kept(self) -> None:
        gpu = Job("gpu", (), 0, uses_gpu=True)
        assert self.place(job("x", gib=9), {}) == "b"
        assert self.place(job("x", gib=9), {"b": [job("y", gib=24)]}) is None
        assert self.place(job("x", gib=99), {}) == "b", "alone on the largest"
        assert self.place(job("x", gib=99), {"b": [job("y", gib=1)]}) is None
        assert self.place(gpu, {}) == "b" and self.place(gpu, {"b": [gpu]}) is None
        assert self.place(job("x"), {"a": [job("y")] * 2, "b": [job("z")] * 4}) is None

    def test_the_least_busy_and_not_where_it_failed(self) -> None:
        assert self.place(job("x"), {"a": [job("y")]}) == "b"
        assert self.place(job("x"), {"b": [job("y")]}, {"a"}) == "b"
        assert self.place(job("x"), {"b": [job("y")]}, {"a", "b"}) == "a"
