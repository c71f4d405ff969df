//! Convolutions in 32 bits of any odd size and stride, as they are defined: where weights are few, other ways cost more than they
//! save.

use crate::flow::{
    bands::{Band, Bands},
    convolutions::{Spread, layer::Step},
    lanes::{Lanes, TILE, Unit, Work},
    winograd::{
        pixels::{LINE, Pixels},
        product::{MANY, most, panel},
    },
};

/// The most outputs that are computed at once: two vectors of 16.
const WIDE: usize = 2 * LINE;
/// About how many bands a picture is cut into.
const BANDS: usize = 8;

/// The most products that are summed up before they are added to those before: one long sum loses more digits.
const FOLD: usize = 32;

/// A convolution with zeros around its input.
#[derive(Debug)]
pub struct Layer {
    step: Step,
    inputs: usize,
    outputs: usize,
    size: [usize; 2],
    /// For each panel of outputs, two vectors or the last one of one, those of each tap and input.
    weights: Vec<f32>,
    /// For whole lines of outputs.
    bias: Vec<f32>,
}

/// What is read: rows of pixels.
#[derive(Debug, Clone, Copy)]
pub struct From<'a> {
    /// From the first pixel on that an output of row and column 0 reads; a line more than there are.
    pub values: &'a [f32],
    /// Values from one row to the next, and from one pixel to the next.
    pub strides: [usize; 2],
    /// Rows and columns of the picture.
    pub size: [usize; 2],
}

impl<'a> From<'a> {
    /// A map, for a convolution that reads so many rows and columns around a pixel.
    pub fn map(map: &'a Pixels, around: [usize; 2]) -> Self {
        let ([_, height, width], strides) = (map.shape, [map.stride(), map.depth()]);
        let [y, x] = around.map(|around| map.margins[0] - around);
        Self { values: &map.values()[y * strides[0] + x * strides[1]..], strides, size: [height, width] }
    }
}

/// Where results go to: as [`super::To`] has it.
pub type To<'a> = super::To<'a, Pixels>;

impl Layer {
    /// `weights` are outputs × inputs × rows × columns; there is a bias for each output, or none.
    pub fn new(
        unit: Unit,
        weights: &[f32],
        [outputs, inputs, rows, columns]: [usize; 4],
        bias: &[f32],
        step: Step,
    ) -> Self {
        let mut whole = vec![0.0; outputs.next_multiple_of(LINE)];
        whole[..bias.len()].copy_from_slice(bias);
        let mut packed = vec![0.0; whole.len() * inputs * rows * columns];
        let size = [rows, columns];
        unit.run(Prepare { weights, inputs, taps: rows * columns, whole: whole.len(), to: &mut packed });
        Self { step, inputs, outputs, size, weights: packed, bias: whole }
    }

    /// Channels that come out.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Rows and columns around a pixel that it reads.
    pub fn around(&self) -> [usize; 2] {
        self.size.map(|length| self.step.dilation * (length / 2))
    }

    /// How many parts sums have, one for each row, and values of a part.
    pub fn sums(&self, height: usize) -> [usize; 2] {
        [height, 2 * self.bias.len()]
    }

    /// Computes everything.
    pub fn run<E>(&self, unit: Unit, from: From<'_>, to: To<'_>, spread: &impl Spread<E>) -> Result<(), E> {
        let ([height, width], [down, right]) = (from.size, self.step.stride);
        let (height, width) = (height.div_ceil(down), width.div_ceil(right));
        let rows = height.div_ceil(BANDS).max(1);
        let (mut margin, mut depth) = (0, 0);
        let map = to.map.map(|map| {
            (margin, depth) = (map.margins[0], map.depth());
            map.cut(rows)
        });
        let planes = to.planes.map(|planes| Bands::new(planes, [self.outputs, height, width], rows));
        let [parts, each] = self.sums(height);
        let sums = to.sums.map(|sums| Bands::new(sums, [1, parts, each], rows));
        spread(height.div_ceil(rows), &|number| {
            let map = map.as_ref().and_then(|map| map.take(number));
            let planes = planes.as_ref().and_then(|planes| planes.take(number));
            let sums = sums.as_ref().and_then(|sums| sums.take(number));
            let rows = [number * rows, height.min((number + 1) * rows)];
            // Whoever asks for a band a second time gets nothing.
            if map.is_some() || planes.is_some() {
                unit.run(Convolve { layer: self, from, rows, width, margin, depth, map, planes, sums });
            }
        })
    }
}

