//! `nightflow_msgs`: our own messages, field by field as in `msgs/msg/`.

use serde::{Deserialize, Serialize};

use super::{Header, Message, Time, TwistWithCovariance};

/// `nightflow_msgs/Step`: what one step found; depends on the frames alone.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Step {
    pub header: Header,
    pub older_stamp: Time,
    pub step: u64,
    pub state: u8,
    pub cause: String,
    pub width: u32,
    pub height: u32,
    pub scale_x: f32,
    pub scale_y: f32,
    pub gain: f32,
    pub raw_mean: f32,
    pub saturated: f32,
    pub confidence: f32,
    pub velocity_lacks: String,
}

impl Message for Step {
    const PACKAGE: &'static str = "nightflow_msgs";
    const NAME: &'static str = "Step";
}

/// `nightflow_msgs/EgoMotion`: the camera's own translation.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct EgoMotion {
    pub header: Header,
    pub older_stamp: Time,
    pub scale: u8,
    pub distance: f64,
    pub twist: TwistWithCovariance,
    pub samples: u32,
    pub inliers: u32,
    pub quality: u8,
}

impl Message for EgoMotion {
    const PACKAGE: &'static str = "nightflow_msgs";
    const NAME: &'static str = "EgoMotion";
}

/// `nightflow_msgs/Status`: how the node fares.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Status {
    pub header: Header,
    pub state: u8,
    pub cause: String,
    pub frames: u64,
    pub displaced: u64,
    pub steps: u64,
    pub spoiled: u64,
    pub unpaired: u64,
    pub lost: u64,
    pub last_error: String,
    pub rate: f32,
    pub latency_ms: f32,
    pub step_ms: f32,
    pub noise_a: f32,
    pub noise_b: f32,
    pub snr_db: f32,
    pub noise_level: f32,
}

impl Message for Status {
    const PACKAGE: &'static str = "nightflow_msgs";
    const NAME: &'static str = "Status";
}

/// `nightflow_msgs/Width`: how wide images are developed from now on.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Width {
    pub header: Header,
    pub columns: u32,
}

impl Message for Width {
    const PACKAGE: &'static str = "nightflow_msgs";
    const NAME: &'static str = "Width";
}
