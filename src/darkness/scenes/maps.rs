//! Plane-to-plane maps (homographies) of pixels, and the draws that scenes are made of.

use nalgebra::Matrix3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A homography.
pub(super) type Map = Matrix3<f64>;

/// Where a point goes; `None` when it is behind.
pub(super) fn apply(map: &Map, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
    let depth = map[(2, 0)] * x + map[(2, 1)] * y + map[(2, 2)];
    (depth > 1e-9).then(|| {
        [
            (map[(0, 0)] * x + map[(0, 1)] * y + map[(0, 2)]) / depth,
            (map[(1, 0)] * x + map[(1, 1)] * y + map[(1, 2)]) / depth,
        ]
    })
}

/// A shift.
pub(super) fn shift([x, y]: [f64; 2]) -> Map {
    Map::new(1.0, 0.0, x, 0.0, 1.0, y, 0.0, 0.0, 1.0)
}

/// A turn (radians, x towards y) and a zoom about the origin.
pub(super) fn turn(angle: f64, zoom: f64) -> Map {
    let (sine, cosine) = angle.sin_cos();
    Map::new(zoom * cosine, -zoom * sine, 0.0, zoom * sine, zoom * cosine, 0.0, 0.0, 0.0, 1.0)
}

/// A map that is done about a centre.
pub(super) fn about([x, y]: [f64; 2], map: Map) -> Map {
    shift([x, y]) * map * shift([-x, -y])
}

/// The inverse, or the identity of a map that has none, which no scene draws.
pub(super) fn inverse(map: &Map) -> Map {
    let inverse = map.try_inverse().unwrap_or_else(Map::identity);
    // The sign decides what lies in front.
    if inverse[(2, 2)] < 0.0 { -inverse } else { inverse }
}

/// Draws of one scene: a series of its own for every (seed, index).
pub(super) struct Dice {
    draws: ChaCha8Rng,
}

impl Dice {
    pub fn new(seed: u64, index: u64) -> Dice {
        let mut draws = ChaCha8Rng::seed_from_u64(seed);
        draws.set_stream(index);
        Dice { draws }
    }

    /// Evenly over `low`…`high`.
    pub fn even(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.draws.random::<f64>()
    }

    /// Evenly over the logarithm.
    pub fn ratio(&mut self, low: f64, high: f64) -> f64 {
        self.even(low.ln(), high.ln()).exp()
    }

    pub fn chance(&mut self, part: f64) -> bool {
        self.even(0.0, 1.0) < part
    }

    /// One of 0…count.
    pub fn pick(&mut self, count: usize) -> usize {
        ((self.even(0.0, count as f64)) as usize).min(count.saturating_sub(1))
    }

    /// N(0, 1), by Box and Muller.
    pub fn normal(&mut self) -> f64 {
        let length = (-2.0 * (1.0 - self.even(0.0, 1.0)).ln()).sqrt();
        length * (std::f64::consts::TAU * self.even(0.0, 1.0)).cos()
    }

    /// A number below the sum of the weights picks one of them.
    pub fn weighted<T: Copy>(&mut self, choices: &[(f64, T)]) -> Option<T> {
        let mut left = self.even(0.0, choices.iter().map(|(weight, _)| weight).sum());
        for (weight, choice) in choices {
            left -= weight;
            if left < 0.0 {
                return Some(*choice);
            }
        }
        choices.last().map(|(_, choice)| *choice)
    }
}
