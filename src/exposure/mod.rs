//! Stage 2: raw counts become a linear image of normal brightness, the same gain for both frames of a pair.
//!
//! A frame is looked through once, row by row: its bytes become counts, hot pixels are repaired, the rows are summed
//! to the network's size, and what the counts say is held against what the settings declare. Nothing is clipped before
//! the gain, so that noise around black keeps its mean. The image before the gain is kept, so that the older frame of a
//! pair can be given another one.

use std::sync::Arc;

use crate::clock::Stamp;

mod config;
mod develop;
mod error;
mod gain;
mod hot;
mod layout;
mod linear;
mod mosaic;
mod noise;
mod reduce;
mod rows;
mod sums;

pub use config::{Config, Justification, Packing, Pattern, REASONS};
pub use develop::{Developer, Pairing};
pub use error::Error;
pub use linear::{Linear, Linearizer};
pub use mosaic::{Mosaic, Plane};
pub use noise::Noise;

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
    /// The same before the gain and the clip, where the frame was developed from raw counts; else empty.
    pub linear: Vec<f32>,
    /// 1 where a source pixel stood at the white level; `height` × `width`.
    pub saturated: Vec<u8>,
    /// Part of the developed pixels that are saturated.
    pub saturated_part: f32,
    /// Mean of the three colours above black, before the gain and unclipped; 1 = white level.
    pub raw_mean: f32,
    /// The gain in `rgb`.
    pub gain: f32,
    /// Changes whenever `rgb` does, so that features computed from it can be kept.
    pub generation: u64,
    /// The camera's noise as the newest frames show it; none before a frame was large enough to tell.
    pub noise: Option<Noise>,
    /// Deviation of the noise in a pixel of the developed image, in 1/255, once its mean is 0.4.
    pub noise_level: Option<f32>,
    /// The frame before had another stamp and the same bytes: the camera repeats itself.
    pub frozen: bool,
}

/// Two frames under one gain.
#[derive(Debug, Clone, Copy)]
pub struct Pair<'a> {
    /// The frame before.
    pub older: &'a Exposed,
    /// The frame that just came.
    pub newer: &'a Exposed,
    /// Newer mean over older mean, when the light changed by more than the settings allow (a lamp went on or off).
    pub gain_step: Option<f32>,
}
