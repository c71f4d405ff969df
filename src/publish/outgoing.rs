//! What one step found, in the form of the ROS 2 messages that go out and into recordings.
//!
//! Each message can be filled into one that is kept, so that a steady state allocates nothing.

use std::fmt::Write;

use super::{Moved, Offer};
use crate::{
    clock::Stamp,
    flow::{Flow, Grid, State, wheel},
    motion::{NoSight, Obstacles, SECTORS, Scale, Sector, Velocity},
    wire::{
        DiagnosticArray, DiagnosticStatus, EgoMotion, Header, Image, KeyValue, LaserScan, Status, Step, Twist,
        TwistWithCovariance, TwistWithCovarianceStamped, Vector3,
    },
};

/// `Step.state` and `Status.state`.
pub const OK: u8 = 0;
/// Usable with care.
pub const DEGRADED: u8 = 1;
/// Nothing to be trusted.
pub const BLIND: u8 = 2;
/// No frames come (`Status` only).
pub const IDLE: u8 = 3;

/// The step without its vectors.
pub fn step(offer: &Offer<'_>) -> Step {
    let mut message = Step::default();
    fill_step(offer.moved, &mut message);
    message
}

/// [`step`] into a message that is kept.
pub fn fill_step(moved: &Moved, message: &mut Step) {
    fill_header(&mut message.header, moved.newer, &moved.frame_id);
    message.older_stamp = moved.older.into();
    message.step = moved.step;
    message.cause.clear();
    // Writing into a String cannot fail.
    message.state = match &moved.state {
        State::Ok => OK,
        State::Degraded(cause) => {
            let _ = write!(message.cause, "{cause}");
            DEGRADED
        }
        State::Blind(cause) => {
            let _ = write!(message.cause, "{cause}");
            BLIND
        }
    };
    (message.width, message.height) = (moved.grid.width as u32, moved.grid.height as u32);
    [message.scale_x, message.scale_y] = moved.grid.scale;
    message.gain = moved.gain;
    message.raw_mean = moved.raw_mean;
    message.saturated = moved.saturated_part;
    message.confidence = moved.confidence;
    message.velocity_lacks.clear();
    let lacks = &mut message.velocity_lacks;
    let _ = match (&moved.state, &moved.velocity) {
        (_, Err(lack)) => write!(lacks, "{lack}"),
        (State::Blind(_), Ok(_)) => write!(lacks, "{}", crate::motion::Lack::Blind),
        (_, Ok(Velocity { scale: Scale::PerDistance(why), .. })) => write!(lacks, "{why}"),
        (_, Ok(_)) => Ok(()),
    };
}

/// The velocity, only where it may be fused: metric, and the step was not blind.
pub fn twist(moved: &Moved, body_frame: &str) -> Option<TwistWithCovarianceStamped> {
    let mut message = TwistWithCovarianceStamped::default();
    fill_twist(moved, body_frame, &mut message).then_some(message)
}

/// [`twist`] into a message that is kept; false when there is none.
pub fn fill_twist(moved: &Moved, body_frame: &str, message: &mut TwistWithCovarianceStamped) -> bool {
    let Some(velocity @ Velocity { scale: Scale::Metric { .. }, .. }) = trusted(moved) else { return false };
    fill_header(&mut message.header, velocity.newer, body_frame);
    message.twist = with_covariance(velocity);
    true
}

/// The ego motion, metric or per distance; none when the step was blind or had no velocity.
pub fn ego_motion(moved: &Moved, body_frame: &str) -> Option<EgoMotion> {
    let mut message = EgoMotion::default();
    fill_ego_motion(moved, body_frame, &mut message).then_some(message)
}

