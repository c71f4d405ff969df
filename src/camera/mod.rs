//! Stage 1: samples come in, from ROS 2, from zenoh or from a recording.

pub mod latest;
pub mod mcap;
pub mod ros2;
pub mod zenoh;

use std::{sync::Arc, time::Duration};

use serde::{Deserialize, Serialize};

use crate::{
    clock::Stamp,
    wire::{self, CameraInfo, Image, Imu, Range, TfMessage, Width},
};

/// A camera frame as it came: the mosaic is looked at by [`crate::exposure`] only.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The image as published.
    pub image: Image,
    /// When it arrived here.
    pub received: Stamp,
}

impl Frame {
    /// When the frame was taken.
    pub fn stamp(&self) -> Stamp {
        self.image.header.stamp.into()
    }
}

/// Whatever can come in; each keeps its own stamp.
#[derive(Debug, Clone, PartialEq)]
pub enum Sample {
    /// A raw frame; shared, so that the recorder keeps it without a copy.
    Frame(Arc<Frame>),
    /// The camera's calibration.
    Info(Arc<CameraInfo>),
    /// Body rates.
    Imu(Arc<Imu>),
    /// Distance to the ground.
    Range(Arc<Range>),
    /// Where frames of reference stand in each other.
    Transforms(Arc<TfMessage>),
    /// How wide images are developed from now on: the node's own decision, which a replay must know.
    Width(Arc<Width>),
}

impl Sample {
    /// The sample's own stamp.
    pub fn stamp(&self) -> Stamp {
        match self {
            Sample::Frame(frame) => frame.stamp(),
            Sample::Info(info) => info.header.stamp.into(),
            Sample::Imu(imu) => imu.header.stamp.into(),
            Sample::Range(range) => range.header.stamp.into(),
            Sample::Width(width) => width.header.stamp.into(),
            Sample::Transforms(message) => {
                message.transforms.iter().map(|one| one.header.stamp.into()).min().unwrap_or_default()
            }
        }
    }
}

/// What a source answers.
#[derive(Debug, Clone, PartialEq)]
pub enum Next {
    /// The next sample. Small samples older than the frame come before it.
    Sample(Sample),
    /// Nothing came within the wait.
    Idle,
    /// Nothing will ever come again.
    End,
}

/// What a source counted so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Frames that arrived whole.
    pub arrived: u64,
    /// Frames that a newer one displaced before they were taken.
    pub displaced: u64,
    /// Messages that could not be decoded.
    pub torn: u64,
    /// Small samples (gyro, range, calibration) that found their queue full.
    pub overrun: u64,
    /// Frames that their sender numbered and that never came whole: the network lost or tore them.
    pub missed: u64,
}

/// Where samples come from.
pub trait Source: Send {
    /// The next sample, waiting for at most `wait`. A live source gives the newest frame and counts what it displaced.
    fn next(&mut self, wait: Duration) -> Result<Next, Error>;
    /// What was counted so far.
    fn counts(&self) -> Counts;
    /// Progress through a finite source, 0…1; `None` for a live one.
    fn progress(&self) -> Option<f64> {
        None
    }
}

/// Why a source fails.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The source cannot be opened or was lost; it may come back.
    #[error("camera source {source_name}: {reason}")]
    Lost {
        /// `ros2`, `zenoh` or the file.
        source_name: String,
        /// What happened.
        reason: String,
    },
    /// One message could not be decoded; the source goes on.
    #[error("a message on {topic} is torn: {reason}")]
    Torn {
        /// Topic or key.
        topic: String,
        /// Expected against found.
        reason: String,
    },
    /// The settings make no sense.
    #[error("camera settings: {0}")]
    Settings(String),
    /// A message could not be decoded.
    #[error(transparent)]
    Wire(#[from] wire::Error),
}

/// `[camera]`: where samples come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The source, by its name as a table: `[camera.source.ros2]`, `[camera.source.zenoh]`, `[camera.source.mcap]`.
    pub source: SourceConfig,
    /// Topic of the raw frames.
    pub image_topic: String,
    /// Topic of the calibration.
    pub info_topic: String,
    /// Topic of the body rates.
    pub imu_topic: String,
    /// Topic of the range finder.
    pub range_topic: String,
    /// Topic of the transforms, for `[motion] camera = "tf"`; empty reads none.
    pub tf_topic: String,
    /// Topic of a recording on which the governor's widths are; see `[exposure] width_min`.
    pub width_topic: String,
    /// A source is called lost after this time without a frame.
    pub silence_s_max: f64,
    /// How long an exposure lasts that begins at its frame's stamp.
    pub exposure_s: f64,
}

impl Config {
    /// Whether the source waits for whoever takes its samples: a recording that is not read at its own pace does, and
    /// nothing of it need be lost to a slow taker.
    pub fn waits(&self) -> bool {
        matches!(&self.source, SourceConfig::Mcap(mcap) if !mcap.realtime)
    }
}

