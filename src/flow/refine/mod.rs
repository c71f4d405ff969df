//! The last step behind the network: every vector is moved to where the images' own gradients want it, as far as noise allows.
//!
//! A network is right to a part of a pixel and errs alike over the whole image; gradients are right to hundredths, but only
//! near the truth and only where there is texture above the noise. So the network's vector is the prior, and a window of
//! Lucas and Kanade's around it is the likelihood:
//!
//! - Both frames become grey (all the light of a Bayer cell, unclipped where the raw counts are at hand), slightly blurred.
//! - The newer frame is warped to the older one by the vectors (bicubic), and the mean of both gives the gradients. Such
//!   gradients are not correlated with the difference of the frames, so that noise does not pull to whole or half pixels.
//! - A pixel's weight is the inverse of its noise variance, which the exposure stage measured; what noise adds to the
//!   gradients' products is taken off. Where frames differ by more than noise, the information is divided by as much.
//!   It is also multiplied with the probability that the truth is within a reach of two pixels, by the error that the network
//!   expects: in mere noise gradients know nothing.
//! - The products are summed over windows of ever larger size. What the larger window says is what the smaller one
//!   believes beforehand: flat cells and dark ones take the correction of what lies around them, at most that, and the
//!   largest window believes the network. Errors of a network are alike over many cells, and many cells know what one
//!   does not. Where narrow things matter, the smallest window may be a column of cells.
//! - Two rounds, each at the place that the one before found. A cell whose frames are no more alike after the first round
//!   than before keeps the network's vector.

mod pyramid;
mod said;
mod sums;

use crate::{
    clock::Stamp,
    exposure::{Exposed, Pair},
    flow::Gradients,
};
use pyramid::{Found, Level, Sums};
use said::Said;

/// Pixels of the developed image in a cell, along either side.
const CELL: usize = 4;
/// Images with a shorter side are left alone.
const SIDE_MIN: usize = 16;
const ROUNDS: usize = 2;
/// The variance that a pixel's value has beyond what is known of its noise: half a step of eight bits, squared.
const FLOOR: f32 = 3.84e-6;
/// Pixels or cells that are worked on at once.
const SIDE_BY_SIDE: usize = 16;
/// An expected end-point error on either axis: a vector of two normal errors of deviation s has a mean length of 1.25 s.
const AXIS: f32 = 0.8;
/// No vector is known better beforehand than this, pixels.
const PRIOR_MIN: f32 = 0.05;
/// No vector is said to be better than this afterwards, pixels: what the models of noise and motion leave out.
const ERROR_MIN: f32 = 0.1;

/// Refines the vectors of one pair after the other. It takes memory at the first pair of a size only.
#[derive(Debug, Default)]
pub(super) struct Refiner {
    /// The newest two frames' grey.
    seen: [Grey; 2],
    scratch: Vec<f32>,
    /// The network's vectors in pixels, right and down.
    start: [Vec<f32>; 2],
    /// What is added to them.
    found: Found,
    /// Deviation of the network's vectors beforehand, on either axis, pixels.
    prior: Vec<f32>,
    /// Mean squared difference of the frames in each window before the first round.
    before: Vec<f32>,
    warp: sums::Warp,
    cells: Sums,
    window: Sums,
    /// Whether there are columns, and their sums.
    narrow: bool,
    column: Sums,
    levels: Vec<Level>,
    said: Said,
}

/// A frame's grey, blurred.
#[derive(Debug, Default)]
struct Grey {
    key: Option<(u64, Stamp)>,
    values: Vec<f32>,
    /// Variance of the noise before the blur: `slope` × value + `base`.
    slope: f32,
    base: f32,
}

impl Grey {
    fn see(&mut self, exposed: &Exposed, scratch: &mut Vec<f32>) {
        let pixels = exposed.width * exposed.height;
        self.values.resize(pixels, 0.0);
        scratch.resize(pixels, 0.0);
        match exposed.linear.len() == 3 * pixels {
            true => sums::grey(&exposed.linear, 0.25 * exposed.gain, &mut self.values),
            false => sums::grey(&exposed.rgb, 0.25, &mut self.values),
        }
        sums::blur(&mut self.values, scratch, exposed.width);
        // A cell's pixels all count alike in red + 2·green + blue.
        let part = exposed.gain / (exposed.scale[0] * exposed.scale[1]);
        (self.slope, self.base) = match exposed.noise {
            Some(noise) => (noise.a as f32 * part, noise.b.max(0.0) as f32 * part * exposed.gain),
            None => (0.0, 0.0),
        };
        self.key = Some((exposed.generation, exposed.stamp));
    }
}

impl Refiner {
    /// With or without columns.
    pub(super) fn new(narrow: bool) -> Self {
        Self { narrow, ..Self::default() }
    }

