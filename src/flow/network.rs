//! What the matcher asks of a network, whatever it is made of.

use std::path::PathBuf;

use crate::flow::{
    Error, Operators,
    padding::{self, Padded},
};

/// Which of the two places for a frame's features.
///
/// Two are enough: a step needs the features of the newer frame and of the one before it, and the newer frame of this
/// step is the older one of the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Slot {
    /// One.
    A,
    /// The other.
    B,
}

impl Slot {
    /// The one that this is not.
    pub fn other(self) -> Slot {
        match self {
            Slot::A => Slot::B,
            Slot::B => Slot::A,
        }
    }

    /// 0 or 1.
    pub fn index(self) -> usize {
        self as usize
    }
}

/// Where a network writes: a quarter of the padded image's rows and columns.
#[derive(Debug)]
pub struct Raster<'a> {
    /// rows × columns × 2: (u right, v down) from the older to the newer frame, in camera pixels.
    pub flow: &'a mut [f32],
    /// rows × columns: the expected end-point error in pixels of the network's image.
    pub uncertainty: &'a mut [f32],
}

/// A network that finds flow between two images.
///
/// It comes in two steps, so that what concerns one frame alone is done once though the frame stands in two pairs. A
/// graph that takes two images at once keeps the image in `describe` and does its work in `between`.
pub trait Network: Send {
    /// Rows and columns of the images must be multiples of this.
    fn stride(&self) -> usize {
        padding::STRIDE
    }

    /// Looks at one frame and keeps what it found in `slot`. Both slots always hold frames of one size.
    fn describe(&mut self, slot: Slot, image: &Padded<'_>) -> Result<(), Error>;

    /// Flow from the frame in `older` to the frame in the other slot; `scale` is camera pixels per network pixel.
    fn between(&mut self, older: Slot, scale: [f32; 2], out: Raster<'_>) -> Result<(), Error>;

    /// What is known about it.
    fn model(&self) -> &Model;

    /// What its exporter noted, to be computed again here.
    fn golden(&self) -> Option<&Golden> {
        None
    }

    /// Ends the record of what each node takes, and says in which files it is; none where nothing was recorded.
    fn end_profile(&mut self) -> Result<Vec<PathBuf>, Error> {
        Ok(vec![])
    }

    /// How many results were not written where they belong and had to be copied there.
    fn copied(&self) -> u64 {
        0
    }
}

/// Which network runs, in words that a recording keeps.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Model {
    /// Its name in the manifest.
    pub name: String,
    /// Its version in the manifest.
    pub version: String,
    /// sha256 of each of its files, by file name: the pyramid, the decoder, and the upsampler if it runs.
    pub sha256: Vec<(String, String)>,
    /// What computes its cost volumes.
    pub operators: Operators,
    /// What really computes it, with its version.
    pub provider: String,
    /// The library that computes it; empty where there is none.
    pub library: PathBuf,
}

/// Flow that the exporter noted for two images that are given by a formula.
#[derive(Debug, Clone, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Golden {
    /// Rows of the images.
    pub height: usize,
    /// Columns of the images.
    pub width: usize,
    /// How far a value may lie from what was noted, in pixels.
    pub tolerance: f32,
    /// (u, v) at the cells of rows 4, 12, 20, … and columns 4, 12, 20, …, row by row.
    pub flow: Vec<f32>,
    /// The expected error at the same cells.
    pub uncertainty: Vec<f32>,
}
