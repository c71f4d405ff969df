//! Stage 5: flow and velocity go out, to this machine's memory, to ROS 2, to zenoh and to an autopilot.

pub mod autopilot;
pub mod courier;
pub mod iceoryx2;
pub mod outgoing;
mod pace;
pub mod paint;
pub mod pictures;
mod plot;
pub mod ros2;
pub mod shared;
pub mod zenoh;

use serde::{Deserialize, Serialize};

pub use autopilot::{Mavlink, Px4};

/// `[publish.zenoh]`: the same settings as for a camera.
pub use crate::camera::Zenoh;

use crate::{
    camera::Sample,
    clock::Stamp,
    flow::{Flow, State},
    motion::{Integrated, Lack, NoSight, Obstacles, Velocity},
    wire,
};

/// Everything that one step found, but for the vectors themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct Moved {
    /// Counts from 0.
    pub step: u64,
    /// Stamp of the older frame.
    pub older: Stamp,
    /// Stamp of the newer frame.
    pub newer: Stamp,
    /// The camera's optical frame.
    pub frame_id: std::sync::Arc<str>,
    /// Camera frame size, columns and rows.
    pub camera_size: [u32; 2],
    /// The raster of the flow.
    pub grid: crate::flow::Grid,
    /// Gain that both frames were given.
    pub gain: f32,
    /// Mean above black of the newer frame, 1 = white.
    pub raw_mean: f32,
    /// The camera's noise, once it is known.
    pub noise: Option<crate::exposure::Noise>,
    /// Deviation of the noise in the developed newer frame at a mean of 0.4, in 1/255.
    pub noise_level: Option<f32>,
    /// Part of the newer frame that is saturated.
    pub saturated_part: f32,
    /// Mean confidence of the flow.
    pub confidence: f32,
    /// How far it can be trusted.
    pub state: State,
    /// The velocity, or what it lacks.
    pub velocity: Result<Velocity, Lack>,
    /// The flow straight below in an autopilot's form.
    pub integrated: Integrated,
    /// What is in the way, or why that is not known.
    pub obstacles: Result<Obstacles, NoSight>,
}

/// One step as a sink sees it.
#[derive(Clone, Copy)]
pub struct Offer<'a> {
    /// What was found.
    pub moved: &'a Moved,
    /// The vectors.
    pub flow: Flow<'a>,
    /// The developed newer frame, for previews.
    pub image: &'a crate::exposure::Exposed,
}

/// Where results go.
pub trait Sink: Send {
    /// The sink's name in messages and counters.
    fn name(&self) -> &'static str;
    /// A sample that the pipeline is about to see; only a recorder cares.
    fn sample(&mut self, _sample: &Sample) -> Result<(), Error> {
        Ok(())
    }
    /// A step's results. Must not wait: what can't be taken now is lost, counted and said.
    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), Error>;
    /// How the node fares, about once a second.
    fn status(&mut self, _status: &wire::Status) -> Result<(), Error> {
        Ok(())
    }
    /// Nothing follows: write out what is kept.
    fn finish(&mut self) -> Result<(), Error> {
        Ok(())
    }
    /// Steps or samples that this sink could not take.
    fn lost(&self) -> u64 {
        0
    }
}

/// A sink that somebody else wants back afterwards.
impl<S: Sink + ?Sized> Sink for &mut S {
    fn name(&self) -> &'static str {
        (**self).name()
    }

    fn sample(&mut self, sample: &Sample) -> Result<(), Error> {
        (**self).sample(sample)
    }

    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), Error> {
        (**self).offer(offer)
    }

    fn status(&mut self, status: &wire::Status) -> Result<(), Error> {
        (**self).status(status)
    }

    fn finish(&mut self) -> Result<(), Error> {
        (**self).finish()
    }

    fn lost(&self) -> u64 {
        (**self).lost()
    }
}

/// Why something did not go out.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The sink can't be opened.
    #[error("{sink} can't be opened: {reason}")]
    Open {
        /// The sink's name.
        sink: &'static str,
        /// What is missing and what to do.
        reason: String,
    },
    /// A step or sample was lost.
    #[error("{sink} lost {what}: {reason}")]
    Lost {
        /// The sink's name.
        sink: &'static str,
        /// What was lost.
        what: String,
        /// Why.
        reason: String,
    },
    /// There is too little shared memory.
    #[error(
        "/dev/shm has {free} bytes free, {needed} are needed for flow of {cells} cells; enlarge it (docker: --shm-size) or lower cells_max or subscribers_max in [publish.iceoryx2]"
    )]
    SharedMemory {
        /// Bytes free.
        free: u64,
        /// Bytes needed.
        needed: u64,
        /// Cells of the largest flow that must fit.
        cells: usize,
    },
}

