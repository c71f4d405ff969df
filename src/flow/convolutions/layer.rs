//! One convolution: its weights as the tiles want them, and its pass over a map.

use super::{
    Spread,
    map::Map,
    rows::{self, Halves, Results, Wide},
    tiles::{Begun, Block, LANES, Line, SIDE, STEP, Sums, Unit, Work, narrowed},
};
use crate::flow::bands::{Band, Bands};

/// How a convolution goes over its input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Step {
    /// Rows and columns from one output to the next.
    pub stride: [usize; 2],
    /// Rows and columns from one weight to the next.
    pub dilation: usize,
    /// What negative results are multiplied with: 0 for a ReLU, 1 for none; not more.
    pub slope: f32,
}

/// A convolution with zeros around its input, of an odd size.
#[derive(Debug)]
pub struct Layer {
    step: Step,
    outputs: usize,
    size: [usize; 2],
    /// The maps that it reads.
    reads: Vec<Read>,
    /// For each [`LANES`] outputs those of each map.
    weights: Vec<Line>,
    /// For whole lines of outputs.
    bias: Vec<f32>,
}

/// A map that is read.
#[derive(Debug)]
struct Read {
    channels: usize,
    /// Where each step of the tiles reads, for maps of one stride.
    offsets: Vec<usize>,
    offsets_for: Option<usize>,
}

/// Where results go to.
#[derive(Debug, Default)]
pub struct To<'a> {
    /// As bf16, for the next convolution; of the output's size.
    pub map: Option<&'a mut Map>,
    /// As f32, outputs × height × width.
    pub planes: Option<&'a mut [f32]>,
    /// For each band the sums of each output and of their squares, before the activation: [`Layer::sums`] values.
    pub sums: Option<&'a mut [f32]>,
}

impl Layer {
    /// `weights` are outputs × inputs × rows × columns.
    ///
    /// # Panics
    ///
    /// If there are not as many weights and biases as that.
    pub fn new(weights: &[f32], shape: [usize; 4], bias: &[f32], step: Step) -> Self {
        Self::of_maps(weights, shape, &[shape[1]], bias, step)
    }

    /// The same for inputs that are those of several maps, of so many channels.
    ///
    /// # Panics
    ///
    /// If there are not as many weights, biases and channels as that.
    pub fn of_maps(
        weights: &[f32],
        [outputs, inputs, rows, columns]: [usize; 4],
        read: &[usize],
        bias: &[f32],
        step: Step,
    ) -> Self {
        assert!(weights.len() == outputs * inputs * rows * columns && (bias.is_empty() || bias.len() == outputs));
        assert!(read.iter().sum::<usize>() == inputs, "{inputs} inputs of {read:?}");
        let mut packed = vec![];
        for first in (0..outputs).step_by(LANES) {
            let mut before = 0;
            for &channels in read {
                let weight = |o: usize, i: usize, tap: usize| {
                    let at = (o * inputs + before + i) * rows * columns + tap;
                    if o < outputs && i < channels { narrowed(weights[at]) } else { 0 }
                };
                for tap in 0..rows * columns {
                    for input in (0..channels).step_by(LANES) {
                        for output in (first..first + LANES).step_by(SIDE) {
                            // A line of a tile has two inputs of each of 16 outputs.
                            for two in (input..input + LANES).step_by(2) {
                                packed.push(Line(std::array::from_fn(|j| weight(output + j / 2, two + j % 2, tap))));
                            }
                        }
                    }
                }
                before += channels;
            }
        }
        let mut whole = vec![0.0; outputs.next_multiple_of(LANES)];
        whole[..bias.len()].copy_from_slice(bias);
        let reads = read.iter().map(|channels| Read { channels: *channels, offsets: vec![], offsets_for: None });
        Self { step, outputs, size: [rows, columns], reads: reads.collect(), weights: packed, bias: whole }
    }

    /// Channels that go in.
    pub fn inputs(&self) -> usize {
        self.reads.iter().map(|read| read.channels).sum()
    }

    /// Channels that come out.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// Rows and columns of zeros that the input must have around it.
    pub fn margin(&self) -> usize {
        self.step.dilation * (self.size[0] / 2).max(self.size[1] / 2)
    }

    /// Rows and columns of the output.
    pub fn size_of(&self, height: usize, width: usize) -> [usize; 2] {
        [height.div_ceil(self.step.stride[0]), width.div_ceil(self.step.stride[1])]
    }

    /// Values that [`To::sums`] takes for an output of so many rows.
    pub fn sums(&self, height: usize) -> usize {
        Map::bands(height).1 * 2 * self.bias.len()
    }

    /// Where the steps read, which is the same until the input's width changes.
    fn locate(&mut self, from: &[Map]) {
        let ([rows, columns], dilation) = (self.size, self.step.dilation);
        for (read, from) in self.reads.iter_mut().zip(from) {
            if read.offsets_for == Some(from.stride()) {
                continue;
            }
            read.offsets.clear();
            for tap in 0..rows * columns {
                let at = from.at(tap / columns * dilation, tap % columns * dilation);
                read.offsets.extend((0..from.depth()).map(|line| at + line));
            }
            read.offsets_for = Some(from.stride());
        }
    }

