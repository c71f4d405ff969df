"""A camera over zenoh: zenoh_camera.py ROLE ENDPOINT STYLE DOMAIN PREFIX WIDTH HEIGHT

ROLE is connect or listen; STYLE is plain, rmw, labelled (the attachment before rmw_zenoh 0.2.4) or unhashed (Humble's).
Prints "matched" when somebody listens to PREFIX/image, with the tokens of the ROS graph that it sees. Then does what its
standard input says:
  frames N HZ   sends N frames, each with its index in its last 8 bytes, and prints "sent" and the newest index
  skip N        leaves out N numbers of the attachment
  torn          sends half a frame and prints "torn"
  sensors       sends a calibration, a gyro sample and a range, and prints "sensors"
It ends when its standard input does.
"""

import os
import struct
import sys
import time

import numpy as np
import zenoh
from zenoh_session import dds_type, open_session, typestore, wait_for

role, endpoint, style, domain, prefix = sys.argv[1:6]
width, height = int(sys.argv[6]), int(sys.argv[7])
session = open_session(role, endpoint)
store = typestore()
T = store.types


def key(topic, name):
    if style == "plain":
        return topic.lstrip("/")
    digest = "TypeHashNotSupported" if style == "unhashed" else store.hash_rihs01(name)
    return f"{domain}/{topic.lstrip('/')}/{dds_type(name)}/{digest}"


class Publisher:
    def __init__(self, topic, name):
        self.name = name
        self.gid = os.urandom(16)
        self.sequence = 0
        self.publisher = session.declare_publisher(
            key(topic, name), congestion_control=zenoh.CongestionControl.BLOCK, express=True
        )

    def attachment(self):
        self.sequence += 1
        fields = [struct.pack("<q", self.sequence), struct.pack("<q", time.time_ns()), b"\x10" + self.gid]
        if style == "plain":
            return None
        if style == "labelled":
            names = [b"sequence_number", b"source_timestamp", b"source_gid"]
            fields = [bytes([len(n)]) + n + f for n, f in zip(names, fields)]
        return b"".join(fields)

    def put(self, payload):
        self.publisher.put(payload, attachment=self.attachment())

    def message(self, message):
        self.put(bytes(store.serialize_cdr(message, self.name)))


def header(sec, nanosec, frame):
    return T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](sec, nanosec), frame)


def vector(x, y, z):
    return T["geometry_msgs/msg/Vector3"](x, y, z)


images = Publisher(f"{prefix}/image", "sensor_msgs/msg/Image")
imus = Publisher(f"{prefix}/imu", "sensor_msgs/msg/Imu")
ranges = Publisher(f"{prefix}/range", "sensor_msgs/msg/Range")
infos = Publisher(f"{prefix}/info", "sensor_msgs/msg/CameraInfo")

pixels = np.frombuffer(os.urandom(width * height * 2), np.uint8)
image = T["sensor_msgs/msg/Image"](header(0, 0, "camera_optical"), height, width, "bayer_rggb16", 0, width * 2, pixels)
frame = bytearray(store.serialize_cdr(image, images.name))
end = len(frame) if frame.endswith(pixels.tobytes()) else frame.rfind(pixels.tobytes()[-64:]) + 64


def say(*words):
    print(*words, flush=True)


for publisher in (images, imus, ranges, infos):
    wait_for("a subscriber", lambda p=publisher: p.publisher.matching_status.matching)
tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get(f"@ros2_lv/{domain}/**", timeout=5)]
say("matched", *sorted(tokens))

nine = np.arange(9, dtype=np.float64)
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
            struct.pack_into("<Q", frame, end - 8, index)
            images.put(bytes(frame))
            index += 1
        say(f"sent {index - 1} {count / max(1e-9, time.perf_counter() - start):.1f}")
    elif order[0] == "skip":
        images.sequence += int(order[1])
    elif order[0] == "torn":
        images.put(bytes(frame[: len(frame) // 2]))
        say("torn")
    elif order[0] == "sensors":
        at = header(7, 123456789, "sensor")
        turn = T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8)
        imus.message(T[imus.name](at, turn, nine, vector(0.1, -0.2, 0.3), nine, vector(0.0, 0.5, 9.81), nine))
        ranges.message(T[ranges.name](at, 1, 0.5, 0.25, 40.0, 12.5, 0.0625))
        intrinsics = np.array([500.0, 0.0, 319.5, 0.0, 501.0, 239.5, 0.0, 0.0, 1.0])
        distortion = np.array([0.1, -0.05, 0.001, 0.002, 0.0])
        part = T["sensor_msgs/msg/RegionOfInterest"](1, 2, 3, 4, True)
        infos.message(
            T[infos.name](
                at, 480, 640, "plumb_bob", distortion, intrinsics, nine, np.arange(12, dtype=np.float64), 2, 1, part
            )
        )
        say("sensors")
session.close()
