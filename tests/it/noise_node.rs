//! The node's own estimate of its camera's noise, and what follows from it.

use std::sync::Arc;

use nightflow::{
    camera::{Frame, Sample},
    clock::{Stamp, Untimed},
    config::Config,
    darkness::{
        flight::{self, Flight, Settings},
        noise::{Noise, Normals},
    },
    exposure::Developer,
    flow::{Cause, Fake, Matcher, Own, State},
    pipeline::{Outcome, Pipeline},
    publish::Moved,
    wire::{Header, Image},
};

fn config() -> Config {
    let text =
        format!("[exposure]\nbit_depth = 12\nblack_level = {}.0\nwhite_level = {}.0\n", flight::BLACK, flight::WHITE);
    Config::parse(&text, std::path::Path::new("test")).unwrap()
}

/// The estimates of four flights' first frames, and the mean over black.
fn estimates(noise: Noise, mean: f64) -> (Vec<[f64; 2]>, f64) {
    let settings = |seed| Settings {
        seed,
        mean: [mean; 2],
        size: [480, 360],
        height: 8.0,
        noise: Some(noise),
        ..Settings::default()
    };
    let mut found = Vec::new();
    let mut raw_mean = 0.0;
    for seed in 0..4 {
        let shot = Flight::new(settings(seed)).unwrap().next().unwrap();
        let Some(Sample::Frame(frame)) = shot.samples.last() else { panic!("no frame") };
        let mut developer = Developer::new(&config().exposure).unwrap();
        developer.develop(frame).unwrap();
        let exposed = developer.newest().unwrap();
        let noise = exposed.noise.unwrap();
        found.push([noise.a, noise.b]);
        raw_mean += f64::from(exposed.raw_mean) / 4.0;
    }
    (found, raw_mean)
}

#[test]
fn a_flight_into_the_dark_knows_its_noise() {
    // The same for all colours, as one estimate stands for them.
    let (a, b) = (1.2e-4, 4e-7);
    let noise = Noise { a: [a; 3], b: [b; 3] };
    for (mean, most) in [(0.06, 1.8), (0.02, 1.4), (0.008, 1.25), (0.004, 1.15)] {
        let (found, raw_mean) = estimates(noise, mean);
        let truth = (a * raw_mean + b).sqrt();
        for [a, b] in found {
            let deviation = (a * raw_mean + b).max(0.0).sqrt();
            println!("raw mean {raw_mean:.4}: a {a:.2e}, b {b:+.2e}, deviation {:.3} of the true", deviation / truth);
            // The ground is textured as finely as its pixels and nowhere smooth; in good light some of it passes for noise.
            assert!((0.88..most).contains(&(deviation / truth)), "raw mean {raw_mean}: {deviation} of {truth}");
        }
    }
}

/// A soft picture that slides over the sensor, with the camera's noise on it, at a raw mean.
fn frame(index: i64, mean: f64, [a, b]: [f64; 2]) -> Sample {
    let mut draws = Normals::new(11, index as u64);
    let mut bytes = Vec::with_capacity(320 * 256 * 2);
    for at in 0..320 * 256 {
        let [x, y] = [f64::from(at % 320), f64::from(at / 320)];
        let clean = mean * (1.0 + 0.8 * (0.03 * x - 0.1 * index as f64).sin() * (0.04 * y).cos());
        let value = clean + (a * clean + b).sqrt() * draws.draw();
        let span = f64::from(flight::WHITE - flight::BLACK);
        let count = f64::from(flight::BLACK) + value * span;
        bytes.extend((count.round().clamp(0.0, 4095.0) as u16).to_le_bytes());
    }
    let stamp = Stamp::from_ns(1_700_000_000_000_000_000 + index * 33_333_333);
    let image = Image {
        header: Header { stamp: stamp.into(), frame_id: "camera_optical".into() },
        height: 256,
        width: 320,
        encoding: "bayer_rggb16".into(),
        is_bigendian: 0,
        step: 640,
        data: bytes,
    };
    Sample::Frame(Arc::new(Frame { image, received: stamp }))
}

fn pipeline() -> Pipeline {
    let config = config();
    Pipeline::with(&config, Matcher::with(&config.flow, Box::new(Fake::shift(0.0, 0.0)))).unwrap()
}

fn step(pipeline: &mut Pipeline, sample: &Sample) -> Option<Moved> {
    match pipeline.step(sample, &mut Own::default(), &mut Untimed).unwrap() {
        Outcome::Moved(moved) => Some(moved),
        _ => None,
    }
}

/// The raw mean at which a camera's noise has a level in the network's image: cells of four pixels, green twice.
fn mean_at(level: f64, [a, b]: [f64; 2]) -> f64 {
    let level_at = |mean: f64| 102.0 * ((a * mean + b) / 1.2).sqrt() / mean;
    let (mut low, mut high) = (1e-6, 1.0);
    for _ in 0..60 {
        let middle = f64::sqrt(low * high);
        if level_at(middle) > level { low = middle } else { high = middle }
    }
    low
}

#[test]
fn noise_makes_degraded_and_blind_at_the_same_level_for_every_camera() {
    let mut means = Vec::new();
    // A quiet sensor, and one with forty times its variance.
    for camera in [[2.5e-5, 2e-7], [1e-3, 8e-6]] {
        for (level, word) in [(12.0, "ok"), (24.0, "ok"), (38.0, "degraded"), (94.0, "blind")] {
            let mean = mean_at(level, camera);
            let mut pipeline = pipeline();
            assert!(step(&mut pipeline, &frame(0, mean, camera)).is_none());
            let moved = step(&mut pipeline, &frame(1, mean, camera)).unwrap();
            let found = moved.noise_level.unwrap();
            println!("{camera:?} at a raw mean of {mean:.5}: level {found:.1} of {level}: {:?}", moved.state);
            assert!((f64::from(found) / level - 1.0).abs() < 0.12, "level {found} of {level}");
            let right = match (&moved.state, word) {
                (State::Ok, "ok") => true,
                (State::Degraded(Cause::Noisy { allowed, .. }), "degraded") => *allowed == 30.0,
                (State::Blind(Cause::Noisy { allowed, .. }), "blind") => *allowed == 75.0,
                _ => false,
            };
            assert!(right, "level {level} should be {word}, found {:?}", moved.state);
            means.push(mean);
        }
    }
    assert!(means[5] > 5.0 * means[1], "what is dark for one camera is not for the other: {means:?}");
}

#[test]
fn the_estimate_is_renewed_once_a_second_by_the_frames_own_stamps() {
    let mut pipeline = pipeline();
    let mut changes = Vec::new();
    let mut known = None;
    for index in 0..70 {
        // Every frame has another noise, so that a new estimate shows.
        let sample = frame(index, 0.05, [1e-4 * (1.0 + 0.02 * index as f64), 1e-6]);
        let found = step(&mut pipeline, &sample).and_then(|moved| moved.noise);
        if found != known {
            changes.push(index);
            known = found;
        }
    }
    // The first shows with the first pair; a second is 30 frames and a rounding.
    assert_eq!(changes.len(), 3, "{changes:?}");
    assert!(changes[0] == 1 && (30..=31).contains(&changes[1]) && (60..=62).contains(&changes[2]), "{changes:?}");
}
