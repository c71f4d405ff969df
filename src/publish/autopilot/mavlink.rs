//! MAVLink 2 for PX4 and ArduPilot: which messages they take, in which axes, and how each is told that there is nothing.

use std::time::{Duration, Instant};

use ::mavlink::dialects::common::{
    MavDistanceSensor, MavEstimatorType, MavFrame, MavMessage, OBSTACLE_DISTANCE_DATA, ODOMETRY_DATA,
    OPTICAL_FLOW_DATA, OPTICAL_FLOW_RAD_DATA,
};

use super::{
    Autopilot, Mavlink, Word,
    feed::{Feed, Moment, Voice},
    link::Wire,
    reach_cm,
    ring::{INCREMENT_DEG, MIN_CM, Ring},
    stream::{Span, Stream, stamp_us},
};
use crate::{
    clock,
    motion::Velocity,
    publish::{Error, pace::Pace},
};

const NAME: &str = "mavlink";
/// ArduPilot takes the first flow after half a second of silence for a rate of zero, whatever it says, and believes its
/// quality. So the first one is said with quality 0.
const SILENCE: Duration = Duration::from_millis(400);
/// PX4 and ArduPilot forget obstacles after half a second.
const OBSTACLES_HZ_MIN: f64 = 4.0;
/// (rad/s)²: above it a body rate was not observed.
const UNOBSERVED: f64 = 1e4;

/// Opens the line and says what `words` names.
pub fn open(settings: &Mavlink) -> Result<Feed, Error> {
    let refused = |reason: String| Error::Open { sink: NAME, reason };
    if settings.words.is_empty() {
        return Err(refused("words is empty: name flow, odometry or obstacles".into()));
    }
    if settings.autopilot == Autopilot::Ardupilot && settings.words.contains(&Word::Odometry) {
        return Err(refused(
            "ArduPilot takes an ODOMETRY for a pose as well as a velocity, and there is no pose; \
             leave odometry out of words"
                .into(),
        ));
    }
    if !(0.0..=1000.0).contains(&settings.hz) {
        return Err(refused(format!("hz is {}, expected 0 for every step, or up to 1000", settings.hz)));
    }
    if settings.obstacles_hz != 0.0 && !(OBSTACLES_HZ_MIN..=1000.0).contains(&settings.obstacles_hz) {
        return Err(refused(format!(
            "obstacles_hz is {}, expected 0 for every step, or {OBSTACLES_HZ_MIN} to 1000: autopilots forget obstacles \
             within half a second",
            settings.obstacles_hz
        )));
    }
    let reach_cm = reach_cm(settings.obstacles_m_max).map_err(refused)?;
    let wire = Wire::open(settings).map_err(refused)?;
    let (stream, pace) = (Stream::new(settings.hz), Pace::new(settings.obstacles_hz));
    Feed::open(NAME, Speaker { settings: settings.clone(), reach_cm, stream, pace, wire, said: None })
}

struct Speaker {
    settings: Mavlink,
    reach_cm: u16,
    stream: Stream,
    pace: Pace,
    wire: Wire,
    /// When flow was last said.
    said: Option<Instant>,
}

impl Voice for Speaker {
    fn reach_cm(&self) -> Option<u16> {
        self.settings.words.contains(&Word::Obstacles).then_some(self.reach_cm)
    }

    fn say(&mut self, moment: &Moment) -> Result<(), String> {
        let spans = self.stream.take(&moment.integrated);
        let due = spans[1].is_some();
        for span in spans.into_iter().flatten().filter(|_| self.settings.words.contains(&Word::Flow)) {
            let first = self.said.is_none_or(|said| said.elapsed() >= SILENCE);
            self.wire.send(&flow(&self.settings, &span, first))?;
            self.said = Some(clock::instant());
        }
        if due && self.settings.words.contains(&Word::Odometry) {
            let stamp_us = stamp_us(moment.integrated.newer, self.settings.time_offset_us);
            // Without a velocity there is nothing to say: PX4 notices the silence, and no value would mean "none".
            if let Some(velocity) = &moment.velocity {
                self.wire.send(&odometry(velocity, stamp_us))?;
            }
        }
        match &moment.ring {
            Some(ring) if self.pace.lets(ring.newer) => self.wire.send(&obstacles(&self.settings, ring)),
            _ => Ok(()),
        }
    }

    fn tend(&mut self) -> Result<(), String> {
        self.wire.tend()
    }
}

/// The flow straight below, as the autopilot takes it. `first`: nothing was said for a while.
fn flow(settings: &Mavlink, span: &Span, first: bool) -> MavMessage {
    match settings.autopilot {
        Autopilot::Px4 => px4_flow(settings, span),
        Autopilot::Ardupilot => ardupilot_flow(settings, span, first),
    }
}

