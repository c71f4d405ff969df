//! The operator `nightflow::CostVolume`: how alike two frames' features are around a flow, and where they are most alike.
//!
//! For features a (older) and b (newer) of C channels, a flow f in cells of their raster (right, down), and displacements
//! d = (dx, dy) of −reach to reach each,
//!
//! - b is fetched to where the flow says that it went: W(q) = b(q + f(q)), bilinear, zero outside;
//! - volume(d, p) = gain / C · Σ a(p) · W(p + d) over the channels, zero where p + d lies outside; dx runs fastest;
//! - argmax(p) = Σ d · softmax(s(d, p) · exp(sharpness)) over the displacements, with s the mean of volume / gain over p and
//!   those of its eight neighbours that there are.
//!
//! A graph of ONNX's own operators does this in some 150 steps that move far more memory than they compute with. Here
//! [`work`] does it in four, none of which takes memory, and [`operator`] lets ONNX Runtime call them. Every result is
//! computed by one thread in a fixed order, so that it does not depend on how many threads there are.

mod operator;
#[cfg(test)]
pub(super) mod tests;
mod work;

pub use crate::flow::lanes::Unit;
use crate::flow::{
    bands::{self, Bands},
    lanes,
};
pub use operator::Fused;
use work::{Fetch, Multiply, Seek, Turn};

/// The widest reach that [`CostVolume`] takes.
pub const REACH_MAX: usize = 8;
/// Numbers in a cache line, and in the widest vector.
const LINE: usize = lanes::MOST;

/// Sizes of the inputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// Features of a cell.
    pub channels: usize,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Displacements go from −reach to reach in both directions; 0 to [`REACH_MAX`].
    pub reach: usize,
}

impl Shape {
    /// Cells of a plane.
    pub fn cells(&self) -> usize {
        self.height * self.width
    }

    /// Displacements in one direction.
    pub fn side(&self) -> usize {
        2 * self.reach + 1
    }

    /// All displacements.
    pub fn displacements(&self) -> usize {
        self.side() * self.side()
    }

    /// Values that a cell's channels take.
    fn depth(&self) -> usize {
        self.channels.next_multiple_of(LINE)
    }

    /// Columns with those that fill the last vector.
    fn columns(&self) -> usize {
        self.width.next_multiple_of(LINE)
    }

    /// Values from one channel to the next in a row of fetched features: an odd number of cache lines, so that the
    /// channels of a column don't drive each other out of the cache.
    fn stride(&self) -> usize {
        ((self.columns() + 2 * self.reach).div_ceil(LINE) | 1) * LINE
    }

    /// Values that a band needs for itself.
    fn scratch(&self) -> usize {
        let seek = self.displacements() * self.columns() + self.columns() + 2;
        (2 * LINE * self.channels).max(seek).next_multiple_of(LINE)
    }

    /// Rows of a band: an even number, for rows are multiplied in pairs, and so many that there are bands enough.
    fn band(&self) -> usize {
        2 * self.height.div_ceil(2 * bands::MOST).max(1)
    }

    fn bands(&self) -> usize {
        self.height.div_ceil(self.band())
    }

    /// Whether everything of this shape can be counted, with room to spare.
    fn is_sound(&self) -> bool {
        let Shape { channels, height, width, reach } = *self;
        let side = 2 * REACH_MAX + 1;
        let lengths = [channels.max(LINE), height, width.max(LINE), side * side, 8];
        let bytes = lengths.iter().try_fold(4usize, |product, length| product.checked_mul(*length));
        let counted = reach <= REACH_MAX && bytes.is_some_and(|bytes| bytes < isize::MAX as usize);
        counted && channels * height * width > 0
    }
}

/// What goes in.
#[derive(Debug, Clone, Copy)]
pub struct Inputs<'a> {
    /// channels × height × width.
    pub older: &'a [f32],
    /// channels × height × width.
    pub newer: &'a [f32],
    /// 2 × height × width: right and down, in cells.
    pub flow: &'a [f32],
    /// The logarithm of what the cost volume is multiplied with in the soft arg-max.
    pub sharpness: f32,
    /// What the cost volume is multiplied with when all is done; not zero.
    pub gain: f32,
}

/// Where it goes to.
#[derive(Debug)]
pub struct Outputs<'a> {
    /// displacements × height × width.
    pub volume: &'a mut [f32],
    /// 2 × height × width: right and down, in cells.
    pub argmax: &'a mut [f32],
}

