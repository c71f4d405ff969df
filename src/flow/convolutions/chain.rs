//! Convolutions one after the other, from planes of f32 to planes of f32.

use super::{
    Spread,
    layer::{Layer, To},
    map::Map,
    rows,
    tiles::{Begun, Line, Unit, Work},
};
use crate::flow::bands::Band;

/// The operator `nightflow::Convolutions` with its memory, which is taken at the first call of a size.
#[derive(Debug)]
pub struct Chain {
    unit: Unit,
    layers: Vec<Layer>,
    /// Whether a layer reads all maps before it.
    dense: bool,
    /// What goes in, and what each layer but the last gives.
    maps: Vec<Map>,
}

/// What goes in: planes that are read as if they were one tensor after the other.
pub type Parts<'a> = &'a [&'a [f32]];

/// What does not fit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("convolutions of {height} × {width}, {inputs} channels to {outputs}, can't have {found} values in and out")]
pub struct Unfit {
    height: usize,
    width: usize,
    inputs: usize,
    outputs: usize,
    found: String,
}

/// Of the channels that layers give those of the last and of the one before.
pub fn last_two(outputs: impl DoubleEndedIterator<Item = usize>) -> [usize; 2] {
    let mut back = outputs.rev();
    [back.next().unwrap_or(0), back.next().unwrap_or(0)]
}

/// Whether parts of so many rows and columns have the channels that go into so many layers, and whether there is room for what
/// comes out of the last one and, if that is wanted, of the one before.
pub fn fits(
    [inputs, layers]: [usize; 2],
    [outputs, kept]: [usize; 2],
    parts: Parts<'_>,
    [height, width]: [usize; 2],
    last: usize,
    before: Option<&[f32]>,
) -> Result<(), Unfit> {
    let cells = height * width;
    let sum: usize = parts.iter().map(|part| part.len()).sum();
    let whole = parts.iter().all(|part| cells > 0 && part.len() % cells == 0) && sum == inputs * cells;
    let fits = before.is_none_or(|before| layers > 1 && before.len() == kept * cells);
    if whole && fits && last == outputs * cells {
        return Ok(());
    }
    let found = format!("{sum}, {last} and {:?}", before.map(|before| before.len()));
    Err(Unfit { height, width, inputs, outputs, found })
}

impl Chain {
    /// Layers that keep the size, at least one; each reads what the one before gives or, in a `dense` chain, all that there is
    /// before it: first what goes in, then what layers gave in their order.
    pub fn new(unit: Unit, layers: Vec<Layer>, dense: bool) -> Self {
        let maps = layers.iter().map(|_| Map::default()).collect();
        Self { unit, layers, dense, maps }
    }

    /// Channels that come out, and those of the layer before the last.
    pub fn outputs(&self) -> [usize; 2] {
        last_two(self.layers.iter().map(Layer::outputs))
    }

    /// Computes everything, `before` being what the layer before the last gives, if that is wanted.
    pub fn run<E: From<Unfit>>(
        &mut self,
        parts: Parts<'_>,
        [height, width]: [usize; 2],
        last: &mut [f32],
        before: Option<&mut [f32]>,
        spread: &impl Spread<E>,
    ) -> Result<(), E> {
        let unit = self.unit;
        let inputs = self.layers.first().map_or(0, Layer::inputs);
        fits([inputs, self.layers.len()], self.outputs(), parts, [height, width], last.len(), before.as_deref())?;
        let cells = height * width;
        let channels = std::iter::once(inputs).chain(self.layers.iter().map(Layer::outputs));
        for (index, (map, channels)) in self.maps.iter_mut().zip(channels).enumerate() {
            let end = if self.dense { self.layers.len() } else { index + 1 };
            let margin = self.layers[index..end].iter().map(Layer::margin).max();
            map.resize([channels, height, width], margin.unwrap_or(0));
        }
        let (rows, bands) = Map::bands(height);
        let [first, ..] = &mut self.maps[..] else { return Ok(()) };
        let (margin, depth) = (first.margin, first.depth());
        let to = first.cut();
        spread(bands, &|number| {
            if let Some(to) = to.take(number) {
                let rows = [number * rows, height.min((number + 1) * rows)];
                unit.run(Pack { parts, cells, width, rows, margin, depth, to });
            }
        })?;
        let (mut last, mut before) = (Some(last), before);
        let count = self.layers.len();
        for (index, layer) in self.layers.iter_mut().enumerate() {
            let (read, written) = self.maps.split_at_mut(index + 1);
            let planes = match count - index {
                1 => last.take(),
                2 => before.take(),
                _ => None,
            };
            let to = To { map: written.first_mut(), planes, sums: None };
            let read = if self.dense { &read[..] } else { &read[index..] };
            layer.run(unit, read, to, spread)?;
        }
        Ok(())
    }
}

/// Some rows of all parts become pixels.
struct Pack<'a> {
    parts: Parts<'a>,
    cells: usize,
    width: usize,
    rows: [usize; 2],
    margin: usize,
    depth: usize,
    to: Band<'a, Line>,
}

impl Work for Pack<'_> {
    #[inline(always)]
    fn on(mut self, begun: &Begun) {
        let Self { parts, cells, width, rows, margin, depth, .. } = self;
        for y in rows[0]..rows[1] {
            let to = &mut self.to.row(0, y)[margin * depth..][..width * depth];
            let mut planes = parts.iter().flat_map(|part| part.chunks_exact(cells));
            for line in 0..depth {
                let channels = std::array::from_fn(|_| planes.next().map(|plane| &plane[y * width..][..width]));
                rows::pack(begun.has_vectors(), &channels, &mut to[line..], depth);
            }
        }
    }
}
