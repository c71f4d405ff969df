//! One convolution: its weights as the products want them, and its pass over a map.

use std::sync::Arc;

use super::{
    Unit,
    forms::{Filter, Form, SIZE, Transforms},
    pixels::{LINE, Pixels, skipped},
    product::{self, Factors, STEP},
};
use crate::flow::{
    bands::Band,
    lanes::{Lanes, Work},
};

/// The most tiles whose transforms are held at once: with [`CHUNK`] lines of channels as many as the second cache has room for.
const TILES: usize = 40;
/// The most lines of channels that are multiplied at once: their weights for a panel of outputs, and all tiles of a place, stay in
/// the first cache.
const CHUNK: usize = 8;
/// About how many bands a picture is cut into, and the least tiles of one: weights are fetched once for each.
const BANDS: usize = 8;
const TILES_LEAST: usize = 32;
/// The same for two equal bands where there would be one: they are worth more than weights, for bands of outputs transform the
/// same tiles.
const TILES_HALF: usize = 8;
/// As if there were so many where there are fewer: weights take as long then as the products with them.
const TILES_FEW: usize = 24;
/// Outputs are cut at multiples of this, for so many are multiplied at once.
const PART: usize = 32;

/// Memory that is equal to its argument, which may be what was given before.
pub type Known = fn(Arc<[f32]>) -> Arc<[f32]>;

/// A convolution of 3 × 3 that keeps the size, with zeros around its input.
#[derive(Debug)]
pub struct Layer {
    unit: Unit,
    /// Which of the inputs, if any, each one that is multiplied is.
    inputs: Vec<Option<usize>>,
    outputs: usize,
    dilation: usize,
    slope: f32,
    /// Outputs × inputs × 3 × 3.
    weights: Arc<[f32]>,
    /// For whole lines of outputs.
    bias: Vec<f32>,
    known: Known,
    form: Form,
    /// For each form that was needed so far, for each place what [`Factors::weights`] describes.
    prepared: [Option<Arc<[f32]>>; 2],
}

impl Layer {
    /// `weights` are outputs × inputs × 3 × 3, the inputs being those of so many maps; weights lie `dilation` rows and columns
    /// apart; negative results are multiplied with `slope`, which is at most 1.
    ///
    /// # Panics
    ///
    /// If there are not as many weights and biases as that.
    pub fn new(
        unit: Unit,
        weights: &[f32],
        (outputs, read): (usize, &[usize]),
        bias: &[f32],
        dilation: usize,
        slope: f32,
    ) -> Self {
        let count = read.iter().sum::<usize>();
        assert!(weights.len() == outputs * count * SIZE * SIZE && bias.len() == outputs && dilation > 0);
        let mut whole = vec![0.0; outputs.next_multiple_of(LINE)];
        whole[..outputs].copy_from_slice(bias);
        // The first map's come last: they are many at once and seldom whole lines, which the others must be.
        let (mut inputs, mut end) = (vec![], count);
        for (map, channels) in read.iter().enumerate().rev() {
            let whole = if map > 0 { channels.next_multiple_of(LINE) } else { *channels };
            inputs.extend((0..whole).map(|c| (c < *channels).then_some(end - channels + c)));
            end -= channels;
        }
        let (weights, prepared) = (aligned(weights), [None, None]);
        Self {
            unit,
            inputs,
            outputs,
            dilation,
            slope,
            weights,
            bias: whole,
            known: |new| new,
            form: Form::Small,
            prepared,
        }
    }

    /// Has all memory for weights go through `known`, so that layers of equal weights may share it.
    pub fn share(&mut self, known: Known) {
        (self.known, self.weights) = (known, known(self.weights.clone()));
    }

    /// Channels that go in.
    pub fn inputs(&self) -> usize {
        self.inputs.iter().flatten().count()
    }

    /// Channels that come out.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Makes the layer ready for pictures of this size.
    pub fn fit(&mut self, size: [usize; 2]) {
        let cost = |form: &Form| form.places() * self.all(*form, size).max(TILES_FEW);
        self.form = Form::ALL.into_iter().min_by_key(cost).unwrap_or(Form::Small);
        if self.prepared[self.form as usize].is_none() {
            let mut packed = vec![0.0; self.form.places() * self.inputs.len() * self.bias.len()];
            self.unit.run(Prepare { layer: self, to: &mut packed });
            self.prepared[self.form as usize] = Some((self.known)(aligned(&packed)));
        }
    }

    /// How many tiles a picture has.
    fn all(&self, form: Form, [height, width]: [usize; 2]) -> usize {
        self.firsts(form, height) * self.firsts(form, width)
    }