/// What does not fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a cost volume of {shape:?} can't have {older}, {newer}, {flow} values in and {volume}, {argmax} out")]
pub struct Unfit {
    shape: Shape,
    older: usize,
    newer: usize,
    flow: usize,
    volume: usize,
    argmax: usize,
}

/// The operator with its memory, which is taken at the first call of a size.
#[derive(Debug)]
pub struct CostVolume {
    unit: Unit,
    memory: Vec<f32>,
    shape: Option<Shape>,
}

impl Default for CostVolume {
    fn default() -> Self {
        Self::with(Unit::best())
    }
}

impl CostVolume {
    /// With vectors of one's choice.
    pub fn with(unit: Unit) -> Self {
        Self { unit, memory: vec![], shape: None }
    }

    /// Computes everything. `spread` calls its second argument with every number below its first, on whatever threads, and
    /// comes back when that is done; its error ends the work.
    pub fn compute<E: From<Unfit>>(
        &mut self,
        shape: Shape,
        inputs: &Inputs<'_>,
        outputs: Outputs<'_>,
        spread: impl Fn(usize, &(dyn Fn(usize) + Sync)) -> Result<(), E>,
    ) -> Result<(), E> {
        fits(shape, inputs, &outputs)?;
        let (unit, rows, bands) = (self.unit, shape.band(), shape.bands());
        let Shape { channels, height, width, .. } = shape;
        let [turned, fetched, scratch] = self.memory(shape);
        let Inputs { older, newer, flow, sharpness, gain } = *inputs;
        let shape = &shape;

        let to = Bands::new(turned, [1, height, width * shape.depth()], rows);
        spread(bands, &|number| {
            if let Some(to) = to.take(number) {
                unit.run(Turn { shape, newer, to });
            }
        })?;

        let newer = &*turned;
        let to = Bands::new(fetched, [1, height, channels * shape.stride()], rows);
        spread(bands, &|number| {
            if let Some(to) = to.take(number) {
                unit.run(Fetch { shape, newer, flow, to });
            }
        })?;

        let fetched = &*fetched;
        let to = Bands::new(&mut *outputs.volume, [shape.displacements(), height, width], rows);
        let own = Bands::new(&mut *scratch, [1, bands, shape.scratch()], 1);
        spread(bands, &|number| {
            if let (Some(volume), Some(mut own)) = (to.take(number), own.take(number)) {
                unit.run(Multiply { shape, older, fetched, gain, scratch: own.row(0, number), volume });
            }
        })?;

        let volume = &*outputs.volume;
        let own = Bands::new(scratch, [1, bands, shape.scratch()], 1);
        let to = Bands::new(outputs.argmax, [2, height, width], rows);
        let scale = sharpness.exp() / gain;
        spread(bands, &|number| {
            if let (Some(to), Some(mut own)) = (to.take(number), own.take(number)) {
                unit.run(Seek { shape, volume, scale, scratch: own.row(0, number), to });
            }
        })
    }

    /// Memory for turned and fetched features and for the bands; zeros where it is new.
    fn memory(&mut self, shape: Shape) -> [&mut [f32]; 3] {
        let lengths = [
            shape.cells() * shape.depth(),
            shape.height * shape.channels * shape.stride(),
            shape.bands() * shape.scratch(),
        ];
        if self.shape != Some(shape) {
            self.memory.clear();
            self.memory.resize(lengths.iter().sum::<usize>() + LINE, 0.0);
            self.shape = Some(shape);
        }
        // From where a cache line begins; all lengths are whole lines.
        let skipped = self.memory.as_ptr().align_offset(4 * LINE).min(LINE);
        let (turned, rest) = self.memory[skipped..].split_at_mut(lengths[0]);
        let (fetched, rest) = rest.split_at_mut(lengths[1]);
        [turned, fetched, &mut rest[..lengths[2]]]
    }
}

fn fits(shape: Shape, inputs: &Inputs<'_>, outputs: &Outputs<'_>) -> Result<(), Unfit> {
    let found = [inputs.older, inputs.newer, inputs.flow, &*outputs.volume, &*outputs.argmax].map(<[f32]>::len);
    let sound = shape.is_sound() && {
        let cells = shape.cells();
        found == [shape.channels, shape.channels, 2, shape.displacements(), 2].map(|planes| planes * cells)
    };
    let [older, newer, flow, volume, argmax] = found;
    if sound { Ok(()) } else { Err(Unfit { shape, older, newer, flow, volume, argmax }) }
}