/// Weights in the order in which they are used.
struct Prepare<'a> {
    weights: &'a [f32],
    inputs: usize,
    taps: usize,
    whole: usize,
    to: &'a mut [f32],
}

impl Work for Prepare<'_> {
    #[inline(always)]
    fn on<L: Lanes>(self, _: L) {
        let Self { weights, inputs, taps, whole, to } = self;
        let (mut first, mut left) = (0, to);
        while first < whole {
            let wide = panel::<L>(whole, first) * L::COUNT;
            let (panel, others) = left.split_at_mut(wide * inputs * taps);
            for (at, value) in panel.iter_mut().enumerate() {
                let (tap, input, output) = (at / (inputs * wide), at / wide % inputs, first + at % wide);
                *value = weights.get((output * inputs + input) * taps + tap).copied().unwrap_or(0.0);
            }
            (first, left) = (first + wide, others);
        }
    }
}

/// Some rows of the output.
struct Convolve<'a> {
    layer: &'a Layer,
    from: From<'a>,
    rows: [usize; 2],
    width: usize,
    margin: usize,
    depth: usize,
    map: Option<Band<'a, f32>>,
    planes: Option<Band<'a, f32>>,
    sums: Option<Band<'a, f32>>,
}

impl Work for Convolve<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        let Layer { inputs, size: [rows, columns], ref weights, ref bias, .. } = *self.layer;
        let most = most::<L>();
        for y in self.rows[0]..self.rows[1] {
            if let Some(sums) = &mut self.sums {
                sums.row(0, y).fill(0.0);
            }
            let (mut first, mut rest) = (0, &weights[..]);
            while first < bias.len() {
                let vectors = panel::<L>(bias.len(), first);
                let (weights, others) = rest.split_at(inputs * rows * columns * vectors * L::COUNT);
                let mut x = 0;
                while x < self.width {
                    let left = (self.width - x).min(most);
                    let at = At { y, x, first, weights };
                    x += match (vectors, left) {
                        (2, 8..) => self.block::<L, 8, 2>(lanes, at),
                        (2, 6..) => self.block::<L, 6, 2>(lanes, at),
                        (2, 4..) => self.block::<L, 4, 2>(lanes, at),
                        (2, 2..) => self.block::<L, 2, 2>(lanes, at),
                        (2, _) => self.block::<L, 1, 2>(lanes, at),
                        (_, 8..) => self.block::<L, 8, 1>(lanes, at),
                        (_, 6..) => self.block::<L, 6, 1>(lanes, at),
                        (_, 4..) => self.block::<L, 4, 1>(lanes, at),
                        (_, 2..) => self.block::<L, 2, 1>(lanes, at),
                        (_, _) => self.block::<L, 1, 1>(lanes, at),
                    };
                }
                (first, rest) = (first + vectors * L::COUNT, others);
            }
        }
    }
}

/// Which results, and their weights.
#[derive(Clone, Copy)]
struct At<'a> {
    y: usize,
    x: usize,
    first: usize,
    weights: &'a [f32],
}

impl Convolve<'_> {
    /// `R` pixels and a panel of `N` vectors of outputs, and how many pixels those are.
    #[inline(always)]
    fn block<L: Lanes, const R: usize, const N: usize>(&mut self, lanes: L, at: At<'_>) -> usize {
        let mut found = [0.0; MANY * WIDE];
        let sums = self.sums.as_mut().map(|sums| sums.row(0, at.y));
        lanes.enter(Block::<R, N> { layer: self.layer, from: self.from, at, sums, found: &mut found });
        let (At { y, x, first, .. }, wide) = (at, N * L::COUNT);
        if let Some(map) = &mut self.map {
            let row = &mut map.row(0, y)[(self.margin + x) * self.depth + first..];
            for (to, from) in row.chunks_mut(self.depth).zip(found.chunks_exact(wide)).take(R) {
                to[..wide].copy_from_slice(from);
            }
        }
        if let Some(planes) = &mut self.planes {
            let mut turned = [0.0; TILE * TILE];
            for c in (0..wide.min(self.layer.outputs - first)).step_by(TILE) {
                if wide - c >= TILE {
                    lanes.turn(&found[c..], wide, &mut turned, TILE);
                } else {
                    for (j, row) in found.chunks_exact(wide).take(TILE).enumerate() {
                        (0..wide - c).for_each(|i| turned[i * TILE + j] = row[c + i]);
                    }
                }
                let channels = TILE.min(wide - c).min(self.layer.outputs - first - c);
                for (i, row) in turned.chunks_exact(TILE).take(channels).enumerate() {
                    planes.row(first + c + i, y)[x..x + R].copy_from_slice(&row[..R]);
                }
            }
        }
        R
    }
}

