"""ROS bags, read a message at a time: rosbag2 folders, bare mcap and sqlite3 files, ROS 1 bags; their photographs.

Definitions of message types come from the bag, else from the ROS distribution. PX4's messages are in no
distribution: for them the layout of `DEFINITIONS` counts that fits the message. A damaged definition harms its own
topic only.
"""

import re
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.extras import require
from pipelines.core.types import ByteArray
from pipelines.formats.bag_files import (
    BagConnection,
    BagFiles,
    BagStorage,
    has_data_files,
    message_counts,
    open_files,
)
from pipelines.formats.bag_limits import refuse_large_chunk, unpacked
from pipelines.formats.image_file import MAX_BYTES, MAX_PIXELS, header_size
from pipelines.formats.px4_messages import DEFINITIONS

# Schemas of mcap that do not belong in a ROS bag; the reader cannot open a bag with them. ROS 1's do not belong
# beside messages in CDR.
_FOREIGN_SCHEMAS = ("jsonschema", "protobuf", "flatbuffer", "ros1msg")
# PX4 sends a message within milliseconds of its sample.
_SAMPLE_LAG_US = 60_000_000
_ZSTD = b"\x28\xb5\x2f\xfd"
_REPAIR = "repair it with `mcap recover` (mcap) or `ros2 bag reindex` (sqlite3, or metadata.yaml missing)"

RosMessage = Any  # decoded; its fields are those of the definition of its type
RosTypes = Mapping[str, Callable[..., RosMessage]]  # classes of messages by type
_Definition = Any  # rosbags.interfaces.MessageDefinition


class UndecodableError(ValueError):
    """A message that does not fit its definition, or whose definition is unknown."""


