"""Photographs from a video: the sharpest of each second, at the places of its subtitles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.gnss_logs import read_subtitles
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.ingest.video_frames import video_length
from pipelines.survey.survey import Survey
from tests import gopro
from tests.earth import enu_from_lla
from tests.refusals import codes, refused

RATE, SECONDS, WIDTH, HEIGHT = 10, 6, 160, 120
SHARP = (3, 7, 1, 9, 5, 0)  # frame of each second that is not blurred
LAT, LON, HEIGHT_M = 46.02, 7.75, 1700.0
STEP_DEG = 1e-4  # a second to the north


def subtitle(number: int, time_s: float, words: str) -> str:
    def clock(seconds: float) -> str:
        whole = round(1000 * seconds)
        return f"00:00:{whole // 1000:02d},{whole % 1000:03d}"

    return f'{number}\n{clock(time_s)} --> {clock(time_s + 0.1)}\n<font size="28">{words}</font>\n\n'


def positioned(time_s: float) -> str:
    return (
        f"2026-05-01 12:00:{time_s:06.3f}\n[iso: 100] [fnum: 2.8] [latitude: {LAT + STEP_DEG * time_s:.9f}] "
        f"[longitude: {LON:.6f}] [rel_alt: 50.000 abs_alt: {HEIGHT_M:.3f}]"
    )


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Six seconds of noise, blurred but for one frame a second."""
    path = tmp_path / "flight.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE, (WIDTH, HEIGHT))  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    for number in range(RATE * SECONDS):
        frame = cv2.resize(rng.integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), np.uint8), (WIDTH, HEIGHT))
        sharp = number % RATE == SHARP[number // RATE]
        writer.write(frame if sharp else cv2.GaussianBlur(frame, (0, 0), 4))
    writer.release()
    text = "".join(subtitle(k + 1, k / RATE, positioned(k / RATE)) for k in range(RATE * SECONDS))
    path.with_suffix(".SRT").write_text(text, "utf-8")
    return path


def surveyed(video: Path, out: Path, **options: Any) -> Survey:
    asked = {"video": video, "vertical": "EPSG:3855", "test_every": 0, **options}
    return survey_and_track(IngestOptions.model_validate(asked), out / "images")[0]


def test_the_sharpest_frame_of_each_second_at_its_place(video: Path, tmp_path: Path) -> None:
    survey = surveyed(video, tmp_path, vertical="ellipsoidal")
    assert [image.name for image in survey.images] == [f"flight_{k:05d}.jpg" for k in range(SECONDS)]
    lla = [[LAT + STEP_DEG * (k + sharp / RATE), LON, HEIGHT_M] for k, sharp in enumerate(SHARP)]
    fixes = [image.fix for image in survey.images]
    places = np.array([fix.position_in_geo for fix in fixes if fix is not None])
    np.testing.assert_allclose(places, enu_from_lla(np.array(lla), survey.origin), atol=0.01)
    shown = [cv2.imread(str(tmp_path / "images" / image.name), cv2.IMREAD_GRAYSCALE) for image in survey.images]
    sharpness = [cv2.Laplacian(grey, cv2.CV_64F).var() for grey in shown if grey is not None]
    assert len(sharpness) == SECONDS and min(sharpness) > 100
    assert "video-every" in codes(survey.assumptions)
    halves = surveyed(video, tmp_path / "halves", every="0.5s", vertical="ellipsoidal")
    assert len(halves.images) == 2 * SECONDS and "video-every" not in codes(halves.assumptions)


def test_what_a_video_does_not_have_is_said(video: Path, tmp_path: Path) -> None:
    with refused("geoid-not-named", InputError):
        surveyed(video, tmp_path, vertical=None)
    with refused("video-every-in-metres", InputError):
        surveyed(video, tmp_path, every="5m")
    with refused("video-and-other-source", InputError):
        surveyed(video, tmp_path, images=tmp_path)
    (folder := tmp_path / "films").mkdir()
    (folder / "a.MP4").write_bytes(video.read_bytes())
    with refused("no-images", InputError) as caught:
        survey_and_track(IngestOptions(images=folder), None)
    assert f"--video {folder / 'a.MP4'}" in str(caught.value)
    video.with_suffix(".SRT").unlink()
    with refused("no-positions", InputError):
        surveyed(video, tmp_path)
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"\0" * 1000)
    for path, code in ((broken, "not-a-video"), (tmp_path / "none.mp4", "no-video")):
        with refused(code, InputError):
            surveyed(path, tmp_path)


def test_subtitles_of_other_spellings_and_without_a_fix(tmp_path: Path) -> None:
    path = tmp_path / "a.srt"
    early = "[latitude : 46.5] [longtitude : 7.5] [rel_alt: 1.0 abs_alt: 500.5]"
    path.write_text(
        subtitle(1, 0.0, early) + subtitle(2, 1.5, early.replace("46.5", "0").replace("7.5", "0")), "utf-8"
    )
    log = read_subtitles(path)
    np.testing.assert_allclose(log.time_s, [0.0, 1.5])
    np.testing.assert_allclose(log.lon_lat_height[0], [7.5, 46.5, 500.5])
    assert np.isnan(log.lon_lat_height[1]).all()
    for words, code in (("[iso: 100]", "subtitles-without-positions"), (early.replace("46.5", "96.5"), None)):
        path.write_text(subtitle(1, 0.0, words), "utf-8")
        with pytest.raises(InputError) as caught:
            read_subtitles(path)
        assert code is None or caught.value.code == code


