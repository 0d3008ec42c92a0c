"""Which topics of a bag to use: by type, by rule where several fit, or as the user says."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

from pipelines.core.errors import InputError
from pipelines.formats.bag.images import COMPRESSED, IMAGE, INFO
from pipelines.formats.bag.reader import Bag, BagTopic
from pipelines.ingest.bag.messages import ATTITUDES, POSITIONS

# Pictures that are no photographs.
_NOT_PHOTOS = ("depth", "disparity", "mask", "confidence", "segmentation", "thermal", "theora")


@dataclass(frozen=True)
class RequestedTopics:
    """Topics that the user named."""

    image: str | None = None
    fix: str | None = None
    attitude: str | None = None


@dataclass(frozen=True)
class SelectedTopics:
    """The topics to read, None where the bag has none; `remarks` names those that were not selected."""

    image: str | None
    info: str | None
    fix: str | None
    attitude: str | None
    remarks: tuple[str, ...]


def select_topics(bag: Bag, requested: RequestedTopics) -> SelectedTopics:
    """Select the topics to read.

    Images: names that tell of depth, masks and the like come last, then topics with a `CameraInfo` beside them
    first, then those with more messages. Positions and attitudes: by the order of types in `messages`
    (receivers before estimators before local frames), then those with more messages. Attitudes only where the
    first message has one. Equals go by name.

    Raises:
        InputError: a named topic is not there, or is of no type that fits.
    """
    remarks: list[str] = []
    images = sorted(_of(bag, (IMAGE, COMPRESSED)), key=lambda topic: _image_rank(bag, topic))
    image = _pick(bag, images, requested.image, flag="--image-topic", subject="photographs", remarks=remarks)
    fixes = sorted(_of(bag, POSITIONS), key=lambda topic: (POSITIONS[topic.type].rank, -topic.count, topic.name))
    fix = _pick(bag, fixes, requested.fix, flag="--fix-topic", subject="positions", remarks=remarks)
    attitudes = sorted(
        _of(bag, ATTITUDES), key=lambda topic: (ATTITUDES[topic.type].rank, -topic.count, topic.name)
    )
    if requested.attitude is None:
        attitudes = [topic for topic in attitudes if _has_attitude(bag, topic)]
    attitude = _pick(
        bag, attitudes, requested.attitude, flag="--attitude-topic", subject="attitudes", remarks=remarks
    )
    return SelectedTopics(image, info_topic(bag, image), fix, attitude, tuple(remarks))


def info_topic(bag: Bag, image: str | None) -> str | None:
    """Return the `CameraInfo` of an image topic: in its namespace, or the only one."""
    infos = _of(bag, (INFO,))
    if image is not None:
        parts = image.split("/")
        for depth in range(len(parts) - 1, 1, -1):
            beside = "/".join([*parts[:depth], "camera_info"])
            if any(topic.name == beside for topic in infos):
                return beside
    return infos[0].name if len(infos) == 1 else None


def _of(bag: Bag, types: Container[str]) -> list[BagTopic]:
    return [topic for topic in bag.topics.values() if topic.count and topic.type in types]


def _image_rank(bag: Bag, topic: BagTopic) -> tuple[bool, bool, int, str]:
    name = topic.name.lower()
    beside = info_topic(bag, topic.name)
    near = beside is not None and topic.name.startswith(beside.removesuffix("camera_info"))
    return any(word in name for word in _NOT_PHOTOS), not near, -topic.count, topic.name


def _has_attitude(bag: Bag, topic: BagTopic) -> bool:
    message = bag.first(topic.name)
    return message is not None and not ATTITUDES[topic.type].read(message).problem


def _pick(
    bag: Bag, candidates: list[BagTopic], requested: str | None, *, flag: str, subject: str, remarks: list[str]
) -> str | None:
    names = [topic.name for topic in candidates]
    if requested is not None:
        if requested not in names:
            is_other = requested in bag.topics
            problem = f"is a {bag.topics[requested].type}" if is_other else "is not in the bag"
            fitting = f"those with {subject}: {', '.join(names)}" if names else f"no topic has {subject}"
            raise InputError(f"{requested} {problem}; {fitting}", path=bag.path, field=flag)
        return requested
    if len(names) > 1:
        remarks.append(f"{subject} are from {names[0]}, not {', '.join(names[1:5])}: see {flag}")
    return names[0] if names else None