    /// Moves the vectors of `flow` (in camera pixels, on a raster of `columns`) and lowers their expected errors. Says whether it did.
    pub(super) fn refine(
        &mut self,
        pair: &Pair<'_>,
        columns: usize,
        flow: &mut [f32],
        uncertainty: &mut [f32],
    ) -> bool {
        let size = [pair.older.width, pair.older.height];
        if size[0].min(size[1]) < SIDE_MIN {
            return false;
        }
        self.look(pair);
        let raster = [size[0] / CELL, size[1] / CELL];
        self.begin(raster, columns, pair.older.scale, flow, uncertainty);
        let [older, newer] = &self.seen;
        for round in 0..ROUNDS {
            self.warp.bring(pair, [&older.values, &newer.values], raster, &self.start, &self.found.change);
            let noise = [older.slope + newer.slope, older.base + newer.base];
            self.warp.sum(&older.values, size, noise, &mut self.cells);
            pyramid::centre(&mut self.cells, &self.found.change, &self.prior);
            pyramid::smooth(&self.cells, &mut self.window);
            if round == 0 {
                self.before.clear();
                self.before.extend(self.window.misfits());
            } else {
                withdraw(&self.window, &mut self.before, &mut self.found.change);
            }
            pyramid::halve(&self.cells, &mut self.levels);
            let columns = self.narrow.then(|| {
                pyramid::stand(&self.cells, &mut self.column);
                &self.column
            });
            pyramid::descend(&mut self.levels, &self.window, columns, &mut self.found);
        }
        self.conclude(raster, columns, pair.older.scale, flow, uncertainty);
        self.said.take(&self.cells, &self.found, &self.before, pair.older.scale);
        true
    }

    /// What the gradients say of the vectors that were refined last, on a raster of whole cells of the frame.
    pub(super) fn said(&self) -> Gradients<'_> {
        self.said.told()
    }

    /// The grey of both frames; the newer one of a pair is the older one of the next.
    fn look(&mut self, pair: &Pair<'_>) {
        let key = |exposed: &Exposed| Some((exposed.generation, exposed.stamp));
        let fits = |grey: &Grey, exposed: &Exposed| {
            grey.key == key(exposed) && grey.values.len() == exposed.width * exposed.height
        };
        if !fits(&self.seen[0], pair.older) && fits(&self.seen[1], pair.older) {
            self.seen.swap(0, 1);
        }
        for (grey, exposed) in self.seen.iter_mut().zip([pair.older, pair.newer]) {
            if !fits(grey, exposed) {
                grey.see(exposed, &mut self.scratch);
            }
        }
    }

    fn begin(&mut self, [width, height]: [usize; 2], columns: usize, scale: [f32; 2], flow: &[f32], errors: &[f32]) {
        self.start.iter_mut().for_each(Vec::clear);
        self.prior.clear();
        let rows = flow.chunks_exact(2 * columns).zip(errors.chunks_exact(columns)).take(height);
        for (vectors, errors) in rows {
            let vectors = &vectors.as_chunks::<2>().0[..width];
            for (axis, start) in self.start.iter_mut().enumerate() {
                start.extend(vectors.iter().map(|vector| vector[axis] / scale[axis]));
            }
            self.prior.extend(errors[..width].iter().map(|error| (AXIS * error).max(PRIOR_MIN)));
        }
        self.found.begin(width * height);
    }

    fn conclude(
        &self,
        [width, height]: [usize; 2],
        columns: usize,
        scale: [f32; 2],
        flow: &mut [f32],
        errors: &mut [f32],
    ) {
        let rows = flow.chunks_exact_mut(2 * columns).zip(errors.chunks_exact_mut(columns)).take(height);
        for (row, (vectors, errors)) in rows.enumerate() {
            let vectors = vectors.as_chunks_mut::<2>().0[..width].iter_mut();
            for (column, (vector, error)) in vectors.zip(errors).enumerate() {
                let cell = row * width + column;
                let variance = self.found.variance[cell];
                if self.before[cell] < 0.0 || variance <= 0.0 {
                    continue;
                }
                for (axis, change) in self.found.change.iter().enumerate() {
                    vector[axis] += change[cell] * scale[axis];
                }
                *error = error.min((variance.sqrt() / AXIS).max(ERROR_MIN));
            }
        }
    }
}

/// Cells that the first round did not make more alike go back to where they were, and stay there.
fn withdraw(window: &Sums, before: &mut [f32], [right, down]: &mut [Vec<f32>; 2]) {
    let changes = right.iter_mut().zip(down);
    for ((after, before), (right, down)) in window.misfits().zip(before).zip(changes) {
        // Asked this way round, a NaN goes back too.
        let better = after <= *before;
        if !better {
            (*right, *down, *before) = (0.0, 0.0, f32::NEG_INFINITY);
        }
    }
}

/// Some values from a place on, zeros behind the last.
#[inline(always)]
fn some(plane: &[f32], at: usize) -> [f32; SIDE_BY_SIDE] {
    let rest = &plane[at..];
    rest.first_chunk().copied().unwrap_or_else(|| {
        let mut values = [0.0; SIDE_BY_SIDE];
        values[..rest.len()].copy_from_slice(rest);
        values
    })
}

/// The other way; what is behind the last is dropped.
#[inline(always)]
fn put(values: [f32; SIDE_BY_SIDE], plane: &mut [f32], at: usize) {
    let rest = &mut plane[at..];
    match rest.first_chunk_mut() {
        Some(all) => *all = values,
        None => rest.copy_from_slice(&values[..rest.len()]),
    }
}