/// PX4 hands the angles on as they are and looks at the quality late: it adds samples up where they come faster than
/// SENS_FLOW_RATE, and a zero among them would pass for half a speed. NaN spoils such a sum, and EKF2 drops it.
/// Without a gyro NaN makes PX4 integrate its own.
fn px4_flow(settings: &Mavlink, span: &Span) -> MavMessage {
    let [x, y] = span.flow.unwrap_or([f64::NAN; 2]).map(|angle| angle as f32);
    let [xgyro, ygyro, zgyro] = span.gyro.unwrap_or([f64::NAN; 3]).map(|angle| angle as f32);
    MavMessage::OPTICAL_FLOW_RAD(OPTICAL_FLOW_RAD_DATA {
        time_usec: span.stamp_us(settings.time_offset_us),
        integration_time_us: span.micros(),
        integrated_x: x,
        integrated_y: y,
        integrated_xgyro: xgyro,
        integrated_ygyro: ygyro,
        integrated_zgyro: zgyro,
        // The distance is that at the older frame.
        time_delta_distance_us: if span.distance.is_some() { span.micros() } else { 0 },
        distance: span.distance.unwrap_or(-1.0) as f32,
        // There is no value for "not measured", and nobody reads it.
        temperature: 0,
        sensor_id: settings.sensor,
        quality: span.quality,
    })
}

/// ArduPilot takes rates, and its own gyro's part off them. EKF3 looks at the quality before it looks at anything else,
/// so a blind step is zeros of quality 0. NaN would do on a vehicle but stops its simulator (a trapped exception), and
/// silence would make the next good step a rate of zero.
fn ardupilot_flow(settings: &Mavlink, span: &Span, first: bool) -> MavMessage {
    let rates = span.flow.unwrap_or([0.0; 2]).map(|angle| angle / span.seconds().max(1e-6));
    let compensated = |axis: usize| match (span.flow, span.gyro, span.distance) {
        (Some(flow), Some(gyro), Some(distance)) => {
            ((flow[axis] - gyro[axis]) / span.seconds().max(1e-6) * distance) as f32
        }
        _ => f32::NAN,
    };
    // Tenths of a pixel, for those that do not know the rates; the cast saturates.
    let tenths = |axis: usize| match (span.flow, span.focal_px) {
        (Some(flow), Some(focal_px)) => (10.0 * focal_px * flow[axis]).round() as i16,
        _ => 0,
    };
    MavMessage::OPTICAL_FLOW(OPTICAL_FLOW_DATA {
        time_usec: span.stamp_us(settings.time_offset_us),
        flow_comp_m_x: compensated(0),
        flow_comp_m_y: compensated(1),
        ground_distance: span.distance.unwrap_or(-1.0) as f32,
        flow_x: tenths(0),
        flow_y: tenths(1),
        sensor_id: settings.sensor,
        quality: if first { 0 } else { span.quality },
        flow_rate_x: rates[0] as f32,
        flow_rate_y: rates[1] as f32,
    })
}

/// ArduPilot takes what is free for what is unknown, and passes over both.
fn obstacles(settings: &Mavlink, ring: &Ring) -> MavMessage {
    let ring = match settings.autopilot {
        Autopilot::Px4 => ring.paired(),
        Autopilot::Ardupilot => *ring,
    };
    MavMessage::OBSTACLE_DISTANCE(OBSTACLE_DISTANCE_DATA {
        time_usec: stamp_us(ring.newer, settings.time_offset_us),
        distances: ring.cm,
        min_distance: MIN_CM,
        max_distance: ring.max_cm,
        // A camera is none of those that have a number.
        sensor_type: MavDistanceSensor::MAV_DISTANCE_SENSOR_UNKNOWN,
        increment: INCREMENT_DEG,
        increment_f: f32::from(INCREMENT_DEG),
        angle_offset: 0.0,
        frame: MavFrame::MAV_FRAME_BODY_FRD,
    })
}

/// The velocity in the body's own axes (FRD); pose and attitude are unknown, and say so by NaN.
fn odometry(velocity: &Velocity, stamp_us: u64) -> MavMessage {
    // FLU to FRD turns y and z around.
    let sign = |axis: usize| if axis.is_multiple_of(3) { 1.0 } else { -1.0 };
    let [vx, vy, vz] = std::array::from_fn(|i| (sign(i) * velocity.linear[i]) as f32);
    let observed = (3..6).all(|i| velocity.covariance[i][i] < UNOBSERVED);
    let [rollspeed, pitchspeed, yawspeed] =
        std::array::from_fn(|i| if observed { (sign(i) * velocity.angular[i]) as f32 } else { f32::NAN });
    let mut upper = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
    let velocity_covariance = std::array::from_fn(|_| {
        let (row, column) = upper.next().unwrap_or((5, 5));
        (sign(row) * sign(column) * velocity.covariance[row][column]) as f32
    });
    MavMessage::ODOMETRY(ODOMETRY_DATA {
        time_usec: stamp_us,
        x: f32::NAN,
        y: f32::NAN,
        z: f32::NAN,
        q: [f32::NAN; 4],
        vx,
        vy,
        vz,
        rollspeed,
        pitchspeed,
        yawspeed,
        pose_covariance: [f32::NAN; 21],
        velocity_covariance,
        frame_id: MavFrame::MAV_FRAME_LOCAL_FRD,
        child_frame_id: MavFrame::MAV_FRAME_BODY_FRD,
        reset_counter: 0,
        estimator_type: MavEstimatorType::MAV_ESTIMATOR_TYPE_VISION,
        // Per cent, where 0 means unknown.
        quality: (1 + u32::from(velocity.quality) * 99 / 255) as i8,
    })
}
