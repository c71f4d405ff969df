//! The encoder's arithmetic in 32 bits.

use super::{
    COLOURS, FIRST, Numbers, Short, To, View,
    direct::{From, Layer},
};
use crate::flow::{
    bands::{Band, Bands},
    convolutions::{Spread, layer::Step},
    lanes::{Lanes, Unit, Work},
    winograd::pixels::{LINE, Pixels},
};

/// Products and sums of 32 bits, by [`super::direct`].
#[derive(Debug)]
pub struct Wide;

/// About how many bands a picture is cut into.
const BANDS: usize = 8;

/// The image, its colours side by side, with zeros around it: so that what the first convolution reads of a row lies side by side.
#[derive(Debug, Default)]
pub struct Image {
    values: Vec<f32>,
    size: [usize; 2],
}

impl Image {
    /// Values of a row.
    fn stride(&self) -> usize {
        (self.size[1] + FIRST - 1) * COLOURS
    }
}

impl Numbers for Wide {
    type Unit = Unit;
    type Layer = Layer;
    type Map = Pixels;
    type Image = Image;

    const FIRST_ACROSS: usize = 2;

    fn layer(unit: Unit, weights: &[f32], shape: [usize; 4], bias: &[f32], step: Step) -> Layer {
        Layer::new(unit, weights, shape, bias, step)
    }

    fn outputs(layer: &Layer) -> usize {
        layer.outputs()
    }

    fn margin(layer: &Layer) -> usize {
        layer.around().into_iter().fold(0, usize::max)
    }

    fn sums(layer: &Layer, height: usize) -> [usize; 2] {
        layer.sums(height)
    }

    fn resize(map: &mut Pixels, shape: [usize; 3], margin: usize) {
        map.resize(shape, [margin; 2]);
    }

    fn size(map: &Pixels) -> [usize; 2] {
        [map.shape[1], map.shape[2]]
    }

    fn run<E>(
        layer: &mut Layer,
        unit: Unit,
        from: &Pixels,
        to: To<'_, Pixels>,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        layer.run(unit, From::map(from, layer.around()), to, spread)
    }

    fn run_first<E>(
        layer: &mut Layer,
        unit: Unit,
        from: &Image,
        to: To<'_, Pixels>,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        let from = From { values: &from.values, strides: [from.stride(), COLOURS], size: from.size };
        layer.run(unit, from, to, spread)
    }

    fn join<E>(
        unit: Unit,
        map: &mut Pixels,
        norm: &[Vec<f32>; 2],
        short: Short<'_, Pixels>,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        let ([_, height, width], margin, depth) = (map.shape, map.margins[0], map.depth());
        let rows = height.div_ceil(BANDS).max(1);
        let to = map.cut(rows);
        spread(height.div_ceil(rows), &|number| {
            if let Some(to) = to.take(number) {
                unit.run(Join { width, margin, depth, norm, short, to });
            }
        })
    }

    fn look<E>(
        unit: Unit,
        view: View,
        image: &[f32],
        size: [usize; 2],
        to: &mut Image,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        let height = size[0];
        if to.size != size {
            to.size = size;
            to.values.clear();
            // Lines are read whole, the last ones too.
            to.values.resize((height + FIRST - 1) * to.stride() + 2 * LINE, 0.0);
        }
        let (stride, rows) = (to.stride(), height.div_ceil(BANDS).max(1));
        let picture = &mut to.values[FIRST / 2 * stride..];
        let to = Bands::new(picture, [1, height, stride], rows);
        spread(height.div_ceil(rows), &|number| {
            if let Some(to) = to.take(number) {
                unit.run(Look { image, size, view, to });
            }
        })
    }
}

struct Join<'a> {
    width: usize,
    margin: usize,
    depth: usize,
    norm: &'a [Vec<f32>; 2],
    short: Short<'a, Pixels>,
    to: Band<'a, f32>,
}

impl Work for Join<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        let Self { width, margin, depth, norm, short, .. } = self;
        let zero = lanes.splat(0.0);
        let normed = |[scale, shift]: &[Vec<f32>; 2], c: usize, from: &[f32]| {
            lanes.fused(lanes.load(from), lanes.load(&scale[c..]), lanes.load(&shift[c..]))
        };
        for y in self.to.first..self.to.end {
            let row = &mut self.to.row(0, y)[margin * depth..][..width * depth];
            match short {
                None => {
                    for pixel in row.chunks_exact_mut(depth) {
                        for (c, to) in pixel.chunks_exact_mut(L::COUNT).enumerate() {
                            let value = normed(norm, c * L::COUNT, to);
                            lanes.store(lanes.max(value, zero), to);
                        }
                    }
                }
                Some((other, own)) => {
                    let around = other.margins[0];
                    let other = &other.values()[(y + around) * other.stride() + around * depth..][..width * depth];
                    for (pixel, other) in row.chunks_exact_mut(depth).zip(other.chunks_exact(depth)) {
                        let both = pixel.chunks_exact_mut(L::COUNT).zip(other.chunks_exact(L::COUNT));
                        for (c, (to, other)) in both.enumerate() {
                            let value = lanes.max(normed(norm, c * L::COUNT, to), zero);
                            let other = match own {
                                Some(own) => normed(own, c * L::COUNT, other),
                                None => lanes.load(other),
                            };
                            lanes.store(lanes.max(lanes.add(value, other), zero), to);
                        }
                    }
                }
            }
        }
    }
}

struct Look<'a> {
    image: &'a [f32],
    size: [usize; 2],
    view: View,
    to: Band<'a, f32>,
}

impl Work for Look<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, _: L) {
        let Self { image, size: [height, width], view: View { factor, offset, shift }, .. } = self;
        for y in self.to.first..self.to.end {
            let to = &mut self.to.row(0, y)[FIRST / 2 * COLOURS..][..width * COLOURS];
            let from = y + shift;
            let some = if from < height { width - shift } else { 0 };
            let (seen, beyond) = to.split_at_mut(some * COLOURS);
            let [red, green, blue] = std::array::from_fn(|c| {
                &image[(c * height + from.min(height - 1)) * width + shift.min(width - some)..][..some]
            });
            let (pixels, _) = seen.as_chunks_mut::<COLOURS>();
            for (((pixel, red), green), blue) in pixels.iter_mut().zip(red).zip(green).zip(blue) {
                *pixel = [red, green, blue].map(|value| factor * value + offset);
            }
            beyond.fill(0.0);
        }
    }
}
