//! The robust fit of the displacement over distance, τ, to the flow vectors of one step.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix3x2, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{Config, Lack};

/// Where Tukey's weight ends, in standard deviations: 95 % efficient on Gaussian noise.
pub(super) const CUT: f64 = 4.685;
const ROUNDS: usize = 10;
const GUESSES: usize = 64;
/// Vectors that a guess is scored on.
const JURY: usize = 240;
/// Median length of a two-dimensional standard normal vector.
pub(super) const MEDIAN_LENGTH: f64 = 1.177_410_022_515_474_7;
/// The least spread in radians: a twentieth of a pixel, below which quantisation speaks.
pub(super) const SPREAD_MIN: f64 = 5e-5;

/// One flow vector with its turn taken off.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sight {
    /// On the older frame, (x, y) of the ray (x, y, 1).
    pub(super) older: [f64; 2],
    /// On the newer frame, turned back to the older frame's axes.
    pub(super) newer: [f64; 2],
    /// n·(x, y, 1): cosine to the ground's normal times the ray's length.
    pub(super) slope: f64,
    /// Inverse variance by the confidence, relative.
    pub(super) weight: f64,
    /// Vectors that were left out keep their place in the raster.
    pub(super) offered: bool,
    /// Length of the vector as it was seen, turn and all.
    pub(super) stretch: f64,
    pub(super) residual: [f64; 2],
    pub(super) agrees: bool,
}

impl Sight {
    fn rows(&self) -> Matrix2x3<f64> {
        let [x, y] = self.newer;
        Matrix2x3::new(-1.0, 0.0, x, 0.0, -1.0, y) * self.slope
    }

    fn motion(&self) -> Vector2<f64> {
        Vector2::new(self.newer[0] - self.older[0], self.newer[1] - self.older[1])
    }

    fn off(&self, tau: &Vector3<f64>) -> [f64; 2] {
        let [x, y] = self.newer;
        [self.motion().x - self.slope * (-tau.x + x * tau.z), self.motion().y - self.slope * (-tau.y + y * tau.z)]
    }

    fn length(&self) -> f64 {
        // Radians are far from overflow, and the root, unlike `hypot`, is exact to the bit on every machine.
        (self.residual[0] * self.residual[0] + self.residual[1] * self.residual[1]).sqrt()
    }
}

/// What the fit found, in the older frame's optical axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    /// Displacement of the camera over the distance to the ground.
    pub(super) tau: Vector3<f64>,
    /// Of `tau`, by the residuals.
    pub(super) covariance: Matrix3<f64>,
    /// Change of `tau` with an error of the turn that was taken off.
    pub(super) by_turn: Matrix3<f64>,
    /// Change of `tau` with a shift that all vectors share.
    pub(super) by_shift: Matrix3x2<f64>,
    /// Change of `tau` with an error of the normal.
    pub(super) by_normal: Matrix3<f64>,
    pub(super) samples: u32,
    pub(super) inliers: u32,
    /// Root mean square of the length of those that agree, as they were seen: what an error of the network's that grows
    /// with the displacement grows with.
    pub(super) stretch: f64,
}

/// The raster of vectors and its scratch memory, kept from step to step.
#[derive(Debug, Default)]
pub(super) struct Fit {
    /// Columns of the thinned raster.
    pub(super) columns: usize,
    /// The thinned raster, row by row.
    pub(super) sights: Vec<Sight>,
    scratch: Vec<f64>,
    /// Residuals over their spread, place by place; NaN where none agrees.
    scaled: Vec<[f64; 2]>,
    offered: Vec<u32>,
}

impl Fit {
    /// Fits τ to what stands in `sights`. The draws depend on `seed` alone.
    pub(super) fn solve(&mut self, config: &Config, seed: u64) -> Result<Found, Lack> {
        self.offered.clear();
        self.offered.extend((0u32..).zip(&self.sights).filter(|(_, sight)| sight.offered).map(|(i, _)| i));
        let samples = self.offered.len() as u32;
        let needed = config.inliers_min.max((f64::from(samples) * config.inlier_part_min).ceil() as u32);
        if samples < needed.max(2) {
            return Err(Lack::Disagreement { inliers: samples, samples, needed: needed.max(2) });
        }
        let mut tau = self.guess(config, seed).ok_or(Lack::Degenerate)?;
        let mut spread = self.measure(&tau, config, f64::INFINITY);
        for _ in 0..ROUNDS {
            let next = self.weigh(spread).ok_or(Lack::Degenerate)?;
            let moved = (next - tau).norm();
            tau = next;
            spread = self.measure(&tau, config, CUT * spread);
            if moved < 1e-12 {
                break;
            }
        }
        let inliers = self.mark(spread, config);
        if inliers < needed {
            return Err(Lack::Disagreement { inliers, samples, needed });
        }
        self.linearise(tau, spread, samples, inliers).ok_or(Lack::Degenerate)
    }

