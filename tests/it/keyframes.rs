//! A hover in which a frame is kept: what it shows of the gyro's bias, and what must not disturb it.

use std::{path::Path, sync::Arc};

use nalgebra::Vector3;
use nightflow::{
    camera::{Frame, Sample},
    clock::{Stamp, Untimed},
    config::Config,
    darkness::{
        flight::{BLACK, Flight, Settings, WHITE},
        noise::Normals,
    },
    exposure::Exposed,
    flow::{Fake, Grid, Keyframe, Matcher, Own, State},
    motion::Velocity,
    pipeline::{Outcome, Pipeline},
    wire::Imu,
};

const BIAS: Vector3<f64> = Vector3::new(0.004, -0.005, 0.0);

fn settings(keyframes: bool) -> Config {
    let mut config = Config::parse("", Path::new("test")).unwrap();
    config.exposure.bit_depth = Some(12);
    config.exposure.black_level = Some(f32::from(BLACK));
    config.exposure.white_level = Some(f32::from(WHITE));
    config.motion.keyframes = keyframes;
    // The flight's ground is level. Who does not know that takes a while to tell climbing over a slope from turning.
    (config.motion.ground_bend_sd, config.motion.ground_slope_sd) = (0.01, 0.01);
    config
}

/// A second and a half over 12 m, its gyro off by [`BIAS`]; body rates at the frames.
fn hover() -> (Vec<Sample>, Vec<Vector3<f64>>) {
    let flight = Settings { seed: 4, seconds: 1.5, speed: 0.0, height: 12.0, mean: [0.05; 2], ..Settings::default() };
    let (mut samples, mut rates) = (vec![], vec![]);
    for shot in Flight::new(flight).unwrap() {
        rates.push(Vector3::from(shot.truth.rates));
        samples.extend(shot.samples.into_iter().map(|sample| match sample {
            Sample::Imu(imu) => {
                let mut imu = Imu::clone(&imu);
                let w = &mut imu.angular_velocity;
                (w.x, w.y, w.z) = (w.x + BIAS.x, w.y + BIAS.y, w.z + BIAS.z);
                Sample::Imu(Arc::new(imu))
            }
            other => other,
        }));
    }
    (samples, rates)
}

/// What becomes of every step, and whether it was blind.
fn fly(samples: &[Sample], keyframes: bool) -> Vec<(bool, Option<Velocity>)> {
    let config = settings(keyframes);
    // A hover's vectors are short enough for the gradients to find them from nothing.
    let network = Box::new(Fake::shift(0.0, 0.0).with_uncertainty(0.6));
    let mut pipeline = Pipeline::with(&config, Matcher::with(&config.flow, network)).unwrap();
    let (mut own, mut found) = (Own::default(), vec![]);
    for sample in samples {
        if let Ok(Outcome::Moved(moved)) = pipeline.step(sample, &mut own, &mut Untimed) {
            found.push((matches!(moved.state, State::Blind(_)), moved.velocity.ok()));
        }
    }
    found
}

/// What is left of the bias across the optical axis on the average of some steps, rad/s.
fn left(steps: &[(bool, Option<Velocity>)], rates: &[Vector3<f64>], of: std::ops::Range<usize>) -> f64 {
    let errors = of.clone().map(|step| {
        let truth = 0.5 * (rates[step] + rates[step + 1]);
        let found = Vector3::from(steps[step].1.as_ref().unwrap().angular);
        found - truth
    });
    // The gyro's own noise is new in every step.
    (errors.sum::<Vector3<f64>>() / of.len() as f64).xy().norm()
}

#[test]
fn a_frame_that_is_kept_shows_the_bias() {
    let (samples, rates) = hover();
    let [kept, plain] = [true, false].map(|keyframes| fly(&samples, keyframes));
    let [with, without] = [&kept, &plain].map(|steps| left(steps, &rates, 30..45));
    println!("{with:.5} rad/s are left with frames that are kept, {without:.5} without");
    assert!(with < 0.2 * BIAS.norm() && with < 0.5 * without, "{with} {without}");
    let again = fly(&samples, true);
    assert!(kept == again, "the same samples give the same bits");
}

