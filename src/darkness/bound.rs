//! The Cramér–Rao bound: how small the error of a displacement can be at all, given the noise.
//!
//! Two noisy pictures of one patch that moved by d: whoever estimates d without bias has
//! cov ≥ 2·(Σ ∇I ∇Iᵀ / σ²(I))⁻¹, summed over the patch's pixels and colours; the 2 is there because both are noisy.
//! Three things make it fit a dark frame and an end-point error:
//!
//! - A value that is clipped to 0…1 tells less: 1/σ² is multiplied by the part of the Fisher information about its mean
//!   that a normal draw keeps when it is censored at both ends ([`kept`]).
//! - A flat patch knows nothing, and its bound would be infinite, but nobody errs by more than the scene moves: the
//!   displacement is taken to be known beforehand to within the scene's own motion, s² = mean |true flow|²/2 on each
//!   axis (van Trees), so that a patch without any structure is bounded by about what zero flow errs.
//! - The mean length of a normal error of this covariance is its end-point error ([`mean_length`]); the bound of a pair
//!   is the mean of these over its valid pixels, as the EPE is.
//!
//! The patch has a side of [`PATCH`] pixels around each pixel, within which motion is taken to be one displacement. It
//! bounds whoever looks no further; a network that takes motion from further around, and gets its smoothness right, may
//! in principle fall below. The mean is ruled by the few flat or saturated places, where the prior is all there is; the
//! median says what a place with structure allows. Without noise a saturated place says nothing at all, and a little
//! noise lifts some of its values out of saturation, so that the mean may be higher at the brightest exposure than at
//! the next. Gradients are five-point differences of the picture without noise.

use super::{flow_files::Field, ladder::Rung};

/// Side of a patch, pixels: some four by four cells of the network's raster, the reach of its last cost volume (±4
/// cells would be 36, but over so many pixels real flow is seldom one displacement). DIS has 8, Farnebäck's usual window is 15.
pub const PATCH: usize = 15;

/// The least possible error of a pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limit {
    /// Mean end-point error over the valid pixels.
    pub epe: f64,
    /// Root of the mean squared end-point error.
    pub rms: f64,
    /// Median of the pixels' end-point errors: what a typical, structured place allows.
    pub median: f64,
}

/// The bound of a pair at one exposure; `None` where the truth has no valid pixel.
pub fn limit(rung: &Rung, truth: &Field, patch: usize) -> Option<Limit> {
    let valid: Vec<usize> = (0..truth.vectors.len()).filter(|&at| truth.known(at)).collect();
    if valid.is_empty() {
        return None;
    }
    let squares = valid.iter().flat_map(|&at| truth.vectors[at]).map(|along| f64::from(along).powi(2)).sum::<f64>()
        / valid.len() as f64;
    // A scene that stands still is known to do so to a thousandth of a pixel.
    let prior = 1.0 / (squares / 2.0).max(1e-6);
    let summed = information(rung, patch);
    let (mut lengths, mut squared) = (Vec::with_capacity(valid.len()), 0.0);
    for &at in &valid {
        let [xx, xy, yy] = summed.each_ref().map(|sums| sums[at]);
        // 2·J⁻¹ is the inverse of J/2; the prior's information adds to that.
        let (xx, xy, yy) = (xx / 2.0 + prior, xy / 2.0, yy / 2.0 + prior);
        let (middle, apart) = ((xx + yy) / 2.0, ((xx - yy) / 2.0).hypot(xy));
        let variances = [1.0 / (middle - apart).max(prior), 1.0 / (middle + apart)];
        squared += variances[0] + variances[1];
        lengths.push(mean_length(variances));
    }
    let epe = lengths.iter().sum::<f64>() / lengths.len() as f64;
    let middle = lengths.len() / 2;
    let median = *lengths.select_nth_unstable_by(middle, f64::total_cmp).1;
    Some(Limit { epe, rms: (squared / valid.len() as f64).sqrt(), median })
}

