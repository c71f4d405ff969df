//! `geometry_msgs`: vectors and twists.

use serde::{Deserialize, Serialize};

use super::{Header, Message};

/// `geometry_msgs/Vector3`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Vector3 {
    pub x: f64,
    pub y: f64,
    pub z: f64,
}

impl Message for Vector3 {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "Vector3";
}

/// `geometry_msgs/Vector3Stamped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Vector3Stamped {
    pub header: Header,
    pub vector: Vector3,
}

impl Message for Vector3Stamped {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "Vector3Stamped";
}

/// `geometry_msgs/Quaternion`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Quaternion {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub w: f64,
}

impl Message for Quaternion {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "Quaternion";
}

impl Default for Quaternion {
    fn default() -> Self {
        Self { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }
    }
}

/// `geometry_msgs/Twist`: m/s and rad/s.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Twist {
    pub linear: Vector3,
    pub angular: Vector3,
}

impl Message for Twist {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "Twist";
}

/// `geometry_msgs/TwistStamped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct TwistStamped {
    pub header: Header,
    pub twist: Twist,
}

impl Message for TwistStamped {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "TwistStamped";
}

/// `geometry_msgs/TwistWithCovariance`; serde stops at arrays of 32, and six rows of six have the same CDR form.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct TwistWithCovariance {
    pub twist: Twist,
    /// Row-major over (x, y, z, rotation about x, y, z).
    pub covariance: [[f64; 6]; 6],
}

impl Message for TwistWithCovariance {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "TwistWithCovariance";
}

/// `geometry_msgs/TwistWithCovarianceStamped`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct TwistWithCovarianceStamped {
    pub header: Header,
    pub twist: TwistWithCovariance,
}

impl Message for TwistWithCovarianceStamped {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "TwistWithCovarianceStamped";
}

/// `geometry_msgs/Transform`: brings points of the child frame into the parent frame.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct Transform {
    /// Metres.
    pub translation: Vector3,
    pub rotation: Quaternion,
}

impl Message for Transform {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "Transform";
}

/// `geometry_msgs/TransformStamped`: the header names the parent frame.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[allow(missing_docs)]
pub struct TransformStamped {
    pub header: Header,
    pub child_frame_id: String,
    pub transform: Transform,
}

impl Message for TransformStamped {
    const PACKAGE: &'static str = "geometry_msgs";
    const NAME: &'static str = "TransformStamped";
}
