//! What travels: the ROS 2 messages that Nightflow reads and writes, as plain structs with CDR in and out.

mod diagnostic;
mod geometry;
mod nightflow;
mod sensor;
mod standard;

pub use diagnostic::{DiagnosticArray, DiagnosticStatus, KeyValue};
pub use geometry::{
    Quaternion, Twist, TwistStamped, TwistWithCovariance, TwistWithCovarianceStamped, Vector3, Vector3Stamped,
};
pub use nightflow::{EgoMotion, Status, Step};
pub use sensor::{CameraInfo, Image, Imu, Range, RegionOfInterest};
pub use standard::{Header, Time};

/// A ROS 2 message: its name, and by serde its CDR form.
pub trait Message: serde::Serialize + serde::de::DeserializeOwned + Send + Sync + 'static {
    /// The interface package, as in `sensor_msgs`.
    const PACKAGE: &'static str;
    /// The message, as in `Image`.
    const NAME: &'static str;
}

/// Why bytes are not the message that they should be, or a message can't become bytes.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The bytes are no CDR of this message.
    #[error("{message}: expected {expected}, found {found}")]
    Cdr {
        /// `sensor_msgs/msg/Image`.
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
