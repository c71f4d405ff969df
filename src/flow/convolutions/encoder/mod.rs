//! RAFT-small's feature encoder (Teed and Deng 2020), each convolution but the last one followed by an instance norm, and what
//! is projected from its levels.

mod direct;
mod narrow;
mod wide;

use std::fmt;

pub use narrow::Narrow;
pub use wide::Wide;

use super::{Spread, layer::Step};

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

/// Where a convolution's results go to.
#[derive(Debug)]
pub struct To<'a, M> {
    /// For the next convolution; of the output's size.
    pub map: Option<&'a mut M>,
    /// As f32, outputs × height × width.
    pub planes: Option<&'a mut [f32]>,
    /// Sums of each output and of their squares, before the activation: as [`Numbers::sums`] says.
    pub sums: Option<&'a mut [f32]>,
}

impl<'a, M> To<'a, M> {
    fn planes(planes: &'a mut [f32]) -> Self {
        Self { map: None, planes: Some(planes), sums: None }
    }
}

/// What a short cut leads past a unit, and what that is normalised by, if by anything.
pub type Short<'a, M> = Option<(&'a M, Option<&'a [Vec<f32>; 2]>)>;

/// What numbers maps are made of, and what computes with them.
pub trait Numbers {
    /// The processor's vectors or tiles.
    type Unit: Copy + fmt::Debug;
    /// A convolution.
    type Layer: fmt::Debug;
    /// What convolutions read and give.
    type Map: Default + fmt::Debug;
    /// The image as the first one reads it.
    type Image: Default + fmt::Debug;

    /// Of how many columns of [`Numbers::Image`] the first convolution has an output.
    const FIRST_ACROSS: usize;

    /// A convolution, of outputs × inputs × rows × columns weights and a bias for each output or none.
    fn layer(unit: Self::Unit, weights: &[f32], shape: [usize; 4], bias: &[f32], step: Step) -> Self::Layer;
    /// Channels that come out.
    fn outputs(layer: &Self::Layer) -> usize;
    /// Rows and columns of zeros that its map must have around it.
    fn margin(layer: &Self::Layer) -> usize;
    /// For an output of so many rows how many parts sums have, and how many values a part has: as many sums as squares.
    fn sums(layer: &Self::Layer, height: usize) -> [usize; 2];
    /// Makes a map so large.
    fn resize(map: &mut Self::Map, shape: [usize; 3], margin: usize);
    /// Its rows and columns.
    fn size(map: &Self::Map) -> [usize; 2];
    /// Convolves.
    fn run<E>(
        layer: &mut Self::Layer,
        unit: Self::Unit,
        from: &Self::Map,
        to: To<'_, Self::Map>,
        spread: &impl Spread<E>,
    ) -> Result<(), E>;
    /// The same by the first convolution.
    fn run_first<E>(
        layer: &mut Self::Layer,
        unit: Self::Unit,
        from: &Self::Image,
        to: To<'_, Self::Map>,
        spread: &impl Spread<E>,
    ) -> Result<(), E>;
    /// map = ReLU(norm(map)), and if there is a short cut, ReLU(that + short), where short may have a norm of its own. A norm is what
    /// each channel is multiplied with, and what is added then.
    fn join<E>(
        unit: Self::Unit,
        map: &mut Self::Map,
        norm: &[Vec<f32>; 2],
        short: Short<'_, Self::Map>,
        spread: &impl Spread<E>,
    ) -> Result<(), E>;
    /// The image, of three planes of that size, as the first convolution reads it.
    fn look<E>(
        unit: Self::Unit,
        view: View,
        image: &[f32],
        size: [usize; 2],
        to: &mut Self::Image,
        spread: &impl Spread<E>,
    ) -> Result<(), E>;
}

/// The first convolution's weights for images whose colours lie side by side, and so all that it reads of a row: each column's colours
/// are inputs.
fn side_by_side(weights: &[f32]) -> Vec<f32> {
    let mut turned = vec![0.0; weights.len()];
    for (i, value) in weights.iter().enumerate() {
        let [o, c, y, x] = [i / (COLOURS * FIRST * FIRST), i / (FIRST * FIRST) % COLOURS, i / FIRST % FIRST, i % FIRST];
        turned[(o * COLOURS * FIRST + x * COLOURS + c) * FIRST + y] = *value;
    }
    turned
}

/// Norms are for multiples of so many channels.
const LANES: usize = 32;

