//! The laboratory: noise has the moments that it states, and the flight's truth is what its pictures show.

use nalgebra::Vector3;
use nightflow::{
    camera::Sample,
    darkness::{
        course::{self, Course, Thing},
        flight::{self, Flight, Settings, Shot, TrueFlow},
        noise::{Noise, Normals},
        pan::{self, Pan, Photograph},
        profiles,
    },
    flow::Flow,
    motion::{Config, Odometer, Scale},
    wire::Image,
};

#[test]
fn normal_and_poisson_draws_have_their_moments() {
    let mut draws = Normals::new(3, 1);
    let n = 200_000;
    let moments = |values: Vec<f64>| {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let central = |p| values.iter().map(|v| (v - mean).powi(p)).sum::<f64>() / values.len() as f64;
        (mean, central(2), central(3), central(4))
    };
    let (mean, variance, skew, kurtosis) = moments((0..n).map(|_| draws.draw()).collect());
    assert!(mean.abs() < 0.01 && (variance - 1.0).abs() < 0.02 && skew.abs() < 0.03 && (kurtosis - 3.0).abs() < 0.1);
    for expected in [0.3, 4.0, 11.9, 12.1, 80.0, 3000.0] {
        let (mean, variance, skew, _) = moments((0..n).map(|_| draws.poisson(expected)).collect());
        let error = 5.0 * (expected / n as f64).sqrt();
        assert!((mean - expected).abs() < error, "Poisson {expected}: mean {mean}");
        assert!((variance / expected - 1.0).abs() < 0.03, "Poisson {expected}: variance {variance}");
        assert!((skew / expected - 1.0).abs() < 0.5 + expected / 100.0, "Poisson {expected}: third moment {skew}");
    }
}

#[test]
fn noise_has_the_variance_of_its_model() {
    let noise = Noise { a: [0.004, 0.003, 0.005], b: [2e-6, 1e-6, 3e-6] };
    let n = 100_000;
    for (colour, clean) in [(0, 0.0), (1, 0.002), (2, 0.02), (1, 0.4)] {
        for counted in [false, true] {
            let mut draws = Normals::new(9, colour as u64);
            let draw = |_| {
                if counted {
                    noise.counted(colour, clean, &mut draws)
                } else {
                    noise.gaussian(colour, clean, &mut draws)
                }
            };
            let values: Vec<f64> = (0..n).map(draw).collect();
            let mean = values.iter().sum::<f64>() / n as f64;
            let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n as f64;
            let expected = noise.variance(colour, clean);
            assert!(
                (mean - clean).abs() < 5.0 * (expected / n as f64).sqrt(),
                "counted {counted}: mean {mean} of {clean}"
            );
            assert!((variance / expected - 1.0).abs() < 0.04, "counted {counted}: {variance} of {expected}");
        }
    }
    // Attenuated and noised further is what the camera would have seen in less light.
    let (clean, factor) = (0.05, 0.08);
    let rest = noise.darkening(factor);
    let total = factor * factor * noise.variance(1, clean) + rest.variance(1, factor * clean);
    assert!((total / noise.variance(1, factor * clean) - 1.0).abs() < 1e-12);
}

#[test]
fn draws_do_not_depend_on_their_order() {
    let row = |stream| (0..5).map(|_| Normals::new(4, stream).draw()).collect::<Vec<_>>();
    let (a, b) = (row(1), row(2));
    assert_eq!((row(2), row(1)), (b.clone(), a.clone()));
    assert_ne!(a, b);
}

#[test]
fn profiles_are_found_and_never_negative() {
    assert_eq!(profiles::all().count(), 267);
    let m6 = profiles::find("canon eos m6", 3200).unwrap();
    assert_eq!(m6.a, [0.0001169, 0.0001032, 0.0002621]);
    assert_eq!(profiles::find("Canon EOS 30D", 640).unwrap().b, [0.0, 0.0, 8.597e-07]);
    assert!(profiles::all().all(|profile| profile.noise.b.iter().all(|b| *b >= 0.0)));
    let camera = profiles::find("Brownie", 100).unwrap_err().to_string();
    assert!(camera.contains("Brownie") && camera.contains("Sony ILCE-6000"), "{camera}");
    let iso = profiles::find("Canon EOS M6", 3201).unwrap_err().to_string();
    assert!(iso.contains("3201") && iso.contains("3200"), "{iso}");
}

