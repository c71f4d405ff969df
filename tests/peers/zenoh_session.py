"""A zenoh session over TCP, and what rmw_zenoh puts around messages, built by rosbags and eclipse-zenoh alone."""

import json
import time

import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


def open_session(role, endpoint, shared_memory=True, stamped=False):
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5(f"{role}/endpoints", json.dumps([endpoint]))
    config.insert_json5("transport/shared_memory/enabled", "true" if shared_memory else "false")
    if stamped:
        config.insert_json5("timestamping/enabled", "true")
    return zenoh.open(config)


def typestore(msgs=None):
    """The messages of Jazzy, and our own from the texts in msgs/."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(msgs.glob("msg/*.msg")) if msgs else []:
        store.register(get_types_from_msg(path.read_text(), f"nightflow_msgs/msg/{path.stem}"))
    return store


def dds_type(name):
    package, _, kind = name.split("/")
    return f"{package}::msg::dds_::{kind}_"


def wait_for(what, done, seconds=30):
    until = time.monotonic() + seconds
    while not done():
        if time.monotonic() > until:
            raise SystemExit(f"not within {seconds} s: {what}")
        time.sleep(0.005)
