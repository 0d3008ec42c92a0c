"""Counts of a band back to its reflectance, by the constants that makers write; the truth is what was exposed."""

from __future__ import annotations

import base64
import struct

import numpy as np
import pytest

from pipelines.formats.exif import read_tags
from pipelines.formats.image_file import deep_pixels, image_header
from pipelines.formats.radiometry import Radiometry, band_of, radiometry_of
from tests.band_photographs import band_tiff, dji_band, exposed, pix4d_band, polynomial

HEIGHT, WIDTH = 60, 80
ROW, COLUMN = np.mgrid[:HEIGHT, :WIDTH].astype(float)
REFLECTANCE = 0.05 + 0.4 * (COLUMN / WIDTH) * (0.5 + 0.5 * ROW / HEIGHT)
CENTER = (38.5, 31.0)
RADIUS = np.hypot(COLUMN - CENTER[0], ROW - CENTER[1])
BRIGHTENS = (1e-5, 2e-5, 0.0, 3e-9, 0.0, 0.0)  # DJI's polynomial, by which counts are multiplied
DARKENS = (-1e-5, -2e-5, 0.0, -3e-9, 0.0, 0.0)  # MicaSense's, by which they are divided


def read(data: bytes, *, thermal: bool = False) -> tuple[Radiometry, np.ndarray, np.ndarray]:
    """Return the radiometry of a file, its values, and how much a count is worth at each pixel."""
    header, tags, pixels = image_header(data), read_tags(data), deep_pixels(data)
    assert header is not None and pixels is not None
    found = radiometry_of(tags, header, thermal=thermal)
    values = found.values(pixels)
    return found, values, found.values(pixels.astype(float) + 1) - values


def is_back(values: np.ndarray, step: np.ndarray, truth: np.ndarray) -> None:
    """Counts are whole: the truth is within half a count, and float32's digits."""
    error = np.abs(values - truth)
    print(error.max(), step.max())
    assert (error <= 0.5 * np.abs(step) + 1e-6 * np.abs(truth)).all()
    assert step.max() < 0.01 * np.ptp(truth)  # or the bound would say nothing


def counted(values: np.ndarray) -> np.ndarray:
    assert values.min() > 0 and values.max() < 65535
    return np.round(values).astype(np.uint16)


PHANTOM = {"BandName": "NIR", "BandFreq": "840(+/-26)nm", "VignettingData": ", ".join(map(str, BRIGHTENS)),
    "CalibratedOpticalCenterX": CENTER[0], "CalibratedOpticalCenterY": CENTER[1]}  # fmt: skip
MAVIC = {"BandName": "NIR", "CentralWavelength": "840", "WavelengthFWHM": "52",
    "VignettingPolynomial": ", ".join(map(str, BRIGHTENS)), "VignettingFlag": "0",
    "VignettingCenter": f"{CENTER[0]}, {CENTER[1]}"}  # fmt: skip


@pytest.mark.parametrize("names", [PHANTOM, MAVIC], ids=["Phantom 4 Multispectral", "Mavic 3M"])
@pytest.mark.parametrize("black_in_exif", [True, False])
def test_dji_by_gain_exposure_and_irradiance(names: dict[str, object], black_in_exif: bool) -> None:
    gain, exposure_s, adjustment, irradiance, black = 2.0, 0.0012, 1.08, 800.0, 4096
    signal = 65535 * REFLECTANCE * gain * exposure_s * irradiance / adjustment / polynomial(RADIUS, BRIGHTENS)
    stated = {
        **names, "SensorGain": gain, "ExposureTime": round(exposure_s * 1e6), "Irradiance": irradiance,
        "SensorGainAdjustment": adjustment,
    }  # fmt: skip
    if not black_in_exif:
        stated["BlackLevel"] = black
    tags = exposed(exposure_s, black=black) if black_in_exif else exposed(exposure_s)
    data = band_tiff(counted(black + signal), dji_band(**stated), make="DJI", tags=tags)
    found, values, step = read(data)
    is_back(values, step, REFLECTANCE)
    assert (found.quantity, found.comparable) == ("relative reflectance", True)
    band = band_of(read_tags(data))
    assert (band.wavelength_nm, band.fwhm_nm) == (840.0, 52.0)


@pytest.mark.parametrize("second_sensor", [True, False])
def test_micasense_by_its_radiometric_calibration(second_sensor: bool) -> None:
    """The row gradient is that of a rolling shutter; irradiance in W/m²/nm, or in hundredths of it."""
    a1, a2, a3, exposure_s, iso, black, irradiance = 2.1e-4, 1.3e-7, 2e-5, 0.0004, 200, 4800, 1.1
    radiance = REFLECTANCE * irradiance / np.pi
    signal = 65536 * radiance * (iso / 100) / a1 * (exposure_s + a2 * ROW - a3 * exposure_s * ROW)
    counts = counted(black + signal * polynomial(RADIUS, DARKENS))
    names = {"HorizontalIrradiance": 100 * irradiance} if second_sensor else {"Irradiance": irradiance}
    xmp = pix4d_band(
        BandName="Red edge", CentralWavelength=717, WavelengthFWHM=12,
        RadiometricCalibration=f"{a1},{a2},{a3}", VignettingCenter=f"{CENTER[0]},{CENTER[1]}",
        VignettingPolynomial=",".join(map(str, DARKENS)), **names,
    )  # fmt: skip
    found, values, step = read(band_tiff(counts, xmp, tags=exposed(exposure_s, iso, black=black)))
    is_back(values, step, REFLECTANCE)
    assert found.quantity == "reflectance"


