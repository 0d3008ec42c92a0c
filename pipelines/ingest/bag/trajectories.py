"""The navigation of a bag on one clock: positions Earth-centred, attitudes against north and up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import VerticalDatum, assumed_ellipsoidal
from pipelines.geometry.rig import frame_from_frd
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.trajectory import Trajectory
from pipelines.ingest.bag.messages import POSITIONS, Axes
from pipelines.ingest.bag.streams import BagStreams, TopicSamples
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.position_sigma import RECEIVERS


@dataclass(frozen=True)
class BagNavigation:
    """Positions and attitudes of frames of the aircraft; trajectories without samples where there are none.

    Attributes:
        positions: Earth-centred, with the σ that the messages state.
        vertical: the datum that their heights counted from.
        receiver: kind of receiver, the worst that occurs.
        attitudes: rotations from forward, right, down of the body's frame to East-North-Up at its place, with σ.
        body_frame: name of that frame.
        body_axes: its own axes.
    """

    positions: Trajectory
    vertical: VerticalDatum
    receiver: str
    attitudes: Trajectory
    body_frame: str
    body_axes: Axes


def navigation_of(streams: BagStreams, options: IngestOptions, notes: Notes) -> BagNavigation:
    """Return the navigation of a bag.

    Raises:
        InputError: positions of a local frame without `--origin`, or a missing grid.
    """
    positions, vertical = _positions(streams, options, notes)
    receivers = [] if streams.positions is None else streams.positions.receivers
    attitudes = streams.attitudes
    return BagNavigation(
        positions=positions,
        vertical=vertical,
        receiver=max(receivers, key=RECEIVERS.index, default=RECEIVERS[-1]),
        attitudes=_attitudes(streams, options),
        body_frame="" if attitudes is None else attitudes.frame,
        body_axes="flu" if attitudes is None else attitudes.axes,
    )


def _positions(streams: BagStreams, options: IngestOptions, notes: Notes) -> tuple[Trajectory, VerticalDatum]:
    series = streams.positions
    if series is None or not len(series.stamps):
        if series is not None:
            notes.warn(f"no message of {series.topic} has a usable position")
        return Trajectory.from_samples(np.empty(0)), VerticalDatum(name="ellipsoidal", stated=True)
    values = series.table()
    if POSITIONS[series.type].geodetic:
        position_in_ecef, vertical = _geodetic(series, options, notes)
    else:
        position_in_ecef = ecef_from_enu(values[:, :3], _zero_of(series, streams, options))
        vertical = assumed_ellipsoidal("height of --origin taken as ellipsoidal")
        notes.assume(f"the frame {series.world!r} of {series.topic} is East-North-Up, with its zero at --origin")
    clock = streams.clocks[series.topic]
    positions = Trajectory.from_samples(
        clock.time_s[clock.usable],
        position=position_in_ecef[clock.usable],
        sigma_m=values[clock.usable, 3:6],
        max_gap_s=options.max_gap,
    )
    return positions, vertical


def _geodetic(series: TopicSamples, options: IngestOptions, notes: Notes) -> tuple[FloatArray, VerticalDatum]:
    """Return positions in ECEF (K, 3) of latitudes, longitudes and heights, and what the heights counted from."""
    crs, kind = parse_crs(WGS84, vertical=options.vertical), POSITIONS[series.type]
    if options.vertical is None:
        notes.assume(f"heights of {series.topic} are {kind.heights}; if its driver does otherwise, see --vertical")
    by_definition = VerticalDatum(name="ellipsoidal", stated=True, note=kind.heights)
    lla = crs.lla_from_xyz(series.table()[:, [1, 0, 2]])
    return ecef_from_lla(lla), crs.vertical if crs.vertical.stated else by_definition


def _zero_of(series: TopicSamples, streams: BagStreams, options: IngestOptions) -> Origin:
    if options.origin is None:
        raise InputError(
            f"{series.topic} has positions in the local frame {series.world!r} only: give --origin LAT,LON,HEIGHT "
            "of its zero (its axes being East-North-Up), or a topic with latitude and longitude as --fix-topic",
            path=streams.path,
            field="--origin",
        )
    lat_deg, lon_deg, alt_m = options.origin
    return Origin(lat_deg=lat_deg, lon_deg=lon_deg, alt_m=alt_m)


def _attitudes(streams: BagStreams, options: IngestOptions) -> Trajectory:
    series = streams.attitudes
    if series is None or not len(series.stamps):
        return Trajectory.from_samples(np.empty(0))
    clock = streams.clocks[series.topic]
    samples = series.table()[clock.usable]
    return Trajectory.from_samples(
        clock.time_s[clock.usable],
        rotation=matrix_from_quat_xyzw(samples[:, :4]) @ frame_from_frd(series.axes),
        sigma_deg=samples[:, 4],
        max_gap_s=options.max_gap,
    )
