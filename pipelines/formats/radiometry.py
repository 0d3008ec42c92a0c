"""Radiometry of a photograph: constants that turn its stored counts into reflectance or degrees, by its tags.

- MicaSense (RedEdge, Altum): radiance by `RadiometricCalibration`, black level, gain and exposure, over the
  horizontal irradiance of the light sensor ("RedEdge Camera Radiometric Calibration Model", and the maker's
  `imageprocessing`).
- Parrot Sequoia: irradiance by `SensorModel` A, B, C as f² (p − B) / (A ε γ + C) (application note SEQ-AN-01), over
  the sunshine sensor's count / (gain · exposure), whose gains `IrradianceCalibrationMeasurement` states.
- DJI (P4 Multispectral, Mavic 3M): (p − black) / (gain · exposure) · `SensorGainAdjustment` / `Irradiance` ("P4
  Multispectral Image Processing Guide", equations 6 to 9). Others that state black level, gain, exposure and
  irradiance are read alike.
- Thermal: MicaSense's LWIR in hundredths of a kelvin, FLIR's `TlinearGain`, and files of floating-point numbers.

MicaSense's reflectance is absolute. The others' differs from it by a factor that only a panel tells: relative.
"""

import base64
import binascii
import math
import re
import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipelines.core.types import AnyArray, Float32Array, FloatArray
from pipelines.formats.exif import PhotoTags
from pipelines.formats.image_file import ImageHeader
from pipelines.formats.xmp import Xmp

Quantity = Literal["reflectance", "relative reflectance", "degrees Celsius", "counts"]
ZERO_CELSIUS_K = 273.15
_CENTIKELVIN = 0.01
_SEQUOIA_BITS = 10  # of its sensors; files have them in the upper ones of sixteen
_READING = struct.Struct("<Q4H3f")  # time, counts of both channels, gain index, exposure in ms, attitude
_REFERENCE_GAIN = 1  # index: counts of the next lower one have two digits
_SATURATED = 65535
_SAME_EXPOSURE = 0.1  # relative difference of two statements of one exposure
_WIDTH_OF_BAND = re.compile(r"\s*([\d.]+)\s*\(?\s*\+/-\s*([\d.]+)\s*\)?\s*nm", re.IGNORECASE)


@dataclass(frozen=True)
class RadialVignetting:
    """Polynomial 1 + k₀ r + k₁ r² + … of the distance r in pixels from a centre, which divides or multiplies."""

    center_px: tuple[float, float]  # of indices of pixels, from 0 on
    coefficients: tuple[float, ...]
    divides: bool

    def factor(self, height: int, width: int) -> FloatArray:
        """Return the factors (H, W) that undo it."""
        row, column = np.mgrid[:height, :width]
        radius = np.hypot(column - self.center_px[0], row - self.center_px[1])
        value = np.polynomial.polynomial.polyval(radius, (1.0, *self.coefficients))
        return np.asarray(1.0 / value if self.divides else value)


@dataclass(frozen=True)
class PlaneVignetting:
    """Polynomial Σ k xⁱ yʲ of places over width and height, which divides counts."""

    powers: tuple[tuple[int, int], ...]
    coefficients: tuple[float, ...]

    def factor(self, height: int, width: int) -> FloatArray:
        """Return the factors (H, W) that undo it."""
        grid = np.zeros((max(i for i, _ in self.powers) + 1, max(j for _, j in self.powers) + 1))
        for (i, j), value in zip(self.powers, self.coefficients, strict=True):
            grid[i, j] += value
        x, y = np.arange(width) / width, np.arange(height) / height
        return np.asarray(1.0 / np.polynomial.polynomial.polygrid2d(x, y, grid).T)


