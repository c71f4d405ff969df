//! `px4_msgs` as of PX4 1.14 to 1.16: what a companion tells PX4 over DDS, field by field as in `msgs/px4_msgs/msg/`.

use serde::{Deserialize, Serialize};

use super::Message;

/// `px4_msgs/SensorOpticalFlow`: flow as a sensor measured it; µs, rad, FRD.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct SensorOpticalFlow {
    pub timestamp: u64,
    pub timestamp_sample: u64,
    pub device_id: u32,
    pub pixel_flow: [f32; 2],
    pub delta_angle: [f32; 3],
    pub delta_angle_available: bool,
    pub distance_m: f32,
    pub distance_available: bool,
    pub integration_timespan_us: u32,
    pub quality: u8,
    pub error_count: u32,
    pub max_flow_rate: f32,
    pub min_ground_distance: f32,
    pub max_ground_distance: f32,
    pub mode: u8,
}

impl Message for SensorOpticalFlow {
    const PACKAGE: &'static str = "px4_msgs";
    const NAME: &'static str = "SensorOpticalFlow";
}

/// `px4_msgs/VehicleOpticalFlow`: flow as PX4's estimator takes it; µs, rad, FRD.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct VehicleOpticalFlow {
    pub timestamp: u64,
    pub timestamp_sample: u64,
    pub device_id: u32,
    pub pixel_flow: [f32; 2],
    pub delta_angle: [f32; 3],
    pub distance_m: f32,
    pub integration_timespan_us: u32,
    pub quality: u8,
    pub max_flow_rate: f32,
    pub min_ground_distance: f32,
    pub max_ground_distance: f32,
}

impl Message for VehicleOpticalFlow {
    const PACKAGE: &'static str = "px4_msgs";
    const NAME: &'static str = "VehicleOpticalFlow";
}

/// `px4_msgs/ObstacleDistance`: the nearest obstacle of each sector; serde stops at arrays of 32, and six rows of
/// twelve have the same CDR form.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct ObstacleDistance {
    pub timestamp: u64,
    pub frame: u8,
    pub sensor_type: u8,
    /// cm, clockwise.
    pub distances: [[u16; 12]; 6],
    pub increment: f32,
    pub min_distance: u16,
    pub max_distance: u16,
    pub angle_offset: f32,
}

impl Message for ObstacleDistance {
    const PACKAGE: &'static str = "px4_msgs";
    const NAME: &'static str = "ObstacleDistance";
}
