//! The robust fit of the displacement over distance, τ, to the flow vectors of one step; of the ground's normal too
//! where nobody knows it.

use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix5, Matrix5x3, SMatrix, SVector, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{
    Config, Lack,
    linear::{self, Leftover},
};

/// Where Tukey's weight ends, in standard deviations: 95 % efficient on Gaussian noise.
pub(super) const CUT: f64 = 4.685;
const ROUNDS: usize = 10;
const GUESSES: usize = 64;
/// From where the vectors agreed it is not far.
const ROUNDS_OF_GRADIENTS: usize = 2;
/// Guesses where the normal has to be guessed too.
const GUESSES_OF_NORMAL: usize = 256;
/// Rounds in which the normal is fitted; unlike τ it is not linear.
const ROUNDS_OF_NORMAL: usize = 20;
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
    /// The same for the two directions that the normal may lean to; 0 where the normal is given.
    pub(super) lean: [f64; 2],
    /// Inverse variance by the confidence, relative.
    pub(super) weight: f64,
    /// Vectors that were left out keep their place in the raster.
    pub(super) offered: bool,
    /// Length of the vector as it was seen, turn and all.
    pub(super) stretch: f64,
    pub(super) residual: [f64; 2],
    pub(super) agrees: bool,
    /// What the frames' gradients say of the vector; where it stands, `weight` only says what is an outlier.
    pub(super) said: Option<Said>,
}

/// A vector's likelihood by its cell's gradients, along the ray's x and y: see [`crate::flow::Gradients`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Said {
    pub(super) information: Matrix2<f64>,
    pub(super) pull: Vector2<f64>,
}

/// What is looked for.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Motion {
    /// Displacement of the camera over the distance to the ground.
    pub(super) tau: Vector3<f64>,
    /// How far the normal leans from the one that was given.
    pub(super) lean: [f64; 2],
}

impl Motion {
    fn add<const D: usize>(&mut self, step: &SVector<f64, D>) {
        for (axis, value) in step.iter().enumerate() {
            match axis {
                0..3 => self.tau[axis] += value,
                _ => self.lean[axis - 3] += value,
            }
        }
    }
}

impl Sight {
    fn slope(&self, motion: &Motion) -> f64 {
        self.slope + self.lean[0] * motion.lean[0] + self.lean[1] * motion.lean[1]
    }

    /// What the vector would be on a plane at distance 1 that is looked at squarely.
    pub(super) fn per_slope(&self, tau: &Vector3<f64>) -> Vector2<f64> {
        let [x, y] = self.newer;
        Vector2::new(-tau.x + x * tau.z, -tau.y + y * tau.z)
    }

    /// Change of the vector with τ, and with the normal's lean where D is 5.
    pub(super) fn rows<const D: usize>(&self, motion: &Motion) -> SMatrix<f64, 2, D> {
        let ([x, y], slope) = (self.newer, self.slope(motion));
        let off = self.per_slope(&motion.tau);
        SMatrix::from_fn(|row, column| match (row, column) {
            (0, 0) | (1, 1) => -slope,
            (0, 2) => x * slope,
            (1, 2) => y * slope,
            (_, 3..) => off[row] * self.lean[column - 3],
            _ => 0.0,
        })
    }

    /// Change of the vector with an error of the turn that was taken off, optical axes.
    pub(super) fn turned(&self) -> Matrix2x3<f64> {
        let [x, y] = self.newer;
        Matrix2x3::new(-x * y, 1.0 + x * x, -y, -(1.0 + y * y), x * y, x)
    }

    fn off(&self, motion: &Motion) -> [f64; 2] {
        let (slope, by) = (self.slope(motion), self.per_slope(&motion.tau));
        [self.newer[0] - self.older[0] - slope * by.x, self.newer[1] - self.older[1] - slope * by.y]
    }

    pub(super) fn length(&self) -> f64 {
        // Radians are far from overflow, and the root, unlike `hypot`, is exact to the bit on every machine.
        (self.residual[0] * self.residual[0] + self.residual[1] * self.residual[1]).sqrt()
    }

    /// The square of the residual over that at which Tukey's weight ends.
    fn part(&self, spread: f64) -> f64 {
        self.weight * self.length().powi(2) / (CUT * spread).powi(2)
    }

    /// Tukey's weight of the residual, 0…1; of what gradients say, 1 where the vector agrees.
    pub(super) fn tukey(&self, spread: f64) -> f64 {
        match &self.said {
            // In full or not at all: a vector's residual is its own noise in part, and what weighs the same noise by it would pass for
            // knowing more.
            Some(_) => f64::from(u8::from(self.agrees)),
            None => (1.0 - self.part(spread)).max(0.0).powi(2),
        }
    }

    /// What the vector pulls a motion by, on the ray's axes: its residual by its weight.
    pub(super) fn pull(&self, spread: f64) -> Vector2<f64> {
        let (residual, kept) = (Vector2::from(self.residual), self.tukey(spread));
        match &self.said {
            Some(said) => (said.pull + said.information * residual) * kept,
            None => residual * (self.weight * kept),
        }
    }

