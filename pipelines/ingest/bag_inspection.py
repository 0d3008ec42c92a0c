"""`georef inspect`: what a ROS bag holds, what `ingest` would select of it, and what is missing.

Reads the bag once, message by message; writes nothing.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipelines.core.progress import SILENT, Progress
from pipelines.formats.bag import Bag, RawMessage, UndecodableError, open_bag
from pipelines.ingest.bag_messages import BASE, GEODETIC_HEIGHTS, TRANSFORM_TYPES, Transforms
from pipelines.ingest.bag_streams import SelectedTopics, clock_shifts_of, select_topics
from pipelines.ingest.options import IngestOptions

# A gap is worth telling if it is this many times the usual step.
_GAP_STEPS = 3.0


@dataclass(frozen=True)
class TopicReport:
    """A topic."""

    name: str
    type: str
    use: str  # what `ingest` would take from it, or ""
    messages: int  # that could be read
    rate_hz: float | None  # by the median step between stamps; None for fewer than two messages
    first_s: float | None
    last_s: float | None
    longest_gap_s: float | None
    gaps: int  # steps of more than three times the median
    backwards: int  # stamps that are not later than the one before
    clock: str  # "stamp", or "recording" where messages have none
    frame: str  # of the first message, and its child frame
    problem: str  # why the type or its messages cannot be read


@dataclass(frozen=True)
class BagReport:
    """A bag: its topics, remarks on those that `ingest` would select, and what is missing."""

    path: str
    messages: int
    topics: tuple[TopicReport, ...]
    remarks: tuple[str, ...]
    missing: tuple[str, ...]


@dataclass
class _Tally:
    """Counts of one pass over a topic."""

    times: array[int] = field(default_factory=lambda: array("q"))
    recorded: array[int] = field(default_factory=lambda: array("q"))  # by the recorder's clock
    stamped: bool = False
    frame: str = ""
    child: str = ""
    problem: str = ""
    described: bool = False


def inspect_bag(path: Path, progress: Progress = SILENT) -> BagReport:
    """Report on a bag.

    Raises:
        InputError: it cannot be opened.
    """
    with open_bag(path) as bag:
        topics = select_topics(bag, IngestOptions())
        tallies = {name: _Tally() for name in bag.topics}
        transforms = Transforms()
        with progress.task("bag", sum(topic.count for topic in bag.topics.values())) as task:
            for message in bag.messages(list(bag.topics)):
                _count(bag, message, tallies[message.topic], transforms)
                task.advance()
        uses = {topics.image: "photographs", topics.info: "lens", topics.fix: "positions"}
        uses[topics.attitude] = "attitudes"
        if topics.fix is not None and topics.fix == topics.attitude:
            uses[topics.fix] = "positions, attitudes"
        reports = tuple(
            _report(name, bag.topics[name].type, uses.get(name, ""), tally)
            for name, tally in sorted(tallies.items())
        )
        reports += tuple(
            replace(
                _report(topic.name, topic.type, "", _Tally()),
                problem=f"metadata.yaml counts {topic.count} messages, and the data files have none",
            )
            for topic in bag.lost.values()
        )
        missing = _missing(bag, topics, tallies, transforms)
        count = sum(len(tally.times) for tally in tallies.values())
        remarks = (*(note.text for note in (*bag.notes, *topics.remarks)), *_clock_remarks(topics, tallies))
        return BagReport(str(path), count, reports, remarks, missing)


def _clock_remarks(topics: SelectedTopics, tallies: dict[str, _Tally]) -> list[str]:
    """Return what is to be said of topics to read whose stamps are on another clock than the others'."""
    raw = {}
    for topic in filter(None, (topics.image, topics.fix, topics.attitude)):
        times, recorded = (
            np.array(each, dtype=np.int64) for each in (tallies[topic].times, tallies[topic].recorded)
        )
        raw[topic] = (times if tallies[topic].stamped else np.zeros_like(times)), recorded
    return [shift.remark.text for shift in clock_shifts_of(raw).values()]