/// [`ego_motion`] into a message that is kept; false when there is none.
pub fn fill_ego_motion(moved: &Moved, body_frame: &str, message: &mut EgoMotion) -> bool {
    let Some(velocity) = trusted(moved) else { return false };
    fill_header(&mut message.header, velocity.newer, body_frame);
    message.older_stamp = velocity.older.into();
    (message.scale, message.distance) = match velocity.scale {
        Scale::Metric { distance } => (0, distance),
        Scale::PerDistance(_) => (1, f64::NAN),
    };
    message.twist = with_covariance(velocity);
    message.samples = velocity.samples;
    message.inliers = velocity.inliers;
    message.quality = velocity.quality;
    true
}

/// What is in the way as distances; none where it is not looked for. See [`fill_proximity`].
pub fn proximity(moved: &Moved, body_frame: &str) -> Option<LaserScan> {
    let mut message = LaserScan::default();
    fill_proximity(moved, body_frame, &mut message).then_some(message)
}

/// [`proximity`] into a message that is kept; false when obstacles are not looked for.
///
/// The rays lie in the body frame with its roll and pitch taken off. A ray is NaN where nothing is known, +inf where
/// nothing is met up to `range_max`, the way of one horizon at the present speed (REP 117), and the intensity is the
/// probability of what is said. Without a metric speed there are no distances: every ray is unknown.
pub fn fill_proximity(moved: &Moved, body_frame: &str, message: &mut LaserScan) -> bool {
    let seen = match (&moved.state, &moved.obstacles) {
        (_, Err(NoSight::Off)) => return false,
        (State::Blind(_), _) | (_, Err(_)) => None,
        (_, Ok(found)) => found.speed.map(|speed| (found, speed)),
    };
    fill_header(&mut message.header, moved.newer, body_frame);
    let increment = std::f32::consts::TAU / SECTORS as f32;
    message.angle_min = -std::f32::consts::PI;
    message.angle_max = std::f32::consts::PI - increment;
    message.angle_increment = increment;
    (message.time_increment, message.range_min) = (0.0, 0.0);
    message.scan_time = moved.newer.seconds_since(moved.older) as f32;
    message.range_max = seen.map_or(0.0, |(found, speed)| (found.horizon_s * speed) as f32);
    let sector = |k: usize| seen.map_or(Sector::Unknown, |(Obstacles { sectors, .. }, _)| sectors[k]);
    let ray = |sector: Sector| match sector {
        Sector::Unknown => (f32::NAN, 0.0),
        Sector::Free { confidence } => (f32::INFINITY, confidence as f32),
        Sector::Occupied { distance_m, confidence, .. } => (distance_m as f32, confidence as f32),
    };
    message.ranges.clear();
    message.ranges.extend((0..SECTORS).map(|k| ray(sector(k)).0));
    message.intensities.clear();
    message.intensities.extend((0..SECTORS).map(|k| ray(sector(k)).1));
    true
}

/// The vectors as `32FC2`: (u right, v down) in camera pixels, stamp of the newer frame.
pub fn flow_image(frame_id: &str, flow: &Flow<'_>, image: &mut Image) {
    shape(image, frame_id, flow, "32FC2", 8);
    fill_floats(flow.vectors, &mut image.data);
}

/// The confidence as `32FC1`, 0…1.
pub fn confidence_image(frame_id: &str, flow: &Flow<'_>, image: &mut Image) {
    shape(image, frame_id, flow, "32FC1", 4);
    fill_floats(flow.confidence, &mut image.data);
}

/// The vectors as colours (`rgb8`): hue is direction, saturation is length. Full saturation stands for the longest
/// vector that is more likely right than not, and for one pixel at least, so that noise on a still image stays pale.
pub fn preview(frame_id: &str, flow: &Flow<'_>, image: &mut Image) {
    shape(image, frame_id, flow, "rgb8", 3);
    let longest = flow
        .vectors
        .as_chunks::<2>()
        .0
        .iter()
        .zip(flow.confidence)
        .filter(|(_, confidence)| **confidence >= 0.5)
        .map(|([u, v], _)| u.hypot(*v))
        .filter(|length| length.is_finite())
        .fold(1.0, f32::max);
    image.data.resize(flow.grid.cells() * 3, 0);
    for (rgb, [u, v]) in image.data.as_chunks_mut::<3>().0.iter_mut().zip(flow.vectors.as_chunks::<2>().0) {
        *rgb = wheel::colour(*u, *v, longest);
    }
}

