//! What lies in shared memory beside the vectors: plain structs of fixed layout that C++ and Python read too.
//!
//! Every stamp is nanoseconds since the Unix epoch. `examples/` holds the same layouts for the other languages.

use iceoryx2::prelude::ZeroCopySend;

use super::Moved;
use crate::{
    flow::{Cause, State},
    motion::{Lack, NoSight, Obstacles, SECTORS, Scale, Sector, Velocity},
    wire,
};

/// The header of `<prefix>/flow` and `<prefix>/confidence`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("nightflow::FlowHeader")]
pub struct FlowHeader {
    /// Stamp of the older frame.
    pub older_ns: i64,
    /// Stamp of the newer frame.
    pub newer_ns: i64,
    /// When the sample was sent.
    pub published_ns: i64,
    /// Counts from 0; a hole is a step that was lost.
    pub step: u64,
    /// Frames that a newer one displaced before they were looked at, since the start.
    pub displaced: u64,
    /// Steps that could not be sent, since the start.
    pub lost: u64,
    /// Columns of the flow.
    pub width: u32,
    /// Rows of the flow.
    pub height: u32,
    /// Columns of the camera's frame.
    pub camera_width: u32,
    /// Rows of the camera's frame.
    pub camera_height: u32,
    /// Camera pixels a flow column.
    pub scale_x: f32,
    /// Camera pixels a flow row.
    pub scale_y: f32,
    /// 0 ok, 1 degraded, 2 blind.
    pub state: u32,
    /// Why it is not ok, see [`cause_code`].
    pub cause: u32,
    /// Linear gain that both frames were given.
    pub gain: f32,
    /// Mean above black of the newer frame, 1 = white level.
    pub raw_mean: f32,
    /// Part of the newer frame that is saturated, 0…1.
    pub saturated: f32,
    /// Mean confidence of the flow, 0…1.
    pub confidence: f32,
}

/// The payload of `<prefix>/velocity`, sent with every step: without a velocity `valid` is 0 and every number of it NaN,
/// never zero.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("nightflow::VelocitySample")]
pub struct VelocitySample {
    /// Stamp of the older frame.
    pub older_ns: i64,
    /// Stamp of the newer frame, which the velocity belongs to.
    pub newer_ns: i64,
    /// When the sample was sent.
    pub published_ns: i64,
    /// The step, as in [`FlowHeader`].
    pub step: u64,
    /// Body frame, FLU: m/s, or 1/s when `scale` is 1.
    pub linear: [f64; 3],
    /// Body frame, rad/s.
    pub angular: [f64; 3],
    /// Row-major 6×6 over (linear, angular).
    pub covariance: [[f64; 6]; 6],
    /// Metres to the ground along its normal; NaN when unknown.
    pub distance: f64,
    /// 1 when there is a velocity, 0 when there is none.
    pub valid: u32,
    /// 0 metric, 1 divided by the unknown distance.
    pub scale: u32,
    /// 0 ok, 1 degraded, 2 blind.
    pub state: u32,
    /// Why it is not ok, see [`cause_code`].
    pub cause: u32,
    /// Why there is no velocity, see [`lack_code`].
    pub lack: u32,
    /// Flow vectors that were offered.
    pub samples: u32,
    /// Flow vectors that agreed.
    pub inliers: u32,
    /// 0 none … 255.
    pub quality: u32,
}

