//! One convolution: its weights as the products want them, and its pass over a map.

use std::sync::Arc;

use super::{
    Unit,
    pixels::{LINE, Pixels, skipped},
    product::{self, Factors, STEP},
};
use crate::flow::{
    bands::Band,
    lanes::{Lanes, Work},
};

/// Rows and columns of the weights.
const SIZE: usize = 3;
/// Rows and columns of a tile of results.
const OUT: usize = 2;
/// Rows and columns of what a tile is made of.
const IN: usize = OUT + SIZE - 1;
/// Places of a transformed tile.
const PLACES: usize = IN * IN;
/// Of the weights' transform: G of Lavin and Gray.
const G: [[f64; SIZE]; IN] = [[1.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.5, -0.5, 0.5], [0.0, 0.0, 1.0]];
/// About the most tiles whose transforms are held at once: as many as leave the second cache some room.
const TILES: usize = 24;
/// About how many bands a picture is cut into, and the least tiles of one: weights are fetched once for each.
const BANDS: usize = 8;
const TILES_LEAST: usize = 16;
/// Outputs are cut at multiples of this, for so many are multiplied at once.
const PART: usize = 32;

/// A convolution of 3 × 3 that keeps the size, with zeros around its input.
#[derive(Debug)]
pub struct Layer {
    inputs: usize,
    outputs: usize,
    dilation: usize,
    slope: f32,
    /// For each place what [`Factors::weights`] describes.
    weights: Arc<[f32]>,
    /// For whole lines of outputs.
    bias: Vec<f32>,
}

impl Layer {
    /// `weights` are outputs × inputs × 3 × 3; weights lie `dilation` rows and columns apart; negative results are multiplied
    /// with `slope`, which is at most 1.
    ///
    /// # Panics
    ///
    /// If there are not as many weights and biases as that.
    pub fn new(
        unit: Unit,
        weights: &[f32],
        [outputs, inputs]: [usize; 2],
        bias: &[f32],
        dilation: usize,
        slope: f32,
    ) -> Self {
        assert!(weights.len() == outputs * inputs * SIZE * SIZE && bias.len() == outputs && dilation > 0);
        let mut whole = vec![0.0; outputs.next_multiple_of(LINE)];
        whole[..outputs].copy_from_slice(bias);
        let mut packed = vec![0.0; PLACES * inputs * whole.len()];
        unit.run(Prepare { weights, inputs, outputs, to: &mut packed });
        Self { inputs, outputs, dilation, slope, weights: aligned(&packed), bias: whole }
    }

    /// Exchanges the weights for what `known` has instead, which must be equal.
    pub fn share(&mut self, known: impl FnOnce(Arc<[f32]>) -> Arc<[f32]>) {
        self.weights = known(self.weights.clone());
    }

    /// Channels that go in.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// Channels that come out.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Rows and columns of zeros that the input must have before and after it: a tile may begin in its last row.
    pub fn margins(&self) -> [usize; 2] {
        [self.dilation, OUT * self.dilation]
    }

    /// Rows of a band for a picture of so many rows and columns.
    pub fn band(&self, [height, width]: [usize; 2]) -> usize {
        let group = OUT * self.dilation;
        let (groups, tiles) = (height.div_ceil(group).max(1), self.dilation * width.div_ceil(OUT).max(1));
        let rows = groups.div_ceil(BANDS).max(TILES_LEAST.div_ceil(tiles));
        group * groups.div_ceil(groups.div_ceil(rows))
    }

    /// Outputs of a band: half of them where the rows are one band, too few or too far apart for more, else all.
    pub fn part(&self, size: [usize; 2]) -> usize {
        let outputs = self.bias.len();
        if self.band(size) < size[0] { outputs } else { outputs.div_ceil(2).next_multiple_of(PART).min(outputs) }
    }

    /// How many bands there are, by rows and by outputs.
    pub fn bands(&self, size: [usize; 2]) -> usize {
        size[0].div_ceil(self.band(size)) * self.bias.len().div_ceil(self.part(size))
    }

    /// Values that a band needs for itself.
    pub fn scratch(&self, [height, width]: [usize; 2]) -> usize {
        let tiles = self.tiles([height, width]);
        PLACES * (room(tiles, self.inputs.next_multiple_of(LINE)) + room(tiles, self.part([height, width])))
    }

