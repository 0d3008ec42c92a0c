"""Headers of other programs' tables: what their columns mean, in which unit and from which zero."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.ground_points import (
    read_geo,
    read_ground_points,
    read_marks,
    read_point_list,
    read_point_table,
)
from pipelines.formats.metashape import read_cameras
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geometry.rotations import geo_from_cam, matrix_from_quat_xyzw, omega_phi_kappa_deg
from tests.refusals import refused


def write(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "header",
    [
        "image_name,gps_latitude,gps_longitude,gps_height",
        "photo,lat,lon,ele",
        "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude",
        "#name,Lat,Long,Alt",
        "filename,camera_lat_deg,camera_lon_deg,camera_alt_m",
        "Image Name,Latitude (decimal degrees),Longitude (decimal degrees),Altitude [m]",
        "label;Y/Latitude;X/Longitude;Z/Altitude",
        "imageName Latitude Longitude Height",
    ],
)
def test_positions_of_other_programs(tmp_path: Path, header: str) -> None:
    separator = next((sign for sign in ",;" if sign in header), " ")
    table = read_trajectory(
        write(tmp_path, header + "\n" + separator.join(("a.jpg", "46.5", "7.25", "800.5")) + "\n")
    )
    assert table.names == ("a.jpg",) and table.geographic is True
    np.testing.assert_array_equal(table.xyz, [[7.25, 46.5, 800.5]])


@pytest.mark.parametrize(
    ("header", "cells", "expected"),
    [
        ("image,lat,lon,alt,lat_ref,lon_ref", "46.5,7.25,800,S,W", (-7.25, -46.5, 800)),
        ("image,lat,lon,alt", "46°30'0\" S,7 deg 15' 0.00\" W,800", (-7.25, -46.5, 800)),
        ("image,lat,lon,alt", "46.5 N,7.25 W,800", (-7.25, 46.5, 800)),
        ("image,lat,lon,GPSAltitude,GPSAltitudeRef", "46.5,7.25,12.5,1", (7.25, 46.5, -12.5)),
        ("image,lat,lon,altitude,gps_altitude", "46.5,7.25,800,1", (7.25, 46.5, 800)),
        ("image,lat,lon,altitude,ellipsoidal height", "46.5,7.25,750,800", (7.25, 46.5, 800)),
    ],
)
def test_signs_and_the_height_that_counts(
    tmp_path: Path, header: str, cells: str, expected: tuple[float, float, float]
) -> None:
    table = read_trajectory(write(tmp_path, f"{header}\na.jpg,{cells}\n"))
    np.testing.assert_allclose(table.xyz, [expected], rtol=0, atol=1e-12)


def test_units_and_zeros_of_heights_are_told(tmp_path: Path) -> None:
    """The table has what the file has; the CRS decides what a foot is."""
    feet = read_trajectory(write(tmp_path, "image,lat,lon,altitude (ft)\na,46,7,100\n"))
    assert feet.height_unit_m == 0.3048 and feet.xyz[0, 2] == 100.0
    assert read_trajectory(write(tmp_path, "image,x_ft,y_ft,z_ft\na,1,2,3\n")).plan_unit_m == 0.3048
    assert read_trajectory(write(tmp_path, "image,lat,lon,height above MSL\na,46,7,100\n")).heights_above_geoid
    stated = read_trajectory(write(tmp_path, "image,lat,lon,Height (ellipsoidal)\na,46,7,100\n"))
    assert stated.assumed_crs == "EPSG:4979"
    for relative in ("rel_alt", "RelativeAltitude", "height above takeoff [m]", "AGL"):
        with refused("heights-relative", InputError):
            read_trajectory(write(tmp_path, f"image,lat,lon,{relative}\na,46,7,100\n"))


def test_accuracies_but_no_accelerations(tmp_path: Path) -> None:
    """PIX4D's horizontal and vertical accuracy, in its unit; `acc_x` is an acceleration."""
    text = "image,lat,lon,alt,Accuracy Horizontal [cm],Accuracy Vertical [cm]\na,46,7,1,2,3\n"
    sigma = read_trajectory(write(tmp_path, text)).sigma_enu_m
    assert sigma is not None
    np.testing.assert_allclose(sigma, [[0.02, 0.02, 0.03]])
    text = "image,lat,lon,alt,sdn(m),sde(m),sdu(m)\na,46,7,1,0.1,0.2,0.3\n"
    sigma = read_trajectory(write(tmp_path, text)).sigma_enu_m
    assert sigma is not None and sigma.tolist() == [[0.2, 0.1, 0.3]]
    assert (
        read_trajectory(write(tmp_path, "image,lat,lon,alt,acc_x,acc_y,acc_z\na,46,7,1,-9,1,0\n")).sigma_enu_m
        is None
    )


