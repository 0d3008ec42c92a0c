"""The glb: its chunks are those of the standard, and its attributes those that CesiumJS needs."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.gltf import decode_plain_glb, encode_glb, encode_plain_glb, spz_in_glb
from pipelines.formats.splat_ply import SplatArrays
from tests.delivered_scenes import splat_arrays
from tests.refusals import refused

SPLATS, SPZ = "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_structure(degree: int) -> None:
    payload = b"spz bytes"
    glb = encode_glb(payload, 7, degree, ((0, 1, 2), (3, 4, 5)), {"georef": {"σ": 1}})
    magic, version, size, json_size, kind = struct.unpack_from("<4sIII4s", glb)
    assert (magic, version, size, kind) == (b"glTF", 2, len(glb), b"JSON")
    assert json_size % 4 == size % 4 == 0
    assert glb[20 + json_size + 4 :][:4] == b"BIN\0"
    assert spz_in_glb(glb)[: len(payload)] == payload
    document = json.loads(glb[20 : 20 + json_size])
    assert document["extensionsUsed"] == document["extensionsRequired"] == [SPLATS, SPZ]
    assert document["asset"]["extras"] == {"georef": {"σ": 1}}
    (primitive,) = document["meshes"][document["nodes"][0]["mesh"]]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][SPLATS]["extensions"][SPZ] == {"bufferView": 0}
    names = list(primitive["attributes"])
    assert names[:4] == ["POSITION", "COLOR_0", f"{SPLATS}:SCALE", f"{SPLATS}:ROTATION"]
    # CesiumJS knows the degree by the number of harmonics, which leaves out the constant one: 0, 3, 8 or 15.
    assert len(names) - 4 == (degree + 1) ** 2 - 1
    assert all(name.startswith(f"{SPLATS}:SH_DEGREE_") for name in names[4:])
    assert not any("SH_DEGREE_0" in name for name in names)
    assert {accessor["count"] for accessor in document["accessors"]} == {7}
    assert document["bufferViews"] == [{"buffer": 0, "byteLength": len(payload)}]
    # Column by column: up of the frame is y of glTF.
    matrix = np.array(document["nodes"][0]["matrix"]).reshape(4, 4).T
    np.testing.assert_array_equal(matrix @ [0, 0, 1, 1], [0, 1, 0, 1])
    assert np.linalg.det(matrix) == 1


def test_other_files_hold_no_spz() -> None:
    assert spz_in_glb(b"") == spz_in_glb(b"not a glb, though long enough") == b""
    assert spz_in_glb(b"glTF" + b"\xff" * 40) == b""


def attributes_of(glb: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Document of a glb, and its attributes as any reader of glTF takes them."""
    (size,) = struct.unpack_from("<I", glb, 12)
    document = json.loads(glb[20 : 20 + size])
    body = glb[28 + size :]
    arrays = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        dtype = {5121: np.dtype("u1"), 5126: np.dtype("<f4")}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert view["byteOffset"] % 4 == 0 and view["byteLength"] == accessor["count"] * width * dtype.itemsize
        data = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        arrays[name] = np.frombuffer(data, dtype).reshape(-1, width)
    return document, arrays


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_plain_attributes_are_those_of_the_ratified_extension(degree: int) -> None:
    whole = splat_arrays(30)
    splat = SplatArrays(**{**vars(whole), "sh": whole.sh[:, : (degree + 1) ** 2]})
    document, read = attributes_of(encode_plain_glb(splat, {"georef": 1}))
    assert document["extensionsUsed"] == [SPLATS] and "extensionsRequired" not in document
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and "extensions" not in primitive["extensions"][SPLATS]
    assert primitive["extensions"][SPLATS]["kernel"] == "ellipse"
    assert primitive["extensions"][SPLATS]["colorSpace"] == "srgb_rec709_display"
    bounds = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(bounds["min"], splat.means.min(axis=0))
    np.testing.assert_array_equal(bounds["max"], splat.means.max(axis=0))
    np.testing.assert_array_equal(read["POSITION"], splat.means)
    np.testing.assert_allclose(read[f"{SPLATS}:SCALE"], np.exp(splat.log_scales.astype(float)), rtol=1e-6)
    opacity = 1 / (1 + np.exp(-splat.logit_opacities.astype(float)))
    np.testing.assert_allclose(read[f"{SPLATS}:OPACITY"][:, 0], opacity, rtol=1e-6)
    unit = splat.quats_wxyz / np.linalg.norm(splat.quats_wxyz, axis=1, keepdims=True)
    np.testing.assert_allclose(read[f"{SPLATS}:ROTATION"], unit[:, [1, 2, 3, 0]], atol=1e-6)
    harmonics = [name for name in read if "SH_DEGREE" in name]
    places = [(int(name.split("_")[-3]), int(name.split("_")[-1])) for name in harmonics]
    assert places == [(band, order) for band in range(degree + 1) for order in range(2 * band + 1)]
    for index, name in enumerate(harmonics):
        np.testing.assert_array_equal(read[name], splat.sh[:, index])
    assert read["COLOR_0"].dtype == np.uint8
    colour = np.clip(0.5 + 0.2820948 * splat.sh[:, 0], 0, 1)
    np.testing.assert_allclose(read["COLOR_0"] / 255, np.column_stack([colour, opacity]), atol=0.501 / 255)


def test_plain_gaussians_are_read_back() -> None:
    splat = splat_arrays(30)
    read = decode_plain_glb(encode_plain_glb(splat))
    for name in ("means", "sh"):
        np.testing.assert_array_equal(getattr(read, name), getattr(splat, name))
    # A float32 near 1 has steps of 6e-8, which the logit of an opacity of 0.98 magnifies fifty times.
    np.testing.assert_allclose(read.logit_opacities, splat.logit_opacities, atol=1e-5)
    np.testing.assert_allclose(read.log_scales, splat.log_scales, atol=1e-6)
    unit = splat.quats_wxyz / np.linalg.norm(splat.quats_wxyz, axis=1, keepdims=True)
    np.testing.assert_allclose(read.quats_wxyz, unit, atol=1e-6)
    opaque = SplatArrays(**{**vars(splat), "logit_opacities": np.full(30, 90, np.float32)})
    assert np.isfinite(decode_plain_glb(encode_plain_glb(opaque)).logit_opacities).all()


def test_gaussians_without_a_rotation_and_damaged_files_are_refused() -> None:
    splat = splat_arrays(3)
    splat.quats_wxyz[1] = 0
    with refused("values-not-finite", InputError):
        encode_plain_glb(splat)
    glb = encode_plain_glb(splat_arrays(3))
    for damaged in (
        b"",
        b"not a glb, though long enough",
        glb[:300],
        glb[:-2000],
        encode_glb(b"spz", 1, 0, ((0,) * 3,) * 2),
    ):
        with refused("file-damaged", InputError):
            decode_plain_glb(damaged)
