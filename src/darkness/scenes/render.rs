//! Layers painted back to front into both frames, the exact flow of what lies in front, and what stays in sight.

use std::borrow::Cow;

use super::{
    Pair,
    maps::{Map, apply, inverse},
    shapes::Outline,
    texture::Texture,
};

/// Pixels that share one footprint and one look at the outline.
const BLOCK: usize = 16;

/// A plane with a picture on it, cut out along an outline, and how it moves.
pub(super) struct Layer<'t> {
    /// From pixels of frame 1 to pixels of frame 2.
    pub motion: Map,
    /// From pixels of frame 1 to the layer's own pixels around its middle.
    pub local: Map,
    pub outline: Outline,
    pub fill: Fill<'t>,
}

/// What a layer shows.
pub(super) struct Fill<'t> {
    pub texture: Cow<'t, Texture>,
    /// From the layer's own pixels to the texture's: two rows of a, b, c in a·x + b·y + c.
    pub place: [[f32; 3]; 2],
    pub tint: [f32; 3],
}

/// A frame while it is painted.
struct Canvas {
    size: [usize; 2],
    pixels: Vec<[f32; 3]>,
    /// The number of the layer that covers more than half of the pixel.
    owner: Vec<u8>,
}

/// Both frames (8 bits, rounded), flow and sight of at most 255 layers, the first of which covers everything.
pub(super) fn render(index: u64, size: [usize; 2], layers: &[Layer<'_>]) -> Pair {
    let first: Vec<Map> = layers.iter().map(|layer| layer.local).collect();
    let second: Vec<Map> = layers.iter().map(|layer| layer.local * inverse(&layer.motion)).collect();
    let [older, newer] = [&first, &second].map(|maps| {
        let mut canvas = Canvas { size, pixels: vec![[0.0; 3]; size[0] * size[1]], owner: vec![0; size[0] * size[1]] };
        for (number, (layer, map)) in layers.iter().zip(maps).enumerate() {
            canvas.paint(number as u8, layer, map);
        }
        canvas
    });
    let (flow, valid) = flow(&older.owner, &newer.owner, size, layers, &second);
    Pair { index, size, older: older.bytes(), newer: newer.bytes(), flow, valid, noise: None }
}

impl Canvas {
    fn bytes(&self) -> Vec<u8> {
        self.pixels.as_flattened().iter().map(|value| (value + 0.5).clamp(0.0, 255.0) as u8).collect()
    }

    /// The rectangle that a layer can cover: first and last column, first and last row.
    fn bounds(&self, reach: f32, to_local: &Map) -> [[usize; 2]; 2] {
        let whole = self.size.map(|side| [0, side]);
        if reach.is_infinite() {
            return whole;
        }
        let (back, reach) = (inverse(to_local), f64::from(reach));
        let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for corner in [[-reach, -reach], [reach, -reach], [reach, reach], [-reach, reach]] {
            let Some(pixel) = apply(&back, corner) else { return whole };
            for axis in 0..2 {
                bounds[axis] = [bounds[axis][0].min(pixel[axis] - 2.0), bounds[axis][1].max(pixel[axis] + 2.0)];
            }
        }
        std::array::from_fn(|axis| bounds[axis].map(|edge| edge.clamp(0.0, self.size[axis] as f64) as usize))
    }

    fn paint(&mut self, number: u8, layer: &Layer<'_>, to_local: &Map) {
        let [[left, right], [top, bottom]] = self.bounds(layer.outline.reach(), to_local);
        for row in top..bottom {
            let line = Line::new(to_local, row as f64);
            for begin in (left..right).step_by(BLOCK) {
                self.block(number, layer, &line, row, begin..(begin + BLOCK).min(right));
            }
        }
    }

    fn block(&mut self, number: u8, layer: &Layer<'_>, line: &Line, row: usize, columns: std::ops::Range<usize>) {
        let middle = (columns.start + columns.end - 1) as f32 / 2.0;
        let Some(centre) = line.at(middle) else { return };
        let [across, footprint] = line.footprint(middle, centre);
        // How far the block's ends lie from its middle, on the layer, with a pixel for what is soft.
        let room = across * (columns.len() as f32 / 2.0 + 1.0) + footprint;
        let distance = layer.outline.distance(centre[0], centre[1]);
        if distance < -room {
            return;
        }
        let soft = distance < room;
        let Fill { texture, place: [px, py], tint } = &layer.fill;
        let lod = (footprint * (px[0] * px[0] + py[0] * py[0]).sqrt()).log2();
        let sharp = 1.0 / footprint;
        for column in columns {
            let Some([x, y]) = line.at(column as f32) else { continue };
            let mut cover = 1.0;
            if soft {
                cover = (0.5 + layer.outline.distance(x, y) * sharp).clamp(0.0, 1.0);
                if cover <= 0.0 {
                    continue;
                }
            }
            let [r, g, b, a] = texture.sample(px[0] * x + px[1] * y + px[2], py[0] * x + py[1] * y + py[2], lod);
            let behind = 1.0 - cover * a * (1.0 / 255.0);
            let at = row * self.size[0] + column;
            let pixel = &mut self.pixels[at];
            for (c, colour) in [r, g, b].into_iter().enumerate() {
                pixel[c] = pixel[c] * behind + cover * colour * tint[c];
            }
            if behind < 0.5 {
                self.owner[at] = number;
            }
        }
    }
}

/// A row of pixels on its way to a layer: numerators and denominator are linear in the column.
struct Line {
    across: [f32; 3],
    at_nought: [f32; 3],
    down: [f32; 3],
}

impl Line {
    fn new(map: &Map, row: f64) -> Line {
        let column = |c: usize| [0, 1, 2].map(|r| map[(r, c)] as f32);
        let at_nought = [0, 1, 2].map(|r| (map[(r, 1)] * row + map[(r, 2)]) as f32);
        Line { across: column(0), at_nought, down: column(1) }
    }

    #[inline(always)]
    fn at(&self, column: f32) -> Option<[f32; 2]> {
        let [x, y, depth] = [0, 1, 2].map(|r| self.across[r] * column + self.at_nought[r]);
        let inverse = 1.0 / depth;
        (depth > 1e-6).then_some([x * inverse, y * inverse])
    }

    /// The layer's pixels per frame pixel along the row, and typically.
    fn footprint(&self, column: f32, [x, y]: [f32; 2]) -> [f32; 2] {
        let inverse = 1.0 / (self.across[2] * column + self.at_nought[2]);
        let grow = |step: &[f32; 3]| [(step[0] - x * step[2]) * inverse, (step[1] - y * step[2]) * inverse];
        let ([ax, ay], [dx, dy]) = (grow(&self.across), grow(&self.down));
        let (across, down) = ((ax * ax + ay * ay).sqrt(), (dx * dx + dy * dy).sqrt());
        [across, 0.5 * (across.max(down) + (ax * dy - ay * dx).abs().sqrt()).max(1e-4)]
    }
}

/// Flow at the centres of frame 1's pixels, and whether what lies there is still seen in frame 2.
fn flow(
    older: &[u8],
    newer: &[u8],
    [width, height]: [usize; 2],
    layers: &[Layer<'_>],
    second: &[Map],
) -> (Vec<[f32; 2]>, Vec<bool>) {
    let (mut flow, mut valid) = (Vec::with_capacity(width * height), Vec::with_capacity(width * height));
    let edge = [(width - 1) as f64, (height - 1) as f64];
    for (row, owners) in older.chunks_exact(width).enumerate() {
        for (column, owner) in owners.iter().enumerate() {
            let number = usize::from(*owner);
            let from = [column as f64, row as f64];
            let Some(to) = apply(&layers[number].motion, from) else {
                flow.push([0.0; 2]);
                valid.push(false);
                continue;
            };
            flow.push([(to[0] - from[0]) as f32, (to[1] - from[1]) as f32]);
            let inside = (0..2).all(|axis| (0.0..=edge[axis]).contains(&to[axis]));
            valid.push(inside && seen(newer, width, to, number, layers, second));
        }
    }
    (flow, valid)
}

/// Whether no layer in front covers the point of frame 2.
fn seen(newer: &[u8], width: usize, to: [f64; 2], number: usize, layers: &[Layer<'_>], second: &[Map]) -> bool {
    let (column, row) = (to[0] as usize, to[1] as usize);
    let (right, below) = (to[0].ceil() as usize, to[1].ceil() as usize);
    let around = [(column, row), (right, row), (column, below), (right, below)];
    if around.iter().all(|(column, row)| usize::from(newer[row * width + column]) == number) {
        return true;
    }
    !layers[number + 1..].iter().zip(&second[number + 1..]).any(|(layer, map)| covers(layer, map, to))
}

/// Whether a layer covers more than half of a pixel at this point.
fn covers(layer: &Layer<'_>, map: &Map, [x, y]: [f64; 2]) -> bool {
    let line = Line::new(map, y);
    let Some(at) = line.at(x as f32) else { return false };
    let distance = layer.outline.distance(at[0], at[1]);
    if distance <= 0.0 {
        return false;
    }
    let Outline::Cutout(_) = layer.outline else { return true };
    let Fill { texture, place: [px, py], .. } = &layer.fill;
    let [_, footprint] = line.footprint(x as f32, at);
    let lod = (footprint * px[0].hypot(py[0])).log2();
    let [.., opacity] =
        texture.sample(px[0] * at[0] + px[1] * at[1] + px[2], py[0] * at[0] + py[1] * at[1] + py[2], lod);
    opacity > 127.5
}