/// The payload of `<prefix>/status`, about once a second; counters run from the start.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("nightflow::StatusSample")]
pub struct StatusSample {
    /// The status' own stamp.
    pub stamp_ns: i64,
    /// Frames that reached the pipeline.
    pub frames: u64,
    /// Frames that a newer one displaced.
    pub displaced: u64,
    /// Pairs that gave flow.
    pub steps: u64,
    /// Frames that were refused.
    pub spoiled: u64,
    /// Frames with no partner.
    pub unpaired: u64,
    /// Steps that a sink could not take.
    pub lost: u64,
    /// 0 ok, 1 degraded, 2 blind, 3 no frames come.
    pub state: u32,
    /// Steps a second.
    pub rate: f32,
    /// Median from the frame's stamp to its flow; NaN when unknown.
    pub latency_ms: f32,
    /// Median of a step.
    pub step_ms: f32,
    /// Noise of a raw value y (1 = white): its variance is noise_a·y + noise_b; NaN when unknown, as all four.
    pub noise_a: f32,
    /// See `noise_a`.
    pub noise_b: f32,
    /// Signal to noise of a raw pixel at the newest frame's mean.
    pub snr_db: f32,
    /// Deviation of the noise in the network's image at a mean of 0.4, in 1/255.
    pub noise_level: f32,
    /// UTF-8, filled up with zeros, cut where it is longer.
    pub cause: [u8; 128],
    /// UTF-8, filled up with zeros, cut where it is longer.
    pub last_error: [u8; 256],
}

/// The payload of `<prefix>/obstacles`, sent with every step: where nothing is known `valid` is 0 and every sector
/// unknown.
///
/// Sector k looks along −π + k·2π/72 in the body frame with its roll and pitch taken off, counter-clockwise from above;
/// 36 looks forward.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("nightflow::ObstaclesSample")]
pub struct ObstaclesSample {
    /// Stamp of the older frame.
    pub older_ns: i64,
    /// Stamp of the newer frame, which everything here belongs to.
    pub newer_ns: i64,
    /// When the sample was sent.
    pub published_ns: i64,
    /// The step, as in [`FlowHeader`].
    pub step: u64,
    /// Unit vector of the motion by the flow, level body frame.
    pub heading: [f64; 3],
    /// Its largest standard deviation, rad.
    pub heading_sd: f64,
    /// Speed over ground, m/s; NaN when it is not metric.
    pub speed: f64,
    /// What is met later than this is not in the way, s.
    pub horizon_s: f64,
    /// Time constant of the filter, s.
    pub delay_s: f64,
    /// 1 when the surroundings were looked at, 0 when not.
    pub valid: u32,
    /// 0 ok, 1 degraded, 2 blind.
    pub state: u32,
    /// Why it is not ok, see [`cause_code`].
    pub cause: u32,
    /// Why nothing is known, see [`sight_code`].
    pub sight: u32,
    /// Seconds to contact of an occupied sector; NaN of any other.
    pub ttc_s: [f32; SECTORS],
    /// Metres to what occupies a sector, if it stands still; NaN of any other and without a metric speed.
    pub distance_m: [f32; SECTORS],
    /// Probability of what is said of a sector, 0…1; 0 where it is unknown.
    pub confidence: [f32; SECTORS],
    /// 0 unknown, 1 free, 2 occupied.
    pub sector: [u8; SECTORS],
}

/// [`ObstaclesSample::sight`]: 0 seen, 64 not asked for, 65 bare, 66 no parallax; below 64 a [`lack_code`].
pub fn sight_code(obstacles: &Result<Obstacles, NoSight>) -> u32 {
    match obstacles {
        Ok(_) => 0,
        Err(NoSight::Lack(lack)) => code(lack),
        Err(NoSight::Off) => 64,
        Err(NoSight::Bare { .. }) => 65,
        Err(NoSight::Parallax { .. }) => 66,
    }
}

/// [`FlowHeader::cause`]: 0 none, 1 dark, 2 saturated, 3 gain step, 4 unsure, 5 frozen, 6 noisy.
pub fn cause_code(state: &State) -> u32 {
    match state {
        State::Ok => 0,
        State::Degraded(cause) | State::Blind(cause) => match cause {
            Cause::Dark { .. } => 1,
            Cause::Saturated { .. } => 2,
            Cause::GainStep { .. } => 3,
            Cause::Unsure { .. } => 4,
            Cause::Frozen => 5,
            Cause::Noisy { .. } => 6,
        },
    }
}

