//! The loops over pixels: grey, blur, warp, and the products that cells are summed from.
//!
//! Each value is made of the same operations in the same order whatever the width of the vectors, so that all
//! instruction sets give the same bits.

use multiversion::multiversion;

use super::{CELL, FLOOR, SIDE_BY_SIDE, put, pyramid::Sums, some};
use crate::exposure::{Exposed, Pair};

/// What the blur leaves of the variance of white noise: (3/8)².
const KEPT: f32 = 0.140_625;
/// What the blur and the differences along one axis leave of it: 3/8 · 0.159…
const SLOPED: f32 = 0.059_896;

/// Planar colours to grey, red + 2·green + blue times `gain`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn grey(planes: &[f32], gain: f32, into: &mut [f32]) {
    let (red, rest) = planes.split_at(into.len());
    let (green, blue) = rest.split_at(into.len());
    for (value, ((red, green), blue)) in into.iter_mut().zip(red.iter().zip(green).zip(blue)) {
        *value = (red + 2.0 * green + blue) * gain;
    }
}

/// (1 2 1)/4 along rows and columns; the edge is repeated.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn blur(plane: &mut [f32], scratch: &mut [f32], width: usize) {
    for (row, out) in plane.chunks_exact(width).zip(scratch.chunks_exact_mut(width)) {
        let last = width - 1;
        for x in 1..last {
            out[x] = 0.25 * (row[x - 1] + row[x + 1]) + 0.5 * row[x];
        }
        out[0] = 0.75 * row[0] + 0.25 * row[1];
        out[last] = 0.75 * row[last] + 0.25 * row[last - 1];
    }
    let rows = plane.len() / width;
    for (y, out) in plane.chunks_exact_mut(width).enumerate() {
        let row = |y: usize| &scratch[y * width..][..width];
        let (above, here, below) = (row(y.saturating_sub(1)), row(y), row((y + 1).min(rows - 1)));
        for (x, value) in out.iter_mut().enumerate() {
            *value = 0.25 * (above[x] + below[x]) + 0.5 * here[x];
        }
    }
}

/// The newer frame as the vectors bring it to the older one.
#[derive(Debug, Default)]
pub(super) struct Warp {
    /// Mean of both frames.
    mean: Vec<f32>,
    /// Newer less older.
    difference: Vec<f32>,
    /// 1 where there is a difference, else 0.
    valid: Vec<f32>,
    /// The cells' vectors, right and down.
    vectors: [Vec<f32>; 2],
    /// How far each pixel of a row of the older frame has moved, right and down.
    places: [Vec<f32>; 2],
    /// How those of a row are read, [`SIDE_BY_SIDE`] together.
    reads: Vec<Reads>,
    /// Vectors between two rows of cells on one axis, with one more at either end.
    line: Vec<f32>,
    /// The products of a row of cells, pixel by pixel.
    products: Vec<f32>,
}

impl Warp {
    /// Warps the newer frame's grey by `start` + `change`, pixels at the cells of `raster` and bilinear between them.
    pub(super) fn bring(
        &mut self,
        pair: &Pair<'_>,
        [older, newer]: [&[f32]; 2],
        raster: [usize; 2],
        start: &[Vec<f32>; 2],
        change: &[Vec<f32>; 2],
    ) {
        let (width, height) = (pair.older.width, pair.older.height);
        for plane in [&mut self.mean, &mut self.difference, &mut self.valid] {
            plane.resize(width * height, 0.0);
        }
        let pixels = (CELL * raster[0]).next_multiple_of(SIDE_BY_SIDE);
        self.places.iter_mut().for_each(|places| places.resize(pixels, 0.0));
        self.line.resize(raster[0] + 2, 0.0);
        for ((vectors, start), change) in self.vectors.iter_mut().zip(start).zip(change) {
            vectors.clear();
            vectors.extend(start.iter().zip(change).map(|(start, change)| start + change));
        }
        self.reads.resize(pixels / SIDE_BY_SIDE, Reads::default());
        self.valid.fill(0.0);
        let covered = CELL * raster[0];
        let marks = |exposed: &'_ Exposed| exposed.saturated_part > 0.0;
        let hidden = if marks(pair.newer) { &pair.newer.saturated[..] } else { &[] };
        for y in 0..CELL * raster[1] {
            self.place(y, raster);
            let row = y * width..y * width + covered;
            let out = [&mut self.mean[row.clone()], &mut self.difference[row.clone()], &mut self.valid[row.clone()]];
            weigh(&mut self.reads, [width, height], y, [&self.places[0], &self.places[1]]);
            sample(newer, hidden, width, &self.reads, &older[row], out);
        }
        if marks(pair.older) {
            for (valid, mark) in self.valid.iter_mut().zip(&pair.older.saturated) {
                *valid *= 1.0 - f32::from(*mark);
            }
        }
    }

