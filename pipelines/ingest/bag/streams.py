"""The small messages of a bag, read in one pass: stamps of the photographs, positions, attitudes, frames, lens.

Photographs pass by undecoded here, so that memory does not grow with them.
"""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.bag.reader import Bag, RawMessage, UndecodableError
from pipelines.ingest.bag import transforms as bag_transforms
from pipelines.ingest.bag.navigation import ATTITUDES, POSITIONS, Axes, stamp_ns
from pipelines.ingest.bag.topics import Choice
from pipelines.ingest.bag.transforms import Transforms
from pipelines.ingest.notes import Notes

DAY_NS = 86_400_000_000_000
# A stamp this far off the others, against the recorder's clock, is no late message but a wrong clock.
_JUMP_NS = 60_000_000_000


@dataclass
class Series:
    """Samples of one topic in the order of recording.

    Attributes:
        topic: its name.
        stamps: nanoseconds of the message's own clock; 0 where it has none.
        bag_times: nanoseconds of the recorder's clock.
        values: `width` numbers a sample.
        kinds: a word a sample.
        frame: of the first sample; `world`: its local frame; `axes`: of the frame.
        problems: how many messages were left out, by reason.
    """

    topic: str
    width: int = 0
    stamps: array = field(default_factory=lambda: array("q"))
    bag_times: array = field(default_factory=lambda: array("q"))
    values: array = field(default_factory=lambda: array("d"))
    kinds: list[str] = field(default_factory=list)
    frame: str = ""
    world: str = ""
    axes: Axes = "flu"
    problems: Counter[str] = field(default_factory=Counter)

    def add(self, stamp: int | None, bag_ns: int, values: tuple[float, ...] = (), kind: str = "") -> None:
        """Append a sample."""
        self.stamps.append(stamp or 0)
        self.bag_times.append(bag_ns)
        self.values.extend(values)
        self.kinds.append(kind)

    def table(self) -> FloatArray:
        """(N, width) values."""
        return np.frombuffer(self.values, dtype=np.float64).reshape(-1, self.width)


@dataclass(frozen=True)
class Streams:
    """What one pass over a bag found.

    Attributes:
        images: stamps of every message of the image topic; `image_frame`: frame of the first.
        positions: latitude, longitude, height (or east, north, up) and their σ.
        attitudes: quaternion xyzw frame → East-North-Up, and σ in degrees.
        transforms: the frames.
        info: first `CameraInfo`, or None.
    """

    images: Series
    image_frame: str
    positions: Series | None
    attitudes: Series | None
    transforms: Transforms
    info: Any | None


def read_streams(bag: Bag, choice: Choice, notes: Notes, progress: Progress = SILENT) -> Streams:
    """Read everything but the pictures; what could not be used is counted and noted."""
    assert choice.image is not None
    images = Series(choice.image)
    positions = Series(choice.fix, 6) if choice.fix else None
    attitudes = Series(choice.attitude, 5) if choice.attitude else None
    transforms, state = Transforms(), _Once()
    kinds = (bag_transforms.TYPE, bag_transforms.OLD_TYPE)
    frames = [topic.name for topic in bag.topics.values() if topic.type in kinds]
    wanted = {choice.image, *frames, *filter(None, (choice.info, choice.fix, choice.attitude))}
    undecodable: dict[str, list[str]] = {}
    total = sum(bag.topics[name].count for name in wanted)
    with progress.task("bag", total) as task:
        for message in bag.messages(wanted):
            task.advance()
            try:
                if message.topic == images.topic:
                    images.add(bag.header_stamp_ns(message), message.bag_ns)
                    state.image_frame = state.image_frame or _frame(bag, message)
                elif message.topic == choice.info:
                    state.info = state.info or bag.decode(message)
                elif message.topic in frames:
                    transforms.add(bag.decode(message), static=message.topic.endswith("static"))
                else:
                    _navigation(bag, message, positions, attitudes)
            except UndecodableError as error:
                undecodable.setdefault(message.topic, []).append(str(error)[:120])
    series = [one for one in (images, positions, attitudes) if one is not None]
    _note_losses(bag, series, undecodable, transforms.refused, notes)
    return Streams(images, state.image_frame, positions, attitudes, transforms, state.info)


@dataclass
class _Once:
    image_frame: str = ""
    info: Any | None = None


