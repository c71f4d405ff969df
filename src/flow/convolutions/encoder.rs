//! RAFT-small's feature encoder (Teed and Deng 2020), each convolution but the last one followed by an instance norm, and what
//! is projected from its levels.

use std::slice;

use super::{
    Spread,
    layer::{Layer, Step, To},
    map::Map,
    rows::{self, Norm},
    tiles::{Begun, LANES, Line, Unit, Work},
};
use crate::flow::bands::{Band, Bands};

/// What is added to a variance.
const EPSILON: f64 = 1e-5;
/// Rows and columns of the first convolution.
const FIRST: usize = 7;
const COLOURS: usize = 3;

/// A convolution's weights as PyTorch has them: outputs × inputs × rows × columns.
#[derive(Debug, Clone, Copy)]
pub struct Weights<'a> {
    /// The numbers.
    pub values: &'a [f32],
    /// Their shape.
    pub shape: [usize; 4],
    /// One for each output; where a norm follows it takes this away again.
    pub bias: &'a [f32],
    /// What negative results are multiplied with where no norm follows; at most 1.
    pub slope: f32,
}

/// A layer of units: whether the first halves the map.
const STRIDES: [usize; 3] = [1, 2, 2];
/// The unit at a quarter of the image's rows and columns that is the last one there.
const QUARTER: usize = 3;
/// Convolutions that it takes: the first, three for each of two units a layer, one for each short cut, the last, and two of
/// 1 × 1 that project what comes out at a quarter and at an eighth of the image's rows and columns.
pub const CONVOLUTIONS: usize = 1 + 3 * 2 * STRIDES.len() + 2 + 1 + 2;

/// What does not fit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Unfit {
    /// Weights of another network.
    #[error("the encoder's convolution {number} should have {wanted}, it has {found:?}")]
    Weights {
        /// Which one, from 0.
        number: usize,
        /// What would do.
        wanted: String,
        /// Outputs, inputs, rows, columns.
        found: [usize; 4],
    },
    /// Buffers of another size.
    #[error("the encoder of {height} × {width} pixels can't have {found:?} values in and out")]
    Size {
        /// Rows.
        height: usize,
        /// Columns.
        width: usize,
        /// Of the image, the projected quarter, the eighth and what is projected from it.
        found: [usize; 4],
    },
}

/// A convolution, its norm, and the map that it gives.
#[derive(Debug)]
struct Normed {
    layer: Layer,
    sums: Vec<f32>,
    /// What each channel is multiplied with and what is added then, for whole lines.
    norm: [Vec<f32>; 2],
    map: Map,
}

/// A 1 × 1, a 3 × 3 and a 1 × 1 convolution around a short cut.
#[derive(Debug)]
struct Bottleneck {
    inner: [Normed; 2],
    last: Normed,
    short: Option<Normed>,
}

/// How the encoder sees an image: `factor` · value + `offset`, and that without its first `shift` rows and columns, with as many
/// of zeros at the end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// What values are multiplied with.
    pub factor: f32,
    /// What is added then.
    pub offset: f32,
    /// Rows and columns; even.
    pub shift: usize,
}

impl View {
    /// The image as it is.
    pub const WHOLE: Self = Self { factor: 1.0, offset: 0.0, shift: 0 };
}

/// The operator `nightflow::Encoder` with its memory, which is taken at the first call of a size.
#[derive(Debug)]
pub struct Encoder {
    unit: Unit,
    view: View,
    /// The image, with all columns that the first convolution looks at side by side.
    image: Map,
    /// For each band the even and the odd columns of a row.
    columns: Vec<f32>,
    first: Normed,
    units: Vec<Bottleneck>,
    last: Layer,
    /// What the last one gives, for the projection that reads it.
    eighth: Map,
    /// Projections of the quarter and of the eighth.
    projections: [Layer; 2],
}

impl Normed {
    fn new(layer: Layer) -> Self {
        let whole = layer.outputs().next_multiple_of(LANES);
        Self { layer, sums: vec![], norm: [vec![0.0; whole], vec![0.0; whole]], map: Map::default() }
    }

