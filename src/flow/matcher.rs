//! One step: the features of two frames, the vectors between them, and a confidence for each.

use std::path::PathBuf;

use tracing::debug;

use crate::{
    clock::Stamp,
    exposure::{Exposed, Pair},
    flow::{
        Canvas, Config, Error, Flow, Gradients, Grid, Lender, Resolution,
        cores::{self, Pinned},
        golden::{self, Deviation},
        manifest::File,
        network::{Model, Network, Raster, Slot},
        onnx::Onnx,
        padding::{self, Padded},
        pages::{Moved, Moving},
        priority,
        refine::Refiner,
        upsampler::Upsampler,
    },
};

/// Pixels of the network's image in one cell of its raster.
const CELL: usize = 4;
/// So many sizes of frames have their memory moved to large pages: whoever has more has no steps to hurry for.
const SIZES_MAX: usize = 16;

/// Dense flow between the frames of a pair.
pub struct Matcher {
    pub(crate) config: Config,
    network: Box<dyn Network>,
    model: Model,
    refiner: Refiner,
    /// Whether the newest vectors went through it.
    refined: bool,
    /// For full resolution, where the network has one.
    upsampler: Option<Upsampler>,
    /// Whose features each slot holds.
    described: [Option<Key>; 2],
    /// The network's raster, where it is not the one that was asked for.
    flow: Vec<f32>,
    uncertainty: Vec<f32>,
    counts: Counts,
    /// Width and height of frames whose memory has been moved to large pages.
    settled: Vec<[usize; 2]>,
    moving: Option<Moving>,
}

/// What makes a frame's features what they are. The stamp is in it for frames that nobody numbered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Key {
    generation: u64,
    stamp: Stamp,
    width: usize,
    height: usize,
}

impl Key {
    fn of(exposed: &Exposed) -> Self {
        let Exposed { generation, stamp, width, height, .. } = *exposed;
        Self { generation, stamp, width, height }
    }
}

/// What a matcher did so far.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Frames whose features were computed.
    pub described: u64,
    /// Pairs.
    pub pairs: u64,
    /// Pairs whose flow was copied to the lent memory, because its raster is not the network's own.
    pub copied: u64,
}

impl Matcher {
    /// With the network that the settings name, through ONNX Runtime; checked against its golden output unless the
    /// settings say otherwise. With `[flow] priority` the calling thread has it from here on.
    pub fn open(config: &Config) -> Result<Self, Error> {
        cores::check(config)?;
        // Before the runtime starts its threads, which inherit it.
        priority::take(config)?;
        let mut matcher = Self::with(config, Box::new(Onnx::open(config)?));
        if config.golden_check {
            matcher.check_golden()?;
        }
        if config.resolution == Resolution::Full {
            matcher.upsampler = Upsampler::open(config)?;
            let file = matcher.upsampler.as_ref().map(|upsampler| upsampler.file().clone());
            matcher.model.sha256.extend(file.map(|File { file, sha256 }| (file, sha256)));
        }
        Ok(matcher)
    }

    /// With any network.
    pub fn with(config: &Config, network: Box<dyn Network>) -> Self {
        Self {
            config: config.clone(),
            model: network.model().clone(),
            network,
            upsampler: None,
            refiner: Refiner::new(config.refine_narrow),
            refined: false,
            described: [None; 2],
            flow: vec![],
            uncertainty: vec![],
            counts: Counts::default(),
            settled: vec![],
            moving: None,
        }
    }

    /// Which network runs.
    pub fn model(&self) -> &Model {
        &self.model
    }

    /// What was done so far.
    pub fn counts(&self) -> Counts {
        Counts { copied: self.counts.copied + self.network.copied(), ..self.counts }
    }

    /// Ends the record of what each node takes: see [`profile`](super::profile).
    pub(super) fn end_profile(&mut self) -> Result<Vec<PathBuf>, Error> {
        self.network.end_profile()
    }

    /// Computes the flow that the network's exporter noted and says how far it is off; an error if too far. `None`
    /// where nothing was noted.
    pub fn check_golden(&mut self) -> Result<Option<Deviation>, Error> {
        self.described = [None; 2];
        golden::check(self.network.as_mut(), self.config.precision)
    }

    /// The raster of the flow of this frame. At quarter resolution it has a cell for every whole 4 × 4 pixels.
    pub fn grid(&self, exposed: &Exposed) -> Grid {
        let [x, y] = exposed.scale;
        let (width, height) = (exposed.width, exposed.height);
        match self.config.resolution {
            Resolution::Full | Resolution::Bilinear => Grid { width, height, scale: [x, y] },
            Resolution::Quarter => quarter(exposed),
        }
    }

