"""SOG: what is written is what its specification reads, within the steps that the format states."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.types import rows_of
from pipelines.formats.sog import write_sog
from tests.delivered_scenes import splat_arrays
from tests.refusals import refused
from tests.sog_files import pixels, read_sog


@pytest.mark.parametrize(("count", "degree"), [(1, 3), (40, 0), (700, 2)])
def test_values_come_back_within_a_step(tmp_path: Path, count: int, degree: int) -> None:
    splat = splat_arrays(count)
    splat = replace(splat, sh=splat.sh[:, : (degree + 1) ** 2])
    rounded_m = write_sog(tmp_path, splat)
    read = read_sog(tmp_path)
    # Half a step of the logarithm of 1 + |x|, over the extent of the unit.
    logarithms = np.sign(splat.means) * np.log1p(np.abs(splat.means))
    step = np.ptp(logarithms, axis=0).max() / 65535
    off_m = np.abs(read.means - splat.means).max(axis=1)
    assert (off_m <= 0.51 * step * (1 + np.abs(splat.means).max()) + 1e-6).all()
    np.testing.assert_allclose(rounded_m, off_m, rtol=0, atol=2e-6)
    np.testing.assert_allclose(read.log_scales, splat.log_scales, rtol=0, atol=1 / 32 + 1e-6)
    np.testing.assert_allclose(read.sh[:, 0], splat.sh[:, 0], rtol=0, atol=0.5 / 38.25 + 1e-6)
    np.testing.assert_allclose(read.sh[:, 1:], splat.sh[:, 1:], rtol=0, atol=1 / 128 + 1e-6)
    opacity, truth = (1 / (1 + np.exp(-part.logit_opacities)) for part in (read, splat))
    np.testing.assert_allclose(opacity, truth, rtol=0, atol=0.5 / 255 + 1e-6)
    unit = splat.quats_wxyz / np.linalg.norm(splat.quats_wxyz, axis=1, keepdims=True)
    # Three components, each off by half of √2 / 255.
    assert np.degrees(2 * np.arccos(np.clip(np.abs((read.quats_wxyz * unit).sum(axis=1)), 0, 1))).max() < 0.8


def test_colours_of_what_is_transparent_stay(tmp_path: Path) -> None:
    """Writers of WebP may drop the colour where the fourth channel is zero: it is that of a Gaussian here."""
    splat = replace(splat_arrays(), logit_opacities=np.full(40, -20, np.float32))
    write_sog(tmp_path, splat)
    assert not pixels(tmp_path, "sh0.webp", 40)[:, 3].any()
    np.testing.assert_allclose(read_sog(tmp_path).sh[:, 0], splat.sh[:, 0], rtol=0, atol=0.014)


def test_what_lies_beyond_the_range_is_clamped_and_one_place_is_no_extent(tmp_path: Path) -> None:
    splat = rows_of(splat_arrays(), np.zeros(5, np.int64))
    write_sog(tmp_path, replace(splat, sh=50 * splat.sh, log_scales=splat.log_scales - 90), mip_filter=True)
    read, meta = read_sog(tmp_path), json.loads((tmp_path / "meta.json").read_text())
    np.testing.assert_allclose(read.means, splat.means, rtol=1e-5)
    assert np.abs(read.sh).max() <= 3.34 and (read.log_scales == -10).all()
    assert (meta["antialias"], meta["model"]) == (True, "antialiased")


def test_what_is_no_gaussian_is_refused(tmp_path: Path) -> None:
    splat = splat_arrays()
    splat.means[3, 1] = np.nan
    with refused("values-not-finite", InputError):
        write_sog(tmp_path, splat)
    splat = splat_arrays()
    splat.quats_wxyz[0] = 0
    with refused("quaternion-length", InputError):
        write_sog(tmp_path, splat)
