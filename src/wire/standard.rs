//! `builtin_interfaces` and `std_msgs`: the time and the header that other messages are made of.

use serde::{Deserialize, Serialize};

use super::Message;

/// `builtin_interfaces/Time`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Time {
    /// Seconds since the epoch.
    pub sec: i32,
    /// Nanoseconds within the second.
    pub nanosec: u32,
}

impl Message for Time {
    const PACKAGE: &'static str = "builtin_interfaces";
    const NAME: &'static str = "Time";
}

/// `std_msgs/Header`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Header {
    /// When the content was measured.
    pub stamp: Time,
    /// The frame of reference that the content is given in.
    pub frame_id: String,
}

impl Message for Header {
    const PACKAGE: &'static str = "std_msgs";
    const NAME: &'static str = "Header";
}
