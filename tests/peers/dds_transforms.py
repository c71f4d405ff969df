"""Where a camera sits, on CycloneDDS: dds_transforms.py DOMAIN TOPIC

Says it once, keeps it for those who come later (transient local, as static_transform_publisher does), prints "sent", and
lives until its standard input ends.
"""

import sys

from cyclonedds.core import Policy, Qos
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from dds_messages import Header, Quaternion, TFMessage, Time, Transform, TransformStamped, Vector3, dds_name, participant

domain, topic = sys.argv[1], sys.argv[2]
at = participant(domain)
qos = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=500)),
    Policy.History.KeepLast(1),
    Policy.Durability.TransientLocal,
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
transform = Transform(Vector3(0.1, -0.2, 0.3), Quaternion(0.0, 0.6, 0.0, 0.8))
writer = DataWriter(Publisher(at), Topic(at, dds_name(topic), TFMessage, qos=qos), qos=qos)
writer.write(TFMessage([TransformStamped(Header(Time(0, 0), "base_link"), "camera_optical", transform)]))
print("sent", flush=True)
sys.stdin.read()
