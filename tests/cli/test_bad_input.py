"""Bad input to `georef ingest`, as a user meets it: exit code, what is said, and that nothing is lost."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from pipelines.core.products import load_json
from pipelines.core.stages import SURVEY
from pipelines.survey.survey import Survey
from tests.cli_runs import Georef, finish, products_in, start, write_files
from tests.photos import Exif, gps_entries, jpeg, write_flight

LAT, LON = 46.02, 7.75


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """A folder with `photos` of a flight: IMG_0000.JPG … IMG_0004.JPG."""
    write_flight(tmp_path / "photos", 5, lat=LAT, lon=LON)
    return tmp_path


def table(header: str, *rows: str, ends: str = "\n") -> bytes:
    return ends.join([header, *rows, ""]).encode()


def positions(*last: str, header: str = "image,latitude,longitude,altitude") -> bytes:
    """A trajectory of three good rows and those given, from line 5 on."""
    good = [f"IMG_{index:04d}.JPG,46.02,{7.75 + 1e-4 * index:.4f},120" for index in range(3)]
    return table(header, *good, *last)


def marks(*last: str, crs: str = "EPSG:4979") -> bytes:
    """A gcp_list.txt of two good rows and those given, from line 4 on."""
    return table(crs, "7.75 46.02 500 10 10 IMG_0000.JPG P1", "7.75 46.02 500 12 10 IMG_0001.JPG P1", *last)


class Case(NamedTuple):
    """Files that a user adds to the flight, options of `georef ingest`, and place and code of the refusal."""

    name: str
    files: dict[str, bytes]
    options: str
    told: str


CSV = "--trajectory {here}/t.csv"
GEO = "--geo {here}/geo.txt"
GCP = "--gcp {here}/gcp.txt"

REFUSED = (
    # positions
    Case("missing file", {}, CSV, "t.csv [--trajectory] no-such-file"),
    Case("empty table", {"t.csv": b" \n"}, CSV, "t.csv file-empty"),
    Case("header only", {"t.csv": b"image,lat,lon,alt\n"}, CSV, "t.csv no-rows"),
    Case("no header", {"t.csv": b"IMG_0000.JPG,46,7,500\n"}, CSV, "[--trajectory] header-missing"),
    Case("not text", {"t.csv": b"\xff\xfd\x00"}, CSV, "t.csv:1 not-utf8"),
    Case("half a UTF-16", {"t.csv": b"\xff\xfe\x00"}, CSV, "t.csv not-text"),
    Case("no number", {"t.csv": positions("IMG_0003.JPG,46.02,east,500")}, CSV, "t.csv:5 [longitude] not-a-number"),
    Case(
        "decimal commas between commas",
        {"t.csv": positions("IMG_0003.JPG,46,02,7,7503,500")},
        CSV,
        "t.csv:5 wrong-columns",
    ),
    Case(
        "latitude out of range",
        {"t.csv": positions("IMG_0003.JPG,96.02,7.75,500")},
        CSV,
        "t.csv:5 [latitude] value-out-of-range",
    ),
    Case(
        "path that leaves the folder",
        {"t.csv": positions("../IMG_0003.JPG,46.02,7.75,500")},
        CSV,
        "t.csv:5 [image] image-outside-folder",
    ),
    Case(
        "two rows of an image",
        {"t.csv": positions("IMG_0000.JPG,46.02,7.75,500")},
        CSV,
        "t.csv:5 [image] image-twice",
    ),
    Case(
        "none of the names",
        {"t.csv": table("image,lat,lon,alt", "DJI_1.JPG,46,7,500")},
        CSV,
        "t.csv [image] no-image-matched",
    ),
    Case(
        "x,y,z without CRS",
        {"t.csv": table("image,x,y,z", "IMG_0000.JPG,400000,5097000,500")},
        CSV,
        "t.csv crs-missing",
    ),
    Case(
        "degrees in a projected CRS",
        {"t.csv": table("image,x,y,z", "IMG_0000.JPG,7.75,46.02,500")},
        CSV + " --crs EPSG:32632",
        "t.csv:2 degrees-in-projection",
    ),
    Case("unknown CRS", {"t.csv": positions()}, CSV + " --crs EPSG:999999", "[--crs] crs-unknown"),
    Case("CRS without table", {}, "--crs EPSG:32632", "[--crs] crs-without-trajectory"),
    Case("two tables", {"t.csv": positions(), "geo.txt": b"x"}, CSV + " " + GEO, "[--geo] two-position-files"),
    Case("geo.txt without CRS", {"geo.txt": b"a.jpg 7.75 46.02 500\n"}, GEO, "geo.txt:1 crs-missing"),
    Case(
        "geo.txt cut off",
        {"geo.txt": b"EPSG:4326\nIMG_0000.JPG 7.75\n"},
        GEO,
        "geo.txt:2 wrong-columns",
    ),
    # ground points
    Case(
        "cut off mark",
        {"gcp.txt": marks("7.75 46.02 500 10")},
        GCP,
        "gcp.txt:4 wrong-columns",
    ),
    Case(
        "mark that is no number",
        {"gcp.txt": marks("7.75 46.02 500 nan 1 IMG_0002.JPG P1")},
        GCP,
        "gcp.txt:4 [px] number-missing",
    ),
    Case(
        "mark outside",
        {"gcp.txt": marks("7.75 46.02 500 99 1 IMG_0002.JPG P1")},
        GCP,
        "gcp.txt:4 [px py] mark-outside-image",
    ),
    Case(
        "mark that escapes",
        {"gcp.txt": marks("7.75 46.02 500 9 1 /etc/x.jpg P1")},
        GCP,
        "gcp.txt:4 [image] image-outside-folder",
    ),
    Case("far away", {"gcp.txt": marks().replace(b"7.75 46.02", b"46.02 7.75")}, GCP, "gcp.txt:2 point-far-away"),
    Case("unknown check point", {"gcp.txt": marks()}, GCP + " --check P9", "gcp.txt [--check] check-not-a-point"),
    Case("check without points", {}, "--check P1", "[--check] check-without-gcp"),
    # heights and numbers
    Case("unknown datum", {}, "--vertical sea", "[--vertical] vertical-datum-unknown"),
    Case("missing grid", {}, "--vertical EGM2008", "grid-not-installed"),
    Case("sigma of nothing", {}, "--sigma-h 0", "[--sigma-h] option-invalid"),
    Case("sigma that is no number", {}, "--sigma-h nan", "[--sigma-h] option-invalid"),
    Case("every image held out", {}, "--test-every 1", "[--test-every] nothing-to-train-on"),
    # options in the file
    Case("unknown table", {"ws/georef.toml": b"[traim]\n"}, "", "georef.toml [traim] unknown-stage"),
    Case(
        "unknown key",
        {"ws/georef.toml": b"[ingest]\nsigma = 1\n"},
        "",
        "georef.toml [ingest.sigma] unknown-option",
    ),
    Case(
        "bad value",
        {"ws/georef.toml": b"[ingest]\nsigma_v = -1\n"},
        "",
        "georef.toml [ingest.sigma_v] option-invalid",
    ),
    Case("no TOML", {"ws/georef.toml": b"sigma_v -1"}, "", "georef.toml toml-invalid"),
)


@pytest.mark.parametrize("case", REFUSED, ids=lambda case: case.name)
def test_refused(real_georef: Georef, flight: Path, case: Case) -> None:
    workspace = flight / "ws"
    assert real_georef("ingest", workspace, "--images", flight / "photos").code == 0
    write_files(flight, case.files)
    before = products_in(workspace)
    options = case.options.format(here=flight).split()
    result = real_georef("ingest", workspace, "--images", flight / "photos", *options, "--json")
    result.assert_failed(2 if re.match(r"error: \[--", result.err.splitlines()[-1]) else 1)
    last = result.err.splitlines()[-1]
    assert last.startswith("error: ")
    error = result.document["error"]
    place = "" if error["path"] is None else Path(error["path"]).name
    place += "" if error["line"] is None else f":{error['line']}"
    place += "" if error["field"] is None else f" [{error['field']}]"
    assert f"{place} {error['code']}".strip() == case.told
    assert place in last
    assert "Traceback" not in result.err
    assert products_in(workspace) == before


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes and devices in folders")
@pytest.mark.parametrize(
    ("options", "told"),
    [
        ("--trajectory {here}/pipe", "pipe [--trajectory]: "),
        ("--trajectory /dev/zero", "/dev/zero [--trajectory]: "),
        ("--geo {here}/pipe", "pipe [--geo]: "),
        ("--gcp {here}/pipe", "pipe [--gcp]: "),
        ("--bag {here}/pipe.bag", "pipe.bag [--bag]: "),
    ],
)
def test_pipes_and_devices_are_refused_at_once(real_georef: Georef, flight: Path, options: str, told: str) -> None:
    os.mkfifo(flight / "pipe")
    os.mkfifo(flight / "pipe.bag")
    result = real_georef(
        "ingest", flight / "ws", "--images", flight / "photos", *options.format(here=flight).split(), "--json"
    )
    result.assert_failed(1)
    assert told in result.err.splitlines()[-1]
    assert result.document["error"]["code"] == "not-a-file"


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes and devices in folders")
def test_pipe_among_the_photographs_is_left_out(real_georef: Georef, flight: Path) -> None:
    os.mkfifo(flight / "photos/Z.JPG")
    result = real_georef("ingest", flight / "ws", "--images", flight / "photos")
    assert result.code == 0, result.err
    assert "(1): Z.JPG (" in result.err and "named pipe" in result.err
    (flight / "ws/georef.toml").unlink(missing_ok=True)
    os.mkfifo(flight / "ws/georef.toml")
    assert "georef.toml: " in real_georef("status", flight / "ws").err


COUNTED = (
    Case("empty image", {"photos/E.JPG": b""}, "", "(1): E.JPG ("),
    Case("damaged image", {"photos/D.JPG": jpeg(8)[:700]}, "", "(1): D.JPG ("),
    Case("no image", {"photos/N.JPG": b"GIF89a"}, "", "(1): N.JPG ("),
    Case(
        "duplicate image",
        {"photos/A.JPG": jpeg(7), "photos/B.JPG": jpeg(7)},
        "",
        "(1): B.JPG (as A.JPG)",
    ),
    Case("mixed sizes", {"photos/L.JPG": jpeg(8, (96, 64))}, "", "(64×48, 96×64)"),
    Case("no GPS on some", {"photos/Z.JPG": jpeg(8)}, "", "EXIF (1): Z.JPG"),
    Case(
        "position out of range",
        {"photos/Z.JPG": jpeg(8, exif=Exif(gps=gps_entries(91.5, 7.75)))},
        "",
        "EXIF (1): Z.JPG",
    ),
    Case(
        "position far away",
        {"photos/Z.JPG": jpeg(8, exif=Exif(gps=gps_entries(-33.0, 151.0)))},
        "",
        "(1): Z.JPG (",
    ),
    Case(
        "name that is not here",
        {"t.csv": positions("DJI_9.JPG,46.02,7.75,500")},
        CSV,
        "(1): t.csv:5 (DJI_9.JPG)",
    ),
    Case("NaN", {"t.csv": positions("IMG_0003.JPG,nan,7.75,500")}, CSV, "t.csv:5"),
    Case("unknown column", {"t.csv": positions(header="image,lat,lon,alt,mood")}, CSV, "t.csv:1 (mood)"),
    Case("mark elsewhere", {"gcp.txt": marks("7.75 46.02 500 9 9 DJI_9.JPG P1")}, GCP, "gcp.txt:4"),
    Case("point with one mark", {"gcp.txt": marks("7.7501 46.02 500 9 9 IMG_0000.JPG P2")}, GCP, "P2"),
)


@pytest.mark.parametrize("case", COUNTED, ids=lambda case: case.name)
def test_counted(real_georef: Georef, flight: Path, case: Case) -> None:
    write_files(flight, case.files)
    result = real_georef(
        "ingest", flight / "ws", "--images", flight / "photos", *case.options.format(here=flight).split()
    )
    assert result.code == 0, result.err
    told = [line for line in result.err.splitlines() if line.startswith("warning: ingest: ") and case.told in line]
    assert len(told) == 1, result.err
    again = real_georef(
        "ingest", flight / "ws", "--images", flight / "photos", *case.options.format(here=flight).split()
    )
    assert case.told in again.out


@pytest.mark.parametrize(
    "data",
    [
        b"\xef\xbb\xbf" + positions(),
        positions().replace(b"\n", b"\r\n"),
        positions().replace(b",", b";").replace(b".02", b",02").replace(b"7.75", b"7,75"),
    ],
    ids=["byte order mark", "CRLF", "decimal commas"],
)
def test_read_as_meant(real_georef: Georef, flight: Path, data: bytes) -> None:
    """What spreadsheets do to a table changes nothing."""
    fixes = []
    for name, content in {"plain": positions(), "odd": data}.items():
        (flight / "t.csv").write_bytes(content)
        done = real_georef("ingest", flight / name, "--images", flight / "photos", "--trajectory", flight / "t.csv")
        assert done.code == 0, done.err
        fixes.append([image.fix for image in load_json(Survey, flight / name / SURVEY).images])
    assert fixes[0] == fixes[1]
    assert sum(fix is not None for fix in fixes[0]) == 3


@pytest.mark.parametrize(
    ("spoil", "code"),
    [
        (
            lambda photos: [path.unlink() for path in sorted(photos.iterdir())[2:]],
            "too-few-images",
        ),
        (shutil.rmtree, "no-such-file"),
        (
            lambda photos: [path.rename(path.with_suffix(".raw")) for path in photos.iterdir()],
            "no-images",
        ),
        (
            lambda photos: [path.write_bytes(jpeg(i)) for i, path in enumerate(sorted(photos.iterdir()))],
            "no-positions",
        ),
    ],
    ids=["two images", "no folder", "no images", "no positions at all"],
)
def test_photographs_that_make_no_survey(
    real_georef: Georef, flight: Path, spoil: Callable[[Path], object], code: str
) -> None:
    spoil(flight / "photos")
    result = real_georef("ingest", flight / "ws", "--images", flight / "photos", "--json")
    result.assert_failed(1)
    assert result.document["error"]["code"] == code


@pytest.mark.parametrize(
    "arguments",
    [
        ("ingest",),
        ("ingest", "ws", "--test-every", "often"),
        ("train", "ws", "--preset", "best"),
        ("train", "ws", "--backend", "gpu"),
        ("sfm", "ws", "--mapper", "best"),
        ("run", "ws", "--to", "trian"),
        ("splat", "ws"),
    ],
)
def test_usage(
    real_georef: Georef, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    result = real_georef(*arguments)
    result.assert_failed(2)
    assert "Usage:" in result.err
    assert not (tmp_path / "ws").exists()


def test_as_a_process(flight: Path) -> None:
    """The same through a shell: one line on stderr, nothing on stdout, nothing left behind."""
    (flight / "t.csv").write_bytes(positions("IMG_0003.JPG,96.02,7.75,500"))
    code = "from georef_cli.main import main; main()"
    arguments = ("--images", flight / "photos", "--trajectory", flight / "t.csv")
    result = finish(start("-q", "ingest", flight / "ws", *arguments, code=code))
    result.assert_failed(1)
    assert result.err == f"error: {flight}/t.csv:5 [latitude]: 96.02 is out of range -90 … 90\n"
    assert not (flight / "ws/ingest").exists()


def test_a_number_without_end_is_told_where_it_stands(tmp_path: Path, real_georef: Georef) -> None:
    """In a list of missions, where `--deliver` was blamed, and in `--set`."""
    path = tmp_path / "missions.toml"
    path.write_text(f"[missions.a]\nseed = {'9' * 5000}\n", "utf-8")
    ended = real_georef("batch", path)
    ended.assert_failed(1)
    assert "missions.toml: is not valid TOML: an integer is beyond 64 bits" in ended.err
    ended = real_georef("run", tmp_path / "ws", "--set", f"sfm.seed={'9' * 5000}")
    ended.assert_failed(2)
    assert "sfm.seed" in ended.err or "--seed" in ended.err