def _count(bag: Bag, message: RawMessage, tally: _Tally, transforms: Transforms) -> None:
    is_frames = message.type in TRANSFORM_TYPES
    if not tally.described or is_frames:
        tally.described = True
        try:
            decoded = bag.decode(message)
            if is_frames:
                transforms.add(decoded, static=message.topic.endswith("static"))
            header = getattr(decoded, "header", None)
            if header is not None:
                tally.stamped = bool(header.stamp.sec or header.stamp.nanosec)
                tally.frame = str(header.frame_id)
            tally.child = str(getattr(decoded, "child_frame_id", ""))
        except UndecodableError as error:
            tally.problem = str(error)[:200]
    stamp = bag.header_stamp_ns(message) if tally.stamped else None
    tally.times.append(stamp or message.bag_ns)
    tally.recorded.append(message.bag_ns)


def _report(name: str, kind: str, use: str, tally: _Tally) -> TopicReport:
    times = np.frombuffer(tally.times, dtype=np.int64) if len(tally.times) else np.empty(0, np.int64)
    steps = np.diff(times) / 1e9
    forward = steps[steps > 0]
    usual = float(np.median(forward)) if len(forward) else None
    return TopicReport(
        name=name,
        type=kind,
        use=use,
        messages=len(times),
        rate_hz=None if usual is None else 1.0 / usual,
        first_s=float(times.min() / 1e9) if len(times) else None,
        last_s=float(times.max() / 1e9) if len(times) else None,
        longest_gap_s=float(forward.max()) if len(forward) else None,
        gaps=int((forward > _GAP_STEPS * usual).sum()) if usual is not None else 0,
        backwards=int((steps <= 0).sum()),
        clock="stamp" if tally.stamped else "recording",
        frame=" → ".join(filter(None, (tally.frame, tally.child))),
        problem=tally.problem,
    )


def _missing(
    bag: Bag, topics: SelectedTopics, tallies: dict[str, _Tally], transforms: Transforms
) -> tuple[str, ...]:
    """Return what a survey would lack, and the remedies."""
    missing: list[str] = []
    for topic in bag.lost.values():
        missing.append(
            f"all {topic.count} messages of {topic.name}, which metadata.yaml counts and the data files do not have"
        )
    if bag.damage is not None:
        missing.append(f"the bag is damaged and could not be read to its end ({bag.damage})")
    if topics.image is None:
        missing.append("no photographs: no topic of sensor_msgs/Image or CompressedImage")
    if topics.info is None:
        missing.append("no CameraInfo for the photographs: the focal length is assumed, or give --focal-px")
    if topics.fix is None:
        missing.append("no positions: ground control points alone can place the model (--gcp)")
    elif bag.topics[topics.fix].type not in GEODETIC_HEIGHTS:
        missing.append(f"{topics.fix} is in a local frame: give --origin LAT,LON,HEIGHT of its zero")
    if topics.attitude is None:
        missing.append("no attitudes: a lever arm cannot be applied")
        return tuple(missing)
    if topics.image is None:
        return tuple(missing)
    body = tallies[topics.attitude].child or tallies[topics.attitude].frame or BASE
    body = body if body in transforms or BASE not in transforms else BASE
    camera, at = tallies[topics.image].frame, np.zeros(1)
    if transforms.between(body, camera, at) is None:
        missing.append(f"/tf does not link camera {camera!r} and body {body!r}: give --camera-mount YAW,PITCH,ROLL")
    antenna = tallies[topics.fix].child or tallies[topics.fix].frame or BASE if topics.fix else None
    if antenna is not None and transforms.between(body, antenna, at) is None:
        missing.append(f"/tf does not link antenna {antenna!r} and body {body!r}: give --lever-arm")
    return tuple(missing)