def test_positions_of_a_gopro(tmp_path: Path) -> None:
    path = tmp_path / "GX010001.MP4"
    written = tmp_path / "a.mp4"
    writer = cv2.VideoWriter(str(written), cv2.VideoWriter_fourcc(*"mp4v"), RATE, (WIDTH, HEIGHT))  # type: ignore[attr-defined]
    rng = np.random.default_rng(0)
    for _ in range(RATE * SECONDS):
        writer.write(cv2.resize(rng.integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), np.uint8), (WIDTH, HEIGHT)))
    writer.release()

    def recorded(heights: bytes, fix: int = 3) -> None:
        seconds = [
            gopro.Payload([gopro.Sample(LAT + STEP_DEG * (k + j / 18), LON, HEIGHT_M, fix) for j in range(18)])
            for k in range(SECONDS)
        ]
        texts = [gopro.gps5(one, clock=f"2605011200{k:02d}.000", heights=heights) for k, one in enumerate(seconds)]
        path.write_bytes(gopro.with_telemetry(written.read_bytes(), texts, [1.0] * SECONDS))

    recorded(b"")
    survey = surveyed(path, tmp_path, vertical=None)
    assert len(survey.images) == SECONDS and survey.images[0].timestamp_s is not None
    seconds = np.array([image.timestamp_s for image in survey.images])
    in_video = seconds - 1_777_636_800.0  # 2026-05-01 12:00 UTC
    lla = np.column_stack([LAT + STEP_DEG * in_video, np.full(SECONDS, LON), np.full(SECONDS, HEIGHT_M)])
    fixes = [image.fix for image in survey.images]
    places = np.array([fix.position_in_geo for fix in fixes if fix is not None])
    np.testing.assert_allclose(places, enu_from_lla(lla, survey.origin), atol=0.02)
    assert {fix.source for fix in fixes if fix is not None} == {"video telemetry"}
    assert {"default-position-sigma", "vertical-datum-assumed"} <= set(codes(survey.assumptions))
    recorded(b"MSLV")
    with refused("geoid-not-named", InputError):
        surveyed(path, tmp_path, vertical=None)
    recorded(b"", fix=2)
    with refused("file-without-positions", InputError):
        surveyed(path, tmp_path, vertical=None)


SCRIPTS = {
    "ffconcat": "ffconcat version 1.0\nfile flight.avi\n",
    "ffconcat with a comment": "# a film\nffconcat version 1.0\nfile 'flight.avi'\n",
    "playlist": "#EXTM3U\n#EXT-X-TARGETDURATION:6\n#EXTINF:6,\nflight.avi\n#EXT-X-ENDLIST\n",
    "session": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=a\nm=video 5004 RTP/AVP 96\n",
    "manifest": "<?xml version='1.0'?><MPD><Period><BaseURL>flight.avi</BaseURL></Period></MPD>",
    "script that looks like a film": "ffconcat version 1.0\n# ftyp\nfile flight.avi\n",
}


@pytest.mark.parametrize("suffix", [".MP4", ".mov", ".avi", ".mkv"])
@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_that_name_another_film(video: Path, tmp_path: Path, script: str, suffix: str) -> None:
    path = video.with_name(f"DJI_0001{suffix}")
    path.write_text(SCRIPTS[script])
    path.with_suffix(".SRT").write_bytes(video.with_suffix(".SRT").read_bytes())
    with refused("not-a-video", InputError):
        surveyed(path, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.jpg"))


def test_names_that_are_protocols_to_ffmpeg(video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file's name with a colon in the current folder is the file, and no protocol and its argument."""
    (home := tmp_path / "home").mkdir()
    named = home / "concat:flight.avi"
    named.write_bytes(video.read_bytes())
    named.with_suffix(".SRT").write_bytes(video.with_suffix(".SRT").read_bytes())
    monkeypatch.chdir(home)
    assert len(surveyed(Path(named.name), tmp_path / "out", vertical="ellipsoidal").images) == SECONDS


@pytest.mark.parametrize(("suffix", "codec"), [(".mp4", "mp4v"), (".mov", "mp4v"), (".mkv", "MJPG")])
def test_containers_of_films_are_known(tmp_path: Path, suffix: str, codec: str) -> None:
    path = tmp_path / f"film{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 10, (64, 48))  # type: ignore[attr-defined]
    for number in range(20):
        writer.write(np.random.default_rng(number).integers(0, 255, (48, 64, 3), dtype=np.uint8))
    writer.release()
    assert video_length(path) == pytest.approx(2.0, abs=0.11)
