//! Stage 2: raw counts become a linear image of normal brightness, the same gain for both frames of a pair.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::clock::Stamp;

/// A developed frame, ready for the network.
///
/// `rgb` is planar (3 × `height` × `width`, f32): linear, black level off, white level 1, times the pair's gain,
/// clipped to 0…1. A pixel of the network's image is the camera pixel `(p + 0.5) · scale − 0.5`.
#[derive(Debug, Clone, Default)]
pub struct Exposed {
    /// When the frame was taken.
    pub stamp: Stamp,
    /// The camera's optical frame.
    pub frame_id: Arc<str>,
    /// Columns of the developed image.
    pub width: usize,
    /// Rows of the developed image.
    pub height: usize,
    /// Camera pixels per developed pixel, x and y.
    pub scale: [f32; 2],
    /// The image, see above.
    pub rgb: Vec<f32>,
    /// 1 where a source pixel stood at the white level; `height` × `width`.
    pub saturated: Vec<u8>,
    /// Part of the developed pixels that are saturated.
    pub saturated_part: f32,
    /// Mean above black before the gain, 1 = white level.
    pub raw_mean: f32,
    /// The gain in `rgb`.
    pub gain: f32,
    /// Changes whenever `rgb` does, so that features computed from it can be kept.
    pub generation: u64,
}

/// Two frames under one gain.
#[derive(Debug, Clone, Copy)]
pub struct Pair<'a> {
    /// The frame before.
    pub older: &'a Exposed,
    /// The frame that just came.
    pub newer: &'a Exposed,
    /// The light changed by more than the settings allow between the two (a lamp went on or off).
    pub gain_step: bool,
}

/// `[exposure]`: how raw counts are read, and how they become an image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Columns of the image that the network sees; rows follow from the camera's shape.
    pub width_max: usize,
    /// Mean that the gain brings the image to.
    pub mean_target: f32,
}

impl Default for Config {
    fn default() -> Self {
        Self { width_max: 320, mean_target: 0.4 }
    }
}
