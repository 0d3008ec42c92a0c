"""Metashape's cameras with their poses and lenses (File ▸ Export ▸ Export Cameras, Agisoft XML).

A camera's `transform` leads from the camera (x right, y down, z forward) to the chunk, in the units of the chunk.
The transform of the chunk, or of a component of it, leads on to the Earth. Several components have a frame in
common only by their transforms. Calibrations have f, cx and cy from the middle of the image, b1 (fx − fy) and b2
(skew); P1 and P2 stand for OpenCV's p2 and p1. PhotoScan until 1.1, and MeshLab, write fx, fy and cx, cy from the
corner instead, with p1, p2 in OpenCV's order. Cameras that were not aligned have no transform, or one of zeros.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.products import Remark
from pipelines.core.sentences import listed
from pipelines.core.types import FloatArray
from pipelines.formats.solved_cameras import (
    LONGEST_SIDE_PX,
    PhotoSize,
    SolvedCameras,
    SolvedPhotograph,
    crs_name,
    not_placed,
    solved_cameras,
    vector_of,
)
from pipelines.formats.xml_events import OFF, XmlReader, read_xml
from pipelines.geometry.lens_fit import Brown, ForeignLens, brown_lens, fisheye_lens
from pipelines.geometry.similarity import Similarity

PROGRAM = "Metashape"
_MAX_BYTES = 256 * 1024 * 1024
_LONGEST_TEXT = 1 << 16
_MOST_CAMERAS = 1_000_000
_CALIBRATION = frozenset({"f", "fx", "fy", "cx", "cy", "b1", "b2", "skew"}) | {
    f"{letter}{number}" for letter in "kp" for number in (1, 2, 3, 4)
}
_OF_TRANSFORM = {"rotation": 9, "translation": 3, "scale": 1}
_FISHEYES = frozenset({"fisheye", "equidistant_fisheye", "equisolid_fisheye"})


@dataclass
class _Sensor:
    """Sensor: its type and size, calibrations by class, and whether it has a rolling shutter."""

    kind: str
    size: tuple[int, int] = (0, 0)
    calibrations: dict[str, dict[str, float]] = field(default_factory=dict)
    rolling: bool = False


@dataclass
class _Camera:
    """Camera: its label, sensor and component, and its pose camera → chunk, if it has one."""

    label: str
    sensor: str
    component: str
    enabled: bool
    pose: FloatArray | None = None  # (4, 4)


def read_metashape(path: Path, photo_size: PhotoSize) -> SolvedCameras:
    """Read the enabled and aligned cameras of a chunk.

    Raises:
        InputError: unreadable, not well-formed XML, several chunks, a value that is no number, no aligned
            camera, or what `solved_cameras` refuses.

    Examples:
        >>> _ = Path("cameras.xml").write_text(
        ...     '<document><chunk><sensors><sensor id="0" type="frame"><calibration type="frame">'
        ...     '<resolution width="400" height="300"/><f>350</f></calibration></sensor></sensors>'
        ...     '<cameras><camera id="0" sensor_id="0" label="a.jpg">'
        ...     '<transform>1 0 0 2 0 1 0 3 0 0 1 4 0 0 0 1</transform></camera></cameras></chunk></document>'
        ... )
        >>> solved = read_metashape(Path("cameras.xml"), lambda name: (400, 300))
        >>> solved.model.image_name, solved.model.focal_px.tolist()
        (('a.jpg',), [350.0])
    """
    reader = _Reader(path)
    read_xml(reader, limit_bytes=_MAX_BYTES, kind="file of cameras")
    cameras, remarks = _used(reader)
    frames, framed = _frames(reader, cameras)
    kept = [camera for camera in cameras if camera.component in frames]
    photographs = []
    for camera in kept:
        assert camera.pose is not None
        frame = frames[camera.component]
        center = frame.apply(camera.pose[:3, 3])
        photographs.append(
            SolvedPhotograph(camera.label, camera.sensor, frame.rotation @ camera.pose[:3, :3], center)
        )
    lenses = {key: _lens(key, sensor, path) for key, sensor in reader.sensors.items() if _has_lens(sensor)}
    remarks += [*framed, *_said_of_sensors(reader, {camera.sensor for camera in kept})]
    if reader.placed:
        remarks.append(not_placed(PROGRAM, crs_name(reader.crs)))
    return solved_cameras(path, PROGRAM, photographs, lenses, photo_size, remarks=remarks)


def _used(reader: _Reader) -> tuple[list[_Camera], list[Remark]]:
    """Return the cameras with a pose that are enabled, and what is said of the others."""
    posed = [camera for camera in reader.cameras if camera.pose is not None]
    off = [camera.label for camera in posed if not camera.enabled]
    remarks = []
    if off:
        sentence = f"{len(off)} cameras are disabled in {PROGRAM} and left out: {listed(off)}."
        remarks.append(Remark(code="disabled-cameras", sentence=sentence))
    missing = len(reader.cameras) - len(posed)
    if missing and posed:
        sentence = f"{missing} of {len(reader.cameras)} cameras were not aligned by {PROGRAM} and have no pose."
        remarks.append(Remark(code="cameras-without-pose", sentence=sentence))
    return [camera for camera in posed if camera.enabled], remarks


def _frames(reader: _Reader, cameras: list[_Camera]) -> tuple[dict[str, Similarity], list[Remark]]:
    """Return the similarity from the frame of each component that is taken to one common frame."""
    counts = Counter(camera.component for camera in cameras)
    if len(counts) < 2:
        return {key: Similarity() for key in counts}, []
    placed = {key: reader.similarity(key) for key in counts}
    known = {key: similarity for key, similarity in placed.items() if similarity is not None}
    if len(known) == len(counts):
        return known, []
    largest, most = counts.most_common(1)[0]
    sentence = (
        f"{PROGRAM} aligned {len(counts)} components without a common frame: the largest, of {most} cameras, is "
        f"taken, and {len(cameras) - most} cameras are left out."
    )
    return {largest: Similarity()}, [Remark(code="several-models", sentence=sentence)]


def _said_of_sensors(reader: _Reader, used: set[str]) -> list[Remark]:
    sensors = {key: sensor for key, sensor in reader.sensors.items() if key in used}
    remarks = []
    if any(sensor.rolling for sensor in sensors.values()):
        sentence = f"{PROGRAM} solved a rolling shutter: poses are taken, the motion during the readout is not."
        remarks.append(Remark(code="rolling-shutter-not-taken", sentence=sentence))
    initial = [key for key, each in sensors.items() if each.calibrations and not each.calibrations.get("adjusted")]
    if initial:
        sentence = f"The lens of sensor {listed(initial)} is {PROGRAM}'s initial calibration: none was adjusted."
        remarks.append(Remark(code="lens-not-adjusted", sentence=sentence))
    return remarks


def _has_lens(sensor: _Sensor) -> bool:
    return bool(_calibration(sensor)) and (sensor.kind == "frame" or sensor.kind in _FISHEYES)


def _calibration(sensor: _Sensor) -> dict[str, float]:
    """Return the values of the adjusted calibration, or else of another one; empty: there is none."""
    classes = ("adjusted", *sensor.calibrations)
    calibrations = (sensor.calibrations.get(name, {}) for name in classes)
    return next((values for values in calibrations if {"f", "fx"} & set(values)), {})


def _lens(key: str, sensor: _Sensor, path: Path) -> ForeignLens:
    values = _calibration(sensor)
    size = (int(values.get("width", sensor.size[0])), int(values.get("height", sensor.size[1])))
    of = {name: values.get(name, 0.0) for name in _CALIBRATION}
    from_corner = "fx" in values
    focal = (of["fx"], values.get("fy", of["fx"])) if from_corner else (of["f"] + of["b1"], of["f"])
    center = (of["cx"], of["cy"]) if from_corner else (size[0] / 2 + of["cx"], size[1] / 2 + of["cy"])
    if not min(focal) > 0:
        message = f"The sensor {key!r} has no focal length."
        raise InputError("focal-length-impossible", message, path=path, field="calibration")
    brown = Brown(
        size,
        focal,
        center,
        radial=(of["k1"], of["k2"], of["k3"], of["k4"]),
        tangential=(of["p1"], of["p2"]) if from_corner else (of["p2"], of["p1"]),
        growth=(of["p3"], of["p4"]),
        skew=of["skew"] if from_corner else of["b2"],
    )
    if sensor.kind in _FISHEYES:
        return fisheye_lens(brown, equisolid=sensor.kind == "equisolid_fisheye")
    return brown_lens(brown)


class _Reader(XmlReader):
    """Reader of one document, element by element."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.sensors: dict[str, _Sensor] = {}
        self.cameras: list[_Camera] = []
        self.crs = ""
        self._transforms: dict[str, dict[str, FloatArray]] = {}  # of components, and of the chunk: ""
        self._chunks = 0
        self._sensor: _Sensor | None = None
        self._class: str | None = None  # of the calibration that is open
        self._camera: _Camera | None = None
        self._component: str | None = None
        self._text = ""

    @property
    def placed(self) -> bool:
        return any(self._transforms.values())

    def similarity(self, component: str) -> Similarity | None:
        """Return the similarity component → Earth, or None if the file states none."""
        transform = self._transforms.get(component, {})
        if not {"rotation", "translation"} <= set(transform):
            return None
        scale = float(transform.get("scale", np.ones(1))[0])
        rotation = transform["rotation"].reshape(3, 3)
        if not scale > 0 or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            message = f"The transform of component {component!r} is no similarity."
            raise InputError("rotation-impossible", message, path=self.path, field="transform")
        return Similarity(scale, rotation, transform["translation"])

    def begin(self, name: str, values: dict[str, str], parent: str) -> None:
        self._text = ""
        if name == "chunk":
            self._chunks += 1
            if self._chunks > 1:
                raise self.fault("several-chunks", "the file has several chunks: export the cameras of one")
        elif name == "sensor" and parent == "sensors":
            self._sensor = self.sensors.setdefault(values.get("id", ""), _Sensor(values.get("type", "frame")))
        elif name == "calibration" and self._sensor is not None:
            self._class = values.get("class", "adjusted")
            self._sensor.calibrations.setdefault(self._class, {})
        elif name == "resolution" and self._sensor is not None:
            self._size(values, parent)
        elif name == "property" and self._sensor is not None and values.get("name") == "rolling_shutter":
            self._sensor.rolling = values.get("value", "").lower() not in {*OFF, ""}
        elif name == "component":
            self._component = values.get("id", "")
        elif name == "camera" and "label" in values and "cameras" in self.open:
            on = values.get("enabled", "true").lower() not in OFF
            label = values["label"]
            self._camera = _Camera(label, values.get("sensor_id", ""), values.get("component_id", ""), on)
            self.cameras.append(self._camera)
            if len(self.cameras) > _MOST_CAMERAS:
                raise self.fault("too-many-cameras", f"the file has more than {_MOST_CAMERAS} cameras, the limit")

    def end(self, name: str) -> None:
        parent = self.open[-1] if self.open else ""
        if (
            name in _CALIBRATION
            and parent == "calibration"
            and self._sensor is not None
            and self._class is not None
        ):
            self._sensor.calibrations[self._class][name] = float(self._numbers(name, 1)[0])
        elif name == "transform" and self._camera is not None and self._text.strip():
            pose = self._numbers(name, 16).reshape(4, 4)
            self._camera.pose = pose if pose.any() else None
        elif name in _OF_TRANSFORM and parent == "transform" and self._camera is None and self._text.strip():
            component = self._component if self._component is not None else ""
            self._transforms.setdefault(component, {})[name] = self._numbers(name, _OF_TRANSFORM[name])
        elif name == "reference" and parent == "chunk":
            self.crs = self._text.strip()
        elif name == "sensor":
            self._sensor = None
        elif name == "calibration":
            self._class = None
        elif name == "camera":
            self._camera = None
        elif name == "component":
            self._component = None
        self._text = ""

    def text(self, content: str) -> None:
        if self.open[-1:] == ["coeffs"]:  # of covariances, which are not read
            return
        self._text += content
        if len(self._text) > _LONGEST_TEXT:
            message = f"the text of <{self.open[-1]}> is longer than {_LONGEST_TEXT} characters, the limit"
            raise self.fault("xml-text-too-long", message)

    def _size(self, values: dict[str, str], parent: str) -> None:
        assert self._sensor is not None
        try:
            size = int(values["width"]), int(values["height"])
        except (KeyError, ValueError) as error:
            raise self.fault("not-a-number", "the resolution has no width and height", "resolution") from error
        if not 0 < min(size) <= max(size) <= LONGEST_SIDE_PX:
            raise self.fault(
                "lens-impossible", f"a picture has no {size[0]:.4g}×{size[1]:.4g} pixels", "resolution"
            )
        if parent == "calibration" and self._class is not None:
            self._sensor.calibrations[self._class] |= {"width": float(size[0]), "height": float(size[1])}
        else:
            self._sensor.size = size

    def _numbers(self, name: str, count: int) -> FloatArray:
        try:
            return vector_of([float(cell) for cell in self._text.split()], count)
        except ValueError as error:
            message = f"{' '.join(self._text.split())[:40]!r} is not {count} finite numbers"
            raise self.fault("not-a-number", message, name) from error