    /// The best of many motions through two vectors each, by the truncated sum of squares (MSAC).
    fn guess(&self, config: &Config, seed: u64) -> Option<Vector3<f64>> {
        let mut draws = ChaCha8Rng::seed_from_u64(seed);
        let stride = self.offered.len().div_ceil(JURY);
        let limit = config.seed_rad * config.seed_rad;
        let mut best: Option<(f64, Vector3<f64>)> = None;
        for _ in 0..GUESSES {
            let pick: [&Sight; 2] =
                std::array::from_fn(|_| &self.sights[self.offered[draws.random_range(0..self.offered.len())] as usize]);
            let Some(tau) = through(&pick) else { continue };
            let cost: f64 = self
                .offered
                .iter()
                .step_by(stride)
                .map(|i| {
                    let [x, y] = self.sights[*i as usize].off(&tau);
                    (x * x + y * y).min(limit)
                })
                .sum();
            if best.is_none_or(|(least, _)| cost < least) {
                best = Some((cost, tau));
            }
        }
        best.map(|(_, tau)| tau)
    }

    /// Residuals under `tau`, and their spread for a vector of weight 1 by the median over those within `cut`.
    fn measure(&mut self, tau: &Vector3<f64>, config: &Config, cut: f64) -> f64 {
        self.scratch.clear();
        for sight in self.sights.iter_mut().filter(|sight| sight.offered) {
            sight.residual = sight.off(tau);
            let length = sight.length();
            let scaled = length * sight.weight.sqrt();
            sight.agrees = length <= config.agree_rad_max;
            if sight.agrees && scaled <= cut {
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

    /// One round of weighted least squares under Tukey's weight.
    fn weigh(&self, spread: f64) -> Option<Vector3<f64>> {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for sight in self.sights.iter().filter(|sight| sight.offered && sight.agrees) {
            let weight = sight.weight * tukey(sight, spread);
            if weight > 0.0 {
                let rows = sight.rows();
                normal += rows.transpose() * rows * weight;
                right += rows.transpose() * sight.motion() * weight;
            }
        }
        Some(invert(&normal)? * right)
    }

    /// Marks and counts the vectors that agree.
    fn mark(&mut self, spread: f64, config: &Config) -> u32 {
        let mut inliers = 0;
        for sight in self.sights.iter_mut().filter(|sight| sight.offered) {
            sight.agrees = tukey(sight, spread) > 0.0 && sight.length() <= config.agree_rad_max;
            inliers += u32::from(sight.agrees);
        }
        inliers
    }

    /// The estimate's covariance by its own residuals (a sandwich: it holds where the confidences are wrong too), and
    /// its first-order change with everything that all vectors share.
    fn linearise(&mut self, tau: Vector3<f64>, spread: f64, samples: u32, inliers: u32) -> Option<Found> {
        let (mut slope, mut noise) = (Matrix3::zeros(), Matrix3::zeros());
        let (mut by_turn, mut by_shift, mut by_normal) = (Matrix3::zeros(), Matrix3x2::zeros(), Matrix3::zeros());
        let mut stretch = 0.0;
        for sight in self.sights.iter().filter(|sight| sight.offered && sight.agrees) {
            let rows = sight.rows();
            let bent = rows.transpose() * tukey_slope(sight, spread);
            slope += bent * rows;
            let pull = rows.transpose() * Vector2::from(sight.residual) * (sight.weight * tukey(sight, spread));
            noise += pull * pull.transpose();
            let [x, y] = sight.newer;
            by_turn += bent * Matrix2x3::new(-x * y, 1.0 + x * x, -y, -(1.0 + y * y), x * y, x);
            by_shift += bent;
            let (ox, oy) = (sight.older[0], sight.older[1]);
            let per_slope = Vector2::new(-tau.x + x * tau.z, -tau.y + y * tau.z);
            by_normal += bent * per_slope * Vector3::new(ox, oy, 1.0).transpose();
            stretch += sight.stretch * sight.stretch;
        }
        let inverse = invert(&slope)?;
        let count = f64::from(inliers);
        noise *= self.likeness() * count / (count - 1.5).max(1.0);
        Some(Found {
            tau,
            covariance: inverse * noise * inverse.transpose(),
            by_turn: inverse * by_turn,
            by_shift: inverse * by_shift,
            by_normal: inverse * by_normal,
            samples,
            inliers,
            stretch: (stretch / count).sqrt(),
        })
    }

    /// How many vectors stand for one independent vector: residuals that are alike carry no new knowledge.
    ///
    /// The sum of the residuals' autocorrelation over all distances, taken as separable along columns and rows. Each
    /// sum ends where the correlation first falls to zero (Geyer's initial positive sequence): a network's error is
    /// smooth over several cells and then ends, so that neither its nearest neighbours (as a first-order autoregression
    /// would have it, three times too many) nor blocks of the image (too few) say how far it reaches.
    fn likeness(&mut self) -> f64 {
        self.scaled.clear();
        self.scaled.extend(self.sights.iter().map(|sight| match sight.offered && sight.agrees {
            true => sight.residual.map(|off| off * sight.weight.sqrt()),
            false => [f64::NAN; 2],
        }));
        let rows = self.sights.len() / self.columns.max(1);
        let mut factor = 1.0;
        for (along_row, cells) in [(true, self.columns), (false, rows)] {
            let mut sum = 1.0;
            for lag in 1..cells {
                let correlation = if along_row { self.alike(lag, lag) } else { self.alike(lag * self.columns, 0) };
                if correlation <= 0.0 {
                    break;
                }
                sum += 2.0 * correlation * (1.0 - lag as f64 / cells as f64);
            }
            factor *= sum;
        }
        factor
    }

    /// Correlation of the residuals of vectors that lie `apart` places from each other in the raster; the last `edge`
    /// columns have no partner in their row.
    fn alike(&self, apart: usize, edge: usize) -> f64 {
        let (mut product, mut square) = (0.0, 0.0);
        let partners = self.scaled.get(apart..).unwrap_or_default();
        let both = self.scaled.chunks(self.columns).zip(partners.chunks(self.columns));
        for (here, there) in both {
            for ([ax, ay], [bx, by]) in here.iter().zip(there).take(self.columns - edge) {
                let pair = ax * bx + ay * by;
                if pair.is_finite() {
                    product += pair;
                    square += 0.5 * (ax * ax + ay * ay + bx * bx + by * by);
                }
            }
        }
        if square > 0.0 { product / square } else { 0.0 }
    }
}

/// Tukey's weight of a vector's residual, 0…1.
fn tukey(sight: &Sight, spread: f64) -> f64 {
    let part = sight.weight * sight.length().powi(2) / (CUT * spread).powi(2);
    if part < 1.0 { (1.0 - part).powi(2) } else { 0.0 }
}

/// Derivative of the weighted residual by the residual.
fn tukey_slope(sight: &Sight, spread: f64) -> Matrix2<f64> {
    let cut = (CUT * spread).powi(2);
    let part = sight.weight * sight.length().powi(2) / cut;
    if part >= 1.0 {
        return Matrix2::zeros();
    }
    let residual = Vector2::from(sight.residual);
    let bend = residual * residual.transpose() * (4.0 * (1.0 - part) * sight.weight / cut);
    (Matrix2::identity() * (1.0 - part).powi(2) - bend) * sight.weight
}

/// The motion through two vectors, by least squares over their four equations.
fn through(pick: &[&Sight; 2]) -> Option<Vector3<f64>> {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for sight in pick {
        let rows = sight.rows();
        normal += rows.transpose() * rows;
        right += rows.transpose() * sight.motion();
    }
    Some(invert(&normal)? * right)
}

/// The inverse, unless the matrix is singular beside its own size.
fn invert(matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let size = matrix.trace().abs() / 3.0;
    let regular = matrix.determinant().abs() > 1e-12 * size.powi(3);
    if regular { matrix.try_inverse() } else { None }
}