fn frame(samples: &[Sample]) -> &Image {
    let Some(Sample::Frame(frame)) = samples.last() else { panic!("the frame comes last") };
    &frame.image
}

/// Raw values 0…1 above black.
fn values(image: &Image) -> Vec<f64> {
    let white = f64::from(flight::WHITE - flight::BLACK);
    image
        .data
        .chunks_exact(2)
        .map(|b| (f64::from(u16::from_le_bytes([b[0], b[1]])) - f64::from(flight::BLACK)) / white)
        .collect()
}

/// Bayer cells as grey, at half size.
fn cells(image: &Image) -> (Vec<f64>, usize, usize) {
    let (raw, width) = (values(image), image.width as usize);
    let (columns, rows) = (width / 2, image.height as usize / 2);
    let grey = (0..rows * columns).map(|i| {
        let at = (i / columns) * 2 * width + (i % columns) * 2;
        (raw[at] + raw[at + 1] + raw[at + width] + raw[at + width + 1]) / 4.0
    });
    (grey.collect(), columns, rows)
}

fn sample(grey: &[f64], columns: usize, rows: usize, x: f64, y: f64) -> Option<f64> {
    let (i, j) = (x.floor(), y.floor());
    if i < 0.0 || j < 0.0 || i as usize + 1 >= columns || j as usize + 1 >= rows {
        return None;
    }
    let (fx, fy, at) = (x - i, y - j, j as usize * columns + i as usize);
    let upper = grey[at] * (1.0 - fx) + grey[at + 1] * fx;
    let lower = grey[at + columns] * (1.0 - fx) + grey[at + columns + 1] * fx;
    Some(upper * (1.0 - fy) + lower * fy)
}

/// Mean squared difference at the flow's cells between the older frame and the newer one fetched along `shift` (camera
/// pixels added to the true flow) or, without flow, at the same place.
fn residual(older: &Image, newer: &Image, flow: &TrueFlow, flowing: f64, shift: [f64; 2]) -> f64 {
    let (then, columns, rows) = cells(older);
    let (now, ..) = cells(newer);
    let mut differences = Vec::new();
    for cell in 0..flow.grid.cells() {
        let [u, v] = [0, 1].map(|axis| flowing * f64::from(flow.vectors[2 * cell + axis]) + shift[axis]);
        let x = ((cell % flow.grid.width) as f64 + 0.5) * 8.0 - 0.5;
        let y = ((cell / flow.grid.width) as f64 + 0.5) * 8.0 - 0.5;
        // A camera pixel p is the cell (p + 0.5) / 2 − 0.5.
        let cellwise = |x: f64, y: f64| [(x + 0.5) / 2.0 - 0.5, (y + 0.5) / 2.0 - 0.5];
        let ([ox, oy], [nx, ny]) = (cellwise(x, y), cellwise(x + u, y + v));
        if let (Some(a), Some(b)) = (sample(&then, columns, rows, ox, oy), sample(&now, columns, rows, nx, ny)) {
            differences.push((a - b) * (a - b));
        }
    }
    // The few cells that an obstacle hides or uncovers are no matter of flow.
    differences.sort_by(f64::total_cmp);
    let kept = &differences[..differences.len() * 9 / 10];
    kept.iter().sum::<f64>() / kept.len() as f64
}

#[test]
fn the_true_flow_carries_one_frame_onto_the_other() {
    for seed in [1, 2] {
        let settings = Settings {
            seed,
            noise: None,
            mean: [0.2, 0.2],
            speed: 4.0,
            seconds: 0.2,
            size: [320, 240],
            ..Settings::default()
        };
        let shots: Vec<Shot> = Flight::new(settings).unwrap().collect();
        assert_eq!(shots.len(), 7);
        for pair in shots.windows(2) {
            let [older, newer] = [0, 1].map(|i| frame(&pair[i].samples));
            carries(older, newer, pair[1].truth.flow.as_ref().unwrap(), &format!("seed {seed}"));
        }
    }
}