/// What `/diagnostics` shows of the node's state: OK 0, WARN 1, ERROR 2, STALE 3.
pub fn diagnostics(status: &Status) -> DiagnosticArray {
    let word = ["ok", "degraded", "blind", "no frames come"].get(usize::from(status.state)).unwrap_or(&"unknown");
    let message = if status.cause.is_empty() { (*word).to_owned() } else { format!("{word}: {}", status.cause) };
    let value = |key: &str, value: String| KeyValue { key: key.into(), value };
    DiagnosticArray {
        header: status.header.clone(),
        status: vec![DiagnosticStatus {
            level: status.state.min(3),
            name: "nightflow: optical flow".into(),
            message,
            hardware_id: "nightflow".into(),
            values: vec![
                value("rate", format!("{:.2}", status.rate)),
                value("latency_ms", format!("{:.2}", status.latency_ms)),
                value("step_ms", format!("{:.2}", status.step_ms)),
                value("noise_a", format!("{:.3e}", status.noise_a)),
                value("noise_b", format!("{:.3e}", status.noise_b)),
                value("snr_db", format!("{:.1}", status.snr_db)),
                value("noise_level", format!("{:.1}", status.noise_level)),
                value("frames", status.frames.to_string()),
                value("displaced", status.displaced.to_string()),
                value("steps", status.steps.to_string()),
                value("spoiled", status.spoiled.to_string()),
                value("unpaired", status.unpaired.to_string()),
                value("lost", status.lost.to_string()),
                value("last_error", status.last_error.clone()),
            ],
        }],
    }
}

/// The vectors of one step, copied out of lent memory so that another thread can turn them into images.
#[derive(Debug, Default)]
pub struct Kept {
    /// The camera's optical frame.
    pub frame_id: String,
    older: Stamp,
    newer: Stamp,
    grid: Grid,
    vectors: Vec<f32>,
    confidence: Vec<f32>,
}

impl Kept {
    /// Copies the offer's vectors in place of what was kept.
    pub fn keep(&mut self, offer: &Offer<'_>) {
        self.frame_id.clear();
        self.frame_id.push_str(&offer.moved.frame_id);
        (self.older, self.newer, self.grid) = (offer.flow.older, offer.flow.newer, offer.flow.grid);
        self.vectors.clear();
        self.vectors.extend_from_slice(offer.flow.vectors);
        self.confidence.clear();
        self.confidence.extend_from_slice(offer.flow.confidence);
    }

    /// What is kept.
    pub fn flow(&self) -> Flow<'_> {
        Flow {
            older: self.older,
            newer: self.newer,
            grid: self.grid,
            vectors: &self.vectors,
            confidence: &self.confidence,
        }
    }
}

fn trusted(moved: &Moved) -> Option<&Velocity> {
    match moved.state {
        State::Blind(_) => None,
        State::Ok | State::Degraded(_) => moved.velocity.as_ref().ok(),
    }
}

fn with_covariance(velocity: &Velocity) -> TwistWithCovariance {
    let vector = |[x, y, z]: [f64; 3]| Vector3 { x, y, z };
    TwistWithCovariance {
        twist: Twist { linear: vector(velocity.linear), angular: vector(velocity.angular) },
        covariance: velocity.covariance,
    }
}

fn fill_header(header: &mut Header, stamp: Stamp, frame_id: &str) {
    header.stamp = stamp.into();
    header.frame_id.clear();
    header.frame_id.push_str(frame_id);
}

