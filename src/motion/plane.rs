//! The plane that two views are joined by: a homography fitted to the dense flow without the gyro's word, and how well
//! it is known.

use nalgebra::{Matrix2, Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::{
    Config, NoFlow,
    fit::{CUT, MEDIAN_LENGTH, SPREAD_MIN},
    lens::Lens,
    linear,
    thinned::{Rays, Thinned, weight},
};
use crate::flow::Flow;

/// The most vectors that are looked at: neighbours are alike, and what is asked of the plane needs no more.
const PAIRS_MAX: usize = 600;
/// Rounds that weigh by the inverse of the residual, which no start can lead astray, and then Tukey's.
const ROUNDS: [usize; 2] = [4, 3];
/// Numbers of a homography.
const UNKNOWNS: usize = 8;

/// One vector as rays (x, y, 1) of its two ends.
#[derive(Debug, Clone, Copy)]
struct Pair {
    from: [f64; 2],
    to: [f64; 2],
    /// Inverse variance by the confidence, relative.
    weight: f64,
    /// Its cell of the thinned raster.
    cell: usize,
    residual: [f64; 2],
    /// The residual's length, radians.
    off: f64,
}

/// The raster of vectors and its scratch memory, kept from step to step.
#[derive(Debug, Default)]
pub(super) struct Plane {
    /// Columns of the thinned raster.
    columns: usize,
    /// Rays of its cells.
    seen: Rays,
    pairs: Vec<Pair>,
    scratch: Vec<f64>,
    /// Residuals over their spread, cell by cell; NaN where none agrees.
    scaled: Vec<[f64; 2]>,
}

/// What the fit found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    /// Brings rays of the older frame to rays of the newer one, up to their length.
    pub(super) homography: Matrix3<f64>,
    /// The least and the greatest ray among those that agree.
    pub(super) sight: [[f64; 2]; 2],
    /// Root mean square of the length of those that agree.
    pub(super) stretch: f64,
    /// Deviation of a vector of weight 1.
    spread: f64,
}

impl Plane {
    /// Takes the vectors that may be used, evenly thinned.
    pub(super) fn look(&mut self, flow: &Flow<'_>, lens: &Lens, confidence_min: f64) {
        let raster = Thinned::to(flow.grid, PAIRS_MAX);
        self.seen.see(lens, raster);
        self.columns = raster.columns();
        self.pairs.clear();
        self.pairs.extend(raster.cells().zip(&self.seen.rays).enumerate().filter_map(|(cell, (place, ray))| {
            let ([u, v], confidence) = raster.seen(flow, place)?;
            if confidence < confidence_min {
                return None;
            }
            let [x, y] = raster.pixel(place);
            let to = lens.ray([x + u, y + v])?;
            let (from, weight) = (ray.as_ref()?.at, weight(confidence));
            Some(Pair { from, to, weight, cell, residual: [0.0; 2], off: 0.0 })
        }));
    }

    /// Iteratively re-weighted least squares: first towards the least sum of lengths, then under Tukey's weight.
    pub(super) fn solve(&mut self, config: &Config) -> Result<Found, NoFlow> {
        let samples = self.pairs.len() as u32;
        let needed = config.inliers_min.max((f64::from(samples) * config.inlier_part_min).ceil() as u32);
        if samples < needed {
            return Err(NoFlow::Disagreement { inliers: samples, samples, needed });
        }
        let mut homography = self.weigh(|_| 1.0).ok_or(NoFlow::Degenerate)?;
        let mut spread = self.measure(&homography, f64::INFINITY);
        for _ in 0..ROUNDS[0] {
            let floor = 0.1 * spread;
            homography =
                self.weigh(|pair| 1.0 / (pair.off * pair.weight.sqrt()).max(floor)).ok_or(NoFlow::Degenerate)?;
            spread = self.measure(&homography, f64::INFINITY);
        }
        let agrees = |pair: &Pair, spread: f64| pair.tukey(spread, config.agree_rad_max);
        for _ in 0..ROUNDS[1] {
            homography = self.weigh(|pair| agrees(pair, spread)).ok_or(NoFlow::Degenerate)?;
            spread = self.measure(&homography, CUT * spread);
        }
        let (mut inliers, mut squares) = (0, 0.0);
        let mut sight = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        for pair in &mut self.pairs {
            if agrees(pair, spread) == 0.0 {
                pair.weight = 0.0;
                continue;
            }
            inliers += 1;
            for (i, (from, to)) in pair.from.into_iter().zip(pair.to).enumerate() {
                squares += (to - from) * (to - from);
                sight[0][i] = sight[0][i].min(from);
                sight[1][i] = sight[1][i].max(from);
            }
        }
        if inliers < needed {
            return Err(NoFlow::Disagreement { inliers, samples, needed });
        }
        let stretch = (squares / f64::from(inliers)).sqrt();
        Ok(Found { homography, sight, stretch, spread })
    }

