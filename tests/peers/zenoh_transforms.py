"""Where a camera sits, over zenoh: zenoh_transforms.py ROLE ENDPOINT STYLE DOMAIN TOPIC

ROLE is connect or listen; STYLE is plain or rmw. Says it once, keeps it for those who come later, as rmw_zenoh does with a
transient local publisher, prints "sent", and lives until its standard input ends.
"""

import sys

import zenoh
from zenoh_session import dds_type, open_session, typestore

role, endpoint, style, domain, topic = sys.argv[1:6]
session = open_session(role, endpoint, stamped=True)
store = typestore()
T = store.types
name = "tf2_msgs/msg/TFMessage"
key = topic.lstrip("/")
if style == "rmw":
    key = f"{domain}/{key}/{dds_type(name)}/{store.hash_rihs01(name)}"
header = T["std_msgs/msg/Header"](T["builtin_interfaces/msg/Time"](0, 0), "base_link")
transform = T["geometry_msgs/msg/Transform"](
    T["geometry_msgs/msg/Vector3"](0.1, -0.2, 0.3), T["geometry_msgs/msg/Quaternion"](0.0, 0.6, 0.0, 0.8)
)
message = T[name]([T["geometry_msgs/msg/TransformStamped"](header, "camera_optical", transform)])
publisher = zenoh.ext.declare_advanced_publisher(
    session, key, cache=zenoh.ext.CacheConfig(max_samples=1), publisher_detection=True
)
publisher.put(bytes(store.serialize_cdr(message, name)))
print("sent", flush=True)
sys.stdin.read()
