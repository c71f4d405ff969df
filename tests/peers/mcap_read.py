"""Reads a recording with PyPI's mcap + mcap-ros2-support and with rosbags, and prints what each of them sees.

Lines: `summary TOPIC TYPE ENCODING COUNT QOS HASH`, `metadata NAME KEYS`, `message READER TOPIC LOG PUBLISH VALUES`.
"""

import sys
import zlib
from pathlib import Path

import numpy
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from ruamel.yaml import YAML


def flat(value, name=""):
    """Every leaf of a message as `path=value`; sequences of bytes as their length and CRC."""
    if isinstance(value, numpy.ndarray):
        value = bytes(value) if value.dtype == numpy.uint8 else value.tolist()
    if isinstance(value, (bytes, bytearray)):
        yield f"{name}={len(value)}:{zlib.crc32(value):08x}"
    elif isinstance(value, (list, tuple)):
        if value and all(isinstance(v, int) for v in value) and name.endswith("data"):
            yield from flat(bytes(value), name)
        else:
            for i, v in enumerate(value):
                yield from flat(v, f"{name}[{i}]")
    elif isinstance(value, (bool, int, float, str)):
        yield f"{name}={value}"
    elif hasattr(value, "__slots__") and not hasattr(value, "__dataclass_fields__"):
        for slot in value.__slots__:
            yield from flat(getattr(value, slot), f"{name}.{slot}" if name else slot)
    else:
        for field in value.__dataclass_fields__:
            if field != "__msgtype__":
                yield from flat(getattr(value, field), f"{name}.{field}" if name else field)


path = Path(sys.argv[1])
with open(path, "rb") as file:
    reader = make_reader(file, decoder_factories=[DecoderFactory()])
    header, summary = reader.get_header(), reader.get_summary()
    assert header.profile == "ros2", header
    assert summary is not None and summary.statistics is not None, "no summary"
    for channel in sorted(summary.channels.values(), key=lambda c: c.topic):
        schema = summary.schemas[channel.schema_id]
        qos = YAML(typ="safe").load(channel.metadata["offered_qos_profiles"])[0]
        count = summary.statistics.channel_message_counts[channel.id]
        print(
            "summary", channel.topic, schema.name, f"{schema.encoding}/{channel.message_encoding}", count,
            f"{qos['reliability']}/{qos['history']}/{qos['depth']}", channel.metadata["topic_type_hash"],
        )
    for record in reader.iter_metadata():
        print("metadata", record.name, ",".join(sorted(record.metadata)))
        if record.name == "rosbag2":
            bag = YAML(typ="safe").load(record.metadata["serialized_metadata"])
            assert bag["version"] == 9 and bag["storage_identifier"] == "mcap", bag
            assert bag["message_count"] == summary.statistics.message_count, bag
            assert bag["relative_file_paths"] == [path.name], bag
            for topic in bag["topics_with_message_count"]:
                about = topic["topic_metadata"]
                durability = "transient_local" if about["type"] == "tf2_msgs/msg/TFMessage" else "volatile"
                assert YAML(typ="safe").load(about["offered_qos_profiles"])[0]["durability"] == durability
    for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
        print("message mcap", channel.topic, message.log_time, message.publish_time, *flat(decoded))

with AnyReader([path]) as reader:
    seen = 0
    for connection, log_time, raw in reader.messages():
        decoded = reader.deserialize(raw, connection.msgtype)
        print("message rosbags", connection.topic, log_time, "-", *flat(decoded))
        seen += 1
    print("rosbags", seen)