/// A convolution and its norm.
#[derive(Debug)]
struct Normed<N: Numbers> {
    layer: N::Layer,
    sums: Vec<f32>,
    /// What each channel is multiplied with and what is added then, for whole lines.
    norm: [Vec<f32>; 2],
}

/// Maps that nobody reads any more, for others of the same channels, rows, columns and margin: all of them together would not
/// fit the caches.
#[derive(Debug)]
struct Free<M> {
    /// The image's.
    size: [usize; 2],
    maps: Vec<([usize; 4], M)>,
}

/// A 1 × 1, a 3 × 3 and a 1 × 1 convolution around a short cut.
#[derive(Debug)]
struct Bottleneck<N: Numbers> {
    inner: [Normed<N>; 2],
    last: Normed<N>,
    /// Which has a stride.
    short: Option<Normed<N>>,
    stride: usize,
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
pub struct Encoder<N: Numbers> {
    unit: N::Unit,
    view: View,
    image: N::Image,
    first: Normed<N>,
    units: Vec<Bottleneck<N>>,
    last: N::Layer,
    /// What the last one gives, for the projection that reads it.
    eighth: N::Map,
    /// Projections of the quarter and of the eighth.
    projections: [N::Layer; 2],
    free: Free<N::Map>,
}

impl<M: Default> Free<M> {
    /// Forgets maps of images of another size.
    fn fit(&mut self, size: [usize; 2]) {
        if self.size != size {
            (self.size, self.maps) = (size, vec![]);
        }
    }

    /// One of those, or a new one.
    fn take(&mut self, like: [usize; 4]) -> ([usize; 4], M) {
        let known = self.maps.iter().position(|(key, _)| *key == like);
        known.map_or_else(|| (like, M::default()), |index| self.maps.swap_remove(index))
    }
}

impl<N: Numbers> Normed<N> {
    fn new(layer: N::Layer) -> Self {
        let whole = N::outputs(&layer).next_multiple_of(LANES);
        Self { layer, sums: vec![], norm: [vec![0.0; whole], vec![0.0; whole]] }
    }

