"""Gyro, range and calibration on CycloneDDS: dds_sensors.py DOMAIN PREFIX

Sends each twice a second under PREFIX/imu, /range and /info with the same values until its standard input ends.
"""

import select
import sys
import time

from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.topic import Topic
from dds_messages import (
    CameraInfo,
    Header,
    Imu,
    Quaternion,
    Range,
    RegionOfInterest,
    Time,
    Vector3,
    dds_name,
    participant,
    sensor_qos,
)

domain, prefix = sys.argv[1], sys.argv[2]
at = participant(domain)
qos = sensor_qos()
header = Header(Time(7, 123456789), "sensor")
nine = [float(i) for i in range(9)]
messages = {
    "imu": Imu(header, Quaternion(0.0, 0.0, 0.6, 0.8), nine, Vector3(0.1, -0.2, 0.3), nine, Vector3(0.0, 0.5, 9.81), nine),
    "range": Range(header, 1, 0.5, 0.25, 40.0, 12.5, 0.0625),
    "info": CameraInfo(
        header, 480, 640, "plumb_bob", [0.1, -0.05, 0.001, 0.002, 0.0], [500.0, 0.0, 319.5, 0.0, 501.0, 239.5, 0.0, 0.0, 1.0],
        nine, [float(i) for i in range(12)], 2, 1, RegionOfInterest(1, 2, 3, 4, True),
    ),
}
publisher = Publisher(at)
writers = {
    name: DataWriter(publisher, Topic(at, dds_name(f"{prefix}/{name}"), type(message), qos=qos), qos=qos)
    for name, message in messages.items()
}
while not select.select([sys.stdin], [], [], 0.5)[0]:
    for name, message in messages.items():
        writers[name].write(message)
