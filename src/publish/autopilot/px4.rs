//! PX4's own topics over DDS, as its uXRCE-DDS agent reads them: `/fmu/in/…`, stamps in microseconds.

use std::thread::JoinHandle;

use ros2_client::dds::{Node, Publisher};
use serde::{Deserialize, Serialize};

use super::{
    feed::{Feed, Moment, Voice},
    reach_cm,
    ring::{INCREMENT_DEG, MIN_CM, Ring},
    stream::{Span, Stream, stamp_us},
};
use crate::{
    camera::ros2 as dds,
    clock,
    publish::{
        Error,
        ros2::{ACK_BUFFER, publish, publisher},
    },
    wire::{ObstacleDistance, SensorOpticalFlow, VehicleOpticalFlow},
};

const NAME: &str = "px4";
/// MAV_FRAME_BODY_FRD.
const BODY_FRD: u8 = 12;
/// MAV_DISTANCE_SENSOR_UNKNOWN: a camera is none of those that have a number.
const SENSOR_UNKNOWN: u8 = 4;

/// `[publish.px4]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Px4 {
    /// DDS domain of the agent.
    pub domain: u16,
    /// What stands before `/fmu/in`, as in `/px4_1`; empty for a single vehicle.
    pub namespace: String,
    /// What is said.
    pub topics: Vec<Topic>,
    /// The sensor's number; it stays the same, and is not 0.
    pub device_id: u32,
    /// Steps are joined so that flow goes out at most this often; 0 says every step.
    pub hz: f64,
    /// Metres up to which obstacles are told, and up to which a sector must be free to be told so.
    pub obstacles_m_max: f64,
    /// Added to every stamp that goes out.
    pub time_offset_us: i64,
}

/// A topic of PX4's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Topic {
    /// `/fmu/in/sensor_optical_flow`: the flow straight below, through PX4's own sensor stage.
    SensorOpticalFlow,
    /// `/fmu/in/vehicle_optical_flow`: the same past that stage; PX4 reads it only if its dds_topics.yaml names it.
    VehicleOpticalFlow,
    /// `/fmu/in/obstacle_distance`: what is in the way, step by step, where `[motion.obstacles]` looks for it.
    ObstacleDistance,
}

impl Default for Px4 {
    fn default() -> Self {
        Self {
            domain: 0,
            namespace: String::new(),
            topics: vec![Topic::SensorOpticalFlow],
            device_id: 0x4E46,
            hz: 0.0,
            obstacles_m_max: 15.0,
            time_offset_us: 0,
        }
    }
}

/// Joins the domain and offers what `topics` names.
pub fn open(settings: &Px4) -> Result<Feed, Error> {
    let refused = |reason: String| Error::Open { sink: NAME, reason };
    if settings.topics.is_empty() {
        return Err(refused("topics is empty: name sensor_optical_flow or obstacle_distance".into()));
    }
    if settings.device_id == 0 {
        return Err(refused("device_id is 0, which PX4 takes for no sensor".into()));
    }
    if !(0.0..=1000.0).contains(&settings.hz) {
        return Err(refused(format!("hz is {}, expected 0 for every step, or up to 1000", settings.hz)));
    }
    let reach_cm = reach_cm(settings.obstacles_m_max).map_err(refused)?;
    Feed::open(NAME, Speaker::join(settings, reach_cm).map_err(refused)?)
}

struct Speaker {
    settings: Px4,
    stream: Stream,
    sensor: Option<Publisher<SensorOpticalFlow>>,
    vehicle: Option<Publisher<VehicleOpticalFlow>>,
    obstacles: Option<Publisher<ObstacleDistance>>,
    reach_cm: u16,
    /// Spans without flow so far.
    blind: u32,
    node: Option<Node>,
    spinning: Option<JoinHandle<()>>,
}

impl Speaker {
    fn join(settings: &Px4, reach_cm: u16) -> Result<Self, String> {
        let mut node = dds::join(settings.domain, "nightflow_px4", ACK_BUFFER)?;
        let spinner = node.spinner();
        let name = |topic: &str| format!("{}/fmu/in/{topic}", settings.namespace.trim_end_matches('/'));
        let wanted = |topic: Topic| settings.topics.contains(&topic);
        let sensor = wanted(Topic::SensorOpticalFlow).then(|| publisher(&mut node, &name("sensor_optical_flow")));
        let vehicle = wanted(Topic::VehicleOpticalFlow).then(|| publisher(&mut node, &name("vehicle_optical_flow")));
        let obstacles = wanted(Topic::ObstacleDistance).then(|| publisher(&mut node, &name("obstacle_distance")));
        Ok(Self {
            settings: settings.clone(),
            stream: Stream::new(settings.hz),
            sensor: sensor.transpose()?,
            vehicle: vehicle.transpose()?,
            obstacles: obstacles.transpose()?,
            reach_cm,
            blind: 0,
            node: Some(node),
            spinning: std::thread::Builder::new()
                .name("publish-px4-graph".into())
                .spawn(move || dds::on_tokio(dds::spin(spinner)))
                .ok(),
        })
    }

