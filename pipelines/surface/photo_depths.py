"""Depth maps of the photographs, as depth cameras and renderers write them: geometry in the frame of the cameras.

1. A map belongs to the photograph of its name. It shows what the photograph shows, at any size, or is of a pinhole
   camera with the photograph's place and axes that the user states.
2. A value times the stated unit is a depth along the optical axis, or a distance along the ray. What the depth maps
   of stereo fit decides between the two where the user says nothing, and contradicts a wrong unit.
3. Pixels beside a step of the depth mix two surfaces and are dropped. The points lie in the frame of the solved
   cameras: no CRS is needed, and the photographs' centres are the places from which they were measured.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy import ndimage

from pipelines.core.errors import InputError
from pipelines.core.products import Remark
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import Float32Array, FloatArray
from pipelines.formats.depth_image import DEPTH_SUFFIXES, read_depth_image
from pipelines.geodesy.enu import Origin
from pipelines.geometry.cameras import undistort
from pipelines.geometry.statistics import mad_sigma
from pipelines.surface.depth_maps import DepthMaps
from pipelines.surface.measured_cloud import MeasuredCloud, ReadTally, Thinning, suffixes_in
from pipelines.survey.options import CLOUD_SUFFIXES
from pipelines.survey.scene import SparseScene

log = logging.getLogger(__name__)

Along = Literal["axis", "ray"]
_ENDINGS = ("_depth", "-depth", ".depth", "_depthmap")
_STEP = 1.05  # of the depth between neighbours, on each side: they lie on two surfaces
_MOST_ASPECT = 0.01  # relative difference of the two scales between map and photograph
_CHECKED_VIEWS, _CHECKED_PIXELS = 24, 20_000
_LEAST_PIXELS = 200
_OFF_UNIT = 0.02  # of the depth: beyond, the unit is wrong, or the camera of the maps
_CLEARLY = 0.7  # of the other's scatter
_LEAST_DIFFERENCE = 0.001  # of the scatters, relative to the depth


@dataclass(frozen=True)
class DepthStatement:
    """The user's statements on depth maps: metres of a value, direction, camera (fx, fy, cx, cy); None: unknown."""

    unit_m: float
    along: Along | None = None
    camera: tuple[float, float, float, float] | None = None
    sigma_m: float = np.inf


@dataclass(frozen=True)
class DepthRays:
    """Pixels of one map: rays (N, 3) with z = 1 in the camera's frame, and values (N,) in metres."""

    ray: FloatArray
    value_m: FloatArray

    def depth_m(self, along: Along) -> FloatArray:
        """Return the depths (N,) along the optical axis."""
        return self.value_m if along == "axis" else self.value_m / np.linalg.norm(self.ray, axis=1)


def holds_depth_maps(path: Path) -> bool:
    """Return whether a path is of depth maps: pictures beside clouds and meshes are previews and textures."""
    suffixes = suffixes_in(path)
    return bool(suffixes & DEPTH_SUFFIXES) and not suffixes & CLOUD_SUFFIXES


