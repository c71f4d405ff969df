//! Things that are compared run in turns, so that other work on the machine strikes all of them alike.

use std::fmt;

use anyhow::{Error, Result};
use indicatif::ProgressBar;
use nightflow::flow::Operators;

/// What takes a turn.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum What {
    /// Our step of a network.
    Step(String, Operators),
    /// Our step of a network in bf16, by the processor's tiles.
    Tiles(String),
    /// Our step of a network with its vectors refined.
    Refined(String),
    /// Our step of the network that costs are followed with, at a size, with so many threads.
    Sized([usize; 2], usize),
    /// The product of matrices that tells what the processor can do.
    Product,
    /// A network in OpenVINO, in so many bits.
    OpenVino(String, &'static str),
    /// A method of OpenCV's.
    OpenCv(&'static str),
}

impl fmt::Display for What {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            What::Step(network, operators) => write!(f, "{network}, {operators} operators"),
            What::Tiles(network) => write!(f, "{network}, bf16"),
            What::Refined(network) => write!(f, "{network}, refined"),
            What::Sized([width, height], threads) => write!(f, "{width}×{height}, threads: {threads}"),
            What::Product => f.write_str("product of matrices"),
            What::OpenVino(network, bits) => write!(f, "{network} in OpenVINO {bits}"),
            What::OpenCv(method) => write!(f, "OpenCV's {method}"),
        }
    }
}

/// Steps of a turn before the one that is timed: in a stream, one follows the other. The first after somebody else's finds
/// caches full of what is not its own.
pub const LEAD: usize = 4;

/// Something that makes a step and says how many milliseconds that took.
pub struct Turn {
    pub what: What,
    pub step: Box<dyn FnMut() -> Result<f64>>,
}

/// Milliseconds, one value a round.
pub struct Times(Vec<f64>);

impl Times {
    pub fn median(&self) -> f64 {
        median(self.0.clone())
    }

    pub fn best(&self) -> f64 {
        self.0.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// The median of the ratios within a round, on which work of others that lasts longer than a round has no hold.
    pub fn over(&self, other: &Times) -> f64 {
        self.paired(other, |a, b| a / b)
    }

    /// The median of the differences within a round.
    pub fn less(&self, other: &Times) -> f64 {
        self.paired(other, |a, b| a - b)
    }

    fn paired(&self, other: &Times, by: impl Fn(f64, f64) -> f64) -> f64 {
        median(self.0.iter().zip(&other.0).map(|(a, b)| by(*a, *b)).collect())
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let (low, high) = (values.len().saturating_sub(1) / 2, values.len() / 2);
    match (values.get(low), values.get(high)) {
        (Some(low), Some(high)) => (low + high) / 2.0,
        _ => f64::NAN,
    }
}

/// What was found, and what failed on the way.
#[derive(Default)]
pub struct Found(Vec<(What, Result<Times>)>);

impl Found {
    pub fn of(&self, what: &What) -> Option<&Times> {
        self.0.iter().find(|(known, _)| known == what).and_then(|(_, times)| times.as_ref().ok())
    }

    pub fn failed(&self) -> impl Iterator<Item = (&What, &Error)> {
        self.0.iter().filter_map(|(what, times)| Some((what, times.as_ref().err()?)))
    }
}

/// One round to warm up, then so many that count. Every second round goes backwards, so that nobody always follows the
/// same one. Whoever fails takes no further turn.
pub fn take(turns: &mut [Turn], rounds: usize, bar: &ProgressBar) -> Found {
    let mut found: Vec<Result<Times>> = turns.iter().map(|_| Ok(Times(vec![]))).collect();
    for round in 0..=rounds {
        let count = turns.len();
        for at in 0..count {
            let at = if round % 2 == 0 { at } else { count - 1 - at };
            bar.inc(1);
            let Ok(times) = &mut found[at] else { continue };
            let step = &mut turns[at].step;
            match (0..LEAD).try_for_each(|_| step().map(drop)).and_then(|()| step()) {
                Ok(ms) if round > 0 => times.0.push(ms),
                Ok(_) => {}
                Err(error) => found[at] = Err(error),
            }
        }
    }
    Found(turns.iter().map(|turn| turn.what.clone()).zip(found).collect())
}
