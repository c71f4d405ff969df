//! Windows over the cells' sums, and the correction from the largest window down to each cell.

use super::CELL;

/// Windows beyond the cell's own, each twice as wide as the one before.
const LEVELS: usize = 5;
/// What is believed of the largest window's correction, as a part of the deviation that the network states.
const TOP: f32 = 1.0;
/// How far the correction of a smaller window may be from that of the larger one, as such a part.
const LOCAL: f32 = 1.0;
/// Weights of the cells of a column, the middle one's first: (1 8 28 56 70 56 28 8 1)/70.
const COLUMN: [f32; 5] = [1.0, 56.0 / 70.0, 28.0 / 70.0, 8.0 / 70.0, 1.0 / 70.0];
/// No correction is longer, pixels: the gradients know no further.
const REACH: f32 = 1.0;
/// Errors of vectors, pixels on either axis, of which gradients still know something: texture is a few pixels wide.
const NEAR: f32 = 2.0;
/// A variance that stands for knowing nothing, pixels².
const UNKNOWN: f32 = 1e3;

/// Sums over the pixels of each cell, plane by plane, each pixel weighted by its inverse variance: products of the gradients
/// (xx, xy, yy), of gradients and difference (x, y; after [`centre`] the correction times the information), the squared
/// difference over what noise lets expect, what noise adds to xx and yy, how many pixels there were, and the inverse
/// variance beforehand, counted as often.
#[derive(Debug, Default)]
pub(super) struct Sums {
    width: usize,
    height: usize,
    planes: Vec<f32>,
    line: Vec<f32>,
}

const XX: usize = 0;
const XY: usize = 1;
const YY: usize = 2;
const X: usize = 3;
const Y: usize = 4;
const MISFIT: usize = 5;
const NOISE: usize = 6;
const COUNT: usize = 7;
const BELIEF: usize = 8;

impl Sums {
    pub(super) const PLANES: usize = 9;
    /// Those that are summed from pixels.
    pub(super) const OF_PIXELS: usize = 8;

    pub(super) fn size(&mut self, [width, height]: [usize; 2]) {
        (self.width, self.height) = (width, height);
        self.planes.resize(Self::PLANES * width * height, 0.0);
    }

    fn cells(&self) -> usize {
        self.width * self.height
    }

    /// Takes a row of cells from its pixels' products, plane by plane.
    pub(super) fn fold(&mut self, row: usize, products: &[f32]) {
        let (width, cells) = (self.width, self.cells());
        for (plane, products) in products.chunks_exact(CELL * width).enumerate() {
            let out = &mut self.planes[plane * cells + row * width..][..width];
            for (sum, four) in out.iter_mut().zip(products.as_chunks::<CELL>().0) {
                *sum = (four[0] + four[1]) + (four[2] + four[3]);
            }
        }
    }

    fn at(&self, cell: usize) -> [f32; Self::PLANES] {
        let cells = self.cells();
        std::array::from_fn(|plane| self.planes[plane * cells + cell])
    }

    /// Mean squared difference over what noise lets expect, cell by cell; NaN where there is none.
    pub(super) fn misfits(&self) -> impl Iterator<Item = f32> {
        let plane = |plane: usize| &self.planes[plane * self.cells()..][..self.cells()];
        plane(MISFIT).iter().zip(plane(COUNT)).map(|(misfit, count)| misfit / count)
    }
}

/// Takes the noise off the gradients' products, and makes of gradients times differences what the whole correction should
/// be, that so far included, times the information.
pub(super) fn centre(sums: &mut Sums, change: &[f32], prior: &[f32]) {
    let cells = sums.cells();
    for cell in 0..cells {
        let sum = sums.at(cell);
        let (xx, xy, yy) = (sum[XX] - sum[NOISE], sum[XY], sum[YY] - sum[NOISE]);
        let [u, v] = [change[2 * cell], change[2 * cell + 1]];
        let mut set = |plane: usize, value: f32| sums.planes[plane * cells + cell] = value;
        set(XX, xx);
        set(YY, yy);
        set(X, sum[X] + (xx * u + xy * v));
        set(Y, sum[Y] + (xy * u + yy * v));
        set(BELIEF, sum[COUNT] / (prior[cell] * prior[cell]));
    }
}