impl Default for Config {
    fn default() -> Self {
        Self {
            source: SourceConfig::Ros2(Ros2::default()),
            image_topic: "/camera/image_raw".into(),
            info_topic: "/camera/camera_info".into(),
            imu_topic: "/imu/data_raw".into(),
            range_topic: "/range".into(),
            tf_topic: "/tf_static".into(),
            width_topic: "/nightflow/width".into(),
            silence_s_max: 1.0,
            exposure_s: 0.0,
        }
    }
}

/// Why each default is what it is, by key.
pub const REASONS: &[(&str, &str)] = &[
    ("image_topic", "the name that image drivers of ROS 2 use"),
    ("info_topic", "beside the images, as camera drivers put it"),
    ("imu_topic", "REP 145: what the sensor measured, with no orientation mixed in"),
    ("range_topic", "no convention exists; set it to the range finder's"),
    ("tf_topic", "where robot_state_publisher says how sensors sit; a camera on a moving gimbal is told on /tf"),
    ("width_topic", "beside the node's other results; only replays read it"),
    ("silence_s_max", "1: thirty frames of a 30 Hz camera, and soon enough for a pilot"),
    (
        "exposure_s",
        "0: no message tells it; gyro and range are looked at in the middle of the exposure, which is the stamp without it",
    ),
    ("source.ros2.domain", "0: what ROS_DOMAIN_ID is where nobody set it"),
    ("source.ros2.reliable", "false: a frame that has to be sent again comes too late"),
    (
        "source.ros2.receive_buffer_bytes",
        "0: all that the kernel allows, for a frame comes as hundreds of datagrams at once",
    ),
    ("source.zenoh.connect", "where the router of rmw_zenoh listens on this machine"),
    ("source.zenoh.listen", "none: a free port of this machine only, as rmw_zenoh's nodes do"),
    ("source.zenoh.rmw", "true: the camera is a ROS 2 node with rmw_zenoh; false for plain zenoh programs"),
    ("source.zenoh.domain", "0: what ROS_DOMAIN_ID is where nobody set it"),
    ("source.mcap.path", "none: a recording has to be named"),
    ("source.mcap.realtime", "false: every frame is looked at, at the machine's own pace"),
];

/// The kinds of source.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SourceConfig {
    /// ROS 2 over DDS.
    Ros2(Ros2),
    /// zenoh, plain keys or rmw_zenoh's.
    Zenoh(Zenoh),
    /// A recording.
    Mcap(Mcap),
}

/// `[camera.source.ros2]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Ros2 {
    /// DDS domain.
    pub domain: u16,
    /// Ask for reliable delivery instead of best effort.
    pub reliable: bool,
    /// Socket receive buffer; 0 takes what the kernel allows at most.
    pub receive_buffer_bytes: usize,
}

/// `[camera.source.zenoh]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Zenoh {
    /// Endpoints to connect to; a ROS 2 machine's router listens on tcp/localhost:7447.
    pub connect: Vec<String>,
    /// Endpoints to listen on.
    pub listen: Vec<String>,
    /// Keys and attachments of rmw_zenoh (true), or the topic itself as the key (false).
    pub rmw: bool,
    /// ROS domain, first part of rmw_zenoh's keys.
    pub domain: u16,
}

impl Default for Zenoh {
    fn default() -> Self {
        Self { connect: vec!["tcp/localhost:7447".into()], listen: vec![], rmw: true, domain: 0 }
    }
}

/// `[camera.source.mcap]`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Mcap {
    /// The recording.
    pub path: std::path::PathBuf,
    /// Keep the recording's own pace and drop as a live source does, instead of giving every frame.
    pub realtime: bool,
}

/// Opens the source that the settings name.
pub fn open(config: &Config) -> Result<Box<dyn Source>, Error> {
    match &config.source {
        SourceConfig::Ros2(settings) => Ok(Box::new(ros2::Ros2Source::open(config, settings)?)),
        SourceConfig::Zenoh(settings) => Ok(Box::new(zenoh::ZenohSource::open(config, settings)?)),
        SourceConfig::Mcap(recording) => mcap::open(config, recording),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_key_of_every_source_has_a_reason_and_no_reason_is_left_over() {
        let sources = [
            SourceConfig::Ros2(Ros2::default()),
            SourceConfig::Zenoh(Zenoh::default()),
            SourceConfig::Mcap(Mcap::default()),
        ];
        let mut keys = BTreeSet::new();
        for source in sources {
            let table = toml::Table::try_from(Config { source, ..Config::default() }).unwrap();
            list(&mut keys, "", &table);
        }
        let reasons: BTreeSet<String> = REASONS.iter().map(|(key, _)| (*key).to_owned()).collect();
        assert_eq!(keys, reasons);
    }

    fn list(keys: &mut BTreeSet<String>, under: &str, table: &toml::Table) {
        for (key, value) in table {
            match value {
                toml::Value::Table(inner) => list(keys, &format!("{under}{key}."), inner),
                _ => drop(keys.insert(format!("{under}{key}"))),
            }
        }
    }
}
