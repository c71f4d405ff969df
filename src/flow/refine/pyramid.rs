//! Windows over the cells' sums, and the correction from the largest window down to each cell.
//!
//! As in [`sums`](super::sums), all instruction sets give the same bits.

use multiversion::multiversion;

use super::{CELL, SIDE_BY_SIDE, put, some};

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

    /// In their order.
    pub(super) fn all(&self) -> [&[f32]; Self::PLANES] {
        let mut planes = self.planes.chunks_exact(self.cells());
        std::array::from_fn(|_| planes.next().unwrap_or_default())
    }

    /// Takes a row of cells from its pixels' products, plane by plane.
    pub(super) fn fold(&mut self, row: usize, products: &[f32]) {
        let (width, cells) = (self.width, self.cells());
        for (plane, products) in products.chunks_exact(CELL * width).enumerate() {
            add_fours(products, &mut self.planes[plane * cells + row * width..][..width]);
        }
    }

    /// Mean squared difference over what noise lets expect, cell by cell; NaN where there is none.
    pub(super) fn misfits(&self) -> impl Iterator<Item = f32> {
        let [.., misfits, _, counts, _] = self.all();
        misfits.iter().zip(counts).map(|(misfit, count)| misfit / count)
    }
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_fours(products: &[f32], sums: &mut [f32]) {
    for (sum, four) in sums.iter_mut().zip(products.as_chunks::<CELL>().0) {
        *sum = (four[0] + four[1]) + (four[2] + four[3]);
    }
}

/// Corrections of cells, pixels right and down, and what variance they have on either axis, pixels².
#[derive(Debug, Default)]
pub(super) struct Found {
    pub(super) change: [Vec<f32>; 2],
    pub(super) variance: Vec<f32>,
}

impl Found {
    /// None, for so many cells.
    pub(super) fn begin(&mut self, cells: usize) {
        self.size(cells);
        self.planes_mut().into_iter().for_each(|plane| plane.fill(0.0));
    }

    fn size(&mut self, cells: usize) {
        self.planes_mut().into_iter().for_each(|plane| plane.resize(cells, 0.0));
    }

    fn planes(&self) -> [&Vec<f32>; 3] {
        [&self.change[0], &self.change[1], &self.variance]
    }

    fn planes_mut(&mut self) -> [&mut Vec<f32>; 3] {
        let [right, down] = &mut self.change;
        [right, down, &mut self.variance]
    }
}

/// Takes the noise off the gradients' products, and makes of gradients times differences what the whole correction should
/// be, that so far included, times the information.
pub(super) fn centre(sums: &mut Sums, change: &[Vec<f32>; 2], prior: &[f32]) {
    let mut planes = sums.planes.chunks_exact_mut(prior.len());
    centre_planes(std::array::from_fn(|_| planes.next().unwrap_or_default()), [&change[0], &change[1]], prior);
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn centre_planes(sums: [&mut [f32]; Sums::PLANES], [u, v]: [&[f32]; 2], prior: &[f32]) {
    let [xx, xy, yy, x, y, _, noise, count, belief] = sums;
    for at in (0..prior.len()).step_by(SIDE_BY_SIDE) {
        let [mut to_xx, of_xy, mut to_yy] = [some(xx, at), some(xy, at), some(yy, at)];
        let [mut to_x, mut to_y, mut to_belief] = [some(x, at), some(y, at), some(prior, at)];
        let [noise, count, u, v] = [some(noise, at), some(count, at), some(u, at), some(v, at)];
        for i in 0..SIDE_BY_SIDE {
            to_xx[i] -= noise[i];
            to_yy[i] -= noise[i];
            to_x[i] += to_xx[i] * u[i] + of_xy[i] * v[i];
            to_y[i] += of_xy[i] * u[i] + to_yy[i] * v[i];
            to_belief[i] = count[i] / (to_belief[i] * to_belief[i]);
        }
        put(to_xx, xx, at);
        put(to_yy, yy, at);
        put(to_x, x, at);
        put(to_y, y, at);
        put(to_belief, belief, at);
    }
}

/// The cells' own windows: (1 4 6 4 1)/6 along rows and columns, 1 at the middle.
pub(super) fn smooth(from: &Sums, into: &mut Sums) {
    let (width, height) = (from.width, from.height);
    into.size([width, height]);
    into.line.resize(width + 4, 0.0);
    let Sums { planes, line, .. } = into;
    let both = from.planes.chunks_exact(width * height).zip(planes.chunks_exact_mut(width * height));
    both.for_each(|(from, into)| smooth_plane(from, width, line, into));
}

/// `line` has room for two columns more on either side.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn smooth_plane(from: &[f32], width: usize, line: &mut [f32], into: &mut [f32]) {
    let last = from.len() / width - 1;
    for (y, out) in into.chunks_exact_mut(width).enumerate() {
        let row = |y: usize| &from[y.min(last) * width..][..width];
        let (up2, up, here) = (row(y.saturating_sub(2)), row(y.saturating_sub(1)), row(y));
        let (down, down2) = (row(y + 1), row(y + 2));
        for (x, value) in line[2..][..width].iter_mut().enumerate() {
            *value = (up2[x] + down2[x]) * (1.0 / 6.0) + (up[x] + down[x]) * (4.0 / 6.0) + here[x];
        }
        let (first, end) = (line[2], line[width + 1]);
        line[..2].fill(first);
        line[width + 2..].fill(end);
        for (value, five) in out.iter_mut().zip(line.windows(5)) {
            *value = (five[0] + five[4]) * (1.0 / 6.0) + (five[1] + five[3]) * (4.0 / 6.0) + five[2];
        }
    }
}

