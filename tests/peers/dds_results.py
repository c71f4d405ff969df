"""Reads Nightflow's results with CycloneDDS: dds_results.py DOMAIN NAMESPACE

Prints "listening", then "done" when enough of each topic came and all of it was right.
"""

import sys
import time

from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic
from dds_messages import (
    DiagnosticArray,
    EgoMotion,
    Image,
    LaserScan,
    Status,
    Step,
    TwistWithCovarianceStamped,
    dds_name,
    participant,
    reliable_qos,
    sensor_qos,
)
from results import Results

domain, namespace = sys.argv[1:3]
at = participant(domain)
subscriber = Subscriber(at)
results = Results(namespace)
types = {
    "geometry_msgs/msg/TwistWithCovarianceStamped": TwistWithCovarianceStamped,
    "nightflow_msgs/msg/EgoMotion": EgoMotion,
    "nightflow_msgs/msg/Step": Step,
    "nightflow_msgs/msg/Status": Status,
    "diagnostic_msgs/msg/DiagnosticArray": DiagnosticArray,
    "sensor_msgs/msg/Image": Image,
    "sensor_msgs/msg/LaserScan": LaserScan,
}


def reader(topic, kind, qos):
    return DataReader(subscriber, Topic(at, dds_name(topic), types[kind], qos=qos), qos=qos)


# Both kinds of reader must be served: velocity is asked for as sensors are, the rest as rmw does by default.
readers = {
    topic: reader(topic, kind, sensor_qos(50) if topic.endswith("/velocity") else reliable_qos())
    for topic, kind in results.kinds.items()
}
print("listening", flush=True)
until = time.monotonic() + 60
while not results.done():
    if time.monotonic() > until:
        raise SystemExit(f"not within 60 s: {results.missing()}")
    for topic, one in readers.items():
        for message in one.take(N=50):
            if message.sample_info.valid_data:
                results.check(topic, message)
    time.sleep(0.005)
print("done", flush=True)
