"""A GoPro's telemetry: positions, times and heights as they were written, and damage of every kind refused."""

from __future__ import annotations

import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.gnss_logs import VideoPositions
from pipelines.formats.gopro_telemetry import read_telemetry
from tests import gopro

LAT, LON, HEIGHT_M = 46.02, 7.75, 1700.0


def payloads(count: int = 5, each: int = 10) -> list[gopro.Payload]:
    """Payloads of a second on a straight way, a step of 10⁻⁵ degrees to the north a position."""
    return [
        gopro.Payload(
            [
                gopro.Sample(LAT + 1e-5 * (each * k + j), LON, HEIGHT_M + k, utc=(9617, 43_200.0 + k + j / each))
                for j in range(each)
            ]
        )
        for k in range(count)
    ]


def read(path: Path, data: bytes) -> VideoPositions | None:
    path.write_bytes(data)
    return read_telemetry(path)


def test_gps5_positions_at_their_times(tmp_path: Path) -> None:
    durations = [1.0, 1.001, 0.999, 1.0, 0.5]
    texts = [gopro.gps5(one, clock=f"26050112000{k}.000") for k, one in enumerate(payloads())]
    log = read(tmp_path / "a.mp4", gopro.telemetry_alone(texts, durations))
    assert log is not None and not log.heights_above_geoid and log.receiver == "single-frequency"
    begins = np.cumsum(durations) - durations
    np.testing.assert_allclose(
        log.time_s, (begins[:, None] + np.array(durations)[:, None] * np.arange(10) / 10).ravel()
    )
    np.testing.assert_allclose(log.lon_lat_height[:, 1], LAT + 1e-5 * np.arange(50), atol=1e-7)
    np.testing.assert_allclose(log.lon_lat_height[::10, 2], HEIGHT_M + np.arange(5))
    assert log.utc_from_video_s == pytest.approx(datetime(2026, 5, 1, 12, tzinfo=UTC).timestamp(), abs=0.002)


def test_gps9_goes_before_gps5_and_every_position_has_its_own_fix(tmp_path: Path) -> None:
    two = payloads(2)
    lost = gopro.Payload([gopro.Sample(0, 0, 0, fix=0, dop=99.99), *two[0].samples[1:]])
    rough = gopro.Payload([*two[1].samples[:-1], gopro.Sample(LAT, LON, 9, dop=12.0)])
    both = [gopro.gps5(two[0]) + gopro.gps9(lost), gopro.gps9(rough)]
    log = read(tmp_path / "a.mp4", gopro.telemetry_alone(both, [1.0, 1.0]))
    assert log is not None and log.heights_above_geoid and len(log.time_s) == 20
    assert np.flatnonzero(np.isnan(log.lon_lat_height[:, 0])).tolist() == [0, 19]
    day = datetime(2000, 1, 1, tzinfo=UTC).timestamp() + 9617 * 86_400
    assert log.utc_from_video_s == pytest.approx(day + 43_200, abs=0.002)


@pytest.mark.parametrize(("heights", "named"), [(b"", True), (b"WGS8", True), (b"MSLV", False), (b"XXXX", False)])
def test_heights_count_from_what_the_file_states(tmp_path: Path, heights: bytes, named: bool) -> None:
    text = gopro.gps5(payloads(1)[0], heights=heights)
    log = read(tmp_path / "a.mp4", gopro.telemetry_alone([text], [1.0]))
    assert log is not None and log.heights_above_geoid is not named


def test_files_without_positions_are_none(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    motion = gopro.nested("DEVC", gopro.nested("STRM", gopro.triple("ACCL", b"s", 6, bytes(60))))
    for data in (
        b"",
        b"RIFF" + bytes(100),
        gopro.box("ftyp", b"mp41"),
        gopro.box("ftyp", b"mp41") + gopro.box("moov", gopro.box("mvhd", bytes(100))),
        gopro.telemetry_alone([motion], [1.0]),
        gopro.telemetry_alone([motion], [1.0]).replace(b"mhlrmeta", b"mhlrsoun"),
    ):
        assert read(path, data) is None


def test_damage_is_refused(tmp_path: Path) -> None:
    good = gopro.telemetry_alone([gopro.gps5(one) for one in payloads(4)], [1.0] * 4)

    def changed(kind: bytes, at: int, value: int) -> bytes:
        begin = good.index(kind) + 4 + at
        return good[:begin] + struct.pack(">I", value) + good[begin + 4 :]

    damaged = {
        "cut off": good[:-100],
        "index cut off": good[: good.index(b"stsz")],
        "too many sizes": changed(b"stsz", 8, 2**32 - 1),
        "uniform size": changed(b"stsz", 4, 2**31),
        "too many times": changed(b"stts", 8, 2**32 - 1),
        "no times": changed(b"stts", 4, 1),
        "runs out of order": changed(b"stsc", 8, 7),
        "too many a chunk": changed(b"stsc", 12, 2**32 - 1),
        "no time scale": changed(b"mdhd", 12, 0),
        "place outside": changed(b"stco", 8, 2**31),
        "scale of zero": good.replace(struct.pack(">5i", 10_000_000, 10_000_000, 1000, 1000, 100), bytes(20)),
        "another layout": good.replace(b"GPS5l", b"GPS5s"),
        "off Earth": good.replace(struct.pack(">i", round(LON * 1e7)), struct.pack(">i", 2_000_000_000)),
        "endless value": good.replace(b"GPS5l\x14\0\x0a", b"GPS5l\x14\xff\xff"),
    }
    for name, data in damaged.items():
        assert data != good, name
        with pytest.raises(InputError) as caught:
            read(tmp_path / "a.mp4", data)
        assert caught.value.code in ("telemetry-damaged", "value-out-of-range"), name