    /// The displacement of each pixel of row `y`.
    fn place(&mut self, y: usize, [columns, rows]: [usize; 2]) {
        let place = (y as f32 + 0.5) / CELL as f32 - 0.5;
        let part = place - place.floor();
        let upper = (place.floor().max(0.0) as usize).min(rows - 1);
        let lower = ((place.floor() + 1.0) as usize).min(rows - 1);
        for (vectors, places) in self.vectors.iter().zip(&mut self.places) {
            let both = [upper, lower].map(|row| &vectors[row * columns..][..columns]);
            place_row(both, part, &mut self.line, places);
        }
    }

    /// Sums the products of every cell: see [`Sums`]. `noise` is slope and base of the variance of a difference.
    pub(super) fn sum(&mut self, older: &[f32], [width, height]: [usize; 2], noise: [f32; 2], cells: &mut Sums) {
        let raster = [width / CELL, height / CELL];
        cells.size(raster);
        let covered = CELL * raster[0];
        self.products.resize(Sums::OF_PIXELS * covered, 0.0);
        for row in 0..raster[1] {
            self.products.fill(0.0);
            for y in CELL * row..CELL * (row + 1) {
                // Differences reach two pixels up and down.
                if y < 2 || y + 2 >= height {
                    continue;
                }
                let rows = [y - 2, y - 1, y, y + 1, y + 2].map(|y| &self.mean[y * width..][..width]);
                let here = y * width..(y + 1) * width;
                let pixels = [&older[here.clone()], &self.difference[here.clone()], &self.valid[here]];
                add(rows, pixels, noise, covered, &mut self.products);
            }
            cells.fold(row, &self.products);
        }
    }
}

/// The vectors of a row of pixels, between two rows of cells: the lower one counts for `part`.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn place_row([upper, lower]: [&[f32]; 2], part: f32, line: &mut [f32], places: &mut [f32]) {
    let columns = upper.len();
    for ((value, above), below) in line[1..].iter_mut().zip(upper).zip(lower) {
        *value = above + (below - above) * part;
    }
    (line[0], line[columns + 1]) = (line[1], line[columns]);
    for (three, four) in line.windows(3).zip(places.as_chunks_mut::<CELL>().0) {
        let (left, right) = (three[1] - three[0], three[2] - three[1]);
        *four = [three[1] - 0.375 * left, three[1] - 0.125 * left, three[1] + 0.125 * right, three[1] + 0.375 * right];
    }
}

/// From which sixteen pixels each of some is read, and what they weigh, by Catmull and Rom's cubic.
#[derive(Debug, Clone, Copy, Default)]
struct Reads {
    /// The first of them, or [`NOWHERE`].
    first: [i32; SIDE_BY_SIDE],
    /// Whether each is read one column to the right of the one before, as nearly all are where vectors are alike.
    in_a_row: bool,
    /// Weights of their columns, and of their rows.
    across: [[f32; SIDE_BY_SIDE]; 4],
    down: [[f32; SIDE_BY_SIDE]; 4],
}

/// The place is not in the image, or too near to its edge.
const NOWHERE: i32 = -1;

/// By where the pixels of row `y` went.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn weigh(reads: &mut [Reads], [width, height]: [usize; 2], y: usize, places: [&[f32]; 2]) {
    let (right, bottom) = ((width - 2) as f32, (height - 2) as f32);
    let [u, v] = places.map(|places| places.as_chunks::<SIDE_BY_SIDE>().0);
    for (block, (reads, (u, v))) in reads.iter_mut().zip(u.iter().zip(v)).enumerate() {
        for i in 0..SIDE_BY_SIDE {
            let (to_x, to_y) = ((block * SIDE_BY_SIDE + i) as f32 + u[i], y as f32 + v[i]);
            // Asked this way round, a NaN is outside.
            let inside = (to_x >= 1.0) & (to_y >= 1.0) & (to_x < right) & (to_y < bottom);
            let (to_x, to_y) = (if inside { to_x } else { 1.0 }, if inside { to_y } else { 1.0 });
            let (column, row) = (to_x.floor(), to_y.floor());
            let first = (count(row) - 1) * width as i32 + count(column) - 1;
            reads.first[i] = if inside { first } else { NOWHERE };
            let (of_columns, of_rows) = (cubic(to_x - column), cubic(to_y - row));
            for tap in 0..4 {
                reads.across[tap][i] = of_columns[tap];
                reads.down[tap][i] = of_rows[tap];
            }
        }
        let begin = reads.first[0];
        let apart = reads.first.iter().enumerate().fold(0, |apart, (i, first)| apart | (first - begin - i as i32));
        reads.in_a_row = begin != NOWHERE && apart == 0;
    }
}