    /// How many tiles of such a picture are transformed at once: [`TILES`], or all of a band.
    fn tiles(&self, [height, width]: [usize; 2]) -> usize {
        let rows = self.band([height, width]).min(height);
        (self.firsts(rows) * self.firsts(width)).min(TILES).next_multiple_of(STEP)
    }

    /// Which of `length` rows or columns tiles begin in: of every two times `dilation` the first half.
    fn first(&self, number: usize) -> usize {
        OUT * self.dilation * (number / self.dilation) + number % self.dilation
    }

    /// How many rows or columns there are that tiles begin in.
    fn firsts(&self, length: usize) -> usize {
        let group = OUT * self.dilation;
        length / group * self.dilation + (length % group).min(self.dilation)
    }
}

/// Memory that begins a cache line where [`skipped`] says.
fn aligned(weights: &[f32]) -> Arc<[f32]> {
    let mut new: Arc<[f32]> = vec![0.0; weights.len() + LINE].into();
    let first = skipped(&new);
    if let Some(to) = Arc::get_mut(&mut new) {
        to[first..][..weights.len()].copy_from_slice(weights);
    }
    new
}

/// Whether two layers' weights are equal, wherever their cache lines begin.
pub fn are_equal(one: &[f32], other: &[f32]) -> bool {
    let of = |weights: &[f32]| skipped(weights)..skipped(weights) + weights.len().saturating_sub(LINE);
    one.len() == other.len() && one[of(one)] == other[of(other)]
}

/// Values of one place of so many tiles: a line more than there are, so that places don't drive each other out of the cache.
fn room(tiles: usize, depth: usize) -> usize {
    tiles * depth + LINE
}

/// G g Gᵀ of every weight, in the order of the products.
struct Prepare<'a> {
    weights: &'a [f32],
    inputs: usize,
    outputs: usize,
    to: &'a mut [f32],
}

impl Work for Prepare<'_> {
    #[inline(always)]
    fn on<L: Lanes>(self, _: L) {
        let whole = self.outputs.next_multiple_of(LINE);
        for (o, of_output) in self.weights.chunks_exact(self.inputs * SIZE * SIZE).enumerate() {
            // The panel that the output is in, and where in it.
            let pairs = 2 * L::COUNT;
            let first = o / pairs * pairs;
            let vectors = product::panel::<L>(whole, first);
            let (first, wide) = if vectors == 2 { (first, pairs) } else { (o / L::COUNT * L::COUNT, L::COUNT) };
            for (i, weights) in of_output.chunks_exact(SIZE * SIZE).enumerate() {
                for place in 0..PLACES {
                    let (row, column) = (G[place / IN], G[place % IN]);
                    let sum: f64 = weights
                        .iter()
                        .enumerate()
                        .map(|(at, g)| row[at / SIZE] * column[at % SIZE] * f64::from(*g))
                        .sum();
                    self.to[(place * whole + first) * self.inputs + i * wide + o - first] = sum as f32;
                }
            }
        }
    }
}

/// A band of a convolution.
pub struct Convolve<'a> {
    pub layer: &'a Layer,
    pub from: &'a Pixels,
    /// Columns before the picture in the output, and columns with those and with those behind it.
    pub before: usize,
    pub across: usize,
    /// [`Layer::scratch`] values.
    pub scratch: &'a mut [f32],
    /// A row of channels for each pixel.
    pub to: Band<'a, f32>,
}

impl Work for Convolve<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        let (layer, [_, height, width]) = (self.layer, self.from.shape);
        let across = layer.firsts(width);
        let begin = layer.firsts(self.to.first / self.across);
        let all = (layer.firsts(self.to.end / self.across) - begin) * across;
        let most = layer.tiles([height, width]);
        let parts = all.div_ceil(most).max(1);
        let some = all.div_ceil(parts).next_multiple_of(STEP).min(most);
        let (inputs, [first, end]) = (self.from.depth(), [self.to.left, self.to.right]);
        let outputs = end - first;
        let (seen, results) = std::mem::take(&mut self.scratch).split_at_mut(PLACES * room(some, inputs));
        for start in (0..all).step_by(some) {
            let count = some.min(all - start);
            let place = |tile: usize| {
                let tile = start + tile;
                [layer.first(begin + tile / across), layer.first(tile % across)]
            };
            for tile in 0..count {
                self.look(lanes, place(tile), tile, some, seen);
            }
            let places = layer.weights[skipped(&layer.weights)..].chunks_exact(layer.inputs * layer.bias.len());
            let panels = places.take(PLACES).map(|weights| &weights[layer.inputs * first..layer.inputs * end]);
            let (seen, stride) = (&*seen, room(some, outputs));
            for (number, weights) in panels.enumerate() {
                let tiles = seen[number * room(some, inputs)..].as_chunks().0;
                let factors = Factors { tiles, count: some, inputs: layer.inputs, weights };
                product::multiply(lanes, factors, &mut results[number * stride..][..stride], outputs);
            }
            for tile in 0..count {
                self.finish(lanes, place(tile), &results[tile * outputs..], stride);
            }
        }
    }
}

