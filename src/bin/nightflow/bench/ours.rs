//! Our own step, and what the processor can do at best by the same library.

use std::rc::Rc;

use anyhow::{Result, ensure};
use nightflow::{
    clock,
    exposure::{Exposed, Pair},
    flow::{self, Config, Graph, Matcher, Own, manifest::Entry, padding, profile},
};

/// Frames that take turns: three would do for each to be new to the matcher, which keeps two.
const FRAMES: u64 = 4;

/// Frames of a moving pattern; `benches/rivals/step.py` makes the same.
pub fn frames(width: usize, height: usize) -> Rc<[Exposed]> {
    (0..FRAMES).map(|number| flow::pattern(width, height, number)).collect()
}

/// What the image becomes for the network.
pub fn padded(sides: [usize; 2], entry: &Entry) -> [usize; 2] {
    sides.map(|side| padding::padded(side, entry.stride))
}

/// A matcher that gets one new frame a step, as in the node: the pyramid runs once and the decoder once.
pub struct Ours {
    matcher: Matcher,
    frames: Rc<[Exposed]>,
    own: Own,
    steps: usize,
}

impl Ours {
    pub fn with(matcher: Matcher, frames: Rc<[Exposed]>) -> Self {
        Self { matcher, frames, own: Own::default(), steps: 0 }
    }

    /// What computes it, with its version.
    pub fn provider(&self) -> &str {
        &self.matcher.model().provider
    }

    /// Milliseconds of the step to the next frame.
    pub fn step(&mut self) -> Result<f64> {
        let of = |number: usize| &self.frames[number % self.frames.len()];
        let (older, newer) = (of(self.steps), of(self.steps + 1));
        let described = self.matcher.counts().described;
        let start = clock::instant();
        self.matcher.between(&Pair { older, newer, gain_step: None }, &mut self.own)?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        // The very first step knows no frame yet.
        let looked_at = self.matcher.counts().described - described;
        ensure!(looked_at == 1 || self.steps == 0, "a step looked at {looked_at} frames, expected 1");
        self.steps += 1;
        Ok(ms)
    }
}

/// Operators that convolve: ONNX's and what its runtime makes of them, and the node's own.
const CONVOLVING: [&str; 6] = ["Conv", "FusedConv", "ConvTranspose", "QLinearConv", "Convolutions", "Encoder"];

/// Milliseconds that the convolutions of a step take by themselves.
pub fn convolutions(config: &Config, frames: &[Exposed], rounds: usize) -> Result<f64> {
    let folder = std::env::temp_dir().join(format!("nightflow_profile_{}", std::process::id()));
    let taken = profile::profile(config, frames, rounds, &folder)?;
    Ok(CONVOLVING.iter().filter_map(|operator| taken.get(*operator)).sum())
}

/// Rows and columns of the matrices.
const SIDE: usize = 768;
/// How many pairs of them.
const PAIRS: usize = 3;

/// An ONNX graph of operator set 9, in which a slice has its ends as attributes: `c = MatMul(a, b)`, all three [1, 3, n, n],
/// and `row = Slice(c)`, of axis 2 from 0 to 1, so that next to nothing is fetched from it.
const PRODUCT: &[u8] = b"\x08\x04\x12\x00:\xb4\x01\n\x11\n\x01a\n\x01b\x12\x01c\"\x06MatMul\n8\n\x01c\x12\x03row\"\x05Slice\
    *\x0b\n\x04axes@\x02\xa0\x01\x07*\x0b\n\x04ends@\x01\xa0\x01\x07*\r\n\x06starts@\x00\xa0\x01\x07\x12\x07product\
    Z\x1d\n\x01a\x12\x18\n\x16\x08\x01\x12\x12\n\x02\x08\x01\n\x02\x08\x03\n\x03\x12\x01n\n\x03\x12\x01n\
    Z\x1d\n\x01b\x12\x18\n\x16\x08\x01\x12\x12\n\x02\x08\x01\n\x02\x08\x03\n\x03\x12\x01n\n\x03\x12\x01n\
    b\x1e\n\x03row\x12\x17\n\x15\x08\x01\x12\x11\n\x02\x08\x01\n\x02\x08\x03\n\x02\x08\x01\n\x03\x12\x01nB\x04\n\x00\x10\t";

/// Products of matrices of floats, which a processor is never faster at than at these.
pub struct Product {
    graph: Graph,
    matrix: Vec<f32>,
}

impl Product {
    /// Multiply-adds of a step, in 10⁹.
    pub const GIGAMACS: f64 = (PAIRS * SIDE * SIDE * SIDE) as f64 * 1e-9;

    pub fn open(config: &Config) -> Result<Self> {
        let graph = Graph::of(config, "the product of matrices".into(), PRODUCT, 2)?;
        let matrix = (0..PAIRS * SIDE * SIDE).map(|i| (i as f32 * 0.37).sin()).collect();
        Ok(Self { graph, matrix })
    }

    pub fn step(&mut self) -> Result<f64> {
        let start = clock::instant();
        self.graph.run(&[&self.matrix, &self.matrix], SIDE, SIDE)?;
        Ok(start.elapsed().as_secs_f64() * 1e3)
    }
}
