//! Convolutions one after the other, from planes to planes.

use super::{
    Unit,
    layer::{Convolve, Layer},
    pixels::{LINE, Pack, Pixels, Unpack, skipped},
};
use crate::flow::{
    bands::Bands,
    convolutions::{
        Spread,
        chain::{Parts, Unfit, fits, last_two},
    },
};

/// The operator `nightflow::Convolutions` in 32 bits with its memory, which is taken at the first call of a size.
#[derive(Debug)]
pub struct Chain {
    unit: Unit,
    layers: Vec<Layer>,
    /// Whether a layer reads all maps before it.
    dense: bool,
    /// What goes in, and what each layer gives.
    maps: Vec<Pixels>,
    own: Own,
}

/// What bands need for themselves: one piece for each, of which only those are touched that are in use at the same time.
#[derive(Debug, Default)]
struct Own {
    values: Vec<f32>,
    pieces: usize,
    each: usize,
}

impl Own {
    fn resize(&mut self, pieces: usize, each: usize) {
        if pieces > self.pieces || each > self.each {
            (self.pieces, self.each) = (pieces.max(self.pieces), each.max(self.each).next_multiple_of(LINE));
            // New zeros take no memory before they are touched.
            self.values = vec![0.0; self.pieces * self.each + LINE];
        }
    }

    fn cut(&mut self) -> Bands<'_, f32> {
        let first = skipped(&self.values);
        Bands::new(&mut self.values[first..], [1, self.pieces, self.each], 1)
    }
}

impl Chain {
    /// Layers for this unit, at least one; each reads what the one before gives or, in a `dense` chain, all that there is before
    /// it: first what goes in, then what layers gave in their order.
    pub fn new(unit: Unit, layers: Vec<Layer>, dense: bool) -> Self {
        let maps = (0..=layers.len()).map(|_| Pixels::default()).collect();
        Self { unit, layers, dense, maps, own: Own::default() }
    }

    /// Channels that come out, and those of the layer before the last.
    pub fn outputs(&self) -> [usize; 2] {
        last_two(self.layers.iter().map(Layer::outputs))
    }

    /// Computes everything: `parts` are planes that are read as if they were one tensor after the other, `before` is what the
    /// layer before the last gives, if that is wanted.
    pub fn run<E: From<Unfit>>(
        &mut self,
        parts: Parts<'_>,
        size: [usize; 2],
        last: &mut [f32],
        before: Option<&mut [f32]>,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        let [height, _] = size;
        let inputs = self.layers.first().map_or(0, Layer::inputs);
        fits([inputs, self.layers.len()], self.outputs(), parts, size, last.len(), before.as_deref())?;
        self.resize(size);
        let Self { unit, layers, dense, maps, own } = self;
        let (unit, count) = (*unit, layers.len());
        let rows = height.div_ceil(PACKED);
        let ([margin, _], depth) = (maps[0].margins, maps[0].depth());
        let to = maps[0].cut(rows);
        spread(height.div_ceil(rows), &|number| {
            if let Some(to) = to.take(number) {
                unit.run(Pack { parts, size, before: margin, depth, to });
            }
        })?;
        for (index, layer) in layers.iter().enumerate() {
            let (read, written) = maps.split_at_mut(index + 1);
            let read = if *dense { &read[..] } else { &read[index..] };
            convolve(unit, layer, read, &mut written[0], own, spread)?;
        }
        unpack(unit, &maps[count], last, spread)?;
        before.map_or(Ok(()), |before| unpack(unit, &maps[count - 1], before, spread))
    }

    /// Memory for pictures of this size.
    fn resize(&mut self, [height, width]: [usize; 2]) {
        let (mut bands, mut each) = (0, 0);
        for layer in &mut self.layers {
            layer.fit([height, width]);
            bands = bands.max(layer.bands([height, width]));
            each = each.max(layer.scratch([height, width]));
        }
        let given = self.layers.iter().map(Layer::outputs);
        let channels = self.layers.first().map(Layer::inputs).into_iter().chain(given);
        for (index, (map, channels)) in self.maps.iter_mut().zip(channels).enumerate() {
            let after = &self.layers[index..];
            let readers = if self.dense { after } else { after.get(..1).unwrap_or(&[]) };
            let most = |of: usize| readers.iter().map(|layer| layer.margins()[of]).max().unwrap_or(0);
            map.resize([channels, height, width], [most(0), most(1)]);
        }
        self.own.resize(bands, each);
    }
}

/// How many bands planes are cut into where they become pixels and the other way round.
const PACKED: usize = 8;

fn convolve<E>(
    unit: Unit,
    layer: &Layer,
    from: &[Pixels],
    to: &mut Pixels,
    own: &mut Own,
    spread: &impl Spread<E>,
) -> Result<(), E> {
    let [_, height, width] = to.shape;
    let size = [height, width];
    let (before, across) = (to.margins[0], to.stride() / to.depth());
    let (to, own) = (to.tiled([layer.band(size), layer.part(size)]), own.cut());
    spread(layer.bands(size), &|number| {
        if let (Some(to), Some(mut own)) = (to.take(number), own.lend()) {
            unit.run(Convolve { layer, from, before, across, scratch: own.row(), to });
        }
    })
}

fn unpack<E>(unit: Unit, from: &Pixels, to: &mut [f32], spread: &impl Spread<E>) -> Result<(), E> {
    let [_, height, _] = from.shape;
    let rows = height.div_ceil(PACKED);
    let to = Bands::new(to, from.shape, rows);
    spread(height.div_ceil(rows), &|number| {
        if let Some(to) = to.take(number) {
            unit.run(Unpack { from, to });
        }
    })
}