/// A whole number from 0 to 2²³ as an integer: a cast would look for all others too, one by one.
#[inline(always)]
fn count(whole: f32) -> i32 {
    const DIGITS: f32 = 8_388_608.0;
    (whole + DIGITS).to_bits() as i32 - DIGITS.to_bits() as i32
}

/// Reads `newer` where the pixels of one row went; not where `hidden` marks it.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn sample(
    newer: &[f32],
    hidden: &[u8],
    width: usize,
    reads: &[Reads],
    older: &[f32],
    [mean, difference, valid]: [&mut [f32]; 3],
) {
    for (block, reads) in reads.iter().enumerate() {
        let x = block * SIDE_BY_SIDE;
        let here = some(older, x);
        let mut values = here;
        if reads.in_a_row {
            reads.all(newer, width, &mut values);
        } else {
            reads.each(newer, width, &mut values);
        }
        let (mut means, mut differences, mut seen) = (here, here, here);
        for i in 0..SIDE_BY_SIDE {
            means[i] = 0.5 * (here[i] + values[i]);
            differences[i] = values[i] - here[i];
            seen[i] = if reads.first[i] == NOWHERE { 0.0 } else { 1.0 };
        }
        if !hidden.is_empty() {
            for (i, seen) in seen.iter_mut().enumerate() {
                *seen -= reads
                    .nearest(width, i)
                    .and_then(|nearest| hidden.get(nearest))
                    .map_or(0.0, |mark| f32::from(*mark));
            }
        }
        put(means, mean, x);
        put(differences, difference, x);
        put(seen, valid, x);
    }
}

impl Reads {
    /// All values of pixels that are read wherever they went; those that are nowhere stay as they are.
    #[inline(always)]
    fn each(&self, newer: &[f32], width: usize, values: &mut [f32; SIDE_BY_SIDE]) {
        let Self { across: [w, x, y, z], down: [e, f, g, h], .. } = self;
        // Four columns at once: they lie side by side.
        let mut columns = [[0.0; 4]; SIDE_BY_SIDE];
        for (i, columns) in columns.iter_mut().enumerate() {
            // Who is nowhere reads what comes first, so that nobody need ask.
            let newer = &newer[self.first[i].max(0) as usize..];
            let (a, b, c, d) = (&newer[..4], &newer[width..][..4], &newer[2 * width..][..4], &newer[3 * width..][..4]);
            for at in 0..4 {
                columns[at] = of_four([a[at], b[at], c[at], d[at]], [e[i], f[i], g[i], h[i]]);
            }
        }
        for i in 0..SIDE_BY_SIDE {
            let value = of_four(columns[i], [w[i], x[i], y[i], z[i]]);
            values[i] = if self.first[i] == NOWHERE { values[i] } else { value };
        }
    }

    /// All values of pixels that are read one beside the other.
    #[inline(always)]
    fn all(&self, newer: &[f32], width: usize, values: &mut [f32; SIDE_BY_SIDE]) {
        const SEEN: usize = SIDE_BY_SIDE + 3;
        let newer = &newer[self.first[0] as usize..];
        let (a, b, c, d) =
            (&newer[..SEEN], &newer[width..][..SEEN], &newer[2 * width..][..SEEN], &newer[3 * width..][..SEEN]);
        let Self { across: [w, x, y, z], down: [e, f, g, h], .. } = self;
        for i in 0..SIDE_BY_SIDE {
            let down = [e[i], f[i], g[i], h[i]];
            let first = of_four([a[i], b[i], c[i], d[i]], down);
            let second = of_four([a[i + 1], b[i + 1], c[i + 1], d[i + 1]], down);
            let third = of_four([a[i + 2], b[i + 2], c[i + 2], d[i + 2]], down);
            let fourth = of_four([a[i + 3], b[i + 3], c[i + 3], d[i + 3]], down);
            values[i] = of_four([first, second, third, fourth], [w[i], x[i], y[i], z[i]]);
        }
    }

    /// Of the sixteen that a pixel is made of the nearest, one of the middle four.
    #[inline(always)]
    fn nearest(&self, width: usize, i: usize) -> Option<usize> {
        let first = usize::try_from(self.first[i]).ok()?;
        let further = |weights: &[[f32; SIDE_BY_SIDE]; 4]| usize::from(weights[2][i] > weights[1][i]);
        Some(first + (1 + further(&self.down)) * width + 1 + further(&self.across))
    }
}

#[inline(always)]
fn of_four(values: [f32; 4], weights: [f32; 4]) -> f32 {
    values[0] * weights[0] + values[1] * weights[1] + (values[2] * weights[2] + values[3] * weights[3])
}