    /// Finds the norm of what `run` convolves to a map of this size, and gives that map, which is not normalised yet. `margin` is what
    /// its reader needs.
    fn found<E>(
        &mut self,
        free: &mut Free<N::Map>,
        ([height, width], margin): ([usize; 2], usize),
        run: impl FnOnce(&mut N::Layer, To<'_, N::Map>) -> Result<(), E>,
    ) -> Result<([usize; 4], N::Map), E> {
        let Self { layer, sums, norm: [scale, shift] } = self;
        let channels = N::outputs(layer);
        let (like, mut map) = free.take([channels, height, width, margin]);
        N::resize(&mut map, [channels, height, width], margin);
        let [parts, each] = N::sums(layer, height);
        sums.resize(parts * each, 0.0);
        run(layer, To { map: Some(&mut map), planes: None, sums: Some(sums) })?;
        for channel in 0..channels {
            let total =
                |offset: usize| -> f64 { sums.chunks_exact(each).map(|part| f64::from(part[offset + channel])).sum() };
            let cells = (height * width) as f64;
            let mean = total(0) / cells;
            let deviation = (total(each / 2) / cells - mean * mean).max(0.0) + EPSILON;
            scale[channel] = deviation.sqrt().recip() as f32;
            shift[channel] = -(mean as f32) * scale[channel];
        }
        Ok((like, map))
    }

    /// The same of what it convolves.
    fn convolved<E>(
        &mut self,
        unit: N::Unit,
        (from, free): (&N::Map, &mut Free<N::Map>),
        to: ([usize; 2], usize),
        spread: &impl Spread<E>,
    ) -> Result<([usize; 4], N::Map), E> {
        self.found(free, to, |layer, to| N::run(layer, unit, from, to, spread))
    }
}

impl<N: Numbers> Bottleneck<N> {
    /// What becomes of a map.
    fn run<E>(
        &mut self,
        unit: N::Unit,
        (from, free): (&N::Map, &mut Free<N::Map>),
        spread: &impl Spread<E>,
    ) -> Result<([usize; 4], N::Map), E> {
        let Self { inner: [first, second], last, short, stride } = self;
        let size = N::size(from);
        let out = size.map(|length| length.div_ceil(*stride));
        let mut one = first.convolved(unit, (from, free), (size, N::margin(&second.layer)), spread)?;
        N::join(unit, &mut one.1, &first.norm, None, spread)?;
        let mut two = second.convolved(unit, (&one.1, free), (out, 0), spread)?;
        free.maps.push(one);
        N::join(unit, &mut two.1, &second.norm, None, spread)?;
        let mut three = last.convolved(unit, (&two.1, free), (out, 0), spread)?;
        free.maps.push(two);
        let Some(short) = short else {
            N::join(unit, &mut three.1, &last.norm, Some((from, None)), spread)?;
            return Ok(three);
        };
        let past = short.convolved(unit, (from, free), (out, 0), spread)?;
        N::join(unit, &mut three.1, &last.norm, Some((&past.1, Some(&short.norm))), spread)?;
        free.maps.push(past);
        Ok(three)
    }
}

impl<N: Numbers> Encoder<N> {
    /// Weights in the order in which they are used, a short cut's after those of its unit: [`CONVOLUTIONS`] of them.
    pub fn new(unit: N::Unit, view: View, weights: &[Weights<'_>]) -> Result<Self, Unfit> {
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
            Ok((*weights, bias, Step { stride: [stride; 2], dilation: 1, slope }))
        };
        let made = |(weights, bias, step): (Weights<'_>, &[f32], Step)| {
            (N::layer(unit, weights.values, weights.shape, bias, step), weights.shape[0])
        };
        let (image, ..) = take(Some(COLOURS), FIRST, 2, false)?;
        let outputs = image.shape[0];
        let step = Step { stride: [2, N::FIRST_ACROSS], dilation: 1, slope: 1.0 };
        let shape = [outputs, COLOURS * FIRST, FIRST, 1];
        let first = Normed::new(N::layer(unit, &side_by_side(image.values), shape, &[], step));
        let (mut units, mut width, mut quarter) = (vec![], outputs, outputs);
        for stride in STRIDES {
            for stride in [stride, 1] {
                let (one, inner) = made(take(Some(width), 1, 1, false)?);
                let (two, inner) = made(take(Some(inner), 3, stride, false)?);
                let (three, out) = made(take(Some(inner), 1, 1, false)?);
                let short = if stride > 1 { Some(made(take(Some(width), 1, stride, false)?)) } else { None };
                if short.as_ref().map_or(width, |(_, outputs)| *outputs) != out {
                    let (number, wanted) = (3 * units.len() + 3, "as many outputs as its short cut".into());
                    return Err(Unfit::Weights { number, wanted, found: [out, inner, 1, 1] });
                }
                width = out;
                let short = short.map(|(layer, _)| Normed::new(layer));
                units.push(Bottleneck { inner: [one, two].map(Normed::new), last: Normed::new(three), short, stride });
                quarter = if units.len() <= QUARTER + 1 { width } else { quarter };
            }
        }
        let (last, outputs) = made(take(Some(width), 1, 1, true)?);
        let projections = [made(take(Some(quarter), 1, 1, true)?).0, made(take(Some(outputs), 1, 1, true)?).0];
        let (image, eighth, free) = (N::Image::default(), N::Map::default(), Free { size: [0; 2], maps: vec![] });
        Ok(Self { unit, view, image, first, units, last, eighth, projections, free })
    }

    /// Channels of the projected quarter, of the eighth, and of what is projected from that.
    pub fn outputs(&self) -> [usize; 3] {
        let [quarter, eighth] = &self.projections;
        [quarter, &self.last, eighth].map(N::outputs)
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
        let Self {
            view, image: seen, first, units, last, eighth: map, projections: [of_quarter, of_eighth], free, ..
        } = self;
        free.fit([height, width]);
        N::look(unit, *view, image, [height, width], seen, spread)?;
        let to = ([height / 2, width / 2], 0);
        let mut from = first.found(free, to, |layer, to| N::run_first(layer, unit, seen, to, spread))?;
        N::join(unit, &mut from.1, &first.norm, None, spread)?;
        for (index, of_unit) in units.iter_mut().enumerate() {
            let following = of_unit.run(unit, (&from.1, free), spread)?;
            free.maps.push(std::mem::replace(&mut from, following));
            if index == QUARTER {
                N::run(of_quarter, unit, &from.1, To::planes(quarter), spread)?;
            }
        }
        N::resize(map, [N::outputs(last), height / 8, width / 8], 0);
        N::run(last, unit, &from.1, To { map: Some(map), ..To::planes(eighth) }, spread)?;
        free.maps.push(from);
        N::run(of_eighth, unit, map, To::planes(projected), spread)
    }
}
