//! Tests of what leads from step to step: noise, what lasts, contradictions, bias, and frames that are kept.

use nalgebra::Matrix3x2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::motion::{
    bias::{Bias, Shown},
    errors::LASTING,
};

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
        by_vectors: Matrix3::identity() * noise * noise,
        by_gyro: Matrix3::zeros(),
        gyro_sd: 0.0,
        with_rates: Matrix3::identity() * 0.25 * noise * noise,
        lasting: columns,
        rates: columns * 0.5,
    }
}

/// What is believed where nothing is known.
fn nothing() -> Believed {
    Bias::new(0.003).believed()
}

fn take(inertia: &mut Inertia, step: &Step, push: Option<&Push>) -> Option<Weighed> {
    inertia.take(step, push, BIAS_SD, &nothing())
}

/// Draws of a normal distribution as far as it matters here: sums of twelve.
struct Normal(ChaCha8Rng);

impl Normal {
    fn three(&mut self, sd: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| sd * ((0..12).map(|_| self.0.random::<f64>()).sum::<f64>() - 6.0))
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
        let mut draws = Normal(ChaCha8Rng::seed_from_u64(draw));
        let mut three = |sd| draws.three(sd);
        let (shared, mut truth) = (three(lasting), three(1.0));
        let leak = three(((GRAVITY * 0.005).powi(2) + BIAS_SD * BIAS_SD).sqrt());
        let mut inertia = Inertia::default();
        let first = step(0, truth + shared + three(noise), noise, lasting);
        let mut found = (first.linear, first.noise + first.lasting * first.lasting.transpose());
        assert!(take(&mut inertia, &first, None).is_none(), "the first step stands alone");
        for number in 1..steps {
            let change = three(0.1);
            truth += change;
            let measured = push(change + leak * PERIOD_S + three(1e-3));
            assert_eq!(inertia.before(Stamp(number * PERIOD_NS)), Some(Stamp((number - 1) * PERIOD_NS)));
            let word = step(number, truth + shared + three(noise), noise, lasting);
            // One in a thousand contradicts by chance, and stands alone.
            let weighed = take(&mut inertia, &word, Some(&measured));
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
    take(&mut inertia, &alone, None);
    for number in 1..40 {
        take(&mut inertia, &step(number, Vector3::zeros(), 0.05, 0.04), Some(&push(Vector3::zeros())));
    }
    let late = take(&mut inertia, &step(40, Vector3::zeros(), 0.05, 0.04), Some(&push(Vector3::zeros()))).unwrap();
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
            take(&mut inertia, &step(number, still, 0.05, 0.0), Some(&push(still)));
        }
        take(&mut inertia, &step(20, Vector3::new(struck, 0.0, 0.0), noise, 0.0), Some(&push(still))).unwrap()
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
        take(&mut inertia, &step(number, still, 0.05, 0.0), Some(&push(still)));
    }
    let struck = Vector3::new(1.0, 0.0, 0.0);
    assert!(take(&mut inertia, &step(20, struck, 0.05, 0.0), Some(&push(still))).is_none());
    let next = take(&mut inertia, &step(21, still, 0.05, 0.0), Some(&push(still))).unwrap();
    assert!(next.linear.norm() < 1e-12 && next.covariance[(0, 0)] < 0.4 * 0.05 * 0.05, "{next:?}");

    assert!(take(&mut inertia, &step(22, struck, 0.05, 0.0), Some(&push(still))).is_none());
    assert!(take(&mut inertia, &step(23, struck, 0.05, 0.0), Some(&push(still))).is_none());
    let next = take(&mut inertia, &step(24, struck, 0.05, 0.0), Some(&push(still))).unwrap();
    assert!((next.linear - struck).norm() < 1e-12 && next.covariance[(0, 0)] > 0.4 * 0.05 * 0.05, "{next:?}");
    // Nor does anything lead over a gap, or from what was forgotten.
    assert_eq!(inertia.before(Stamp(26 * PERIOD_NS)), None);
    inertia.forget();
    assert_eq!(inertia.before(Stamp(25 * PERIOD_NS)), None);
    assert!(take(&mut inertia, &step(25, still, 0.05, 0.0), Some(&push(still))).is_none());
}

/// By how much the gyro's bias moves the velocity: the distance to the ground.
const HEIGHT_M: f64 = 20.0;

#[test]
fn what_is_learnt_of_the_bias_is_taken_off_everything() {
    let (mut bias, mut inertia) = (Bias::new(0.003), Inertia::default());
    let wrong = Vector3::new(0.004, -0.002, 0.0);
    let step = |number| {
        let mut step = step(number, wrong * HEIGHT_M, 0.02, 0.0);
        for (state, part) in bias.believed().units().take(3).enumerate() {
            step.lasting.set_column(LASTING - 11 + state, &(part.bias * HEIGHT_M));
        }
        step
    };
    let still = push(Vector3::zeros());
    inertia.take(&step(0), None, BIAS_SD, &bias.believed());
    for number in 1..20 {
        let weighed = inertia.take(&step(number), Some(&still), BIAS_SD, &bias.believed()).unwrap();
        assert!((weighed.linear - wrong * HEIGHT_M).norm() < 1e-12, "nothing is known of it");
        assert!(weighed.covariance[(0, 0)] > (0.003 * HEIGHT_M).powi(2));
    }
    let last = step(20);
    let shown = Shown {
        angle: wrong,
        interval_s: 1.0,
        noise: Matrix3::identity() * 1e-12,
        by_slope: Matrix3x2::zeros(),
        bent: 0.0,
    };
    assert!(bias.take(&shown));
    let weighed = inertia.take(&last, Some(&still), BIAS_SD, &bias.believed()).unwrap();
    assert!(weighed.linear.norm() < 1e-4 && weighed.covariance[(0, 0)] < 1e-4, "{weighed:?}");
}

