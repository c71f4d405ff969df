//! To an autopilot: the flow straight below, the velocity and obstacles, over MAVLink or as PX4's own topics over DDS.
//!
//! Both say the same of a step that has no trustworthy flow: quality 0, and no number that could be taken for a
//! measured one. The message still goes out, for its interval has passed, and an autopilot counts on the cadence. So it
//! is with obstacles: what can't be seen is unknown, and the message goes out though all of it is.

mod feed;
mod link;
pub mod mavlink;
pub mod px4;
mod ring;
mod stream;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use feed::Feed;
pub use px4::Px4;

/// `[publish.mavlink]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Mavlink {
    /// What listens, and in which dialect of habits.
    pub autopilot: Autopilot,
    /// What is said.
    pub words: Vec<Word>,
    /// MAVLink system that we belong to.
    pub system: u8,
    /// MAVLink component that we are.
    pub component: u8,
    /// Sensor within the component.
    pub sensor: u8,
    /// Steps are joined so that flow goes out at most this often; 0 says every step.
    pub hz: f64,
    /// Obstacles are told at most this often; 0 says every step.
    pub obstacles_hz: f64,
    /// Metres up to which obstacles are told, and up to which a sector must be free to be told so.
    pub obstacles_m_max: f64,
    /// Added to every stamp that goes out, the answers to TIMESYNC among them.
    pub time_offset_us: i64,
    /// How the autopilot is reached.
    pub link: Link,
}

/// How an autopilot is reached.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Link {
    /// Host and port that datagrams are sent to; answers come back the same way.
    Udp(String),
    /// A serial line: eight bits, no parity, one stop bit, no flow control.
    Serial(Serial),
}

/// `[publish.mavlink.link.serial]`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Serial {
    /// The device, as in `/dev/ttyTHS1`.
    pub path: PathBuf,
    /// Bits a second.
    pub baud: u32,
}

/// Who listens. It decides which messages are spoken, and how they say that there is nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Autopilot {
    /// PX4: OPTICAL_FLOW_RAD, ODOMETRY.
    Px4,
    /// ArduPilot: OPTICAL_FLOW.
    Ardupilot,
}

/// What is said.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Word {
    /// The flow straight below: OPTICAL_FLOW_RAD or OPTICAL_FLOW.
    Flow,
    /// The body's velocity, where it is metric: ODOMETRY. PX4 only.
    Odometry,
    /// What is in the way, where `[motion.obstacles]` looks for it: OBSTACLE_DISTANCE.
    Obstacles,
}

/// Centimetres of `obstacles_m_max`; one more than the greatest must not come near the number for "unknown".
fn reach_cm(obstacles_m_max: f64) -> Result<u16, String> {
    if !(1.0..=650.0).contains(&obstacles_m_max) {
        return Err(format!("obstacles_m_max is {obstacles_m_max}, expected 1 to 650 m"));
    }
    Ok((100.0 * obstacles_m_max) as u16)
}

impl Default for Mavlink {
    fn default() -> Self {
        Self {
            autopilot: Autopilot::Px4,
            words: vec![Word::Flow],
            system: 1,
            component: 197,
            sensor: 0,
            hz: 0.0,
            obstacles_hz: 10.0,
            obstacles_m_max: 15.0,
            time_offset_us: 0,
            link: Link::Udp("127.0.0.1:14580".into()),
        }
    }
}
