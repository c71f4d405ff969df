//! The encoder's arithmetic in bf16.

use std::slice;

use super::{COLOURS, FIRST, Numbers, Short, To, View};
use crate::flow::{
    bands::{Band, Bands},
    convolutions::{
        Spread,
        layer::{self, Layer, Step},
        map::Map,
        rows::{self, Norm},
        tiles::{Begun, LANES, Line, Unit, Work},
    },
};

/// Products of bf16 and sums of 32 bits, by [`super::super::tiles`].
#[derive(Debug)]
pub struct Narrow;

/// The image with all columns that the first convolution looks at side by side: seven of three colours fill a line, where three
/// would waste it.
#[derive(Debug, Default)]
pub struct Image {
    map: Map,
    /// For each band the even and the odd columns of a row.
    columns: Vec<f32>,
}

impl Numbers for Narrow {
    type Unit = Unit;
    type Layer = Layer;
    type Map = Map;
    type Image = Image;

    // Its image has a pixel for every second column.
    const FIRST_ACROSS: usize = 1;

    fn layer(_: Unit, weights: &[f32], shape: [usize; 4], bias: &[f32], step: Step) -> Layer {
        Layer::new(weights, shape, bias, step)
    }

    fn outputs(layer: &Layer) -> usize {
        layer.outputs()
    }

    fn margin(layer: &Layer) -> usize {
        layer.margin()
    }

    fn sums(layer: &Layer, height: usize) -> [usize; 2] {
        let bands = Map::bands(height).1;
        [bands, layer.sums(height) / bands]
    }

    fn resize(map: &mut Map, shape: [usize; 3], margin: usize) {
        map.resize(shape, margin);
    }

    fn size(map: &Map) -> [usize; 2] {
        [map.height, map.width]
    }

    fn run<E>(
        layer: &mut Layer,
        unit: Unit,
        from: &Map,
        To { map, planes, sums }: To<'_, Map>,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        layer.run(unit, slice::from_ref(from), layer::To { map, planes, sums }, spread)
    }

    fn run_first<E>(
        layer: &mut Layer,
        unit: Unit,
        from: &Image,
        to: To<'_, Map>,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        Self::run(layer, unit, &from.map, to, spread)
    }

    fn join<E>(
        unit: Unit,
        map: &mut Map,
        norm: &[Vec<f32>; 2],
        short: Short<'_, Map>,
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

    fn look<E>(
        unit: Unit,
        view: View,
        image: &[f32],
        [height, width]: [usize; 2],
        to: &mut Image,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        let half = width / 2;
        to.map.resize([COLOURS * FIRST, height, half], FIRST / 2);
        let margin = to.map.margin;
        let (_, bands) = Map::bands(height);
        let stride = half + 2 * BESIDE;
        to.columns.resize(bands * 2 * COLOURS * stride, 0.0);
        let own = Bands::new(&mut to.columns, [1, bands, 2 * COLOURS * stride], 1);
        let to = to.map.cut();
        spread(bands, &|number| {
            if let (Some(to), Some(own)) = (to.take(number), own.take(number)) {
                unit.run(Look { image, height, width, view, number, margin, own, to });
            }
        })
    }
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