/// Mean normalised error squared over its degrees of freedom, and the deviation of the error, of a hover whose steps scatter by
/// `scatter` (m/s) and whose gyro by `gyro` (rad), with what a kept frame shows where it is `looked` at, again and again.
fn hover(scatter: f64, gyro: f64, looked: bool) -> (f64, f64) {
    const DRAWS: u64 = 200;
    let (mut nees, mut square) = (0.0, 0.0);
    for draw in 0..DRAWS {
        let mut draws = Normal(ChaCha8Rng::seed_from_u64(draw));
        let (mut inertia, mut truth) = (Inertia::default(), Vector3::zeros());
        let leak = draws.three(((GRAVITY * 0.005).powi(2) + BIAS_SD * BIAS_SD).sqrt());
        let (mut moved, mut turned, mut found) = (Vector3::zeros(), Vector3::zeros(), None);
        let of = |number, linear: Vector3<f64>, scatter: f64, gyro: f64, seconds: f64| {
            let by_gyro = Matrix3::identity() * (HEIGHT_M * gyro / seconds);
            let noise = Matrix3::identity() * scatter.powi(2) + by_gyro * by_gyro;
            let by_vectors = Matrix3::identity() * scatter.powi(2);
            Step { noise, by_vectors, by_gyro, gyro_sd: gyro, ..step(number, linear, scatter, 0.0) }
        };
        for number in 0..20 {
            let (change, turn) = (draws.three(0.1), draws.three(gyro));
            truth += change;
            let seen = truth + draws.three(scatter) + turn * HEIGHT_M / PERIOD_S;
            let push = push(change + leak * PERIOD_S + draws.three(1e-3));
            found = take(&mut inertia, &of(number, seen, scatter, gyro, PERIOD_S), Some(&push)).or(found);
            if number == 0 {
                inertia.begin(Stamp(PERIOD_NS));
                continue;
            }
            (moved, turned) = (moved + truth * PERIOD_S, turned + turn);
            let off = draws.three(scatter * PERIOD_S);
            if looked && number % 4 == 0 {
                let seconds = PERIOD_S * number as f64;
                let linear = (moved + off + turned * HEIGHT_M) / seconds;
                let gyro = gyro * (number as f64).sqrt();
                let back = of(0, linear, scatter * PERIOD_S / seconds, gyro, seconds);
                let back = Step { older: Stamp(PERIOD_NS), newer: Stamp((number + 1) * PERIOD_NS), ..back };
                inertia.look_back(&back, &nothing());
            }
        }
        let found = found.unwrap();
        let error = found.linear - truth;
        nees += error.dot(&(found.covariance.try_inverse().unwrap() * error)) / 3.0;
        square += error.norm_squared() / 3.0;
    }
    (nees / DRAWS as f64, (square / DRAWS as f64).sqrt())
}

#[test]
fn a_kept_frame_ends_the_wandering_of_the_steps_scatter() {
    let (alone, beside) = (hover(0.08, 0.0, false), hover(0.08, 0.0, true));
    println!("{alone:.4?} alone, {beside:.4?} with a frame that is kept");
    assert!(beside.1 < 0.8 * alone.1, "{} {}", alone.1, beside.1);
    assert!((0.8..1.25).contains(&alone.0) && (0.8..1.25).contains(&beside.0), "{} {}", alone.0, beside.0);
}

#[test]
fn the_gyros_noise_is_the_same_in_both() {
    let (alone, beside) = (hover(1e-4, 1e-4, false), hover(1e-4, 1e-4, true));
    println!("{alone:.4?} alone, {beside:.4?} with a frame that is kept");
    assert!((beside.1 - alone.1).abs() < 0.02 * alone.1, "{} {}", alone.1, beside.1);
    assert!((0.8..1.25).contains(&alone.0) && (0.8..1.25).contains(&beside.0), "{} {}", alone.0, beside.0);
}

#[test]
fn a_kept_frame_that_contradicts_or_is_another_says_nothing() {
    let still = Vector3::zeros();
    let back = |since: i64, linear| Step {
        older: Stamp(since * PERIOD_NS),
        newer: Stamp(10 * PERIOD_NS),
        ..step(0, linear, 0.01, 0.0)
    };
    let told = |back: Option<Step>| {
        let mut inertia = Inertia::default();
        for number in 0..11 {
            if let (10, Some(back)) = (number, &back) {
                inertia.look_back(back, &nothing());
            }
            let off = Vector3::repeat(if number % 2 == 0 { 0.03 } else { -0.02 });
            let weighed = take(&mut inertia, &step(number, off, 0.05, 0.0), Some(&push(still)));
            if number == 10 {
                return weighed.unwrap().linear;
            }
            if number == 1 {
                inertia.begin(Stamp(2 * PERIOD_NS));
            }
        }
        unreachable!("the last step returns")
    };
    let nothing = told(None);
    assert_ne!(told(Some(back(2, still))), nothing);
    assert_eq!(told(Some(back(2, Vector3::repeat(1.0)))), nothing, "moved by a quarter of a metre");
    assert_eq!(told(Some(back(2, Vector3::repeat(f64::NAN)))), nothing);
    assert_eq!(told(Some(back(3, still))), nothing, "another frame");
    assert_eq!(told(Some(Step { newer: Stamp(9 * PERIOD_NS), ..back(2, still) })), nothing, "not the newest");
}