    /// Rows and columns of zeros that the input must have before and after it: a tile may begin in its last row.
    pub fn margins(&self) -> [usize; 2] {
        [self.dilation, self.form.out() * self.dilation]
    }

    /// Rows of a band for a picture of so many rows and columns.
    pub fn band(&self, [height, width]: [usize; 2]) -> usize {
        let group = self.form.out() * self.dilation;
        let (groups, tiles) = (height.div_ceil(group).max(1), self.dilation * width.div_ceil(self.form.out()).max(1));
        let rows = groups.div_ceil(BANDS).max(TILES_LEAST.div_ceil(tiles));
        let halves = groups.is_multiple_of(2) && groups * tiles >= 2 * TILES_HALF;
        let rows = if rows >= groups && halves { groups / 2 } else { rows };
        group * groups.div_ceil(groups.div_ceil(rows))
    }

    /// Outputs of a band: half of them where the rows are one band, too few or too far apart for two, else all.
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
        let depths = [self.chunk() * LINE, self.part([height, width])];
        self.form.places() * depths.map(|depth| room(tiles, depth)).iter().sum::<usize>()
    }

    /// The most lines of channels that are transformed at once.
    fn chunk(&self) -> usize {
        self.inputs.len().div_ceil(LINE).min(CHUNK)
    }

    /// How many tiles of such a picture are transformed at once: [`TILES`], or all of a band.
    fn tiles(&self, [height, width]: [usize; 2]) -> usize {
        let rows = self.band([height, width]).min(height);
        self.all(self.form, [rows, width]).min(TILES).next_multiple_of(STEP)
    }

    /// Which of `length` rows or columns tiles begin in: of every `out` times `dilation` the first ones.
    fn first(&self, number: usize) -> usize {
        self.form.out() * self.dilation * (number / self.dilation) + number % self.dilation
    }

    /// How many rows or columns there are that tiles begin in.
    fn firsts(&self, form: Form, length: usize) -> usize {
        let group = form.out() * self.dilation;
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
    layer: &'a Layer,
    to: &'a mut [f32],
}

impl Work for Prepare<'_> {
    #[inline(always)]
    fn on<L: Lanes>(self, _: L) {
        let Layer { inputs, weights, bias, form, .. } = self.layer;
        let (each, whole) = (self.layer.inputs() * SIZE * SIZE, bias.len());
        let weights = &weights[skipped(weights)..][..self.layer.outputs * each];
        for (o, of_output) in weights.chunks_exact(each).enumerate() {
            // The panel that the output is in, and where in it.
            let pairs = 2 * L::COUNT;
            let first = o / pairs * pairs;
            let vectors = product::panel::<L>(whole, first);
            let (first, wide) = if vectors == 2 { (first, pairs) } else { (o / L::COUNT * L::COUNT, L::COUNT) };
            let (of_output, _) = of_output.as_chunks();
            for (i, input) in inputs.iter().enumerate() {
                let Some(weights) = input.map(|input| &of_output[input]) else { continue };
                for (place, value) in form.prepared(weights).enumerate() {
                    self.to[(place * whole + first) * inputs.len() + i * wide + o - first] = value;
                }
            }
        }
    }
}

/// A band of a convolution.
pub struct Convolve<'a> {
    pub layer: &'a Layer,
    /// Maps of one size.
    pub from: &'a [Pixels],
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
    fn on<L: Lanes>(self, lanes: L) {
        match self.layer.form {
            Form::Small => self.tiled::<L, 2, 4>(lanes),
            Form::Large => self.tiled::<L, 4, 6>(lanes),
        }
    }
}