/// Bᵀ times a column of four.
#[inline(always)]
fn looked<L: Lanes>(lanes: L, [a, b, c, d]: [L::V; IN]) -> [L::V; IN] {
    [lanes.sub(a, c), lanes.add(b, c), lanes.sub(c, b), lanes.sub(b, d)]
}

/// Aᵀ times a column of four.
#[inline(always)]
fn finished<L: Lanes>(lanes: L, [a, b, c, d]: [L::V; IN]) -> [L::V; OUT] {
    [lanes.add(lanes.add(a, b), c), lanes.sub(lanes.sub(b, c), d)]
}

/// Columns as rows.
#[inline(always)]
fn turned<V: Copy, const R: usize, const C: usize>(rows: [[V; C]; R]) -> [[V; R]; C] {
    let mut columns = [[rows[0][0]; R]; C];
    for (i, row) in rows.iter().enumerate() {
        for (j, value) in row.iter().enumerate() {
            columns[j][i] = *value;
        }
    }
    columns
}

impl Convolve<'_> {
    /// Bᵀ d B of the tile that begins there.
    #[inline(always)]
    fn look<L: Lanes>(&self, lanes: L, [y, x]: [usize; 2], tile: usize, count: usize, to: &mut [f32]) {
        let (dilation, depth, stride) = (self.layer.dilation, self.from.depth(), self.from.stride());
        // The margin before the picture is as wide as the dilation or wider.
        let skipped = self.from.margins[0] - dilation;
        let from = &self.from.values()[(y + skipped) * stride + (x + skipped) * depth..];
        let room = room(count, depth);
        for c in (0..depth).step_by(L::COUNT) {
            let mut rows = [[lanes.splat(0.0); IN]; IN];
            for (i, row) in rows.iter_mut().enumerate() {
                for (j, value) in row.iter_mut().enumerate() {
                    *value = lanes.load(&from[dilation * (i * stride + j * depth) + c..]);
                }
                *row = looked(lanes, *row);
            }
            let at = (c / LINE * count + tile) * LINE + c % LINE;
            for (j, column) in turned(rows).into_iter().enumerate() {
                for (i, value) in looked(lanes, column).into_iter().enumerate() {
                    lanes.store(value, &mut to[(i * IN + j) * room + at..]);
                }
            }
        }
    }

    /// Aᵀ m A, bias and activation, to the four pixels of the tile that begins there, or those that there are.
    #[inline(always)]
    fn finish<L: Lanes>(&mut self, lanes: L, [y, x]: [usize; 2], from: &[f32], room: usize) {
        let Layer { dilation, slope, bias, .. } = self.layer;
        let (slope, width, bottom) = (lanes.splat(*slope), self.from.shape[2], self.to.end / self.across);
        let bias = &bias[self.to.left..self.to.right];
        for c in (0..bias.len()).step_by(L::COUNT) {
            let mut rows = [[lanes.splat(0.0); OUT]; IN];
            for (i, row) in rows.iter_mut().enumerate() {
                let mut values = [lanes.splat(0.0); IN];
                for (j, value) in values.iter_mut().enumerate() {
                    *value = lanes.load(&from[(i * IN + j) * room + c..]);
                }
                *row = finished(lanes, values);
            }
            let bias = lanes.load(&bias[c..]);
            for (j, column) in turned(rows).into_iter().enumerate() {
                for (i, value) in finished(lanes, column).into_iter().enumerate() {
                    let (y, x) = (y + i * dilation, x + j * dilation);
                    if y < bottom && x < width {
                        let value = lanes.add(value, bias);
                        let value = lanes.max(value, lanes.mul(slope, value));
                        lanes.store(value, &mut self.to.row(0, y * self.across + self.before + x)[c..]);
                    }
                }
            }
        }
    }
}