struct Block<'a, const R: usize, const N: usize> {
    layer: &'a Layer,
    from: From<'a>,
    at: At<'a>,
    sums: Option<&'a mut [f32]>,
    /// Rows of `N` vectors.
    found: &'a mut [f32; MANY * WIDE],
}

impl<const R: usize, const N: usize> Work for Block<'_, R, N> {
    #[inline(always)]
    fn on<L: Lanes>(self, lanes: L) {
        let Self { layer, from: From { values, strides: [row, pixel], .. }, at: At { y, x, first, weights }, .. } =
            self;
        let Layer { inputs, step: Step { stride: [down, right], dilation, slope }, .. } = *layer;
        let found = self.found;
        for to in found.chunks_exact_mut(N * L::COUNT).take(R) {
            to.copy_from_slice(&layer.bias[first..][..N * L::COUNT]);
        }
        let (mut sums, mut summed) = ([[lanes.splat(0.0); N]; R], 0);
        for (tap, weights) in weights.chunks_exact(inputs * N * L::COUNT).enumerate() {
            let [ty, tx] = [tap / layer.size[1], tap % layer.size[1]].map(|tap| tap * dilation);
            let start = (y * down + ty) * row + (x * right + tx) * pixel;
            for (line, weights) in weights.chunks(LINE * N * L::COUNT).enumerate() {
                let lines: [&[f32; LINE]; R] = std::array::from_fn(|r| {
                    let from = &values[start + r * right * pixel + line * LINE..];
                    from.first_chunk().unwrap_or(&[0.0; LINE])
                });
                let channels = LINE.min(inputs - line * LINE);
                if summed + channels > FOLD {
                    fold(lanes, &mut sums, found);
                    summed = 0;
                }
                summed += channels;
                for (k, weights) in weights.chunks_exact(N * L::COUNT).enumerate().take(channels) {
                    let near = lanes.load(weights);
                    let far = if N > 1 { lanes.load(&weights[L::COUNT..]) } else { near };
                    // Written out, for a loop may leave the sums in memory.
                    macro_rules! each {
                        ($($r:literal)*) => { $(if $r < R {
                            let value = lanes.splat(lines[$r % R][k]);
                            sums[$r % R][0] = lanes.fused(value, near, sums[$r % R][0]);
                            if N > 1 {
                                sums[$r % R][N - 1] = lanes.fused(value, far, sums[$r % R][N - 1]);
                            }
                        })* };
                    }
                    each!(0 1 2 3 4 5 6 7);
                }
            }
        }
        fold(lanes, &mut sums, found);
        if let Some(totals) = self.sums {
            let (ones, squares) = totals.split_at_mut(layer.bias.len());
            for n in 0..N {
                let at = first + n * L::COUNT;
                let (mut one, mut square) = (lanes.load(&ones[at..]), lanes.load(&squares[at..]));
                for r in 0..R {
                    let value = lanes.load(&found[(r * N + n) * L::COUNT..]);
                    (one, square) = (lanes.add(one, value), lanes.fused(value, value, square));
                }
                lanes.store(one, &mut ones[at..]);
                lanes.store(square, &mut squares[at..]);
            }
        }
        if slope < 1.0 {
            let slope = lanes.splat(slope);
            for to in found.chunks_exact_mut(L::COUNT).take(R * N) {
                let value = lanes.load(to);
                lanes.store(lanes.max(value, lanes.mul(slope, value)), to);
            }
        }
    }
}

/// Adds sums to those found so far, and begins new ones.
#[inline(always)]
fn fold<L: Lanes, const R: usize, const N: usize>(lanes: L, sums: &mut [[L::V; N]; R], found: &mut [f32]) {
    macro_rules! each {
        ($($r:literal)*) => { $(if $r < R {
            for n in 0..N {
                let to = &mut found[($r * N + n) * L::COUNT..];
                lanes.store(lanes.add(lanes.load(to), sums[$r % R][n]), to);
                sums[$r % R][n] = lanes.splat(0.0);
            }
        })* };
    }
    each!(0 1 2 3 4 5 6 7);
}
