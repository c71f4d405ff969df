//! Logarithm, power, sine and the normal curve by plain arithmetic, the same bits on every machine.
//!
//! The platform's mathematical library rounds its last bit as it likes; what is drawn from a seed must not show it.

/// Logarithm to the base e of x > 0, right to 1e-15 of itself or of 1.
pub(super) fn ln(x: f64) -> f64 {
    const ROOT_HALF: u64 = 0x3fe6_a09e_667f_3bcd;
    // x = 2ⁿ·m with m between √½ and √2, and ln m = 2·artanh((m − 1)/(m + 1)).
    let shifted = x.to_bits().wrapping_sub(ROOT_HALF);
    let power = (shifted as i64 >> 52) as f64;
    let m = f64::from_bits((shifted & 0xf_ffff_ffff_ffff) + ROOT_HALF);
    let s = (m - 1.0) / (m + 1.0);
    let square = s * s;
    let series = (0..11).rev().fold(0.0, |sum, k| sum * square + 1.0 / f64::from(2 * k + 1));
    power * std::f64::consts::LN_2 + 2.0 * s * series
}

/// eˣ for |x| < 700, right to 1e-15 of itself.
pub(super) fn exp(x: f64) -> f64 {
    const LN_2_HIGH: f64 = f64::from_bits(0x3fe6_2e42_fee0_0000);
    const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;
    let power = (x.clamp(-700.0, 700.0) * std::f64::consts::LOG2_E).round();
    let rest = x.clamp(-700.0, 700.0) - power * LN_2_HIGH - power * LN_2_LOW;
    let series = (1..=14).rev().fold(1.0, |sum, k| 1.0 + sum * rest / f64::from(k));
    series * f64::from_bits(((power as i64 + 1023) as u64) << 52)
}

/// xʸ of x ≥ 0 and y > 0.
pub(super) fn power(x: f64, y: f64) -> f64 {
    if x > 0.0 { exp(y * ln(x)) } else { 0.0 }
}

/// The sine of so many turns, right to 1e-15 for a few of them.
pub(super) fn sine(turns: f64) -> f64 {
    let part = turns - turns.round();
    // Beyond a quarter it comes back.
    let folded = if part.abs() > 0.25 { 0.5f64.copysign(part) - part } else { part };
    let x = folded * std::f64::consts::TAU;
    let series = (1..=10).rev().fold(1.0, |sum, k| 1.0 - sum * x * x / f64::from(2 * k * (2 * k + 1)));
    x * series
}

/// The density of N(0, 1), and the part of it below t (Abramowitz and Stegun 26.2.17, right to 1e-7).
fn normal(t: f64) -> [f64; 2] {
    const SERIES: [f64; 5] = [0.319_381_530, -0.356_563_782, 1.781_477_937, -1.821_255_978, 1.330_274_429];
    let density = exp(-0.5 * t * t) / std::f64::consts::TAU.sqrt();
    let k = 1.0 / (1.0 + 0.231_641_9 * t.abs());
    let above = density * k * SERIES.iter().rev().fold(0.0, |sum, c| sum * k + c);
    [density, if t < 0.0 { above } else { 1.0 - above }]
}

/// The variance of N(mean, variance) clipped to 0…1.
pub(super) fn clipped_variance(mean: f64, variance: f64) -> f64 {
    let sigma = variance.sqrt();
    if sigma * 6.0 < mean.min(1.0 - mean) {
        return variance;
    }
    if sigma < 1e-9 {
        return 0.0;
    }
    let [low, below] = normal(-mean / sigma);
    let [high, under] = normal((1.0 - mean) / sigma);
    let (inside, over) = (under - below, 1.0 - under);
    let first = mean * inside + sigma * (low - high) + over;
    let second = (mean * mean + variance) * inside + sigma * (mean * low - (mean + 1.0) * high) + over;
    (second - first * first).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curves_are_those_of_the_library() {
        for i in 1..2000 {
            let x = f64::from(i) * 0.0137;
            assert!((ln(x) - x.ln()).abs() < 4e-15 * x.ln().abs().max(1.0), "ln {x}");
            let y = x - 14.0;
            assert!((exp(y) / y.exp() - 1.0).abs() < 4e-15, "exp {y}");
            let z = f64::from(i) / 2000.0;
            assert!((sine(y) - (std::f64::consts::TAU * y).sin()).abs() < 2e-14, "sine {y}");
            assert!((power(z, 2.2) / z.powf(2.2) - 1.0).abs() < 1e-14, "{z} to the 2.2");
        }
        assert_eq!([power(0.0, 2.2), power(1.0, 2.2), exp(0.0), ln(1.0)], [0.0, 1.0, 1.0, 0.0]);
    }

    #[test]
    fn clipping_takes_the_variance_that_it_should() {
        assert!((clipped_variance(0.5, 1e-4) - 1e-4).abs() < 1e-12);
        // Half of a normal curve at the edge: (1 − 1/π)/2 of its variance.
        let half = 0.5 * (1.0 - std::f64::consts::FRAC_1_PI);
        for mean in [0.0, 1.0] {
            assert!((clipped_variance(mean, 0.0025) / 0.0025 - half).abs() < 1e-5);
        }
        assert_eq!(clipped_variance(0.0, 0.0), 0.0);
        // Against a sum over the curve, where both edges cut.
        for (mean, sigma) in [(0.3, 0.4), (0.0, 0.1), (0.9, 2.0)] {
            let (mut weight, mut sum, mut squares) = (0.0, 0.0, 0.0);
            for i in -80_000..80_000 {
                let t: f64 = f64::from(i) * 1e-4;
                let (w, z) = ((-0.5 * t * t).exp(), (mean + sigma * t).clamp(0.0, 1.0));
                weight += w;
                sum += w * z;
                squares += w * z * z;
            }
            let expected = squares / weight - (sum / weight).powi(2);
            assert!((clipped_variance(mean, sigma * sigma) / expected - 1.0).abs() < 1e-5, "{mean} {sigma}");
        }
    }
}
