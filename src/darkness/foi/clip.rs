//! What clipping does to mean and deviation of a normal distribution.

/// The least and the largest value that the sensor can give, in the plane's own unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clip {
    /// What stands for all below.
    pub low: f64,
    /// What stands for all above.
    pub high: f64,
}

impl Clip {
    /// Of counts from 0 to the white level, with the black level off and white 1.
    pub fn counts(black: f64, white: f64) -> Self {
        Self { low: -black / (white - black), high: 1.0 }
    }

    /// Mean and deviation of N(mean, deviation²) once it is clipped.
    pub(super) fn of(&self, mean: f64, deviation: f64) -> [f64; 2] {
        let [low, high] = [self.low, self.high].map(|edge| (edge - mean) / deviation);
        // Six deviations away an edge clips one of a thousand million.
        if low < -6.0 && high > 6.0 {
            return [mean, deviation];
        }
        let (below, above) = (cumulative(low), cumulative(-high));
        let [low_density, high_density] = [low, high].map(density);
        let (low, high) = (low.max(-40.0), high.min(40.0));
        let inside = 1.0 - below - above;
        // Moments of the part between the edges, and of the parts that stand on them; in deviations around the mean.
        let first = low * below + high * above + low_density - high_density;
        let second = low * low * below + high * high * above + inside + low * low_density - high * high_density;
        [mean + deviation * first, deviation * (second - first * first).max(1e-12).sqrt()]
    }

    /// The mean before clipping, of what has `mean` afterwards; `deviation` gives that of the noise at a mean.
    pub(super) fn undo(&self, mean: f64, deviation: impl Fn(f64) -> f64) -> f64 {
        let mut clean = mean;
        for _ in 0..12 {
            let off = self.of(clean, deviation(clean))[0] - mean;
            if off.abs() < 1e-9 {
                break;
            }
            clean -= off;
        }
        clean
    }
}

fn density(x: f64) -> f64 {
    if x.abs() > 38.0 { 0.0 } else { (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt() }
}

/// The normal distribution's cumulative function; error below 1.5e-7 (Abramowitz and Stegun 7.1.26).
fn cumulative(x: f64) -> f64 {
    let z = x.abs() / std::f64::consts::SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let series =
        t * (0.254_829_592 + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    let tail = 0.5 * series * (-z * z).exp();
    if x < 0.0 { tail } else { 1.0 - tail }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::darkness::noise::Normals;

    #[test]
    fn clipped_moments_are_those_of_clipped_draws() {
        let clip = Clip { low: 0.0, high: 1.0 };
        for (mean, deviation) in [(0.5, 0.01), (0.02, 0.02), (-0.01, 0.02), (0.98, 0.05), (0.5, 0.8)] {
            let mut draws = Normals::new(1, 2);
            let values: Vec<f64> =
                (0..200_000).map(|_| (mean + deviation * draws.draw()).clamp(clip.low, clip.high)).collect();
            let drawn = values.iter().sum::<f64>() / values.len() as f64;
            let variance = values.iter().map(|v| (v - drawn).powi(2)).sum::<f64>() / values.len() as f64;
            let [expected, spread] = clip.of(mean, deviation);
            assert!((drawn - expected).abs() < 0.01 * deviation, "{mean} ± {deviation}: {drawn} of {expected}");
            assert!((variance.sqrt() / spread - 1.0).abs() < 0.01, "{mean} ± {deviation}: {spread}");
            let back = clip.undo(expected, |_| deviation);
            assert!((back - mean).abs() < 0.03 * deviation, "{mean} ± {deviation}: back at {back}");
        }
    }
}
