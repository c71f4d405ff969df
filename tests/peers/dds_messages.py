"""The ROS 2 messages that Nightflow reads and writes, as CycloneDDS types."""

from dataclasses import dataclass

import cyclonedds.idl.types as t
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.util import duration


def named(package, name):
    return f"{package}::msg::dds_::{name}_"


@dataclass
class Time(IdlStruct, typename=named("builtin_interfaces", "Time")):
    sec: t.int32
    nanosec: t.uint32


@dataclass
class Header(IdlStruct, typename=named("std_msgs", "Header")):
    stamp: Time
    frame_id: str


@dataclass
class Image(IdlStruct, typename=named("sensor_msgs", "Image")):
    header: Header
    height: t.uint32
    width: t.uint32
    encoding: str
    is_bigendian: t.uint8
    step: t.uint32
    data: t.sequence[t.uint8]


@dataclass
class RegionOfInterest(IdlStruct, typename=named("sensor_msgs", "RegionOfInterest")):
    x_offset: t.uint32
    y_offset: t.uint32
    height: t.uint32
    width: t.uint32
    do_rectify: bool


@dataclass
class CameraInfo(IdlStruct, typename=named("sensor_msgs", "CameraInfo")):
    header: Header
    height: t.uint32
    width: t.uint32
    distortion_model: str
    d: t.sequence[t.float64]
    k: t.array[t.float64, 9]
    r: t.array[t.float64, 9]
    p: t.array[t.float64, 12]
    binning_x: t.uint32
    binning_y: t.uint32
    roi: RegionOfInterest


@dataclass
class Vector3(IdlStruct, typename=named("geometry_msgs", "Vector3")):
    x: t.float64
    y: t.float64
    z: t.float64


@dataclass
class Quaternion(IdlStruct, typename=named("geometry_msgs", "Quaternion")):
    x: t.float64
    y: t.float64
    z: t.float64
    w: t.float64


@dataclass
class Transform(IdlStruct, typename=named("geometry_msgs", "Transform")):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename=named("geometry_msgs", "TransformStamped")):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename=named("tf2_msgs", "TFMessage")):
    transforms: t.sequence[TransformStamped]


@dataclass
class Imu(IdlStruct, typename=named("sensor_msgs", "Imu")):
    header: Header
    orientation: Quaternion
    orientation_covariance: t.array[t.float64, 9]
    angular_velocity: Vector3
    angular_velocity_covariance: t.array[t.float64, 9]
    linear_acceleration: Vector3
    linear_acceleration_covariance: t.array[t.float64, 9]


@dataclass
class Range(IdlStruct, typename=named("sensor_msgs", "Range")):
    header: Header
    radiation_type: t.uint8
    field_of_view: t.float32
    min_range: t.float32
    max_range: t.float32
    range: t.float32
    variance: t.float32


@dataclass
class LaserScan(IdlStruct, typename=named("sensor_msgs", "LaserScan")):
    header: Header
    angle_min: t.float32
    angle_max: t.float32
    angle_increment: t.float32
    time_increment: t.float32
    scan_time: t.float32
    range_min: t.float32
    range_max: t.float32
    ranges: t.sequence[t.float32]
    intensities: t.sequence[t.float32]


@dataclass
class Twist(IdlStruct, typename=named("geometry_msgs", "Twist")):
    linear: Vector3
    angular: Vector3


@dataclass
class TwistWithCovariance(IdlStruct, typename=named("geometry_msgs", "TwistWithCovariance")):
    twist: Twist
    covariance: t.array[t.float64, 36]


@dataclass
class TwistWithCovarianceStamped(IdlStruct, typename=named("geometry_msgs", "TwistWithCovarianceStamped")):
    header: Header
    twist: TwistWithCovariance


@dataclass
class KeyValue(IdlStruct, typename=named("diagnostic_msgs", "KeyValue")):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename=named("diagnostic_msgs", "DiagnosticStatus")):
    level: t.uint8
    name: str
    message: str
    hardware_id: str
    values: t.sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename=named("diagnostic_msgs", "DiagnosticArray")):
    header: Header
    status: t.sequence[DiagnosticStatus]


@dataclass
class Step(IdlStruct, typename=named("nightflow_msgs", "Step")):
    header: Header
    older_stamp: Time
    step: t.uint64
    state: t.uint8
    cause: str
    width: t.uint32
    height: t.uint32
    scale_x: t.float32
    scale_y: t.float32
    gain: t.float32
    raw_mean: t.float32
    saturated: t.float32
    confidence: t.float32
    velocity_lacks: str


@dataclass
class EgoMotion(IdlStruct, typename=named("nightflow_msgs", "EgoMotion")):
    header: Header
    older_stamp: Time
    scale: t.uint8
    distance: t.float64
    twist: TwistWithCovariance
    samples: t.uint32
    inliers: t.uint32
    quality: t.uint8


@dataclass
class Status(IdlStruct, typename=named("nightflow_msgs", "Status")):
    header: Header
    state: t.uint8
    cause: str
    frames: t.uint64
    displaced: t.uint64
    steps: t.uint64
    spoiled: t.uint64
    unpaired: t.uint64
    lost: t.uint64
    last_error: str
    rate: t.float32
    latency_ms: t.float32
    step_ms: t.float32
    noise_a: t.float32
    noise_b: t.float32
    snr_db: t.float32
    noise_level: t.float32


def participant(domain):
    return DomainParticipant(int(domain))


def sensor_qos(depth=5):
    """rmw's sensor data: best effort, keep last, volatile; XCDR1 as ROS 2 sends it."""
    return Qos(
        Policy.Reliability.BestEffort,
        Policy.History.KeepLast(depth),
        Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def reliable_qos(depth=50):
    """rmw's default, with room for a slow reader."""
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=500)),
        Policy.History.KeepLast(depth),
        Policy.Durability.Volatile,
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def dds_name(topic):
    return "rt" + topic