def sunshine(count: int, index: int, exposure_ms: int) -> str:
    """Parrot's readings: an old one of another brightness before that of the exposure."""
    readings = [(1, 9, 1, index, exposure_ms), (2, count, 60, index, exposure_ms)]
    return base64.b64encode(b"".join(struct.pack("<Q4H3f", *each, 0.1, 0.2, 0.3) for each in readings)).decode()


@pytest.mark.parametrize("firmware", ["with a sensor model", "without"])
@pytest.mark.parametrize("gain_index", [1, 2])
def test_sequoia_by_sensor_model_and_sunshine(firmware: str, gain_index: int) -> None:
    """Reflectance times a factor of the lens, which is the model's unit of irradiance."""
    slope, black, constant = (12000.0, 4736.0, 0.8) if firmware != "without" else (1.0, 4736.0, 0.0)
    f_number, exposure_s, iso, count, exposure_ms = 2.2, 0.00115, 100, 640, 100
    counts_of_gain = {0: 14, 1: 357, 2: 5989, 3: 65535}
    light = count / (exposure_ms * counts_of_gain[gain_index] / counts_of_gain[1])
    x, y = COLUMN / WIDTH, ROW / HEIGHT
    vignetting = 0.7 + 1.2 * x - 1.2 * x**2 + 0.5 * y - 0.5 * y**2 + 0.1 * x * y
    unit = 50000 / ((slope * exposure_s * iso + constant) * light / f_number**2)  # so that counts fill the range
    signal = unit * REFLECTANCE * light * (slope * exposure_s * iso + constant) / f_number**2
    stated: dict[str, object] = {
        "IrradianceList": sunshine(count, gain_index, exposure_ms),
        "IrradianceCalibrationMeasurement": ",".join(f"{i},600,{c},1" for i, c in counts_of_gain.items()),
        "BlackCurrent": 74.0,
        "VignettingPolynomial2DName": "0,0,1,0,2,0,0,1,0,2,1,1",
        "VignettingPolynomial2D": "0.7,1.2,-1.2,0.5,-0.5,0.1",
    }
    if firmware != "without":
        stated["SensorModel"] = f"{slope},{black},{constant}"
    data = band_tiff(
        counted(black + signal * vignetting), pix4d_band(**stated), tags=exposed(exposure_s, iso, f_number=f_number)
    )
    found, values, step = read(data)
    is_back(values / unit, step / unit, REFLECTANCE)
    assert (found.quantity, found.comparable) == ("relative reflectance", False)


def test_what_lacks_a_constant_has_counts() -> None:
    """A sunshine sensor that was saturated tells nothing; nor do a file without tags and an exposure of 0."""
    stated = {"SensorGain": 1.0, "Irradiance": 900.0, "BlackLevel": 4096}
    data = band_tiff(np.full((4, 4), 5000, np.uint16), dji_band(**stated))
    assert read(data)[0].missing == ("ExposureTime",)
    np.testing.assert_array_equal(read(data)[1], 5000)
    dark = band_tiff(np.full((4, 4), 5000, np.uint16), dji_band(**stated | {"Irradiance": 0}), tags=exposed(1e-3))
    assert read(dark)[0].missing == ("Irradiance",)
    assert read(band_tiff(np.full((4, 4), 7, np.uint16), None))[0].quantity == "counts"
    table = {"IrradianceCalibrationMeasurement": "0,600,14,1,1,600,357,45"}
    saturated = pix4d_band(IrradianceList=sunshine(65535, 1, 100), BlackCurrent=70, **table)
    tags = exposed(1e-3, f_number=2.2)
    assert read(band_tiff(np.full((4, 4), 7, np.uint16), saturated, tags=tags))[0].missing == ("Irradiance",)
    senseless = pix4d_band(IrradianceList=sunshine(600, 1, 100), SensorModel="0,70,0", **table)
    assert read(band_tiff(np.full((4, 4), 7, np.uint16), senseless, tags=tags))[0].missing == ("SensorModel",)


def test_temperatures() -> None:
    """FLIR's linear counts of 0.04 K, MicaSense's of 0.01 K, and degrees as they are; other counts are counts."""
    degrees = np.linspace(-10, 60, 48).reshape(6, 8)
    flir = band_tiff(np.round((degrees + 273.15) / 0.04).astype(np.uint16), pix4d_band(TlinearGain=0.04))
    micasense = band_tiff(np.round((degrees + 273.15) * 100).astype(np.uint16), None, make="MicaSense")
    for data, step in ((flir, 0.04), (micasense, 0.01)):
        found, values, _ = read(data, thermal=True)
        assert found.quantity == "degrees Celsius"
        assert np.abs(values - degrees).max() <= step / 2 + 1e-4
    found, values, _ = read(band_tiff(degrees.astype(np.float32), None), thermal=True)
    assert (found.quantity, found.float_degrees) == ("degrees Celsius", True)
    np.testing.assert_allclose(values, degrees, atol=1e-5)
    assert read(band_tiff(np.full((4, 4), 9000, np.uint16), None), thermal=True)[0].quantity == "counts"
