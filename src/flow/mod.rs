//! Stage 3: two developed images become dense optical flow with a confidence for every vector.

mod bands;
mod config;
pub mod convolutions;
pub mod cores;
pub mod cost_volume;
mod error;
mod fake;
mod golden;
mod keyframe;
mod lanes;
pub mod manifest;
mod matcher;
mod moved;
mod network;
mod normalised;
mod onnx;
mod onnx_graph;
mod onnx_shared;
mod operators;
pub mod padding;
pub mod pages;
pub mod priority;
pub mod profile;
mod provider;
mod refine;
mod resized;
pub mod runtime;
mod trust;
mod upsampler;
pub mod wheel;
pub mod winograd;

use crate::clock::Stamp;

pub use self::{
    config::{Config, Operators, Precision, Provider, REASONS, Resolution},
    error::Error,
    fake::{Fake, pattern},
    golden::Deviation,
    keyframe::Keyframe,
    matcher::{Counts, Matcher},
    network::{Golden, Model, Network, Raster, Slot},
    onnx_graph::Graph,
};

/// The raster that the flow is given on.
///
/// Cell (row, column) stands for the camera pixel `((column + 0.5) · scale[0] − 0.5, (row + 0.5) · scale[1] − 0.5)`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Grid {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Camera pixels per column and per row.
    pub scale: [f32; 2],
}

impl Grid {
    /// How many cells there are.
    pub fn cells(&self) -> usize {
        self.width * self.height
    }
}

/// Memory that the flow is written into.
pub struct Canvas<'a> {
    /// `height` × `width` × 2, (u right, v down) in camera pixels from the older to the newer frame.
    pub flow: &'a mut [f32],
    /// `height` × `width`, 0…1.
    pub confidence: &'a mut [f32],
}

/// Lends the memory for one step's flow; shared memory does, so that the network writes straight to its readers.
pub trait Lender {
    /// Memory for this raster. It holds until the next call.
    fn lend(&mut self, grid: &Grid) -> Canvas<'_>;
    /// What was last lent, flow and confidence.
    fn lent(&self) -> (&[f32], &[f32]);
}

/// Memory of our own, for where nobody lends.
#[derive(Debug, Default)]
pub struct Own {
    flow: Vec<f32>,
    confidence: Vec<f32>,
}

impl Lender for Own {
    fn lend(&mut self, grid: &Grid) -> Canvas<'_> {
        self.flow.resize(grid.cells() * 2, 0.0);
        self.confidence.resize(grid.cells(), 0.0);
        Canvas { flow: &mut self.flow, confidence: &mut self.confidence }
    }

    fn lent(&self) -> (&[f32], &[f32]) {
        (&self.flow, &self.confidence)
    }
}

/// Dense flow between two frames, in memory that somebody lent.
#[derive(Debug, Clone, Copy)]
pub struct Flow<'a> {
    /// Stamp of the older frame.
    pub older: Stamp,
    /// Stamp of the newer frame.
    pub newer: Stamp,
    /// Where the vectors stand: on the older frame.
    pub grid: Grid,
    /// `height` × `width` × 2, (u right, v down) in camera pixels.
    pub vectors: &'a [f32],
    /// `height` × `width`: the probability that the vector is right to within one pixel of the network's image.
    pub confidence: &'a [f32],
}

/// What the frames' own gradients say about the vectors of a flow, cell by cell of its raster and without what a network or a cell's
/// neighbours say: a vector's logarithmic likelihood changes with a step s (camera pixels, right and down) by `pull`·s − ½ sᵀ·`information`·s.
/// Zeros where they say nothing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gradients<'a> {
    /// Fisher's information, xx, xy and yy, in 1/px².
    pub information: [&'a [f32]; 3],
    /// Right and down, in 1/px.
    pub pull: [&'a [f32]; 2],
}

/// How far the flow of a step can be trusted.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum State {
    /// As good as it gets.
    #[default]
    Ok,
    /// Usable with care; why.
    Degraded(Cause),
    /// There is no trustworthy flow; why. Blind is not still: nothing is published as velocity.
    Blind(Cause),
}

/// Why flow is not to be trusted in full; every variant carries its figure.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum Cause {
    /// Too little light.
    #[error("too dark: raw mean {raw_mean:.5} of white, at least {needed:.5} is needed")]
    Dark {
        /// Mean above black, 1 = white.
        raw_mean: f32,
        /// The limit.
        needed: f32,
    },
    /// Too much noise for the light there is.
    #[error("too noisy: level {level:.1} of 255 at normal brightness, at most {allowed:.1} may be")]
    Noisy {
        /// Deviation in the developed image at a mean of 0.4, in 1/255.
        level: f32,
        /// The limit.
        allowed: f32,
    },
    /// Too much light.
    #[error("{part:.2} of the image is saturated, at most {allowed:.2} may be")]
    Saturated {
        /// Part of the pixels.
        part: f32,
        /// The limit.
        allowed: f32,
    },
    /// The light changed between the two frames.
    #[error("the light changed by a factor of {factor:.2} between the frames")]
    GainStep {
        /// Newer mean over older mean.
        factor: f32,
    },
    /// The network itself trusts too little of its flow.
    #[error("mean confidence {mean:.2}, at least {needed:.2} is needed")]
    Unsure {
        /// Mean over the raster.
        mean: f32,
        /// The limit.
        needed: f32,
    },
    /// The camera repeats the same frame.
    #[error("the camera is frozen: frames of different stamps are equal to the bit")]
    Frozen,
}