/// `[publish]`: which sinks are open, and how.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Shared memory on this machine; `None` (absent) closes it.
    pub iceoryx2: Option<Iceoryx2>,
    /// ROS 2 over DDS.
    pub ros2: Option<Ros2>,
    /// zenoh.
    pub zenoh: Option<Zenoh>,
    /// An autopilot over MAVLink.
    pub mavlink: Option<Mavlink>,
    /// PX4's own topics over DDS.
    pub px4: Option<Px4>,
    /// Topics stand under this name.
    pub namespace: String,
    /// Frame of reference of the published velocity (FLU).
    pub body_frame: String,
    /// Dense flow and preview go out over the network at most this often; 0 sends none.
    pub image_hz_max: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            iceoryx2: Some(Iceoryx2::default()),
            ros2: None,
            zenoh: None,
            mavlink: None,
            px4: None,
            namespace: "/nightflow".into(),
            body_frame: "base_link".into(),
            image_hz_max: 2.0,
        }
    }
}

/// Why each default is what it is, by key.
pub const REASONS: &[(&str, &str)] = &[
    ("namespace", "the node's own name, as ROS 2 programs have it"),
    ("body_frame", "REP 105: the vehicle's own frame"),
    ("image_hz_max", "2: enough to watch; whoever needs every flow reads shared memory or the recording"),
    ("iceoryx2.prefix", "the same name as the topics'"),
    ("iceoryx2.subscribers_max", "4: each reader may hold samples, and their memory is set aside at the start"),
    ("iceoryx2.cells_max", "640×480: fits the 64 MB of /dev/shm that a container has"),
    ("ros2.domain", "0: what ROS_DOMAIN_ID is where nobody set it"),
    ("zenoh.connect", "where the router of rmw_zenoh listens on this machine"),
    ("zenoh.listen", "none: a free port of this machine only, as rmw_zenoh's nodes do"),
    ("zenoh.rmw", "true: the readers are ROS 2 nodes with rmw_zenoh; false for plain zenoh programs"),
    ("zenoh.domain", "0: what ROS_DOMAIN_ID is where nobody set it"),
    ("mavlink.autopilot", "px4: it takes the flow with the gyro of the very same interval"),
    ("mavlink.words", "flow: an autopilot that is told the velocity too would fuse the same light twice"),
    ("mavlink.system", "1: the vehicle's own number unless there are several"),
    ("mavlink.component", "197: what MAVLink calls a camera's odometry"),
    ("mavlink.sensor", "0: the first, and there is only one"),
    ("mavlink.hz", "0: every step, as long as the line has room for it"),
    ("mavlink.obstacles_hz", "10: what autopilots ask for, and 179 bytes each are a third of a line of 57,600 baud"),
    (
        "mavlink.obstacles_m_max",
        "15: as far as ArduPilot's BendyRuler looks; 7 m/s can be braked in 10 m, and from 2 m/s on 8 s reach that far",
    ),
    (
        "mavlink.time_offset_us",
        "0: stamps are the camera's, and TIMESYNC tells the autopilot how its clock stands to them",
    ),
    ("mavlink.link", "where PX4's simulator listens for a companion; on a vehicle it is mostly a serial line"),
    ("px4.domain", "0: what the agent joins where nobody told it otherwise"),
    ("px4.namespace", "none: PX4 has none where it flies alone"),
    ("px4.topics", "sensor_optical_flow: PX4 as it is built reads it, and keeps our stamps"),
    ("px4.device_id", "any number that stays the same: what counts is that it is not 0"),
    ("px4.hz", "0: every step; PX4 joins what is too fast for it"),
    ("px4.obstacles_m_max", "15: 7 m/s can be braked in 10 m, and from 2 m/s on the horizon of 8 s reaches that far"),
    ("px4.time_offset_us", "0: the agent's machine is this one, and the agent tells PX4 its clock"),
];

/// `[publish.iceoryx2]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Iceoryx2 {
    /// Service names begin with this.
    pub prefix: String,
    /// The most readers of a service.
    pub subscribers_max: usize,
    /// Cells of the largest flow that must fit.
    pub cells_max: usize,
}

impl Default for Iceoryx2 {
    fn default() -> Self {
        Self { prefix: "nightflow".into(), subscribers_max: 4, cells_max: 640 * 480 }
    }
}

/// `[publish.ros2]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ros2 {
    /// DDS domain.
    pub domain: u16,
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_key_of_every_sink_has_a_reason_and_no_reason_is_left_over() {
        let all = Config {
            ros2: Some(Ros2::default()),
            zenoh: Some(Zenoh::default()),
            mavlink: Some(Mavlink::default()),
            px4: Some(Px4::default()),
            ..Config::default()
        };
        let mut keys = BTreeSet::new();
        for (key, value) in toml::Table::try_from(all).unwrap() {
            match value {
                toml::Value::Table(inner) => keys.extend(inner.keys().map(|name| format!("{key}.{name}"))),
                _ => drop(keys.insert(key)),
            }
        }
        assert_eq!(keys, REASONS.iter().map(|(key, _)| (*key).to_owned()).collect());
    }
}