/// The cells' own windows: (1 4 6 4 1)/6 along rows and columns, 1 at the middle.
pub(super) fn smooth(from: &Sums, into: &mut Sums) {
    let (width, height) = (from.width, from.height);
    into.size([width, height]);
    into.line.resize(width, 0.0);
    let Sums { planes, line, .. } = into;
    let both = from.planes.chunks_exact(width * height).zip(planes.chunks_exact_mut(width * height));
    for (from, into) in both {
        for (y, out) in into.chunks_exact_mut(width).enumerate() {
            let row = |off: isize| {
                let y = (y as isize + off).clamp(0, height as isize - 1) as usize;
                &from[y * width..][..width]
            };
            let (up2, up, here, down, down2) = (row(-2), row(-1), row(0), row(1), row(2));
            for (x, value) in line.iter_mut().enumerate() {
                *value = (up2[x] + down2[x]) * (1.0 / 6.0) + (up[x] + down[x]) * (4.0 / 6.0) + here[x];
            }
            for (x, value) in out.iter_mut().enumerate() {
                let at = |off: isize| line[(x as isize + off).clamp(0, width as isize - 1) as usize];
                *value = (at(-2) + at(2)) * (1.0 / 6.0) + (at(-1) + at(1)) * (4.0 / 6.0) + at(0);
            }
        }
    }
}

/// The cells' columns, one cell wide: what stands before something far away is often no wider, and a window that is would have what
/// is behind it say that the network, which draws narrow things to what is behind them, is right.
pub(super) fn stand(from: &Sums, into: &mut Sums) {
    let (width, height) = (from.width, from.height);
    into.size([width, height]);
    let both = from.planes.chunks_exact(width * height).zip(into.planes.chunks_exact_mut(width * height));
    for (from, into) in both {
        for (y, out) in into.chunks_exact_mut(width).enumerate() {
            let row = |y: usize| &from[y.min(height - 1) * width..][..width];
            for (value, here) in out.iter_mut().zip(row(y)) {
                *value = COLUMN[0] * here;
            }
            for (off, weight) in COLUMN.iter().enumerate().skip(1) {
                for (value, (up, down)) in out.iter_mut().zip(row(y.saturating_sub(off)).iter().zip(row(y + off))) {
                    *value += weight * (up + down);
                }
            }
        }
    }
}

/// A larger window's sums and what they say.
#[derive(Debug, Default)]
pub(super) struct Level {
    sums: Sums,
    change: Vec<f32>,
    variance: Vec<f32>,
}

/// The larger windows: (1 3 3 1)/4 along rows and columns of the level before, every second one. Every cell counts once
/// in each level.
pub(super) fn halve(cells: &Sums, levels: &mut Vec<Level>) {
    levels.resize_with(LEVELS, Level::default);
    let mut from = cells;
    let mut rest = &mut levels[..];
    while let Some((level, others)) = rest.split_first_mut() {
        let (width, height) = (from.width.div_ceil(2), from.height.div_ceil(2));
        level.sums.size([width, height]);
        level.change.resize(2 * width * height, 0.0);
        level.variance.resize(width * height, 0.0);
        let Sums { planes, line, .. } = &mut level.sums;
        line.resize(from.width, 0.0);
        let both = from.planes.chunks_exact(from.cells()).zip(planes.chunks_exact_mut(width * height));
        for (from_plane, into) in both {
            for (y, out) in into.chunks_exact_mut(width).enumerate() {
                line.fill(0.0);
                for (off, weight) in [0.25, 0.75, 0.75, 0.25].into_iter().enumerate() {
                    let Some(y) = (2 * y + off).checked_sub(1).filter(|y| *y < from.height) else { continue };
                    for (value, sum) in line.iter_mut().zip(&from_plane[y * from.width..][..from.width]) {
                        *value += weight * sum;
                    }
                }
                for (x, value) in out.iter_mut().enumerate() {
                    let at =
                        |off: usize| (2 * x + off).checked_sub(1).and_then(|x| line.get(x)).copied().unwrap_or(0.0);
                    *value = 0.25 * (at(0) + at(3)) + 0.75 * (at(1) + at(2));
                }
            }
        }
        from = &level.sums;
        rest = others;
    }
}

/// From the largest window, which believes the network, down to the cells' own, and on to their columns where there are any.
pub(super) fn descend(
    levels: &mut [Level],
    cells: &Sums,
    columns: Option<&Sums>,
    change: &mut [f32],
    variance: &mut [f32],
) {
    for at in (0..levels.len()).rev() {
        let (below, above) = levels.split_at_mut(at + 1);
        if let Some(Level { sums, change, variance }) = below.last_mut() {
            match above.first() {
                Some(larger) => settle(sums, LOCAL, |cell, _| larger.around(cell, sums), change, variance),
                None => settle(sums, TOP, |_, _| Known::default(), change, variance),
            }
        }
    }
    if let Some(larger) = levels.first() {
        settle(cells, LOCAL, |cell, _| larger.around(cell, cells), change, variance);
    }
    if let Some(columns) = columns {
        settle(columns, LOCAL, |_, window| window, change, variance);
    }
}