    fn span(&mut self, span: &Span) -> Result<(), String> {
        self.blind += u32::from(span.flow.is_none());
        let flow = sensed(&self.settings, span, self.blind);
        if let Some(vehicle) = &self.vehicle {
            publish(vehicle, &estimated(&flow))?;
        }
        match &self.sensor {
            Some(sensor) => publish(sensor, &flow),
            None => Ok(()),
        }
    }
}

impl Voice for Speaker {
    fn reach_cm(&self) -> Option<u16> {
        self.obstacles.as_ref().map(|_| self.reach_cm)
    }

    fn say(&mut self, moment: &Moment) -> Result<(), String> {
        let spans = self.stream.take(&moment.integrated);
        spans.into_iter().flatten().try_for_each(|span| self.span(&span))?;
        match (&self.obstacles, &moment.ring) {
            (Some(obstacles), Some(ring)) => publish(obstacles, &around(&self.settings, ring)),
            _ => Ok(()),
        }
    }
}

impl Drop for Speaker {
    fn drop(&mut self) {
        // The spinner ends with its node.
        drop(self.node.take());
        if let Some(spinning) = self.spinning.take() {
            let _ = spinning.join();
        }
    }
}

/// PX4 adds samples up where they come faster than SENS_FLOW_RATE, and a zero among them would pass for half a speed:
/// NaN spoils such a sum, and EKF2 drops it.
fn sensed(settings: &Px4, span: &Span, blind: u32) -> SensorOpticalFlow {
    let now_us = clock::now().ns().div_euclid(1000).saturating_add(settings.time_offset_us);
    let narrow = |angle: f64| angle as f32;
    SensorOpticalFlow {
        timestamp: u64::try_from(now_us).unwrap_or(0),
        timestamp_sample: span.stamp_us(settings.time_offset_us),
        device_id: settings.device_id,
        pixel_flow: span.flow.unwrap_or([f64::NAN; 2]).map(narrow),
        delta_angle: span.gyro.unwrap_or([f64::NAN; 3]).map(narrow),
        delta_angle_available: span.gyro.is_some(),
        distance_m: span.distance.unwrap_or(f64::NAN) as f32,
        distance_available: span.distance.is_some(),
        integration_timespan_us: span.micros(),
        quality: span.quality,
        error_count: blind,
        // Not a number leaves the limits to PX4's own parameters.
        max_flow_rate: f32::NAN,
        min_ground_distance: f32::NAN,
        max_ground_distance: f32::NAN,
        mode: 0,
    }
}

/// PX4 takes the stamp for the time of what was seen, and what is older than half a second for nothing.
fn around(settings: &Px4, ring: &Ring) -> ObstacleDistance {
    let cm = ring.paired().cm;
    ObstacleDistance {
        timestamp: stamp_us(ring.newer, settings.time_offset_us),
        frame: BODY_FRD,
        sensor_type: SENSOR_UNKNOWN,
        distances: std::array::from_fn(|row| std::array::from_fn(|i| cm[12 * row + i])),
        increment: f32::from(INCREMENT_DEG),
        min_distance: MIN_CM,
        max_distance: ring.max_cm,
        angle_offset: 0.0,
    }
}

fn estimated(flow: &SensorOpticalFlow) -> VehicleOpticalFlow {
    VehicleOpticalFlow {
        timestamp: flow.timestamp,
        timestamp_sample: flow.timestamp_sample,
        device_id: flow.device_id,
        pixel_flow: flow.pixel_flow,
        delta_angle: flow.delta_angle,
        distance_m: flow.distance_m,
        integration_timespan_us: flow.integration_timespan_us,
        quality: flow.quality,
        max_flow_rate: flow.max_flow_rate,
        min_ground_distance: flow.min_ground_distance,
        max_ground_distance: flow.max_ground_distance,
    }
}
