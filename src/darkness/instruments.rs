//! What a simulated drone measures beside its camera: gyro with attitude, and range.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};

use super::{noise::Normals, path::Pose};
use crate::{
    camera::Sample,
    clock::Stamp,
    wire::{self, Header, Imu, Range},
};

/// Frame of reference of gyro, range and true velocity (FLU).
pub const BODY_FRAME: &str = "base_link";

/// Gyro and range begin so long before the first frame.
const LEAD_NS: i64 = 100_000_000;
const GYRO_NS: i64 = 5_000_000;
const RANGE_NS: i64 = 25_000_000;
const GYRO_SD: f64 = 0.005;
const ATTITUDE_SD: f64 = 0.005;
const REACH_M: [f32; 2] = [0.2, 60.0];

/// A gyro at 200 Hz, whose messages carry an attitude, and at 40 Hz a lidar that looks along the body's down axis.
#[derive(Debug, Clone)]
pub(super) struct Instruments {
    seed: u64,
    tilt_error: Vector3<f64>,
    gyro_next_ns: i64,
    range_next_ns: i64,
}

impl Instruments {
    /// They begin a little before the first frame, which is taken at `begin`.
    pub(super) fn new(seed: u64, begin: Stamp) -> Instruments {
        let mut draws = Normals::new(seed, 0x7117);
        Instruments {
            seed,
            tilt_error: Vector3::from_fn(|_, _| 0.7 * ATTITUDE_SD * draws.draw()),
            gyro_next_ns: begin.ns() - LEAD_NS,
            range_next_ns: begin.ns() - LEAD_NS,
        }
    }

    /// Gyro and range up to `until`, in the order of their stamps. `pose` says where the body is, `below` how far what
    /// stands under it is along its down axis.
    pub(super) fn until(
        &mut self,
        until: Stamp,
        pose: impl Fn(Stamp) -> Pose,
        below: impl Fn(Stamp, &Pose) -> Option<f64>,
        samples: &mut Vec<Sample>,
    ) {
        loop {
            let next = self.gyro_next_ns.min(self.range_next_ns);
            if next > until.ns() {
                return;
            }
            let (stamp, pose) = (Stamp(next), pose(Stamp(next)));
            if next == self.gyro_next_ns {
                samples.push(Sample::Imu(Arc::new(self.gyro(stamp, &pose))));
                self.gyro_next_ns += GYRO_NS;
            } else {
                samples.push(Sample::Range(Arc::new(self.range(stamp, below(stamp, &pose)))));
                self.range_next_ns += RANGE_NS;
            }
        }
    }

    fn gyro(&self, stamp: Stamp, pose: &Pose) -> Imu {
        let mut draws = Normals::new(self.seed ^ 0x6720, stamp.ns().cast_unsigned());
        let mut noisy = |clean: Vector3<f64>, sd: f64| clean.map(|value| value + sd * draws.draw());
        let rates = noisy(pose.rates, GYRO_SD);
        let force = noisy(pose.force, 0.05);
        let wander = noisy(self.tilt_error, 0.2 * ATTITUDE_SD);
        let attitude = pose.attitude * UnitQuaternion::from_scaled_axis(wander);
        let diagonal = |variance: f64| [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance];
        Imu {
            header: Header { stamp: stamp.into(), frame_id: BODY_FRAME.into() },
            orientation: wire::Quaternion { x: attitude.i, y: attitude.j, z: attitude.k, w: attitude.w },
            orientation_covariance: diagonal(ATTITUDE_SD.powi(2)),
            angular_velocity: wire::Vector3 { x: rates.x, y: rates.y, z: rates.z },
            angular_velocity_covariance: diagonal(GYRO_SD.powi(2)),
            linear_acceleration: wire::Vector3 { x: force.x, y: force.y, z: force.z },
            linear_acceleration_covariance: diagonal(0.05_f64.powi(2)),
        }
    }

    /// `clean` is the true distance.
    fn range(&self, stamp: Stamp, clean: Option<f64>) -> Range {
        let clean = clean.unwrap_or(f64::INFINITY);
        let sd = if clean.is_finite() { 0.02 + 0.005 * clean } else { 0.0 };
        let mut draws = Normals::new(self.seed ^ 0x4a6e, stamp.ns().cast_unsigned());
        Range {
            header: Header { stamp: stamp.into(), frame_id: BODY_FRAME.into() },
            radiation_type: 1,
            field_of_view: 0.03,
            min_range: REACH_M[0],
            max_range: REACH_M[1],
            range: (clean + sd * draws.draw()) as f32,
            variance: (sd * sd) as f32,
        }
    }
}