def test_angles_of_the_aircraft_are_not_the_camera_s(tmp_path: Path) -> None:
    text = "image,lat,lon,alt,uav_yaw,uav_pitch,uav_roll\na,46,7,1,10,2,3\n"
    assert read_trajectory(write(tmp_path, text)).quat_xyzw is None
    text = (
        "SourceFile,GPSLatitude,GPSLongitude,AbsoluteAltitude,GimbalYawDegree,GimbalPitchDegree,GimbalRollDegree\n"
    )
    turned = read_trajectory(write(tmp_path, text + "a,46,7,1,10,-80,0\n")).quat_xyzw
    assert turned is not None
    np.testing.assert_allclose(matrix_from_quat_xyzw(turned[0]), geo_from_cam([10.0, -80.0, 0.0]), atol=1e-12)


ATTITUDE = (35.0, -78.0, 3.0)


@pytest.mark.parametrize("unit", ["", "_deg", " [gon]", "(rad)"])
def test_omega_phi_kappa(tmp_path: Path, unit: str) -> None:
    """Of the same camera as yaw, pitch and roll; in any order of columns; PIX4D's text file too."""
    rotation = geo_from_cam(ATTITUDE)
    factor = {" [gon]": 1 / 0.9, "(rad)": np.pi / 180}.get(unit, 1.0)
    omega, phi, kappa = (float(angle) for angle in factor * omega_phi_kappa_deg(rotation))
    rows = [(f"Kappa{unit}", f"Omega{unit}", f"Phi{unit}"), (kappa, omega, phi)]
    text = "\n".join(
        ",".join(map(str, (*start, *cells)))
        for start, cells in zip((("image", "x", "y", "z"), ("a.jpg", 1, 2, 3)), rows, strict=True)
    )
    table = read_trajectory(write(tmp_path, text + "\n"))
    assert table.quat_xyzw is not None and table.attitudes_of_grid
    np.testing.assert_allclose(matrix_from_quat_xyzw(table.quat_xyzw[0]), rotation, atol=1e-9)
    if unit == "":
        text = f"imageName X Y Z Omega Phi Kappa\na.jpg 1 2 3 {omega} {phi} {kappa}\n"
        table = read_trajectory(write(tmp_path, text, "external.txt"))
        assert table.quat_xyzw is not None
        np.testing.assert_allclose(matrix_from_quat_xyzw(table.quat_xyzw[0]), rotation, atol=1e-9)
        header = "\t".join(
            ("#Label", "X/Easting", "Y/Northing", "Z/Altitude", "Phi", "Kappa", "Omega", "Omega_est")
        )
        text = f"{header}\nDJI 1\t1\t2\t3\t{phi}\t{kappa}\t{omega}\t99\n"
        cameras = read_cameras(write(tmp_path, text, "reference.txt"))
        assert cameras.quat_xyzw is not None and cameras.attitudes_of_grid and cameras.names == ("DJI 1",)
        np.testing.assert_allclose(matrix_from_quat_xyzw(cameras.quat_xyzw[0]), rotation, atol=1e-9)


