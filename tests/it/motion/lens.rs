//! Binning, regions and distortion are taken off.

use super::*;

#[test]
fn binning_region_and_distortion_are_taken_off() {
    let mut truth = Truth::hovering(5.0);
    truth.velocity = Vector3::new(2.0, 0.5, 0.3);
    truth.rates = Vector3::new(0.1, 0.2, 0.3);
    let mut info = calibration();
    // The same frame as a binned cut-out of a sensor twice as fine, 100 columns and 60 rows in.
    info.k = [2.0 * FOCAL, 0.0, 2.0 * 320.0 - 0.5 + 100.0, 0.0, 2.0 * FOCAL, 2.0 * 240.0 - 0.5 + 60.0, 0.0, 0.0, 1.0];
    (info.width, info.height, info.binning_x, info.binning_y) = (1600, 1200, 2, 2);
    (info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height) = (100, 60, 1280, 960);
    let gyro = || (-4..12).map(|k| OLDER_NS + k * 5_000_000);
    let seen = truth.exact();
    let mut odometer = truth.odometer(&seen, gyro(), true);
    odometer.info(&info).unwrap();
    let found = odometer.velocity(&truth.flow(&seen), SIZE).unwrap();
    assert!((Vector3::from(found.linear) - truth.expected()).norm() < 1e-5, "{found:?}");
    for (model, d) in [
        ("plumb_bob", vec![-0.25, 0.08, 0.001, -0.0005, -0.01]),
        ("rational_polynomial", vec![0.3, 0.05, 0.0004, 0.0003, 0.01, 0.5, 0.1, 0.02]),
        ("equidistant", vec![0.02, -0.01, 0.004, -0.001]),
    ] {
        let mut info = calibration();
        info.distortion_model = model.into();
        info.d = d;
        let mut bent = truth.exact();
        distort(&mut bent, &info);
        let mut odometer = truth.odometer(&bent, gyro(), true);
        odometer.info(&info).unwrap();
        let found = odometer.velocity(&truth.flow(&bent), SIZE).unwrap();
        assert!((Vector3::from(found.linear) - truth.expected()).norm() < 2e-5, "{model}: {found:?}");
    }
}

/// Moves each vector to where a distorting lens would show it, keeping the cell centres as *distorted* pixels.
fn distort(seen: &mut Seen, info: &CameraInfo) {
    let truth =
        Truth { velocity: Vector3::new(2.0, 0.5, 0.3), rates: Vector3::new(0.1, 0.2, 0.3), ..Truth::hovering(5.0) };
    let (newer, turned) = truth.newer();
    for cell in 0..GRID.cells() {
        let pixel = [cell % GRID.width, cell / GRID.width].map(|i| (i as f64 + 0.5) * 8.0 - 0.5);
        let bent = [(pixel[0] - 319.5) / FOCAL, (pixel[1] - 239.5) / FOCAL];
        let mut ray = bent;
        for _ in 0..200 {
            // Newton's fixed point on the forward model alone, so that it shares no code with what is tested.
            let there = forward(ray, info);
            ray = [ray[0] + 0.7 * (bent[0] - there[0]), ray[1] + 0.7 * (bent[1] - there[1])];
        }
        let beam = truth.mount() * Vector3::new(ray[0], ray[1], 1.0);
        let point = Vector3::new(0.0, 0.0, 5.0) + beam * (-5.0 / beam.z);
        let back = truth.mount().inverse() * (turned.inverse() * (point - newer));
        let there = forward([back.x / back.z, back.y / back.z], info);
        for axis in 0..2 {
            seen.vectors[2 * cell + axis] = ((there[axis] - bent[axis]) * FOCAL) as f32;
        }
    }
}

/// OpenCV's documented forward models.
fn forward([x, y]: [f64; 2], info: &CameraInfo) -> [f64; 2] {
    let k = |i: usize| info.d.get(i).copied().unwrap_or(0.0);
    let r2 = x * x + y * y;
    if info.distortion_model == "equidistant" {
        let (r, t) = (r2.sqrt().max(1e-12), r2.sqrt().atan());
        let bent = t * (1.0 + k(0) * t.powi(2) + k(1) * t.powi(4) + k(2) * t.powi(6) + k(3) * t.powi(8));
        return [x * bent / r, y * bent / r];
    }
    let radial =
        (1.0 + k(0) * r2 + k(1) * r2 * r2 + k(4) * r2.powi(3)) / (1.0 + k(5) * r2 + k(6) * r2 * r2 + k(7) * r2.powi(3));
    [
        x * radial + 2.0 * k(2) * x * y + k(3) * (r2 + 2.0 * x * x),
        y * radial + k(2) * (r2 + 2.0 * y * y) + 2.0 * k(3) * x * y,
    ]
}
