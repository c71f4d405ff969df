//! From step to step by the accelerometer: what the steps before said of the velocity is carried to the newest and weighed with its word.
//!
//! The mean velocities of two adjoining intervals differ by ∫ w a dt, where a is the body's acceleration and w rises from 0 to 1 over
//! the first of them and falls to 0 again over the second. An accelerometer measures a − g; g's direction is the attitude's word, and
//! what is wrong about both, the leak, is fitted beside the velocity. What one step errs by and the next one too (the gyro's bias and
//! clock, the tilt, what all vectors share) is never averaged out: it is carried along as columns of unit variance whose causes are
//! the same in every step, and a step is weighed by what it does *not* have in common with those before (Schmidt's consider filter:
//! S. F. Schmidt, "Application of state-space methods to navigation problems", 1966).

use nalgebra::{Matrix3, Matrix6, Matrix6x3, SMatrix, Vector3};

use super::linear::{GATE, invert};
use crate::clock::Stamp;

/// Standard gravity, m/s².
pub const GRAVITY: f64 = 9.806_65;
/// What errs alike in every step.
pub(super) const LASTING: usize = 18;
/// How many times what it says a step's own noise may be, where that explains it.
const ROUGH: f64 = 2.0;
/// m/s² after a second: an attitude's error moves, with the accelerations that a filter behind it takes for gravity.
const WALK: f64 = 0.03;

/// What accelerometer and attitude say between the steps, body axes at the newest stamp.
#[derive(Debug, Clone, Copy)]
pub(super) struct Push {
    /// Change of the mean velocity, m/s.
    pub(super) change: Vector3<f64>,
    /// (m/s)² an axis.
    pub(super) variance: f64,
    /// By how many seconds a leak changes it.
    pub(super) seconds: f64,
    /// rad, the attitude's own word on its error.
    pub(super) up_sd: f64,
}

/// What one step alone says, the newer frame's body axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step {
    pub(super) older: Stamp,
    pub(super) newer: Stamp,
    /// From the older frame's body axes.
    pub(super) turned: Matrix3<f64>,
    /// m/s.
    pub(super) linear: Vector3<f64>,
    /// Covariance of what is this step's alone, and with the rates.
    pub(super) noise: Matrix3<f64>,
    pub(super) with_rates: Matrix3<f64>,
    /// What lasts, by column: m/s, and rad/s of the rates.
    pub(super) lasting: SMatrix<f64, 3, LASTING>,
    pub(super) rates: SMatrix<f64, 3, LASTING>,
}

/// A velocity with its covariance, and that with the rates.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighed {
    pub(super) linear: Vector3<f64>,
    pub(super) covariance: Matrix3<f64>,
    pub(super) with_rates: Matrix3<f64>,
}

/// Velocity and leak as they were believed after the newest step.
#[derive(Debug, Clone, Copy)]
struct Kept {
    older: Stamp,
    newer: Stamp,
    linear: Vector3<f64>,
    /// m/s² that is measured and not there, body axes; none before there was a push.
    leak: Option<Vector3<f64>>,
    /// Of both, without what lasts, …
    covariance: Matrix6<f64>,
    /// … and what lasts.
    lasting: SMatrix<f64, 6, LASTING>,
    /// Whether the newest step contradicted it.
    doubted: bool,
}

/// The velocity's memory.
#[derive(Debug, Default)]
pub(super) struct Inertia {
    kept: Option<Kept>,
}

impl Inertia {
    /// The older stamp of the step before, if that ended where this one begins.
    pub(super) fn before(&self, older: Stamp) -> Option<Stamp> {
        self.kept.filter(|kept| kept.newer == older).map(|kept| kept.older)
    }

    /// Whatever was known is known no more.
    pub(super) fn forget(&mut self) {
        self.kept = None;
    }

