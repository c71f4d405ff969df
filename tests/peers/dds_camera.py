"""A ROS 2 camera on CycloneDDS: dds_camera.py DOMAIN TOPIC WIDTH HEIGHT

Prints "matched" when somebody listens. Then does what its standard input says:
  frames N HZ   sends N frames, each with its index in its last 8 bytes, and prints "sent" and the newest index
  torn          sends what says to be an image and is none, and prints "torn"
It ends when its standard input does.
"""

import os
import struct
import sys
import time

from dataclasses import dataclass

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.topic import Topic
from dds_messages import Header, Image, Time, dds_name, named, participant, sensor_qos


@dataclass
class Torn(IdlStruct, typename=named("sensor_msgs", "Image")):
    """Says that it is an image and stops after its first fields."""

    header: Header
    height: t.uint32


domain, name, width, height = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
at = participant(domain)
qos = sensor_qos()
writer = DataWriter(Publisher(at), Topic(at, dds_name(name), Image, qos=qos), qos=qos)

# Serialised once by CycloneDDS; Python is too slow to do so for every frame. Stamp and index are patched in.
pixels = os.urandom(width * height * 2)
image = Image(Header(Time(0, 0), "camera_optical"), height, width, "bayer_rggb16", 0, width * 2, list(pixels[:8]))
short = bytes(image.serialize(use_version_2=False))
assert struct.unpack("<I", short[-12:-8])[0] == 8, short
frame = bytearray(short[:-12] + struct.pack("<I", len(pixels)) + pixels)
Image.serialize = lambda self, *_, **__: bytes(frame)


def say(word):
    print(word, flush=True)


while not writer.get_matched_subscriptions():
    time.sleep(0.01)
# A match is known here before the other side has its socket ready.
time.sleep(0.3)
say("matched")

index = 0
for line in sys.stdin:
    order = line.split()
    if order[0] == "frames":
        count, hz = int(order[1]), float(order[2])
        start = time.perf_counter()
        for i in range(count):
            time.sleep(max(0.0, start + i / hz - time.perf_counter()))
            now = time.time_ns()
            struct.pack_into("<iI", frame, 4, now // 10**9, now % 10**9)
            struct.pack_into("<Q", frame, len(frame) - 8, index)
            writer.write(image)
            index += 1
        say(f"sent {index - 1} {count / max(1e-9, time.perf_counter() - start):.1f}")
    elif order[0] == "torn":
        # A participant of its own, because one can't hold two types of the same name.
        other = participant(domain)
        tearing = DataWriter(Publisher(other), Topic(other, dds_name(name), Torn, qos=qos), qos=qos)
        while not tearing.get_matched_subscriptions():
            time.sleep(0.01)
        time.sleep(0.3)
        tearing.write(Torn(Header(Time(0, 0), "camera_optical"), height))
        say("torn")