/// [`VelocitySample::lack`]: 0 none, 1 blind, 2 calibration, 3 camera size, 4 gyro, 5 gyro gap, 6 disagreement,
/// 7 degenerate, 8 mount.
pub fn lack_code(velocity: &Result<Velocity, Lack>) -> u32 {
    velocity.as_ref().err().map_or(0, code)
}

fn code(lack: &Lack) -> u32 {
    match lack {
        Lack::Blind => 1,
        Lack::Calibration => 2,
        Lack::CameraSize { .. } => 3,
        Lack::Gyro => 4,
        Lack::GyroGap { .. } => 5,
        Lack::Disagreement { .. } => 6,
        Lack::Degenerate => 7,
        Lack::Mount => 8,
    }
}

/// What a code of [`FlowHeader::cause`] stands for.
pub fn cause_name(code: u32) -> &'static str {
    ["", "dark", "saturated", "gain step", "unsure", "frozen", "noisy"].get(code as usize).copied().unwrap_or("unknown")
}

/// What a code of [`VelocitySample::lack`] stands for.
pub fn lack_name(code: u32) -> &'static str {
    ["", "blind", "calibration", "camera size", "gyro", "gyro gap", "disagreement", "degenerate", "mount"]
        .get(code as usize)
        .copied()
        .unwrap_or("unknown")
}

/// What a code of [`ObstaclesSample::sight`] stands for.
pub fn sight_name(code: u32) -> &'static str {
    match code {
        64 => "not asked for",
        65 => "bare",
        66 => "no parallax",
        lack => lack_name(lack),
    }
}

fn state_code(state: &State) -> u32 {
    match state {
        State::Ok => 0,
        State::Degraded(_) => 1,
        State::Blind(_) => 2,
    }
}

impl From<&Moved> for FlowHeader {
    /// All but the time of sending and the counters, which the sender knows.
    fn from(moved: &Moved) -> Self {
        Self {
            older_ns: moved.older.ns(),
            newer_ns: moved.newer.ns(),
            step: moved.step,
            width: moved.grid.width as u32,
            height: moved.grid.height as u32,
            camera_width: moved.camera_size[0],
            camera_height: moved.camera_size[1],
            scale_x: moved.grid.scale[0],
            scale_y: moved.grid.scale[1],
            state: state_code(&moved.state),
            cause: cause_code(&moved.state),
            gain: moved.gain,
            raw_mean: moved.raw_mean,
            saturated: moved.saturated_part,
            confidence: moved.confidence,
            ..Self::default()
        }
    }
}

impl From<&Moved> for VelocitySample {
    /// All but the time of sending. A blind step has no velocity, whatever was computed.
    fn from(moved: &Moved) -> Self {
        let blind = matches!(moved.state, State::Blind(_));
        let found = if blind { Err(Lack::Blind) } else { moved.velocity };
        let mut sample = Self {
            older_ns: moved.older.ns(),
            newer_ns: moved.newer.ns(),
            published_ns: 0,
            step: moved.step,
            linear: [f64::NAN; 3],
            angular: [f64::NAN; 3],
            covariance: [[f64::NAN; 6]; 6],
            distance: f64::NAN,
            valid: 0,
            scale: 0,
            state: state_code(&moved.state),
            cause: cause_code(&moved.state),
            lack: lack_code(&found),
            samples: 0,
            inliers: 0,
            quality: 0,
        };
        if let Ok(velocity) = found {
            (sample.linear, sample.angular, sample.covariance) =
                (velocity.linear, velocity.angular, velocity.covariance);
            (sample.scale, sample.distance) = match velocity.scale {
                Scale::Metric { distance } => (0, distance),
                Scale::PerDistance(_) => (1, f64::NAN),
            };
            (sample.samples, sample.inliers) = (velocity.samples, velocity.inliers);
            (sample.quality, sample.valid) = (velocity.quality.into(), 1);
        }
        sample
    }
}

