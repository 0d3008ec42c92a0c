"""The 3DGS PLY: its bytes are the standard's, and files that are not are refused before memory is taken."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from pipelines.core.errors import InputError
from pipelines.core.types import joined_rows
from pipelines.formats.splat_ply import (
    SplatArrays,
    join_splat_plys,
    read_centres,
    read_splat_ply,
    write_splat_ply,
)
from tests.refusals import numbers, refused


def splat(count: int = 3, degree: int = 3) -> SplatArrays:
    rng = np.random.default_rng(count)

    def rows(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    return SplatArrays(rows(3), rows(4), rows(3), rows(), rows((degree + 1) ** 2, 3))


def test_properties_are_in_the_standard_order(tmp_path: Path) -> None:
    write_splat_ply(tmp_path / "s.ply", splat())
    data = PlyData.read(tmp_path / "s.ply")
    names = [prop.name for prop in data["vertex"].properties]
    rest_names = " ".join(f"f_rest_{i}" for i in range(45))
    last = "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert " ".join(names) == f"x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 {rest_names} {last}"
    assert data.byte_order == "<"
    assert {prop.val_dtype for prop in data["vertex"].properties} == {"f4"}


def test_higher_bands_go_channel_by_channel(tmp_path: Path) -> None:
    gaussians = splat(degree=2)
    write_splat_ply(tmp_path / "s.ply", gaussians)
    vertex = PlyData.read(tmp_path / "s.ply")["vertex"]
    # Eight coefficients of red, then eight of green, then eight of blue.
    np.testing.assert_array_equal(vertex["f_rest_0"], gaussians.sh[:, 1, 0])
    np.testing.assert_array_equal(vertex["f_rest_7"], gaussians.sh[:, 8, 0])
    np.testing.assert_array_equal(vertex["f_rest_8"], gaussians.sh[:, 1, 1])
    np.testing.assert_array_equal(vertex["f_rest_23"], gaussians.sh[:, 8, 2])
    np.testing.assert_array_equal(vertex["rot_0"], gaussians.quats_wxyz[:, 0])
    assert (vertex["nx"] == 0).all()


def test_files_are_joined_in_their_order(tmp_path: Path) -> None:
    """The joined file is, byte by byte, the one of all Gaussians; rows of it are those of the parts."""
    parts = [splat(3, degree=1), splat(5, degree=1)]
    for number, part in enumerate(parts):
        write_splat_ply(tmp_path / f"{number}.ply", part)
    assert join_splat_plys([tmp_path / "0.ply", tmp_path / "1.ply"], tmp_path / "joined.ply") == 8
    write_splat_ply(tmp_path / "whole.ply", joined_rows(parts))
    assert (tmp_path / "joined.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()
    second = read_splat_ply(tmp_path / "joined.ply", slice(3, 8))
    for name, values in vars(parts[1]).items():
        np.testing.assert_array_equal(getattr(second, name), values)
    write_splat_ply(tmp_path / "other.ply", splat(2, degree=0))
    with refused("properties-differ", InputError) as error:
        join_splat_plys([tmp_path / "0.ply", tmp_path / "other.ply"], tmp_path / "x.ply")
    assert error.value.path == tmp_path / "other.ply" and "0.ply" in error.value.message


def test_other_order_and_types_are_read_too(tmp_path: Path) -> None:
    gaussians = splat(4, degree=0)
    write_splat_ply(tmp_path / "s.ply", gaussians)
    data = PlyData.read(tmp_path / "s.ply")["vertex"].data
    names = [name for name in reversed(data.dtype.names) if not name.startswith("n")]
    mixed = np.zeros(4, dtype=[(name, "<f8" if name == "x" else "<f4") for name in names] + [("label", "u1")])
    for name in names:
        mixed[name] = data[name]
    PlyData([PlyElement.describe(mixed, "vertex")], byte_order="<").write(str(tmp_path / "mixed.ply"))
    again = read_splat_ply(tmp_path / "mixed.ply")
    for name, values in vars(gaussians).items():
        np.testing.assert_array_equal(getattr(again, name), values)


def test_centres_are_read_alone(tmp_path: Path) -> None:
    gaussians = splat(7)
    write_splat_ply(tmp_path / "s.ply", gaussians)
    np.testing.assert_array_equal(read_centres(tmp_path / "s.ply"), gaussians.means)
    (tmp_path / "s.ply").write_bytes((tmp_path / "s.ply").read_bytes()[:-1])
    with refused("size-differs", InputError):
        read_centres(tmp_path / "s.ply")


@pytest.mark.parametrize(
    ("old", "new", "code", "field"),
    [
        (b"element vertex 3", b"element vertex 900000000000", "size-differs", None),
        (b"element vertex 3", b"element vertex 0", "size-differs", None),
        (b"element vertex 3", b"element vertex -3", "size-differs", None),
        (b"element vertex 3", b"element vertex 9" + b"9" * 400, "size-differs", None),
        (b"element vertex 3", b"element face 3", "ply-elements", None),
        (b"binary_little_endian", b"binary_big_endian", "ply-format", None),
        (b"binary_little_endian", b"ascii", "ply-format", None),
        (b"property float opacity", b"property float opaqueness", "not-gaussians", "opacity"),
        (b"property float f_rest_3\n", b"property float rest_3\n", "sh-coefficients", "f_rest"),
        (b"property float f_rest_3\n", b"property float f_rest_77\n", "not-gaussians", "f_rest_3"),
        (b"property float x\n", b"property float y\n", "file-damaged", None),
        (b"property float x\n", b"property list uchar int x\n", "ply-properties", None),
        (b"ply\n", b"plx\n", "not-a-ply", None),
        (b"end_header", b"", "not-a-ply", None),
    ],
)
def test_wrong_headers_are_refused(tmp_path: Path, old: bytes, new: bytes, code: str, field: str | None) -> None:
    path = tmp_path / "s.ply"
    write_splat_ply(path, splat(degree=1))
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with refused(code, InputError) as caught:
        read_splat_ply(path)
    assert (caught.value.path, caught.value.field) == (path, field)


def test_values_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    gaussians = splat(5)
    gaussians.log_scales[3, 1] = np.nan
    write_splat_ply(tmp_path / "s.ply", gaussians)
    with refused("values-not-finite", InputError) as error:
        read_splat_ply(tmp_path / "s.ply")
    assert str(error.value.field).startswith("scale_0") and numbers(error.value.message) == [1, 5, 3]


def test_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with refused("file-unreadable", InputError):
        read_splat_ply(tmp_path / "none.ply")


def test_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "s.ply"
    write_splat_ply(path, splat())
    before = path.read_bytes()
    good = splat()
    wrong = SplatArrays(good.means, good.quats_wxyz, good.log_scales, good.logit_opacities, good.sh[:, :5])
    with pytest.raises(ValueError, match="spherical harmonics"):
        write_splat_ply(path, wrong)
    assert path.read_bytes() == before


def test_a_hundred_thousand_gaussians_take_no_loop(tmp_path: Path) -> None:
    gaussians = splat(100_000)
    start = time.perf_counter()
    write_splat_ply(tmp_path / "s.ply", gaussians)
    again = read_splat_ply(tmp_path / "s.ply")
    # 25 MB each way; a Python loop over the rows alone would take this long per column.
    assert time.perf_counter() - start < 2.0
    np.testing.assert_array_equal(again.sh, gaussians.sh)
