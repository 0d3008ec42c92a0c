"""Overlays in the viewer's scene: cameras, surveyed points with their errors, SfM points, measured points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from pipelines.adjust.accuracy_grid import AccuracyGrid
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.report.plots.plans import nice_number
from pipelines.report.plots.style import BLUE, DARK, ORANGE, colours_of
from pipelines.survey.survey import SurveyedPoint
from pipelines.survey.trained_survey import TrainedSurvey
from pipelines.view.pictures import ViewFrame

if TYPE_CHECKING:
    import viser

PointColour = Literal["of the photographs", "by σ horizontal", "by σ vertical"]
OverlayKind = Literal["cameras", "points", "errors", "tie points", "measured"]
_KINDS: tuple[OverlayKind, ...] = get_args(OverlayKind)
_MEASURED_RGB = (220, 30, 30)
_MOST_POINTS = 200_000  # SfM points that are drawn
_MOST_FRUSTUMS = 400  # cameras with a frustum to click on; of more, only the places are drawn
# In units of the viewer; the scene's radius is 10.
_CAMERA_SIZE, _MARKER_RADIUS, _POINT_SIZE = 0.15, 0.06, 0.012
_SNAP_PX = 6.0  # of a click, around an overlay
_LENGTH = 0.7  # of the longest error arrow, in units of the viewer


class Overlays:
    """Overlays in the scene of a server, in the viewer's frame."""

    def __init__(self, server: viser.ViserServer, trained: TrainedSurvey, frame: ViewFrame) -> None:
        self._scene, self._trained, self._frame = server.scene, trained, frame
        self._centers = frame.view_from_model.apply(trained.poses.cam_center_in_model)
        self._named: dict[str, FloatArray] = {}
        self._groups = {kind: self._scene.add_frame(f"/{kind}", show_axes=False) for kind in _KINDS}
        self._wanted = dict.fromkeys(_KINDS, True)
        self._hidden = False

    def place(self, point_in_geo: FloatArray) -> FloatArray:
        """Return places (…, 3) in the viewer's frame."""
        model_from_geo = self._trained.geo_from_model.inverse()
        return (self._frame.view_from_model @ model_from_geo).apply(point_in_geo)

    def show(self, kind: OverlayKind, visible: bool) -> None:
        self._wanted[kind] = visible
        self._groups[kind].visible = visible and not self._hidden

    def hide_all(self, *, hidden: bool) -> None:
        """Hide all overlays for a while, or show again those that are wanted."""
        self._hidden = hidden
        for kind, wanted in self._wanted.items():
            self.show(kind, wanted)

    def hit(self, start: FloatArray, direction: FloatArray, pixel_rad: float) -> int | str | None:
        """Return the overlay that a line of sight meets, the nearest to its start; None: it meets none.

        The overlay is a camera by its index, or a surveyed point by its name. The line has a start (3,) in the
        viewer's frame and a unit direction (3,); `pixel_rad` is the width of a pixel of the page.
        """
        overlays: list[tuple[FloatArray, float, int | str]] = []
        if self._groups["points"].visible:
            overlays += [(place, _MARKER_RADIUS, name) for name, place in self._named.items()]
        if self._groups["cameras"].visible:
            overlays += [(place, _CAMERA_SIZE, camera) for camera, place in enumerate(self._centers)]
        met = []
        for place, radius, overlay in overlays:
            along = float((place - start) @ direction)
            across = float(np.linalg.norm(place - start - along * direction))
            if along > 0 and across < max(radius, _SNAP_PX * pixel_rad * along):
                met.append((along, overlay))
        return min(met, key=lambda each: each[0])[1] if met else None

    def add_cameras(self) -> None:
        poses, frame = self._trained.poses, self._frame
        if len(self._centers) > _MOST_FRUSTUMS:
            self._scene.add_point_cloud(
                "/cameras/all", self._centers, _rgb(BLUE), point_size=_CAMERA_SIZE / 2, precision="float32"
            )
            return
        for index, center in enumerate(self._centers):
            lens = self._trained.sparse.camera_of(index)
            split = self._trained.model.cameras[index].split
            self._scene.add_camera_frustum(
                f"/cameras/{index}",
                fov=2 * float(np.arctan(lens.height / 2 / lens.mean_focal_px)),
                aspect=lens.width / lens.height,
                scale=_CAMERA_SIZE,
                thickness=1.5,
                thickness_units="screen",
                color=_rgb(BLUE if split == "train" else ORANGE),
                wxyz=wxyz_of(frame.view_from_model.rotation @ poses.cam_from_model[index].T),
                position=center,
            )

    def add_surveyed(self, points: Sequence[SurveyedPoint], kind: Literal["control", "check"]) -> None:
        for number, point in enumerate(points):
            place = self._named[point.name] = self.place(np.array(point.position_in_geo))
            name = f"/points/{kind}{number}"
            colour = _rgb(ORANGE if kind == "control" else DARK)
            self._scene.add_icosphere(name, radius=_MARKER_RADIUS, color=colour, position=place, subdivisions=2)
            self._scene.add_label(f"{name}/name", point.name, position=(0.0, 0.0, _MARKER_RADIUS))

    def add_errors(self, ends_in_geo: Sequence[tuple[FloatArray, FloatArray]]) -> float:
        """Draw arrows from surveyed to measured places (3,), enlarged so that they are seen; return by how much."""
        longest = max(float(np.linalg.norm(measured - surveyed)) for surveyed, measured in ends_in_geo)
        scale = self._frame.view_from_model.scale
        enlarged = nice_number(max(_LENGTH / max(longest * scale, 1e-12), 1.0))
        ends = [
            (self.place(surveyed), self.place(surveyed + enlarged * (measured - surveyed)))
            for surveyed, measured in ends_in_geo
        ]
        self._scene.add_arrows(
            "/errors/all", np.array(ends), _rgb(ORANGE), shaft_radius=0.015, head_radius=0.04, head_length=0.1
        )
        return enlarged

    def add_points(self, colour: PointColour, grid: AccuracyGrid | None) -> tuple[float, float] | None:
        """Draw the SfM points; return least and largest σ in metres where they are coloured by it."""
        point, shown = self._trained.point_in_model, self._trained.sfm.point_rgb
        every = max(1, -(-len(point) // _MOST_POINTS))
        point, shown = point[::every], shown[::every]
        limits = None
        if colour != "of the photographs" and grid is not None and len(point):
            cov = grid.cov_at(self._trained.geo_from_model.apply(point))
            sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
            values = np.hypot(sigma[:, 0], sigma[:, 1]) if colour == "by σ horizontal" else sigma[:, 2]
            low, high = np.quantile(values, [0.02, 0.98]).tolist()
            shown, limits = colours_of(values, low, high), (low, high)
        self._scene.add_point_cloud(
            "/tie points/all",
            self._frame.view_from_model.apply(point),
            shown,
            point_size=_POINT_SIZE,
            precision="float32",
        )
        return limits

    def show_measured(self, name: str, points_in_geo: FloatArray, *, closed: bool = False) -> None:
        """Draw measured points, and the line through them; without points, remove those of that name."""
        if not len(points_in_geo):
            self._scene.remove_by_name(f"/measured/{name}")
            return
        places = self.place(points_in_geo)
        self._scene.add_point_cloud(
            f"/measured/{name}/points",
            places,
            _MEASURED_RGB,
            point_size=_MARKER_RADIUS,
            point_shape="circle",
            precision="float32",
        )
        ends = np.roll(places, -1, axis=0) if closed else places[1:]
        if len(places) > 1:
            segments = np.stack([places[: len(ends)], ends], axis=1)
            self._scene.add_line_segments(
                f"/measured/{name}/line", segments, _MEASURED_RGB, thickness=3.0, thickness_units="screen"
            )


def wxyz_of(rotation: FloatArray) -> FloatArray:
    """Return the quaternion (4,) of a rotation (3, 3), real part first."""
    x, y, z, w = quat_xyzw_from_matrix(rotation)
    return np.array([w, x, y, z])


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
