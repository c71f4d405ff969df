//! How the fit's result changes with whatever is uncertain, to first order: residuals and how alike they are, the turn, a
//! shift and a stretch of all vectors, the normal.

use nalgebra::{Matrix2x3, Matrix3, Matrix5, Matrix5x3, SMatrix, SVector, Vector3};

use super::fit::{Fit, Found, Motion, Sight};

/// By how much what gradients say is noisier than their residuals show: the information that they are weighed by is as noisy as the frames,
/// and of the same noise (`cargo bench --bench velocity`, Exp-6).
const HEARD: f64 = 1.15;

/// Correlation of what vectors and gradients of the same frames err by (`cargo bench --bench velocity`, Exp-6).
const COMMON: f64 = 0.5;

/// Three values that should agree contradict each other where the square of their difference over its covariance is larger: one time in
/// a thousand, by chance.
pub(super) const GATE: f64 = 16.3;

/// The turn that is left in the vectors: by how much what the gyro said is more than what they show.
#[derive(Debug, Clone, Copy)]
pub(super) struct Leftover {
    /// Radians, optical axes.
    pub(super) angle: Vector3<f64>,
    /// Inverse covariance, by the spread of the residuals.
    pub(super) information: Matrix3<f64>,
    /// The same two where the camera is taken not to have moved.
    pub(super) still: (Vector3<f64>, Matrix3<f64>),
    /// Covariance of `angle`, by the residuals themselves.
    pub(super) covariance: Matrix3<f64>,
    /// Covariance of the motion (τ, lean) with it.
    pub(super) with_motion: Matrix5x3<f64>,
    /// Its change with a shift (2) that all vectors share, and with a stretch.
    pub(super) by_shared: Matrix3<f64>,
    /// Its change with an error of the normal that was given.
    pub(super) by_normal: Matrix3<f64>,
}

/// Sums over the vectors that agree: slopes are second derivatives of the cost, noises the squares of its first.
struct Sums<const D: usize> {
    slope: SMatrix<f64, D, D>,
    slope_turn: Matrix3<f64>,
    noise: SMatrix<f64, D, D>,
    noise_turn: Matrix3<f64>,
    /// Of motion and turn.
    noise_both: SMatrix<f64, D, 3>,
    /// What each of these pulls the motion by, …
    by_turn: SMatrix<f64, D, 3>,
    by_normal: SMatrix<f64, D, 3>,
    by_shared: SMatrix<f64, D, 3>,
    /// … and the turn.
    turn_pull: Vector3<f64>,
    turn_by_normal: Matrix3<f64>,
    turn_by_shared: Matrix3<f64>,
    /// Sum of the squared lengths as they were seen.
    stretch: f64,
    count: f64,
}

impl<const D: usize> Sums<D> {
    fn over<'a>(sights: impl Iterator<Item = &'a Sight>, motion: &Motion, spread: f64) -> Self {
        let mut sums = Self {
            slope: SMatrix::zeros(),
            slope_turn: Matrix3::zeros(),
            noise: SMatrix::zeros(),
            noise_turn: Matrix3::zeros(),
            noise_both: SMatrix::zeros(),
            by_turn: SMatrix::zeros(),
            by_normal: SMatrix::zeros(),
            by_shared: SMatrix::zeros(),
            turn_pull: Vector3::zeros(),
            turn_by_normal: Matrix3::zeros(),
            turn_by_shared: Matrix3::zeros(),
            stretch: 0.0,
            count: 0.0,
        };
        for sight in sights {
            let (rows, turned) = (sight.rows::<D>(motion), sight.turned());
            let by = sight.pull_slope(spread);
            let (bent, bent_turn) = (rows.transpose() * by, turned.transpose() * by);
            let weighted = sight.pull(spread);
            let pull: SVector<f64, D> = rows.transpose() * weighted;
            let pull_turn = turned.transpose() * weighted;
            let [x, y] = sight.older;
            let shared = Matrix2x3::new(1.0, 0.0, x, 0.0, 1.0, y);
            let slanted = sight.per_slope(&motion.tau) * Vector3::new(x, y, 1.0).transpose();
            sums.slope += bent * rows;
            sums.slope_turn += bent_turn * turned;
            sums.noise += pull * pull.transpose();
            sums.noise_turn += pull_turn * pull_turn.transpose();
            sums.noise_both += pull * pull_turn.transpose();
            sums.by_turn += bent * turned;
            sums.by_normal += bent * slanted;
            sums.by_shared += bent * shared;
            sums.turn_pull += pull_turn;
            sums.turn_by_normal += bent_turn * slanted;
            sums.turn_by_shared += bent_turn * shared;
            sums.stretch += sight.stretch * sight.stretch;
            sums.count += 1.0;
        }
        sums
    }

    /// The turn that is left, where the motion is fitted beside it; `inverse` is that of `slope`.
    fn leftover(&self, inverse: &SMatrix<f64, D, D>, tau: &Vector3<f64>, variance: f64) -> Option<Leftover> {
        let by_turn = inverse * self.by_turn;
        let apart = self.slope_turn - self.by_turn.transpose() * by_turn;
        let (moving, still) = invert(&apart).zip(invert(&self.slope_turn))?;
        let moved = self.by_turn.fixed_view::<3, 3>(0, 0).transpose() * tau;
        let both = self.noise_both - self.noise * by_turn;
        let noise = self.noise_turn - self.noise_both.transpose() * by_turn - by_turn.transpose() * both;
        let with_motion = inverse * both * moving;
        Some(Leftover {
            angle: moving * self.turn_pull,
            information: apart / variance,
            still: (still * (self.turn_pull + moved), self.slope_turn / variance),
            covariance: moving * noise * moving.transpose(),
            with_motion: Matrix5x3::from_fn(|i, j| if i < D { with_motion[(i, j)] } else { 0.0 }),
            by_shared: moving * (self.turn_by_shared - by_turn.transpose() * self.by_shared),
            by_normal: moving * (self.turn_by_normal - by_turn.transpose() * self.by_normal),
        })
    }
}

