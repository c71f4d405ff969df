//! What a velocity is worth, as one number: the probability that it is as near to the truth as a stated bound.

use std::f64::consts::SQRT_2;

use nalgebra::{Matrix2, Matrix3, Vector3};

use super::Scale;

/// The bound's constant part where the velocity is metric, m/s.
pub const BOUND_M_S: f64 = 0.1;
/// The bound's constant part where it is per distance, 1/s: that of a metric one at 5 m.
pub const BOUND_PER_S: f64 = 0.02;
/// The bound's part of the speed.
pub const BOUND_PART: f64 = 0.05;

/// 255 × the probability that a velocity's error, its length in all three directions, is within the bound.
pub(super) fn of(linear: &Vector3<f64>, covariance: &Matrix3<f64>, scale: &Scale) -> u8 {
    let constant = match scale {
        Scale::Metric { .. } => BOUND_M_S,
        Scale::PerDistance(_) => BOUND_PER_S,
    };
    (255.0 * within(covariance, constant + BOUND_PART * linear.norm())).round() as u8
}

/// 255 × the probability that two angular rates' error is within the bound of a velocity per distance; `left` is what a
/// gyro leaves of them, rad/s. At least 1, for 0 says that there are none.
pub(super) fn of_rates(left: [f64; 2], covariance: &Matrix2<f64>) -> u8 {
    let bound = BOUND_PER_S + BOUND_PART * (left[0] * left[0] + left[1] * left[1]).sqrt();
    let covariance = covariance.fixed_resize::<3, 3>(0.0);
    ((255.0 * within(&covariance, bound)).round() as u8).max(1)
}

/// The probability that a normal error of this covariance is no longer than `bound`.
///
/// The squared length is a sum of squares of unlike deviations. It is taken as g·χ²(h) of the same mean and variance
/// (Patnaik), and χ² by the cube root that makes it nearly normal (Wilson and Hilferty): right to 0.02.
fn within(covariance: &Matrix3<f64>, bound: f64) -> f64 {
    let (mean, squares) = (covariance.trace(), (covariance * covariance).trace());
    if !(mean > 0.0 && mean.is_finite()) {
        return 0.0;
    }
    let (size, freedom) = (squares / mean, mean * mean / squares);
    let part = 2.0 / (9.0 * freedom);
    below(((bound * bound / (size * freedom)).cbrt() - 1.0 + part) / part.sqrt())
}

/// The part of a standard normal that is below t (Abramowitz and Stegun 7.1.26, right to 2e-7).
pub(super) fn below(t: f64) -> f64 {
    const SERIES: [f64; 5] = [0.254_829_592, -0.284_496_736, 1.421_413_741, -1.453_152_027, 1.061_405_429];
    let x = t.abs() / SQRT_2;
    let k = 1.0 / (1.0 + 0.327_591_1 * x);
    let above = 0.5 * k * SERIES.iter().rev().fold(0.0, |sum, c| sum * k + c) * (-x * x).exp();
    if t < 0.0 { above } else { 1.0 - above }
}