    /// Weighs a step with what is known from before; `None` where that is nothing, or where the two contradict each other, and the step
    /// stands alone. `push` is what leads from there to here. An accelerometer is as wrong as `bias_sd` (m/s²) for good.
    ///
    /// Vectors scatter more than they say now and then, by noise that is not that of a bell: a step that twice its noise explains is
    /// weighed with that. One contradiction beyond says that one of the two is wrong, not which: what was known is kept beside. Two in
    /// a row end it.
    pub(super) fn take(&mut self, step: &Step, push: Option<&Push>, bias_sd: f64) -> Option<Weighed> {
        let carried = push.zip(self.kept).map(|(push, kept)| kept.carried(step, push, bias_sd));
        let rough =
            Step { noise: step.noise * (ROUGH * ROUGH), with_rates: step.with_rates * (ROUGH * ROUGH), ..*step };
        let met = carried.and_then(|carried| carried.met(step).or_else(|| carried.met(&rough)));
        let doubted = carried.filter(|carried| !carried.doubted).map(|carried| Kept { doubted: true, ..carried });
        self.kept = met.map(|(kept, _)| kept).or(doubted).or_else(|| Some(Kept::anew(step)));
        let (kept, heard) = met?;
        let lasting = kept.lasting.fixed_rows::<3>(0);
        Some(Weighed {
            linear: kept.linear,
            covariance: kept.covariance.fixed_view::<3, 3>(0, 0) + lasting * lasting.transpose(),
            with_rates: heard * step.with_rates + lasting * step.rates.transpose(),
        })
    }
}