    /// Derivative of the pull by the residual; what gradients say is taken to keep its weight.
    pub(super) fn pull_slope(&self, spread: f64) -> Matrix2<f64> {
        if let Some(said) = &self.said {
            return said.information * self.tukey(spread);
        }
        let part = self.part(spread);
        if part >= 1.0 {
            return Matrix2::zeros();
        }
        let (residual, cut) = (Vector2::from(self.residual), (CUT * spread).powi(2));
        let bend = residual * residual.transpose() * (4.0 * (1.0 - part) * self.weight / cut);
        (Matrix2::identity() * (1.0 - part).powi(2) - bend) * self.weight
    }
}

/// The motion that most vectors agree on, and how well.
#[derive(Debug, Clone, Copy)]
pub(super) struct Agreed {
    pub(super) motion: Motion,
    /// Of a vector of weight 1, radians.
    pub(super) spread: f64,
    pub(super) samples: u32,
    pub(super) inliers: u32,
}

/// What the fit found, in the older frame's optical axes. Where the normal was given, what concerns its lean is 0.
#[derive(Debug, Clone, Copy)]
pub(super) struct Found {
    /// Displacement of the camera over the distance to the ground.
    pub(super) tau: Vector3<f64>,
    /// How far the normal leans from the one that was given, before it is made a unit again.
    pub(super) lean: [f64; 2],
    /// Of `tau` and `lean`, by the residuals.
    pub(super) covariance: Matrix5<f64>,
    /// Change of both with an error of the turn that was taken off.
    pub(super) by_turn: Matrix5x3<f64>,
    /// Change of both with a shift (2) that all vectors share, and with a stretch: (x, y) of the ray.
    pub(super) by_shared: Matrix5x3<f64>,
    /// Change of `tau` with an error of the normal that was given.
    pub(super) by_normal: Matrix3<f64>,
    /// The turn that is left in the vectors, where they tell it apart from the motion.
    pub(super) leftover: Option<Leftover>,
    /// Whether gradients had the last word.
    pub(super) by_gradients: bool,
    pub(super) samples: u32,
    pub(super) inliers: u32,
    /// Of a vector of weight 1, radians.
    pub(super) spread: f64,
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
    pub(super) scaled: Vec<[f64; 2]>,
    offered: Vec<u32>,
}

impl Fit {
    /// Fits τ to what stands in `sights`, and the normal's lean where it is not known better than `lean_sd`. The draws
    /// depend on `seed` alone.
    pub(super) fn solve(&mut self, config: &Config, lean_sd: Option<f64>, seed: u64) -> Result<Agreed, Lack> {
        self.offered.clear();
        self.offered.extend((0u32..).zip(&self.sights).filter(|(_, sight)| sight.offered).map(|(i, _)| i));
        let samples = self.offered.len() as u32;
        let needed = config.inliers_min.max((f64::from(samples) * config.inlier_part_min).ceil() as u32);
        if samples < needed.max(2) {
            return Err(Lack::Disagreement { inliers: samples, samples, needed: needed.max(2) });
        }
        let guess = self.guess(config, lean_sd, seed).ok_or(Lack::Degenerate)?;
        let (motion, spread) = match lean_sd {
            None => self.refine::<3>(guess, config, None, ROUNDS),
            Some(_) => self.refine::<5>(guess, config, lean_sd, ROUNDS_OF_NORMAL),
        }
        .ok_or(Lack::Degenerate)?;
        let inliers = self.mark(spread, config);
        if inliers < needed {
            return Err(Lack::Disagreement { inliers, samples, needed });
        }
        Ok(Agreed { motion, spread, samples, inliers })
    }

    /// What the vectors that agreed make of it.
    pub(super) fn conclude(&mut self, agreed: &Agreed, lean_sd: Option<f64>) -> Option<Found> {
        let Agreed { motion, spread, samples, inliers } = *agreed;
        let found = match lean_sd {
            None => self.linearise::<3>(&motion, spread, None),
            Some(_) => self.linearise::<5>(&motion, spread, lean_sd),
        };
        found.map(|found| Found { samples, inliers, ..found })
    }

    /// What gradients make of it, whose cells stand in `sights`, from what the vectors agreed on; `None` where they say too little.
    ///
    /// A vector is what its cell and the cells around it say together, and all vectors count alike. Here every cell has its own word,
    /// by its texture, along an edge nothing: the likelihood's maximum over the cells whose vectors agree.
    pub(super) fn by_gradients(&mut self, agreed: &Agreed, config: &Config, lean_sd: Option<f64>) -> Option<Found> {
        let mut agreed = *agreed;
        self.residuals(&agreed.motion);
        self.mark(agreed.spread, config);
        for _ in 0..ROUNDS_OF_GRADIENTS {
            let prior = lean_sd.map_or(0.0, |sd| self.likeness(agreed.spread) * self.unit(agreed.spread) / (sd * sd));
            match lean_sd {
                None => agreed.motion.add(&self.advance::<3>(&agreed.motion, agreed.spread, prior)?),
                Some(_) => agreed.motion.add(&self.advance::<5>(&agreed.motion, agreed.spread, prior)?),
            }
            self.residuals(&agreed.motion);
        }
        self.conclude(&agreed, lean_sd)
    }

