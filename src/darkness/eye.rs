//! A simulated Bayer camera before a scene: what it sees, its light, its noise, and the exact flow between two frames.

use nalgebra::{Matrix3, Rotation3, Vector3};
use rayon::prelude::*;

use super::{
    noise::{Noise, Normals},
    path::Pose,
    scene::{Bounds, Scene},
};
use crate::{
    clock::Stamp,
    flow::Grid,
    wire::{CameraInfo, Header, Image},
};

/// Frame of reference of the frames (x right, y down, z along the view).
pub const OPTICAL_FRAME: &str = "camera_optical";
/// Black level of the raw counts.
pub const BLACK: u16 = 256;
/// White level of the raw counts.
pub const WHITE: u16 = 4095;

/// Rays a pixel, along either side.
const RAYS: usize = 2;
/// Cells of the true flow are this many camera pixels wide: quarter resolution of the developed half-size image.
pub(super) const CELL: usize = 8;
/// How a Bayer sensor answers to grey, red to blue.
const RESPONSE: [f64; 3] = [0.62, 1.0, 0.71];
/// The sky's light, red to blue; without structure.
const SKY: [f64; 3] = [0.3, 0.35, 0.4];

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

/// A pinhole camera, 74° wide.
#[derive(Debug, Clone)]
pub(super) struct Eye {
    /// Columns and rows.
    size: [usize; 2],
    /// Pixels.
    focal: f64,
    /// Body from optical axes.
    mount: Rotation3<f64>,
    noise: Option<Noise>,
    seed: u64,
    /// Light to raw value under the light of mean 1.
    gain: f64,
}

/// The camera at a moment.
pub(super) struct View {
    pub(super) from: Vector3<f64>,
    /// World from optical axes.
    pub(super) turn: Matrix3<f64>,
    bounds: Vec<Bounds>,
}

impl Eye {
    /// A camera whose optical axes stand in the body as `mount` says; its light is set by [`Eye::settle`].
    pub(super) fn new(size: [usize; 2], mount: Matrix3<f64>, noise: Option<Noise>, seed: u64) -> Eye {
        let mount = Rotation3::from_matrix_unchecked(mount);
        Eye { size, focal: 0.66 * size[0] as f64, mount, noise, seed, gain: 1.0 }
    }

    /// Sets the light by what a frame would show, looked at coarsely.
    pub(super) fn settle(&mut self, scene: &Scene, view: &View) {
        let [columns, rows] = self.size;
        let step = (columns / 80).max(1);
        let (mut sum, mut count) = (0.0, 0.0);
        for (row, column) in (0..rows).step_by(step).flat_map(|r| (0..columns).step_by(step).map(move |c| (r, c))) {
            let colours = self.light(scene, view, [column as f64, row as f64], step as f64);
            sum += 0.25 * (colours[0] * RESPONSE[0] + 2.0 * colours[1] * RESPONSE[1] + colours[2] * RESPONSE[2]);
            count += 1.0;
        }
        self.gain = count / f64::max(sum, 1e-9);
    }

