"""The glb: its chunks are those of the standard, and its attributes those that CesiumJS needs."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from pipelines.formats.gltf import encode_glb, spz_in_glb

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