    /// Computes everything, from maps of one size.
    pub fn run<E>(&mut self, unit: Unit, from: &[Map], to: To<'_>, spread: &impl Spread<E>) -> Result<(), E> {
        let (margin, [first, ..]) = (self.margin(), from) else { return Ok(()) };
        let fits = |(read, map): (&Read, &Map)| {
            read.channels == map.channels
                && map.margin >= margin
                && [map.height, map.width] == [first.height, first.width]
        };
        assert!(from.len() == self.reads.len() && self.reads.iter().zip(from).all(fits), "{} channels", self.inputs());
        self.locate(from);
        let (layer, [height, width]) = (&*self, self.size_of(first.height, first.width));
        let (rows, bands) = Map::bands(height);
        let (mut margin, mut depth) = (0, 0);
        let map = to.map.map(|map| {
            assert!([map.channels, map.height, map.width] == [layer.outputs, height, width]);
            (margin, depth) = (map.margin, map.depth());
            map.cut()
        });
        let planes = to.planes.map(|planes| Bands::new(planes, [layer.outputs, height, width], rows));
        let sums = to.sums.map(|sums| Bands::new(sums, [1, bands, 2 * layer.bias.len()], 1));
        spread(bands, &|number| {
            let map = map.as_ref().map(|map| map.take(number));
            let planes = planes.as_ref().map(|planes| planes.take(number));
            let sums = sums.as_ref().map(|sums| sums.take(number));
            // Whoever asks for a band a second time gets nothing.
            if [map.as_ref().is_some_and(Option::is_none), planes.as_ref().is_some_and(Option::is_none)] == [false; 2] {
                let (map, planes, sums) = (map.flatten(), planes.flatten(), sums.flatten());
                let rows = [number * rows, height.min((number + 1) * rows)];
                unit.run(Convolve { layer, from, rows, width, number, map, margin, depth, planes, sums });
            }
        })
    }
}

/// Some rows of the output.
struct Convolve<'a> {
    layer: &'a Layer,
    from: &'a [Map],
    rows: [usize; 2],
    width: usize,
    number: usize,
    map: Option<Band<'a, Line>>,
    margin: usize,
    depth: usize,
    planes: Option<Band<'a, f32>>,
    sums: Option<Band<'a, f32>>,
}

impl Work for Convolve<'_> {
    #[inline(always)]
    fn on(mut self, begun: &Begun) {
        let Layer { step: Step { stride: [down, right], dilation, .. }, size, reads, weights, bias, .. } = self.layer;
        let panel = reads.iter().map(|read| read.offsets.len()).sum::<usize>() * STEP;
        let mut sums = Sums::ZERO;
        for (group, (weights, bias)) in weights.chunks_exact(panel).zip(bias.as_chunks().0).enumerate() {
            let mut totals = [[0.0; LANES]; 2];
            for y in (self.rows[0]..self.rows[1]).step_by(2) {
                let second = (y + 1).min(self.rows[1] - 1);
                for x in (0..self.width).step_by(SIDE) {
                    // The last tile of a row begins earlier, rather than reach beyond it.
                    let first = if self.width < SIDE { 0 } else { x.min(self.width - SIDE) };
                    let mut rest = weights;
                    for (number, (Read { offsets, .. }, from)) in reads.iter().zip(self.from).enumerate() {
                        let around = size.map(|length| from.margin - dilation * (length / 2));
                        let starts = [y, second].map(|y| from.at(around[0] + down * y, around[1] + right * first));
                        let (weights, others) = rest.split_at(offsets.len() * STEP);
                        let stride = right * from.depth();
                        let block = Block { pixels: from.lines(), starts, stride, offsets, weights };
                        begun.multiply(&block, number > 0, &mut sums);
                        rest = others;
                    }
                    let columns = [x, self.width.min(first + SIDE)];
                    for (half, y) in (0..1 + second - y).zip([y, second]) {
                        let skipped = x - first;
                        self.finish(
                            begun,
                            sums.half(half).map(|tile| &tile[skipped..]),
                            group,
                            y,
                            columns,
                            bias,
                            &mut totals,
                        );
                    }
                }
            }
            if let Some(band) = &mut self.sums {
                for (row, totals) in band.row(0, self.number).chunks_exact_mut(self.layer.bias.len()).zip(totals) {
                    row[group * LANES..][..LANES].copy_from_slice(&totals);
                }
            }
        }
    }
}

impl Convolve<'_> {
    /// Bias, sums, activation, and the results' way to where they belong, for one row of pixels.
    #[inline(always)]
    #[allow(clippy::too_many_arguments)]
    fn finish(
        &mut self,
        begun: &Begun,
        sums: Halves<'_>,
        group: usize,
        y: usize,
        [begin, end]: [usize; 2],
        bias: &Wide,
        totals: &mut [Wide; 2],
    ) {
        let (margin, depth) = (self.margin, self.depth);
        let mut wide = [[0.0; LANES]; SIDE];
        let results = Results {
            map: self.map.as_mut().map(|map| (&mut map.row(0, y)[(margin + begin) * depth + group..], depth)),
            wide: self.planes.is_some().then_some(&mut wide),
            totals: self.sums.is_some().then_some(totals),
        };
        let some = end - begin;
        rows::finish(begun.has_vectors(), sums.map(|half| &half[..some]), bias, self.layer.step.slope, results);
        if let Some(planes) = &mut self.planes {
            let channels = LANES.min(self.layer.outputs - group * LANES);
            rows::spread(begun.has_vectors(), &wide[..some], channels, |channel, row| {
                planes.row(group * LANES + channel, y)[begin..end].copy_from_slice(row);
            });
        }
    }
}
