//! What a velocity and an autopilot's flow cost: a flow raster of the network's quarter resolution and one of its whole size.

use std::{f64::consts::TAU, hint::black_box};

use criterion::{Criterion, criterion_group, criterion_main};
use nightflow::{
    clock::Stamp,
    darkness::noise::Normals,
    flow::{Flow, Grid},
    motion::{Config, Odometer},
    wire::{CameraInfo, Header, Imu, Range},
};

/// A frame takes 33 ms.
const NEWER_NS: i64 = 1_033_333_333;

fn header(ns: i64) -> Header {
    Header { stamp: Stamp(ns).into(), frame_id: String::new() }
}

fn odometer() -> Odometer {
    let fresh = Odometer::new(&Config::default());
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
        let mut odometer = odometer();
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

criterion_group!(benches, velocity);
criterion_main!(benches);