/// The cells' columns, one cell wide: what stands before something far away is often no wider, and a window that is would have what
/// is behind it say that the network, which draws narrow things to what is behind them, is right.
pub(super) fn stand(from: &Sums, into: &mut Sums) {
    let (width, height) = (from.width, from.height);
    into.size([width, height]);
    let both = from.planes.chunks_exact(width * height).zip(into.planes.chunks_exact_mut(width * height));
    both.for_each(|(from, into)| stand_plane(from, width, into));
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn stand_plane(from: &[f32], width: usize, into: &mut [f32]) {
    let last = from.len() / width - 1;
    for (y, out) in into.chunks_exact_mut(width).enumerate() {
        let row = |y: usize| &from[y.min(last) * width..][..width];
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

/// A larger window's sums and what they say.
#[derive(Debug, Default)]
pub(super) struct Level {
    sums: Sums,
    found: Found,
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
        let Sums { planes, line, .. } = &mut level.sums;
        line.clear();
        line.resize(2 * width + 2, 0.0);
        let both = from.planes.chunks_exact(from.cells()).zip(planes.chunks_exact_mut(width * height));
        both.for_each(|(plane, into)| halve_plane(plane, from.width, line, into));
        from = &level.sums;
        rest = others;
    }
}

/// `line` has room for a column more on the left, and for so many on the right that its length is even and a larger column's four lie
/// in it; these stay zero.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn halve_plane(from: &[f32], width: usize, line: &mut [f32], into: &mut [f32]) {
    for (y, out) in into.chunks_exact_mut(width.div_ceil(2)).enumerate() {
        line[1..][..width].fill(0.0);
        for (off, weight) in [0.25, 0.75, 0.75, 0.25].into_iter().enumerate() {
            let Some(y) = (2 * y + off).checked_sub(1).filter(|y| (y + 1) * width <= from.len()) else { continue };
            for (value, sum) in line[1..].iter_mut().zip(&from[y * width..][..width]) {
                *value += weight * sum;
            }
        }
        for (value, pairs) in out.iter_mut().zip(line.as_chunks::<2>().0.windows(2)) {
            *value = 0.25 * (pairs[0][0] + pairs[1][1]) + 0.75 * (pairs[0][1] + pairs[1][0]);
        }
    }
}

/// From the largest window, which believes the network, down to the cells' own, and on to their columns where there are any.
pub(super) fn descend(levels: &mut [Level], cells: &Sums, columns: Option<&Sums>, found: &mut Found) {
    for at in (0..levels.len()).rev() {
        let (below, above) = levels.split_at_mut(at + 1);
        if let Some(Level { sums, found }) = below.last_mut() {
            match above.first() {
                Some(larger) => {
                    larger.widen(sums, found);
                    settle(sums, LOCAL, found);
                }
                None => {
                    found.begin(sums.cells());
                    settle(sums, TOP, found);
                }
            }
        }
    }
    if let Some(larger) = levels.first() {
        larger.widen(cells, found);
        settle(cells, LOCAL, found);
    }
    if let Some(columns) = columns {
        settle(columns, LOCAL, found);
    }
}

impl Level {
    /// What was found here, at the cells of the next smaller level: bilinear between the centres.
    fn widen(&self, smaller: &Sums, into: &mut Found) {
        let Sums { width, height, .. } = self.sums;
        into.size(smaller.cells());
        for (from, into) in self.found.planes().into_iter().zip(into.planes_mut()) {
            for (y, out) in into.chunks_exact_mut(smaller.width).enumerate() {
                let near = y / 2;
                let far = if y.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(height - 1) };
                widen_row(&from[near * width..][..width], &from[far * width..][..width], out);
            }
        }
    }
}