impl Kept {
    /// The step's word alone.
    fn anew(step: &Step) -> Kept {
        let (mut covariance, mut lasting) = (Matrix6::zeros(), SMatrix::<f64, 6, LASTING>::zeros());
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&step.noise);
        lasting.fixed_rows_mut::<3>(0).copy_from(&step.lasting);
        let Step { older, newer, linear, .. } = *step;
        Kept { older, newer, linear, leak: None, covariance, lasting, doubted: false }
    }

    /// To the end of a step that begins where this ends.
    fn carried(mut self, step: &Step, push: &Push, bias_sd: f64) -> Kept {
        let leak = self.leak.unwrap_or_else(|| {
            let variance = (GRAVITY * push.up_sd).powi(2) + bias_sd * bias_sd;
            self.covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * variance));
            Vector3::zeros()
        });
        let mut by = Matrix6::identity();
        by.fixed_view_mut::<3, 3>(0, 0).copy_from(&step.turned);
        by.fixed_view_mut::<3, 3>(0, 3).copy_from(&(Matrix3::identity() * -push.seconds));
        let mut covariance = by * self.covariance * by.transpose();
        for axis in 0..3 {
            covariance[(axis, axis)] += push.variance;
            covariance[(axis + 3, axis + 3)] += WALK * WALK * push.seconds;
        }
        Kept {
            older: step.older,
            newer: step.newer,
            linear: step.turned * self.linear + push.change - leak * push.seconds,
            leak: Some(leak),
            covariance,
            lasting: by * self.lasting,
            ..self
        }
    }

    /// Weighed with a step's own word, and by how much that changed the velocity; `None` where the two contradict each other.
    fn met(self, step: &Step) -> Option<(Kept, Matrix3<f64>)> {
        let apart = step.lasting - self.lasting.fixed_rows::<3>(0);
        let surprise = step.linear - self.linear;
        let total = self.covariance.fixed_view::<3, 3>(0, 0) + step.noise + apart * apart.transpose();
        let inverse = invert(&total)?;
        // Asked this way round, a NaN is a contradiction.
        let likely = surprise.dot(&(inverse * surprise)) <= GATE;
        if !likely {
            return None;
        }
        let both: Matrix6x3<f64> = self.covariance.fixed_columns::<3>(0) - self.lasting * apart.transpose();
        let gain = both * inverse;
        let mut left = Matrix6::identity();
        let mut columns = left.fixed_columns_mut::<3>(0);
        columns -= gain;
        let change = gain * surprise;
        let kept = Kept {
            linear: self.linear + change.fixed_rows::<3>(0),
            leak: self.leak.map(|leak| leak + change.fixed_rows::<3>(3)),
            covariance: left * self.covariance * left.transpose() + gain * step.noise * gain.transpose(),
            lasting: self.lasting + gain * apart,
            doubted: false,
            ..self
        };
        Some((kept, gain.fixed_rows::<3>(0).into_owned()))
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    const PERIOD_NS: i64 = 33_000_000;
    const PERIOD_S: f64 = 0.033;
    const BIAS_SD: f64 = 0.05;

    /// A word of `noise` (m/s, one deviation) on a velocity, and of `lasting`.
    fn step(number: i64, linear: Vector3<f64>, noise: f64, lasting: f64) -> Step {
        let mut columns = SMatrix::<f64, 3, LASTING>::zeros();
        columns.fixed_view_mut::<3, 3>(0, 0).copy_from(&(Matrix3::identity() * lasting));
        Step {
            older: Stamp(number * PERIOD_NS),
            newer: Stamp((number + 1) * PERIOD_NS),
            turned: Matrix3::identity(),
            linear,
            noise: Matrix3::identity() * noise * noise,
            with_rates: Matrix3::identity() * 0.25 * noise * noise,
            lasting: columns,
            rates: columns * 0.5,
        }
    }

    fn push(change: Vector3<f64>) -> Push {
        Push { change, variance: 1e-6, seconds: PERIOD_S, up_sd: 0.005 }
    }

    /// Mean normalised error squared over its degrees of freedom, and the deviation of the error, after so many steps.
    fn after(steps: i64, noise: f64, lasting: f64) -> (f64, f64) {
        const DRAWS: u64 = 400;
        let (mut nees, mut square) = (0.0, 0.0);
        for draw in 0..DRAWS {
            let mut draws = ChaCha8Rng::seed_from_u64(draw);
            // Normal as far as it matters here: a sum of twelve.
            let mut normal = || (0..12).map(|_| draws.random::<f64>()).sum::<f64>() - 6.0;
            let mut three = |sd: f64| Vector3::from_fn(|_, _| sd * normal());
            let (shared, mut truth) = (three(lasting), three(1.0));
            let leak = three(((GRAVITY * 0.005).powi(2) + BIAS_SD * BIAS_SD).sqrt());
            let mut inertia = Inertia::default();
            let first = step(0, truth + shared + three(noise), noise, lasting);
            let mut found = (first.linear, first.noise + first.lasting * first.lasting.transpose());
            assert!(inertia.take(&first, None, BIAS_SD).is_none(), "the first step stands alone");
            for number in 1..steps {
                let change = three(0.1);
                truth += change;
                let measured = push(change + leak * PERIOD_S + three(1e-3));
                assert_eq!(inertia.before(Stamp(number * PERIOD_NS)), Some(Stamp((number - 1) * PERIOD_NS)));
                let word = step(number, truth + shared + three(noise), noise, lasting);
                // One in a thousand contradicts by chance, and stands alone.
                let weighed = inertia.take(&word, Some(&measured), BIAS_SD);
                let alone = (word.linear, word.noise + word.lasting * word.lasting.transpose());
                found = weighed.map_or(alone, |weighed| (weighed.linear, weighed.covariance));
            }
            let error = found.0 - truth;
            nees += error.dot(&(found.1.try_inverse().unwrap() * error)) / 3.0;
            square += error.norm_squared() / 3.0;
        }
        (nees / DRAWS as f64, (square / DRAWS as f64).sqrt())
    }

    #[test]
    fn steps_together_err_less_than_each_and_say_so() {
        for (steps, at_most) in [(1, 1.1), (2, 0.8), (10, 0.5), (60, 0.4)] {
            let (nees, sd) = after(steps, 0.05, 0.0);
            println!("{steps} steps: {sd:.4} m/s, normalised {nees:.2}");
            assert!(sd < at_most * 0.05, "{steps} steps: {sd}");
            assert!((0.75..1.3).contains(&nees), "{steps} steps: {nees}");
        }
    }

    #[test]
    fn what_lasts_is_never_averaged_out() {
        let (nees, sd) = after(60, 0.05, 0.04);
        assert!(sd > 0.035 && (0.8..1.25).contains(&nees), "{sd} m/s, {nees}");
        // Even where there is nothing else.
        let (nees, sd) = after(60, 1e-4, 0.04);
        assert!(sd > 0.035 && (0.8..1.25).contains(&nees), "{sd} m/s, {nees}");
    }

    #[test]
    fn covariances_with_the_rates_are_those_of_the_parts() {
        let mut inertia = Inertia::default();
        let alone = step(0, Vector3::zeros(), 0.05, 0.04);
        inertia.take(&alone, None, BIAS_SD);
        for number in 1..40 {
            inertia.take(&step(number, Vector3::zeros(), 0.05, 0.04), Some(&push(Vector3::zeros())), BIAS_SD);
        }
        let late =
            inertia.take(&step(40, Vector3::zeros(), 0.05, 0.04), Some(&push(Vector3::zeros())), BIAS_SD).unwrap();
        let lasts = alone.lasting * alone.rates.transpose();
        // The newest step's own part counts for what it weighs by now; what lasts counts in full.
        assert!(late.with_rates[(0, 0)] < lasts[(0, 0)] + 0.4 * alone.with_rates[(0, 0)], "{}", late.with_rates);
        assert!(late.with_rates[(0, 0)] > 0.99 * lasts[(0, 0)], "{}", late.with_rates);
    }

    #[test]
    fn a_step_that_scatters_more_than_it_says_counts_for_little() {
        let still = Vector3::zeros();
        let last = |struck: f64, noise: f64| {
            let mut inertia = Inertia::default();
            for number in 0..20 {
                inertia.take(&step(number, still, 0.05, 0.0), Some(&push(still)), BIAS_SD);
            }
            inertia.take(&step(20, Vector3::new(struck, 0.0, 0.0), noise, 0.0), Some(&push(still)), BIAS_SD).unwrap()
        };
        let (rough, fair) = (last(0.35, 0.05), last(0.35, 0.1));
        assert!((rough.linear - fair.linear).norm() < 1e-12, "{} {}", rough.linear, fair.linear);
        assert!((rough.covariance - fair.covariance).norm() < 1e-12);
        // Of its word, less than of one that is as rough as it says.
        let (less, more) = (rough.linear.x / 0.35, last(0.1, 0.05).linear.x / 0.1);
        assert!(less > 0.0 && less < 0.4 * more, "{less} {more}");
    }

    #[test]
    fn one_contradiction_changes_nothing_and_two_begin_anew() {
        let mut inertia = Inertia::default();
        let still = Vector3::zeros();
        for number in 0..20 {
            inertia.take(&step(number, still, 0.05, 0.0), Some(&push(still)), BIAS_SD);
        }
        let struck = Vector3::new(1.0, 0.0, 0.0);
        assert!(inertia.take(&step(20, struck, 0.05, 0.0), Some(&push(still)), BIAS_SD).is_none());
        let next = inertia.take(&step(21, still, 0.05, 0.0), Some(&push(still)), BIAS_SD).unwrap();
        assert!(next.linear.norm() < 1e-12 && next.covariance[(0, 0)] < 0.4 * 0.05 * 0.05, "{next:?}");

        assert!(inertia.take(&step(22, struck, 0.05, 0.0), Some(&push(still)), BIAS_SD).is_none());
        assert!(inertia.take(&step(23, struck, 0.05, 0.0), Some(&push(still)), BIAS_SD).is_none());
        let next = inertia.take(&step(24, struck, 0.05, 0.0), Some(&push(still)), BIAS_SD).unwrap();
        assert!((next.linear - struck).norm() < 1e-12 && next.covariance[(0, 0)] > 0.4 * 0.05 * 0.05, "{next:?}");
        // Nor does anything lead over a gap, or from what was forgotten.
        assert_eq!(inertia.before(Stamp(26 * PERIOD_NS)), None);
        inertia.forget();
        assert_eq!(inertia.before(Stamp(25 * PERIOD_NS)), None);
        assert!(inertia.take(&step(25, still, 0.05, 0.0), Some(&push(still)), BIAS_SD).is_none());
    }
}
