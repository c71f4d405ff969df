//! What travels: the ROS 2 messages that Nightflow reads and writes, as plain structs with CDR in and out.

mod decoder;
pub mod definition;
mod definitions;
mod diagnostic;
mod encoder;
mod geometry;
mod nightflow;
mod px4;
pub mod rmw;
mod sensor;
mod standard;
mod tf2;

use std::{collections::HashMap, sync::OnceLock};

pub use definitions::Definitions;
pub use diagnostic::{DiagnosticArray, DiagnosticStatus, KeyValue};
pub use geometry::{
    Quaternion, Transform, TransformStamped, Twist, TwistStamped, TwistWithCovariance, TwistWithCovarianceStamped,
    Vector3, Vector3Stamped,
};
pub use nightflow::{EgoMotion, Status, Step, Width};
pub use px4::{ObstacleDistance, SensorOpticalFlow, VehicleOpticalFlow};
pub use sensor::{CameraInfo, CompressedImage, Image, Imu, LaserScan, Range, RegionOfInterest};
pub use standard::{Header, Time};
pub use tf2::TfMessage;

/// A ROS 2 message: its name, and by serde its CDR form.
pub trait Message: serde::Serialize + serde::de::DeserializeOwned + Send + Sync + 'static {
    /// The interface package, as in `sensor_msgs`.
    const PACKAGE: &'static str;
    /// The message, as in `Image`.
    const NAME: &'static str;
}

/// Why bytes are not the message that they should be, or a message can't become bytes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Error {
    /// The bytes are no CDR of this message, or the message has no CDR form.
    #[error("{message}: expected {expected}, found {found}")]
    Cdr {
        /// `sensor_msgs/msg/Image`, and the field where one is to blame: `sensor_msgs/msg/Image, header.frame_id`.
        message: String,
        /// What should have been there.
        expected: String,
        /// What was there.
        found: String,
    },
    /// A `.msg` text can't be read.
    #[error("{definition}, line {line}: {reason}")]
    Definition {
        /// `sensor_msgs/msg/Image`.
        definition: String,
        /// 1 for the first.
        line: usize,
        /// What is wrong.
        reason: String,
    },
}

/// Writes a message as CDR (XCDR1, little-endian, with its header of 4 bytes) in place of what `out` holds. Byte
/// sequences are copied as one; a buffer that is used again is not allocated again.
pub fn encode<M: Message>(message: &M, out: &mut Vec<u8>) -> Result<(), Error> {
    encoder::encode(message, out).map_err(|encoder::Refusal(reason)| Error::Cdr {
        message: ros_name::<M>(),
        expected: "a message that CDR can hold".to_owned(),
        found: reason,
    })
}

/// Reads a message from CDR (XCDR1, either byte order, with its header of 4 bytes). A length that the bytes do not bear
/// out is an error before anything is allocated for it.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<M, Error> {
    decoder::decode(bytes).map_err(|decoder::Fault(report)| {
        let message = ros_name::<M>();
        let message = if report.field.is_empty() { message } else { format!("{message}, {}", report.field) };
        Error::Cdr { message, expected: report.expected, found: report.found }
    })
}

/// `sensor_msgs/msg/Image`.
pub fn ros_name<M: Message>() -> String {
    format!("{}/msg/{}", M::PACKAGE, M::NAME)
}

/// `sensor_msgs::msg::dds_::Image_`, as DDS and rmw_zenoh name it.
pub fn dds_name<M: Message>() -> String {
    format!("{}::msg::dds_::{}_", M::PACKAGE, M::NAME)
}

/// The `ros2msg` schema: the message's `.msg` text, and below it each text that it needs.
pub fn schema<M: Message>() -> String {
    built_in(&ros_name::<M>()).schema.clone()
}

/// The type's hash, `RIHS01_…` (REP 2016).
pub fn type_hash<M: Message>() -> String {
    built_in(&ros_name::<M>()).hash.clone()
}

/// The definitions of every message here.
pub fn definitions() -> &'static Definitions {
    static ALL: OnceLock<Definitions> = OnceLock::new();
    ALL.get_or_init(|| {
        let mut all = Definitions::default();
        for (name, text) in TEXTS {
            if let Err(error) = all.insert(name, text) {
                // The texts are built in and a test reads them all, so this is never met outside of it.
                panic!("{error}");
            }
        }
        all
    })
}

struct BuiltIn {
    schema: String,
    hash: String,
}

/// Worked out once for all: a publisher asks at every start, a recorder for every topic.
fn built_in(name: &str) -> &'static BuiltIn {
    static ALL: OnceLock<HashMap<String, BuiltIn>> = OnceLock::new();
    let all = ALL.get_or_init(|| {
        let all = definitions();
        let built_in = |name: &str| Ok::<_, Error>(BuiltIn { schema: all.schema(name)?, hash: all.type_hash(name)? });
        all.names().filter_map(|name| Some((name.to_owned(), built_in(name).ok()?))).collect()
    });
    all.get(name)
        .unwrap_or_else(|| panic!("{name} implements Message, so its text and all that it needs belong into TEXTS"))
}

macro_rules! texts {
    ($($folder:literal $package:literal: $($name:literal)+;)+) => {
        [$($((
            concat!($package, "/msg/", $name),
            include_str!(concat!("../../msgs/", $folder, "msg/", $name, ".msg")),
        )),+),+]
    };
}

const TEXTS: [(&str, &str); 29] = texts! {
    "" "nightflow_msgs": "EgoMotion" "Status" "Step" "Width";
    "px4_msgs/" "px4_msgs": "ObstacleDistance" "SensorOpticalFlow" "VehicleOpticalFlow";
    "standard/builtin_interfaces/" "builtin_interfaces": "Time";
    "standard/diagnostic_msgs/" "diagnostic_msgs": "DiagnosticArray" "DiagnosticStatus" "KeyValue";
    "standard/geometry_msgs/" "geometry_msgs": "Quaternion" "Transform" "TransformStamped" "Twist" "TwistStamped" "TwistWithCovariance"
        "TwistWithCovarianceStamped" "Vector3" "Vector3Stamped";
    "standard/sensor_msgs/" "sensor_msgs": "CameraInfo" "CompressedImage" "Image" "Imu" "LaserScan" "Range"
        "RegionOfInterest";
    "standard/std_msgs/" "std_msgs": "Header";
    "standard/tf2_msgs/" "tf2_msgs": "TFMessage";
};