    /// Convolves, and finds the norm; the map is not normalised yet. `margin` is what the map's reader needs.
    fn convolve<E>(&mut self, unit: Unit, from: &Map, margin: usize, spread: &impl Spread<E>) -> Result<(), E> {
        let Self { layer, sums, norm: [scale, shift], map } = self;
        let [height, width] = layer.size_of(from.height, from.width);
        map.resize([layer.outputs(), height, width], margin);
        sums.resize(layer.sums(height), 0.0);
        layer.run(unit, slice::from_ref(from), To { map: Some(map), planes: None, sums: Some(sums) }, spread)?;
        let whole = scale.len();
        for channel in 0..layer.outputs() {
            let total = |offset: usize| -> f64 {
                sums.chunks_exact(2 * whole).map(|band| f64::from(band[offset + channel])).sum()
            };
            let cells = (height * width) as f64;
            let mean = total(0) / cells;
            let deviation = (total(whole) / cells - mean * mean).max(0.0) + EPSILON;
            scale[channel] = deviation.sqrt().recip() as f32;
            shift[channel] = -(mean as f32) * scale[channel];
        }
        Ok(())
    }

    /// The norm and a ReLU.
    fn finish<E>(&mut self, unit: Unit, spread: &impl Spread<E>) -> Result<(), E> {
        join(unit, &mut self.map, &self.norm, None, spread)
    }
}

/// map = ReLU(norm(map)), and if there is a short cut, ReLU(that + short), where short may have a norm of its own.
fn join<E>(
    unit: Unit,
    map: &mut Map,
    norm: &[Vec<f32>; 2],
    short: Option<(&Map, Option<&[Vec<f32>; 2]>)>,
    spread: &impl Spread<E>,
) -> Result<(), E> {
    let (height, margin, depth) = (map.height, map.margin, map.depth());
    let (rows, bands) = Map::bands(height);
    let to = map.cut();
    spread(bands, &|number| {
        if let Some(to) = to.take(number) {
            let rows = [number * rows, height.min((number + 1) * rows)];
            unit.run(Join { rows, margin, depth, norm, short, to });
        }
    })
}

struct Join<'a> {
    rows: [usize; 2],
    margin: usize,
    depth: usize,
    norm: &'a [Vec<f32>; 2],
    short: Option<(&'a Map, Option<&'a [Vec<f32>; 2]>)>,
    to: Band<'a, Line>,
}

impl Work for Join<'_> {
    #[inline(always)]
    fn on(mut self, begun: &Begun) {
        let Self { rows, margin, depth, norm, short, .. } = self;
        fn lanes(of: &[Vec<f32>; 2], line: usize) -> Norm<'_> {
            [&of[0].as_chunks().0[line], &of[1].as_chunks().0[line]]
        }
        let fast = begun.has_vectors();
        for y in rows[0]..rows[1] {
            let row = self.to.row(0, y);
            let end = row.len() - margin * depth;
            let row = &mut row[margin * depth..end];
            for line in 0..depth {
                let short = short.map(|(other, norm)| {
                    (&other.row(y)[line..], norm.map_or([&[1.0; LANES], &[0.0; LANES]], |norm| lanes(norm, line)))
                });
                rows::join(fast, &mut row[line..], depth, lanes(norm, line), short);
            }
        }
    }
}

impl Bottleneck {
    fn run<E>(&mut self, unit: Unit, from: &Map, spread: &impl Spread<E>) -> Result<(), E> {
        let Self { inner: [first, second], last, short } = self;
        first.convolve(unit, from, second.layer.margin(), spread)?;
        first.finish(unit, spread)?;
        second.convolve(unit, &first.map, 0, spread)?;
        second.finish(unit, spread)?;
        last.convolve(unit, &second.map, 0, spread)?;
        let short = match short {
            Some(short) => {
                short.convolve(unit, from, 0, spread)?;
                (&short.map, Some(&short.norm))
            }
            None => (from, None),
        };
        join(unit, &mut last.map, &last.norm, Some(short), spread)
    }
}

