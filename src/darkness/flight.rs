//! A synthetic flight into the dark: raw frames with calibrated noise, gyro, range, and what is true about them.

use std::sync::Arc;

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::{
    noise::{Noise, Normals},
    path::{Path, Pose},
    profiles,
    scene::{Bounds, Scene},
};
use crate::{
    camera::{Frame, Sample},
    clock::Stamp,
    flow::Grid,
    wire::{self, CameraInfo, Header, Image, Imu, Range},
};

/// Frame of reference of the frames (x right, y down, z into the ground).
pub const OPTICAL_FRAME: &str = "camera_optical";
/// Frame of reference of gyro, range and true velocity (FLU).
pub const BODY_FRAME: &str = "base_link";
/// Black level of the raw counts.
pub const BLACK: u16 = 256;
/// White level of the raw counts.
pub const WHITE: u16 = 4095;

/// Frames begin here, gyro and range a little earlier.
const BEGIN_NS: i64 = 1_700_000_000_000_000_000;
const LEAD_NS: i64 = 100_000_000;
const GYRO_NS: i64 = 5_000_000;
const RANGE_NS: i64 = 25_000_000;
const GYRO_SD: f64 = 0.005;
const ATTITUDE_SD: f64 = 0.005;
const REACH_M: [f32; 2] = [0.2, 60.0];
/// Rays a pixel, along either side.
const RAYS: usize = 2;
/// Cells of the true flow are this many camera pixels wide: quarter resolution of the developed half-size image.
const CELL: usize = 8;
/// How a Bayer sensor answers to grey, red to blue.
const RESPONSE: [f64; 3] = [0.62, 1.0, 0.71];

/// What is flown.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Draws the path, the ground, the obstacles and the noise.
    pub seed: u64,
    /// Length of the flight.
    pub seconds: f64,
    /// Mean speed forward, m/s.
    pub speed: f64,
    /// Mean height, metres.
    pub height: f64,
    /// Mean of the first and the last frame above black, 1 = white; the light falls exponentially between them.
    pub mean: [f64; 2],
    /// Columns and rows; multiples of 8.
    pub size: [usize; 2],
    /// Frames a second.
    pub fps: f64,
    /// The camera's noise; `None` gives clean frames.
    pub noise: Option<Noise>,
}

impl Default for Settings {
    /// Four seconds at 2 m/s and 5 m, from dusk to dark, as a Canon EOS M6 at ISO 3200 would see it.
    fn default() -> Self {
        Self {
            seed: 1,
            seconds: 4.0,
            speed: 2.0,
            height: 5.0,
            mean: [0.1, 0.004],
            size: [640, 480],
            fps: 30.0,
            noise: profiles::find("Canon EOS M6", 3200).ok(),
        }
    }
}

/// Why a flight can't be flown.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A figure that makes no sense.
    #[error("{what} is {found}, expected {expected}")]
    Setting {
        /// Which.
        what: &'static str,
        /// As given.
        found: String,
        /// What makes sense.
        expected: &'static str,
    },
}

/// True flow from the frame before.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueFlow {
    /// Stamp of the frame before.
    pub older: Stamp,
    /// Where the vectors stand: on the older frame.
    pub grid: Grid,
    /// `height` × `width` × 2, (u right, v down) in camera pixels, also where the newer frame no longer shows the point.
    pub vectors: Vec<f32>,
}

/// What is true about a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    /// The frame's stamp.
    pub stamp: Stamp,
    /// m/s, body (FLU), at the stamp.
    pub velocity: [f64; 3],
    /// rad/s, body (FLU), at the stamp.
    pub rates: [f64; 3],
    /// Distance of the camera to the ground along its normal, metres.
    pub height: f64,
    /// None for the first frame.
    pub flow: Option<TrueFlow>,
}

/// One frame, what came since the one before, and the truth.
#[derive(Debug, Clone)]
pub struct Shot {
    /// In the order of their stamps; the frame is the last.
    pub samples: Vec<Sample>,
    /// What is true about the frame.
    pub truth: Truth,
}

/// A flight, frame by frame. The camera looks down with the image's top forward, 74° wide.
#[derive(Debug, Clone)]
pub struct Flight {
    settings: Settings,
    path: Path,
    scene: Scene,
    mount: Rotation3<f64>,
    focal: f64,
    /// Light to raw value under the light of mean 1.
    gain: f64,
    tilt_error: Vector3<f64>,
    gyro_next_ns: i64,
    range_next_ns: i64,
    index: u64,
}

