//! The settings of this stage, each with its reason.

use serde::{Deserialize, Serialize};

use super::Error;

/// `[exposure]`: how raw counts are read, and how they become an image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Columns of the image that the network sees; rows follow from the camera's shape. 320: the network's time grows
    /// with the area, and averaging the pixels of a dark image is what makes its flow readable.
    pub width_max: usize,
    /// Columns down to which a live node may narrow the image where it can't keep the camera's rate, in steps of 64. Unset:
    /// it never does, and frames are displaced by newer ones instead.
    pub width_min: Option<usize>,
    /// Mean that the gain brings the image to. 0.4: the paper's value, so that training and flight agree.
    pub mean_target: f32,
    /// Bits that the sensor really gives: 8, 10, 12, 14 or 16. Unset: the encoding's own, for no message states it.
    pub bit_depth: Option<u8>,
    /// Which end of a 16-bit container the counts stand at. Low: what most drivers publish.
    pub justification: Justification,
    /// Counts without light. Unset: 0, which is right only for cameras that take the black level off themselves.
    pub black_level: Option<f32>,
    /// Counts at which a pixel is full. Unset: the largest that the bit depth can hold.
    pub white_level: Option<f32>,
    /// Colours of the mosaic, for `16UC1` and `8UC1`, which do not name them. Unset: those are monochrome.
    pub pattern: Option<Pattern>,
    /// MIPI packing of the bytes of `8UC1`. Unset: one byte a pixel.
    pub packing: Option<Packing>,
    /// Largest gain. 1000: there 12-bit counts stand at a mean of 1.6 above black, which is the black level's own
    /// uncertainty; more gain would show the sensor's pattern instead of the scene.
    pub gain_max: f32,
    /// The gain is held while the smoothed target stays within this part of it. 0.1: outside the flicker of mains
    /// lamps, inside what the network's training covers; a held gain lets the older frame's features be kept.
    pub gain_band: f32,
    /// Weight of the newest frame in the smoothed mean. 0.2: five frames, several periods of a lamp's beat.
    pub gain_smoothing: f32,
    /// Ratio of two frames' means from which a lamp is taken to have gone on or off. 2: twice what a pan over a
    /// half-lit scene changes between frames at 30 Hz, half of what a lamp in the dark does.
    pub gain_step_factor: f32,
    /// A lone pixel is hot from this many mean absolute differences above its brightest neighbour; 0 repairs none.
    /// 8: nine standard deviations of Gaussian noise, so that noise itself is never cut and its mean not moved.
    pub hot_threshold: f32,
}

/// Why each setting of `[exposure]` has the value that it has by default.
pub const REASONS: &[(&str, &str)] = &[
    ("width_max", "the network's time grows with the area, and averaged pixels make a dark image readable"),
    (
        "width_min",
        "unset: accuracy before rate; 192 has a third of the cells of 320, and costs about as much less time",
    ),
    ("mean_target", "the paper's value, so that training and flight agree"),
    ("bit_depth", "8, 10, 12, 14 or 16; unset takes the encoding's own, for no message states it"),
    ("justification", "low is what most drivers publish in 16-bit containers"),
    ("black_level", "counts without light; unset is 0, right only for cameras that take it off themselves"),
    ("white_level", "counts of a full pixel; unset is the largest that the bit depth can hold"),
    ("pattern", "colours of 16UC1 and 8UC1, which do not name them; unset reads those as monochrome"),
    ("packing", "raw10 or raw12 in the bytes of 8UC1; unset is one byte a pixel"),
    ("gain_max", "12-bit counts stand 1.6 above black there, which is the black level's own uncertainty"),
    ("gain_band", "outside the flicker of mains lamps; a held gain lets the older frame's features be kept"),
    ("gain_smoothing", "five frames, several periods of a lamp's beat against the frame rate"),
    ("gain_step_factor", "above what a pan changes between two frames, below what a lamp in the dark does"),
    ("hot_threshold", "nine standard deviations of Gaussian noise, so that noise itself is never cut; 0 repairs none"),
];

impl Default for Config {
    fn default() -> Self {
        Self {
            width_max: 320,
            width_min: None,
            mean_target: 0.4,
            bit_depth: None,
            justification: Justification::Low,
            black_level: None,
            white_level: None,
            pattern: None,
            packing: None,
            gain_max: 1000.0,
            gain_band: 0.1,
            gain_smoothing: 0.2,
            gain_step_factor: 2.0,
            hot_threshold: 8.0,
        }
    }
}

/// Which end of its container a count stands at.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Justification {
    /// The high bits are zero.
    #[default]
    Low,
    /// The low bits are zero.
    High,
}

/// Colours of a mosaic: the first two columns of its first two rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)]
pub enum Pattern {
    Rggb,
    Bggr,
    Gbrg,
    Grbg,
}

impl std::fmt::Display for Pattern {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Pattern::Rggb => "rggb",
            Pattern::Bggr => "bggr",
            Pattern::Gbrg => "gbrg",
            Pattern::Grbg => "grbg",
        })
    }
}

/// MIPI CSI-2 packing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Packing {
    /// Four pixels in five bytes: their high eight bits each, then the low two of all, the first pixel's lowest.
    Raw10,
    /// Two pixels in three bytes: their high eight bits each, then the low four of both, the first pixel's lowest.
    Raw12,
}

impl Packing {
    pub(super) const fn bits(self) -> u8 {
        match self {
            Packing::Raw10 => 10,
            Packing::Raw12 => 12,
        }
    }

    /// Pixels and bytes of a group.
    pub(super) const fn group(self) -> [u64; 2] {
        match self {
            Packing::Raw10 => [4, 5],
            Packing::Raw12 => [2, 3],
        }
    }
}

impl std::fmt::Display for Packing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "raw{}", self.bits())
    }
}

impl Config {
    /// Refuses what no frame could be developed with.
    pub(super) fn check(&self) -> Result<(), Error> {
        let within = |key, value: f32, low: f32, high: f32| {
            if (low..=high).contains(&value) { Ok(()) } else { Err(Error::Settings { key, low, high, value }) }
        };
        within("width_max", self.width_max as f32, 1.0, 16384.0)?;
        if let Some(width_min) = self.width_min {
            within("width_min", width_min as f32, 1.0, self.width_max as f32)?;
        }
        within("mean_target", self.mean_target, 0.01, 0.99)?;
        within("gain_max", self.gain_max, 1.0, 1e6)?;
        within("gain_band", self.gain_band, 0.0, 10.0)?;
        within("gain_smoothing", self.gain_smoothing, 0.001, 1.0)?;
        within("gain_step_factor", self.gain_step_factor, 1.01, 1e6)?;
        within("hot_threshold", self.hot_threshold, 0.0, 1e6)?;
        if let Some(bit_depth) = self.bit_depth
            && ![8, 10, 12, 14, 16].contains(&bit_depth)
        {
            return Err(Error::BitDepth { bit_depth });
        }
        if let Some(packing) = self.packing {
            if let Some(bit_depth) = self.bit_depth.filter(|bits| *bits != packing.bits()) {
                return Err(Error::PackedDepth { packing, bits: packing.bits(), bit_depth });
            }
            if self.justification == Justification::High {
                return Err(Error::NoContainer { what: packing.to_string() });
            }
        }
        Ok(())
    }
}