    /// Its calibration.
    pub(super) fn info(&self, stamp: Stamp) -> CameraInfo {
        let [columns, rows] = self.size;
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

    /// Where the camera is when the body is at `pose`.
    pub(super) fn view(&self, scene: &Scene, pose: &Pose) -> View {
        let turn = pose.attitude.to_rotation_matrix() * self.mount;
        let mut view = View { from: pose.position, turn: *turn.matrix(), bounds: Vec::new() };
        view.bounds = scene.corners().map(|corners| self.bounds(&view, &corners)).collect();
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

    /// The pixel (column, row) that shows a point of the world, in the image or beside it.
    pub(super) fn project(&self, view: &View, point: &Vector3<f64>) -> Option<[f64; 2]> {
        self.towards(view, &(point - view.from))
    }

    /// The same for what lies at infinity along a direction of the world.
    pub(super) fn towards(&self, view: &View, direction: &Vector3<f64>) -> Option<[f64; 2]> {
        let seen = view.turn.transpose() * direction;
        let [columns, rows] = self.size;
        (seen.z > 1e-3).then(|| {
            [
                seen.x / seen.z * self.focal + (columns as f64 - 1.0) / 2.0,
                seen.y / seen.z * self.focal + (rows as f64 - 1.0) / 2.0,
            ]
        })
    }

    /// Inward normals, in the world, of the four planes through the camera that bound the image.
    pub(super) fn sides(&self, view: &View) -> [Vector3<f64>; 4] {
        let [x, y] = self.size.map(|side| 0.5 * side as f64 / self.focal);
        [(1.0, 0.0, x), (-1.0, 0.0, x), (0.0, 1.0, y), (0.0, -1.0, y)]
            .map(|(a, b, c)| view.turn * Vector3::new(a, b, c))
    }

    /// From the camera through a pixel, one unit along the optical axis.
    fn ray(&self, view: &View, pixel: [f64; 2]) -> Vector3<f64> {
        let [columns, rows] = self.size;
        let x = (pixel[0] - (columns as f64 - 1.0) / 2.0) / self.focal;
        let y = (pixel[1] - (rows as f64 - 1.0) / 2.0) / self.focal;
        view.turn * Vector3::new(x, y, 1.0)
    }

    /// Light of the three colours at a point of the image, from an area `width` pixels wide.
    fn light(&self, scene: &Scene, view: &View, pixel: [f64; 2], width: f64) -> [f64; 3] {
        let ray = self.ray(view, pixel);
        match scene.cast(&view.from, &ray, pixel, &view.bounds) {
            Some(hit) => scene.shade(&view.from, &ray, hit, width / self.focal),
            None => SKY,
        }
    }

    /// The raw frame under a light that would bring the mean to `mean`, with its noise.
    pub(super) fn expose(&self, scene: &Scene, view: &View, mean: f64, index: u64) -> Vec<u8> {
        let [columns, rows] = self.size;
        let mut counts = vec![0; columns * rows * 2];
        counts.par_chunks_exact_mut(2 * columns).enumerate().for_each(|(row, line)| {
            // A series for each row of each frame: the noise does not depend on what is drawn first.
            let mut draws = Normals::new(self.seed ^ 0xdead_11e5, index * 65_536 + row as u64);
            for (column, count) in line.as_chunks_mut::<2>().0.iter_mut().enumerate() {
                let colour = row % 2 + column % 2;
                let mut light = 0.0;
                for ray in 0..RAYS * RAYS {
                    let [dx, dy] = [ray % RAYS, ray / RAYS].map(|i| (i as f64 + 0.5) / RAYS as f64 - 0.5);
                    light += self.light(scene, view, [column as f64 + dx, row as f64 + dy], 1.0)[colour];
                }
                let clean = light / (RAYS * RAYS) as f64 * RESPONSE[colour] * self.gain * mean;
                let value = match &self.noise {
                    Some(noise) => noise.gaussian(colour, clean.min(1.0), &mut draws),
                    None => clean,
                };
                let value = f64::from(BLACK) + value * f64::from(WHITE - BLACK);
                *count = (value.round().clamp(0.0, f64::from(WHITE)) as u16).to_le_bytes();
            }
        });
        counts
    }

    /// The frame as a message; the arguments are those of [`Eye::expose`].
    pub(super) fn image(&self, stamp: Stamp, scene: &Scene, view: &View, mean: f64, index: u64) -> Image {
        let [columns, rows] = self.size;
        Image {
            header: Header { stamp: stamp.into(), frame_id: OPTICAL_FRAME.into() },
            height: rows as u32,
            width: columns as u32,
            encoding: "bayer_rggb16".into(),
            is_bigendian: 0,
            step: 2 * columns as u32,
            data: self.expose(scene, view, mean, index),
        }
    }

    /// Where the points that the older frame (taken at `stamp`) shows at the cells' centres stand in the newer frame. Each
    /// frame has the scene of its own moment; the blocks are the same and may have moved.
    pub(super) fn true_flow(&self, stamp: Stamp, older: (&Scene, &View), newer: (&Scene, &View)) -> TrueFlow {
        let ((before, then), (after, now)) = (older, newer);
        let [width, height] = self.size.map(|side| side / CELL);
        let grid = Grid { width, height, scale: [CELL as f32; 2] };
        let mut vectors = Vec::with_capacity(2 * grid.cells());
        for cell in 0..grid.cells() {
            let pixel = [cell % width, cell / width].map(|i| (i as f64 + 0.5) * CELL as f64 - 0.5);
            let ray = self.ray(then, pixel);
            let there = match before.cast(&then.from, &ray, pixel, &then.bounds) {
                Some(hit) => {
                    let point = then.from + ray * hit.reach;
                    self.project(now, &(point + after.moved(hit) - before.moved(hit)))
                }
                // The sky turns and does not move.
                None => self.towards(now, &ray),
            };
            vectors.extend(match there {
                Some(there) => [(there[0] - pixel[0]) as f32, (there[1] - pixel[1]) as f32],
                None => [f32::NAN; 2],
            });
        }
        TrueFlow { older: stamp, grid, vectors }
    }
}

/// Whether columns and rows suit the cells of the true flow.
pub(super) fn fits(size: [usize; 2]) -> bool {
    size.iter().all(|side| *side > 0 && side % CELL == 0 && *side <= 8192)
}