/// The true flow explains the pair, and neither no flow nor one that is half a cell off does.
fn carries(older: &Image, newer: &Image, flow: &TrueFlow, name: &str) {
    let right = residual(older, newer, flow, 1.0, [0.0; 2]);
    let still = residual(older, newer, flow, 0.0, [0.0; 2]);
    assert!(right < 0.05 * still, "{name}: true flow leaves {right:e}, no flow {still:e}");
    for shift in [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]] {
        let off = residual(older, newer, flow, 1.0, shift);
        assert!(right < 0.8 * off, "{name}: half a cell off by {shift:?} leaves {off:e}, the truth {right:e}");
    }
}

#[test]
fn the_true_flow_of_a_course_carries_one_frame_onto_the_other() {
    let crossing = Thing::pole(6.0, -1.5, 1.5).moving([0.0, 2.0, 0.0]);
    let settings = course::Settings {
        noise: None,
        mean: 0.2,
        size: [320, 240],
        things: vec![Thing::wall(8.0), crossing],
        ..course::Settings::default()
    };
    let mut course = Course::new(settings).unwrap();
    let shots: Vec<course::Shot> = (0..5).map(|_| course.shot([0.0, 0.5, 0.0])).collect();
    for pair in shots.windows(2) {
        let [older, newer] = [0, 1].map(|i| frame(&pair[i].samples));
        carries(older, newer, pair[1].truth.flow.as_ref().unwrap(), "course");
    }
    let samples: Vec<&Sample> = shots.iter().flat_map(|shot| &shot.samples).collect();
    assert!(samples.windows(2).all(|pair| pair[0].stamp() <= pair[1].stamp()));
    let count = |is: fn(&Sample) -> bool| samples.iter().filter(|sample| is(sample)).count();
    // 100 ms of lead and four periods of a fifteenth of a second, both ends included.
    assert_eq!(count(|s| matches!(s, Sample::Imu(_))), 74);
    assert_eq!(count(|s| matches!(s, Sample::Range(_))), 15);
}

#[test]
fn the_light_falls_as_asked_and_noise_is_the_cameras() {
    let noise = profiles::find("Canon EOS M6", 3200).unwrap();
    let settings = Settings { seconds: 0.1, size: [160, 120], ..Settings::default() };
    let noisy: Vec<Shot> = Flight::new(settings.clone()).unwrap().collect();
    let clean: Vec<Shot> = Flight::new(Settings { noise: None, ..settings.clone() }).unwrap().collect();
    let again: Vec<Shot> = Flight::new(settings).unwrap().collect();
    for (index, (shot, clean)) in noisy.iter().zip(&clean).enumerate() {
        let expected = 0.1 * (0.004_f64 / 0.1).powf(index as f64 / 3.0);
        let (with, without) = (values(frame(&shot.samples)), values(frame(&clean.samples)));
        let mean = without.iter().sum::<f64>() / without.len() as f64;
        assert!((mean / expected - 1.0).abs() < 0.25, "frame {index}: mean {mean}, asked for {expected}");
        let ratio: f64 = with
            .iter()
            .zip(&without)
            .enumerate()
            .map(|(i, (z, y))| {
                let colour = (i / 160) % 2 + i % 2;
                // Rounding to counts adds a twelfth of a count squared, twice.
                (z - y).powi(2) / (noise.variance(colour, *y) + 2.0 / 12.0 / 3839.0_f64.powi(2))
            })
            .sum::<f64>()
            / with.len() as f64;
        assert!((ratio - 1.0).abs() < 0.05, "frame {index}: noise is {ratio} of what the profile says");
        assert_eq!(frame(&shot.samples), frame(&again[index].samples), "the same seed gives the same frame");
    }
}

