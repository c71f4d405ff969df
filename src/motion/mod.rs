//! Stage 4: flow, gyro and range become the body's velocity with a covariance.

use serde::{Deserialize, Serialize};

use crate::{
    clock::Stamp,
    flow::Flow,
    wire::{CameraInfo, Imu, Range},
};

/// Translational velocity of the body, FLU (x forward, y left, z up), at the newer frame's stamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Velocity {
    /// Stamp of the older frame.
    pub older: Stamp,
    /// Stamp of the newer frame.
    pub newer: Stamp,
    /// m/s when metric, 1/s when per distance.
    pub linear: [f64; 3],
    /// rad/s, mean over the interval, body frame.
    pub angular: [f64; 3],
    /// Row-major over (linear, angular).
    pub covariance: [[f64; 6]; 6],
    /// Whether `linear` is metric.
    pub scale: Scale,
    /// Flow vectors that were offered.
    pub samples: u32,
    /// Flow vectors that agreed.
    pub inliers: u32,
    /// 0 none … 255.
    pub quality: u8,
}

/// What `Velocity::linear` is measured in.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scale {
    /// m/s; the distance to the ground along its normal in metres.
    Metric {
        /// Metres.
        distance: f64,
    },
    /// 1/s: velocity over the unknown distance; why there is no distance.
    PerDistance(NoDistance),
}

/// Why there is no distance to the ground.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum NoDistance {
    /// No range sample at all.
    #[error("no range was received")]
    Missing,
    /// The newest is too old.
    #[error("the newest range is {age_s:.3} s old, at most {allowed_s:.3} s is allowed")]
    Old {
        /// Age at the newer frame.
        age_s: f64,
        /// The limit.
        allowed_s: f64,
    },
    /// Out of the sensor's bounds.
    #[error("range {range} m is outside {min}…{max} m")]
    OutOfBounds {
        /// Metres.
        range: f64,
        /// Metres.
        min: f64,
        /// Metres.
        max: f64,
    },
}

/// Why there is no velocity at all.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Lack {
    /// The flow is not to be trusted.
    #[error("blind")]
    Blind,
    /// No CameraInfo, or one that says "uncalibrated" (K[0] = 0).
    #[error("no calibration: CameraInfo is missing or has K[0] = 0")]
    Calibration,
    /// No gyro at all, and the settings ask for it.
    #[error("no gyro was received")]
    Gyro,
    /// The gyro does not cover the interval between the frames.
    #[error("the gyro covers {covered_s:.4} s of the {interval_s:.4} s between the frames")]
    GyroGap {
        /// Seconds covered.
        covered_s: f64,
        /// Seconds between the frames.
        interval_s: f64,
    },
    /// Too few vectors agree.
    #[error("{inliers} of {samples} flow vectors agree, at least {needed} are needed")]
    Disagreement {
        /// That agreed.
        inliers: u32,
        /// That were offered.
        samples: u32,
        /// The limit.
        needed: u32,
    },
    /// The fit has no unique solution.
    #[error("the flow vectors do not determine the motion")]
    Degenerate,
}

/// `[motion]`: the vehicle's geometry and the fit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The fewest vectors that must agree.
    pub inliers_min: u32,
}

impl Default for Config {
    fn default() -> Self {
        Self { inliers_min: 60 }
    }
}