impl Encoder {
    /// Weights in the order in which they are used, a short cut's after those of its unit: [`CONVOLUTIONS`] of them.
    pub fn new(unit: Unit, view: View, weights: &[Weights<'_>]) -> Result<Self, Unfit> {
        let mut numbered = weights.iter().enumerate();
        let mut take = |inputs: Option<usize>, size: usize, stride: usize, biased: bool| {
            let (number, weights) = numbered
                .next()
                .unwrap_or((CONVOLUTIONS, &Weights { values: &[], shape: [0; 4], bias: &[], slope: 1.0 }));
            let [outputs, found, rows, columns] = weights.shape;
            let whole =
                weights.values.len() == weights.shape.iter().product::<usize>() && weights.bias.len() == outputs;
            if inputs.is_some_and(|inputs| inputs != found) || [rows, columns] != [size; 2] || !whole || outputs == 0 {
                let wanted = format!("{size} × {size} weights of {inputs:?} inputs and a bias for each output");
                return Err(Unfit::Weights { number, wanted, found: weights.shape });
            }
            let (bias, slope) = if biased { (weights.bias, weights.slope) } else { (&[][..], 1.0) };
            let step = Step { stride: [stride; 2], dilation: 1, slope };
            Ok((Layer::new(weights.values, weights.shape, bias, step), *weights))
        };
        let (_, image) = take(Some(COLOURS), FIRST, 2, false)?;
        // Its columns become channels: seven of three colours fill a line, where three would waste it.
        let outputs = image.shape[0];
        let mut turned = vec![0.0; image.values.len()];
        for (i, value) in image.values.iter().enumerate() {
            let [o, c, y, x] =
                [i / (COLOURS * FIRST * FIRST), i / (FIRST * FIRST) % COLOURS, i / FIRST % FIRST, i % FIRST];
            turned[(o * COLOURS * FIRST + x * COLOURS + c) * FIRST + y] = *value;
        }
        let step = Step { stride: [2, 1], dilation: 1, slope: 1.0 };
        let first = Normed::new(Layer::new(&turned, [outputs, COLOURS * FIRST, FIRST, 1], &[], step));
        let (mut units, mut width, mut quarter) = (vec![], outputs, outputs);
        for stride in STRIDES {
            for stride in [stride, 1] {
                let (one, inner) = take(Some(width), 1, 1, false)?;
                let (two, _) = take(Some(inner.shape[0]), 3, stride, false)?;
                let (three, last) = take(Some(two.outputs()), 1, 1, false)?;
                let short = if stride > 1 { Some(take(Some(width), 1, stride, false)?.0) } else { None };
                if short.as_ref().map_or(width, Layer::outputs) != last.shape[0] {
                    let wanted = "as many outputs as its short cut".into();
                    return Err(Unfit::Weights { number: 3 * units.len() + 3, wanted, found: last.shape });
                }
                width = last.shape[0];
                let inner = [one, two].map(Normed::new);
                units.push(Bottleneck { inner, last: Normed::new(three), short: short.map(Normed::new) });
                quarter = if units.len() <= QUARTER + 1 { width } else { quarter };
            }
        }
        let (last, _) = take(Some(width), 1, 1, true)?;
        let projections = [take(Some(quarter), 1, 1, true)?.0, take(Some(last.outputs()), 1, 1, true)?.0];
        let (image, eighth, columns) = (Map::default(), Map::default(), vec![]);
        Ok(Self { unit, view, image, columns, first, units, last, eighth, projections })
    }

    /// Channels of the projected quarter, of the eighth, and of what is projected from that.
    pub fn outputs(&self) -> [usize; 3] {
        let [quarter, eighth] = &self.projections;
        [quarter.outputs(), self.last.outputs(), eighth.outputs()]
    }

    /// An image of three planes of height × width (multiples of eight) to planes: what is projected from the second layer's results
    /// at a quarter of its rows and columns, what the last convolution gives at an eighth, and what is projected from that.
    pub fn run<E: From<Unfit>>(
        &mut self,
        image: &[f32],
        [height, width]: [usize; 2],
        [quarter, eighth, projected]: [&mut [f32]; 3],
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        let (unit, cells, channels) = (self.unit, height * width, self.outputs());
        let found = [image.len(), quarter.len(), eighth.len(), projected.len()];
        let wanted = [COLOURS * cells, channels[0] * cells / 16, channels[1] * cells / 64, channels[2] * cells / 64];
        let shift = self.view.shift;
        if found != wanted
            || cells == 0
            || height % 8 != 0
            || width % 8 != 0
            || !shift.is_multiple_of(2)
            || shift > width
        {
            return Err(Unfit::Size { height, width, found }.into());
        }
        self.look(image, [height, width], spread)?;
        self.first.convolve(unit, &self.image, 0, spread)?;
        self.first.finish(unit, spread)?;
        for index in 0..self.units.len() {
            let (before, following) = self.units.split_at_mut(index);
            let from = before.last().map_or(&self.first.map, |unit| &unit.last.map);
            following[0].run(unit, from, spread)?;
        }
        let planes = |planes| To { map: None, planes: Some(planes), sums: None };
        let Self { units, last, eighth: map, projections: [of_quarter, of_eighth], .. } = self;
        of_quarter.run(unit, slice::from_ref(&units[QUARTER].last.map), planes(quarter), spread)?;
        map.resize([last.outputs(), height / 8, width / 8], 0);
        let from = slice::from_ref(&units[2 * STRIDES.len() - 1].last.map);
        last.run(unit, from, To { map: Some(map), ..planes(eighth) }, spread)?;
        of_eighth.run(unit, slice::from_ref(map), planes(projected), spread)
    }

    /// The image as the first convolution reads it: a pixel for every second column, with that column and three on either
    /// side.
    fn look<E>(&mut self, image: &[f32], [height, width]: [usize; 2], spread: &impl Spread<E>) -> Result<(), E> {
        let half = width / 2;
        self.image.resize([COLOURS * FIRST, height, half], FIRST / 2);
        let (unit, view, margin) = (self.unit, self.view, self.image.margin);
        let (_, bands) = Map::bands(height);
        let stride = half + 2 * BESIDE;
        self.columns.resize(bands * 2 * COLOURS * stride, 0.0);
        let own = Bands::new(&mut self.columns, [1, bands, 2 * COLOURS * stride], 1);
        let to = self.image.cut();
        spread(bands, &|number| {
            if let (Some(to), Some(own)) = (to.take(number), own.take(number)) {
                unit.run(Look { image, height, width, view, number, margin, own, to });
            }
        })
    }
}

/// Columns of zeros on either side of a row's even and odd columns, of which two are looked at.
const BESIDE: usize = 2;

struct Look<'a> {
    image: &'a [f32],
    height: usize,
    width: usize,
    view: View,
    number: usize,
    margin: usize,
    own: Band<'a, f32>,
    to: Band<'a, Line>,
}

