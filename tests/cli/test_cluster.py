"""Who may connect to a cluster: by default, whoever has the user's own certificate, while it is valid."""

from __future__ import annotations

import os
import socket
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from pipelines.jobs.cluster import CERTIFICATE, KEY, make_certificates, make_own_certificates
from tests.cli_runs import Georef, finish, start
from tests.clusters import greeting
from tests.photos import write_flight

NOW = datetime.now(UTC)
PLAIN = "from georef_cli.main import main; main()"


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the certificate of a user who has none yet."""
    for name in ("HOME", "XDG_CONFIG_HOME", "APPDATA"):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    return tmp_path / "home/georef/cluster"


@pytest.fixture
def port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def write_certificate(folder: Path, since: datetime, until: datetime) -> None:
    """A certificate for another time than now."""
    key, name = ec.generate_private_key(ec.SECP256R1()), x509.Name([])
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(1).not_valid_before(since).not_valid_after(until)
    folder.mkdir(parents=True, mode=0o700)
    certificate = builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    for file, data in ((CERTIFICATE, certificate), (KEY, private)):
        (folder / file).touch(0o600)
        (folder / file).write_bytes(data)


@pytest.mark.skipif(sys.platform == "win32", reason="modes of POSIX")
@pytest.mark.slow
def test_strangers_are_refused_by_default(own: Path, tmp_path: Path, port: int) -> None:
    """The scheduler makes a certificate for its user alone, which the user's commands find and a stranger lacks."""
    scheduler = start("cluster", "scheduler", "--listen", f"127.0.0.1:{port}", code=PLAIN)
    try:
        assert scheduler.stderr is not None
        assert any(f"tls://127.0.0.1:{port}" in line for line in scheduler.stderr)
        modes = {path.name: path.stat().st_mode & 0o777 for path in (own, *own.iterdir())}
        assert modes == {"cluster": 0o700, CERTIFICATE: 0o600, KEY: 0o600}
        assert greeting(port, own)
        assert greeting(port, None) == b""
        make_certificates(tmp_path / "other")
        assert greeting(port, tmp_path / "other") == b""
        write_flight(tmp_path / "photos", 4)
        (tmp_path / "missions.toml").write_text('[missions.a]\nimages = "photos"\n', "utf-8")
        address = ("--cluster", f"127.0.0.1:{port}")
        ended = finish(start("batch", tmp_path / "missions.toml", *address, "--dry-run", code=PLAIN))
        assert ended.code == 0, ended.err
        ended = finish(start("batch", tmp_path / "missions.toml", *address, "--insecure", code=PLAIN))
        assert ended.code == 1 and "tcp://" in ended.err
    finally:
        scheduler.terminate()
        scheduler.communicate(timeout=60)


CALLS = {
    "scheduler": ("cluster", "scheduler", "--listen", "127.0.0.1:1"),
    "worker": ("cluster", "worker", "127.0.0.1:1", "--gpus", "0"),
    "batch": ("batch", ".", "--cluster", "127.0.0.1:1"),
    "sfm": ("sfm", "field", "--cluster", "127.0.0.1:1"),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_each_side_names_a_certificate_of_another_time(
    own: Path, tmp_path: Path, real_georef: Georef, call: tuple[str, ...]
) -> None:
    """The user's own one, and one that is named."""
    day = timedelta(days=1)
    write_certificate(own, NOW - 3 * day, NOW - 2 * day)
    ended = real_georef(*call)
    ended.assert_failed(1, "certificate-expired")
    assert f"{CERTIFICATE}: " in ended.err and f"{NOW - 2 * day:%Y-%m-%d %H:%M} UTC" in ended.err
    assert "`georef cluster certificates`" in ended.err
    write_certificate(tmp_path / "named", NOW + 2 * day, NOW + 3 * day)
    ended = real_georef(*call, "--certificates", tmp_path / "named")
    ended.assert_failed(1, "certificate-not-yet-valid")
    for part in (f"{CERTIFICATE}: ", f"{NOW + 2 * day:%Y-%m-%d %H:%M} UTC", f"{NOW:%Y-%m-%d}", "clock"):
        assert part in ended.err


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_plain_text_is_asked_for(own: Path, real_georef: Georef, call: tuple[str, ...]) -> None:
    """By name: an address does not do it, nor does a missing certificate, which is made for nodes only."""
    ended = real_georef(*(word.replace("127.0.0.1", "tcp://127.0.0.1") for word in call))
    ended.assert_failed(2)
    assert "--insecure" in ended.err
    if call[0] != "cluster":
        ended = real_georef(*call)
        ended.assert_failed(1, "certificate-missing")
        assert CERTIFICATE in ended.err and not own.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="modes of POSIX")
def test_a_certificate_that_others_reach_is_refused(
    own: Path, real_georef: Georef, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_own_certificates(own)
    for path, mode in ((own, 0o770), (own / KEY, 0o640)):
        before = path.stat().st_mode
        path.chmod(mode)
        ended = real_georef(*CALLS["batch"])
        ended.assert_failed(1, "key-open")
        assert f"{path}: " in ended.err and "chmod -R go-rwx" in ended.err
        path.chmod(before)
    monkeypatch.setattr(os, "geteuid", lambda: own.stat().st_uid + 1)
    ended = real_georef(*CALLS["batch"])
    ended.assert_failed(1, "key-of-another-user")
    assert f"{own}: " in ended.err
