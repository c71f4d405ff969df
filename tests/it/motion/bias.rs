//! What the flow shows of the gyro's bias is learnt and taken off, and what is no bias isn't.

use super::*;

/// Steps of a hover over `height` metres (or a flight at `velocity`) with a gyro that is off by `bias`, from `step` on.
fn fly(
    odometer: &mut Odometer,
    truth: &Truth,
    bias: Vector3<f64>,
    steps: std::ops::Range<i64>,
    bent: impl Fn([f64; 2]) -> [f64; 2],
) -> Vec<Velocity> {
    let mut draws = Normals::new(5, steps.start.cast_unsigned());
    let step_ns = truth.newer_ns() - OLDER_NS;
    let exact = truth.exact();
    let step = |step: i64| {
        let older_ns = OLDER_NS + step * step_ns;
        for sample in -1..11 {
            let noise = Vector3::from_fn(|_, _| 0.005 * draws.draw());
            let ns = (older_ns / 4_000_000 + sample) * 4_000_000;
            // Those that the step before brought are refused.
            let _ = odometer.imu(&imu(ns, truth.rates + bias + noise, Some(truth.attitude)));
        }
        odometer.range(&reach(older_ns, truth.height as f32)).unwrap();
        let mut vectors = exact.vectors.clone();
        for (cell, vector) in vectors.as_chunks_mut::<2>().0.iter_mut().enumerate() {
            let slope = [cell % GRID.width, cell / GRID.width];
            let slope = [(slope[0] as f64 - 39.5) * 8.0 / FOCAL, (slope[1] as f64 - 29.5) * 8.0 / FOCAL];
            for (value, more) in vector.iter_mut().zip(bent(slope)) {
                *value += (0.1 * draws.draw() + more) as f32;
            }
        }
        let flow =
            Flow { older: Stamp(older_ns), newer: Stamp(older_ns + step_ns), vectors: &vectors, ..truth.flow(&exact) };
        odometer.velocity(&flow, SIZE).unwrap()
    };
    steps.map(step).collect()
}

fn odometer(truth: &Truth) -> Odometer {
    let mut odometer = Odometer::new(&truth.config).unwrap();
    odometer.info(&calibration()).unwrap();
    odometer
}

const BIAS: Vector3<f64> = Vector3::new(0.004, -0.005, 0.002);

#[test]
fn a_hover_learns_the_bias_and_stands_still() {
    let truth = Truth::hovering(10.0);
    let mut odometer = odometer(&truth);
    let steps = fly(&mut odometer, &truth, BIAS, 0..200, |_| [0.0; 2]);
    let speed = |velocity: &Velocity| Vector3::from(velocity.linear).norm();
    let sd = |velocity: &Velocity| (velocity.covariance[0][0] + velocity.covariance[1][1]).sqrt();
    let late: f64 = steps[150..].iter().map(speed).sum::<f64>() / 50.0;
    println!("{:.4} ± {:.4} m/s, then {late:.4} ± {:.4} m/s", speed(&steps[0]), sd(&steps[0]), sd(&steps[199]));
    assert!(late < 0.02, "a bias of 0.006 rad/s at 10 m is 0.064 m/s: {late}");
    assert!(sd(&steps[199]) < 0.75 * sd(&steps[0]), "{} {}", sd(&steps[0]), sd(&steps[199]));
    let turn: Vector3<f64> = steps[150..].iter().map(|step| Vector3::from(step.angular)).sum::<Vector3<f64>>() / 50.0;
    assert!(turn.norm() < 0.3 * BIAS.norm(), "{turn}");

    // A bias that jumps is doubted first, and then learnt anew.
    let steps = fly(&mut odometer, &truth, -BIAS, 200..400, |_| [0.0; 2]);
    let soon: Vector3<f64> = steps[1..5].iter().map(|step| Vector3::from(step.angular)).sum::<Vector3<f64>>() / 4.0;
    assert!((soon + 2.0 * BIAS).norm() < 0.005, "what was learnt is taken off, wrongly: {soon}");
    let late: f64 = steps[150..].iter().map(speed).sum::<f64>() / 50.0;
    assert!(late < 0.02, "{late}");

    // A recording that is played anew may be another vehicle's.
    assert!(matches!(
        odometer.imu(&imu(OLDER_NS - 9_000_000_000, BIAS, None)),
        Err(Error::Backwards { anew: true, .. })
    ));
    assert!(odometer.range(&reach(OLDER_NS - 9_000_000_000, 10.0)).is_err());
    let anew = Vector3::from(fly(&mut odometer, &truth, BIAS, -200..-199, |_| [0.0; 2])[0].angular);
    assert!((anew - BIAS).norm() < 0.005, "the first step knows of no bias: {anew}");
}

/// In a valley the ground bends; that bends the vectors as a turn does, and is not taken for one.
#[test]
fn ground_that_bends_is_no_bias() {
    let mut truth = Truth::hovering(10.0);
    truth.velocity = Vector3::new(5.0, 0.0, 0.0);
    let fit = |bend: f64| {
        let tau = truth.velocity.x * truth.interval_s / truth.height;
        let mut odometer = odometer(&truth);
        // Forward is up in the image, and the ground moves down.
        let steps =
            fly(&mut odometer, &truth, Vector3::zeros(), 0..60, |[x, y]| [0.0, FOCAL * tau * bend * (x * x + y * y)]);
        Vector3::from(steps[59].linear) - truth.velocity
    };
    let [flat, bent] = [fit(0.0), fit(0.05)];
    println!("{flat} {bent}");
    assert!(flat.norm() < 0.1, "{flat}");
    // A fit alone is off by what the ground's mean differs by, 5 % × 0.16 of 5 m/s, and range knows the middle.
    assert!((bent - flat).norm() < 0.09, "{bent} beside {flat}");
}

/// Vectors that turn by far more than the gyro can be wrong by are not the gyro's error.
#[test]
fn what_no_gyro_errs_by_is_not_taken_off_nor_learnt() {
    let truth = Truth::hovering(5.0);
    let mut odometer = odometer(&truth);
    let step = |odometer: &mut Odometer, from: i64, wrong: f64| {
        let turned = wrong * truth.interval_s * FOCAL;
        fly(odometer, &truth, Vector3::zeros(), from..from + 20, |[x, y]| [turned * (1.0 + x * x), turned * x * y])
    };
    let wrong = step(&mut odometer, 0, 0.2);
    let angular = Vector3::from(wrong[19].angular);
    assert!(angular.norm() < 0.01, "the gyro's word stands: {angular}");
    let right = step(&mut odometer, 20, 0.0);
    let angular = Vector3::from(right[0].angular);
    assert!(angular.norm() < 0.01 && Vector3::from(right[0].linear).norm() < 0.05, "{:?}", right[0]);
}
