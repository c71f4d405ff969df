//! The direction of motion: where all vectors of what stands still come from, the focus of expansion.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::cell::Cell;
use crate::motion::fit::{CUT, SPREAD_MIN};

/// Directions through two vectors each that are tried.
const GUESSES: usize = 64;
/// Cells that a guess is scored on.
const JURY: usize = 300;
const ROUNDS: usize = 8;
/// Median of a standard normal's absolute value.
pub(super) const MEDIAN_ABS: f64 = 0.674_489_750_196_081_7;
/// No heading is taken as known better than this, radians: mounts and gyros are not.
const FLOOR_RAD: f64 = 0.005;

/// Where the camera moves.
#[derive(Debug, Clone, Copy)]
pub(super) struct Heading {
    /// Unit vector, optical axes of the older frame.
    pub(super) direction: Vector3<f64>,
    /// The two directions in which it may be off.
    pub(super) tangents: [Vector3<f64>; 2],
    /// rad² along the tangents.
    pub(super) covariance: Matrix2<f64>,
    /// Deviation of a vector of weight 1 across its line, radians.
    pub(super) spread: f64,
}

/// What earlier steps knew, body axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Memory {
    pub(super) direction: Vector3<f64>,
    /// Inverse covariance, 1/rad².
    pub(super) information: Matrix3<f64>,
}

/// What the search has to go by.
pub(super) struct Search<'a> {
    /// Directions that are tried beside the drawn ones, optical axes.
    pub(super) candidates: [Option<Vector3<f64>>; 2],
    /// What earlier steps knew, optical axes.
    pub(super) memory: Option<Memory>,
    /// A vector agrees with a guess within this.
    pub(super) seed_rad: f64,
    /// Cells for one independent vector.
    pub(super) likeness: f64,
    /// Error that all vectors share, radians.
    pub(super) shared_rad: f64,
    pub(super) draws: u64,
    pub(super) cells: &'a [Cell],
}

impl Heading {
    /// The largest deviation in any direction, radians.
    pub(super) fn sd(&self) -> f64 {
        self.covariance.symmetric_eigenvalues().max().max(0.0).sqrt()
    }

    /// What the next step shall know of it: `turn` brings these optical axes to the newer body's.
    pub(super) fn remember(&self, turn: &Matrix3<f64>) -> Option<Memory> {
        let known = self.covariance.try_inverse()?;
        let [a, b] = self.tangents.map(|tangent| turn * tangent);
        let mut information = Matrix3::zeros();
        for (i, one) in [a, b].iter().enumerate() {
            for (j, other) in [a, b].iter().enumerate() {
                information += one * other.transpose() * known[(i, j)];
            }
        }
        Some(Memory { direction: turn * self.direction, information })
    }
}

impl Memory {
    /// The same in other axes, and faded.
    pub(super) fn turned(&self, turn: &Matrix3<f64>, fading: f64) -> Memory {
        let information = turn * self.information * turn.transpose() * fading;
        Memory { direction: turn * self.direction, information }
    }
}

