"""Bands of a rig as pictures of the orthophoto: each lens's own photographs, as reflectance, degrees or counts.

A cell has all its bands from one instant. Its place in the photograph of a lens follows from that in the
reference's by the pose of the lens in the rig: the bands meet as exactly as the rig was solved, whatever the
adjustment has moved since. What hides a place from the reference hides it from the lenses beside it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.plan import photograph_folder
from pipelines.core.products import Remark
from pipelines.core.progress import Progress
from pipelines.core.stages import RIG_MODEL
from pipelines.core.types import BoolArray, Float32Array, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.deliver.photo_colours import Recent, rim_weight
from pipelines.formats.colmap import read_sparse
from pipelines.formats.exif import read_tags
from pipelines.formats.geotiff import Band
from pipelines.formats.image_file import deep_pixels, image_header, read_bytes, require_unchanged
from pipelines.formats.radiometry import (
    ZERO_CELSIUS_K,
    BandTags,
    Quantity,
    Radiometry,
    band_of,
    radiometry_of,
)
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.photographs import ImageCache, Photograph, pinhole_of
from pipelines.survey.scene import photograph_files
from pipelines.survey.solution import TrainedModel
from pipelines.survey.survey import Survey

_THERMAL, _GREY = "thermal", "grey"  # sensors, by the names of `ingest`
_MOST_GREY = 2  # channels of a photograph of one band: grey, and opacity
_MOVED = 0.25  # of a band's range of values from the median: another thing
_RANGE = (1.0, 99.0)  # percentiles
_SAMPLED = 8  # instants whose values tell a band's range
_EVERY = 8  # pixels between two of these values
_WARMEST_C = 150.0  # median of a picture: beyond, its floating-point numbers are kelvin
_RED_NM, _NIR_NM = (620.0, 700.0), (760.0, 900.0)
_AHEAD = 1e-3
_REFLECTANCES = ("reflectance", "relative reflectance")
_UNITS: dict[Quantity, str] = {"degrees Celsius": "°C", "counts": "count"}


@dataclass(frozen=True)
class _Shot:
    """Photograph of a lens at an instant: its place in the cache of the lens, and its pose lens ← reference."""

    index: int  # in the images of the lens
    key: int  # of all shots
    file: Path
    sha256: str
    radiometry: Radiometry
    rotation: FloatArray
    shift_m: FloatArray


@dataclass(frozen=True)
class LensBand:
    """Band of a lens: its sensor, what its photographs state of it, and the quantity of its values."""

    sensor: str
    tags: BandTags
    quantity: Quantity
    comparable: bool  # with the other bands, as `Radiometry.comparable`

    def described(self) -> Band:
        centre = "" if self.tags.wavelength_nm is None else f", {self.tags.wavelength_nm:g} nm"
        unit = _UNITS.get(self.quantity, "")
        text = f"{self.sensor}{centre}: {self.quantity}"
        return Band(text, unit, wavelength_nm=self.tags.wavelength_nm, fwhm_nm=self.tags.fwhm_nm)


@dataclass(frozen=True)
class Bands:
    """Bands of a file, in the order of their wavelengths."""

    lenses: tuple[LensBand, ...]

    @property
    def ndvi(self) -> tuple[int, int] | None:
        """Numbers of the red and the near-infrared band, where an index of both means something."""
        red, nir = self._nearest("red", _RED_NM), self._nearest("nir", _NIR_NM)
        if red is None or nir is None:
            return None
        one, other = self.lenses[red], self.lenses[nir]
        same = one.quantity == other.quantity and one.quantity in _REFLECTANCES
        return (red, nir) if same and one.comparable and other.comparable else None

    def _nearest(self, name: str, limits: tuple[float, float]) -> int | None:
        for number, lens in enumerate(self.lenses):
            centre = lens.tags.wavelength_nm
            if (lens.sensor == name) if centre is None else (limits[0] <= centre <= limits[1]):
                return number
        return None

    def described(self) -> tuple[Band, ...]:
        """Return the bands of the file."""
        bands = tuple(lens.described() for lens in self.lenses)
        return bands if self.ndvi is None else (*bands, Band("NDVI: (nir - red) / (nir + red)"))

    def with_indices(self, values: Float32Array) -> Float32Array:
        """Return the values (C, H, W) of bands, and the index behind them if there is one."""
        if self.ndvi is None:
            return values
        red, nir = values[self.ndvi[0]], values[self.ndvi[1]]
        with np.errstate(invalid="ignore", divide="ignore"):
            index = np.where(nir + red > 0, (nir - red) / (nir + red), np.float32(np.nan))
        return np.concatenate([values, index[None]]).astype(np.float32)


class BandPictures:
    """Values of the lenses of a rig at the instants at which all of them are in the model (`Pictures`)."""

    def __init__(
        self,
        bands: Bands,
        images: Mapping[str, ImageCache],
        instants: Mapping[int, tuple[_Shot, ...]],
        pinholes: Mapping[int, Pinhole],
    ) -> None:
        """Take the images of each lens, and by camera the shots in the order of the bands and the pinholes.

        The pinholes are those of the references under SfM's lenses, at full size.
        """
        self.bands = bands
        self._images, self._instants, self._pinholes = images, instants, pinholes
        self._shots = {shot.key: shot for shots in instants.values() for shot in shots}
        self._values = Recent(self._read)
        self.moved = self._moved()

    def has(self, camera: int) -> bool:
        return camera in self._instants

    def at(
        self, camera: int, pinhole: Pinhole, u: Float32Array, v: Float32Array, z: Float32Array
    ) -> tuple[Float32Array, Float32Array]:
        """Return values (H, W, C) and factors of the weight as `Pictures.at` says."""
        # Pixels of an undistorted photograph are rays of SfM's lens, whatever lens led there.
        ray = self._pinholes[camera].rays(np.stack([u, v], axis=-1))
        point = ray * z[..., None].astype(np.float64)
        values = np.empty((*u.shape, len(self.bands.lenses)), dtype=np.float32)
        factor = np.ones(u.shape, dtype=np.float32)
        for number, (lens, shot) in enumerate(zip(self.bands.lenses, self._instants[camera], strict=True)):
            images = self._images[lens.sensor]
            own = images.pinhole(shot.index)
            in_lens = point @ shot.rotation.T + shot.shift_m
            seen: BoolArray = (z > 0) & (in_lens[..., 2] > _AHEAD)
            depth = np.where(seen, in_lens[..., 2], 1.0)
            x, y = (
                np.where(seen, focal * in_lens[..., axis] / depth + middle, -1.0)
                for axis, focal, middle in ((0, own.fx, own.cx), (1, own.fy, own.cy))
            )
            most = 4.0 * max(own.width, own.height)  # far outside, for OpenCV's 16-bit places
            x, y = (np.clip(axis, -most, most).astype(np.float32) for axis in (x, y))
            factor = np.minimum(factor, rim_weight(x, y, own))
            values[..., number] = images.sampled(shot.index, self._values.get(shot.key), np.stack([x, y], axis=-1))
        return values, factor

    def _read(self, key: int) -> Float32Array:
        shot = self._shots[key]
        return shot.radiometry.values(_pixels(shot.file, shot.sha256))

    def _moved(self) -> Float32Array:
        shots = list(self._instants.values())
        ranges = []
        for several in shots[:: max(len(shots) // _SAMPLED, 1)]:
            each = [self._values.get(shot.key)[::_EVERY, ::_EVERY] for shot in several]
            ranges.append([float(np.ptp(np.percentile(values, _RANGE))) for values in each])
        return np.maximum(_MOVED * np.median(ranges, axis=0), 1e-12).astype(np.float32)


@dataclass(frozen=True)
class _RigModel:
    """Photographs of all lenses that are in the SfM model, by its rows.

    `stated` has bands and radiometries of photographs of a single band.
    """

    sparse: SparseModel
    files: list[Photograph]
    sensor: list[str]
    stated: dict[int, tuple[BandTags, Radiometry]]

    @property
    def names(self) -> tuple[str, ...]:
        """Sensors of the bands, in the order of their wavelengths, those without one last."""
        centre: dict[str, float] = {}
        for row, (tags, _) in self.stated.items():
            centre[self.sensor[row]] = min(centre.get(self.sensor[row], np.inf), tags.wavelength_nm or np.inf)
        return tuple(sorted(centre, key=lambda name: (centre[name], name)))

    def of(self, name: str) -> list[int]:
        """Return the rows of a band."""
        return [row for row in self.stated if self.sensor[row] == name]

    def band(self, name: str) -> LensBand:
        """Return a band: counts if one of its photographs states no more."""
        stated = [self.stated[row] for row in self.of(name)]
        quantities = {radiometry.quantity for _, radiometry in stated}
        quantity: Quantity = next(iter(quantities)) if len(quantities) == 1 else "counts"
        return LensBand(name, stated[0][0], quantity, all(radiometry.comparable for _, radiometry in stated))

    def beside(self, row: int, reference: int) -> tuple[FloatArray, FloatArray]:
        """Return rotation (3, 3) and translation (3,) of a photograph ← reference, in units of the model."""
        turn, shift = self.sparse.rotation_cam_from_local, self.sparse.translation_cam_from_local
        rotation = turn[row] @ turn[reference].T
        return rotation, shift[row] - rotation @ shift[reference]


def band_pictures(
    workspace: Workspace, model: TrainedModel, sfm: SparseModel, survey: Survey, progress: Progress
) -> tuple[BandPictures, tuple[Remark, ...]]:
    """Return the bands of a survey's lenses, and what is to be said of them.

    Raises:
        InputError: no photograph is of a single band, or one cannot be read or is not that of the survey.
        MissingProductError: the survey has companions, and the SfM model of them does not exist.
    """
    rig = _rig_model(workspace, sfm, survey, progress)
    if not rig.stated:
        raise InputError(
            "no-bands",
            "No photograph of the survey is of one band: all have three colours.",
            field="--bands",
            remedy="Run `georef ingest` with --sensor all (or --rig) for the lenses of a multispectral camera.",
        )
    bands = Bands(tuple(rig.band(name) for name in rig.names))
    instants, left_out = _instants(model, survey, rig)
    images: dict[str, ImageCache] = {}
    number_of: dict[int, int] = {}
    for name in rig.names:
        files = [rig.files[row] for row in rig.of(name)]
        longest_px = max(max(each.camera.width, each.camera.height) for each in files)
        images[name] = ImageCache(workspace.cache / "undistorted", files, longest_px)
        number_of |= {row: number for number, row in enumerate(rig.of(name))}
    index, scale = rig.sparse.image_index(), model.model_from_local.scale
    shots, pinholes = {}, {}
    for camera, rows in instants.items():
        made = []
        for row, band in zip(rows, bands.lenses, strict=True):
            rotation, shift = rig.beside(row, index[sfm.image_name[camera]])
            file, stated = rig.files[row], rig.stated[row][1]
            radiometry = Radiometry("counts") if band.quantity == "counts" else stated
            made.append(_Shot(number_of[row], row, file.file, file.sha256, radiometry, rotation, scale * shift))
        shots[camera] = tuple(made)
        lens = sfm.camera_of(camera)
        pinholes[camera] = pinhole_of(lens, max(lens.width, lens.height))
    return BandPictures(bands, images, shots, pinholes), (*_remarks(rig, bands), *left_out)


def _rig_model(workspace: Workspace, sfm: SparseModel, survey: Survey, progress: Progress) -> _RigModel:
    sparse = read_sparse(workspace.path(RIG_MODEL)) if survey.companions else sfm
    files = _full_depth(photograph_files(sparse, survey.with_companions(), workspace), survey, workspace)
    sensors = {prior.camera_id: prior.sensor or _GREY for prior in survey.cameras}
    of_row = [sensors[int(camera)] for camera in sparse.image_camera_id]
    stated = {}
    with progress.task("tags of the bands", len(files)) as task:
        for row, photograph in enumerate(files):
            if (statement := _statement(photograph, thermal=of_row[row] == _THERMAL)) is not None:
                stated[row] = statement
            task.advance()
    return _RigModel(sparse, files, of_row, stated)


def _full_depth(files: list[Photograph], survey: Survey, workspace: Workspace) -> list[Photograph]:
    """Return the photographs as they were taken, where those of the survey have fewer bits."""
    if survey.original_dir is None:
        return files
    folder = photograph_folder(workspace, survey.original_dir)
    hashes = {each.name: each.sha256 for each in survey.originals}
    return [
        replace(each, file=folder / each.name, sha256=hashes[each.name]) if each.name in hashes else each
        for each in files
    ]


def _statement(photograph: Photograph, *, thermal: bool) -> tuple[BandTags, Radiometry] | None:
    """Return the band and the radiometry that a photograph states; None: it is one of several colours."""
    data = read_bytes(photograph.file)
    require_unchanged(data, photograph.sha256, photograph.file)
    header = image_header(data)
    if header is None or header.channels > _MOST_GREY:
        return None
    tags = read_tags(data)
    radiometry = radiometry_of(tags, header, thermal=thermal)
    if radiometry.float_degrees:
        middle = float(np.nanmedian(_pixels(photograph.file, photograph.sha256)))
        if middle > _WARMEST_C:
            radiometry = replace(radiometry, offset=-ZERO_CELSIUS_K)
    return band_of(tags), radiometry


def _pixels(file: Path, sha256: str) -> Float32Array:
    """Return the stored numbers (H, W) of a photograph of one band, in full depth; NaN becomes their median."""
    data = read_bytes(file)
    require_unchanged(data, sha256, file)
    pixels = deep_pixels(data)
    if pixels is None:
        raise InputError("photograph-damaged", "The photograph cannot be read.", path=file)
    grey = np.asarray(pixels if pixels.ndim == 2 else pixels[..., 0], dtype=np.float32)
    return np.where(np.isfinite(grey), grey, np.nanmedian(grey)) if not np.isfinite(grey).all() else grey


def _instants(
    model: TrainedModel, survey: Survey, rig: _RigModel
) -> tuple[dict[int, list[int]], tuple[Remark, ...]]:
    """Return rows in the order of the bands, by camera of the training, and a remark of instants left out.

    An InputError: at no instant are all bands in the model.
    """
    index, names = rig.sparse.image_index(), rig.names
    beside: dict[str, list[str]] = {}
    for each in survey.companions:
        beside.setdefault(each.beside, []).append(each.name)
    columns: dict[int, list[int]] = {}
    cameras = [camera for camera in model.indices("train") if model.cameras[camera].name in index]
    for camera in cameras:
        name = model.cameras[camera].name
        rows = [index[each] for each in (name, *beside.get(name, ())) if each in index]
        of_band = {rig.sensor[row]: row for row in rows if row in rig.stated}
        if all(band in of_band for band in names):
            columns[camera] = [of_band[band] for band in names]
    if not columns:
        message = f"At no instant are all bands ({', '.join(names)}) in the SfM model."
        raise InputError("bands-never-together", message, field="--bands")
    if len(columns) == len(cameras):
        return columns, ()
    sentence = (
        f"{len(cameras) - len(columns)} of {len(cameras)} instants lack a band in the SfM model: bands.tif does "
        "without them."
    )
    return columns, (Remark(code="bands-instants-left-out", sentence=sentence),)


def _remarks(rig: _RigModel, bands: Bands) -> tuple[Remark, ...]:
    """Return what the values of the bands are not: reflectance, comparable, of a stated unit."""
    remarks = []
    of_row = {row: radiometry for row, (_, radiometry) in rig.stated.items()}
    if counts := [lens.sensor for lens in bands.lenses if lens.quantity == "counts"]:
        without = [row for row in of_row if rig.sensor[row] in counts and of_row[row].quantity == "counts"]
        missing = ", ".join(of_row[without[0]].missing) if without else "one scale in common"
        example = f" {rig.files[without[0]].name} states no {missing}." if without else f" They lack {missing}."
        sentence = (
            f"bands.tif has counts of {', '.join(counts)} as the photographs store them, and no reflectance or "
            f"temperature.{example}"
        )
        remarks.append(Remark(code="bands-as-counts", sentence=sentence))
    if relative := [lens for lens in bands.lenses if lens.quantity == "relative reflectance"]:
        factor = "one factor" if all(lens.comparable for lens in relative) else "a factor of each band"
        sentence = (
            f"bands.tif has relative reflectance of {', '.join(lens.sensor for lens in relative)}: it differs from "
            f"reflectance by {factor}, which only the photograph of a calibrated panel tells."
        )
        remarks.append(Remark(code="bands-relative", sentence=sentence))
    if assumed := [radiometry for radiometry in of_row.values() if radiometry.float_degrees]:
        unit = "kelvin" if assumed[0].offset else "degrees Celsius"
        sentence = f"The thermal photographs hold numbers without a unit: {unit} are assumed, by their values."
        remarks.append(Remark(code="bands-degrees-assumed", sentence=sentence))
    return tuple(remarks)
