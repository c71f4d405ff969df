//! How noisy the camera is: (a, b) of its raw values, estimated about once a second from the frames themselves.
//!
//! Pairs of rows far apart are cut into blocks of two times eight pixels of one colour. Each block gives its brightness
//! twice, from pixels of its own each time, a step between its halves, and two details (third differences along the rows,
//! one row less the other), which hold noise and little else; for white noise all of these are independent. Blocks are
//! sorted by the one brightness into sets, the third of a set with the least steps is kept, and the median of its details
//! is the noise at the mean of the other brightness. So neither the sorting nor the choice changes what is measured. What
//! the sets say is fitted by a line.
//!
//! The laboratory's way (`darkness::foi`) is sharper and a hundred times as dear.

use super::layout::Layout;
use crate::clock::Stamp;

/// How far apart frames are that are measured.
const EVERY_S: f64 = 1.0;
/// Columns of a block, in pixels of one colour.
const BLOCK: usize = 8;
/// Blocks a frame, at most; rows are left out accordingly.
const BLOCKS_MAX: usize = 12_288;
/// Fewer blocks than this say nothing.
const BLOCKS_MIN: usize = 256;
const SETS: usize = 16;
/// One of so many blocks of a set is kept.
const SMOOTH: usize = 3;
/// The part of the newest frame's estimate in the running one.
const NEWEST: f64 = 0.5;
/// Median of |x| of a normal x of deviation 1.
const MEDIAN: f64 = 0.674_489_75;
/// Deviations of a set's variance from the line, as a part of it, beyond which the set counts for less.
const OUTLIER: f64 = 0.15;
/// The brightness that noise levels are told for, as the paper has it.
const BRIGHT: f64 = 0.4;

/// The camera's noise: the variance of a raw value y (black off, white 1) is a·y + b.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// The shot part; never negative.
    pub a: f64,
    /// The read part; a little below 0 where it is too small to be told from 0.
    pub b: f64,
}

impl Noise {
    /// Variance at a raw value.
    pub fn variance(&self, raw: f64) -> f64 {
        (self.a * raw.max(0.0) + self.b).max(0.0)
    }

    /// Signal to noise of a pixel at a raw mean, decibels.
    pub fn snr_db(&self, raw_mean: f64) -> f64 {
        20.0 * (raw_mean.max(0.0) / self.variance(raw_mean).sqrt()).log10()
    }

    /// Deviation of the noise in 1/255 once the raw mean is brightened to 0.4 and `pixels` pixels are averaged: what a
    /// network sees, by day and by night and of every camera.
    pub fn level(&self, raw_mean: f64, pixels: f64) -> f64 {
        let deviation = (self.variance(raw_mean) / pixels).sqrt();
        if deviation == 0.0 { 0.0 } else { 255.0 * BRIGHT * deviation / raw_mean.max(0.0) }
    }
}

/// Two rows of eight pixels of a colour, in counts.
#[derive(Debug, Clone, Copy)]
struct Block {
    sorted_by: f32,
    mean: f32,
    step: f32,
    details: [f32; 2],
}

impl Block {
    fn of(upper: [f32; BLOCK], lower: [f32; BLOCK]) -> Self {
        let p: [f32; BLOCK] = std::array::from_fn(|k| 0.5 * (upper[k] + lower[k]));
        let q: [f32; BLOCK] = std::array::from_fn(|k| upper[k] - lower[k]);
        let third = |k: usize| (q[k] - 3.0 * q[k + 1] + 3.0 * q[k + 2] - q[k + 3]) / 40.0_f32.sqrt();
        Self {
            sorted_by: 0.25 * (p[0] + p[3] + p[4] + p[7]),
            mean: 0.25 * (p[1] + p[2] + p[5] + p[6]),
            step: (p[0] + p[1] + p[2] + p[3] - p[4] - p[5] - p[6] - p[7]).abs(),
            details: [third(0), third(4)],
        }
    }
}

/// What a set says: mean and variance in raw values, and of how many details.
#[derive(Debug, Clone, Copy, Default)]
struct Set {
    mean: f64,
    variance: f64,
    count: f64,
}

/// The running estimate. It takes memory at the first frame of a size only.
#[derive(Debug, Default)]
pub(super) struct Gauge {
    noise: Option<Noise>,
    measured: Option<Stamp>,
    /// Rows from one pair that is measured to the next, odd so that both kinds of row of a mosaic are met; `None` while
    /// the frame is not measured.
    every: Option<usize>,
    /// The upper row of a pair, until the lower one comes.
    upper: Vec<u16>,
    blocks: Vec<Block>,
    sizes: Vec<f32>,
}