/// The camera at a moment.
struct View {
    from: Vector3<f64>,
    /// World from optical axes.
    turn: Matrix3<f64>,
    bounds: Vec<Bounds>,
}

impl Flight {
    /// Checks the settings and lays out the ground.
    pub fn new(settings: Settings) -> Result<Flight, Error> {
        check(&settings)?;
        let path = Path::new(settings.seed, settings.speed, settings.height);
        let (begin, end) = (-1.5 * settings.height, settings.speed * settings.seconds + 1.5 * settings.height);
        let scene = Scene::new(settings.seed, begin, end, settings.height, path.clear());
        let mut draws = Normals::new(settings.seed, 0x7117);
        let mut flight = Flight {
            focal: 0.66 * settings.size[0] as f64,
            path,
            scene,
            mount: Rotation3::from_matrix_unchecked(Matrix3::new(0., -1., 0., -1., 0., 0., 0., 0., -1.)),
            gain: 1.0,
            tilt_error: Vector3::from_fn(|_, _| 0.7 * ATTITUDE_SD * draws.draw()),
            gyro_next_ns: BEGIN_NS - LEAD_NS,
            range_next_ns: BEGIN_NS - LEAD_NS,
            index: 0,
            settings,
        };
        // The light is set by what the first frame would show, looked at coarsely.
        let view = flight.view(&flight.path.at(0.0));
        let [columns, rows] = flight.settings.size;
        let step = (columns / 80).max(1);
        let (mut sum, mut count) = (0.0, 0.0);
        for (row, column) in (0..rows).step_by(step).flat_map(|r| (0..columns).step_by(step).map(move |c| (r, c))) {
            let colours = flight.light(&view, [column as f64, row as f64], step as f64);
            sum += 0.25 * (colours[0] * RESPONSE[0] + 2.0 * colours[1] * RESPONSE[1] + colours[2] * RESPONSE[2]);
            count += 1.0;
        }
        flight.gain = count / f64::max(sum, 1e-9);
        Ok(flight)
    }

    /// How many frames the flight has.
    pub fn frames(&self) -> u64 {
        (self.settings.seconds * self.settings.fps).round() as u64 + 1
    }