/// Two words on the same.
#[derive(Clone, Copy)]
struct Mean {
    /// How much the first counts.
    part: f64,
    /// How much more the second scatters.
    wider: f64,
}

impl Mean {
    fn of<const R: usize, const C: usize>(self, a: &SMatrix<f64, R, C>, b: &SMatrix<f64, R, C>) -> SMatrix<f64, R, C> {
        a * self.part + b * (1.0 - self.part)
    }

    /// Of covariances.
    fn noise<const R: usize, const C: usize>(
        self,
        a: &SMatrix<f64, R, C>,
        b: &SMatrix<f64, R, C>,
    ) -> SMatrix<f64, R, C> {
        let (first, second) = (self.part, 1.0 - self.part);
        let both = COMMON * first * second;
        a * (first * first + both * self.wider) + b * (second * second + both / self.wider)
    }
}

impl Leftover {
    fn beside(&self, other: &Leftover, mean: Mean) -> Leftover {
        Leftover {
            angle: mean.of(&self.angle, &other.angle),
            covariance: mean.noise(&self.covariance, &other.covariance),
            with_motion: mean.noise(&self.with_motion, &other.with_motion),
            by_shared: mean.of(&self.by_shared, &other.by_shared),
            by_normal: mean.of(&self.by_normal, &other.by_normal),
            ..*self
        }
    }
}

impl Found {
    /// What gradients found beside what the vectors of the same frames did, each by how little it scatters; what vectors err by together,
    /// `shared` (rad), their scatter doesn't show. In good light gradients know nearly everything; in noise the network knows what a
    /// cell's gradients don't.
    pub(super) fn beside(&self, seen: &Found, shared: f64) -> Found {
        let scatter = |found: &Found| found.covariance.fixed_view::<3, 3>(0, 0).trace();
        let vectors = scatter(seen) + 2.0 * shared * shared;
        let part = vectors / (scatter(self) + vectors);
        let wider = (scatter(seen) / scatter(self)).sqrt();
        // Where either scatters by nothing at all there is nothing to weigh.
        if !part.is_finite() || !(1e-3..1e3).contains(&wider) {
            return *self;
        }
        let mean = Mean { part, wider };
        let lean = |i: usize| part * self.lean[i] + (1.0 - part) * seen.lean[i];
        Found {
            tau: mean.of(&self.tau, &seen.tau),
            lean: [lean(0), lean(1)],
            covariance: mean.noise(&self.covariance, &seen.covariance),
            by_turn: mean.of(&self.by_turn, &seen.by_turn),
            by_shared: mean.of(&self.by_shared, &seen.by_shared),
            by_normal: mean.of(&self.by_normal, &seen.by_normal),
            leftover: match (&self.leftover, &seen.leftover) {
                (Some(a), Some(b)) => Some(a.beside(b, mean)),
                (a, _) => *a,
            },
            ..*self
        }
    }
}

