//! A gyro clock and a flow scale that are off are told with their figures.

use super::*;

/// A flight that turns to and fro, with a flow that is `scale` times too long and a gyro clock that is ahead.
fn turning(velocity: Vector3<f64>, scale: f64, ahead_ns: i64) -> Odometer {
    let phase = |axis: usize, at: f64| (4.0 + axis as f64) * at + axis as f64;
    let rates = |at: f64| Vector3::from_fn(|axis, _| 0.4 * phase(axis, at).cos());
    let turned = |at: f64| Vector3::from_fn(|axis, _| 0.4 * phase(axis, at).sin() / (4.0 + axis as f64));
    let mut draws = Normals::new(3, 9);
    let mut truth = Truth::hovering(5.0);
    truth.velocity = velocity;
    truth.config.turn_scale_off_max = 0.015;
    let mut odometer = Odometer::new(&truth.config).unwrap();
    odometer.info(&calibration()).unwrap();
    let step_ns = truth.newer_ns() - OLDER_NS;
    let mut gyro_ns = OLDER_NS - 50_000_000;
    for step in 0..300 {
        let older_ns = OLDER_NS + step * step_ns;
        let [from, to] = [older_ns, older_ns + step_ns].map(|ns| (ns - OLDER_NS) as f64 * 1e-9);
        truth.rates = (turned(to) - turned(from)) / (to - from);
        let mut seen = truth.exact();
        seen.vectors.iter_mut().for_each(|v| *v = (scale * f64::from(*v) + 0.3 * draws.draw()) as f32);
        while gyro_ns <= older_ns + step_ns + 10_000_000 {
            let noise = Vector3::from_fn(|_, _| 0.005 * draws.draw());
            odometer.imu(&imu(gyro_ns + ahead_ns, rates((gyro_ns - OLDER_NS) as f64 * 1e-9) + noise, None)).unwrap();
            gyro_ns += 5_000_000;
        }
        odometer.range(&reach(older_ns, 5.0)).unwrap();
        let flow = Flow { older: Stamp(older_ns), newer: Stamp(older_ns + step_ns), ..truth.flow(&seen) };
        odometer.velocity(&flow, SIZE).unwrap();
    }
    odometer
}

#[test]
fn a_gyro_clock_that_is_off_is_told_with_its_figure() {
    for velocity in [Vector3::zeros(), Vector3::new(1.5, -0.5, 0.2)] {
        let late = turning(velocity, 1.0, -5_000_000);
        let drift = late.drift().unwrap();
        println!("{drift:?}");
        assert!(
            (drift.offset_s + 5e-3).abs() < 3.0 * drift.offset_sd_s + 3e-4 && drift.offset_sd_s < 5e-4,
            "{drift:?}"
        );
        let said = late.diagnosis().unwrap().to_string();
        assert!(said.starts_with("the gyro's clock is ") && said.ends_with(" ms behind the camera's"), "{said}");
    }
}

#[test]
fn a_flow_that_turns_too_far_is_told_with_its_figure() {
    let long = turning(Vector3::zeros(), 1.03, 0);
    let drift = long.drift().unwrap();
    println!("{drift:?}");
    for axis in 0..3 {
        let (off, sd) = ((drift.scale[axis] - 1.03).abs(), drift.scale_sd[axis]);
        assert!(off < 3.0 * sd + 1e-3 && sd < 0.01, "{drift:?}");
    }
    assert!(matches!(long.diagnosis(), Some(Diagnosis::Scale { .. })), "{drift:?}");
    // In flight only the turn about the optical axis is told apart from the motion, and the others are not guessed.
    for velocity in [Vector3::zeros(), Vector3::new(1.5, -0.5, 0.2)] {
        let right = turning(velocity, 1.0, 0);
        assert_eq!(right.diagnosis(), None, "{:?}", right.drift());
    }
    let flown = turning(Vector3::new(4.0, -0.5, 0.2), 1.03, 0).drift().unwrap();
    assert!(flown.scale_sd[0] > 0.1 && (flown.scale[2] - 1.03).abs() < 3.0 * flown.scale_sd[2] + 1e-3, "{flown:?}");
}
