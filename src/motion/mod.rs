//! Stage 4: flow, gyro and range become the body's velocity with a covariance.
//!
//! A point on the ground stands on the ray m₁ = (x₁, y₁, 1) of the older frame and on m₂ of the newer one. The gyro,
//! integrated over exactly the interval, turns m₂ back into the older frame's axes: p₂. With n the unit vector to the
//! ground, d the distance along it and t the camera's displacement, τ = t/d obeys
//! x₂ − x₁ = (n·m₁)(−τ_x + x₂ τ_z) and the same in y: exact, and linear in τ. A seeded RANSAC starts the fit, and
//! iteratively re-weighted least squares ends it. Where n is not known either it is fitted with τ. Where the frames' gradients
//! are at hand, theirs is the last word (`sights`): a vector is made of many cells' words. What the vectors then
//! show of the gyro's error is taken off, and its bias is learnt (`fusion`). Last, accelerometer and attitude carry what the
//! steps before said to this one, and the two are weighed (`inertia`).

mod anchor;
mod bias;
mod config;
mod drift;
mod errors;
mod fit;
mod fusion;
mod ground;
mod gyro;
mod inertia;
mod integrated;
mod lens;
mod linear;
mod mounting;
pub mod obstacles;
mod odometer;
mod plane;
mod quality;
mod sights;
mod thinned;

pub use anchor::Keeping;
pub use config::{AttitudeUse, Config, GyroUse, Mount, REASONS};
pub use drift::{Diagnosis, Drift};
pub use inertia::GRAVITY;
pub use integrated::{Integrated, NoFlow};
pub use obstacles::{Lookout, NoSight, Obstacles, SECTORS, Sector};
pub use odometer::Odometer;
pub use quality::{BOUND_M_S, BOUND_PART, BOUND_PER_S};

use crate::clock::Stamp;

/// Translational velocity of the body, FLU (x forward, y left, z up), at the newer frame's stamp.
///
/// It is the mean over the interval between the middles of both exposures, in the body axes of the newer frame. Where the
/// IMU's messages have acceleration and attitude it holds what the steps before said too, carried here by them
/// ([`Config::inertia`]): who has an accelerometer himself wants it without. A network errs alike in frames that are alike:
/// errors of successive steps are not independent either way, and a filter that takes them as such trusts them too much.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Velocity {
    /// Stamp of the older frame.
    pub older: Stamp,
    /// Stamp of the newer frame.
    pub newer: Stamp,
    /// m/s when metric, 1/s when per distance.
    pub linear: [f64; 3],
    /// rad/s, mean over the interval, body frame: the gyro's, less the bias that the flow has shown so far.
    pub angular: [f64; 3],
    /// Row-major over (linear, angular): flow noise by the residuals and the number of effectively independent vectors,
    /// gyro, range, tilt and stamps by the settings or their messages, less what the vectors show of their errors. An axis
    /// that was not observed has a large variance, never 0.
    pub covariance: [[f64; 6]; 6],
    /// Whether `linear` is metric.
    pub scale: Scale,
    /// Flow vectors that were offered.
    pub samples: u32,
    /// Flow vectors that agreed.
    pub inliers: u32,
    /// 255 × the probability that `linear` is within [`BOUND_M_S`] + [`BOUND_PART`] of the speed of the truth (length of
    /// the error in all three directions; [`BOUND_PER_S`] where it is per distance). It follows from the covariance,
    /// means the same by day and by night; its curve on simulated flights is in `models/velocity.md`.
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
    /// The beam hits the ground too slantingly.
    #[error(
        "the range finder's beam stands at a cosine of {cosine:.2} to the ground's normal, at least {needed:.2} is needed"
    )]
    Slanting {
        /// Between beam and normal.
        cosine: f64,
        /// The limit.
        needed: f64,
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
    /// The settings leave the camera's mount to the transforms, and none leads from the camera's frame to the body's.
    #[error("no transform from the camera's frame to the body's was received")]
    Mount,
    /// The calibration belongs to frames of another size.
    #[error("CameraInfo is for frames of {calibrated:?}, the frames are {frame:?} (columns, rows)")]
    CameraSize {
        /// Columns and rows after binning and region of interest.
        calibrated: [u32; 2],
        /// Columns and rows of the frame.
        frame: [u32; 2],
    },
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

impl Lack {
    /// What is missing, without its figures: the name that steps are counted under.
    pub fn kind(&self) -> &'static str {
        match self {
            Lack::Blind => "trustworthy flow",
            Lack::Calibration => "a calibration",
            Lack::Mount => "a transform from camera to body",
            Lack::CameraSize { .. } => "a calibration for this frame size",
            Lack::Gyro => "a gyro",
            Lack::GyroGap { .. } => "a gyro over the whole interval",
            Lack::Disagreement { .. } => "flow vectors that agree",
            Lack::Degenerate => "flow that determines the motion",
        }
    }
}

/// Why a sample or the settings were refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// The settings make no sense.
    #[error("motion settings: {0}")]
    Settings(String),
    /// A value that is no number.
    #[error("{sensor} at {stamp}: {what} is not finite, the sample is refused")]
    NotFinite {
        /// `gyro`, `range`, `calibration` or `transform`.
        sensor: &'static str,
        /// The sample's stamp.
        stamp: Stamp,
        /// Which value.
        what: &'static str,
    },
    /// The clock went back.
    #[error("{sensor}: its clock went back from {newest} to {stamp}, the sample is refused{}", if *anew { "; the series starts anew" } else { "" })]
    Backwards {
        /// `gyro` or `range`.
        sensor: &'static str,
        /// The sample's stamp.
        stamp: Stamp,
        /// The newest stamp before it.
        newest: Stamp,
        /// It went back so far that what was kept is forgotten.
        anew: bool,
    },
    /// A distortion model that is not known here.
    #[error("distortion model {model:?} is not known; plumb_bob, rational_polynomial and equidistant are")]
    Distortion {
        /// As the message names it.
        model: String,
    },
}