    /// Iteratively re-weighted least squares from a guess, and the spread that it ends with.
    fn refine<const D: usize>(
        &mut self,
        guess: Motion,
        config: &Config,
        lean_sd: Option<f64>,
        rounds: usize,
    ) -> Option<(Motion, f64)> {
        let mut motion = guess;
        let mut spread = self.measure(&motion, config, f64::INFINITY);
        for _ in 0..rounds {
            let prior = lean_sd.map_or(0.0, |sd| self.likeness(spread) * (spread / sd).powi(2));
            let step = self.advance::<D>(&motion, spread, prior)?;
            motion.add(&step);
            spread = self.measure(&motion, config, CUT * spread);
            if step.norm() < 1e-12 {
                break;
            }
        }
        Some((motion, spread))
    }

    /// The best of many motions through two vectors each, by the truncated sum of squares (MSAC); over a normal that is
    /// drawn where it is not known.
    fn guess(&self, config: &Config, lean_sd: Option<f64>, seed: u64) -> Option<Motion> {
        let mut draws = ChaCha8Rng::seed_from_u64(seed);
        let stride = self.offered.len().div_ceil(JURY);
        let limit = config.seed_rad * config.seed_rad;
        let mut best: Option<(f64, Motion)> = None;
        for _ in 0..if lean_sd.is_some() { GUESSES_OF_NORMAL } else { GUESSES } {
            let pick: [&Sight; 2] =
                std::array::from_fn(|_| &self.sights[self.offered[draws.random_range(0..self.offered.len())] as usize]);
            let lean =
                lean_sd.map_or([0.0; 2], |sd| std::array::from_fn(|_| 2.0 * sd * (2.0 * draws.random::<f64>() - 1.0)));
            let Some(motion) = through(&pick, lean) else { continue };
            let cost: f64 = self
                .offered
                .iter()
                .step_by(stride)
                .map(|i| {
                    let [x, y] = self.sights[*i as usize].off(&motion);
                    (x * x + y * y).min(limit)
                })
                .sum();
            if best.is_none_or(|(least, _)| cost < least) {
                best = Some((cost, motion));
            }
        }
        best.map(|(_, motion)| motion)
    }

    /// Residuals under `motion`, and their spread for a vector of weight 1 by the median over those within `cut`.
    fn measure(&mut self, motion: &Motion, config: &Config, cut: f64) -> f64 {
        self.scratch.clear();
        for sight in self.sights.iter_mut().filter(|sight| sight.offered) {
            sight.residual = sight.off(motion);
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

    /// One round of weighted least squares under Tukey's weight; `prior` holds the lean to 0.
    fn advance<const D: usize>(&self, motion: &Motion, spread: f64, prior: f64) -> Option<SVector<f64, D>> {
        let (mut normal, mut right) = (SMatrix::<f64, D, D>::zeros(), SVector::<f64, D>::zeros());
        for sight in self.sights.iter().filter(|sight| sight.offered && sight.agrees) {
            let kept = sight.tukey(spread);
            if kept > 0.0 {
                let rows = sight.rows::<D>(motion);
                let by = sight.said.map_or(Matrix2::identity() * sight.weight, |said| said.information) * kept;
                normal += rows.transpose() * by * rows;
                right += rows.transpose() * sight.pull(spread);
            }
        }
        for axis in 3..D {
            normal[(axis, axis)] += prior;
            right[axis] -= prior * motion.lean[axis - 3];
        }
        Some(linear::invert(&normal)? * right)
    }

    /// Residuals under `motion`.
    fn residuals(&mut self, motion: &Motion) {
        self.sights.iter_mut().filter(|sight| sight.offered).for_each(|sight| sight.residual = sight.off(motion));
    }

    /// Marks and counts the vectors that agree.
    fn mark(&mut self, spread: f64, config: &Config) -> u32 {
        let mut inliers = 0;
        for sight in self.sights.iter_mut().filter(|sight| sight.offered) {
            sight.agrees = sight.part(spread) < 1.0 && sight.length() <= config.agree_rad_max;
            inliers += u32::from(sight.agrees);
        }
        inliers
    }
}

/// The motion through two vectors, by least squares over their four equations.
fn through(pick: &[&Sight; 2], lean: [f64; 2]) -> Option<Motion> {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    let still = Motion { tau: Vector3::zeros(), lean };
    for sight in pick {
        let rows = sight.rows::<3>(&still);
        normal += rows.transpose() * rows;
        right += rows.transpose() * Vector2::from(sight.off(&still));
    }
    Some(Motion { tau: linear::invert(&normal)? * right, lean })
}
