//! `sensor_msgs`: the camera's frames and calibration, the gyro and the range finder.

use serde::{Deserialize, Serialize};

use super::{Header, Message, Quaternion, Vector3};

/// `sensor_msgs/Image`: rows of `step` bytes each.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Image {
    /// Acquisition time and optical frame (x right, y down, z forward).
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns, in pixels.
    pub width: u32,
    /// Pixel encoding, as in `bayer_rggb16`.
    pub encoding: String,
    /// Non-zero when 16-bit values are big-endian.
    pub is_bigendian: u8,
    /// Bytes from one row to the next, padding included.
    pub step: u32,
    /// `height * step` bytes.
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
}

impl Message for Image {
    const PACKAGE: &'static str = "sensor_msgs";
    const NAME: &'static str = "Image";
}

/// `sensor_msgs/RegionOfInterest`, in full-resolution pixels.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct RegionOfInterest {
    pub x_offset: u32,
    pub y_offset: u32,
    pub height: u32,
    pub width: u32,
    pub do_rectify: bool,
}

impl Message for RegionOfInterest {
    const PACKAGE: &'static str = "sensor_msgs";
    const NAME: &'static str = "RegionOfInterest";
}

/// `sensor_msgs/CameraInfo`; `k[0] == 0` means uncalibrated.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CameraInfo {
    /// Stamp and optical frame of the image that it belongs to.
    pub header: Header,
    /// Rows of the calibrated (full-resolution) image.
    pub height: u32,
    /// Columns of the calibrated (full-resolution) image.
    pub width: u32,
    /// `plumb_bob` (k1, k2, t1, t2, k3), `rational_polynomial` or `equidistant`.
    pub distortion_model: String,
    /// Distortion coefficients.
    pub d: Vec<f64>,
    /// Intrinsic matrix, row-major 3×3, in full-resolution pixels.
    pub k: [f64; 9],
    /// Rectification, row-major 3×3.
    pub r: [f64; 9],
    /// Projection, row-major 3×4.
    pub p: [f64; 12],
    /// Columns that the sensor joined into one.
    pub binning_x: u32,
    /// Rows that the sensor joined into one.
    pub binning_y: u32,
    /// The part of the sensor that the image shows; all zero means all of it.
    pub roi: RegionOfInterest,
}

impl Message for CameraInfo {
    const PACKAGE: &'static str = "sensor_msgs";
    const NAME: &'static str = "CameraInfo";
}

/// `sensor_msgs/Imu`, in the IMU's own frame (REP 145); rad/s and m/s².
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Imu {
    pub header: Header,
    pub orientation: Quaternion,
    pub orientation_covariance: [f64; 9],
    pub angular_velocity: Vector3,
    pub angular_velocity_covariance: [f64; 9],
    pub linear_acceleration: Vector3,
    pub linear_acceleration_covariance: [f64; 9],
}

impl Message for Imu {
    const PACKAGE: &'static str = "sensor_msgs";
    const NAME: &'static str = "Imu";
}

/// `sensor_msgs/Range` (as of Jazzy, with `variance`); metres along the sensor's x axis.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Range {
    pub header: Header,
    /// 0 ultrasound, 1 infrared.
    pub radiation_type: u8,
    pub field_of_view: f32,
    pub min_range: f32,
    pub max_range: f32,
    /// +inf: nothing within `max_range`; −inf: nearer than `min_range` (REP 117).
    pub range: f32,
    /// m²; 0 means unknown.
    pub variance: f32,
}

impl Message for Range {
    const PACKAGE: &'static str = "sensor_msgs";
    const NAME: &'static str = "Range";
}

/// `sensor_msgs/LaserScan`: distances in a plane, about the frame's z axis, counter-clockwise from x.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct LaserScan {
    pub header: Header,
    /// rad.
    pub angle_min: f32,
    pub angle_max: f32,
    pub angle_increment: f32,
    /// Seconds from one ray to the next.
    pub time_increment: f32,
    /// Seconds from one scan to the next.
    pub scan_time: f32,
    /// m.
    pub range_min: f32,
    pub range_max: f32,
    /// m; +inf: nothing up to `range_max`; NaN: unknown (REP 117).
    pub ranges: Vec<f32>,
    /// Empty when there are none.
    pub intensities: Vec<f32>,
}

impl Message for LaserScan {
    const PACKAGE: &'static str = "sensor_msgs";
    const NAME: &'static str = "LaserScan";
}

/// `sensor_msgs/CompressedImage`: an image file as a message.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct CompressedImage {
    pub header: Header,
    /// `jpeg`, `png`.
    pub format: String,
    #[serde(with = "serde_bytes")]
    pub data: Vec<u8>,
}

impl Message for CompressedImage {
    const PACKAGE: &'static str = "sensor_msgs";
    const NAME: &'static str = "CompressedImage";
}