@dataclass(frozen=True)
class Radiometry:
    """Way from stored counts to values: scale · vignetting · (count − black) / (1 + slope · row) + offset.

    Attributes:
        comparable: whether the factor of relative reflectance is the same in all bands of the camera.
        missing: tags without which nothing but counts is known.
        float_degrees: floating-point temperatures, whose unit the file does not state.
    """

    quantity: Quantity
    black: float = 0.0
    scale: float = 1.0
    offset: float = 0.0
    row_slope: float = 0.0
    vignetting: RadialVignetting | PlaneVignetting | None = None
    comparable: bool = True
    missing: tuple[str, ...] = ()
    float_degrees: bool = False

    def values(self, pixels: AnyArray) -> Float32Array:
        """Return the values (H, W) of stored pixels (H, W), in the unit of the quantity."""
        value = self.scale * (pixels.astype(np.float64) - self.black)
        if self.vignetting is not None:
            value *= self.vignetting.factor(*pixels.shape)
        if self.row_slope:
            value /= 1.0 + self.row_slope * np.arange(pixels.shape[0])[:, None]
        return np.asarray(value + self.offset, dtype=np.float32)


@dataclass(frozen=True)
class BandTags:
    """Statement of a photograph's band: its name, centre and full width at half maximum; None: not stated."""

    name: str = ""
    wavelength_nm: float | None = None
    fwhm_nm: float | None = None


def band_of(tags: PhotoTags) -> BandTags:
    """Return the band that a photograph's tags state."""
    xmp = tags.xmp
    wavelength, fwhm = (_first(_numbers(xmp, name)) for name in ("CentralWavelength", "WavelengthFWHM"))
    stated = _WIDTH_OF_BAND.match(xmp.text("BandFreq") or "")
    if stated is not None:
        wavelength, fwhm = wavelength or float(stated[1]), fwhm or 2 * float(stated[2])
    if wavelength is not None and 0 < wavelength < 100:  # some makers state micrometres
        wavelength, fwhm = 1000 * wavelength, None if fwhm is None else 1000 * fwhm
    return BandTags((xmp.text("BandName") or "").strip(), wavelength or None, fwhm or None)


def radiometry_of(tags: PhotoTags, header: ImageHeader, *, thermal: bool = False) -> Radiometry:
    """Return the radiometry of a photograph of one band; counts where its tags lack a constant."""
    if thermal:
        return _temperature(tags, header)
    if len(calibration := _numbers(tags.xmp, "RadiometricCalibration")) >= 3:
        return _micasense(tags, header, calibration)
    if tags.xmp.text("IrradianceList") is not None:
        return _sequoia(tags, header)
    return _by_gain(tags, header)


def _temperature(tags: PhotoTags, header: ImageHeader) -> Radiometry:
    gain = tags.xmp.number("TlinearGain")
    if gain is not None and gain > 0:
        return Radiometry("degrees Celsius", scale=gain, offset=-ZERO_CELSIUS_K)
    if header.is_float:
        return Radiometry("degrees Celsius", float_degrees=True)
    if "micasense" in tags.make.casefold() and header.bits == 16:
        return Radiometry("degrees Celsius", scale=_CENTIKELVIN, offset=-ZERO_CELSIUS_K)
    return Radiometry("counts", missing=("a scale of temperatures",))


def _micasense(tags: PhotoTags, header: ImageHeader, calibration: tuple[float, ...]) -> Radiometry:
    """L = V a₁ / g · (p − black) / (t + a₂ y − a₃ t y), p and black over 2ᴺ; reflectance π L / E."""
    xmp = tags.xmp
    irradiance = xmp.number("HorizontalIrradiance", "Irradiance", "SpectralIrradiance")
    if irradiance is not None:
        # Second sensors state hundredths where no scale stands beside, the first ones W/m²/nm.
        unstated = 0.01 if xmp.number("HorizontalIrradiance") is not None else 1.0
        irradiance *= xmp.number("IrradianceScaleToSIUnits") or unstated
    known, missing = _known(black=_black(tags), exposure=_exposure_s(tags), gain=_gain(tags), irradiance=irradiance)
    if missing:
        return Radiometry("counts", missing=missing)
    first, second, third = calibration[:3]
    scale = _over(math.pi * first, known["gain"] * known["exposure"] * 2**header.bits * known["irradiance"])
    if scale is None:
        return Radiometry("counts", missing=("RadiometricCalibration",))
    return Radiometry(
        "reflectance",
        black=known["black"],
        scale=scale,
        row_slope=second / known["exposure"] - third,
        vignetting=_radial(xmp, "VignettingPolynomial", divides=True),
    )


