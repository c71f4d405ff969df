//! Scenes as a drone sees them: the ground from above, things that stand on it or hang over it, and a camera that
//! moves a little and turns a little.
//!
//! The camera is a pinhole with the ground plane one unit away. A plane nᵀX = d moves by H = K(R + t·nᵀ/d)K⁻¹, so that
//! what stands higher moves faster (parallax) without approximation.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::{
    chairs::{farthest, thing},
    library::Library,
    maps::{Dice, Map, apply, inverse, shift, turn},
    render::Layer,
    shapes::Outline,
};

/// No displacement is longer, pixels.
const LONGEST: f64 = 32.0;
/// Typical displacements: share, least and most, pixels.
const MIXTURE: [(f64, [f64; 2]); 4] =
    [(0.05, [0.0, 0.0]), (0.45, [0.2, 4.0]), (0.32, [4.0, 10.0]), (0.18, [10.0, 26.0])];
/// Part of the typical displacement that is a turn of the camera, at most.
const TURNED: f64 = 0.7;

/// A plane nᵀX = d in the axes of the first camera, and a frame on it.
struct Plane {
    normal: Vector3<f64>,
    origin: Vector3<f64>,
    /// Right and down on the plane; units of the ground's distance.
    axes: [Vector3<f64>; 2],
    /// How far it moves by itself, units.
    own: Vector3<f64>,
}

struct Camera {
    lens: Map,
    lens_back: Map,
    focal: f64,
    /// World down, which is the ground's normal.
    down: Vector3<f64>,
    /// From the first camera's axes to the second's.
    turn: Vector3<f64>,
    step: Vector3<f64>,
}

impl Camera {
    fn draw(dice: &mut Dice, [width, height]: [f64; 2]) -> Camera {
        let focal = width * dice.even(0.6, 1.1);
        let lens = Map::new(focal, 0.0, (width - 1.0) / 2.0, 0.0, focal, (height - 1.0) / 2.0, 0.0, 0.0, 1.0);
        // So low that the horizon stays out of sight.
        let edge = (0.5 * height / focal).atan();
        let pitch = if dice.chance(0.35) { 0.05 * dice.normal() } else { dice.even(0.0, (1.2 - edge).min(0.95)) };
        let tilt = Rotation3::from_euler_angles(pitch, 0.0, 0.0)
            * Rotation3::from_euler_angles(0.0, 0.08 * dice.normal(), 0.0);
        let down = tilt * Vector3::z();
        let typical = dice.weighted(&MIXTURE).map_or(0.0, |[low, high]| dice.even(low, high)) / focal;
        let direction = |dice: &mut Dice| Vector3::from_fn(|_, _| dice.normal());
        let turned = TURNED * dice.even(0.0, 1.0) * typical;
        let about = direction(dice);
        let turn = Vector3::new(about.x, about.y, 1.5 * about.z) * (turned / 1.5);
        // Forward over the ground more than up and down.
        let along = direction(dice);
        let step = (along - 0.6 * down * along.dot(&down)).normalize() * (typical - 0.5 * turned);
        Camera { lens, lens_back: inverse(&lens), focal, down, turn, step }
    }

    /// Where pixels of the plane go.
    fn motion(&self, plane: &Plane, part: f64) -> Map {
        let rotation = Rotation3::from_scaled_axis(self.turn * part);
        let distance = plane.normal.dot(&plane.origin);
        let step = (self.step + rotation * plane.own) * part;
        let map = self.lens * (rotation.matrix() + step * plane.normal.transpose() / distance) * self.lens_back;
        map / map[(2, 2)]
    }

    /// From frame pixels to the plane's own units.
    fn onto(&self, plane: &Plane) -> Map {
        let columns = Matrix3::from_columns(&[plane.axes[0], plane.axes[1], plane.origin]);
        inverse(&(self.lens * columns))
    }

    /// The point of the ground that a pixel shows.
    fn ground(&self, [x, y]: [f64; 2]) -> Vector3<f64> {
        let ray = self.lens_back * Vector3::new(x, y, 1.0);
        ray / ray.dot(&self.down).max(0.05)
    }

    /// Flat at a height over the ground, its middle over a point of it.
    fn flat(&self, foot: Vector3<f64>, height: f64, heading: f64) -> Plane {
        let right = self.down.cross(&Vector3::y()).cross(&self.down).normalize();
        let ahead = self.down.cross(&right);
        let (sine, cosine) = heading.sin_cos();
        let axes = [right * cosine + ahead * sine, ahead * cosine - right * sine];
        Plane { normal: self.down, origin: foot - self.down * height, axes, own: Vector3::zeros() }
    }