impl From<&Moved> for ObstaclesSample {
    /// All but the time of sending. In a blind step nothing is known, whatever was computed.
    fn from(moved: &Moved) -> Self {
        let blind = matches!(moved.state, State::Blind(_)) && moved.obstacles.is_ok();
        let found = if blind { Err(NoSight::Lack(Lack::Blind)) } else { moved.obstacles };
        let mut sample = Self {
            older_ns: moved.older.ns(),
            newer_ns: moved.newer.ns(),
            published_ns: 0,
            step: moved.step,
            heading: [f64::NAN; 3],
            heading_sd: f64::NAN,
            speed: f64::NAN,
            horizon_s: f64::NAN,
            delay_s: f64::NAN,
            valid: 0,
            state: state_code(&moved.state),
            cause: cause_code(&moved.state),
            sight: sight_code(&found),
            ttc_s: [f32::NAN; SECTORS],
            distance_m: [f32::NAN; SECTORS],
            confidence: [0.0; SECTORS],
            sector: [0; SECTORS],
        };
        if let Ok(found) = found {
            (sample.heading, sample.heading_sd) = (found.heading, found.heading_sd_rad);
            (sample.speed, sample.horizon_s) = (found.speed.unwrap_or(f64::NAN), found.horizon_s);
            (sample.delay_s, sample.valid) = (found.delay_s, 1);
            for (k, sector) in found.sectors.iter().enumerate() {
                (sample.sector[k], sample.confidence[k]) = match sector {
                    Sector::Unknown => (0, 0.0),
                    Sector::Free { confidence } => (1, *confidence as f32),
                    Sector::Occupied { ttc_s, distance_m, confidence, .. } => {
                        (sample.ttc_s[k], sample.distance_m[k]) = (*ttc_s as f32, *distance_m as f32);
                        (2, *confidence as f32)
                    }
                };
            }
        }
        sample
    }
}

impl From<&wire::Status> for StatusSample {
    fn from(status: &wire::Status) -> Self {
        Self {
            stamp_ns: crate::clock::Stamp::from(status.header.stamp).ns(),
            frames: status.frames,
            displaced: status.displaced,
            steps: status.steps,
            spoiled: status.spoiled,
            unpaired: status.unpaired,
            lost: status.lost,
            state: status.state.into(),
            rate: status.rate,
            latency_ms: status.latency_ms,
            step_ms: status.step_ms,
            noise_a: status.noise_a,
            noise_b: status.noise_b,
            snr_db: status.snr_db,
            noise_level: status.noise_level,
            cause: text(&status.cause),
            last_error: text(&status.last_error),
        }
    }
}

impl StatusSample {
    /// Why the state is not ok.
    pub fn cause(&self) -> String {
        said(&self.cause)
    }

    /// The newest refusal.
    pub fn last_error(&self) -> String {
        said(&self.last_error)
    }
}

/// Cuts between characters, so that the bytes stay UTF-8.
fn text<const N: usize>(text: &str) -> [u8; N] {
    let end = text.floor_char_boundary(N);
    let mut bytes = [0; N];
    bytes[..end].copy_from_slice(&text.as_bytes()[..end]);
    bytes
}

fn said(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layouts_are_those_that_the_other_languages_declare() {
        assert_eq!((size_of::<FlowHeader>(), align_of::<FlowHeader>()), (96, 8));
        assert_eq!((size_of::<VelocitySample>(), align_of::<VelocitySample>()), (408, 8));
        assert_eq!((size_of::<ObstaclesSample>(), align_of::<ObstaclesSample>()), (1040, 8));
        assert_eq!((size_of::<StatusSample>(), align_of::<StatusSample>()), (472, 8));
    }

    #[test]
    fn long_texts_are_cut_between_characters() {
        let cut: [u8; 4] = text("ab×…");
        assert_eq!(said(&cut), "ab×");
        let whole: [u8; 8] = text("ab×…");
        assert_eq!(said(&whole), "ab×…");
    }
}