def _note_losses(
    bag: Bag, series: list[Series], undecodable: dict[str, list[str]], refused: int, notes: Notes
) -> None:
    for topic, errors in undecodable.items():
        notes.warn(f"{len(errors)} messages of {topic} do not decode and were left out: {errors[0]}")
    if refused:
        notes.warn(f"{refused} transforms in /tf are not finite or not possible and were left out")
    if bag.damage is not None:
        read = sum(_count(one) for one in series)
        notes.warn(f"{bag.path.name} is damaged: it could be read for {read} messages only ({bag.damage})")
    if bag.fallback_types:
        notes.assume(
            f"the bag lacks definitions of {', '.join(sorted(bag.fallback_types))}: the usual ones are used"
        )
    for one in series:
        for problem, count in one.problems.items():
            notes.warn(f"{count} of {_count(one)} messages of {one.topic} were left out: {problem}")


def _frame(bag: Bag, message: RawMessage) -> str:
    """Frame of an image; one that does not decode is counted when the photographs are read."""
    try:
        return str(bag.decode(message).header.frame_id) or "camera"
    except UndecodableError:
        return ""


def _count(series: Series) -> int:
    return len(series.stamps) + sum(series.problems.values())


def _navigation(bag: Bag, message: RawMessage, positions: Series | None, attitudes: Series | None) -> None:
    decoded = bag.decode(message)
    if positions is not None and message.topic == positions.topic:
        place = POSITIONS[message.type].read(decoded)
        if place.problem:
            positions.problems[place.problem] += 1
        else:
            positions.frame, positions.world = positions.frame or place.frame, positions.world or place.world
            positions.add(stamp_ns(decoded), message.bag_ns, (*place.place, *place.sigma_enu_m), place.kind)
    if attitudes is not None and message.topic == attitudes.topic:
        turn = ATTITUDES[message.type].read(decoded)
        if turn.problem:
            attitudes.problems[turn.problem] += 1
        else:
            if not attitudes.frame:
                attitudes.frame, attitudes.axes = turn.frame, turn.axes
            attitudes.add(stamp_ns(decoded), message.bag_ns, (*turn.quat_xyzw, turn.sigma_deg))


@dataclass(frozen=True)
class Clock:
    """When the samples of a topic were taken: seconds (N,), and which of them are usable (N,)."""

    time_s: FloatArray
    usable: BoolArray


def settle_clocks(series: list[Series], notes: Notes) -> dict[str, Clock]:
    """One time for all topics, in seconds: the messages' own stamps, where they have any.

    Messages without a stamp get the time of recording. Topics that count from another epoch than the rest (since
    boot) are brought to the recorder's clock by the median difference; if all do (a simulator's time), they keep
    it. Left out are stamps that jump by more than a minute against the recorder's clock, and those that are not
    later than one before.
    """
    raw = {
        one.topic: (np.array(one.stamps, dtype=np.int64), np.array(one.bag_times, dtype=np.int64)) for one in series
    }
    offset = {
        topic: int(np.median((stamp - bag)[stamp != 0])) if (stamp != 0).any() else 0
        for topic, (stamp, bag) in raw.items()
    }
    other_epoch = {topic for topic in raw if len(raw[topic][0]) and abs(offset[topic]) > DAY_NS}
    mixed = bool(other_epoch) and len(other_epoch) < sum(len(stamp) > 0 for stamp, _ in raw.values())
    clocks = {}
    for topic, (stamp, bag) in raw.items():
        without = int((stamp == 0).sum())
        if without:
            notes.assume(f"{without} messages of {topic} have no stamp: the time of recording is used")
        time = np.where(stamp == 0, bag + offset[topic], stamp)
        jump = np.abs(time - bag - offset[topic]) > _JUMP_NS
        _counted(notes, jump, topic, "have a stamp more than a minute off the others")
        if mixed and topic in other_epoch:
            time = time - offset[topic]
            notes.assume(
                f"stamps of {topic} count from another epoch: brought to the recorder's clock by their median"
            )
        usable = ~jump
        latest = np.maximum.accumulate(np.where(usable, time, np.iinfo(np.int64).min))
        backwards = usable & np.concatenate([[False], time[1:] <= latest[:-1]])
        _counted(notes, backwards, topic, "have a stamp that is not later than one before")
        clocks[topic] = Clock(time / 1e9, usable & ~backwards)
    return clocks


def _counted(notes: Notes, bad: BoolArray, topic: str, what: str) -> None:
    if bad.any():
        notes.warn(f"{int(bad.sum())} of {len(bad)} messages of {topic} {what}, and were left out")