def test_two_kinds_of_angles_are_compared(tmp_path: Path) -> None:
    """Half a degree is the convergence of a grid; a sign that is wrong is none."""
    omega, phi, kappa = omega_phi_kappa_deg(geo_from_cam(ATTITUDE))
    header = "image,x,y,z,yaw,pitch,roll,omega,phi,kappa\n"
    path = write(tmp_path, header + f"a,1,2,3,35,-78,3,{omega},{phi},{kappa + 0.5}\n")
    assert not read_trajectory(path).attitudes_of_grid
    with refused("attitudes-disagree", InputError):
        read_trajectory(write(tmp_path, header + f"a,1,2,3,35,-78,3,{omega},{phi},{-kappa}\n"))


@pytest.mark.parametrize(
    "header",
    [
        "img_name,target_name,image_x,image_y",
        "Photo;Marker;X [px];Y [px]",
        "filename\tgcp_id\tpixel_x\tpixel_y",
        "image,point,u,v",
        "#image_file,tag_id,img_x,img_y",
    ],
)
def test_marks_of_other_programs(tmp_path: Path, header: str) -> None:
    separator = next(sign for sign in "\t;," if sign in header)
    (mark,) = read_marks(
        write(tmp_path, header + "\n" + separator.join(("a b.jpg", "T 1", "40.5", "30.25")) + "\n")
    )
    assert (mark.image, mark.name, mark.x_px, mark.y_px) == ("a b.jpg", "T 1", 40.5, 30.25)


EMLID = (
    "Name,Code,Easting,Northing,Elevation,Longitude,Latitude,Ellipsoidal height,Easting RMS,Northing RMS,"
    "Elevation RMS\n"
    "P 1,gcp,400000,5150000,750,7.25,46.5,800,0.01,0.02,0.03\n"
)


def test_points_of_emlid_and_trimble(tmp_path: Path) -> None:
    listed = read_point_table(write(tmp_path, EMLID))
    (point,) = listed.points
    assert (point.name, point.xyz, point.sigma_h_m, point.sigma_v_m) == ("P 1", (7.25, 46.5, 800.0), 0.02, 0.03)
    assert listed.assumed_crs == "EPSG:4979" and listed.unread_columns == ("Easting", "Northing", "Elevation")
    (point,) = read_point_table(write(tmp_path, EMLID), projected=True).points
    assert point.xyz == (400000.0, 5150000.0, 750.0)
    listed = read_point_table(write(tmp_path, "Point,Northing,Easting,Elevation (ft),Code\n7,100,200,30,x\n"))
    assert listed.points[0].xyz == (200.0, 100.0, 30.0) and listed.height_unit_m == 0.3048


def test_unknown_headers_are_answered_with_what_was_found(tmp_path: Path) -> None:
    for header in ("Bild,Breite,Laenge,Hoehe", "Archivo;Latitud;Longitud;Altura"):
        with refused("header-missing", InputError) as error:
            read_trajectory(write(tmp_path, f"{header}\na,1,2,3\n"))
        assert all(name in error.value.message for name in header.replace(";", ",").split(","))
        assert "latitude" in error.value.message
    with refused("header-missing", InputError) as error:
        read_marks(write(tmp_path, "foto,nombre,columna,fila\na,b,1,2\n".replace("foto", "abc")))
    assert "columna" in error.value.message and "image" in error.value.message


TABBED = "EPSG:4326\n9.41\t46.81\t740\t40.5\t30.25\tFlight 2 DJI 1.JPG\tPoint 1\n"


def test_tabs_separate_names_with_spaces(tmp_path: Path) -> None:
    for text in (TABBED, TABBED.replace("\t", " ").replace("Point 1", "P1")):
        listed = read_ground_points(write(tmp_path, text, "gcp_list.txt"))
        (mark,) = listed.marks
        assert mark.image == "Flight 2 DJI 1.JPG" and mark.name in ("Point 1", "P1")
    for gap in ("\t", " "):
        text = f"EPSG:4326\n2022-09-26 15-24-47 DJI.JPG{gap}9.41{gap}46.81{gap}740\n"
        assert read_geo(write(tmp_path, text, "geo.txt")).names == ("2022-09-26 15-24-47 DJI.JPG",)
    points = read_point_list(write(tmp_path, "EPSG:2056\nPoint 1\t2600000\t1200000\t400\n", "points.txt")).points
    assert points[0].name == "Point 1"