def _sequoia(tags: PhotoTags, header: ImageHeader) -> Radiometry:
    """Before firmware 1.2.1 there is no `SensorModel`: its factor, one for each lens, is left out then."""
    xmp = tags.xmp
    model, black = _numbers(xmp, "SensorModel"), _first(_numbers(xmp, "BlackCurrent"))
    if len(model) >= 3:
        slope, black, constant = model[:3]
    else:
        slope, constant = 1.0, 0.0
        if black is not None and header.bits == 16:
            black *= 2 ** (16 - _SEQUOIA_BITS)
    exposure_s, iso, f_number = _exposure_s(tags), _iso(tags), _exif(tags, "FNumber")
    known, missing = _known(
        black=black, exposure=exposure_s, gain=iso, aperture=f_number, irradiance=_sunshine(xmp)
    )
    if missing:
        return Radiometry("counts", missing=missing)
    of_lens = slope * known["exposure"] * known["gain"] + constant
    scale = _over(known["aperture"] ** 2, of_lens * known["irradiance"])
    if scale is None:
        return Radiometry("counts", missing=("SensorModel",))
    return Radiometry(
        "relative reflectance",
        black=known["black"],
        scale=scale,
        vignetting=_plane(xmp),
        comparable=False,
    )


def _sunshine(xmp: Xmp) -> float | None:
    """Return the irradiance of the last reading before the exposure, in units of the unit's own; None: unknown."""
    try:
        data = base64.b64decode(xmp.text("IrradianceList") or "")
    except (binascii.Error, ValueError):
        return None
    table = _numbers(xmp, "IrradianceCalibrationMeasurement")
    counts = {int(row[0]): row[2] / row[1] for row in _rows(table, 4) if row[1] > 0 and 0 < row[2] < _SATURATED}
    readings = [_READING.unpack_from(data, at) for at in range(0, len(data) - _READING.size + 1, _READING.size)]
    if not readings:
        return None
    _, count, _, index, exposure_ms, *_ = readings[-1]
    if not (0 < count < _SATURATED and exposure_ms > 0 and {index, _REFERENCE_GAIN} <= set(counts)):
        return None
    return float(count / (exposure_ms * counts[index] / counts[_REFERENCE_GAIN]))


def _by_gain(tags: PhotoTags, header: ImageHeader) -> Radiometry:
    xmp = tags.xmp
    gain = xmp.number("SensorGain")
    stated_gain = gain if gain is not None and gain > 0 else _gain(tags)
    irradiance = xmp.number("Irradiance", "HorizontalIrradiance", "SpectralIrradiance")
    adjustment = xmp.number("SensorGainAdjustment")
    known, missing = _known(black=_black(tags), exposure=_exposure_s(tags), gain=stated_gain, irradiance=irradiance)
    if missing:
        return Radiometry("counts", missing=missing)
    applied = xmp.number("VignettingFlag") == 1
    vignetting = None if applied else _radial(xmp, "VignettingData", divides=False)
    if vignetting is None and not applied:
        vignetting = _radial(xmp, "VignettingPolynomial", divides=gain is None)
    full = 2**header.bits - 1
    scale = _over(adjustment or 1.0, full * known["gain"] * known["exposure"] * known["irradiance"])
    if scale is None:
        return Radiometry("counts", missing=("SensorGainAdjustment",))
    return Radiometry(
        "relative reflectance",
        black=known["black"],
        scale=scale,
        vignetting=vignetting,
        comparable=adjustment is not None,
    )


