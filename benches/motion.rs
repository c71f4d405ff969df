//! What a velocity, an autopilot's flow and obstacles cost: a raster of the network's quarter resolution and one of its whole size.

use std::{cell::RefCell, f64::consts::TAU, hint::black_box};

use criterion::{BatchSize, Criterion, criterion_group, criterion_main};
use nightflow::{
    clock::Stamp,
    darkness::noise::Normals,
    exposure::Exposed,
    flow::{Flow, Grid},
    motion::{Config, Lack, Lookout, Mount, Odometer, obstacles},
    wire::{CameraInfo, Header, Imu, Range},
};

/// A frame takes 33 ms.
const NEWER_NS: i64 = 1_033_333_333;

fn header(ns: i64) -> Header {
    Header { stamp: Stamp(ns).into(), frame_id: String::new() }
}

fn odometer(camera: Mount) -> Odometer {
    let fresh = Odometer::new(&Config { camera, ..Config::default() });
    let Ok(mut odometer) = fresh else { panic!("the default settings are sound") };
    let k = [420.0, 0.0, 319.5, 0.0, 420.0, 239.5, 0.0, 0.0, 1.0];
    let d = vec![-0.2, 0.05, 0.0, 0.0, 0.0];
    let calibration =
        CameraInfo { width: 640, height: 480, k, d, distortion_model: "plumb_bob".into(), ..CameraInfo::default() };
    assert!(odometer.info(&calibration).is_ok());
    for step in 0..40 {
        let mut imu = Imu { header: header(900_000_000 + step * 5_000_000), ..Imu::default() };
        imu.angular_velocity.x = 0.1 * (TAU * step as f64 / 40.0).sin();
        assert!(odometer.imu(&imu).is_ok());
    }
    let range = Range { header: header(1_000_000_000), max_range: 60.0, range: 5.0, ..Range::default() };
    assert!(odometer.range(&range).is_ok());
    odometer
}

fn velocity(criterion: &mut Criterion) {
    for (name, grid) in [
        ("velocity, 80×60", Grid { width: 80, height: 60, scale: [8.0; 2] }),
        ("velocity, 320×240", Grid { width: 320, height: 240, scale: [2.0; 2] }),
    ] {
        let mut odometer = odometer(Mount::Downward);
        let mut draws = Normals::new(1, 0);
        // A third of the vectors is wrong, so that the fit has its usual work; no raster meets only those.
        let vectors: Vec<f32> = (0..grid.cells())
            .flat_map(|_| {
                let noise = if draws.uniform() < 1.0 / 3.0 { 15.0 } else { 0.5 };
                [noise * draws.draw(), 5.0 + noise * draws.draw()].map(|pixels| pixels as f32)
            })
            .collect();
        let confidence = vec![0.8; grid.cells()];
        let (older, newer) = (Stamp(1_000_000_000), Stamp(NEWER_NS));
        let flow = Flow { older, newer, grid, vectors: &vectors, confidence: &confidence };
        assert!(odometer.velocity(&flow, [640, 480]).is_ok());
        criterion.bench_function(name, |bencher| {
            bencher.iter(|| black_box(odometer.velocity(black_box(&flow), [640, 480])));
        });
        assert!(odometer.integrated(&flow, [640, 480], false).flow.is_ok());
        criterion.bench_function(&name.replace("velocity", "flow straight below"), |bencher| {
            bencher.iter(|| black_box(odometer.integrated(black_box(&flow), [640, 480], false)));
        });
    }
}

/// Everything comes straight at the camera out of noise, with two wires and a rod before it.
fn surroundings(criterion: &mut Criterion) {
    let grid = Grid { width: 80, height: 60, scale: [8.0; 2] };
    let mut draws = Normals::new(2, 0);
    let centre = [39.5, 29.5];
    let vectors: Vec<f32> = (0..grid.cells())
        .flat_map(|cell| [cell % grid.width, cell / grid.width].map(|at| at as f64))
        .enumerate()
        .map(|(i, at)| (0.1 * (at - centre[i % 2]) + 0.2 * draws.draw()) as f32)
        .collect();
    let confidence = vec![0.8; grid.cells()];
    let thin = |at: usize| at / 320 == 80 || at / 320 == 110 || at % 320 == 250;
    let plane: Vec<f32> =
        (0..320 * 240).map(|at| (if thin(at) { 0.2 } else { 0.4 } + 0.1 * draws.draw()) as f32).collect();
    let rgb = plane.iter().chain(&plane).chain(&plane).copied().collect();
    let older = Exposed { width: 320, height: 240, scale: [2.0; 2], rgb, gain: 1.0, ..Exposed::default() };
    for (name, thin) in [("obstacles, 80×60", true), ("obstacles without thin things, 80×60", false)] {
        let Ok(mut lookout) = Lookout::new(&obstacles::Config { thin, ..obstacles::Config::default() }) else {
            continue;
        };
        let (odometer, mut stamp) = (RefCell::new(odometer(Mount::Forward)), 1_066_666_667);
        // Steps follow each other, or whatever is followed would be begun anew in each.
        let mut next = || {
            let begin = stamp;
            stamp += 33_333_333;
            for ns in (begin / 5_000_000 + 6..=stamp / 5_000_000 + 6).map(|step| step * 5_000_000) {
                // What overlaps is refused.
                let _ = odometer.borrow_mut().imu(&Imu { header: header(ns), ..Imu::default() });
            }
            (Stamp(begin), Stamp(stamp))
        };
        let mut look = |(before, after)| {
            let flow = Flow { older: before, newer: after, grid, vectors: &vectors, confidence: &confidence };
            let found = lookout.look(&odometer.borrow(), &flow, [640, 480], &older, &Err(Lack::Blind));
            assert!(found.is_ok(), "{found:?}");
            found
        };
        criterion.bench_function(name, |bencher| bencher.iter_batched(&mut next, &mut look, BatchSize::PerIteration));
    }
}

criterion_group!(benches, velocity, surroundings);
criterion_main!(benches);