impl Work for Look<'_> {
    #[inline(always)]
    fn on(mut self, begun: &Begun) {
        let Self { image, height, width, view: View { factor, offset, shift }, number, margin, .. } = self;
        let (half, columns) = (width / 2, self.own.row(0, number));
        let stride = half + 2 * BESIDE;
        // Images of another size may have been here.
        for row in columns.chunks_exact_mut(stride) {
            row[..BESIDE].fill(0.0);
            row[BESIDE + half..].fill(0.0);
        }
        for y in self.to.first..self.to.end {
            // Even and odd columns of each colour apart: what was every second number is then side by side.
            for (c, two) in columns.chunks_exact_mut(2 * stride).enumerate() {
                let (even, odd) = two.split_at_mut(stride);
                let (even, odd) = (&mut even[BESIDE..][..half], &mut odd[BESIDE..][..half]);
                let from = y + shift;
                let row = if from < height { &image[(c * height + from) * width..][shift..width] } else { &[] };
                let pairs = row.as_chunks::<2>().0;
                for ((even, odd), two) in even.iter_mut().zip(&mut *odd).zip(pairs) {
                    (*even, *odd) = (factor * two[0] + offset, factor * two[1] + offset);
                }
                even[pairs.len()..].fill(0.0);
                odd[pairs.len()..].fill(0.0);
            }
            // Column 2 x + tap − 3 is an odd one for every even tap.
            let channels = std::array::from_fn(|channel| {
                let (tap, c) = (channel / COLOURS, channel % COLOURS);
                let from = (2 * c + (tap + 1) % 2) * stride + BESIDE + tap.div_ceil(2) - 2;
                (tap < FIRST).then(|| &columns[from..][..half])
            });
            rows::pack(begun.has_vectors(), &channels, &mut self.to.row(0, y)[margin..][..half], 1);
        }
    }
}
