"""PX4's end of DDS: reads /fmu/in/... with CycloneDDS: px4_read.py DOMAIN NAMESPACE TOPIC...

Prints "listening", then "matched" when a writer of each topic was found, then each message as one line of JSON; what is
not a number is null. Ends with its standard input.
"""

import json
import math
import select
import sys
from dataclasses import dataclass, fields

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic
from dds_messages import dds_name, named, participant, sensor_qos


@dataclass
class SensorOpticalFlow(IdlStruct, typename=named("px4_msgs", "SensorOpticalFlow")):
    timestamp: t.uint64
    timestamp_sample: t.uint64
    device_id: t.uint32
    pixel_flow: t.array[t.float32, 2]
    delta_angle: t.array[t.float32, 3]
    delta_angle_available: bool
    distance_m: t.float32
    distance_available: bool
    integration_timespan_us: t.uint32
    quality: t.uint8
    error_count: t.uint32
    max_flow_rate: t.float32
    min_ground_distance: t.float32
    max_ground_distance: t.float32
    mode: t.uint8


@dataclass
class VehicleOpticalFlow(IdlStruct, typename=named("px4_msgs", "VehicleOpticalFlow")):
    timestamp: t.uint64
    timestamp_sample: t.uint64
    device_id: t.uint32
    pixel_flow: t.array[t.float32, 2]
    delta_angle: t.array[t.float32, 3]
    distance_m: t.float32
    integration_timespan_us: t.uint32
    quality: t.uint8
    max_flow_rate: t.float32
    min_ground_distance: t.float32
    max_ground_distance: t.float32


@dataclass
class ObstacleDistance(IdlStruct, typename=named("px4_msgs", "ObstacleDistance")):
    timestamp: t.uint64
    frame: t.uint8
    sensor_type: t.uint8
    distances: t.array[t.uint16, 72]
    increment: t.float32
    min_distance: t.uint16
    max_distance: t.uint16
    angle_offset: t.float32


KINDS = {
    "sensor_optical_flow": SensorOpticalFlow,
    "vehicle_optical_flow": VehicleOpticalFlow,
    "obstacle_distance": ObstacleDistance,
}


def plain(value):
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


domain, namespace, *topics = sys.argv[1:]
at = participant(domain)
subscriber = Subscriber(at)
readers = {}
for topic in topics:
    # As the agent reads: best effort.
    qos = sensor_qos(50)
    readers[topic] = DataReader(subscriber, Topic(at, dds_name(f"{namespace}/fmu/in/{topic}"), KINDS[topic], qos=qos), qos=qos)
print("listening", flush=True)
matched = False
while not select.select([sys.stdin], [], [], 0.005)[0]:
    if not matched and all(reader.get_matched_publications() for reader in readers.values()):
        matched = True
        print("matched", flush=True)
    for topic, reader in readers.items():
        for message in reader.take(N=50):
            if message.sample_info.valid_data:
                told = {field.name: plain(getattr(message, field.name)) for field in fields(message)}
                print(json.dumps(told | {"name": topic}, allow_nan=False), flush=True)
