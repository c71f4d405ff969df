//! The flow straight below in an autopilot's form: angles about the body's axes, and the gyro over the same interval.
//!
//! Two views of a plane are joined by a homography, whatever the camera did between them. It is fitted to the dense
//! flow without the gyro's word, so that an autopilot which takes its own gyro off loses nothing, and is then asked for
//! one ray: the body's own down.

use nalgebra::{Matrix2, Vector3};

use super::{Odometer, lens::Lens, plane::Found, quality};
use crate::{clock::Stamp, flow::Flow};

/// What an autopilot's optical flow message holds, for one step. Body axes FRD (x forward, y right, z down).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Integrated {
    /// Stamp of the older frame: the integration begins.
    pub older: Stamp,
    /// Stamp of the newer frame: the integration ends.
    pub newer: Stamp,
    /// rad about the body's X and Y, the gyro's part not taken off. A turn of the vehicle by the right hand about an
    /// axis counts positive; so does flying forward about Y and flying left about X.
    pub flow: Result<[f64; 2], NoFlow>,
    /// rad, the body's rates integrated over exactly the interval; `None` where the gyro does not cover it.
    pub gyro: Option<[f64; 3]>,
    /// Metres along the body's down to the ground at the older frame; `None` where it is not known.
    pub distance: Option<f64>,
    /// Camera pixels per radian at the centre; `None` without a calibration.
    pub focal_px: Option<f64>,
    /// 0 where there is no flow; otherwise 1…255: 255 × the probability that the flow's rate is within
    /// [`BOUND_PER_S`](super::BOUND_PER_S) (rad/s) + [`BOUND_PART`](super::BOUND_PART) of what the gyro leaves of it. That
    /// is [`Velocity::quality`](super::Velocity::quality) for a velocity per distance: it means the same by day and by
    /// night, at any height, with and without a range. Without a gyro the constant part is all of the bound.
    pub quality: u8,
}

/// Why there is no flow straight below.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum NoFlow {
    /// The flow is not to be trusted.
    #[error("blind")]
    Blind,
    /// No CameraInfo, or one that says "uncalibrated", or one for frames of another size.
    #[error("no calibration for frames of {frame:?} (columns, rows)")]
    Calibration {
        /// Columns and rows of the frame.
        frame: [u32; 2],
    },
    /// It is not known how the camera sits.
    #[error("no transform from the camera's frame to the body's was received")]
    Mount,
    /// The camera does not look there.
    #[error("what is straight below the body is not in the camera's sight")]
    OutOfSight,
    /// Too few vectors agree on one plane.
    #[error("{inliers} of {samples} flow vectors agree on one plane, at least {needed} are needed")]
    Disagreement {
        /// That agreed.
        inliers: u32,
        /// That were offered.
        samples: u32,
        /// The limit.
        needed: u32,
    },
    /// The fit has no unique solution.
    #[error("the flow vectors do not determine a plane")]
    Degenerate,
}

impl Odometer {
    /// The flow straight below between two frames of `camera_size` (columns, rows). Blind flow is no flow, but the gyro
    /// and the distance stand by themselves.
    pub fn integrated(&mut self, flow: &Flow<'_>, camera_size: [u32; 2], blind: bool) -> Integrated {
        let span = self.span(flow);
        let gyro = self.rates.turn(span.older, span.newer, &self.config).ok().map(|turn| turn.mean * span.seconds);
        let ground = self.ground(span);
        let cosine = -ground.normal.z;
        let distance = ground.distance.ok().map(|d| d.metres / cosine).filter(|_| cosine > 0.1);
        let found = if blind { Err(NoFlow::Blind) } else { self.plane(flow, camera_size) };
        let below = found.and_then(|found| Ok((found, self.below(&found)?)));
        let turn = gyro.map(|angle| [angle.x, -angle.y]);
        let quality = below.as_ref().map_or(0, |(found, angles)| {
            let left = turn.map_or([0.0; 2], |turn| [angles[0] - turn[0], angles[1] - turn[1]]);
            let seconds = span.seconds.max(1e-6);
            let covariance = self.known(found, flow).map(|covariance| covariance / (seconds * seconds));
            covariance.map_or(1, |covariance| quality::of_rates(left.map(|angle| angle / seconds), &covariance))
        });
        Integrated {
            flow: below.map(|(_, angles)| angles),
            gyro: gyro.map(|angle| [angle.x, -angle.y, -angle.z]),
            distance,
            focal_px: self.lens.as_ref().map(Lens::focal),
            quality,
            ..Integrated::without(flow.older, flow.newer, NoFlow::Blind)
        }
    }

    fn plane(&mut self, flow: &Flow<'_>, camera_size: [u32; 2]) -> Result<Found, NoFlow> {
        if !self.mounted {
            return Err(NoFlow::Mount);
        }
        let fits = |lens: &&Lens| lens.size() == [0, 0] || lens.size() == camera_size;
        let lens = self.lens.as_ref().filter(fits).ok_or(NoFlow::Calibration { frame: camera_size })?;
        self.plane.look(flow, lens, self.config.confidence_min);
        self.plane.solve(&self.config)
    }

    /// The camera's ray along the body's down.
    fn down(&self) -> Vector3<f64> {
        self.mount.inverse() * -Vector3::z()
    }

    /// Covariance of the angles, rad²: by the residuals, and what all vectors err by together.
    fn known(&mut self, found: &Found, flow: &Flow<'_>) -> Option<Matrix2<f64>> {
        let (config, down, lens) = (&self.config, self.down(), self.lens.as_ref()?);
        let constant = config.flow_shared_sd_cells * f64::from(flow.grid.scale[0]) / lens.focal();
        let shared = constant.powi(2) + (config.flow_shared_sd_part * found.stretch).powi(2);
        let at = [down.x / down.z, down.y / down.z];
        let rays = self.plane.known(found, at)? + Matrix2::identity() * shared;
        // A ray (x, y, 1) that is 1 / z long and moves by (dx, dy) turns by its parts across the body's down.
        let mount = self.mount.matrix();
        let turned = Matrix2::new(mount[(1, 0)], mount[(1, 1)], mount[(0, 0)], mount[(0, 1)]) * -down.z;
        Some(turned * rays * turned.transpose())
    }

    /// How far the body's down moved, forward from the older frame and back from the newer one. Their mean belongs to
    /// the axes in the middle, as the integral of the gyro does: a yaw in between turns the two apart alike.
    fn below(&self, found: &Found) -> Result<[f64; 2], NoFlow> {
        let down = self.down();
        let at = [down.x / down.z, down.y / down.z];
        let [least, most] = found.sight;
        if down.z <= 0.0 || (0..2).any(|i| at[i] < least[i] || at[i] > most[i]) {
            return Err(NoFlow::OutOfSight);
        }
        let back = found.homography.try_inverse().ok_or(NoFlow::Degenerate)?;
        let ray = Vector3::new(at[0], at[1], 1.0);
        // Angles about the FRD axes; `mount` leads to FLU.
        let angles = |ray: Vector3<f64>| {
            let body = self.mount * ray;
            [(-body.y).atan2(-body.z), -body.x.atan2(-body.z)]
        };
        let (ahead, behind) = (angles(found.homography * ray), angles(back * ray));
        Ok(std::array::from_fn(|i| 0.5 * (ahead[i] - behind[i])))
    }
}

impl Integrated {
    /// Nothing is known of the interval, and why there is no flow.
    pub fn without(older: Stamp, newer: Stamp, why: NoFlow) -> Self {
        Self { older, newer, flow: Err(why), gyro: None, distance: None, focal_px: None, quality: 0 }
    }
}
