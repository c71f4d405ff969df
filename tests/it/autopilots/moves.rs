//! A vehicle's moves over level ground with exact flow, and the table of signs that PX4 wants of them.

use nalgebra::{UnitQuaternion, Vector3};
use nightflow::{
    clock::Stamp,
    flow::{Cause, Flow, Grid, State},
    motion::{Config, NoSight, Odometer},
    publish::Moved,
    wire::{CameraInfo, Header, Imu, Range, Vector3 as Wire3},
};

pub const FOCAL: f64 = 420.0;
pub const SIZE: [u32; 2] = [640, 480];
pub const GRID: Grid = Grid { width: 40, height: 30, scale: [16.0, 16.0] };
pub const STEP_NS: i64 = 33_333_333;
pub const HEIGHT: f64 = 5.0;
/// m/s and rad/s of the table's moves.
pub const SPEED: f64 = 2.0;
pub const RATE: f64 = 0.3;

/// One step of a vehicle; vectors FLU (x forward, y left, z up) as everywhere inside.
#[derive(Clone, Copy)]
pub struct Move {
    pub velocity: [f64; 3],
    pub rates: [f64; 3],
}

/// A move of full speed or rate along one axis, and the signs that PX4 wants of it about X and Y, and of the gyro (FRD).
pub type Row = (&'static str, Move, [f64; 2], [f64; 3]);

pub fn fly(x: f64, y: f64, z: f64) -> Move {
    Move { velocity: [x, y, z].map(|v| v * SPEED), rates: [0.0; 3] }
}

pub fn turn(x: f64, y: f64, z: f64) -> Move {
    Move { velocity: [0.0; 3], rates: [x, y, z].map(|w| w * RATE) }
}

/// By PX4's rules: forward flow +Y, back −Y, right −X, left +X, and a turn by the right hand about the body's axis
/// (FRD: roll right, nose up, yaw right) counts positive in flow and gyro alike.
pub fn table() -> [Row; 12] {
    [
        ("forward", fly(1.0, 0.0, 0.0), [0.0, 1.0], [0.0; 3]),
        ("back", fly(-1.0, 0.0, 0.0), [0.0, -1.0], [0.0; 3]),
        ("left", fly(0.0, 1.0, 0.0), [1.0, 0.0], [0.0; 3]),
        ("right", fly(0.0, -1.0, 0.0), [-1.0, 0.0], [0.0; 3]),
        ("up", fly(0.0, 0.0, 1.0), [0.0, 0.0], [0.0; 3]),
        ("down", fly(0.0, 0.0, -1.0), [0.0, 0.0], [0.0; 3]),
        ("roll right", turn(1.0, 0.0, 0.0), [1.0, 0.0], [1.0, 0.0, 0.0]),
        ("roll left", turn(-1.0, 0.0, 0.0), [-1.0, 0.0], [-1.0, 0.0, 0.0]),
        ("nose up", turn(0.0, -1.0, 0.0), [0.0, 1.0], [0.0, 1.0, 0.0]),
        ("nose down", turn(0.0, 1.0, 0.0), [0.0, -1.0], [0.0, -1.0, 0.0]),
        ("yaw right", turn(0.0, 0.0, -1.0), [0.0, 0.0], [0.0, 0.0, 1.0]),
        ("yaw left", turn(0.0, 0.0, 1.0), [0.0, 0.0], [0.0, 0.0, -1.0]),
    ]
}

pub const STEP_S: f64 = STEP_NS as f64 * 1e-9;

/// What the row's flow comes to in radians: a move's angle under a height of five metres, or the turn itself.
pub fn expected(row: &Row) -> [f64; 2] {
    let turning = row.1.rates != [0.0; 3];
    row.2.map(|sign| sign * if turning { RATE * STEP_S } else { (SPEED * STEP_S / HEIGHT).atan() })
}

/// Exact flow of a pinhole camera that looks down on level ground, the image's top forward.
pub fn exact(action: &Move) -> Vec<f32> {
    let to_body = |[x, y, z]: [f64; 3]| Vector3::new(-y, -x, -z);
    let moved = Vector3::from(action.velocity) * STEP_S;
    let turned = UnitQuaternion::from_scaled_axis(Vector3::from(action.rates) * STEP_S);
    let mut vectors = Vec::with_capacity(2 * GRID.cells());
    for cell in 0..GRID.cells() {
        let pixel = [cell % GRID.width, cell / GRID.width].map(|i| (i as f64 + 0.5) * 16.0 - 0.5);
        let beam = to_body([(pixel[0] - 319.5) / FOCAL, (pixel[1] - 239.5) / FOCAL, 1.0]);
        let back = turned.inverse() * (beam * (HEIGHT / -beam.z) - moved);
        let there = [-back.y / -back.z * FOCAL + 319.5, -back.x / -back.z * FOCAL + 239.5];
        vectors.extend([(there[0] - pixel[0]) as f32, (there[1] - pixel[1]) as f32]);
    }
    vectors
}

/// An odometer with calibration, and gyro and range of the move around the interval that begins at `older`.
pub fn odometer(config: &Config, action: &Move, older: Stamp, gyro: bool) -> Odometer {
    let header = |ns: i64| Header { stamp: Stamp(ns).into(), frame_id: "camera".into() };
    let mut odometer = Odometer::new(config).unwrap();
    let k = [FOCAL, 0.0, 319.5, 0.0, FOCAL, 239.5, 0.0, 0.0, 1.0];
    let [width, height] = SIZE;
    odometer
        .info(&CameraInfo { width, height, distortion_model: "plumb_bob".into(), k, ..CameraInfo::default() })
        .unwrap();
    for k in (-3..10).filter(|_| gyro) {
        let [x, y, z] = action.rates;
        let mut imu = Imu { header: header(older.0 + k * 5_000_000), ..Imu::default() };
        imu.angular_velocity = Wire3 { x, y, z };
        imu.orientation_covariance[0] = -1.0;
        odometer.imu(&imu).unwrap();
    }
    let range =
        Range { header: header(older.0), min_range: 0.1, max_range: 60.0, range: HEIGHT as f32, ..Range::default() };
    odometer.range(&range).unwrap();
    odometer
}

pub fn flow(older: Stamp, vectors: &[f32]) -> Flow<'_> {
    Flow { older, newer: Stamp(older.0 + STEP_NS), grid: GRID, vectors, confidence: &[0.9; 1200] }
}

/// A step as the pipeline gives it.
pub fn moved(step: u64, older: Stamp, action: &Move, blind: bool) -> Moved {
    let vectors = exact(action);
    let mut odometer = odometer(&Config::default(), action, older, true);
    let flow = flow(older, &vectors);
    Moved {
        step,
        older,
        newer: flow.newer,
        frame_id: "camera".into(),
        camera_size: SIZE,
        grid: GRID,
        gain: 1.0,
        raw_mean: 0.1,
        noise: None,
        noise_level: None,
        saturated_part: 0.0,
        confidence: 0.9,
        state: if blind { State::Blind(Cause::Frozen) } else { State::Ok },
        velocity: odometer.velocity(&flow, SIZE),
        integrated: odometer.integrated(&flow, SIZE, blind),
        obstacles: Err(NoSight::Off),
    }
}