/// Two columns for each one of the nearer row and the farther one; one for the last where there is no more room.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn widen_row(near: &[f32], far: &[f32], out: &mut [f32]) {
    #[inline(always)]
    fn mix(a: f32, b: f32, c: f32, d: f32) -> f32 {
        0.75 * (0.75 * a + 0.25 * b) + 0.25 * (0.75 * c + 0.25 * d)
    }
    let last = near.len() - 1;
    for x in [0, last] {
        for (odd, beside) in [x.saturating_sub(1), (x + 1).min(last)].into_iter().enumerate() {
            if let Some(out) = out.get_mut(2 * x + odd) {
                *out = mix(near[x], near[beside], far[x], far[beside]);
            }
        }
    }
    let pairs = out.as_chunks_mut::<2>().0.iter_mut().skip(1);
    for ((near, far), pair) in near.windows(3).zip(far.windows(3)).zip(pairs) {
        *pair = [mix(near[1], near[0], far[1], far[0]), mix(near[1], near[2], far[1], far[2])];
    }
}

/// The correction of each window by its own sums and by what is there, which is what is known beforehand.
fn settle(sums: &Sums, part: f32, found: &mut Found) {
    settle_planes(sums.all(), part, found.planes_mut().map(Vec::as_mut_slice));
}

#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn settle_planes(sums: [&[f32]; Sums::PLANES], part: f32, [right, down, variance]: [&mut [f32]; 3]) {
    let [xx, xy, yy, x, y, misfit, noise, count, belief] = sums;
    for at in (0..variance.len()).step_by(SIDE_BY_SIDE) {
        let (xx, xy, yy, x, y) = (some(xx, at), some(xy, at), some(yy, at), some(x, at), some(y, at));
        let (misfit, noise, count, belief) = (some(misfit, at), some(noise, at), some(count, at), some(belief, at));
        let (mut to_right, mut to_down, mut to_variance) = (some(right, at), some(down, at), some(variance, at));
        for i in 0..SIDE_BY_SIDE {
            let before = Told { right: to_right[i], down: to_down[i], variance: to_variance[i] };
            let belief = belief[i] / count[i] / (part * part);
            // Gradients are believed as far as the truth is likely to be near. Where the network states an error of many pixels,
            // as in mere noise, what they say is chance, and makes much of the last digits of the vectors.
            let near = 1.0 - fading(0.5 * NEAR * NEAR * belief);
            // More difference than noise lets expect: moving things, light that changed, motion that is none. It weighs on
            // all.
            let trust = near / (misfit[i] / count[i]).max(1.0);
            let told = posterior([xx[i], xy[i], yy[i]], [x[i], y[i]], noise[i], trust, belief, before);
            let length = (told.right * told.right + told.down * told.down).sqrt();
            let shorter = if length > REACH { REACH / length } else { 1.0 };
            // Where nothing was seen, and where what was seen makes no number, that beforehand is all there is.
            let sound = (count[i] > 0.0) & (length < f32::INFINITY);
            to_right[i] = if sound { told.right * shorter } else { before.right };
            to_down[i] = if sound { told.down * shorter } else { before.down };
            to_variance[i] = if sound { told.variance } else { UNKNOWN };
        }
        put(to_right, right, at);
        put(to_down, down, at);
        put(to_variance, variance, at);
    }
}