/// Σ I_x², Σ I_x·I_y, Σ I_y² over σ², summed over the colours and over the patch around each pixel; patches are cut at
/// the picture's edge.
fn information(rung: &Rung, patch: usize) -> [Vec<f64>; 3] {
    let (width, height) = (rung.width, rung.height);
    let value = |x: isize, y: isize, c: usize| {
        let (x, y) = (x.clamp(0, width as isize - 1) as usize, y.clamp(0, height as isize - 1) as usize);
        f64::from(rung.clean[(y * width + x) * 3 + c])
    };
    let slope = |far: f64, near: f64, next: f64, last: f64| (8.0 * (next - near) - (last - far)) / 12.0;
    let mut sums = [(); 3].map(|()| vec![0.0; width * height]);
    for y in 0..height as isize {
        for x in 0..width as isize {
            let at = y as usize * width + x as usize;
            for c in 0..3 {
                let across = slope(value(x - 2, y, c), value(x - 1, y, c), value(x + 1, y, c), value(x + 2, y, c));
                let down = slope(value(x, y - 2, c), value(x, y - 1, c), value(x, y + 1, c), value(x, y + 2, c));
                let mean = value(x, y, c);
                let variance = rung.variance(c, mean);
                let weight = kept(mean, variance.sqrt()) / variance;
                sums[0][at] += across * across * weight;
                sums[1][at] += across * down * weight;
                sums[2][at] += down * down * weight;
            }
        }
    }
    sums.map(|plane| box_sums(&plane, width, height, patch))
}

/// Sums over a square of side `patch` around each cell.
fn box_sums(plane: &[f64], width: usize, height: usize, patch: usize) -> Vec<f64> {
    // Sums over the rectangle up to and without (x, y).
    let wide = width + 1;
    let mut integral = vec![0.0; wide * (height + 1)];
    for y in 0..height {
        let mut row = 0.0;
        for x in 0..width {
            row += plane[y * width + x];
            integral[(y + 1) * wide + x + 1] = integral[y * wide + x + 1] + row;
        }
    }
    let half = patch / 2;
    let mut sums = Vec::with_capacity(width * height);
    for y in 0..height {
        let (top, bottom) = (y.saturating_sub(half), (y + half + 1).min(height));
        for x in 0..width {
            let (left, right) = (x.saturating_sub(half), (x + half + 1).min(width));
            let corner = |x: usize, y: usize| integral[y * wide + x];
            let sum = corner(right, bottom) - corner(left, bottom) - corner(right, top) + corner(left, top);
            // Differences of large sums may fall a hair below nothing.
            sums.push(sum);
        }
    }
    sums
}

/// The part of the Fisher information about the mean that a normal draw keeps when it is censored to 0…1.
pub fn kept(mean: f64, deviation: f64) -> f64 {
    let (low, high) = (-mean / deviation, (1.0 - mean) / deviation);
    if low < -9.0 && high > 9.0 {
        return 1.0;
    }
    let density = |at: f64| (-0.5 * at * at).exp() / std::f64::consts::TAU.sqrt();
    let (below, above) = (half_erfc(-low), half_erfc(high));
    let at_edge = |at: f64, part: f64| if part > 1e-290 { density(at).powi(2) / part } else { 0.0 };
    let edge = |at: f64| if at.abs() < 40.0 { at * density(at) } else { 0.0 };
    let inside = 1.0 - below - above + edge(low) - edge(high);
    (inside + at_edge(low, below) + at_edge(high, above)).clamp(0.0, 1.0)
}