/// Weights of the four pixels around a place that lies `part` behind the second.
#[inline(always)]
fn cubic(part: f32) -> [f32; 4] {
    let (two, three) = (part * part, part * part * part);
    [
        two - 0.5 * (part + three),
        1.0 - 2.5 * two + 1.5 * three,
        0.5 * part + 2.0 * two - 1.5 * three,
        0.5 * (three - two),
    ]
}

/// Adds the products of a row of pixels to those of the row of cells.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add(mean: [&[f32]; 5], pixels: [&[f32]; 3], [slope, base]: [f32; 2], covered: usize, products: &mut [f32]) {
    let [older, difference, valid] = pixels;
    let (xx, rest) = products.split_at_mut(covered);
    let (xy, rest) = rest.split_at_mut(covered);
    let (yy, rest) = rest.split_at_mut(covered);
    let (xr, rest) = rest.split_at_mut(covered);
    let (yr, rest) = rest.split_at_mut(covered);
    let (rr, rest) = rest.split_at_mut(covered);
    let (nn, count) = rest.split_at_mut(covered);
    let count = &mut count[..covered];
    let [up2, up, here, down, down2] = mean;
    let end = covered.min(here.len() - 2);
    for x in 2..end {
        let across = (8.0 * (here[x + 1] - here[x - 1]) - (here[x + 2] - here[x - 2])) * (1.0 / 12.0);
        let along = (8.0 * (down[x] - up[x]) - (down2[x] - up2[x])) * (1.0 / 12.0);
        let variance = slope * older[x].max(0.0) + base;
        let weight = valid[x] / (variance + FLOOR);
        let r = difference[x];
        xx[x] += weight * across * across;
        xy[x] += weight * across * along;
        yy[x] += weight * along * along;
        xr[x] -= weight * across * r;
        yr[x] -= weight * along * r;
        rr[x] += valid[x] * r * r / (variance * KEPT + FLOOR);
        nn[x] += weight * variance * (0.25 * SLOPED);
        count[x] += valid[x];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [60, 20];

    /// Mean, difference and validity of a row whose pixels went to `places`; `one_by_one` takes no notice of who is read in a row.
    fn sampled(places: [&[f32]; 2], hidden: &[u8], one_by_one: bool) -> ([Vec<f32>; 3], usize) {
        let noise =
            |count: usize, factor: usize| (0..count).map(|i| ((i * factor) % 251) as f32 / 251.0).collect::<Vec<_>>();
        let (newer, older) = (noise(SIZE[0] * SIZE[1], 97), noise(SIZE[0], 61));
        let mut reads = vec![Reads::default(); places[0].len() / SIDE_BY_SIDE];
        weigh(&mut reads, SIZE, 9, places);
        let in_a_row = reads.iter().filter(|reads| reads.in_a_row).count();
        reads.iter_mut().for_each(|reads| reads.in_a_row &= !one_by_one);
        let mut out = [vec![0.0; SIZE[0]], vec![0.0; SIZE[0]], vec![0.0; SIZE[0]]];
        let [mean, difference, valid] = &mut out;
        sample(&newer, hidden, SIZE[0], &reads, &older, [mean, difference, valid]);
        (out, in_a_row)
    }

    #[test]
    fn who_is_read_in_a_row_is_read_as_everybody_else() {
        let hidden: Vec<u8> = (0..SIZE[0] * SIZE[1]).map(|i| u8::from(i % 7 == 0)).collect();
        for (slope, expected) in [(0.0, 3), (0.01, 2), (0.3, 0)] {
            let along: Vec<f32> = (0..64).map(|x| 2.9 + slope * x as f32).collect();
            let down = vec![-1.6; 64];
            for hidden in [&[][..], &hidden] {
                let (found, in_a_row) = sampled([&along, &down], hidden, false);
                assert_eq!(in_a_row, expected, "slope {slope}");
                assert_eq!(found, sampled([&along, &down], hidden, true).0);
                assert!(found[2][..40].iter().all(|valid| *valid == 1.0) == hidden.is_empty());
                assert!(found[2].iter().all(|valid| *valid == 0.0 || *valid == 1.0));
            }
        }
    }

    #[test]
    fn what_is_nowhere_differs_by_nothing_and_does_not_count() {
        for nowhere in [f32::NAN, f32::INFINITY, -1e9, 1e9] {
            let mut along = vec![0.5; 64];
            along[20] = nowhere;
            let ([_, difference, valid], _) = sampled([&along, &[0.0; 64]], &[], false);
            assert_eq!((difference[20], valid[20], valid[19], valid[21]), (0.0, 0.0, 1.0, 1.0), "{nowhere}");
        }
    }
}