/// One window's correction, or what is known of it beforehand.
#[derive(Clone, Copy)]
struct Told {
    right: f32,
    down: f32,
    variance: f32,
}

/// Mean and half of the covariance's trace, by the gradients' products, their pull, and what noise adds to the products, where the
/// window's correction is known beforehand to be `before` with the inverse variance `belief`, and `before` itself has a variance.
#[inline(always)]
fn posterior([xx, xy, yy]: [f32; 3], [x, y]: [f32; 2], noise: f32, trust: f32, belief: f32, before: Told) -> Told {
    let (middle, lean) = (0.5 * (xx + yy), 0.5 * (xx - yy));
    let apart = (lean * lean + xy * xy).sqrt();
    // The direction that is known best, by half its angle.
    let twice = if apart > 0.0 { lean / apart } else { 1.0 };
    let cosine = (0.5 * (1.0 + twice)).max(0.0).sqrt();
    let sine = (0.5 * (1.0 - twice)).max(0.0).sqrt();
    let sine = if xy < 0.0 { -sine } else { sine };
    let priors = (noise, trust, belief, before.variance);
    let best = (cosine * x + sine * y, cosine * before.right + sine * before.down);
    let worst = (cosine * y - sine * x, cosine * before.down - sine * before.right);
    let (best, of_best) = on_axis(middle + apart, best, priors);
    let (worst, of_worst) = on_axis(middle - apart, worst, priors);
    let variance = 0.5 * of_best + 0.5 * of_worst;
    Told { right: cosine * best - sine * worst, down: sine * best + cosine * worst, variance }
}

/// Mean and variance along one of the two directions that know nothing of each other.
#[inline(always)]
fn on_axis(
    information: f32,
    (pull, from): (f32, f32),
    (noise, trust, belief, unsure): (f32, f32, f32, f32),
) -> (f32, f32) {
    // Noise in the gradients meets noise in the difference, which gives pulls though nothing is known.
    let trust = if information > 0.0 { trust * information / (information + noise) } else { 0.0 };
    let known = information.max(0.0) * trust;
    let left = belief / (known + belief);
    ((pull * trust + belief * from) / (known + belief), 1.0 / (known + belief) + left * left * unsure)
}

