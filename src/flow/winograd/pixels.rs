//! Feature maps as the transforms read them: a pixel's channels side by side, and margins of zeros.

use crate::flow::{
    bands::{Band, Bands},
    lanes::{self, Lanes, TILE, Work},
};

/// Values of a cache line, and of the widest vector: a pixel's channels are filled up to a multiple with zeros.
pub const LINE: usize = lanes::MOST;

/// Values before the first one that begins a cache line: a vector that lies in two lines is read twice.
pub fn skipped(values: &[f32]) -> usize {
    values.as_ptr().align_offset(size_of::<f32>() * LINE).min(LINE)
}

/// A map. Its margins are never written to, so that a convolution finds zeros around the picture.
#[derive(Debug, Default)]
pub struct Pixels {
    values: Vec<f32>,
    /// Of these values the first so many are not used.
    skipped: usize,
    /// Channels, rows and columns.
    pub shape: [usize; 3],
    /// Rows and columns of zeros before the picture, and after it.
    pub margins: [usize; 2],
}

impl Pixels {
    /// Makes it so large; what was in it is gone if that is a change.
    pub fn resize(&mut self, shape: [usize; 3], margins: [usize; 2]) {
        if (self.shape, self.margins) != (shape, margins) {
            (self.shape, self.margins) = (shape, margins);
            self.values.clear();
            self.values.resize((shape[1] + margins[0] + margins[1]) * self.stride() + LINE, 0.0);
            self.skipped = skipped(&self.values);
        }
    }

    /// Values of a pixel.
    pub fn depth(&self) -> usize {
        self.shape[0].next_multiple_of(LINE)
    }

    /// Values of a row, its margins among them.
    pub fn stride(&self) -> usize {
        (self.shape[2] + self.margins[0] + self.margins[1]) * self.depth()
    }

    /// All values, from the margin's first corner on.
    pub fn values(&self) -> &[f32] {
        &self.values[self.skipped..]
    }

    /// The picture's rows, margins left and right among them, in bands of so many.
    pub fn cut(&mut self, rows: usize) -> Bands<'_, f32> {
        let (stride, before, height) = (self.stride(), self.margins[0], self.shape[1]);
        let picture = &mut self.values[self.skipped..][before * stride..][..height * stride];
        Bands::new(picture, [1, height, stride], rows)
    }

    /// Its pixels, each a row of channels and those of margins left and right among them, in bands of so many of the picture's rows
    /// and so many channels.
    pub fn tiled(&mut self, [rows, channels]: [usize; 2]) -> Bands<'_, f32> {
        let (stride, depth, before, height) = (self.stride(), self.depth(), self.margins[0], self.shape[1]);
        let across = stride / depth;
        let picture = &mut self.values[self.skipped..][before * stride..][..height * stride];
        Bands::tiled(picture, [1, height * across, depth], [rows * across, channels])
    }
}

/// Some rows of planes, which are read as if they were one tensor after the other, become pixels.
pub struct Pack<'a> {
    pub parts: &'a [&'a [f32]],
    /// Rows and columns.
    pub size: [usize; 2],
    /// Columns before the picture, and values of a pixel.
    pub before: usize,
    pub depth: usize,
    pub to: Band<'a, f32>,
}

impl Work for Pack<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        let ([height, width], depth) = (self.size, self.depth);
        let cells = height * width;
        for y in self.to.first..self.to.end {
            let to = &mut self.to.row(0, y)[self.before * depth..];
            let mut first = 0;
            for part in self.parts {
                let channels = part.len() / cells;
                for c in (0..channels).step_by(TILE) {
                    for x in (0..width).step_by(TILE) {
                        let from = &part[c * cells + y * width + x..];
                        let to = &mut to[x * depth + first + c..];
                        if channels - c >= TILE && width - x >= TILE {
                            lanes.turn(from, cells, to, depth);
                            continue;
                        }
                        for i in 0..TILE.min(channels - c) {
                            for j in 0..TILE.min(width - x) {
                                to[j * depth + i] = from[i * cells + j];
                            }
                        }
                    }
                }
                first += channels;
            }
        }
    }
}

/// Some rows of a map become planes.
pub struct Unpack<'a> {
    pub from: &'a Pixels,
    pub to: Band<'a, f32>,
}

impl Work for Unpack<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        let Pixels { shape: [channels, _, width], margins: [before, _], .. } = *self.from;
        let depth = self.from.depth();
        for y in self.to.first..self.to.end {
            let from = &self.from.values()[(y + before) * self.from.stride() + before * depth..];
            for x in (0..width).step_by(TILE) {
                let some = TILE.min(width - x);
                for c in (0..channels).step_by(TILE) {
                    let (from, mut turned) = (&from[x * depth + c..], [0.0; TILE * TILE]);
                    if some == TILE {
                        lanes.turn(from, depth, &mut turned, TILE);
                    } else {
                        for (i, column) in from.chunks(depth).take(some).enumerate() {
                            for (j, value) in column.iter().take(TILE).enumerate() {
                                turned[j * TILE + i] = *value;
                            }
                        }
                    }
                    for (row, c) in turned.chunks_exact(TILE).zip(c..channels) {
                        self.to.row(c, y)[x..x + some].copy_from_slice(&row[..some]);
                    }
                }
            }
        }
    }
}
