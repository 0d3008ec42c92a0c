"""Sessions of fixes, which share one error, from the files of a flight to `survey.json`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.core.products import load_json
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.staleness import status
from pipelines.core.workspace import Workspace
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.geodesy.vertical import VerticalDatum, parse_vertical
from pipelines.ingest.flight_record import COMMON_SIGMA_M, RECEIVER_SIGMA_M, RECEIVERS, ImagePoses
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.stage import survey_and_track
from pipelines.ingest.survey_assembly import SESSION_GAP_S, fix_sessions
from pipelines.survey.survey import FixSession, Survey
from tests.photos import Exif, dji_xmp, gps_entries, jpeg, write_flight
from tests.refusals import codes, numbers

ELLIPSOIDAL = ("--vertical", "ellipsoidal")


def poses_of(receivers: list[str], sigma_h_m: list[float], time_s: list[float]) -> ImagePoses:
    count = len(receivers)
    return ImagePoses(
        position_in_ecef=np.tile(ecef_from_lla([46.0, 7.0, 500.0]), (count, 1)),
        sigma_enu_m=np.tile(np.array(sigma_h_m)[:, None], 3),
        sigma_source=tuple("file" for _ in receivers),
        receivers=tuple(receivers),
        enu_from_cam=np.full((count, 3, 3), np.nan),
        attitude_source=tuple("csv" for _ in receivers),
        sigma_attitude_deg=np.full(count, np.nan),
        time_s=np.array(time_s),
        source="csv",
        crs_name="EPSG:4979",
        vertical=VerticalDatum(name="ellipsoidal", stated=True),
    )


def session(kind: str) -> FixSession:
    """A session with the default σ."""
    horizontal_m, vertical_m = COMMON_SIGMA_M[kind]
    sigma_m = (horizontal_m, horizontal_m, vertical_m)
    return FixSession(receiver=kind, sigma_common_m=sigma_m, sigma_source="default")


FIXES = st.lists(
    st.tuples(
        st.sampled_from(RECEIVERS),
        st.sampled_from([0.01, 0.1, 0.5, 1.0, 3.0]),
        st.one_of(st.just(np.nan), st.integers(0, 20).map(lambda hours: 3600.0 * hours)),
    ),
    min_size=1,
    max_size=12,
)


@given(data=st.data())
def test_sessions_do_not_depend_on_the_order_of_the_photographs(data: st.DataObject) -> None:
    fixes = data.draw(FIXES)
    order = data.draw(st.permutations(range(len(fixes))))
    receivers, sigma, time = (list(column) for column in zip(*fixes, strict=True))
    sessions, of = fix_sessions(poses_of(receivers, sigma, time), IngestOptions(), Remarks())
    moved = poses_of(*([column[row] for row in order] for column in (receivers, sigma, time)))
    again, of_moved = fix_sessions(moved, IngestOptions(), Remarks())
    assert again == sessions
    assert of_moved.tolist() == of[order].tolist()
    assert set(of.tolist()) == set(range(len(sessions)))  # none is empty
    for number in range(len(sessions)):
        times = np.sort(np.array(time)[of == number])
        assert np.isnan(times).any() or (np.diff(times) <= SESSION_GAP_S).all()


def test_a_session_ends_after_four_hours_and_with_the_kind_of_receiver() -> None:
    def of(receivers: list[str], sigma: list[float], hours: list[float]) -> tuple[list[str], list[int]]:
        time_s = [3600 * hour for hour in hours]
        sessions, index = fix_sessions(poses_of(receivers, sigma, time_s), IngestOptions(), Remarks())
        return [each.receiver for each in sessions], index.tolist()

    rtk, plain = "RTK fixed", "single-frequency"
    assert of([rtk] * 4, [0.02] * 4, [9.0, 0.0, 4.9, 0.9]) == ([rtk, rtk], [1, 0, 0, 0])
    assert of([rtk] * 3, [0.02] * 3, [9.0, np.nan, 0.0]) == ([rtk], [0, 0, 0])
    assert of([plain, rtk, plain], [2.5, 0.02, 2.5], [0, 0, 0]) == ([rtk, plain], [1, 0, 1])


@pytest.mark.parametrize(
    ("receiver", "sigma_m", "kind"),
    [
        ("unknown receiver", [0.02, 0.1, 7.0], "RTK fixed"),  # the median decides for all
        ("unknown receiver", [0.02, 0.11, 7.0], "RTK float"),
        ("unknown receiver", [1.1], "unknown receiver"),
        ("single-frequency", [0.02], "RTK fixed"),  # EXIF that holds post-processed positions
        ("single-frequency", [0.5], "single-frequency"),
        ("RTK float", [0.05], "RTK float"),  # the receiver's own flag counts more
        ("RTK fixed", [0.7], "RTK fixed"),
    ],
)
def test_stated_sigma_tells_the_kind_where_no_flag_does(receiver: str, sigma_m: list[float], kind: str) -> None:
    count = len(sigma_m)
    sessions, of = fix_sessions(poses_of([receiver] * count, sigma_m, [0.0] * count), IngestOptions(), Remarks())
    assert sessions == (session(kind),)
    assert not of.any()


def test_every_kind_of_receiver_has_a_common_error() -> None:
    assert list(COMMON_SIGMA_M) == list(RECEIVER_SIGMA_M)


def test_exif_states_kinds_of_receiver(tmp_path: Path) -> None:
    for index, flag in enumerate((50, 50, 34, 16)):
        exif, xmp = Exif(gps=gps_entries(46.02, 7.75 + 1e-4 * index)), dji_xmp(RtkFlag=flag)
        (tmp_path / f"{index}.jpg").write_bytes(jpeg(index, exif=exif, xmp=xmp))
    (tmp_path / "without.jpg").write_bytes(jpeg(9))
    survey, _ = survey_and_track(IngestOptions(images=tmp_path, vertical=parse_vertical("ellipsoidal")), None)
    assert survey.sessions == (session("RTK fixed"), session("RTK float"), session("single-frequency"))
    assert [image.fix and image.fix.session for image in survey.images] == [0, 0, 1, 2, None]
    fixed = next(
        one.text
        for one in survey.assumptions
        if one.code == "default-common-sigma" and "(RTK fixed)" in one.sentence
    )
    assert numbers(fixed) == [2.0, 0.03, 0.05] and "--sigma-common-h and --sigma-common-v" in fixed


def test_stated_sigma_and_options_decide_for_a_table(tmp_path: Path) -> None:
    names = write_flight(tmp_path / "images", 4, positions=False)

    def ingested(sigma: str, **given: float) -> Survey:
        rows = "".join(f"{name},46.02,{7.75 + 1e-4 * index:.4f},120,{sigma}\n" for index, name in enumerate(names))
        (tmp_path / "t.csv").write_text("image,lat,lon,alt,sigma_e,sigma_n,sigma_u\n" + rows)
        stated = {"vertical": parse_vertical("ellipsoidal"), **given}
        options = IngestOptions(images=tmp_path / "images", trajectory=tmp_path / "t.csv", **stated)
        return survey_and_track(options, None)[0]

    assert ingested(",,").sessions == (session("unknown receiver"),)
    assert ingested("0.012,0.011,0.025").sessions == (session("RTK fixed"),)
    assert ingested("0.3,0.3,0.5").sessions == (session("RTK float"),)
    assert ingested(",,", sigma_h=0.02).sessions == (session("RTK fixed"),)
    assert ingested("0.3,0.3,0.5", sigma_h=5.0).sessions == (session("unknown receiver"),)
    one = ingested(",,", sigma_common_h=0.0)
    assert one.sessions[0].sigma_common_m == (0.0, 0.0, 4.0)
    assert one.sessions[0].sigma_source == "option"
    (default,) = (remark for remark in one.assumptions if remark.code == "default-common-sigma")
    sentence = default.sentence
    assert numbers(sentence) == [4.0, 4.0] and "(unknown receiver)" in sentence
    assert "--sigma-common-v" in default.remedy and "--sigma-common-h" not in default.remedy
    both = ingested(",,", sigma_common_h=0.2, sigma_common_v=0.4)
    assert both.sessions[0].sigma_common_m == (0.2, 0.2, 0.4)
    assert "default-common-sigma" not in codes(both.assumptions)


def test_option_reaches_the_survey_and_an_earlier_survey_is_made_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def georef(*arguments: object) -> tuple[int, str]:
        code = boundary.guarded(cli, [str(argument) for argument in arguments])
        return code, capsys.readouterr().err

    write_flight(tmp_path / "images", 4)
    workspace = Workspace(tmp_path / "ws")
    georef("ingest", workspace.root, "--images", tmp_path / "images", "--sigma-common-h", 0.7, *ELLIPSOIDAL)
    survey = load_json(Survey, workspace.root / SURVEY)
    assert survey.sessions[0].sigma_common_m == (0.7, 0.7, 3.0)
    assert survey.sessions[0].receiver == "single-frequency"

    document = json.loads((workspace.root / SURVEY).read_text()) | {"format_version": 1, "rig": None}
    del document["sessions"]
    (workspace.root / SURVEY).write_text(json.dumps(document))
    path = workspace.root / "ingest/manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["product_version"], manifest["files"]
    path.write_text(json.dumps(manifest))
    row = status(workspace, before=BY_NAME["sfm"])[0]
    assert (row.state, row.reason) == ("stale", "made by another version of georef")
    code, told = georef("sfm", workspace.root)
    assert code == 1 and "Traceback" not in told
    assert "survey.json: an earlier version of georef made this survey" in told.splitlines()[-1]
    assert georef("ingest", workspace.root)[0] == 0
    assert load_json(Survey, workspace.root / SURVEY) == survey