    /// Upright on a point of the ground, turned to the camera.
    fn upright(&self, foot: Vector3<f64>) -> Plane {
        let away = (foot - self.down * foot.dot(&self.down)).try_normalize(1e-6).unwrap_or_else(Vector3::y);
        let right = self.down.cross(&away);
        Plane { normal: away, origin: foot, axes: [right, self.down], own: Vector3::zeros() }
    }
}

/// The layers of a scene, back to front.
pub(super) fn layers<'l>(dice: &mut Dice, library: &'l Library, size: [usize; 2]) -> Vec<Layer<'l>> {
    let frame = size.map(|side| side as f64);
    let camera = Camera::draw(dice, frame);
    let middle = [(frame[0] - 1.0) / 2.0, (frame[1] - 1.0) / 2.0];
    let ground = camera.flat(camera.ground(middle), 0.0, dice.even(0.0, std::f64::consts::TAU));
    let mut planes = vec![ground];
    let unit = camera.focal / camera.ground(middle).norm();
    let mut layers = vec![Layer {
        motion: Map::identity(),
        local: turn(0.0, unit) * camera.onto(&planes[0]),
        outline: Outline::All,
        fill: library.window(dice, 0.5 * frame[0], [0.6, 1.4], 0.0),
    }];
    let mut things: Vec<(f64, Plane, Layer<'l>)> =
        (0..2 + dice.pick(14)).filter_map(|_| stand(dice, library, &camera, frame)).collect();
    things.sort_by(|a, b| b.0.total_cmp(&a.0));
    for (_, plane, layer) in things {
        planes.push(plane);
        layers.push(layer);
    }
    // The whole motion is made smaller until nothing moves farther than it may.
    let mut part = 1.0;
    for _ in 0..4 {
        for (layer, plane) in layers.iter_mut().zip(&planes) {
            layer.motion = camera.motion(plane, part);
        }
        let most = layers.iter().map(|layer| farthest(layer, size)).fold(0.0, f64::max);
        if most <= LONGEST {
            break;
        }
        part *= 0.97 * LONGEST / most.min(1e4);
    }
    layers
}

/// Something on the ground or over it, with its distance from the camera.
fn stand<'l>(
    dice: &mut Dice,
    library: &'l Library,
    camera: &Camera,
    [width, height]: [f64; 2],
) -> Option<(f64, Plane, Layer<'l>)> {
    let pixel = [dice.even(-0.05, 1.05) * width, dice.even(-0.05, 1.1) * height];
    let foot = camera.ground(pixel);
    // Things on the ground and roofs more than what comes close.
    let tall = if dice.chance(0.2) { 0.0 } else { dice.even(0.03, 0.6) };
    let slant = camera.down.z < 0.9;
    let mut plane = if slant && dice.chance(0.5) {
        camera.upright(foot)
    } else {
        camera.flat(foot, tall, dice.even(0.0, std::f64::consts::TAU))
    };
    if dice.chance(0.2) {
        let along = dice.even(0.0, std::f64::consts::TAU);
        let pace = dice.even(0.0, 0.02);
        plane.own = plane.axes[0] * (pace * along.cos());
        if plane.normal == camera.down {
            plane.own += plane.axes[1] * (pace * along.sin());
        }
    }
    let near = plane.origin.norm();
    if plane.normal.dot(&plane.origin) < 0.02 || plane.origin.z < 0.1 {
        return None;
    }
    // The plane's own pixels are about as wide as the frame's.
    let unit = camera.focal / near;
    let local = turn(0.0, unit) * camera.onto(&plane);
    let radius = dice.ratio(0.04, 0.22) * width;
    let centre = apply(&inverse(&local), [0.0, 0.0])?;
    let standing = plane.normal != camera.down;
    let mut layer = if standing && dice.chance(0.4) {
        let outline = Outline::pole(dice, tall.max(0.1) * unit);
        Layer { motion: Map::identity(), local, outline, fill: library.window(dice, radius, [0.6, 2.0], 0.6) }
    } else {
        let mut layer = thing(dice, library, [0.0, 0.0], radius, width);
        // What stands, stands on its foot.
        let lift = if standing { [0.0, f64::from(layer.outline.reach()).min(0.8 * unit)] } else { [0.0, 0.0] };
        layer.local = layer.local * shift(lift) * local;
        layer
    };
    layer.motion = Map::identity();
    let seen = (-0.5 * width..1.5 * width).contains(&centre[0]) && (-0.5 * height..1.5 * height).contains(&centre[1]);
    seen.then_some((near, plane, layer))
}