    /// Flow from the older to the newer frame, in memory of `lender`.
    ///
    /// At quarter resolution and for sizes that are multiples of the network's stride the network writes straight into
    /// the lent memory. Otherwise the result is copied there once, cut or enlarged.
    pub fn between<'a>(&mut self, pair: &Pair<'_>, lender: &'a mut dyn Lender) -> Result<Flow<'a>, Error> {
        let (older, newer) = (pair.older, pair.newer);
        checked(older, newer)?;
        let _pinned = Pinned::to(&self.config.cores);
        let slot = self.describe_both(older, newer)?;
        let grid = self.grid(older);
        let mut canvas = lender.lend(&grid);
        if canvas.flow.len() != 2 * grid.cells() || canvas.confidence.len() != grid.cells() {
            return Err(Error::Lent {
                cells: grid.cells(),
                flow: canvas.flow.len(),
                confidence: canvas.confidence.len(),
            });
        }
        self.counts.pairs += 1;
        self.refined = false;
        let padded = Padded::new(older, self.network.stride());
        let (columns, rows) = (padded.width / CELL, padded.height / CELL);
        if padded.is_whole() && self.config.resolution == Resolution::Quarter {
            let raster = Raster { flow: canvas.flow, uncertainty: canvas.confidence };
            self.network.between(slot, older.scale, raster)?;
            finite(canvas.flow, canvas.confidence)?;
            self.refined = self.config.refine && self.refiner.refine(pair, columns, canvas.flow, canvas.confidence);
            confide(canvas.confidence);
        } else {
            self.counts.copied += 1;
            self.flow.resize(columns * rows * 2, 0.0);
            self.uncertainty.resize(columns * rows, 0.0);
            let raster = Raster { flow: &mut self.flow, uncertainty: &mut self.uncertainty };
            self.network.between(slot, older.scale, raster)?;
            finite(&self.flow, &self.uncertainty)?;
            self.refined =
                self.config.refine && self.refiner.refine(pair, columns, &mut self.flow, &mut self.uncertainty);
            self.deliver(&padded, &grid, &mut canvas)?;
        }
        mask(pair, &grid, canvas.flow, canvas.confidence);
        self.settle([older.width, older.height]);
        let lender: &'a dyn Lender = lender;
        let (vectors, confidence) = lender.lent();
        Ok(Flow { older: older.stamp, newer: newer.stamp, grid, vectors, confidence })
    }

    /// What the frames' gradients say of the newest flow, where it was refined and is at quarter resolution.
    pub fn gradients(&self) -> Option<Gradients<'_>> {
        (self.refined && self.config.resolution == Resolution::Quarter).then(|| self.refiner.said())
    }

    /// Copies the network's raster to the lent memory, cut or enlarged.
    fn deliver(&mut self, older: &Padded<'_>, grid: &Grid, canvas: &mut Canvas<'_>) -> Result<(), Error> {
        let (columns, rows) = (older.width / CELL, older.height / CELL);
        if let Some(upsampler) = &mut self.upsampler {
            let raster = Raster { flow: &mut self.flow, uncertainty: &mut self.uncertainty };
            upsampler.enlarge(older, &raster, grid, canvas)?;
            confide(canvas.confidence);
            return Ok(());
        }
        confide(&mut self.uncertainty);
        if self.config.resolution == Resolution::Quarter {
            padding::crop(&self.flow, columns, canvas.flow, grid.width, 2);
            padding::crop(&self.uncertainty, columns, canvas.confidence, grid.width, 1);
        } else {
            padding::enlarge(&self.flow, (columns, rows), canvas.flow, grid.width, 2);
            padding::enlarge(&self.uncertainty, (columns, rows), canvas.confidence, grid.width, 1);
        }
        Ok(())
    }

    /// After the first pair of a size all memory is taken, and goes to large pages, one with every pair.
    fn settle(&mut self, size: [usize; 2]) {
        if self.config.large_pages && self.settled.len() < SIZES_MAX && !self.settled.contains(&size) {
            self.settled.push(size);
            self.moving = Moving::found().inspect_err(|why| debug!("memory stays on small pages: {why}")).ok();
        }
        if self.moving.as_mut().is_some_and(|moving| !moving.step())
            && let Some(moving) = self.moving.take()
        {
            match moving.end() {
                Ok(Moved { large, of }) => debug!("{} of {} MiB lie on large pages", large >> 20, of >> 20),
                Err(why) => debug!("memory stays on small pages: {why}"),
            }
        }
    }

    /// Sees to it that both frames' features are there, computing only those that are not; where the older's are.
    fn describe_both(&mut self, older: &Exposed, newer: &Exposed) -> Result<Slot, Error> {
        let (older_key, newer_key) = (Key::of(older), Key::of(newer));
        let holds = |described: &[Option<Key>; 2], key: Key| {
            [Slot::A, Slot::B].into_iter().find(|slot| described[slot.index()] == Some(key))
        };
        if let Some(other) = self.described.into_iter().flatten().next()
            && (other.width, other.height) != (older.width, older.height)
        {
            self.described = [None; 2];
        }
        let slot = match holds(&self.described, older_key) {
            Some(slot) => slot,
            None => {
                let slot = holds(&self.described, newer_key).map_or(Slot::A, Slot::other);
                self.describe(slot, older)?;
                slot
            }
        };
        if self.described[slot.other().index()] != Some(newer_key) {
            self.describe(slot.other(), newer)?;
        }
        Ok(slot)
    }

    fn describe(&mut self, slot: Slot, exposed: &Exposed) -> Result<(), Error> {
        self.described[slot.index()] = None;
        self.network.describe(slot, &Padded::new(exposed, self.network.stride()))?;
        self.described[slot.index()] = Some(Key::of(exposed));
        self.counts.described += 1;
        Ok(())
    }
}

