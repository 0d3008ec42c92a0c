"""PlayCanvas' own reader of SPZ 4, from npm, takes the Gaussians of a file that has its georeference inside.

The reader is a script of the engine, which an application registers. Node runs it; what it asks of the engine are
classes that hold what they are given, and a decoder of Zstandard, which an application brings too.
"""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.spz import write_spz
from pipelines.formats.spz_extensions import SpzGeoreference
from tests.browser.chromium import LIBRARIES, MissingProgramError
from tests.delivered_scenes import splat_arrays

pytestmark = pytest.mark.browser
PLACE = SpzGeoreference("EPSG:4978", (4037313.9, -9658.3, 4921195.1), (0.5, -0.5, 0.5, 0.5), 1.0, 2026.7)
# What the reader's module imports of the engine; textures keep what is written into them.
_ENGINE = """
import { decompress } from "fzstd";
import { readFileSync } from "node:fs";
export const PIXELFORMAT_RGBA8 = 8, PIXELFORMAT_RGBA32U = 32, Http = { ResponseType: { ARRAY_BUFFER: "a" } };
export class Vec3 {}
export class GSplatFormat { constructor(device, streams) { this.streams = streams; } }
export class GSplatResourceBase {
    constructor(device, data) {
        Object.assign(this, { gsplatData: data, parameters: new Map(), textures: {} });
        this.streams = { init() {}, getTexture: (name) => ({
            lock: () => (this.textures[name] ??= new Uint32Array(4 * data.numSplats)), unlock() {} }) };
    }
    get format() { return this._format; }
}
export const WasmModule = {
    getConfig: () => ({}), getInstance: (name, use) => use({ decompress: (data) => decompress(data) }),
};
export const fetch = (url, type, use) => use(null, new Uint8Array(readFileSync(url)).buffer);
"""
_READ = """
import { SpzParser } from "./reader/spz-parser.mjs";
import { fetch } from "playcanvas";
const parser = new SpzParser({ scene: {} });
parser.handler = { fetch };
parser.load(process.argv[2], (error, read) => {
    if (error) { console.error(String(error)); process.exit(1); }
    const { gsplatData: data, textures, parameters } = read;
    console.log(JSON.stringify({ bands: data.shBands, centers: [...data.getCenters()],
        packed: [...textures.packedTexture], colour: [...textures.colorTexture], sh: [...textures.shTexture0],
        step: parameters.get("spzPositionScale") }));
}, null);
"""


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return the command that prints what the reader makes of a file."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is missing, which runs PlayCanvas' reader: `apt-get install nodejs`")
    folder = tmp_path_factory.mktemp("playcanvas")
    try:
        shutil.copytree(LIBRARIES["PlayCanvasParsers"].folder(), folder / "reader")
        shutil.copytree(LIBRARIES["Fzstd"].folder(), folder / "node_modules/fzstd")
    except MissingProgramError as error:
        pytest.skip(str(error))
    (engine := folder / "node_modules/playcanvas").mkdir()
    (engine / "package.json").write_text('{"name": "playcanvas", "type": "module", "main": "index.js"}')
    (engine / "index.js").write_text(_ENGINE)
    (folder / "read.mjs").write_text(_READ)
    return [node, str(folder / "read.mjs")]


def test_version_4_with_its_georeference_is_read_as_it_was_meant(reader: list[str], tmp_path: Path) -> None:
    splat = splat_arrays(400)
    write_spz(tmp_path / "a.spz", splat, 4, PLACE)
    done = subprocess.run(
        [*reader, str(tmp_path / "a.spz")], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert "extensions" in done.stderr  # it warns of what it leaves out: the extension was seen, and skipped
    read = json.loads(done.stdout)
    found = np.reshape(read["centers"], (-1, 3))
    apart_m = np.abs(found[:, None] - splat.means).max(axis=2)
    row = apart_m.argmin(axis=1)
    assert sorted(row) == list(range(len(splat))) and read["bands"] == 3
    assert apart_m.min(axis=1).max() < 0.51 * read["step"] + 1e-5  # half a step, 1/4096 m
    packed = np.array(read["packed"], np.uint32).reshape(-1, 4)
    scales = (packed[:, :3] >> 24) / 16.0 - 10.0  # as in its shader, and so below
    np.testing.assert_allclose(scales, splat.log_scales[row], rtol=0, atol=1 / 32 + 1e-5)
    unit = splat.quats_wxyz[row] / np.linalg.norm(splat.quats_wxyz[row], axis=1, keepdims=True)
    assert np.abs((quats_wxyz(packed[:, 3]) * unit).sum(axis=1)).min() > 0.9999
    colour = (np.array(read["colour"]).reshape(-1, 4)[:, :3] / 255 - 0.5) / 0.15
    np.testing.assert_allclose(colour, splat.sh[row, 0], rtol=0, atol=0.0132)
    first = np.array(read["sh"], np.uint32).reshape(-1, 4)[:, 0]
    np.testing.assert_allclose(((first & 255) - 128.0) / 128.0, splat.sh[row, 1, 0], rtol=0, atol=0.0314)


def quats_wxyz(word: np.ndarray) -> np.ndarray:
    """Return the quaternions (N, 4) of words (N,): three parts of 10 bits, and which is the fourth, the largest."""
    xyzw, word, largest = np.zeros((len(word), 4)), word.astype(np.int64), word >> 30
    for part in (3, 2, 1, 0):
        here = largest != part
        value = (word & 511) * (np.sqrt(0.5) / 511) * np.where(word & 512, -1.0, 1.0)
        xyzw[here, part], word = value[here], np.where(here, word >> 10, word)
    rows = np.arange(len(word))
    xyzw[rows, largest] = np.sqrt(np.maximum(0.0, 1.0 - (xyzw**2).sum(axis=1)))
    return xyzw[:, [3, 0, 1, 2]]