#[test]
fn nothing_is_compared_over_a_blind_spell() {
    let (mut samples, rates) = hover();
    let mut frames = 0;
    for sample in &mut samples {
        if let Sample::Frame(frame) = sample {
            frames += 1;
            if (20..24).contains(&frames) {
                let mut frame = Frame::clone(frame);
                frame.image.data.chunks_exact_mut(2).for_each(|two| two.copy_from_slice(&BLACK.to_le_bytes()));
                *sample = Sample::Frame(Arc::new(frame));
            }
        }
    }
    let steps = fly(&samples, true);
    assert_eq!(steps.len(), 45);
    let blind: Vec<usize> = (0..45).filter(|step| steps[*step].0).collect();
    assert!(blind.len() >= 4 && blind.iter().all(|step| (18..24).contains(step)), "{blind:?}");
    assert!(blind.iter().all(|step| steps[*step].1.is_none()));
    let after = left(&steps, &rates, 38..45);
    assert!(after < 0.2 * BIAS.norm(), "{after}");
}

/// A texture, moved to the right by so many pixels, under light of this strength.
fn frame(number: u64, moved: f64, light: f32) -> Exposed {
    let [width, height] = [96, 64];
    let wave = |x: f64, y: f64, number: u64| {
        let mut draws = Normals::new(number, 9);
        let (angle, length) = (std::f64::consts::TAU * draws.uniform(), 5.0 + 15.0 * draws.uniform());
        (std::f64::consts::TAU * (x * angle.cos() + y * angle.sin()) / length).sin()
    };
    let value = |pixel: usize| {
        let (x, y) = ((pixel % width) as f64 - moved, (pixel / width) as f64);
        0.1 + 0.005 * (0..12).map(|number| wave(x, y, number)).sum::<f64>()
    };
    let plane: Vec<f32> = (0..width * height).map(|pixel| light * value(pixel) as f32).collect();
    let gain = 4.0;
    Exposed {
        stamp: Stamp(number as i64 * 33_000_000),
        width,
        height,
        scale: [2.0; 2],
        rgb: plane.repeat(3).iter().map(|value| gain * value).collect(),
        linear: plane.repeat(3),
        saturated: vec![0; width * height],
        raw_mean: 0.1 * light,
        gain,
        generation: number,
        ..Exposed::default()
    }
}

/// What is expected to have stood still.
fn still(grid: &Grid, vectors: &mut Vec<f32>) -> Option<()> {
    vectors.clear();
    vectors.resize(2 * grid.cells(), 0.0);
    Some(())
}

#[test]
fn light_that_fades_moves_nothing_and_another_lamp_is_not_compared() {
    let mut key = Keyframe::default();
    assert!(key.flow(&frame(1, 0.0, 1.0), &mut still).is_none(), "nothing was kept");
    key.keep(&frame(1, 0.0, 1.0));
    for (number, light) in [(2, 1.0), (3, 0.75)] {
        let newer = frame(number, 0.4, light);
        let (flow, gradients) = key.flow(&newer, &mut still).unwrap();
        assert_eq!((flow.grid.width, flow.grid.height, flow.older), (24, 16, Stamp(33_000_000)));
        // Camera pixels: two of a pixel.
        let middle = flow.vectors[2 * (8 * 24 + 12)];
        assert!((middle - 0.8).abs() < 0.02, "light {light}: {middle} px of 0.8");
        assert!(gradients.information[0].iter().sum::<f32>() > 0.0);
    }
    assert!(key.flow(&frame(3, 0.4, 3.0), &mut still).is_none(), "another lamp's light");
    assert!(key.flow(&frame(3, 0.4, 1.0), &mut still).is_none(), "and what was kept is of no use from there on");
    key.keep(&frame(4, 0.0, 1.0));
    let smaller = Exposed { width: 48, height: 128, ..frame(5, 0.4, 1.0) };
    assert!(key.flow(&smaller, &mut still).is_none(), "another size");
    key.keep(&frame(6, 0.0, 1.0));
    let nowhere = &mut |grid: &Grid, vectors: &mut Vec<f32>| {
        still(grid, vectors)?;
        vectors.fill(f32::NAN);
        Some(())
    };
    let (flow, gradients) = key.flow(&frame(7, 0.4, 1.0), nowhere).unwrap();
    assert!(flow.confidence.iter().all(|confidence| *confidence == 0.0));
    assert!(gradients.information.iter().all(|plane| plane.iter().all(|value| *value == 0.0)));
    assert!(key.flow(&frame(8, 0.4, 1.0), &mut |_, _| None).is_none(), "nobody knows");
}
