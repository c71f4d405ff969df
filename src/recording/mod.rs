//! Stage 6: what happened is kept in MCAP, and can be fed back.

use serde::{Deserialize, Serialize};

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