fn shape(image: &mut Image, frame_id: &str, flow: &Flow<'_>, encoding: &str, cell_bytes: usize) {
    fill_header(&mut image.header, flow.newer, frame_id);
    (image.width, image.height) = (flow.grid.width as u32, flow.grid.height as u32);
    image.encoding.clear();
    image.encoding.push_str(encoding);
    image.is_bigendian = 0;
    image.step = (flow.grid.width * cell_bytes) as u32;
}

fn fill_floats(values: &[f32], bytes: &mut Vec<u8>) {
    bytes.resize(values.len() * 4, 0);
    for (four, value) in bytes.as_chunks_mut::<4>().0.iter_mut().zip(values) {
        *four = value.to_le_bytes();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        exposure::Exposed,
        flow::Cause,
        motion::{Integrated, Lack, NoDistance, NoFlow, NoSight},
    };

    fn moved(state: State, scale: Scale) -> Moved {
        let (older, newer) = (Stamp::from_ns(1_000_000_001), Stamp::from_ns(1_033_000_002));
        Moved {
            step: 7,
            older,
            newer,
            frame_id: "camera_optical".into(),
            camera_size: [8, 4],
            grid: Grid { width: 2, height: 1, scale: [4.0, 4.0] },
            gain: 20.0,
            raw_mean: 0.02,
            noise: None,
            noise_level: None,
            saturated_part: 0.01,
            confidence: 0.75,
            state,
            velocity: Ok(Velocity {
                older,
                newer,
                linear: [1.0, -2.0, 0.5],
                angular: [0.1, 0.2, -0.3],
                covariance: std::array::from_fn(|r| std::array::from_fn(|c| (r * 6 + c) as f64)),
                scale,
                samples: 500,
                inliers: 400,
                quality: 200,
            }),
            integrated: Integrated::without(older, newer, NoFlow::Blind),
            obstacles: Err(NoSight::Off),
        }
    }

    const METRIC: Scale = Scale::Metric { distance: 12.5 };
    const DARK: Cause = Cause::Dark { raw_mean: 0.0001, needed: 0.001 };

    #[test]
    fn blind_gives_no_velocity_and_says_so() {
        let blind = moved(State::Blind(DARK), METRIC);
        assert_eq!(twist(&blind, "base_link"), None);
        assert_eq!(ego_motion(&blind, "base_link"), None);
        let mut message = Step::default();
        fill_step(&blind, &mut message);
        assert_eq!((message.state, message.velocity_lacks.as_str()), (BLIND, "blind"));
        assert_eq!(message.cause, "too dark: raw mean 0.00010 of white, at least 0.00100 is needed");
    }

    #[test]
    fn without_a_distance_there_is_ego_motion_but_no_velocity() {
        let unscaled = moved(State::Degraded(DARK), Scale::PerDistance(NoDistance::Missing));
        assert_eq!(twist(&unscaled, "base_link"), None);
        let Some(motion) = ego_motion(&unscaled, "base_link") else { panic!("no ego motion") };
        assert!(motion.scale == 1 && motion.distance.is_nan(), "{motion:?}");
        let mut message = Step::default();
        fill_step(&unscaled, &mut message);
        assert_eq!((message.state, message.velocity_lacks.as_str()), (DEGRADED, "no range was received"));
    }

    #[test]
    fn velocity_stands_in_the_body_frame_at_the_newer_stamp() {
        let moved = moved(State::Ok, METRIC);
        let Some(message) = twist(&moved, "base_link") else { panic!("no velocity") };
        assert_eq!(message.header.frame_id, "base_link");
        assert_eq!(Stamp::from(message.header.stamp), moved.newer);
        assert_eq!(message.twist.twist.linear, Vector3 { x: 1.0, y: -2.0, z: 0.5 });
        assert_eq!(message.twist.covariance[2][3], 15.0);
    }

    #[test]
    fn proximity_tells_free_from_unknown_and_is_silent_where_nobody_asked() {
        let mut moved = moved(State::Ok, METRIC);
        assert_eq!(proximity(&moved, "base_link"), None);
        moved.obstacles = Err(NoSight::Lack(Lack::Gyro));
        let Some(unseen) = proximity(&moved, "base_link") else { panic!("no scan") };
        assert!(unseen.ranges.len() == SECTORS && unseen.ranges.iter().all(|range| range.is_nan()), "{unseen:?}");
        let mut sectors = [Sector::Unknown; SECTORS];
        sectors[35] = Sector::Free { confidence: 0.95 };
        sectors[36] = Sector::Occupied { ttc_s: 2.0, distance_m: 6.0, confidence: 0.99, whole: true };
        let found = Obstacles {
            older: moved.older,
            newer: moved.newer,
            sectors,
            heading: [1.0, 0.0, 0.0],
            heading_sd_rad: 0.01,
            speed: Some(3.0),
            horizon_s: 8.0,
            delay_s: 0.15,
        };
        moved.obstacles = Ok(found);
        let Some(scan) = proximity(&moved, "base_link") else { panic!("no scan") };
        assert!(scan.ranges[34].is_nan() && scan.ranges[35] == f32::INFINITY && scan.ranges[36] == 6.0, "{scan:?}");
        assert_eq!((scan.intensities[35], scan.intensities[36], scan.range_max), (0.95, 0.99, 24.0));
        assert!((scan.angle_min + 36.0 * scan.angle_increment).abs() < 1e-5, "ray 36 looks forward");
        moved.obstacles = Ok(Obstacles { speed: None, ..found });
        let Some(unscaled) = proximity(&moved, "base_link") else { panic!("no scan") };
        assert!(unscaled.ranges.iter().all(|range| range.is_nan()), "times without a speed are no distances");
        moved.obstacles = Ok(found);
        moved.state = State::Blind(DARK);
        let Some(blind) = proximity(&moved, "base_link") else { panic!("no scan") };
        assert!(blind.ranges.iter().all(|range| range.is_nan()));
    }

    #[test]
    fn a_kept_message_holds_nothing_of_the_step_before() {
        let mut message = Step::default();
        let mut failed = moved(State::Degraded(DARK), METRIC);
        failed.velocity = Err(Lack::Gyro);
        fill_step(&failed, &mut message);
        assert_eq!(message.velocity_lacks, "no gyro was received");
        let fine = moved(State::Ok, METRIC);
        fill_step(&fine, &mut message);
        let mut fresh = Step::default();
        fill_step(&fine, &mut fresh);
        assert_eq!(message, fresh);
        assert!(message.cause.is_empty() && message.velocity_lacks.is_empty());
    }

    #[test]
    fn images_have_the_bytes_of_the_vectors() {
        let moved = moved(State::Ok, METRIC);
        let exposed = Exposed::default();
        let flow = Flow {
            older: moved.older,
            newer: moved.newer,
            grid: moved.grid,
            vectors: &[3.0, 4.0, f32::NAN, 0.0],
            confidence: &[0.9, 0.1],
        };
        let mut kept = Kept::default();
        kept.keep(&Offer { moved: &moved, flow, image: &exposed });
        let mut image = Image::default();
        flow_image(&kept.frame_id, &kept.flow(), &mut image);
        assert_eq!((image.step, image.width, image.height, image.encoding.as_str()), (16, 2, 1, "32FC2"));
        assert_eq!(image.data[4..8], 4.0f32.to_le_bytes());
        confidence_image(&kept.frame_id, &kept.flow(), &mut image);
        assert_eq!((image.step, image.data.len(), image.encoding.as_str()), (8, 8, "32FC1"));
        preview(&kept.frame_id, &kept.flow(), &mut image);
        assert_eq!((image.step, image.encoding.as_str()), (6, "rgb8"));
        assert_eq!(image.data[..3], wheel::colour(3.0, 4.0, 5.0), "the longest trusted vector is fully saturated");
        assert_eq!(image.data[3..], [0; 3], "what is not finite is black");
    }
}