/// The raster of a frame that has a cell for every whole 4 × 4 pixels.
pub(super) fn quarter(exposed: &Exposed) -> Grid {
    Grid {
        width: (exposed.width / CELL).max(1),
        height: (exposed.height / CELL).max(1),
        scale: exposed.scale.map(|scale| scale * CELL as f32),
    }
}

/// Refuses frames that make no pair.
fn checked(older: &Exposed, newer: &Exposed) -> Result<(), Error> {
    for exposed in [older, newer] {
        let pixels = exposed.width * exposed.height;
        if pixels == 0 || exposed.rgb.len() != 3 * pixels || exposed.saturated.len() != pixels {
            return Err(Error::Image {
                width: exposed.width,
                height: exposed.height,
                rgb: exposed.rgb.len(),
                saturated: exposed.saturated.len(),
            });
        }
    }
    if (older.width, older.height) != (newer.width, newer.height) || older.scale != newer.scale {
        return Err(Error::Differ {
            older: (older.width, older.height, older.scale),
            newer: (newer.width, newer.height, newer.scale),
        });
    }
    Ok(())
}

/// Refuses what is no number.
fn finite(flow: &[f32], uncertainty: &[f32]) -> Result<(), Error> {
    let odd = |values: &[f32]| values.iter().filter(|value| !value.is_finite()).count();
    let (vectors, errors) = (odd(flow), odd(uncertainty));
    if vectors + errors > 0 {
        return Err(Error::NotFinite {
            flow: vectors,
            of_flow: flow.len(),
            uncertainty: errors,
            of: uncertainty.len(),
        });
    }
    Ok(())
}

/// Turns expected errors into confidence where they stand.
///
/// An end-point error that is exponentially distributed with mean s is below one pixel with probability 1 − exp(−1/s).
pub(super) fn confide(uncertainty: &mut [f32]) {
    for value in uncertainty {
        // The smallest that still has a finite reciprocal with room to spare; its confidence is 1.
        *value = 1.0 - (-1.0 / value.max(1e-6)).exp();
    }
}

/// Takes the confidence from cells that stand on saturated pixels in either frame, and from those whose match has left
/// the newer frame.
pub(super) fn mask(pair: &Pair<'_>, grid: &Grid, flow: &[f32], confidence: &mut [f32]) {
    let (older, newer) = (pair.older, pair.newer);
    // Developed pixels per cell: 4 or 1; a frame of less than 4 pixels is one cell.
    let side = (grid.scale[0] / older.scale[0]).round() as usize;
    let per_pixel = older.scale.map(|scale| 1.0 / scale);
    let edge = [older.width as f32, older.height as f32];
    let spots = older.saturated_part > 0.0 || newer.saturated_part > 0.0;
    let rows = flow.chunks_exact(2 * grid.width).zip(confidence.chunks_exact_mut(grid.width));
    for (row, (vectors, confidence)) in rows.enumerate() {
        // Half a pixel on, so that a pixel's number is the whole part.
        let y = (row as f32 + 0.5) * side as f32;
        for (column, (vector, confidence)) in vectors.chunks_exact(2).zip(confidence).enumerate() {
            let x = (column as f32 + 0.5) * side as f32;
            let to = [x + vector[0] * per_pixel[0], y + vector[1] * per_pixel[1]];
            let inside = to[0] >= 0.0 && to[1] >= 0.0 && to[0] < edge[0] && to[1] < edge[1];
            let hidden = || {
                covered(older, column, row, side) || newer.saturated[to[1] as usize * older.width + to[0] as usize] != 0
            };
            if !inside || (spots && hidden()) {
                *confidence = 0.0;
            }
        }
    }
}

/// Whether any pixel of a cell is saturated.
fn covered(exposed: &Exposed, column: usize, row: usize, side: usize) -> bool {
    let (left, top) = (column * side, row * side);
    let right = (left + side).min(exposed.width);
    (top..(top + side).min(exposed.height))
        .any(|y| exposed.saturated[y * exposed.width..][left..right].iter().any(|&pixel| pixel != 0))
}
