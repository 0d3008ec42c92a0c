"""The small messages of a bag: which topics to read, and their samples, gathered in one pass and put on one clock.

Photographs pass by undecoded here, so that memory does not grow with them.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.products import Remark
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.bag import COMPRESSED, IMAGE, INFO, Bag, BagTopic, RawMessage, RosMessage, UndecodableError
from pipelines.ingest.bag_messages import ATTITUDES, POSITIONS, TRANSFORM_TYPES, Axes, Transforms, stamp_ns
from pipelines.ingest.bag_sources import RECEIVER_TYPES, TOPIC_CHOICE, ClockShift, clock_shifts, ranked_receivers
from pipelines.ingest.options import ALL_SENSORS, IngestOptions
from pipelines.ingest.remarks import Remarks, add

# Pictures that are no photographs.
_NOT_PHOTOS = ("depth", "disparity", "mask", "confidence", "segmentation", "thermal", "theora")
_TRANSPORTS = ("compressed", "theora", "ffmpeg", "zstd")  # last parts of topics, of `image_transport`
_ANY_IMAGE = re.compile(r"image([-_]?(raw|colou?r|mono|gr[ae]y|rgb|bgr|rect(ified)?|resized|proc|bayer))*")
UNNAMED_FRAME = "camera"  # stands for the frame of a camera whose driver states none
_DAY_NS = 86_400_000_000_000
# Notes of a bag that change nothing of what is read.
_HARMLESS_NOTES = ("bag-qos-differs",)
# A stamp this far off the others, against the recorder's clock, is no late message but a wrong clock.
_JUMP_NS = 60_000_000_000


@dataclass(frozen=True)
class SelectedTopics:
    """The topics to read, None where the bag has none; `remarks` names those that were not selected.

    `others` are image and lens topics of the other cameras, one of each, where all are asked for.
    `receivers_apart`: the caution of two receivers that are further apart than their σ; None: none are.
    """

    image: str | None
    info: str | None
    fix: str | None
    attitude: str | None
    remarks: tuple[Remark, ...]
    others: tuple[tuple[str, str | None], ...] = ()
    receivers_apart: Remark | None = None


def select_topics(bag: Bag, options: IngestOptions) -> SelectedTopics:
    """Select the topics to read: those that the options name, else by rule.

    Images: names that tell of depth, masks and the like come last, then topics with a `CameraInfo` beside them
    first, then those with more messages. Positions and attitudes: by the order of types in `bag_messages`
    (receivers before estimators before local frames), then those with more messages; of several receivers the
    better one, as `bag_sources` has it. Attitudes only where the first message has one. Equals go by name.

    Raises:
        InputError: a named topic is not there, or is of no type that fits.
    """
    remarks: list[Remark] = []
    apart: Remark | None = None
    choice: Remark | None = None
    images = sorted(_of(bag, (IMAGE, COMPRESSED)), key=lambda topic: _image_rank(bag, topic))
    image = _pick(
        bag, images, options.image_topic, flag="--image-topic", subject="photographs", remarks=remarks,
        choice=_choice_of_camera(images),
    )  # fmt: skip
    others: tuple[tuple[str, str | None], ...] = ()
    if options.sensor == ALL_SENSORS and image is not None:
        remarks = []  # the other topics are not passed over
        others = _other_cameras(bag, images, image)
    fixes = _by_type(bag, POSITIONS)
    receivers = [topic for topic in fixes if topic.type in RECEIVER_TYPES]
    if options.fix_topic is None and len(receivers) > 1:
        receivers, choice, apart = ranked_receivers(bag, receivers)
        fixes = receivers + [topic for topic in fixes if topic.type not in RECEIVER_TYPES]
    fix = _pick(
        bag, fixes, options.fix_topic, flag="--fix-topic", subject="positions", remarks=remarks, choice=choice
    )
    attitudes = _by_type(bag, ATTITUDES)
    if options.attitude_topic is None:
        attitudes = [topic for topic in attitudes if _has_attitude(bag, topic)]
    attitude = _pick(
        bag, attitudes, options.attitude_topic, flag="--attitude-topic", subject="attitudes", remarks=remarks
    )
    return SelectedTopics(image, _info_topic(bag, image), fix, attitude, tuple(remarks), others, apart)


def camera_of_topic(topic: str) -> str:
    """Return what topics of one camera have in common: their namespace, else the name without the transport.

    `/left/image_raw`, `/left/image_raw/compressed` and `/left/image_rect` are of `/left`; `/image_left` is its own.
    """
    parts = topic.split("/")
    if parts[-1] in _TRANSPORTS and len(parts) > 2:
        parts = parts[:-1]
    if _ANY_IMAGE.fullmatch(parts[-1]) and len(parts) > 2:
        parts = parts[:-1]
    return "/".join(parts)


def _choice_of_camera(images: list[BagTopic]) -> Remark | None:
    """Return the remark on topics of several cameras, which may be a rig; None: they are of one."""
    photos = [topic.name for topic in images if not _is_no_photo(topic)]
    if len({camera_of_topic(name) for name in photos}) < 2:
        return None
    first, *rest = (topic.name for topic in images)
    return Remark(
        code=TOPIC_CHOICE,
        sentence=f"The photographs are from {first}, not {', '.join(rest[:4])}.",
        remedy="--image-topic selects another topic, and --sensor all takes cameras that expose together as a rig.",
    )


def _other_cameras(bag: Bag, images: list[BagTopic], chosen: str) -> tuple[tuple[str, str | None], ...]:
    """Return the first image topic of each other camera, and its `CameraInfo`."""
    cameras: dict[str, tuple[str, str | None]] = {}
    for topic in images:
        camera = camera_of_topic(topic.name)
        if not _is_no_photo(topic) and camera != camera_of_topic(chosen):
            cameras.setdefault(camera, (topic.name, _info_beside(bag, topic.name)))
    return tuple(cameras.values())


def _of(bag: Bag, types: Container[str]) -> list[BagTopic]:
    return [topic for topic in bag.topics.values() if topic.count and topic.type in types]


def _by_type(bag: Bag, types: Iterable[str]) -> list[BagTopic]:
    order = list(types)
    return sorted(_of(bag, order), key=lambda topic: (order.index(topic.type), -topic.count, topic.name))


def _info_topic(bag: Bag, image: str | None) -> str | None:
    """Return the `CameraInfo` of an image topic: in its namespace, or the only one."""
    infos = _of(bag, (INFO,))
    beside = None if image is None else _info_beside(bag, image)
    return beside or (infos[0].name if len(infos) == 1 else None)


def _info_beside(bag: Bag, image: str) -> str | None:
    infos = {topic.name for topic in _of(bag, (INFO,))}
    parts = image.split("/")
    names = ("/".join([*parts[:depth], "camera_info"]) for depth in range(len(parts) - 1, 1, -1))
    return next((name for name in names if name in infos), None)


def _is_no_photo(topic: BagTopic) -> bool:
    return any(word in topic.name.lower() for word in _NOT_PHOTOS)


def _image_rank(bag: Bag, topic: BagTopic) -> tuple[bool, bool, int, str]:
    beside = _info_topic(bag, topic.name)
    near = beside is not None and topic.name.startswith(beside.removesuffix("camera_info"))
    return _is_no_photo(topic), not near, -topic.count, topic.name


def _has_attitude(bag: Bag, topic: BagTopic) -> bool:
    message = bag.first(topic.name)
    return message is not None and not ATTITUDES[topic.type](message).problem


def _pick(
    bag: Bag,
    candidates: list[BagTopic],
    requested: str | None,
    *,
    flag: str,
    subject: str,
    remarks: list[Remark],
    choice: Remark | None = None,
) -> str | None:
    names = [topic.name for topic in candidates]
    if requested is not None:
        if requested not in names:
            is_other = requested in bag.topics
            problem = f"is a {bag.topics[requested].type}" if is_other else "is not in the bag"
            fitting = f"Topics with {subject}: {', '.join(names)}" if names else f"No topic has {subject}"
            raise InputError(
                "topic-type" if is_other else "topic-unknown",
                f"{requested} {problem}. {fitting}.",
                path=bag.path,
                field=flag,
            )
        return requested
    if len(names) > 1:
        usual = f"The {subject} are from {names[0]}, not {', '.join(names[1:5])}."
        remedy = f"{flag} selects another topic."
        remarks.append(choice or Remark(code=TOPIC_CHOICE, sentence=usual, remedy=remedy))
    return names[0] if names else None


@dataclass
class TopicSamples:
    """Samples of one topic in the order of recording."""

    topic: str
    type: str
    width: int = 0
    # Nanoseconds of the message's own clock; 0 where it has none
    stamps: array[int] = field(default_factory=lambda: array("q"))
    bag_times: array[int] = field(default_factory=lambda: array("q"))  # nanoseconds of the recorder's clock
    values: array[float] = field(default_factory=lambda: array("d"))  # `width` numbers a sample
    receivers: list[str] = field(default_factory=list)  # the kind of receiver of each sample
    frame: str = ""  # of the first sample
    world: str = ""  # local frame of the first sample
    axes: Axes = "flu"  # of the frame
    problems: Counter[str] = field(default_factory=Counter)  # how many messages were left out, by reason
    # (N,) seconds on the clock of all topics, once all are read
    time_s: FloatArray = field(default_factory=lambda: np.empty(0))
    usable: BoolArray = field(default_factory=lambda: np.empty(0, dtype=bool))  # (N,) which samples are

    def add(self, stamp: int | None, bag_ns: int, values: tuple[float, ...] = (), receiver: str = "") -> None:
        self.stamps.append(stamp or 0)
        self.bag_times.append(bag_ns)
        self.values.extend(values)
        self.receivers.append(receiver)

    @property
    def messages(self) -> int:
        """Number of messages, with those that were left out."""
        return len(self.stamps) + sum(self.problems.values())

    def table(self) -> FloatArray:
        """Return the values (N, width)."""
        return np.frombuffer(self.values, dtype=np.float64).reshape(-1, self.width)


@dataclass(frozen=True)
class CameraStream:
    """A camera: the stamps of its pictures, whose frame is that of the first, and its lens."""

    images: TopicSamples
    info: Any | None  # first `CameraInfo`, or None
    info_topic: str | None


@dataclass(frozen=True)
class BagStreams:
    """The small messages of a bag."""

    path: Path
    camera: CameraStream  # of the photographs
    others: tuple[CameraStream, ...]  # cameras that may expose together with it, where these are asked for
    positions: TopicSamples | None  # latitude, longitude, height (or east, north, up) and their σ
    attitudes: TopicSamples | None  # quaternion xyzw frame → East-North-Up, and σ in degrees
    transforms: Transforms


def read_streams(bag: Bag, options: IngestOptions, remarks: Remarks, progress: Progress = SILENT) -> BagStreams:
    """Read everything but the pictures; messages that cannot be used are counted and noted.

    Raises:
        InputError: no photographs, a named topic that does not fit, or a topic whose messages are counted and that
            has none.
    """
    _note_files(bag, options, remarks)
    topics = select_topics(bag, options)
    if topics.image is None:
        raise InputError(
            "no-image-topic",
            "The bag has no topic of type sensor_msgs/Image or CompressedImage.",
            path=bag.path,
            remedy="`georef inspect` lists its topics.",
        )
    remarks.assume(
        "bag-topics",
        f"Photographs are from {topics.image}, the lens from {topics.info or 'none'}, positions from "
        f"{topics.fix or 'none'}, attitudes from {topics.attitude or 'none'}.",
    )
    for remark in topics.remarks:
        add(remarks.assumptions, remark)
    if topics.receivers_apart is not None:
        add(remarks.cautions, topics.receivers_apart)
    images, positions, attitudes = (
        None if topic is None else TopicSamples(topic, bag.topics[topic].type, width)
        for topic, width in ((topics.image, 0), (topics.fix, 6), (topics.attitude, 5))
    )
    assert images is not None
    pictures = {images.topic: images}
    pictures |= {name: TopicSamples(name, bag.topics[name].type) for name, _ in topics.others}
    transforms = Transforms()
    infos: dict[str, Any] = {}
    lenses = {topics.info, *(info for _, info in topics.others)} - {None}
    frames = [topic.name for topic in bag.topics.values() if topic.type in TRANSFORM_TYPES]
    wanted = {*pictures, *frames, *filter(None, (*lenses, topics.fix, topics.attitude))}
    undecodable: dict[str, list[str]] = {}
    read: Counter[str] = Counter()
    with progress.task("bag", sum(bag.topics[name].count for name in wanted)) as task:
        for message in bag.messages(wanted):
            task.advance()
            read[message.topic] += 1
            try:
                if (stamps := pictures.get(message.topic)) is not None:
                    stamps.add(bag.header_stamp_ns(message), message.bag_ns)
                    stamps.frame = stamps.frame or _frame(bag, message)
                elif message.topic in lenses:
                    infos[message.topic] = infos.get(message.topic) or bag.decode(message)
                elif message.topic in frames:
                    transforms.add(bag.decode(message), static=message.topic.endswith("static"))
                else:
                    _add_navigation(bag.decode(message), message, positions, attitudes)
            except UndecodableError as error:
                undecodable.setdefault(message.topic, []).append(str(error)[:120])
    series = [samples for samples in (*pictures.values(), positions, attitudes) if samples is not None]
    _require_read(bag, wanted, read, remarks)
    _note_losses(bag, series, undecodable, transforms.refused, remarks)
    _settle_clocks(series, remarks)
    camera, *others = (
        CameraStream(pictures[name], infos.get(info or ""), info)
        for name, info in ((images.topic, topics.info), *topics.others)
    )
    return BagStreams(bag.path, camera, tuple(others), positions, attitudes, transforms)


def _note_files(bag: Bag, options: IngestOptions, remarks: Remarks) -> None:
    """Note where `metadata.yaml` and the data files differ; refuse a topic to read whose messages are all lost."""
    for note in bag.notes:
        add(remarks.assumptions if note.code in _HARMLESS_NOTES else remarks.warnings, note)
    roles: tuple[tuple[str | None, Container[str]], ...] = (
        (options.image_topic, (IMAGE, COMPRESSED)), (options.fix_topic, POSITIONS),
        (options.attitude_topic, ATTITUDES), (None, (INFO, *TRANSFORM_TYPES)),
    )  # fmt: skip
    for topic in bag.lost.values():
        roles_of_type = [named for named, types in roles if topic.type in types]
        sentence = f"metadata.yaml counts {topic.count} messages of {topic.name}, and the data files have none."
        if any(named in (None, topic.name) for named in roles_of_type):
            remedy = (
                "Copy the bag again; if they are lost, `ros2 bag reindex` writes metadata.yaml anew without them."
            )
            raise InputError("topic-not-read", f"{sentence} {remedy}", path=bag.path, field=topic.name)
        remarks.warn("topic-not-read", sentence)


def _require_read(bag: Bag, wanted: Iterable[str], read: Counter[str], remarks: Remarks) -> None:
    """Refuse a topic of which no message was read though its file counts some; note those read in part."""
    if bag.damage is not None:
        return
    for topic in sorted(wanted):
        counted = bag.topics[topic].count
        sentence = f"The data files count {counted} messages of {topic}, and {read[topic]} were read"
        if counted and not read[topic]:
            remedy = "Repair the bag with `mcap recover` (mcap) or `ros2 bag reindex` (sqlite3)."
            raise InputError("topic-not-read", f"{sentence}. {remedy}", path=bag.path, field=topic)
        if read[topic] < counted:
            remarks.warn("topic-read-in-part", f"{sentence}.")


def _note_losses(
    bag: Bag, series: list[TopicSamples], undecodable: dict[str, list[str]], refused: int, remarks: Remarks
) -> None:
    for topic, errors in undecodable.items():
        remarks.warn(
            "message-damaged", f"{len(errors)} messages of {topic} do not decode and are left out: {errors[0]}."
        )
    if refused:
        remarks.warn(
            "transform-unusable", f"{refused} transforms in /tf are not finite or impossible, and are left out."
        )
    if bag.damage is not None:
        count = sum(samples.messages for samples in series)
        remarks.warn(
            "bag-damaged", f"{bag.path.name} is damaged: only {count} messages could be read ({bag.damage})."
        )
    if bag.fallback_types:
        remarks.assume(
            "message-definitions",
            f"The bag lacks definitions of {', '.join(sorted(bag.fallback_types))}: the usual ones are used.",
        )
    for samples in series:
        for problem, count in samples.problems.items():
            remarks.warn(
                "message-unusable",
                f"{count} of {samples.messages} messages of {samples.topic} are left out: {problem}.",
            )


def _frame(bag: Bag, message: RawMessage) -> str:
    """Return the frame of an image; one that does not decode is counted when the photographs are read."""
    try:
        return str(bag.decode(message).header.frame_id) or UNNAMED_FRAME
    except UndecodableError:
        return ""


def _add_navigation(
    decoded: RosMessage, message: RawMessage, positions: TopicSamples | None, attitudes: TopicSamples | None
) -> None:
    """Add a message to the positions, the attitudes, or both: one topic may have both."""
    if positions is not None and message.topic == positions.topic:
        position = POSITIONS[message.type](decoded)
        if position.problem:
            positions.problems[position.problem] += 1
        else:
            positions.frame = positions.frame or position.frame
            positions.world = positions.world or position.world
            values = (*position.coordinates, *position.sigma_enu_m)
            positions.add(stamp_ns(decoded), message.bag_ns, values, position.receiver)
    if attitudes is not None and message.topic == attitudes.topic:
        attitude = ATTITUDES[message.type](decoded)
        if attitude.problem:
            attitudes.problems[attitude.problem] += 1
        else:
            if not attitudes.frame:
                attitudes.frame, attitudes.axes = attitude.frame, attitude.axes
            attitudes.add(stamp_ns(decoded), message.bag_ns, (*attitude.quat_xyzw, attitude.sigma_deg))


def _settle_clocks(series: list[TopicSamples], remarks: Remarks) -> None:
    """Put the samples of all topics on one clock, in seconds: the messages' own stamps, where they have any.

    Messages without a stamp get the time of recording. Topics that count from another epoch than the rest (since
    boot) are brought to the recorder's clock by the median difference; if all do (a simulator's time), they keep
    it. Clocks that are a known number of seconds apart (`bag_sources`) become one. Left out are stamps that jump by
    more than a minute against the recorder's clock, and those that are not later than one before.
    """
    raw = {
        samples.topic: (np.array(samples.stamps, dtype=np.int64), np.array(samples.bag_times, dtype=np.int64))
        for samples in series
    }
    offset = {
        topic: int(np.median((stamp - bag)[stamp != 0])) if (stamp != 0).any() else 0
        for topic, (stamp, bag) in raw.items()
    }
    other_epoch = {topic for topic in raw if len(raw[topic][0]) and abs(offset[topic]) > _DAY_NS}
    shifts = clock_shifts_of(raw)
    mixed = bool(other_epoch) and len(other_epoch) < sum(len(stamp) > 0 for stamp, _ in raw.values())
    for topic, (stamp, bag) in raw.items():
        without = int((stamp == 0).sum())
        if without:
            remarks.assume(
                "messages-without-stamp",
                f"{without} messages of {topic} have no stamp: the time of recording is used.",
            )
        time = np.where(stamp == 0, bag + offset[topic], stamp)
        if topic in shifts:
            time = time - int(shifts[topic].shift_s * 1e9)
            add(remarks.assumptions if shifts[topic].shift_s else remarks.warnings, shifts[topic].remark)
        moved = int(shifts[topic].shift_s * 1e9) if topic in shifts else 0
        jump = np.abs(time - bag - offset[topic] + moved) > _JUMP_NS
        _note_left_out(remarks, "stamp-jump", jump, topic, "have a stamp more than a minute off the others")
        if mixed and topic in other_epoch:
            time = time - offset[topic]
            remarks.assume(
                "clock-epoch",
                f"Stamps of {topic} count from another epoch and are brought to the recorder's clock by their "
                "median.",
            )
        usable = ~jump
        latest = np.maximum.accumulate(np.where(usable, time, np.iinfo(np.int64).min))
        backwards = usable & np.concatenate([[False], time[1:] <= latest[:-1]])
        _note_left_out(
            remarks, "stamp-not-later", backwards, topic, "have a stamp that is not later than one before"
        )
        for samples in series:
            if samples.topic == topic:  # positions and attitudes may be of one topic
                samples.time_s, samples.usable = time / 1e9, usable & ~backwards


def clock_shifts_of(raw: Mapping[str, tuple[IntArray, IntArray]]) -> dict[str, ClockShift]:
    """Return the shifts of topics on other clocks, of stamps and times of recording (N,) of each, in nanoseconds.

    Topics without stamps have the recorder's clock; those that count from another epoch have no shift.
    """
    ahead, at_s = {}, 0.0
    for topic, (stamp, bag) in raw.items():
        known = stamp != 0
        if len(stamp) and not known.any():
            ahead[topic] = 0.0
        elif known.any() and abs(between := float(np.median((stamp - bag)[known]))) <= _DAY_NS:
            ahead[topic], at_s = between / 1e9, float(np.median(bag[known])) / 1e9
    return clock_shifts(ahead, at_s)


def _note_left_out(remarks: Remarks, code: str, bad: BoolArray, topic: str, reason: str) -> None:
    if bad.any():
        remarks.warn(code, f"{int(bad.sum())} of {len(bad)} messages of {topic} {reason}, and are left out.")