    /// One round of weighted least squares over x₂(h₆x + h₇y + 1) = h₀x + h₁y + h₂, and the same in y.
    fn weigh(&self, factor: impl Fn(&Pair) -> f64) -> Option<Matrix3<f64>> {
        // Upper triangles of the rays' squares: xx, xy, x, yy, y, 1; plain, and times x₂, y₂ and x₂² + y₂².
        let mut sums = [[0.0; 6]; 4];
        for pair in &self.pairs {
            let weight = pair.weight * factor(pair);
            let ([x, y], [x2, y2]) = (pair.from, pair.to);
            let square = [x * x, x * y, x, y * y, y, 1.0];
            for (sum, by) in sums.iter_mut().zip([weight, weight * x2, weight * y2, weight * (x2 * x2 + y2 * y2)]) {
                for (one, part) in sum.iter_mut().zip(square) {
                    *one += by * part;
                }
            }
        }
        let [plain, by_x, by_y, by_both] =
            sums.map(|[xx, xy, x, yy, y, one]| Matrix3::new(xx, xy, x, xy, yy, y, x, y, one));
        let mut normal = SMatrix::<f64, 8, 8>::zeros();
        normal.fixed_view_mut::<3, 3>(0, 0).copy_from(&plain);
        normal.fixed_view_mut::<3, 3>(3, 3).copy_from(&plain);
        for (row, by) in [(0, &by_x), (3, &by_y)] {
            let cross = -by.fixed_columns::<2>(0);
            normal.fixed_view_mut::<3, 2>(row, 6).copy_from(&cross);
            normal.fixed_view_mut::<2, 3>(6, row).copy_from(&cross.transpose());
        }
        normal.fixed_view_mut::<2, 2>(6, 6).copy_from(&by_both.fixed_view::<2, 2>(0, 0));
        let mut right = SVector::<f64, 8>::zeros();
        right.fixed_rows_mut::<3>(0).copy_from(&by_x.column(2));
        right.fixed_rows_mut::<3>(3).copy_from(&by_y.column(2));
        right.fixed_rows_mut::<2>(6).copy_from(&-by_both.fixed_view::<2, 1>(0, 2));
        let h = normal.cholesky()?.solve(&right);
        let homography = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0);
        homography.iter().all(|value| value.is_finite()).then_some(homography)
    }

    /// Covariance of where the fit that was just made brings the ray `at`, by its residuals and how alike they are: a
    /// sandwich, which holds where the confidences are wrong too. Noise so large that `agree_rad_max` cuts into it looks
    /// smaller than it is.
    pub(super) fn known(&mut self, found: &Found, at: [f64; 2]) -> Option<Matrix2<f64>> {
        let (mut slope, mut count) = (SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros(), 0.0);
        self.scaled.clear();
        self.scaled.resize(self.seen.rays.len(), [f64::NAN; 2]);
        for pair in self.pairs.iter().filter(|pair| pair.weight > 0.0) {
            let rows = rows(&found.homography, pair.from);
            slope += rows.transpose() * (pair.tukey_slope(found.spread) * rows);
            self.scaled[pair.cell] = pair.residual.map(|off| off * pair.weight.sqrt());
            count += 1.0;
        }
        let bend = rows(&found.homography, at) * linear::invert(&slope)?;
        let mut noise = Matrix2::zeros();
        for pair in self.pairs.iter().filter(|pair| pair.weight > 0.0) {
            let weight = pair.weight * pair.tukey(found.spread, f64::INFINITY);
            let pull =
                bend * (rows(&found.homography, pair.from).transpose() * (Vector2::from(pair.residual) * weight));
            noise += pull * pull.transpose();
        }
        let apparent = linear::likeness(&self.scaled, self.columns);
        Some(noise * linear::unfitted(apparent, count, UNKNOWNS))
    }

    /// Residuals, and their spread for a vector of weight 1 by the median over those within `cut`.
    fn measure(&mut self, homography: &Matrix3<f64>, cut: f64) -> f64 {
        self.scratch.clear();
        for pair in &mut self.pairs {
            let there = homography * Vector3::new(pair.from[0], pair.from[1], 1.0);
            let [x, y] = [there.x / there.z - pair.to[0], there.y / there.z - pair.to[1]];
            pair.residual = [x, y];
            pair.off = (x * x + y * y).sqrt();
            let scaled = pair.off * pair.weight.sqrt();
            if scaled <= cut {
                self.scratch.push(scaled);
            }
        }
        if self.scratch.is_empty() {
            return SPREAD_MIN;
        }
        let middle = self.scratch.len() / 2;
        let (_, median, _) = self.scratch.select_nth_unstable_by(middle, f64::total_cmp);
        (*median / MEDIAN_LENGTH).max(SPREAD_MIN)
    }
}

impl Pair {
    /// Tukey's weight, 0 beyond the cut.
    fn tukey(&self, spread: f64, agree_rad_max: f64) -> f64 {
        match self.weight * (self.off / (CUT * spread)).powi(2) {
            part if part < 1.0 && self.off <= agree_rad_max => (1.0 - part).powi(2),
            _ => 0.0,
        }
    }

    /// Derivative of the weighted residual by the residual.
    fn tukey_slope(&self, spread: f64) -> Matrix2<f64> {
        let cut = (CUT * spread).powi(2);
        let part = self.weight * self.off * self.off / cut;
        let residual = Vector2::from(self.residual);
        let bend = residual * residual.transpose() * (4.0 * (1.0 - part) * self.weight / cut);
        (Matrix2::identity() * (1.0 - part).powi(2) - bend) * self.weight
    }
}

/// Change of where a ray goes with the homography's eight numbers.
fn rows(homography: &Matrix3<f64>, [x, y]: [f64; 2]) -> SMatrix<f64, 2, UNKNOWNS> {
    let there = homography * Vector3::new(x, y, 1.0);
    let (u, v) = (there.x / there.z, there.y / there.z);
    let [a, b, c] = [x / there.z, y / there.z, 1.0 / there.z];
    SMatrix::from_row_slice(&[a, b, c, 0.0, 0.0, 0.0, -u * a, -u * b, 0.0, 0.0, 0.0, a, b, c, -v * a, -v * b])
}