@dataclass(frozen=True)
class BagTopic:
    """Topic: name, message type (`sensor_msgs/msg/Imu`) and number of messages."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class RawMessage:
    """Message as stored; `bag_ns` is the time of recording, nanoseconds since 1970."""

    topic: str
    type: str
    bag_ns: int
    data: bytes


class Bag:
    """Open bag; see `open_bag`."""

    def __init__(self, path: Path, files: BagFiles) -> None:
        self.path, self._storages = path, files.storages
        links = [link for storage in self._storages for link in storage.connections]
        # Any file of a split bag may have the definition.
        self._definitions = {link.msgtype: link.msgdef for link in links if link.msgdef.data}
        is_bag1 = path.suffix == ".bag" and not path.is_dir()
        self._ros1 = {
            link.topic for link in links if is_bag1 or getattr(link.ext, "serialization_format", "") == "ros1"
        }
        self._stores: dict[tuple[str, bool], Any] = {}
        self.notes = tuple(files.notes)  # where metadata.yaml states something else than the data files hold
        self.damage: str | None = None  # reason why reading ended before the end of the bag
        self.fallback_types: set[str] = set()  # decoded by a definition that the bag itself does not have
        # Topics that metadata.yaml counts messages of, and that no data file has any of
        self.lost: dict[str, BagTopic] = {}
        counts = message_counts(self._storages)
        self.topics = {
            name: BagTopic(name, kind, count) for (name, kind), count in sorted(counts.items(), reverse=True)
        }
        for name, (kind, count) in files.stated.items():
            if count and not (name in self.topics and self.topics[name].count):
                self.lost[name] = BagTopic(name, kind, count)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Yield the messages of these topics, of each file by time of recording.

        Reading of a file ends early where it is damaged; `damage` then states the reason.
        """
        wanted = {name: self.topics[name].type for name in topics}
        for storage in self._storages:
            links = [link for link in storage.connections if wanted.get(link.topic) == link.msgtype]
            if links:
                yield from self._messages_of(storage, links)

    def _messages_of(self, storage: BagStorage, links: list[BagConnection]) -> Iterator[RawMessage]:
        stream = storage.messages(links)
        while True:
            try:
                link, bag_ns, data = next(stream)
                if not isinstance(bag_ns, int) or not isinstance(data, bytes | bytearray | memoryview):
                    raise TypeError(f"a message of {link.topic} is no bytes")  # SQLite has any type in any column
                data = bytes(data)
                # CDR begins with a zero: recorders compress message by message, whatever metadata.yaml states.
                if data.startswith(_ZSTD) and link.topic not in self._ros1:
                    data = unpacked(data, MAX_BYTES)
            except StopIteration:
                return
            except Exception as error:  # the library raises any error of its parsers
                self.damage = f"{type(error).__name__}: {error}"
                return
            yield RawMessage(link.topic, link.msgtype, bag_ns, data)

    def decode(self, message: RawMessage) -> Any:
        """Return the message as an object with the fields of its definition.

        Raises:
            UndecodableError: the message does not fit, or has no known definition.
        """
        store = self._store(message)
        deserialize = store.deserialize_ros1 if message.topic in self._ros1 else store.deserialize_cdr
        try:
            return deserialize(message.data, message.type)
        except Exception as error:  # hostile bytes make generated code raise any error
            raise UndecodableError(f"{type(error).__name__}: {error}") from error

    def first(self, topic: str) -> Any | None:
        """Return the first message of a topic that decodes, or None."""
        for attempt, message in enumerate(self.messages([topic])):
            try:
                return self.decode(message)
            except UndecodableError:
                if attempt >= 9:
                    break
        return None

    def header_stamp_ns(self, message: RawMessage) -> int | None:
        """Return the stamp of a message that begins with a `std_msgs/Header`, without decoding it; None if zero."""
        try:
            layout = "<II"
            if message.topic not in self._ros1:
                layout = "<iI" if message.data[1] & 1 else ">iI"
            sec, nanosec = struct.unpack_from(layout, message.data, 4)
        except (struct.error, IndexError):
            return None
        return sec * 1_000_000_000 + nanosec or None

    def _store(self, message: RawMessage) -> Any:
        kind, is_ros1 = message.type, message.topic in self._ros1
        if (kind, is_ros1) not in self._stores:
            stated = self._definitions.get(kind)
            if stated is None and kind in DEFINITIONS:
                self._stores[kind, is_ros1] = self._store_that_fits(message)
            else:
                self._stores[kind, is_ros1] = self._make_store(kind, stated, is_ros1)
        store = self._stores[kind, is_ros1]
        if isinstance(store, str):
            raise UndecodableError(store)
        return store

    def _make_store(self, kind: str, stated: _Definition | None, is_ros1: bool) -> Any:
        """Return a typestore that has `kind` by the bag's or a default definition, or the reason why none has."""
        if stated is not None:
            try:
                return _stated_store(stated, kind)
            except Exception as error:  # a grammar error, an unknown word, a repeated name …
                return f"its definition of {kind} cannot be read: {type(error).__name__}: {error}"
        self.fallback_types.add(kind)
        common = _common_store(is_ros1)
        return common if kind in common.types else f"it has no definition of {kind}"

    def _store_that_fits(self, message: RawMessage) -> Any:
        """Return a typestore with the layout of `DEFINITIONS` that fits `message`."""
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        for release, text in DEFINITIONS[message.type].items():
            store = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(text, message.type))
            try:
                decoded: Any = store.deserialize_cdr(message.data, message.type)
            except Exception:  # another length, or damaged
                continue
            sample = getattr(decoded, "timestamp_sample", 0)
            if sample and abs(sample - decoded.timestamp) > _SAMPLE_LAG_US:
                continue
            self.fallback_types.add(f"{message.type} (as of PX4 {release})")
            return store
        # The failure is not stored: the next message may be whole.
        raise UndecodableError(
            f"{len(message.data)} bytes are none of the layouts of {message.type} that are known here"
        )


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag for reading.

    Raises:
        BackendUnavailableError: rosbags is not installed.
        InputError: no bag, damaged beyond opening, or with chunks too large for memory.

    Examples:
        >>> from rosbags.rosbag2 import Writer
        >>> from rosbags.typesys import Stores, get_typestore
        >>> store = get_typestore(Stores.ROS2_JAZZY)
        >>> text = store.types["std_msgs/msg/String"]
        >>> with Writer(Path("flight"), version=9) as writer:
        ...     topic = writer.add_connection("/events", text.__msgtype__, typestore=store)
        ...     data = store.serialize_cdr(text("take-off"), text.__msgtype__)
        ...     writer.write(topic, 1_700_000_000_000_000_000, data)
        >>> with open_bag(Path("flight")) as bag:
        ...     [bag.decode(message).data for message in bag.messages(["/events"])]
        ['take-off']
    """
    if not path.exists():
        raise InputError("bag-missing", "The bag does not exist.", path=path, field="--bag")
    if path.is_dir() and not (path / "metadata.yaml").exists() and not has_data_files(path):
        message = "The folder has no metadata.yaml and no .mcap or .db3 files."
        remedy = "Give the folder of a bag."
        raise InputError("bag-metadata-missing", message, path=path, field="--bag", remedy=remedy)
    if not path.is_dir() and path.suffix not in (".bag", ".mcap", ".db3"):
        message = "The file is not a bag: give a rosbag2 folder, or a .mcap, .db3 or .bag file."
        raise InputError("not-a-bag", message, path=path, field="--bag")
    require("bags")
    with ExitStack() as stack:
        try:
            files = stack.enter_context(open_files(path))
        except InputError:
            raise
        except Exception as error:  # truncated and forged files make the parser raise any error
            raise _refusal(path, error) from error
        for storage in files.storages:
            chunks = getattr(storage, "chunks", ()) if path.suffix != ".bag" or path.is_dir() else ()
            refuse_large_chunk(path, max((chunk.uncompressed_size for chunk in chunks), default=0))
            for link in storage.connections:  # SQLite has any type in any place
                if not isinstance(link.topic, str) or not isinstance(link.msgtype, str):
                    message = f"The bag is damaged (topic {str(link.topic)[:40]!r}): {_REPAIR}"
                    raise InputError("bag-damaged", message, path=path)
        yield Bag(path, files)


def _refusal(path: Path, error: Exception) -> InputError:
    if isinstance(error, KeyError) and error.args[0] in _FOREIGN_SCHEMAS:
        message = f"A topic is in {error.args[0]!r}, not in ROS 2's messages: leave it out with `mcap filter`."
        return InputError("bag-foreign-schema", message, path=path)
    cause = f"{type(error).__name__}: {error}".rstrip(": ").rstrip(".")
    message = f"The file is not a bag, or it is damaged ({cause}): {_REPAIR}"
    return InputError("bag-damaged", message, path=path)


@lru_cache(maxsize=256)
def _stated_store(definition: _Definition, kind: str) -> Any:
    """Return a typestore with the types of a definition, in ROS's message language or in IDL.

    The code that decodes them is generated once.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    if definition.format == MessageDefinitionFormat.MSG:
        store.register(get_types_from_msg(definition.data, kind))
        return store
    rule = "=" * 80 + "\n"
    # rosbags' parser takes no directives; the definitions that they include follow below.
    text = re.sub(r"^[ \t]*#.*$", "", definition.data, flags=re.MULTILINE)
    texts = [text]
    if text.startswith(f"{rule}IDL: "):
        texts = [part.partition("\n")[2] for part in text.split(rule)[1:]]
    types: dict[str, Any] = {}
    for part in texts:
        types.update(get_types_from_idl(part))
    store.register(types)
    return store


