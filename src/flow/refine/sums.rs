//! The loops over pixels: grey, blur, warp, and the products that cells are summed from.
//!
//! Each value is made of the same operations in the same order whatever the width of the vectors, so that all
//! instruction sets give the same bits.

use multiversion::multiversion;

use super::{CELL, FLOOR, pyramid::Sums};
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
    /// Where each pixel of the older frame stands in the newer one, x then y.
    places: [Vec<f32>; 2],
    /// How those of a row are read, [`SIDE_BY_SIDE`] together.
    reads: Vec<Reads>,
    /// Vectors of a row of cells, with one more at either end.
    line: [Vec<f32>; 2],
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
        start: &[f32],
        change: &[f32],
    ) {
        let (width, height) = (pair.older.width, pair.older.height);
        for plane in [&mut self.mean, &mut self.difference, &mut self.valid] {
            plane.resize(width * height, 0.0);
        }
        let pixels = (CELL * raster[0]).next_multiple_of(SIDE_BY_SIDE);
        self.places.iter_mut().for_each(|places| places.resize(pixels, 0.0));
        self.line.iter_mut().for_each(|line| line.resize(raster[0] + 2, 0.0));
        self.reads.resize(pixels / SIDE_BY_SIDE, Reads::default());
        self.valid.fill(0.0);
        let covered = CELL * raster[0];
        let marks = |exposed: &'_ Exposed| exposed.saturated_part > 0.0;
        let hidden = if marks(pair.newer) { &pair.newer.saturated[..] } else { &[] };
        for y in 0..CELL * raster[1] {
            self.place(y, raster, start, change);
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
    fn place(&mut self, y: usize, [columns, rows]: [usize; 2], start: &[f32], change: &[f32]) {
        let place = (y as f32 + 0.5) / CELL as f32 - 0.5;
        let part = place - place.floor();
        let upper = (place.floor().max(0.0) as usize).min(rows - 1);
        let lower = ((place.floor() + 1.0) as usize).min(rows - 1);
        for (axis, (line, places)) in self.line.iter_mut().zip(&mut self.places).enumerate() {
            let at = |row: usize, column: usize| {
                let cell = 2 * (row * columns + column) + axis;
                start[cell] + change[cell]
            };
            for (column, value) in line[1..=columns].iter_mut().enumerate() {
                let above = at(upper, column);
                *value = above + (at(lower, column) - above) * part;
            }
            (line[0], line[columns + 1]) = (line[1], line[columns]);
            for (three, four) in line.windows(3).zip(places.as_chunks_mut::<CELL>().0) {
                let (left, right) = (three[1] - three[0], three[2] - three[1]);
                *four = [
                    three[1] - 0.375 * left,
                    three[1] - 0.125 * left,
                    three[1] + 0.125 * right,
                    three[1] + 0.375 * right,
                ];
            }
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

/// Pixels whose weights are found at once.
const SIDE_BY_SIDE: usize = 16;

/// From which sixteen pixels each of some is read, and what they weigh, by Catmull and Rom's cubic.
#[derive(Debug, Clone, Copy, Default)]
struct Reads {
    /// The first of them, or [`NOWHERE`].
    first: [i32; SIDE_BY_SIDE],
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
            let (column, row) = (to_x as i32, to_y as i32);
            let first = (row - 1) * width as i32 + column - 1;
            reads.first[i] = if inside { first } else { NOWHERE };
            let (of_columns, of_rows) = (cubic(to_x - column as f32), cubic(to_y - row as f32));
            for tap in 0..4 {
                reads.across[tap][i] = of_columns[tap];
                reads.down[tap][i] = of_rows[tap];
            }
        }
    }
}

/// Reads `newer` where the pixels of one row went; not where `hidden` marks it.
fn sample(
    newer: &[f32],
    hidden: &[u8],
    width: usize,
    reads: &[Reads],
    older: &[f32],
    [mean, difference, valid]: [&mut [f32]; 3],
) {
    for x in 0..older.len() {
        let (Reads { first, across, down }, i) = (&reads[x / SIDE_BY_SIDE], x % SIDE_BY_SIDE);
        let Ok(first) = usize::try_from(first[i]) else {
            (mean[x], difference[x]) = (older[x], 0.0);
            continue;
        };
        let [across, down] = [across, down].map(|weights| weights.map(|of_tap| of_tap[i]));
        let rows: [&[f32]; 4] = std::array::from_fn(|row| &newer[first + row * width..][..4]);
        // Four columns at once: they lie side by side.
        let columns: [f32; 4] = std::array::from_fn(|at| {
            rows[0][at] * down[0] + rows[1][at] * down[1] + (rows[2][at] * down[2] + rows[3][at] * down[3])
        });
        let value = columns[0] * across[0] + columns[1] * across[1] + (columns[2] * across[2] + columns[3] * across[3]);
        (mean[x], difference[x]) = (0.5 * (older[x] + value), value - older[x]);
        // The nearest of the sixteen is one of the middle four.
        let further = |weights: [f32; 4]| usize::from(weights[2] > weights[1]);
        let nearest = first + (1 + further(down)) * width + 1 + further(across);
        valid[x] = 1.0 - f32::from(hidden.get(nearest).copied().unwrap_or(0));
    }
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
