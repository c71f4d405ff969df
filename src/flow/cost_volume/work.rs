//! The four pieces of work of a cost volume, each for a band of rows: turning, fetching, multiplying, seeking.

use super::{
    Shape,
    bands::Band,
    lanes::{self, Lanes, TILE, Work, fetch},
};

/// Displacements that are summed at once; with two rows of the older frame that is ten sums, which just fit the sixteen
/// registers of AVX2 and hide the latency of its sums.
const GROUP: usize = 5;

/// Turns the newer frame's planes, so that a pixel's channels lie side by side.
pub struct Turn<'a> {
    pub shape: &'a Shape,
    /// channels × height × width.
    pub newer: &'a [f32],
    /// One plane of height rows of width × depth.
    pub to: Band<'a, f32>,
}

impl Work for Turn<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        let Shape { channels, width, .. } = *self.shape;
        for y in self.to.first..self.to.end {
            // A whole cache line of each pixel at once, while few planes are read: they lie far apart.
            for line in (0..channels).step_by(super::LINE) {
                for x in (0..width).step_by(TILE) {
                    for c in (line..channels.min(line + super::LINE)).step_by(TILE) {
                        self.tile(lanes, c, x, y);
                    }
                }
            }
        }
    }
}

impl Turn<'_> {
    #[inline(always)]
    fn tile<L: Lanes>(&mut self, lanes: L, c: usize, x: usize, y: usize) {
        let Shape { channels, width, .. } = *self.shape;
        let (plane, depth) = (self.shape.cells(), self.shape.depth());
        let from = &self.newer[c * plane + y * width + x..];
        let to = &mut self.to.row(0, y)[x * depth + c..];
        if width - x >= TILE && channels - c >= TILE {
            // Of the next row: planes lie too far apart for a processor to foresee.
            for i in 0..TILE {
                fetch(from.get(i * plane + width..i * plane + width + TILE).unwrap_or(&[]));
            }
            lanes.turn(from, plane, to, depth);
        } else {
            for i in 0..TILE.min(channels - c) {
                for j in 0..TILE.min(width - x) {
                    to[j * depth + i] = from[i * plane + j];
                }
            }
        }
    }
}

/// Fetches the newer frame's features to where the flow says that they went.
pub struct Fetch<'a> {
    pub shape: &'a Shape,
    /// What [`Turn`] gave.
    pub newer: &'a [f32],
    /// 2 × height × width.
    pub flow: &'a [f32],
    /// One plane of height rows of channels × [`Shape::stride`]; the columns beside the image stay as they are.
    pub to: Band<'a, f32>,
}

/// The four cells around a point: where their channels begin, what they weigh in their row, and what the two rows weigh.
type Corners = ([usize; 4], [f32; 4], [f32; 2]);

impl Fetch<'_> {
    /// A cell that lies outside weighs nothing, and so does a point that is no number.
    #[inline(always)]
    fn corners(&self, x: usize, y: usize) -> Corners {
        let Shape { height, width, .. } = *self.shape;
        let (cells, depth) = (self.shape.cells(), self.shape.depth());
        let at = y * width + x;
        let (u, v) = (self.flow[at], self.flow[cells + at]);
        // Whole cells first, so that no digit of the rest is lost on the way.
        let (left, top) = (x as f32 + u.floor(), y as f32 + v.floor());
        let (right, below) = (u - u.floor(), v - v.floor());
        let (mut from, mut weights, mut rows) = ([0; 4], [0.0; 4], [0.0; 2]);
        if left >= -1.0 && top >= -1.0 && left < width as f32 && top < height as f32 {
            rows = [1.0 - below, below];
            for (corner, (column, row, weight)) in [
                (left, top, 1.0 - right),
                (left + 1.0, top, right),
                (left, top + 1.0, 1.0 - right),
                (left + 1.0, top + 1.0, right),
            ]
            .into_iter()
            .enumerate()
            {
                if column >= 0.0 && row >= 0.0 && column < width as f32 && row < height as f32 {
                    from[corner] = (row as usize * width + column as usize) * depth;
                    weights[corner] = weight;
                }
            }
        }
        (from, weights, rows)
    }
}