/// The part of a standard normal distribution above `at` (W. J. Cody's form is not needed: Numerical Recipes' Chebyshev
/// fit of erfc, relative error below 1.2e-7 everywhere).
fn half_erfc(at: f64) -> f64 {
    let z = at.abs() / std::f64::consts::SQRT_2;
    let t = 1.0 / (1.0 + 0.5 * z);
    const FIT: [f64; 10] = [
        -1.265_512_23,
        1.000_023_68,
        0.374_091_96,
        0.096_784_18,
        -0.186_288_06,
        0.278_868_07,
        -1.135_203_98,
        1.488_515_87,
        -0.822_152_23,
        0.170_872_77,
    ];
    let sum = FIT.iter().rev().fold(0.0, |sum, factor| sum * t + factor);
    let above = 0.5 * t * (sum - z * z).exp();
    if at >= 0.0 { above } else { 1.0 - above }
}

/// Mean length of a normal vector of these variances along its axes, the larger first:
/// √(2·v₁/π)·E(1 − v₂/v₁), with the complete elliptic integral of the second kind.
pub fn mean_length([large, small]: [f64; 2]) -> f64 {
    if large <= 0.0 {
        return 0.0;
    }
    let parameter = (1.0 - small / large).clamp(0.0, 1.0);
    (2.0 * large / std::f64::consts::PI).sqrt() * elliptic(parameter)
}

/// E(m) by the arithmetic-geometric mean (Abramowitz and Stegun 17.6).
fn elliptic(parameter: f64) -> f64 {
    if parameter > 1.0 - 1e-14 {
        return 1.0;
    }
    let (mut a, mut g, mut power) = (1.0, (1.0 - parameter).sqrt(), 0.5);
    let mut sum = power * parameter;
    while (a - g).abs() > 1e-15 {
        let half = (a - g) / 2.0;
        power *= 2.0;
        sum += power * half * half;
        (a, g) = ((a + g) / 2.0, (a * g).sqrt());
    }
    std::f64::consts::FRAC_PI_2 / a * (1.0 - sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_lengths_are_those_of_the_tables() {
        // Round: Rayleigh, √(π/2)·σ. Flat: half normal, √(2/π)·σ. E(1/2) = 1.3506438810 (Abramowitz and Stegun 17.1).
        assert!((mean_length([4.0, 4.0]) - 2.0 * (std::f64::consts::FRAC_PI_2).sqrt()).abs() < 1e-12);
        assert!((mean_length([9.0, 0.0]) - 3.0 * (2.0 / std::f64::consts::PI).sqrt()).abs() < 1e-12);
        assert!((elliptic(0.5) - 1.350_643_881_047_675_5).abs() < 1e-12);
    }

    #[test]
    fn censoring_keeps_what_it_must() {
        assert_eq!(kept(0.5, 0.01), 1.0);
        // Half the draws lie below 0 and say only that: 1/2 + φ(0)²/(1/2) = 1/2 + 1/π.
        assert!((kept(0.0, 0.01) - (0.5 + 1.0 / std::f64::consts::PI)).abs() < 1e-6);
        assert!(kept(1.5, 0.01) < 1e-9, "a saturated pixel says nothing");
        // Where both ends cut, numerically: information of the censored draw by its score.
        let (mean, deviation) = (0.3, 0.4);
        let step = 1e-4;
        let parts = |mean: f64| [half_erfc(mean / deviation), half_erfc((1.0 - mean) / deviation)];
        let ends: f64 = (0..2)
            .map(|end| {
                let slope = (parts(mean + step)[end] - parts(mean - step)[end]) / (2.0 * step);
                slope * slope / parts(mean)[end]
            })
            .sum();
        let inside: f64 = (0..10_000)
            .map(|i| {
                let at = ((i as f64 + 0.5) / 10_000.0 - mean) / deviation;
                at * at / (deviation * deviation) * (-0.5 * at * at).exp()
                    / (deviation * std::f64::consts::TAU.sqrt())
                    / 1e4
            })
            .sum();
        let want = (ends + inside) * deviation * deviation;
        assert!((kept(mean, deviation) - want).abs() < 1e-4, "{} {want}", kept(mean, deviation));
    }
}