#[test]
fn samples_come_in_order_and_the_truth_fits_them() {
    let settings = Settings { seconds: 0.5, size: [64, 48], ..Settings::default() };
    let shots: Vec<Shot> = Flight::new(settings).unwrap().collect();
    let samples: Vec<&Sample> = shots.iter().flat_map(|shot| &shot.samples).collect();
    assert!(samples.windows(2).all(|pair| pair[0].stamp() <= pair[1].stamp()));
    let count = |is: fn(&Sample) -> bool| samples.iter().filter(|sample| is(sample)).count();
    assert_eq!(count(|s| matches!(s, Sample::Frame(_))), 16);
    assert_eq!(count(|s| matches!(s, Sample::Imu(_))), 121);
    assert_eq!(count(|s| matches!(s, Sample::Range(_))), 25);
    for pair in shots.windows(2) {
        let (a, b) = (&pair[0].truth, &pair[1].truth);
        let dt = b.stamp.seconds_since(a.stamp);
        let climb = (b.height - a.height) / dt;
        // Level enough that the body's up speed is the climb to a tilt times the speed.
        assert!((climb - 0.5 * (a.velocity[2] + b.velocity[2])).abs() < 0.3, "{climb} {a:?}");
        assert!((1.0..3.2).contains(&a.velocity[0]) && a.velocity[1].abs() < 1.2);
    }
    assert!(Flight::new(Settings { size: [65, 48], ..Settings::default() }).is_err());
    assert!(Flight::new(Settings { mean: [0.1, 0.0], ..Settings::default() }).is_err());
}

#[test]
fn a_synthetic_flight_comes_out_right() {
    let mut odometer = Odometer::new(&Config::default()).unwrap();
    let (mut steps, mut squares, mut nees) = (0.0, 0.0, 0.0);
    let mut draws = Normals::new(8, 0);
    // The frames themselves are of no interest here, and small; the grid's cells are what the fit sees.
    for shot in Flight::new(Settings { seconds: 4.0, size: [160, 120], noise: None, ..Settings::default() }).unwrap() {
        for sample in &shot.samples {
            match sample {
                Sample::Imu(imu) => odometer.imu(imu).unwrap(),
                Sample::Range(range) => odometer.range(range).unwrap(),
                Sample::Info(info) => odometer.info(info).unwrap(),
                Sample::Frame(_) | Sample::Transforms(_) | Sample::Width(_) => {}
            }
        }
        let Some(truth) = shot.truth.flow else { continue };
        let vectors: Vec<f32> = truth.vectors.iter().map(|v| v + 0.1 * draws.draw() as f32).collect();
        let confidence = vec![0.9; truth.grid.cells()];
        let (older, newer, grid) = (truth.older, shot.truth.stamp, truth.grid);
        let flow = Flow { older, newer, grid, vectors: &vectors, confidence: &confidence };
        let found = odometer.velocity(&flow, [160, 120]).unwrap();
        let error = Vector3::from(found.linear) - Vector3::from(shot.truth.velocity);
        let block = nalgebra::Matrix3::from_fn(|i, j| found.covariance[i][j]);
        nees += (error.transpose() * block.try_inverse().unwrap() * error)[0] / 3.0;
        squares += error.norm_squared();
        steps += 1.0;
        let Scale::Metric { distance } = found.scale else { panic!("{found:?}") };
        assert!((distance - shot.truth.height).abs() < 0.4, "{distance} of {}", shot.truth.height);
    }
    let (rms, nees) = (f64::sqrt(squares / steps), nees / steps);
    println!("{steps} steps, {rms:.4} m/s RMS, NEES {nees:.2}");
    assert_eq!(steps, 120.0);
    assert!(rms < 0.09, "{rms} m/s");
    assert!((0.3..2.5).contains(&nees), "{nees}");
}

fn pan_settings(noise: Noise) -> pan::Settings {
    pan::Settings { seed: 3, size: [40, 32], frames: 24, centre: [0.5; 2], sweep: [9.0, 6.0], dark_mean: 0.01, noise }
}