impl Convolve<'_> {
    #[inline(always)]
    fn tiled<L: Lanes, const OUT: usize, const IN: usize>(mut self, lanes: L)
    where
        Filter: Transforms<OUT, IN>,
    {
        let Some(Pixels { shape: [_, height, width], .. }) = self.from.first() else { return };
        let (layer, prepared, places) = (self.layer, &self.layer.prepared[self.layer.form as usize], IN * IN);
        let Some(prepared) = prepared else { return };
        let across = layer.firsts(layer.form, *width);
        let begin = layer.firsts(layer.form, self.to.first / self.across);
        let all = (layer.firsts(layer.form, self.to.end / self.across) - begin) * across;
        let most = layer.tiles([*height, *width]);
        let parts = all.div_ceil(most).max(1);
        let some = all.div_ceil(parts).next_multiple_of(STEP).min(most);
        let (inputs, [first, end]) = (layer.inputs.len(), [self.to.left, self.to.right]);
        let outputs = end - first;
        let (room_seen, room_given) = (room(some, layer.chunk() * LINE), room(some, outputs));
        let (seen, results) = std::mem::take(&mut self.scratch).split_at_mut(places * room_seen);
        for start in (0..all).step_by(some) {
            let count = some.min(all - start);
            let place = |tile: usize| {
                let tile = start + tile;
                [layer.first(begin + tile / across), layer.first(tile % across)]
            };
            let mut done = 0;
            for map in self.from.iter().rev() {
                let lines = map.depth() / LINE;
                let chunk = lines.div_ceil(lines.div_ceil(layer.chunk()));
                for line in (0..lines).step_by(chunk) {
                    let chunk = chunk.min(lines - line);
                    for tile in 0..count {
                        let to = &mut seen[tile * LINE..];
                        self.look::<L, OUT, IN>(lanes, (map, [line, line + chunk]), place(tile), [some, room_seen], to);
                    }
                    let weights = prepared[skipped(prepared)..].chunks_exact(inputs * layer.bias.len());
                    let mut panels =
                        weights.take(places).map(|weights| &weights[inputs * first..inputs * end]).peekable();
                    let those = [done, inputs.min(done + chunk * LINE)];
                    for number in 0..places {
                        let (Some(weights), following) = (panels.next(), panels.peek().copied().unwrap_or(&[])) else {
                            return;
                        };
                        let tiles = seen[number * room_seen..].as_chunks().0;
                        let factors = Factors { tiles, count: some, inputs, some: those, weights, following };
                        product::multiply(lanes, factors, &mut results[number * room_given..][..room_given], outputs);
                    }
                    done = those[1];
                }
            }
            for tile in 0..count {
                self.finish::<L, OUT, IN>(lanes, place(tile), &results[tile * outputs..], room_given);
            }
        }
    }

    /// Bᵀ d B of the tile that begins there, for some lines of channels. There are `count` tiles, and `room` values of a place.
    #[inline(always)]
    fn look<L: Lanes, const OUT: usize, const IN: usize>(
        &self,
        lanes: L,
        (map, [first, end]): (&Pixels, [usize; 2]),
        [y, x]: [usize; 2],
        [count, room]: [usize; 2],
        to: &mut [f32],
    ) where
        Filter: Transforms<OUT, IN>,
    {
        let (dilation, depth, stride) = (self.layer.dilation, map.depth(), map.stride());
        // The margin before the picture is as wide as the dilation or wider.
        let skipped = map.margins[0] - dilation;
        let from = &map.values()[(y + skipped) * stride + (x + skipped) * depth + first * LINE..];
        for c in (0..(end - first) * LINE).step_by(L::COUNT) {
            let mut rows = [[lanes.splat(0.0); IN]; IN];
            for (i, row) in rows.iter_mut().enumerate() {
                for (j, value) in row.iter_mut().enumerate() {
                    *value = lanes.load(&from[dilation * (i * stride + j * depth) + c..]);
                }
                *row = Filter::looked(lanes, *row);
            }
            let at = c / LINE * count * LINE + c % LINE;
            for (j, column) in turned(rows).into_iter().enumerate() {
                for (i, value) in Filter::looked(lanes, column).into_iter().enumerate() {
                    lanes.store(value, &mut to[(i * IN + j) * room + at..]);
                }
            }
        }
    }

    /// Aᵀ m A, bias and activation, to the pixels of the tile that begins there, or those that there are.
    #[inline(always)]
    fn finish<L: Lanes, const OUT: usize, const IN: usize>(
        &mut self,
        lanes: L,
        [y, x]: [usize; 2],
        from: &[f32],
        room: usize,
    ) where
        Filter: Transforms<OUT, IN>,
    {
        let Layer { dilation, slope, bias, .. } = self.layer;
        let (slope, width, bottom) = (lanes.splat(*slope), self.from[0].shape[2], self.to.end / self.across);
        let bias = &bias[self.to.left..self.to.right];
        for c in (0..bias.len()).step_by(L::COUNT) {
            let mut rows = [[lanes.splat(0.0); OUT]; IN];
            for (i, row) in rows.iter_mut().enumerate() {
                let mut values = [lanes.splat(0.0); IN];
                for (j, value) in values.iter_mut().enumerate() {
                    *value = lanes.load(&from[(i * IN + j) * room + c..]);
                }
                *row = Filter::finished(lanes, values);
            }
            let bias = lanes.load(&bias[c..]);
            for (j, column) in turned(rows).into_iter().enumerate() {
                for (i, value) in Filter::finished(lanes, column).into_iter().enumerate() {
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
