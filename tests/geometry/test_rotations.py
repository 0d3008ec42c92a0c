"""Derivatives of rotations against differences, and photogrammetric angles against their definition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.geometry.rotations import (
    exp_so3,
    geo_from_cam,
    log_so3,
    omega_phi_kappa_deg,
    omega_phi_kappa_jacobian,
    right_jacobian_inverse_so3,
    yaw_pitch_roll_deg,
)
from tests.oracles import map_from_cam


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-3, 0.3, 2.0, 3.0])
def test_right_jacobian_is_the_derivative_of_the_logarithm(angle: float) -> None:
    axis = np.array([0.48, -0.6, 0.64])
    step, base = 1e-6, exp_so3(angle * axis)
    numeric = np.stack(
        [(log_so3(base @ exp_so3(d)) - log_so3(base @ exp_so3(-d))) / (2 * step) for d in step * np.eye(3)], axis=1
    )
    # Central differences of 1e-6 are good to 1e-10 of the curvature, which grows towards π.
    np.testing.assert_allclose(right_jacobian_inverse_so3(angle * axis), numeric, atol=1e-7)


def test_right_jacobian_is_batched_and_even_where_the_series_takes_over() -> None:
    vectors = np.array([[9.9e-5, 0, 0], [1.01e-4, 0, 0], [0, 0, 0]])
    first, second, zero = right_jacobian_inverse_so3(vectors)
    np.testing.assert_allclose(first, second, atol=2e-6)
    np.testing.assert_array_equal(zero, np.eye(3))


def test_level_camera_with_north_up_has_zero_angles() -> None:
    looking_down_north_up = geo_from_cam([0.0, -90.0, 0.0])
    np.testing.assert_allclose(omega_phi_kappa_deg(looking_down_north_up), 0.0, atol=1e-12)
    # Heading east, the upper edge faces east: the image has turned clockwise, which is negative about the up axis.
    np.testing.assert_allclose(omega_phi_kappa_deg(geo_from_cam([90.0, -90.0, 0.0])), [0, 0, -90], atol=1e-12)
    # Level and facing north, the camera has tipped up about the east axis.
    np.testing.assert_allclose(omega_phi_kappa_deg(geo_from_cam([0.0, 0.0, 0.0])), [90, 0, 0], atol=1e-12)
    # Facing east from looking down, with the upper edge still north, turns about the north axis.
    facing_east = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    assert yaw_pitch_roll_deg(facing_east) == pytest.approx([90.0, 0.0, 0.0])
    assert abs(omega_phi_kappa_deg(facing_east)[1]) == pytest.approx(90.0)


def test_angles_are_those_of_the_plain_product_of_three_turns() -> None:
    omega, phi, kappa = np.radians([12.0, -7.0, 130.0])
    about_x = np.array([[1, 0, 0], [0, np.cos(omega), -np.sin(omega)], [0, np.sin(omega), np.cos(omega)]])
    about_y = np.array([[np.cos(phi), 0, np.sin(phi)], [0, 1, 0], [-np.sin(phi), 0, np.cos(phi)]])
    about_z = np.array([[np.cos(kappa), -np.sin(kappa), 0], [np.sin(kappa), np.cos(kappa), 0], [0, 0, 1]])
    expected = about_x @ about_y @ about_z @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(map_from_cam([12.0, -7.0, 130.0]), expected, atol=1e-15)


@given(st.floats(-180, 180), st.floats(-180, 180), st.floats(-180, 180))
def test_angles_return_the_rotation_wherever_the_camera_looks(yaw: float, pitch: float, roll: float) -> None:
    rotation = geo_from_cam([yaw, pitch, roll])
    angles = omega_phi_kappa_deg(rotation)
    # Near φ = ±90° ω and κ share an axis, and an arc sine keeps half of the digits.
    np.testing.assert_allclose(map_from_cam(angles), rotation, atol=1e-7)
    assert abs(angles[1]) <= 90 + 1e-9


@given(st.floats(-179, 179), st.floats(-89, 89), st.floats(-179, 179))
def test_angles_near_and_far_from_nadir_come_back(omega: float, phi: float, kappa: float) -> None:
    # At φ = 89° the other two are determined 57 times less well than the rotation.
    np.testing.assert_allclose(
        omega_phi_kappa_deg(map_from_cam([omega, phi, kappa])), [omega, phi, kappa], atol=1e-9
    )


@pytest.mark.parametrize("angles", [[1.0, -2.0, 40.0], [-62.0, 15.0, -170.0], [5.0, 85.0, 10.0]])
def test_derivative_of_the_angles_is_that_of_differences(angles: list[float]) -> None:
    rotation, step = map_from_cam(angles), 1e-6
    numeric = np.stack(
        [
            (omega_phi_kappa_deg(exp_so3(d) @ rotation) - omega_phi_kappa_deg(exp_so3(-d) @ rotation))
            / np.degrees(2 * step)
            for d in step * np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(omega_phi_kappa_jacobian(angles), numeric, atol=1e-6)


def test_derivative_of_the_angles_is_not_finite_where_two_axes_meet() -> None:
    jacobian = omega_phi_kappa_jacobian([[0.0, 0.0, 0.0], [0.0, 90.0, 0.0]])
    np.testing.assert_allclose(jacobian[0], np.eye(3), atol=1e-15)
    assert np.isnan(jacobian[1]).all()