impl Search<'_> {
    fn offered(&self) -> impl Iterator<Item = &Cell> {
        self.cells.iter().filter(|cell| cell.seen)
    }

    /// The heading, or none where no cell is seen. `order` and `lengths` are scratch memory.
    pub(super) fn run(&self, order: &mut Vec<u32>, lengths: &mut Vec<f64>) -> Option<Heading> {
        order.clear();
        order.extend((0u32..).zip(self.cells).filter(|(_, cell)| cell.seen).map(|(i, _)| i));
        let mut direction = self.guess(order)?;
        if self.votes(&direction) < 0.0 {
            direction = -direction;
        }
        let mut spread = self.spread(&direction, f64::INFINITY, lengths);
        // A memory that points the other way is of another flight.
        let memory = self.memory.filter(|memory| memory.direction.dot(&direction) > 0.0);
        let mut covariance = None;
        for _ in 0..ROUNDS {
            let tangents = tangents(&direction);
            let (slope, pull) = self.normal(&direction, &tangents, spread, memory.as_ref());
            covariance = slope.try_inverse();
            let step = covariance? * pull;
            direction = (direction + tangents[0] * step.x + tangents[1] * step.y).normalize();
            spread = self.spread(&direction, CUT * spread, lengths);
            if step.norm() < 1e-9 {
                break;
            }
        }
        let floor = Matrix2::identity() * FLOOR_RAD.powi(2);
        Some(Heading { direction, tangents: tangents(&direction), covariance: covariance? + floor, spread })
    }

    /// The best of many directions by the truncated sum of squares (MSAC).
    fn guess(&self, order: &[u32]) -> Option<Vector3<f64>> {
        if order.len() < 2 {
            return None;
        }
        let mut draws = ChaCha8Rng::seed_from_u64(self.draws);
        let mut pick = || self.cells[order[draws.random_range(0..order.len())] as usize];
        let drawn = (0..GUESSES).filter_map(|_| {
            let [a, b] = [line(&pick()), line(&pick())];
            a.cross(&b).try_normalize(1e-12)
        });
        let kept = self.candidates.into_iter().flatten();
        let stride = order.len().div_ceil(JURY);
        let limit = self.seed_rad * self.seed_rad;
        let cost = |t: &Vector3<f64>| -> f64 {
            let jury = order.iter().step_by(stride);
            jury.map(|i| self.cells[*i as usize].residual(t).powi(2).min(limit)).sum()
        };
        kept.chain(drawn).map(|t| (cost(&t), t)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, t)| t)
    }

    /// By how much more vectors leave the focus than come towards it.
    fn votes(&self, t: &Vector3<f64>) -> f64 {
        self.offered()
            .map(|cell| {
                let (shift, pull) = (cell.shift(), cell.pull(t));
                let length = pull.norm();
                if length > 1e-6 { (shift.dot(&pull) / length).clamp(-self.seed_rad, self.seed_rad) } else { 0.0 }
            })
            .sum()
    }

    /// Spread for a vector of weight 1 by the median residual of those within `cut`.
    fn spread(&self, t: &Vector3<f64>, cut: f64, lengths: &mut Vec<f64>) -> f64 {
        lengths.clear();
        let scaled = self.offered().map(|cell| cell.residual(t).abs() * cell.weight.sqrt());
        lengths.extend(scaled.filter(|length| *length <= cut));
        if lengths.is_empty() {
            return SPREAD_MIN;
        }
        let middle = lengths.len() / 2;
        let (_, median, _) = lengths.select_nth_unstable_by(middle, f64::total_cmp);
        (*median / MEDIAN_ABS).max(SPREAD_MIN)
    }

    /// Gauss and Newton's matrix and right side over the two tangents, in 1/rad² and 1/rad.
    fn normal(
        &self,
        t: &Vector3<f64>,
        tangents: &[Vector3<f64>; 2],
        spread: f64,
        memory: Option<&Memory>,
    ) -> (Matrix2<f64>, Vector2<f64>) {
        let (mut slope, mut right) = (Matrix2::zeros(), Vector2::zeros());
        let (mut power, mut noise) = (0.0, 0.0);
        for cell in self.offered() {
            let residual = cell.residual(t);
            let part = cell.weight * (residual / (CUT * spread)).powi(2);
            let (shift, pull) = (cell.shift(), cell.pull(t));
            let length = pull.norm();
            if part >= 1.0 || length <= 1e-9 {
                continue;
            }
            let weight = cell.weight * (1.0 - part).powi(2);
            let by = Vector2::from_fn(|i, _| {
                let e = tangents[i];
                let bent = Vector2::new(cell.older[0] * e.z - e.x, cell.older[1] * e.z - e.y);
                (shift.x * bent.y - shift.y * bent.x) / length - residual * pull.dot(&bent) / (length * length)
            });
            slope += by * by.transpose() * weight;
            right -= by * (residual * weight);
            power += weight * (shift.dot(&pull) / length).powi(2);
            noise += weight * (spread * spread / cell.weight + self.shared_rad * self.shared_rad);
        }
        // Noise has a length along the line too, and knows nothing of the line.
        let signal = (1.0 - noise / f64::max(power, 1e-300)).max(1e-6);
        let independent = signal / (self.likeness * spread * spread);
        (slope, right) = (slope * independent, right * independent);
        if let Some(memory) = memory {
            let off = memory.information * (t - memory.direction);
            for i in 0..2 {
                right[i] -= tangents[i].dot(&off);
                for j in 0..2 {
                    slope[(i, j)] += tangents[i].dot(&(memory.information * tangents[j]));
                }
            }
        }
        (slope, right)
    }
}

/// The plane that a vector and the camera span; the heading lies in it.
fn line(cell: &Cell) -> Vector3<f64> {
    let (shift, [x, y]) = (cell.shift(), cell.older);
    Vector3::new(shift.y, -shift.x, shift.x * y - shift.y * x)
}

fn tangents(direction: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let aside = if direction.x.abs() < 0.7 { Vector3::x() } else { Vector3::y() };
    let first = direction.cross(&aside).normalize();
    [first, direction.cross(&first)]
}