fn photograph(count: impl Fn(usize, usize) -> u16) -> Photograph {
    let (width, height) = (200, 160);
    let counts = (0..width * height).map(|i| count(i % width, i / width)).collect();
    Photograph { width, height, counts, black: 0.0, white: 65_535.0 }
}

#[test]
fn frames_of_a_pan_share_no_pixel_with_their_neighbours() {
    let noise = Noise { a: [1e-5; 3], b: [1e-7; 3] };
    let marked = photograph(|x, y| (y * 200 + x) as u16);
    let views: Vec<pan::View> = Pan::new(marked.clone(), pan_settings(noise)).unwrap().collect();
    assert_eq!(views.len(), 24);
    for pair in views[..12].windows(2) {
        assert_ne!(pair[0].lattice, pair[1].lattice);
        assert!(pair[0].counts.iter().all(|pixel| !pair[1].counts.contains(pixel)), "consecutive frames share a pixel");
    }
    assert!(views[..12].iter().all(|view| view.factor == 1.0) && views[12].pan.is_some() && views[0].pan.is_none());
    // The mosaic keeps its order: red cells come from red pixels, blue ones from blue.
    for (i, pixel) in views[5].counts.iter().enumerate() {
        let (x, y) = (*pixel as usize % 200, *pixel as usize / 200);
        assert_eq!((x % 2, y % 2), (i % 40 % 2, i / 40 % 2));
    }
    let wide = pan::Settings { sweep: [40.0, 6.0], ..pan_settings(noise) };
    assert!(matches!(Pan::new(marked, wide), Err(pan::Error::Small { .. })));
}

#[test]
fn the_true_pan_is_how_the_picture_moves() {
    let noise = Noise { a: [1e-5; 3], b: [1e-7; 3] };
    // A ramp over cells: where it moves to shows in its mean.
    let ramp = photograph(|x, y| (30 * (x / 2) + 50 * (y / 2) + 100) as u16);
    let views: Vec<pan::View> = Pan::new(ramp, pan_settings(noise)).unwrap().collect();
    let mean = |view: &pan::View| view.counts.iter().map(|c| f64::from(*c)).sum::<f64>() / view.counts.len() as f64;
    let mut far = 0.0_f64;
    for pair in views[..12].windows(2) {
        let [u, v] = pair[1].pan.unwrap();
        assert!((mean(&pair[1]) - mean(&pair[0]) + 30.0 * u + 50.0 * v).abs() < 1e-6, "{:?}", pair[1].pan);
        assert!(u.abs() < 6.0 && v.abs() < 6.0, "the path is smooth");
        far = far.max(u.hypot(v));
    }
    assert!(far > 2.0);
}

#[test]
fn the_dark_half_of_a_pan_is_as_noisy_as_the_camera() {
    let noise = Noise { a: [4e-4, 3e-4, 5e-4], b: [2e-7, 1e-7, 3e-7] };
    let clean = 0.2;
    let mut draws = Normals::new(1, 0);
    let shot: Vec<u16> = (0..32_000)
        .map(|i| (noise.gaussian(i % 200 % 2 + i / 200 % 2, clean, &mut draws).max(0.0) * 65_535.0).round() as u16)
        .collect();
    let views: Vec<pan::View> = Pan::new(photograph(|x, y| shot[y * 200 + x]), pan_settings(noise)).unwrap().collect();
    let dark = &views[20..];
    for colour in 0..3 {
        let values: Vec<f64> = dark
            .iter()
            .flat_map(|view| view.counts.iter().enumerate())
            .filter(|(i, _)| i % 40 % 2 + i / 40 % 2 == colour)
            .map(|(_, count)| f64::from(*count) / 65_535.0)
            .collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64;
        assert!((mean - 0.01).abs() < 2e-4, "mean {mean}");
        let expected = noise.variance(colour, 0.01);
        assert!(
            (variance / expected - 1.0).abs() < 0.1,
            "colour {colour}: variance {variance:e}, the camera's {expected:e}"
        );
    }
}
