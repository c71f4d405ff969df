//! True time to contact around a simulated drone, sector by sector.
//!
//! A thing at p from the drone, which nears it with the velocity c (the drone's less its own), reaches the plane through
//! the drone across c after τ = p·c / |c|². Over the thing's faces τ is linear, so that the least τ of what a sector shows
//! of a face is at a corner of it: faces are clipped and no ray can miss a wire. What will pass beside the drone counts as
//! what will hit it does; what has passed, and what does not near, has no τ. The ground and the sky are no things.

use std::f64::consts::{PI, TAU};

use nalgebra::Vector3;

use super::{
    eye::{Eye, View},
    scene::{Block, Scene},
};

/// Sectors around the drone.
pub const SECTORS: usize = 72;
/// Things count that reach to within so many metres of the drone's height.
pub const BAND_M: f64 = 1.0;
/// What nears more slowly than this does not near, m/s.
const STILL: f64 = 1e-3;

/// Where the middle of a sector lies, radians counter-clockwise from straight ahead, in the level body frame.
pub fn bearing(sector: usize) -> f64 {
    TAU * sector as f64 / SECTORS as f64 - PI
}

/// What is true in each sector.
pub(super) struct Around {
    pub(super) ttc_s: [Option<f64>; SECTORS],
    pub(super) distance_m: [Option<f64>; SECTORS],
    pub(super) in_view: [bool; SECTORS],
}

/// The drone among its things.
pub(super) struct Site<'a> {
    pub(super) eye: &'a Eye,
    pub(super) view: &'a View,
    pub(super) scene: &'a Scene,
    /// m/s, world.
    pub(super) velocity: Vector3<f64>,
    /// m/s, world, of each block.
    pub(super) velocities: &'a [Vector3<f64>],
    /// The body's, radians.
    pub(super) yaw: f64,
}

impl Site<'_> {
    /// Looks into every sector.
    pub(super) fn around(&self) -> Around {
        let mut around = Around { ttc_s: [None; SECTORS], distance_m: [None; SECTORS], in_view: [false; SECTORS] };
        let sides = self.eye.sides(self.view);
        for sector in 0..SECTORS {
            let middle = self.yaw + bearing(sector);
            let half = 0.5 * TAU / SECTORS as f64;
            let [right, left] = [middle - half, middle + half].map(|at| Vector3::new(at.cos(), at.sin(), 0.0));
            around.in_view[sector] = [right, left].iter().all(|edge| sides.iter().all(|side| side.dot(edge) >= 0.0));
            if !around.in_view[sector] {
                continue;
            }
            let wedge = [Vector3::new(-right.y, right.x, 0.0), Vector3::new(left.y, -left.x, 0.0)];
            let planes: Vec<(Vector3<f64>, f64)> = wedge
                .into_iter()
                .chain(sides)
                .map(|normal| (normal, 0.0))
                .chain([(Vector3::z(), BAND_M), (-Vector3::z(), BAND_M)])
                .collect();
            let (mut ttc, mut distance) = (f64::INFINITY, f64::INFINITY);
            for (index, (block, velocity)) in self.scene.blocks().iter().zip(self.velocities).enumerate() {
                let closing = self.velocity - velocity;
                for corners in self.faces(block).into_iter().flatten().map(|face| clip(face, &planes)) {
                    if !self.shows(index, &corners) {
                        continue;
                    }
                    for corner in corners {
                        distance = distance.min(corner.xy().norm());
                        let nears = corner.dot(&closing);
                        if nears > 0.0 && closing.norm() > STILL {
                            ttc = ttc.min(nears / closing.norm_squared());
                        }
                    }
                }
            }
            around.ttc_s[sector] = Some(ttc).filter(|ttc| ttc.is_finite());
            around.distance_m[sector] = Some(distance).filter(|distance| distance.is_finite());
        }
        around
    }

    /// The faces of a block that are turned to the camera, corners from the camera.
    fn faces(&self, block: &Block) -> [Option<Vec<Vector3<f64>>>; 6] {
        std::array::from_fn(|face| {
            let (axis, at_low) = (face / 2, face % 2 == 0);
            let plane = if at_low { block.low[axis] } else { block.high[axis] };
            let turned = if at_low { self.view.from[axis] < plane } else { self.view.from[axis] > plane };
            turned.then(|| {
                let (a, b) = ((axis + 1) % 3, (axis + 2) % 3);
                let corner = |u: &Vector3<f64>, v: &Vector3<f64>| {
                    let mut corner = Vector3::zeros();
                    (corner[axis], corner[a], corner[b]) = (plane, u[a], v[b]);
                    corner - self.view.from
                };
                let (low, high) = (&block.low, &block.high);
                vec![corner(low, low), corner(high, low), corner(high, high), corner(low, high)]
            })
        })
    }

    /// Whether any corner of what is left of a face, or its middle, is seen past the other things.
    fn shows(&self, index: usize, corners: &[Vector3<f64>]) -> bool {
        let middle = corners.iter().sum::<Vector3<f64>>() / corners.len().max(1) as f64;
        let free = |point: Vector3<f64>| {
            let hit = self.scene.cast(&self.view.from, &point, [0.0; 2], &[]);
            hit.is_some_and(|hit| hit.block.is_some_and(|(first, _)| first == index))
        };
        corners.len() > 2 && (free(middle) || corners.iter().any(|corner| free(corner + (middle - corner) * 0.01)))
    }
}

/// What of a polygon lies on the inner side of planes: normal · p + offset ≥ 0 (Sutherland and Hodgman, 1974).
fn clip(mut polygon: Vec<Vector3<f64>>, planes: &[(Vector3<f64>, f64)]) -> Vec<Vector3<f64>> {
    for (normal, offset) in planes {
        let inside = |p: &Vector3<f64>| normal.dot(p) + offset;
        let mut kept = Vec::with_capacity(polygon.len() + 1);
        for (i, a) in polygon.iter().enumerate() {
            let b = &polygon[(i + 1) % polygon.len()];
            let (at_a, at_b) = (inside(a), inside(b));
            if at_a >= 0.0 {
                kept.push(*a);
            }
            if (at_a < 0.0) != (at_b < 0.0) {
                kept.push(a + (b - a) * (at_a / (at_a - at_b)));
            }
        }
        polygon = kept;
    }
    polygon
}