/// Two cells of a row, weighed. A closure would not do: it is compiled without the processor's features, and is ten times slower
/// where it is not inlined.
#[inline(always)]
fn between<L: Lanes>(lanes: L, left: &[f32], right: &[f32], of_left: f32, of_right: f32) -> L::V {
    let left = lanes.mul(lanes.load(left), lanes.splat(of_left));
    lanes.add(left, lanes.mul(lanes.load(right), lanes.splat(of_right)))
}

impl Work for Fetch<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        let Shape { channels, width, reach, .. } = *self.shape;
        let stride = self.shape.stride();
        // Whole tiles: a vector of four lanes needs two for one, one of sixteen fills two.
        let block = L::COUNT.max(TILE);
        for y in self.to.first..self.to.end {
            for x in (0..width).step_by(TILE) {
                let some = TILE.min(width - x);
                let mut corners: [Corners; TILE] = [([0; 4], [0.0; 4], [0.0; 2]); TILE];
                for (i, corners) in corners[..some].iter_mut().enumerate() {
                    *corners = self.corners(x + i, y);
                }
                let to = self.to.row(0, y);
                for c in (0..channels).step_by(block) {
                    let mut tiles = [0.0; lanes::MOST * TILE];
                    for (pixel, (from, weights, rows)) in corners.iter().enumerate() {
                        for part in (0..block).step_by(L::COUNT) {
                            // Rounded after each product, in the order of the plain graph's operator.
                            let [a, b, c, d] = from.map(|corner| corner + c + part);
                            let upper = between(lanes, &self.newer[a..], &self.newer[b..], weights[0], weights[1]);
                            let lower = between(lanes, &self.newer[c..], &self.newer[d..], weights[2], weights[3]);
                            let upper = lanes.mul(upper, lanes.splat(rows[0]));
                            let lower = lanes.mul(lower, lanes.splat(rows[1]));
                            lanes.store(lanes.add(upper, lower), &mut tiles[pixel * block + part..]);
                        }
                    }
                    for (tile, c) in (0..block).step_by(TILE).zip((c..channels).step_by(TILE)) {
                        let (from, to) = (&tiles[tile..], &mut to[c * stride + reach + x..]);
                        if some == TILE && channels - c >= TILE {
                            lanes.turn(from, block, to, stride);
                        } else {
                            for i in 0..TILE.min(channels - c) {
                                for j in 0..some {
                                    to[i * stride + j] = from[j * block + i];
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Means of products over the channels.
pub struct Multiply<'a> {
    pub shape: &'a Shape,
    /// channels × height × width.
    pub older: &'a [f32],
    /// What [`Fetch`] gave.
    pub fetched: &'a [f32],
    pub gain: f32,
    /// Room for [`Shape::scratch`] values.
    pub scratch: &'a mut [f32],
    /// One plane for each displacement.
    pub volume: Band<'a, f32>,
}

impl Work for Multiply<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        for y in (self.volume.first..self.volume.end).step_by(2) {
            for x in (0..self.shape.width).step_by(L::COUNT) {
                self.pack(L::COUNT, x, y);
                self.block(lanes, x, y);
            }
        }
    }
}

impl Multiply<'_> {
    /// The older frame's features of some columns of rows y and y + 1, side by side for each channel: planes lie so far
    /// apart that they would drive each other out of the cache.
    #[inline(always)]
    fn pack(&mut self, count: usize, x: usize, y: usize) {
        let Shape { channels, height, width, .. } = *self.shape;
        let some = count.min(width - x);
        // What comes then, at the end of the rows that of the next two.
        let next = if x + count < width { x + count } else { 2 * width };
        let planes = self.older.chunks_exact(height * width).take(channels);
        for (to, plane) in self.scratch.chunks_exact_mut(2 * count).zip(planes) {
            let (upper, lower) = to.split_at_mut(count);
            for (to, y) in [(upper, y), (lower, y + 1)] {
                if y < height && some == count {
                    to.copy_from_slice(&plane[y * width + x..][..count]);
                } else if y < height {
                    to[..some].copy_from_slice(&plane[y * width + x..][..some]);
                    to[some..].fill(0.0);
                } else {
                    to.fill(0.0);
                }
                fetch(plane.get(next + y * width..next + y * width + count).unwrap_or(&[]));
            }
        }
    }

    /// Some columns of rows y and y + 1 with every displacement. A row of the newer frame is looked at once for both.
    #[inline(always)]
    fn block<L: Lanes>(&mut self, lanes: L, x: usize, y: usize) {
        let Shape { channels, height, reach, .. } = *self.shape;
        let (stride, side) = (self.shape.stride(), self.shape.side());
        for step in 0..=side {
            // Row y + step − reach: `step` is the upper row's displacement, counted from 0, and one more than the lower's.
            let row = (y + step).checked_sub(reach).filter(|row| *row < height);
            let rows = [(step < side).then_some((step, y)), step.checked_sub(1).map(|step| (step, y + 1))];
            for dx in (0..side).step_by(GROUP) {
                let older = &self.scratch[..2 * L::COUNT * channels];
                let fetched = row.map(|row| &self.fetched[row * channels * stride..][..channels * stride]);
                let from = x + dx;
                let mut sums = [[lanes.splat(0.0); GROUP]; 2];
                let some = GROUP.min(side - dx);
                if let Some(fetched) = fetched {
                    match some {
                        5 => sums = group::<L, 5>(lanes, older, fetched, stride, from),
                        4 => sums = group::<L, 4>(lanes, older, fetched, stride, from),
                        3 => sums = group::<L, 3>(lanes, older, fetched, stride, from),
                        2 => sums = group::<L, 2>(lanes, older, fetched, stride, from),
                        _ => sums = group::<L, 1>(lanes, older, fetched, stride, from),
                    }
                }
                for (sums, (dy, y)) in sums.iter().zip(rows).filter_map(|(sums, row)| Some((sums, row?))) {
                    if y < self.volume.end {
                        for (k, sum) in sums.iter().enumerate().take(some) {
                            self.write(lanes, *sum, dy * side + dx + k, x, y);
                        }
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn write<L: Lanes>(&mut self, lanes: L, sum: L::V, plane: usize, x: usize, y: usize) {
        let mean = lanes.mul(sum, lanes.splat(self.gain / self.shape.channels as f32));
        let to = &mut self.volume.row(plane, y)[x..];
        if to.len() >= L::COUNT {
            lanes.store(mean, to);
        } else {
            let mut row = [0.0; lanes::MOST];
            lanes.store(mean, &mut row);
            to.copy_from_slice(&row[..to.len()]);
        }
    }
}

/// Sums over the channels of two rows' products with `N` displacements side by side.
#[inline(always)]
fn group<L: Lanes, const N: usize>(
    lanes: L,
    older: &[f32],
    fetched: &[f32],
    stride: usize,
    from: usize,
) -> [[L::V; GROUP]; 2] {
    let mut sums = [[lanes.splat(0.0); GROUP]; 2];
    for (both, row) in older.chunks_exact(2 * L::COUNT).zip(fetched.chunks_exact(stride)) {
        let (upper, lower) = (lanes.load(both), lanes.load(&both[L::COUNT..]));
        let row = &row[from..from + L::COUNT + N - 1];
        // Written out, for a loop may leave the sums in memory.
        macro_rules! each {
            ($($k:literal)*) => { $(if $k < N {
                let seen = lanes.load(&row[$k..]);
                sums[0][$k] = lanes.fused(upper, seen, sums[0][$k]);
                sums[1][$k] = lanes.fused(lower, seen, sums[1][$k]);
            })* };
        }
        each!(0 1 2 3 4);
    }
    sums
}

/// The soft arg-max over the displacements of the mean over each pixel's neighbours.
pub struct Seek<'a> {
    pub shape: &'a Shape,
    /// What [`Multiply`] gave.
    pub volume: &'a [f32],
    /// What the volume is multiplied with before its exponentials.
    pub scale: f32,
    /// Room for [`Shape::scratch`] values.
    pub scratch: &'a mut [f32],
    /// Two planes: right and down.
    pub to: Band<'a, f32>,
}

impl Work for Seek<'_> {
    #[inline(always)]
    fn on<L: Lanes>(mut self, lanes: L) {
        for y in self.to.first..self.to.end {
            self.pool(lanes, y);
            for x in (0..self.shape.width).step_by(L::COUNT) {
                let found = self.expected(lanes, x);
                for (plane, found) in found.into_iter().enumerate() {
                    let mut row = [0.0; lanes::MOST];
                    lanes.store(found, &mut row);
                    let to = &mut self.to.row(plane, y)[x..];
                    let some = to.len().min(L::COUNT);
                    to[..some].copy_from_slice(&row[..some]);
                }
            }
        }
    }
}

impl Seek<'_> {
    /// Scaled means over 3 × 3 cells, over those that there are: a row of [`Shape::columns`] for each displacement.
    #[inline(always)]
    fn pool<L: Lanes>(&mut self, lanes: L, y: usize) {
        let Shape { height, width, .. } = *self.shape;
        let columns = self.shape.columns();
        let (first, end) = (y.saturating_sub(1), (y + 2).min(height));
        let rows = (end - first) as f32;
        let (pooled, sums) = self.scratch.split_at_mut(self.shape.displacements() * columns);
        // Of columns −1 to `columns`; what is not in the image stays zero.
        let sums = &mut sums[..columns + 2];
        sums.fill(0.0);
        let planes = self.volume.chunks_exact(height * width);
        for (pooled, plane) in pooled.chunks_exact_mut(columns).zip(planes) {
            let within = &mut sums[1..=width];
            within.copy_from_slice(&plane[first * width..][..width]);
            for row in plane[(first + 1) * width..end * width].chunks_exact(width) {
                within.iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
            }
            // A division, as in the plain graph's operator: see `through_grid` in `operator.rs`.
            let (cells, scale) = (lanes.splat(3.0 * rows), lanes.splat(self.scale));
            for (x, pooled) in pooled.chunks_exact_mut(L::COUNT).enumerate() {
                let sums = &sums[x * L::COUNT..][..L::COUNT + 2];
                let sum = lanes.add(lanes.add(lanes.load(sums), lanes.load(&sums[1..])), lanes.load(&sums[2..]));
                lanes.store(lanes.mul(lanes.div(sum, cells), scale), pooled);
            }
            let edge = if width == 1 { rows } else { 2.0 * rows };
            pooled[0] = (sums[1] + sums[2]) / edge * self.scale;
            pooled[width - 1] = (sums[width - 1] + sums[width]) / edge * self.scale;
        }
    }

    /// The displacements, weighed by the exponentials of what [`Self::pool`] left for some columns.
    #[inline(always)]
    fn expected<L: Lanes>(&self, lanes: L, x: usize) -> [L::V; 2] {
        let (reach, side, columns) = (self.shape.reach as f32, self.shape.side(), self.shape.columns());
        let pooled = self.scratch[..side * side * columns].chunks_exact(columns);
        let mut most = lanes.splat(f32::NEG_INFINITY);
        for row in pooled.clone() {
            most = lanes.max(lanes.load(&row[x..]), most);
        }
        let zero = lanes.splat(0.0);
        let (mut total, mut right, mut down) = (zero, zero, zero);
        let (mut dx, mut dy, mut line) = (-reach, -reach, zero);
        for row in pooled {
            let weight = lanes::exp(lanes, lanes.sub(lanes.load(&row[x..]), most));
            line = lanes.add(line, weight);
            right = lanes.fused(weight, lanes.splat(dx), right);
            dx += 1.0;
            if dx > reach {
                total = lanes.add(total, line);
                down = lanes.fused(line, lanes.splat(dy), down);
                (dx, dy, line) = (-reach, dy + 1.0, zero);
            }
        }
        [lanes.div(right, total), lanes.div(down, total)]
    }
}