/// A correction, and its variance.
type Known = ([f32; 2], f32);

/// The correction of each window by its own sums and by what is known beforehand, given the cell and what was here.
fn settle(
    sums: &Sums,
    part: f32,
    beforehand: impl Fn(usize, Known) -> Known,
    change: &mut [f32],
    variance: &mut [f32],
) {
    let both = change.as_chunks_mut::<2>().0.iter_mut().zip(variance);
    for (cell, (change, variance)) in both.enumerate() {
        let (before, unsure) = beforehand(cell, (*change, *variance));
        let sum = sums.at(cell);
        if sum[COUNT] <= 0.0 {
            (*change, *variance) = (before, UNKNOWN);
            continue;
        }
        let (found, spread) = posterior(&sum, before, unsure, sum[BELIEF] / sum[COUNT] / (part * part));
        let length = (found[0] * found[0] + found[1] * found[1]).sqrt();
        // Asked this way round, a NaN changes nothing.
        if length <= REACH {
            *change = found;
        } else if length.is_finite() {
            *change = found.map(|along| along * (REACH / length));
        }
        *variance = spread;
    }
}

/// Mean and half of the covariance's trace, where the window's correction is known beforehand to be `before` with the
/// inverse variance `belief`, and `before` itself has the variance `unsure`.
///
/// Gradients are believed as far as the truth is likely to be near. Where the network states an error of many pixels, as in mere
/// noise, what they say is chance, and makes much of the last digits of the vectors.
fn posterior(sum: &[f32; Sums::PLANES], before: [f32; 2], unsure: f32, belief: f32) -> Known {
    let near = 1.0 - (-0.5 * NEAR * NEAR * belief).exp();
    // More difference than noise lets expect: moving things, light that changed, motion that is none. It weighs on all.
    let trust = near / (sum[MISFIT] / sum[COUNT]).max(1.0);
    let (middle, lean, skew) = (0.5 * (sum[XX] + sum[YY]), 0.5 * (sum[XX] - sum[YY]), sum[XY]);
    let apart = (lean * lean + skew * skew).sqrt();
    // The direction that is known best, by half its angle.
    let (twice, sign) = if apart > 0.0 { (lean / apart, skew) } else { (1.0, 0.0) };
    let cosine = (0.5 * (1.0 + twice)).max(0.0).sqrt();
    let sine = (0.5 * (1.0 - twice)).max(0.0).sqrt() * if sign < 0.0 { -1.0 } else { 1.0 };
    let turn = |[x, y]: [f32; 2]| [cosine * x + sine * y, cosine * y - sine * x];
    let (pull, from) = (turn([sum[X], sum[Y]]), turn(before));
    let (mut found, mut spread) = ([0.0; 2], 0.0);
    for (axis, information) in [middle + apart, middle - apart].into_iter().enumerate() {
        // Noise in the gradients meets noise in the difference, which gives pulls though nothing is known.
        let trust = if information > 0.0 { trust * information / (information + sum[NOISE]) } else { 0.0 };
        let (known, pull) = (information.max(0.0) * trust, pull[axis] * trust);
        found[axis] = (pull + belief * from[axis]) / (known + belief);
        let left = belief / (known + belief);
        spread += 0.5 * (1.0 / (known + belief) + left * left * unsure);
    }
    ([cosine * found[0] - sine * found[1], sine * found[0] + cosine * found[1]], spread)
}

impl Level {
    /// Correction and variance around a cell of the next smaller level, whose sums these are.
    fn around(&self, cell: usize, smaller: &Sums) -> Known {
        self.between(cell % smaller.width, cell / smaller.width)
    }

    /// Correction and variance at the place of a cell of the next smaller level, bilinear between the centres.
    fn between(&self, column: usize, row: usize) -> Known {
        let near_and_far = |at: usize, count: usize| {
            let near = at / 2;
            [near, if at.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(count - 1) }]
        };
        let (columns, rows) = (near_and_far(column, self.sums.width), near_and_far(row, self.sums.height));
        let [a, b, c, d] = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(x, y)| rows[y] * self.sums.width + columns[x]);
        let mix =
            |of: &dyn Fn(usize) -> f32| 0.75 * (0.75 * of(a) + 0.25 * of(b)) + 0.25 * (0.75 * of(c) + 0.25 * of(d));
        let change = [mix(&|at| self.change[2 * at]), mix(&|at| self.change[2 * at + 1])];
        (change, mix(&|at| self.variance[at]))
    }
}
