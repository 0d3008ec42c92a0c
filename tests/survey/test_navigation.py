"""A survey made anew from the recorded navigation: exact where that is exact, nothing invented where it is not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.products import load_json, save_json, save_npz
from pipelines.core.stages import RIG, SURVEY, TRACK
from pipelines.core.workspace import Workspace
from pipelines.geometry.rotations import exp_so3, log_so3, matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.survey.navigation import (
    NavigationTrack,
    RigCalibration,
    RigEstimate,
    apply_calibration,
    load_survey,
    shown_by,
)
from pipelines.survey.survey import Attitude, RigParameter, Survey, SurveyImage
from tests.refusals import refused
from tests.scenes import Measured, Noise, make_scene, survey_of

pytestmark = pytest.mark.usefixtures("one_thread")

COUNT, SPEED = 5, np.array([4.0, 1.0, 0.5])
ARM, MOUNT = np.array([0.3, -0.1, -0.2]), exp_so3([0.4, -0.3, 0.9])


def bodies(time_s: np.ndarray) -> np.ndarray:
    return exp_so3(np.outer(time_s, [0.02, 0.05, -0.2]))  # about one axis: exact on the shortest arc


def cameras(time_s: np.ndarray) -> np.ndarray:
    return np.outer(time_s, SPEED)


@pytest.fixture
def track() -> NavigationTrack:
    """Navigation from 0 to 5 s, and images at 0 … 4 s of a clock that is 0.5 s behind it."""
    clock = np.linspace(0, 5, 51)
    fine = np.linspace(0, 5, 2001)
    return NavigationTrack(
        position_time_s=fine,
        antenna_in_geo=cameras(fine) + bodies(fine) @ ARM,
        sigma_m=np.full((2001, 3), 0.02),
        attitude_time_s=clock,
        geo_from_body=bodies(clock),
        image=np.array([f"{i}.jpg" for i in range(COUNT)]),
        image_time_s=np.arange(COUNT, dtype=np.float64),
        cam_from_body=np.tile(MOUNT, (COUNT, 1, 1)),
        antenna_in_body=np.tile(ARM, (COUNT, 1)),
        nominal_from_cam=np.eye(3),
        time_offset_s=np.array(0.0),
        max_gap_s=np.array(1.0),
        body_known=np.array(True),
    )


@pytest.fixture
def survey() -> Survey:
    """Images 0 … 4 with whatever positions and attitudes, the last without; one that the navigation lacks."""
    made = survey_of(make_scene(images=COUNT + 1), Noise(), Measured(), np.random.default_rng(0))
    images = [image.model_copy(update={"name": f"{i}.jpg"}) for i, image in enumerate(made.images)]
    images[4] = SurveyImage(name="4.jpg", camera_id=1, sha256="0" * 64)
    return made.model_copy(update={"images": tuple(images)})


def estimate(name: RigParameter, value: np.ndarray, start: np.ndarray) -> RigEstimate:
    unit = {"time-offset": "s", "boresight": "deg", "lever-arm": "m"}[name]
    values, starts = tuple(value.tolist()), tuple(start.tolist())
    return RigEstimate(
        name=name,
        unit=unit,
        value=values,
        sigma=(0.0,) * len(values),
        start=starts,
        observable=(True,) * len(values),
    )


def of(*estimates: RigEstimate) -> RigCalibration:
    return RigCalibration(wanted=tuple(estimate.name for estimate in estimates), applied=estimates)


def places(survey: Survey) -> np.ndarray:
    return np.array([image.fix.position_in_geo if image.fix else [np.nan] * 3 for image in survey.images])


def test_offset_boresight_and_arm_are_applied(survey: Survey, track: NavigationTrack) -> None:
    track = replace(track, antenna_in_body=np.full((COUNT, 3), np.nan))
    turned_deg = np.array([0.5, -1.0, 0.3])
    rig = of(
        estimate("time-offset", np.array([0.5]), np.zeros(1)),
        estimate("boresight", turned_deg, np.zeros(3)),
        estimate("lever-arm", ARM, np.zeros(3)),
    )
    calibrated = apply_calibration(survey, track, rig)
    at = track.image_time_s + 0.5
    np.testing.assert_allclose(places(calibrated)[:COUNT], cameras(at), atol=1e-5)
    quats = [image.attitude.quat_xyzw for image in calibrated.images[:COUNT] if image.attitude]
    expected = bodies(at) @ MOUNT.T @ exp_so3(np.radians(turned_deg))
    assert np.abs(log_so3(matrix_from_quat_xyzw(quats) @ np.swapaxes(expected, 1, 2))).max() < 1e-9
    # What the navigation does not know stays; what it now knows takes σ from the nearest.
    assert calibrated.images[5] == survey.images[5]
    assert calibrated.images[4].fix is not None and survey.images[3].fix is not None
    assert calibrated.images[4].fix.cov_in_geo == survey.images[3].fix.cov_in_geo


def test_what_is_not_applied_stays_as_told(survey: Survey, track: NavigationTrack) -> None:
    withheld = (
        estimate("time-offset", np.array([0.5]), np.zeros(1)),
        estimate("boresight", np.array([9.0, 9.0, 9.0]), np.zeros(3)),
    )
    calibrated = apply_calibration(survey, track, RigCalibration(not_applied=withheld))
    np.testing.assert_allclose(places(calibrated)[:COUNT], cameras(track.image_time_s), atol=1e-5)


def test_nothing_is_invented_beyond_the_ends_or_without_attitude(survey: Survey, track: NavigationTrack) -> None:
    calibrated = apply_calibration(survey, track, of(estimate("time-offset", np.array([2.5]), np.zeros(1))))
    assert [image.fix is None for image in calibrated.images] == [False, False, False, True, True, False]
    gap = (track.attitude_time_s < 0.9) | (track.attitude_time_s > 2.9)
    torn = replace(track, attitude_time_s=track.attitude_time_s[gap], geo_from_body=track.geo_from_body[gap])
    calibrated = apply_calibration(survey, torn, of(estimate("time-offset", np.array([0.0]), np.zeros(1))))
    # Without attitude the arm could point anywhere: no position either.
    assert [image.fix is None for image in calibrated.images] == [False, True, True, False, False, False]
    assert [image.attitude is None for image in calibrated.images] == [False, True, True, False, False, False]


def test_attitudes_that_came_with_the_photographs_carry_the_arm(survey: Survey, track: NavigationTrack) -> None:
    turns = bodies(track.image_time_s) @ MOUNT.T
    images = list(survey.images)
    for i, quat in enumerate(quat_xyzw_from_matrix(turns)):
        attitude = Attitude(quat_xyzw=tuple(quat.tolist()), sigma_deg=1.0, source="gimbal")
        images[i] = images[i].model_copy(update={"attitude": attitude})
    survey = survey.model_copy(update={"images": tuple(images)})
    bare = replace(track, attitude_time_s=np.empty(0), geo_from_body=np.empty((0, 3, 3)))
    calibrated = apply_calibration(survey, bare, of(estimate("time-offset", np.array([0.0]), np.zeros(1))))
    np.testing.assert_allclose(places(calibrated)[:COUNT], cameras(track.image_time_s), atol=1e-5)
    assert [image.attitude for image in calibrated.images] == [image.attitude for image in survey.images]


class TestLoadSurvey:
    """The one function that reads a survey for the stages after `calibrate`."""

    OFFSET = of(estimate("time-offset", np.array([0.5]), np.zeros(1)))

    @pytest.fixture
    def workspace(self, tmp_path: Path, survey: Survey, track: NavigationTrack) -> Workspace:
        save_json(survey, tmp_path / SURVEY)
        save_npz(tmp_path / TRACK, vars(track))
        return Workspace(tmp_path)

    def test_applies_what_calibrate_applied(
        self, workspace: Workspace, survey: Survey, track: NavigationTrack
    ) -> None:
        save_json(self.OFFSET, workspace.root / RIG)
        applied = load_survey(workspace)
        assert applied == apply_calibration(survey, track, self.OFFSET)
        assert applied.images != survey.images
        assert load_json(Survey, workspace.root / SURVEY) == survey

    def test_is_the_survey_as_recorded_where_nothing_is_applied(
        self, workspace: Workspace, survey: Survey, caplog: pytest.LogCaptureFixture
    ) -> None:
        assert load_survey(workspace) == survey
        assert caplog.text == ""
        (workspace.root / TRACK).unlink()
        withheld = RigCalibration(not_applied=(estimate("boresight", np.ones(3), np.zeros(3)),))
        save_json(withheld, workspace.root / RIG)
        assert load_survey(workspace) == survey

    def test_reminds_of_a_calibration_that_was_asked_for(
        self, workspace: Workspace, survey: Survey, caplog: pytest.LogCaptureFixture
    ) -> None:
        save_json(survey.model_copy(update={"estimate": ("time-offset",)}), workspace.root / SURVEY)
        load_survey(workspace)
        assert "time-offset" in caplog.text and "`georef calibrate`" in caplog.text

    def test_needs_the_navigation_for_a_calibration(self, workspace: Workspace) -> None:
        (workspace.root / TRACK).unlink()
        save_json(self.OFFSET, workspace.root / RIG)
        with refused("navigation-not-recorded", InputError) as error:
            load_survey(workspace)
        assert error.value.path == workspace.root / TRACK

    @pytest.mark.parametrize(
        ("change", "field", "count"),
        [
            ({"value": []}, "applied.0", "time-offset has 1"),
            ({"name": "boresight"}, "applied.0", "boresight has 3"),
            ({"name": "focus"}, "applied.0.name", ""),
        ],
    )
    def test_refuses_a_calibration_of_another_form(
        self, workspace: Workspace, change: dict[str, object], field: str, count: str
    ) -> None:
        document = self.OFFSET.model_dump(mode="json")
        document["applied"][0].update(change)
        (workspace.root / RIG).parent.mkdir()
        (workspace.root / RIG).write_text(json.dumps(document))
        with pytest.raises(InputError) as error:
            load_survey(workspace)
        assert (error.value.path, error.value.field) == (workspace.root / RIG, field)
        assert count in error.value.message
        document = self.OFFSET.model_dump(mode="json")
        (workspace.root / RIG).write_text(json.dumps({**document, "not_applied": document["applied"]}))
        with pytest.raises(InputError, match="a parameter is estimated twice"):
            load_survey(workspace)

    def test_a_variant_reads_what_it_is_lent(self, workspace: Workspace, survey: Survey) -> None:
        save_json(self.OFFSET, workspace.root / RIG)
        lent = {folder: workspace.root / folder for folder in ("ingest", "calibrate")}
        variant = Workspace(workspace.root / "compare/A", workspace, lent, "compare")
        assert load_survey(variant) == load_survey(workspace) != survey


@pytest.mark.parametrize(
    ("change", "shown"),
    [
        ({}, ("time-offset", "boresight", "lever-arm")),
        ({"position_time_s": np.empty(0)}, ()),
        ({"attitude_time_s": np.empty(0)}, ("time-offset",)),
        ({"body_known": np.array(False)}, ("time-offset", "boresight")),
        ({"cam_from_body": np.full((COUNT, 3, 3), np.nan)}, ("time-offset", "lever-arm")),
    ],
)
def test_a_navigation_shows_what_it_has_recorded(
    track: NavigationTrack, change: dict[str, np.ndarray], shown: tuple[RigParameter, ...]
) -> None:
    assert shown_by(replace(track, **change)) == shown
    assert shown_by(None) == ()


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("sigma_m", np.zeros((9, 2))),
        ("geo_from_body", np.zeros((3, 3))),
        ("image_time_s", np.array(["now"])),
        ("max_gap_s", np.zeros(2)),
    ],
)
def test_navigation_by_hand_is_checked(tmp_path: Path, name: str, array: np.ndarray) -> None:
    shapes = {
        "position_time_s": (9,), "antenna_in_geo": (9, 3), "sigma_m": (9, 3), "attitude_time_s": (5,),
        "geo_from_body": (5, 3, 3), "image_time_s": (2,), "cam_from_body": (2, 3, 3), "antenna_in_body": (2, 3),
        "nominal_from_cam": (3, 3), "time_offset_s": (), "max_gap_s": (),
    }  # fmt: skip
    zeros = {key: np.zeros(shape) for key, shape in shapes.items()}
    track = NavigationTrack(image=np.array(["a", "b"]), body_known=np.array(True), **zeros)
    save_npz(tmp_path / "track.npz", vars(track))
    assert NavigationTrack.load(tmp_path / "track.npz").image.tolist() == ["a", "b"]
    save_npz(tmp_path / "track.npz", vars(replace(track, **{name: array})))
    with pytest.raises(InputError) as error:
        NavigationTrack.load(tmp_path / "track.npz")
    assert (error.value.path, error.value.field) == (tmp_path / "track.npz", name)