    /// The calibration of its camera.
    pub fn info(&self, stamp: Stamp) -> CameraInfo {
        let [columns, rows] = self.settings.size;
        let (f, cx, cy) = (self.focal, (columns as f64 - 1.0) / 2.0, (rows as f64 - 1.0) / 2.0);
        CameraInfo {
            header: Header { stamp: stamp.into(), frame_id: OPTICAL_FRAME.into() },
            height: rows as u32,
            width: columns as u32,
            distortion_model: "plumb_bob".into(),
            d: vec![0.0; 5],
            k: [f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [f, 0.0, cx, 0.0, 0.0, f, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            ..CameraInfo::default()
        }
    }

    fn stamp(&self, index: u64) -> Stamp {
        Stamp(BEGIN_NS + (index as f64 / self.settings.fps * 1e9).round() as i64)
    }

    fn pose(&self, stamp: Stamp) -> Pose {
        self.path.at(stamp.seconds_since(Stamp(BEGIN_NS)))
    }

    fn view(&self, pose: &Pose) -> View {
        let turn = pose.attitude.to_rotation_matrix() * self.mount;
        let mut view = View { from: pose.position, turn: *turn.matrix(), bounds: Vec::new() };
        view.bounds = self.scene.corners().map(|corners| self.bounds(&view, &corners)).collect();
        view
    }

    /// The part of the image that a block may cover; all of it when a corner is not in front of the camera.
    fn bounds(&self, view: &View, corners: &[Vector3<f64>; 8]) -> Bounds {
        let mut bounds = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        for corner in corners {
            let Some(pixel) = self.project(view, corner) else { return [[f64::NEG_INFINITY, f64::INFINITY]; 2] };
            for axis in 0..2 {
                bounds[axis] = [bounds[axis][0].min(pixel[axis] - 1.0), bounds[axis][1].max(pixel[axis] + 1.0)];
            }
        }
        bounds
    }

    fn project(&self, view: &View, point: &Vector3<f64>) -> Option<[f64; 2]> {
        let seen = view.turn.transpose() * (point - view.from);
        let [columns, rows] = self.settings.size;
        (seen.z > 1e-3).then(|| {
            [
                seen.x / seen.z * self.focal + (columns as f64 - 1.0) / 2.0,
                seen.y / seen.z * self.focal + (rows as f64 - 1.0) / 2.0,
            ]
        })
    }

    fn ray(&self, view: &View, pixel: [f64; 2]) -> Vector3<f64> {
        let [columns, rows] = self.settings.size;
        let x = (pixel[0] - (columns as f64 - 1.0) / 2.0) / self.focal;
        let y = (pixel[1] - (rows as f64 - 1.0) / 2.0) / self.focal;
        view.turn * Vector3::new(x, y, 1.0)
    }

    /// Light of the three colours at a point of the image, from an area `width` pixels wide.
    fn light(&self, view: &View, pixel: [f64; 2], width: f64) -> [f64; 3] {
        let ray = self.ray(view, pixel);
        match self.scene.cast(&view.from, &ray, pixel, &view.bounds) {
            Some(hit) => self.scene.shade(&view.from, &ray, hit, width / self.focal),
            None => [0.3, 0.35, 0.4],
        }
    }

    /// The raw frame under a light that would bring the mean to `mean`, with its noise.
    fn expose(&self, view: &View, mean: f64, index: u64) -> Vec<u8> {
        let [columns, rows] = self.settings.size;
        let mut counts = Vec::with_capacity(columns * rows * 2);
        for row in 0..rows {
            // A series for each row of each frame: the noise does not depend on what is drawn first.
            let mut draws = Normals::new(self.settings.seed ^ 0xdead_11e5, index * 65_536 + row as u64);
            for column in 0..columns {
                let colour = row % 2 + column % 2;
                let mut light = 0.0;
                for ray in 0..RAYS * RAYS {
                    let [dx, dy] = [ray % RAYS, ray / RAYS].map(|i| (i as f64 + 0.5) / RAYS as f64 - 0.5);
                    light += self.light(view, [column as f64 + dx, row as f64 + dy], 1.0)[colour];
                }
                let clean = light / (RAYS * RAYS) as f64 * RESPONSE[colour] * self.gain * mean;
                let value = match &self.settings.noise {
                    Some(noise) => noise.gaussian(colour, clean.min(1.0), &mut draws),
                    None => clean,
                };
                let count = f64::from(BLACK) + value * f64::from(WHITE - BLACK);
                counts.extend((count.round().clamp(0.0, f64::from(WHITE)) as u16).to_le_bytes());
            }
        }
        counts
    }

    /// Where the points that the older frame shows at the cells' centres stand in the newer frame.
    fn true_flow(&self, older: Stamp, newer: Stamp) -> TrueFlow {
        let (then, now) = (self.view(&self.pose(older)), self.view(&self.pose(newer)));
        let [width, height] = self.settings.size.map(|side| side / CELL);
        let grid = Grid { width, height, scale: [CELL as f32; 2] };
        let mut vectors = Vec::with_capacity(2 * grid.cells());
        for cell in 0..grid.cells() {
            let pixel = [cell % width, cell / width].map(|i| (i as f64 + 0.5) * CELL as f64 - 0.5);
            let ray = self.ray(&then, pixel);
            let hit = self.scene.cast(&then.from, &ray, pixel, &then.bounds);
            let there = hit.and_then(|hit| self.project(&now, &(then.from + ray * hit.reach)));
            vectors.extend(match there {
                Some(there) => [(there[0] - pixel[0]) as f32, (there[1] - pixel[1]) as f32],
                None => [f32::NAN; 2],
            });
        }
        TrueFlow { older, grid, vectors }
    }

    fn gyro(&self, stamp: Stamp) -> Imu {
        let pose = self.pose(stamp);
        let mut draws = Normals::new(self.settings.seed ^ 0x6720, stamp.ns().cast_unsigned());
        let mut noisy = |clean: Vector3<f64>, sd: f64| clean.map(|value| value + sd * draws.draw());
        let rates = noisy(pose.rates, GYRO_SD);
        let force = noisy(pose.force, 0.05);
        let wander = noisy(self.tilt_error, 0.2 * ATTITUDE_SD);
        let attitude = pose.attitude * nalgebra::UnitQuaternion::from_scaled_axis(wander);
        let diagonal = |variance: f64| [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance];
        Imu {
            header: Header { stamp: stamp.into(), frame_id: BODY_FRAME.into() },
            orientation: wire::Quaternion { x: attitude.i, y: attitude.j, z: attitude.k, w: attitude.w },
            orientation_covariance: diagonal(ATTITUDE_SD.powi(2)),
            angular_velocity: wire::Vector3 { x: rates.x, y: rates.y, z: rates.z },
            angular_velocity_covariance: diagonal(GYRO_SD.powi(2)),
            linear_acceleration: wire::Vector3 { x: force.x, y: force.y, z: force.z },
            linear_acceleration_covariance: diagonal(0.05_f64.powi(2)),
        }
    }

    /// A lidar that looks along the body's down axis, on whatever stands there.
    fn range(&self, stamp: Stamp) -> Range {
        let pose = self.pose(stamp);
        let ray = pose.attitude * -Vector3::z();
        let clean = self.scene.cast(&pose.position, &ray, [0.0; 2], &[]).map_or(f64::INFINITY, |hit| hit.reach);
        let sd = if clean.is_finite() { 0.02 + 0.005 * clean } else { 0.0 };
        let mut draws = Normals::new(self.settings.seed ^ 0x4a6e, stamp.ns().cast_unsigned());
        Range {
            header: Header { stamp: stamp.into(), frame_id: BODY_FRAME.into() },
            radiation_type: 1,
            field_of_view: 0.03,
            min_range: REACH_M[0],
            max_range: REACH_M[1],
            range: (clean + sd * draws.draw()) as f32,
            variance: (sd * sd) as f32,
        }
    }

    fn image(&self, stamp: Stamp, mean: f64) -> Image {
        let [columns, rows] = self.settings.size;
        Image {
            header: Header { stamp: stamp.into(), frame_id: OPTICAL_FRAME.into() },
            height: rows as u32,
            width: columns as u32,
            encoding: "bayer_rggb16".into(),
            is_bigendian: 0,
            step: 2 * columns as u32,
            data: self.expose(&self.view(&self.pose(stamp)), mean, self.index),
        }
    }

    /// Gyro and range up to `until`, in the order of their stamps.
    fn small(&mut self, until: Stamp, samples: &mut Vec<Sample>) {
        loop {
            let next = self.gyro_next_ns.min(self.range_next_ns);
            if next > until.ns() {
                return;
            }
            if next == self.gyro_next_ns {
                samples.push(Sample::Imu(Arc::new(self.gyro(Stamp(next)))));
                self.gyro_next_ns += GYRO_NS;
            } else {
                samples.push(Sample::Range(Arc::new(self.range(Stamp(next)))));
                self.range_next_ns += RANGE_NS;
            }
        }
    }
}

impl Iterator for Flight {
    type Item = Shot;

    fn next(&mut self) -> Option<Shot> {
        if self.index >= self.frames() {
            return None;
        }
        let stamp = self.stamp(self.index);
        let mut samples = Vec::new();
        self.small(stamp, &mut samples);
        samples.push(Sample::Info(Arc::new(self.info(stamp))));
        let [from, to] = self.settings.mean;
        let part = self.index as f64 / (self.frames() - 1).max(1) as f64;
        let image = self.image(stamp, from * (to / from).powf(part));
        samples.push(Sample::Frame(Arc::new(Frame { image, received: stamp })));
        let pose = self.pose(stamp);
        let flow = self.index.checked_sub(1).map(|before| self.true_flow(self.stamp(before), stamp));
        self.index += 1;
        Some(Shot {
            samples,
            truth: Truth {
                stamp,
                velocity: pose.velocity.into(),
                rates: pose.rates.into(),
                height: pose.position.z,
                flow,
            },
        })
    }
}

fn check(settings: &Settings) -> Result<(), Error> {
    let wrong = |what, found: String, expected| Err(Error::Setting { what, found, expected });
    let positive = [("seconds", settings.seconds), ("height", settings.height), ("fps", settings.fps)];
    for (what, value) in positive.into_iter().chain([("speed", settings.speed + f64::MIN_POSITIVE)]) {
        if !(value.is_finite() && value > 0.0) {
            return wrong(what, value.to_string(), "a positive number");
        }
    }
    if settings.mean.iter().any(|mean| !(1e-5..=0.5).contains(mean)) {
        return wrong("mean", format!("{:?}", settings.mean), "two means from 0.00001 to 0.5 of white");
    }
    if settings.size.iter().any(|side| *side == 0 || side % CELL != 0 || *side > 8192) {
        return wrong("size", format!("{:?}", settings.size), "columns and rows that are multiples of 8, at most 8192");
    }
    Ok(())
}
