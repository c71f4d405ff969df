//! The sensor's noise: z = y + N(0, a·y + b), seeded, and the same whatever the order of rows or the number of threads.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Independent standard normal draws. Every (seed, stream) pair is a series of its own, so that each row of each frame
/// can be drawn by whichever thread comes to it.
#[derive(Debug, Clone)]
pub struct Normals {
    draws: ChaCha8Rng,
    spare: Option<f64>,
}

impl Normals {
    /// The series of this seed and stream.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut draws = ChaCha8Rng::seed_from_u64(seed);
        draws.set_stream(stream);
        Self { draws, spare: None }
    }

    /// The series of a row of a frame.
    pub fn of_row(seed: u64, frame: usize, row: usize) -> Self {
        Self::new(seed, (frame as u64) << 32 | row as u64)
    }

    /// The next draw of N(0, 1) (Box and Muller).
    pub fn draw(&mut self) -> f64 {
        if let Some(kept) = self.spare.take() {
            return kept;
        }
        let length = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        let (sine, cosine) = (std::f64::consts::TAU * self.uniform()).sin_cos();
        self.spare = Some(length * sine);
        length * cosine
    }

    /// The next draw of [0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.draws.random()
    }

    /// A draw of the Poisson distribution of this mean.
    pub fn poisson(&mut self, mean: f64) -> f64 {
        if mean <= 0.0 {
            return 0.0;
        }
        if mean < 12.0 {
            // Count arrivals until the time is up.
            let (limit, mut product, mut count) = ((-mean).exp(), self.uniform(), 0.0);
            while product > limit {
                product *= self.uniform();
                count += 1.0;
            }
            return count;
        }
        self.poisson_rejection(mean)
    }

    /// Hörmann's transformed rejection (PTRS, 1993), for means of ten and more.
    fn poisson_rejection(&mut self, mean: f64) -> f64 {
        let b = 0.931 + 2.53 * mean.sqrt();
        let a = -0.059 + 0.02483 * b;
        let inverse_alpha = 1.1239 + 1.1328 / (b - 3.4);
        let accept = 0.9277 - 3.6224 / (b - 2.0);
        loop {
            let (u, v) = (self.uniform() - 0.5, self.uniform());
            let edge = 0.5 - u.abs();
            let count = ((2.0 * a / edge + b) * u + mean + 0.43).floor();
            if edge >= 0.07 && v <= accept {
                return count;
            }
            if count < 0.0 || (edge < 0.013 && v > edge) {
                continue;
            }
            let left = v.ln() + inverse_alpha.ln() - (a / (edge * edge) + b).ln();
            if left <= count * mean.ln() - mean - ln_factorial(count) {
                return count;
            }
        }
    }
}

/// ln n!, by Stirling's series; exact enough (1e-10) from 10 on, and summed below.
fn ln_factorial(n: f64) -> f64 {
    if n < 10.0 {
        return (2..=n as u32).map(|i| f64::from(i).ln()).sum();
    }
    let inverse = 1.0 / n;
    n * n.ln() - n + 0.5 * (std::f64::consts::TAU * n).ln() + inverse / 12.0 - inverse.powi(3) / 360.0
        + inverse.powi(5) / 1260.0
}

/// A camera's noise at one gain: variance a·y + b of a raw value y in 0…1 (1 = white level, black off), for red, green
/// and blue.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// The shot part, per unit of signal.
    pub a: [f64; 3],
    /// The read part, a variance.
    pub b: [f64; 3],
}

impl Noise {
    /// Variance of a clean value; 0 red, 1 green, 2 blue.
    pub fn variance(&self, colour: usize, clean: f64) -> f64 {
        (self.a[colour] * clean.max(0.0) + self.b[colour]).max(0.0)
    }

    /// A noisy value by the Gaussian model that the paper uses. It is not clipped: below black is where the sensor's
    /// offset leaves room for it.
    pub fn gaussian(&self, colour: usize, clean: f64, draws: &mut Normals) -> f64 {
        clean + self.variance(colour, clean).sqrt() * draws.draw()
    }

    /// A noisy value by counting: Poisson with a as the signal of one electron, and Gaussian reading on top. It differs
    /// from [`Noise::gaussian`] where a pixel holds fewer than some twenty electrons.
    pub fn counted(&self, colour: usize, clean: f64, draws: &mut Normals) -> f64 {
        let (a, read) = (self.a[colour], self.b[colour].max(0.0).sqrt());
        let light = if a > 0.0 { a * draws.poisson(clean.max(0.0) / a) } else { clean };
        light + read * draws.draw()
    }

    /// What remains to be added to a value that already carries this noise once it is attenuated by `factor` < 1, so
    /// that it looks as if the camera had taken it in that little light.
    ///
    /// Attenuating f·z keeps a variance of f²(a·y + b), and a camera that sees f·y has a·f·y + b: the difference is
    /// f(1 − f)·a·y + (1 − f²)·b.
    pub fn darkening(&self, factor: f64) -> Noise {
        Noise { a: self.a.map(|a| a * (1.0 - factor)), b: self.b.map(|b| b * (1.0 - factor * factor)) }
    }
}