class PhotoDepths:
    """Depth maps of photographs of a scene; see `MeasuredFiles`.

    Args:
        path: a folder of maps, also in subfolders, or one map.

    Attributes:
        along: direction of the depths, once `check` has been called.

    Raises:
        InputError: no map belongs to a photograph, or two do.
    """

    crs_names: tuple[str, ...] = ()

    def __init__(self, path: Path, scene: SparseScene, stated: DepthStatement) -> None:
        self._scene, self.stated = scene, stated
        self.along: Along = stated.along or "axis"
        self.path_of, self._unmatched = _matched(path, scene)
        if not self.path_of:
            message = (
                f"None of the {len(self._unmatched)} depth maps, such as {self._unmatched[0]!r}, has the name of a "
                "photograph of the model: IMG_1.png or IMG_1_depth.png belongs to IMG_1.JPG."
            )
            raise InputError("depth-names", message, path=path, field="--lidar")
        self._train = [int(index) for index in scene.train if int(index) in self.path_of]
        self.held_out = [int(index) for index in scene.test if int(index) in self.path_of]
        if not self._train:
            message = "All depth maps are of test photographs, which do not take part in the training."
            raise InputError("depth-names", message, path=path, field="--lidar")
        self.tally = ReadTally()
        self.notes: tuple[Remark, ...] = ()
        self._remarks: list[Remark] = []
        if self._unmatched:
            sentence = (
                f"{len(self._unmatched)} of {len(self._unmatched) + len(self.path_of)} depth maps belong to no "
                f"photograph of the model, such as {self._unmatched[0]}."
            )
            self._remarks.append(Remark(code="depth-unmatched", sentence=sentence))

    @property
    def assumptions(self) -> tuple[Remark, ...]:
        return tuple(self._remarks)

    @property
    def stations_in_geo(self) -> FloatArray:
        """Places (S, 3) from which the points were measured: the centres of all cameras."""
        return self._scene.geo_from_model.apply(self._scene.poses.cam_center_in_model)

    def check(self, maps: DepthMaps) -> None:
        """Compare the depth maps with those of stereo, and decide along what the depths count.

        Raises:
            InputError: unit or direction of the depths differ from what is stated.
        """
        ratios: dict[Along, list[FloatArray]] = {"axis": [], "ray": []}
        every = max(len(self._train) // _CHECKED_VIEWS, 1)
        for index in self._train[::every]:
            rays = self._rays(index, most=_CHECKED_PIXELS)
            stereo = np.asarray(maps.depth(index))
            pinhole = maps.camera(index)
            pixel = np.floor(pinhole.project(rays.ray))
            inside = np.flatnonzero(pinhole.contains(pixel + 0.5))
            column, row = pixel[inside].astype(np.int64).T
            depth = stereo[row, column].astype(np.float64)
            seen = depth > 0
            for along, values in ratios.items():
                values.append(depth[seen] / rays.depth_m(along)[inside][seen])
        quotients = {along: np.concatenate(values) for along, values in ratios.items()}
        count = len(quotients["axis"])
        if count < _LEAST_PIXELS:
            message = f"Only {count} pixels of the depth maps show what stereo shows, too few for a comparison."
            raise InputError("no-overlap", message, field="--lidar")
        middle = {along: float(np.median(values)) for along, values in quotients.items()}
        scatter = {along: mad_sigma(values / middle[along] - 1.0) for along, values in quotients.items()}
        self._decide(scatter)
        self._check_unit(middle[self.along], count)
        log.info(
            "depth maps: stereo over measured depth %.4f, scatter %.4f along the axis, %.4f along rays, %d pixels",
            middle[self.along], scatter["axis"], scatter["ray"], count,
        )  # fmt: skip

    def _decide(self, scatter: dict[Along, float]) -> None:
        better: Along = "axis" if scatter["axis"] <= scatter["ray"] else "ray"
        worse: Along = "ray" if better == "axis" else "axis"
        clear = scatter[better] < _CLEARLY * scatter[worse]
        clear = clear and scatter[worse] - scatter[better] > _LEAST_DIFFERENCE
        what = (
            f"stereo scatters about them by {scatter['axis']:.2%} if they count along the optical axis, and by "
            f"{scatter['ray']:.2%} if along the ray"
        )
        if self.stated.along is not None:
            if clear and better != self.stated.along:
                message = f"The depths do not count along the {self.stated.along}: {what}."
                remedy = f"Give --depth-along {better}."
                raise InputError("depth-along-differs", message, field="--depth-along", remedy=remedy)
            return
        self.along = better if clear else "axis"
        name = "optical axis" if self.along == "axis" else "ray"
        reason = what if clear else f"{what}, which does not decide"
        sentence = f"The depths were taken along the {name}: {reason}."
        remedy = "--depth-along states it."
        self._remarks.append(Remark(code="depth-along-assumed", sentence=sentence, remedy=remedy))

    def _check_unit(self, middle: float, count: int) -> None:
        if abs(middle - 1.0) <= _OFF_UNIT:
            return
        fits = self.stated.unit_m * middle
        message = (
            f"Depths of stereo are {middle:.4g} times those of the maps (median of {count} pixels): a value is "
            f"about {fits:.4g} m, and --depth-unit states {self.stated.unit_m:.6g} m."
        )
        remedy = "Check the unit, --depth-camera, and the scale of the georeference."
        raise InputError("depth-unit-differs", message, field="--depth-unit", remedy=remedy)

    def chunks(
        self, origin: Origin, progress: Progress = SILENT, thinning: Thinning | None = None
    ) -> Iterator[MeasuredCloud]:
        """Yield the points of the training photographs' maps in geo; of a thinning, two to the side of a voxel."""
        poses, to_geo = self._scene.poses, self._scene.geo_from_model
        with progress.task("depths", len(self._train)) as task:
            for index in self._train:
                rays = self._rays(index, spacing_m=0.0 if thinning is None else thinning.voxel_m / 2)
                in_cam = rays.depth_m(self.along)[:, None] * rays.ray
                in_model = in_cam @ poses.cam_from_model[index] + poses.cam_center_in_model[index]
                count = len(in_model)
                self.tally.read += count
                yield MeasuredCloud(
                    to_geo.apply(in_model), np.zeros(count, np.uint8), np.ones(count, np.int64),
                    np.full(count, np.nan), 0.0, np.full(count, index, np.int64),
                )  # fmt: skip
                task.advance(1)

    def _rays(self, index: int, *, spacing_m: float = 0.0, most: int | None = None) -> DepthRays:
        """Return the known pixels of a map, `spacing_m` apart on the surface at most, or about `most` of them."""
        path, camera = self.path_of[index], self._scene.sparse.camera_of(index)
        image = read_depth_image(path)
        height, width = image.value.shape
        if self.stated.camera is None:
            scale = np.array([camera.width / width, camera.height / height])
            if abs(scale[0] / scale[1] - 1) > _MOST_ASPECT:
                message = (
                    f"The map of {width}×{height} pixels has not the shape of its photograph, {camera.width}"
                    f"×{camera.height}: it is cut, turned or of another camera."
                )
                remedy = (
                    "State its camera with --depth-camera fx,fy,cx,cy, or write maps that show what the "
                    "photographs show."
                )
                raise InputError("depth-size", message, path=path, field="--depth-camera", remedy=remedy)
        if image.is_half or image.step * self.stated.unit_m / np.sqrt(12) > self.stated.sigma_m:
            self._note_step(path, image.is_half)
        value = without_steps(image.value)
        known = np.isfinite(value)
        if not known.any():
            return DepthRays(np.zeros((0, 3)), np.zeros(0))
        if most is not None:
            stride = max(int(np.sqrt(known.sum() / most)), 1)
        else:
            stated = self.stated.camera
            focal_px = camera.mean_focal_px * width / camera.width if stated is None else stated[0]
            stride = max(int(spacing_m * focal_px / (np.median(value[known]) * self.stated.unit_m)), 1)
        row, column = np.nonzero(known[stride // 2 :: stride, stride // 2 :: stride])
        row, column = row * stride + stride // 2, column * stride + stride // 2
        pixel = np.column_stack([column, row]) + 0.5
        if self.stated.camera is None:
            slope = undistort(camera, pixel * scale)
        else:
            focal, center = np.array(self.stated.camera[:2]), np.array(self.stated.camera[2:])
            slope = (pixel - center) / focal
        ray = np.column_stack([slope, np.ones(len(slope))])
        good = np.isfinite(ray).all(axis=1)
        return DepthRays(ray[good], value[row, column][good].astype(np.float64) * self.stated.unit_m)

    def _note_step(self, path: Path, is_half: bool) -> None:
        if any(remark.code == "depth-resolution" for remark in self._remarks):
            return
        what = "floats of 16 bits, with three decimal digits" if is_half else "integers of a coarse unit"
        sentence = f"{path.name}: the depths are {what}: their rounding may exceed their stated σ."
        remedy = "--lidar-sigma states it."
        self._remarks.append(Remark(code="depth-resolution", sentence=sentence, remedy=remedy))


def without_steps(value: Float32Array) -> Float32Array:
    """Return a depth map (H, W) without pixels beside a step of the depth; unknown ones are NaN."""
    known = np.isfinite(value)
    nearest = ndimage.minimum_filter(np.where(known, value, np.inf), size=3)
    furthest = ndimage.maximum_filter(np.where(known, value, 0.0), size=3)
    return np.where(known & (furthest <= _STEP * nearest), value, np.nan).astype(np.float32)


def _matched(path: Path, scene: SparseScene) -> tuple[dict[int, Path], list[str]]:
    """Return the maps of a path by the photograph to which their names belong, and the names of the others."""
    root = path if path.is_dir() else path.parent
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    by_name: dict[str, list[int]] = {}
    for index, name in enumerate(scene.sparse.image_name):
        whole = Path(name)
        for key in {whole.as_posix(), whole.with_suffix("").as_posix(), whole.name, whole.stem}:
            by_name.setdefault(key.lower(), []).append(index)
    maps: dict[int, Path] = {}
    unmatched = []
    for file in files:
        if file.suffix.lower() not in DEPTH_SUFFIXES or not file.is_file():
            continue
        place = file.relative_to(root).with_suffix("").as_posix().lower()
        indices = _photographs_of(place, by_name)
        if len(indices) > 1:
            names = ", ".join(scene.sparse.image_name[index] for index in indices[:2])
            message = f"The name belongs to {names}: put the maps into folders as the photographs."
            raise InputError("depth-names", message, path=file, field="--lidar")
        if not indices:
            unmatched.append(file.name)
        elif indices[0] in maps:
            message = f"{maps[indices[0]].name} is another depth map of {scene.sparse.image_name[indices[0]]}."
            raise InputError("depth-names", message, path=file, field="--lidar")
        else:
            maps[indices[0]] = file
    return maps, unmatched


def _photographs_of(place: str, by_name: dict[str, list[int]]) -> list[int]:
    """Return the photographs of a map's name without its suffix; the whole path counts before the name alone."""
    names = [place, *(place.removesuffix(ending) for ending in _ENDINGS if place.endswith(ending))]
    for name in (*names, *(name.rpartition("/")[2] for name in names)):
        if name in by_name:
            return by_name[name]
    return []