_NAMES = {
    "black": "BlackLevel",
    "exposure": "ExposureTime",
    "gain": "SensorGain or ISO",
    "aperture": "FNumber",
    "irradiance": "Irradiance",
}


def _known(**constants: float | None) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return the constants that can be used, and the tags that state none of the others; a divisor of 0 is none."""
    known = {
        name: value
        for name, value in constants.items()
        if value is not None and math.isfinite(value) and (value > 0 or name == "black")
    }
    return known, tuple(_NAMES[name] for name in constants if name not in known)


def _over(numerator: float, denominator: float) -> float | None:
    """Return a scale; None: constants of which none is wrong by itself make none that is positive and finite."""
    scale = numerator / denominator if denominator > 0 else 0.0
    return scale if 0 < scale < math.inf else None


def _black(tags: PhotoTags) -> float | None:
    stated = _numbers(tags.xmp, "BlackLevel") or _exif_numbers(tags, "BlackLevel")
    return None if not stated else float(np.mean(stated))


def _exposure_s(tags: PhotoTags) -> float | None:
    """Return the exposure: EXIF's in seconds, DJI's in microseconds if EXIF has none or both agree."""
    seconds, micro = _exif(tags, "ExposureTime"), tags.xmp.number("ExposureTime")
    if micro is None or micro <= 0 or tags.xmp.number("SensorGain") is None:
        return seconds
    exact = micro * 1e-6
    return exact if not seconds or abs(exact / seconds - 1) <= _SAME_EXPOSURE else seconds


def _iso(tags: PhotoTags) -> float | None:
    return _exif(tags, "ISOSpeed") or _exif(tags, "ISOSpeedRatings")


def _gain(tags: PhotoTags) -> float | None:
    iso = _iso(tags)
    return None if iso is None else iso / 100


def _radial(xmp: Xmp, name: str, *, divides: bool) -> RadialVignetting | None:
    coefficients, center = _numbers(xmp, name), _numbers(xmp, "VignettingCenter")
    if len(center) < 2:
        optical = (xmp.number(f"CalibratedOpticalCenter{axis}") for axis in "XY")
        center = tuple(value for value in optical if value is not None)
    if not coefficients or len(center) < 2:
        return None
    return RadialVignetting((center[0], center[1]), coefficients, divides)


def _plane(xmp: Xmp) -> PlaneVignetting | None:
    coefficients = _numbers(xmp, "VignettingPolynomial2D")
    powers = tuple((int(i), int(j)) for i, j in _rows(_numbers(xmp, "VignettingPolynomial2DName"), 2))
    usable = len(powers) == len(coefficients) > 0 and all(0 <= power <= 9 for pair in powers for power in pair)
    return PlaneVignetting(powers, coefficients) if usable else None


def _numbers(xmp: Xmp, name: str) -> tuple[float, ...]:
    """Return all numbers of a property, of a list or of one text with commas; none if one is no number."""
    parts = [part for each in xmp.named(name) for part in re.split(r"[,;\s]+", each.text.strip()) if part]
    try:
        values = tuple(float(part) for part in parts)
    except ValueError:
        return ()
    return values if all(math.isfinite(value) for value in values) else ()


def _exif(tags: PhotoTags, name: str) -> float | None:
    return _first(_exif_numbers(tags, name))


def _exif_numbers(tags: PhotoTags, name: str) -> tuple[float, ...]:
    tag = tags.exif.get(f"EXIF {name}") or tags.exif.get(f"Image {name}")
    return () if tag is None else tuple(a / b for a, b in tag.fractions if b)


def _first(values: tuple[float, ...]) -> float | None:
    return values[0] if values else None


def _rows(values: tuple[float, ...], length: int) -> list[tuple[float, ...]]:
    return [values[at : at + length] for at in range(0, len(values) - length + 1, length)]