impl Gauge {
    /// Decides whether the frame is measured.
    pub fn start(&mut self, layout: &Layout, stamp: Stamp) {
        let due = self.measured.is_none_or(|then| !(0.0..EVERY_S).contains(&stamp.seconds_since(then)));
        self.every = due.then(|| {
            let row = layout.width / (BLOCK * layout.stride()) * layout.stride();
            // Pairs must not lie in one another, or some pixels would count twice.
            let every = (row * layout.height).div_ceil(BLOCKS_MAX).max(2 * layout.stride()) | 1;
            self.blocks.clear();
            let room = row * layout.height.div_ceil(every);
            self.blocks.reserve(room);
            self.sizes.reserve(2 * room);
            self.upper.reserve(layout.width);
            every
        });
    }

    /// Looks at a row of low-justified counts; rows come in order.
    pub fn take(&mut self, y: usize, counts: &[u16], stride: usize, white: f32) {
        let Some(every) = self.every else { return };
        if y.is_multiple_of(every) {
            self.upper.clear();
            self.upper.extend_from_slice(counts);
        } else if y % every == stride {
            let pairs = self.upper.chunks_exact(BLOCK * stride).zip(counts.chunks_exact(BLOCK * stride));
            for (upper, lower) in pairs {
                for colour in 0..stride {
                    let rows = [upper, lower].map(|row| std::array::from_fn(|k| f32::from(row[colour + stride * k])));
                    if rows.as_flattened().iter().all(|count| *count < white) {
                        self.blocks.push(Block::of(rows[0], rows[1]));
                    }
                }
            }
        }
    }

    /// Takes the frame's estimate in, if it was measured and says something.
    pub fn finish(&mut self, layout: &Layout, stamp: Stamp) -> Option<Noise> {
        if self.every.take().is_some() && self.blocks.len() >= BLOCKS_MIN {
            self.measured = Some(stamp);
            let newest = self.measure(layout);
            let part = if self.noise.is_some() { NEWEST } else { 1.0 };
            let before = self.noise.unwrap_or(newest);
            let mix = |before: f64, newest: f64| before + part * (newest - before);
            self.noise = Some(Noise { a: mix(before.a, newest.a), b: mix(before.b, newest.b) });
        }
        self.noise
    }

    fn measure(&mut self, layout: &Layout) -> Noise {
        let (black, span) = (f64::from(layout.black), f64::from(layout.white - layout.black));
        self.blocks.sort_unstable_by(|a, b| a.sorted_by.total_cmp(&b.sorted_by));
        let size = self.blocks.len() / SETS;
        let mut sets = [Set::default(); SETS];
        for (set, blocks) in sets.iter_mut().zip(self.blocks.chunks_exact_mut(size)) {
            let kept = size / SMOOTH;
            blocks.select_nth_unstable_by(kept, |a, b| a.step.total_cmp(&b.step));
            let kept = &blocks[..kept];
            self.sizes.clear();
            self.sizes.extend(kept.iter().flat_map(|block| block.details).map(f32::abs));
            let middle = self.sizes.len() / 2;
            let (_, median, _) = self.sizes.select_nth_unstable_by(middle, f32::total_cmp);
            let mean = kept.iter().map(|block| f64::from(block.mean)).sum::<f64>() / kept.len() as f64;
            let deviation = f64::from(*median) / MEDIAN / span;
            let count = self.sizes.len() as f64;
            *set = Set { mean: (mean - black) / span, variance: deviation * deviation, count };
        }
        line(&sets)
    }
}

/// The line through the sets' variances. A variance is as sure as it is small, so sets are weighted by the line that was
/// found before; those far off it (texture that is as fine as noise) count for less.
fn line(sets: &[Set]) -> Noise {
    let mut noise = Noise { a: 0.0, b: sets.iter().map(|set| set.variance).sum::<f64>() / sets.len() as f64 };
    for round in 0..6 {
        let (mut weights, mut x, mut y, mut xx, mut xy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for set in sets {
            let expected = noise.variance(set.mean).max(1e-3 * set.variance).max(1e-16);
            // The first line is found before it can tell what is off it.
            let off = if round < 2 { 0.0 } else { (set.variance / expected - 1.0) / OUTLIER };
            let weight = set.count / (expected * expected) / (1.0 + off * off);
            weights += weight;
            x += weight * set.mean;
            y += weight * set.variance;
            xx += weight * set.mean * set.mean;
            xy += weight * set.mean * set.variance;
        }
        let (x, y) = (x / weights, y / weights);
        let spread = (xx / weights - x * x).max(0.0);
        // Sets of about one brightness leave the slope open; the variance at their mean holds all the same.
        let a = (xy / weights - x * y) / (spread + (0.02 * x).powi(2)).max(1e-20);
        noise = Noise { a: a.max(0.0), b: y - a.max(0.0) * x };
    }
    noise
}