impl Fit {
    /// The estimate's covariance by its own residuals (a sandwich: it holds where the confidences are wrong too), and
    /// its change with everything that all vectors share. `lean_sd` is how well the normal was known, where it is
    /// fitted (D is 5).
    pub(super) fn linearise<const D: usize>(
        &mut self,
        motion: &Motion,
        spread: f64,
        lean_sd: Option<f64>,
    ) -> Option<Found> {
        let agreed = self.sights.iter().filter(|sight| sight.offered && sight.agrees);
        let mut sums = Sums::<D>::over(agreed, motion, spread);
        let by_gradients = self.sights.iter().any(|sight| sight.said.is_some());
        let likeness = unfitted(self.likeness(spread), sums.count, D) * if by_gradients { HEARD } else { 1.0 };
        let unit = self.unit(spread);
        sums.noise *= likeness;
        sums.noise_turn *= likeness;
        sums.noise_both *= likeness;
        if let Some(sd) = lean_sd {
            let prior = likeness * unit / (sd * sd);
            for axis in 3..D {
                sums.slope[(axis, axis)] += prior;
                sums.noise[(axis, axis)] += (prior * sd).powi(2);
            }
        }
        let inverse = invert(&sums.slope)?;
        let leftover = sums.leftover(&inverse, &motion.tau, likeness * unit);
        let found = inverse * sums.noise * inverse.transpose();
        let (by_turn, by_shared, by_normal) =
            (inverse * sums.by_turn, inverse * sums.by_shared, inverse * sums.by_normal);
        let given = lean_sd.is_none();
        Some(Found {
            tau: motion.tau,
            lean: motion.lean,
            covariance: Matrix5::from_fn(|i, j| if i < D && j < D { found[(i, j)] } else { 0.0 }),
            by_turn: Matrix5x3::from_fn(|i, j| if i < D { by_turn[(i, j)] } else { 0.0 }),
            by_shared: Matrix5x3::from_fn(|i, j| if i < D { by_shared[(i, j)] } else { 0.0 }),
            by_normal: Matrix3::from_fn(|i, j| if given { by_normal[(i, j)] } else { 0.0 }),
            leftover,
            by_gradients,
            samples: 0,
            inliers: 0,
            spread,
            stretch: (sums.stretch / f64::max(sums.count, 1.0)).sqrt(),
        })
    }

    /// How many vectors stand for one independent vector.
    pub(super) fn likeness(&mut self, spread: f64) -> f64 {
        self.scaled.clear();
        self.scaled.extend(self.sights.iter().map(|sight| match (sight.offered && sight.agrees, &sight.said) {
            (true, None) => sight.residual.map(|off| off * sight.weight.sqrt()),
            // As it is: it is the strong ones that count, and that must not be alike.
            (true, Some(_)) => sight.pull(spread).into(),
            (false, _) => [f64::NAN; 2],
        }));
        likeness(&self.scaled, self.columns)
    }

    /// The variance of a residual over what its weight says: for vectors the spread's square, for what gradients say, which know their own
    /// noise, by how much the square of a pull is more than the information.
    pub(super) fn unit(&self, spread: f64) -> f64 {
        let (mut squares, mut expected) = (0.0, 0.0);
        for sight in self.sights.iter().filter(|sight| sight.offered && sight.agrees) {
            if let Some(said) = &sight.said {
                squares += sight.pull(spread).norm_squared();
                expected += said.information.trace();
            }
        }
        if expected > 0.0 { squares / expected } else { spread * spread }
    }
}

/// How many vectors of a raster stand for one independent vector: residuals that are alike carry no new knowledge.
/// `scaled` are residuals over their spread, row by row, NaN where none agrees.
///
/// The sum of the residuals' autocorrelation over all distances, taken as separable along columns and rows. Each
/// sum ends where the correlation first falls to zero (Geyer's initial positive sequence): a network's error is
/// smooth over several cells and then ends, so that neither its nearest neighbours (as a first-order autoregression
/// would have it, three times too many) nor blocks of the image (too few) say how far it reaches.
pub(super) fn likeness(scaled: &[[f64; 2]], columns: usize) -> f64 {
    let rows = scaled.len() / columns.max(1);
    let mut factor = 1.0;
    for (along_row, cells) in [(true, columns), (false, rows)] {
        let mut sum = 1.0;
        for lag in 1..cells {
            let [apart, edge] = if along_row { [lag, lag] } else { [lag * columns, 0] };
            let correlation = alike(scaled, columns, apart, edge);
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
fn alike(scaled: &[[f64; 2]], columns: usize, apart: usize, edge: usize) -> f64 {
    let (mut product, mut square) = (0.0, 0.0);
    let partners = scaled.get(apart..).unwrap_or_default();
    for (here, there) in scaled.chunks(columns).zip(partners.chunks(columns)) {
        for ([ax, ay], [bx, by]) in here.iter().zip(there).take(columns - edge) {
            let pair = ax * bx + ay * by;
            if pair.is_finite() {
                product += pair;
                square += 0.5 * (ax * ax + ay * ay + bx * bx + by * by);
            }
        }
    }
    if square > 0.0 { product / square } else { 0.0 }
}

/// The likeness of `count` vectors' errors where that of their residuals is `apparent`.
///
/// Of twice as many equations as there are independent vectors the fit used up its unknowns. A fit follows what is
/// smooth: the residuals are smaller by that part, and the sums of their correlations along columns and rows too.
pub(super) fn unfitted(apparent: f64, count: f64, unknowns: usize) -> f64 {
    let independent = count / apparent;
    apparent * (independent / f64::max(independent - 0.5 * unknowns as f64, 1.0)).powi(3)
}

/// The inverse, unless the matrix is singular beside its own size.
pub(super) fn invert<const D: usize>(matrix: &SMatrix<f64, D, D>) -> Option<SMatrix<f64, D, D>> {
    let inverse = matrix.try_inverse()?;
    // Each unknown on its own scale: how much of what is known about it is left once the others are unknown too.
    let known = (0..D).all(|axis| matrix[(axis, axis)] * inverse[(axis, axis)] < 1e9);
    known.then_some(inverse)
}