/// e⁻ˣ of what is not negative, to 10⁻⁷: the system's is no loop over vectors, and that of [`lanes`](crate::flow::lanes) fuses products
/// where the machine can, so that machines differ.
#[inline(always)]
fn fading(x: f32) -> f32 {
    /// Adding it leaves whole numbers in the last digits.
    const WHOLE: f32 = 12_582_912.0;
    // Beyond, it is nothing beside one.
    let x = -x.min(80.0);
    let shifted = x * std::f32::consts::LOG2_E + WHOLE;
    let whole = shifted - WHOLE;
    // The logarithm of two in two parts, of which the first has few digits: none is lost.
    let rest = (x - whole * 0.693_359_4) + whole * 2.121_944_4e-4;
    let mut power = 1.0 / 5040.0;
    for term in [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        power = power * rest + term;
    }
    power * f32::from_bits((shifted.to_bits() << 23).wrapping_add(1.0f32.to_bits()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fades_does_so_as_the_exponential() {
        for step in 0..100_000 {
            let x = 0.001 * step as f32;
            let (found, expected) = (f64::from(fading(x)), (-f64::from(x.min(80.0))).exp());
            assert!((found - expected).abs() <= 1e-7 * expected, "{x}: {found}, expected {expected}");
        }
        assert_eq!(fading(0.0), 1.0);
    }

    /// Of the same values in every plane.
    fn sums([width, height]: [usize; 2]) -> Sums {
        let mut sums = Sums::default();
        sums.size([width, height]);
        let values = (0..width * height).map(|i| (1 + (i * 37) % 100) as f32 / 101.0);
        sums.planes = values.cycle().take(sums.planes.len()).collect();
        sums
    }

    #[test]
    fn windows_of_every_size_are_what_they_are_said_to_be() {
        for size in (1..9).flat_map(|width| (1..6).map(move |height| [width, height])) {
            let from = sums(size);
            let inside = |x: i32, y: i32| (0..size[0] as i32).contains(&x) && (0..size[1] as i32).contains(&y);
            let at = |x: i32, y: i32| f64::from(from.planes[y as usize * size[0] + x as usize]);
            let near = |x: i32, y: i32| at(x.clamp(0, size[0] as i32 - 1), y.clamp(0, size[1] as i32 - 1));
            let mut own = Sums::default();
            smooth(&from, &mut own);
            let mut levels = vec![];
            halve(&from, &mut levels);
            let half = &levels[0].sums;
            for (window, step, weights) in [(&own, 1, [1.0, 4.0, 6.0, 4.0, 1.0]), (half, 2, [0.0, 1.0, 3.0, 3.0, 1.0])]
            {
                let whole = if step == 1 { 36.0 } else { 16.0 };
                for cell in 0..window.cells() {
                    let (x, y) = ((cell % window.width) as i32 * step, (cell / window.width) as i32 * step);
                    let mut expected = 0.0;
                    for (j, i) in (-2..=2).flat_map(|j| (-2..=2).map(move |i| (j, i))) {
                        let weight = weights[(i + 2) as usize] * weights[(j + 2) as usize] / whole;
                        // A cell's own windows repeat the edge; of the larger ones' sums nothing may count twice.
                        if step == 1 || inside(x + i, y + j) {
                            expected += weight * near(x + i, y + j);
                        }
                    }
                    assert!(
                        (f64::from(window.planes[cell]) - expected).abs() < 1e-5,
                        "{size:?}, step {step}, cell {cell}"
                    );
                }
            }
        }
    }

    #[test]
    fn what_a_larger_window_found_is_bilinear_between_its_centres() {
        for size in (1..12).flat_map(|width| (1..6).map(move |height| [width, height])) {
            let smaller = sums(size);
            let mut larger = Level::default();
            larger.sums.size(size.map(|side: usize| side.div_ceil(2)));
            larger.found.begin(larger.sums.cells());
            // A plane is what it is between centres too, away from the edge, where it is continued flat.
            let (width, height) = (larger.sums.width, larger.sums.height);
            for cell in 0..width * height {
                larger.found.change[0][cell] = (cell % width) as f32;
                larger.found.change[1][cell] = (cell / width) as f32;
                larger.found.variance[cell] = 2.0;
            }
            let mut found = Found::default();
            found.begin(size[0] * size[1]);
            larger.widen(&smaller, &mut found);
            for cell in 0..size[0] * size[1] {
                let place = |at: usize, last: usize| (at as f32 / 2.0 - 0.25).clamp(0.0, last as f32);
                let expected = [place(cell % size[0], width - 1), place(cell / size[0], height - 1), 2.0];
                let came = found.planes().map(|plane| plane[cell]);
                assert!(
                    came.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6),
                    "{size:?}, {cell}: {came:?}, {expected:?}"
                );
            }
        }
    }

    #[test]
    fn where_nothing_is_seen_that_beforehand_stays_and_is_unsure() {
        let mut seen = sums([20, 1]);
        for plane in seen.planes.chunks_exact_mut(20) {
            plane[3] = 0.0;
            plane[17] = f32::NAN;
        }
        let mut found = Found::default();
        found.begin(20);
        found.change[0].fill(0.25);
        settle(&seen, LOCAL, &mut found);
        for cell in [3, 17] {
            assert_eq!((found.change[0][cell], found.change[1][cell], found.variance[cell]), (0.25, 0.0, UNKNOWN));
        }
        assert!(
            found.variance.iter().enumerate().all(|(cell, variance)| [3, 17].contains(&cell) || *variance < UNKNOWN)
        );
        assert!(found.change[0].iter().chain(&found.change[1]).all(|change| change.abs() <= REACH + 1e-6));
    }
}
