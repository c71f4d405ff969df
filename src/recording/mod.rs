//! Stage 6: what happened is kept in MCAP, and can be fed back.

pub mod check;
mod fields;
mod outputs;
mod pen;
mod queue;
mod recorder;
mod repair;
mod rosbag2;
mod writer;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

pub use outputs::{Output, Outputs, metadata};
pub use recorder::Recorder;
pub use repair::{Original, Repaired, repair};
pub use writer::{Definition, Writer};

use crate::wire;

/// Why a recording can't be written or read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file system refuses.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The MCAP library refuses.
    #[error("{path}: {source}")]
    Mcap {
        /// The file.
        path: PathBuf,
        /// What the library says.
        source: ::mcap::McapError,
    },
    /// Two kinds of message on one topic.
    #[error("{topic} carries {expected}, found {found}")]
    Type {
        /// The topic.
        topic: String,
        /// What the topic's channel was opened with.
        expected: String,
        /// What came.
        found: String,
    },
    /// The file holds nothing that could be kept.
    #[error("{path} is no MCAP file: {reason}")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Expected against found.
        reason: String,
    },
    /// The writing thread can't be started or is gone.
    #[error("the recorder's thread: {0}")]
    Thread(String),
    /// A message can't become bytes.
    #[error(transparent)]
    Wire(#[from] wire::Error),
}

/// `[recording]`: what is kept, and how safely.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The file to write; absent records nothing.
    pub path: Option<std::path::PathBuf>,
    /// How chunks are compressed.
    pub compression: Compression,
    /// Chunks are closed and synced this often: what a power cut can cost at most.
    pub sync_s: f64,
    /// Keep the raw frames (needed for replay).
    pub frames: bool,
    /// Keep the dense flow and its confidence.
    pub flow: bool,
    /// Samples and steps that may wait for the disk.
    pub queue_max: usize,
}

impl Default for Config {
    fn default() -> Self {
        Self { path: None, compression: Compression::Lz4, sync_s: 1.0, frames: true, flow: true, queue_max: 64 }
    }
}

/// Why each default is what it is, by key.
pub const REASONS: &[(&str, &str)] = &[
    ("path", "absent: nothing is recorded unless a file is named"),
    ("compression", "lz4: 300 MB/s on one core, twice what 1280×1024×16 bit at 60 Hz makes; zstd saves a third more"),
    ("sync_s", "1: what a power cut can cost at most; a shorter interval makes smaller chunks and more of them"),
    ("frames", "true: without the frames there is nothing to replay"),
    ("flow", "true: at quarter resolution flow and confidence are a tenth of the frames"),
    ("queue_max", "64: two seconds of frames at 30 Hz for a disk that stalls"),
];

/// How chunks are compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// Fastest, largest.
    None,
    /// Keeps up with 1280×1024×16 bit at 60 Hz on one core.
    Lz4,
    /// Smallest; for the desk.
    Zstd,
}