@lru_cache
def _common_store(is_ros1: bool) -> Any:
    """Return a typestore with the types of a ROS distribution."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)


IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
_PNG_EFFORT = 1
_BAYER = ("rggb", "bggr", "gbrg", "grbg")
# Encoding → bytes a pixel.
_PIXEL_BYTES = {
    "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4, "mono8": 1, "8uc1": 1, "mono16": 2,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2,
    **{f"bayer_{pattern}{depth}": depth // 8 for pattern in _BAYER for depth in (8, 16)},
}  # fmt: skip
ENCODINGS = tuple(_PIXEL_BYTES)


class BadImageError(ValueError):
    """An image message that cannot become a photograph; the text states the reason."""


@dataclass
class ImageWriter:
    """Converts image messages to the bytes of a JPEG or PNG file.

    JPEG and PNG in a `CompressedImage` stay as they are. A raw `Image` becomes a PNG without loss, but for 16 bits,
    which become 8 by the same factor for the whole bag: the first image decides how many bits are in use.
    """

    bits: int | None = None

    def encoded(self, kind: str, message: RosMessage) -> tuple[bytes, str]:
        """Return the file's bytes and its suffix.

        Raises:
            BadImageError: unknown encoding, too few bytes, or too many pixels.
        """
        if kind == COMPRESSED:
            return _compressed(message)
        import cv2

        done, data = cv2.imencode(".png", self._pixels(message), [cv2.IMWRITE_PNG_COMPRESSION, _PNG_EFFORT])
        if not done:
            raise BadImageError("does not encode as PNG")
        return data.tobytes(), ".png"

    def _pixels(self, message: RosMessage) -> ByteArray:
        encoding = str(message.encoding).strip().lower()
        if encoding not in _PIXEL_BYTES:
            raise BadImageError(f"encoding {message.encoding!r} is none of {', '.join(ENCODINGS)}")
        width, height, step = int(message.width), int(message.height), int(message.step)
        data, used = np.asarray(message.data, dtype=np.uint8), width * _PIXEL_BYTES[encoding]
        if not 0 < width * height <= MAX_PIXELS:
            raise BadImageError(f"claims {width}×{height} pixels")
        if step < used or len(data) < step * height:
            raise BadImageError(f"{len(data)} bytes in rows of {step} are too few for {width}×{height} pixels")
        raw: ByteArray = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :used])
        if encoding.endswith("16"):
            pixels: NDArray[np.uint16] = raw.view(">u2" if message.is_bigendian else "<u2")
            if self.bits is None:
                needed = int(pixels.max(initial=1)).bit_length()
                self.bits = next(bits for bits in (8, 10, 12, 14, 16) if needed <= bits)
            raw = np.minimum(pixels >> (self.bits - 8), 255).astype(np.uint8)
            encoding = encoding[:-2] + "8"
        return _to_bgr(raw, encoding)


def _compressed(message: RosMessage) -> tuple[bytes, str]:
    data = np.asarray(message.data, dtype=np.uint8).tobytes()
    if len(data) > MAX_BYTES:
        raise BadImageError(f"has {len(data) / 2**20:.0f} MiB (limit {MAX_BYTES // 2**20})")
    size = header_size(data)
    if data[:2] == b"\xff\xd8":
        suffix = ".jpg"
    elif data[:4] == b"\x89PNG":
        suffix = ".png"
    else:
        raise BadImageError(f"is neither JPEG nor PNG (format {str(message.format)[:40]!r})")
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        raise BadImageError("has a damaged header")
    return data, suffix


def _to_bgr(raw: ByteArray, encoding: str) -> ByteArray:
    """Return BGR (height, width, 3) or grey (height, width) of rows of bytes."""
    import cv2

    height = len(raw)
    if encoding in ("mono8", "8uc1"):
        return raw
    if encoding.startswith("bayer_"):
        return np.asarray(cv2.cvtColor(raw, getattr(cv2, f"COLOR_Bayer{encoding[6:10].upper()}2BGR")), np.uint8)
    pixels = raw.reshape(height, -1, _PIXEL_BYTES[encoding])
    codes = {
        "rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR,
        "8uc4": cv2.COLOR_BGRA2BGR, "yuv422": cv2.COLOR_YUV2BGR_UYVY, "uyvy": cv2.COLOR_YUV2BGR_UYVY,
        "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2, "yuyv": cv2.COLOR_YUV2BGR_YUY2,
    }  # fmt: skip
    return pixels if encoding not in codes else np.asarray(cv2.cvtColor(pixels, codes[encoding]), np.uint8)
