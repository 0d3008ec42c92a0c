"""Tables for spreadsheets: no name becomes a formula, numbers stay numbers, and names come back as they were."""

from __future__ import annotations

import ast
import csv
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.files import replace_text
from pipelines.formats.camera_files import CameraTable, write_camera_table
from pipelines.formats.tables import plain_text, table_text
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geometry.rotations import geo_from_cam, omega_phi_kappa_deg
from tests.cli_runs import REPOSITORY

FORMULAS = ["=cmd|' /C calc'!A0", "+1+2", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "'=1", "''-x"]
NUMBERS = ["-1.5", "+2", "-1e-07", "-.5", "3."]
NAMES = ["a.jpg", "'quoted'", "ä=b", ""]


def test_formulas_alone_begin_with_an_apostrophe(tmp_path: Path) -> None:
    replace_text(tmp_path / "t.csv", table_text([[*FORMULAS, *NUMBERS, *NAMES, -1.5, None]]))
    with (tmp_path / "t.csv").open(encoding="utf-8", newline="") as handle:
        (cells,) = csv.reader(handle)
    assert cells == [*(f"'{text}" for text in FORMULAS), *NUMBERS, *NAMES, "-1.5", ""]
    assert [plain_text(cell) for cell in cells[:-2]] == [*FORMULAS, *NUMBERS, *NAMES]


@pytest.mark.parametrize("name", ["=1+2.jpg", "-a.jpg", "'@b.jpg", "c.jpg"])
def test_names_of_a_table_of_cameras_are_read_back(tmp_path: Path, name: str) -> None:
    three = np.full((1, 3), -1.25)
    omega = omega_phi_kappa_deg(geo_from_cam(three))
    table = CameraTable((name,), ("train",), three, False, omega, three, three.clip(0.1), three)
    write_camera_table(tmp_path / "cameras.csv", table)
    text = (tmp_path / "cameras.csv").read_text("utf-8").splitlines()[1]
    assert text.startswith(name if name == "c.jpg" else f"'{name}")
    assert read_trajectory(tmp_path / "cameras.csv").names == (name,)


@pytest.mark.slow
def test_one_writer_writes_all_tables() -> None:
    users = {
        file.name
        for package in ("georef_cli", "pipelines")
        for file in (REPOSITORY / package).rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text("utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("csv.writer", "csv.DictWriter")
    }
    assert users == {"tables.py"}
