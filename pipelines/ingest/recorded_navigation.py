"""The navigation as recorded, Earth-centred, until the survey's frame is known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geodesy.enu import Origin, enu_from_ecef, geo_from_enu_at, lla_from_ecef
from pipelines.geometry.rig import Rig
from pipelines.geometry.trajectory import Trajectory
from pipelines.scene.navigation import NavigationTrack


@dataclass(frozen=True)
class RecordedNavigation:
    """The navigation on its own clock, and how the cameras of N photographs sit in it.

    Attributes:
        positions: of the antenna, Earth-centred.
        attitudes: rotations body → East-North-Up at the antenna, forward-right-down.
        rig: of the N photographs, as `ingest` was told or as `/tf` has it.
        body_known: whether the body's axes are known; where not, the camera's nominal axes stand for them.
        images: names of the photographs.
        image_time_s: (N,) their times on the camera's clock.
        time_offset_s: navigation clock minus camera clock.
    """

    positions: Trajectory
    attitudes: Trajectory
    rig: Rig
    body_known: bool
    images: tuple[str, ...]
    image_time_s: FloatArray
    time_offset_s: float

    def in_geo(self, origin: Origin) -> NavigationTrack | None:
        """Return the navigation in the frame at an origin; None if it has no positions."""
        if not len(self.positions):
            return None
        mounts, arms = self.rig.of_each(len(self.images))
        return NavigationTrack(
            position_time_s=self.positions.time_s,
            antenna_in_geo=enu_from_ecef(self.positions.position, origin),
            sigma_m=self.positions.sigma_m,
            attitude_time_s=self.attitudes.time_s,
            geo_from_body=self._geo_from_body(origin),
            image=np.array(self.images, dtype=np.str_),
            image_time_s=self.image_time_s,
            cam_from_body=mounts,
            antenna_in_body=arms,
            nominal_from_cam=self.rig.nominal_from_cam,
            time_offset_s=np.array(self.time_offset_s),
            max_gap_s=np.array(self.positions.max_gap_s),
            body_known=np.array(self.body_known),
        )

    def _geo_from_body(self, origin: Origin) -> FloatArray:
        """Turn attitudes against north and up where each was taken into the frame at the origin.

        Where attitudes begin or end beyond the positions, the first or last position stands for the place: at
        45° latitude north turns by a second of arc in 30 m.
        """
        clock = self.positions.time_s
        time_s = np.clip(self.attitudes.time_s, clock[0], clock[-1])
        place = replace(self.positions, max_gap_s=np.inf).at(time_s).position
        return geo_from_enu_at(lla_from_ecef(place), origin) @ self.attitudes.rotation
