//! A simulated course in the dark: a drone looks forward, obstacles stand or cross before it, and it may brake.
//!
//! The world is x along the track, y left, z up, metres, with the drone's start at (0, 0, height). Consumers close the loop:
//! each [`Course::shot`] takes the acceleration that they ask for. The attitude sways, and does not follow the
//! acceleration, as on a gimbal.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::{
    contact::{Around, Site},
    eye::{self, Eye},
    flight::BEGIN,
    instruments::Instruments,
    noise::{Noise, Normals},
    path::{Pose, Sway},
    profiles,
    scene::{Block, Scene},
};
pub use super::{
    contact::{BAND_M, SECTORS, bearing},
    eye::{BLACK, OPTICAL_FRAME, TrueFlow, WHITE},
    flight::Error,
    instruments::BODY_FRAME,
};
use crate::{
    camera::{Frame, Sample},
    clock::Stamp,
    wire::CameraInfo,
};

/// Things across the track reach so far to either side, and walls and poles so high.
const REACH_M: f64 = 25.0;
const TALL_M: f64 = 12.0;
const DEEP_M: f64 = 0.5;

/// What is flown, and into what.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Draws the sway, the surfaces and the noise.
    pub seed: u64,
    /// Columns and rows; multiples of 8.
    pub size: [usize; 2],
    /// Frames a second.
    pub fps: f64,
    /// Speed at the start, m/s along the track.
    pub speed: f64,
    /// Height at the start, metres.
    pub height: f64,
    /// Mean of the first frame above black, 1 = white.
    pub mean: f64,
    /// The camera's noise; `None` gives clean frames.
    pub noise: Option<Noise>,
    /// What stands and moves in the world.
    pub things: Vec<Thing>,
}

impl Default for Settings {
    /// At 3 m/s and 4 m towards a wall 15 m ahead, in little light, as a Canon EOS M6 at ISO 3200 would see it.
    fn default() -> Self {
        Self {
            seed: 1,
            size: [640, 480],
            fps: 15.0,
            speed: 3.0,
            height: 4.0,
            mean: 0.01,
            noise: profiles::find("Canon EOS M6", 3200).ok(),
            things: vec![Thing::wall(15.0)],
        }
    }
}

/// A box in the drone's way or beside it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thing {
    /// Its least corner at the start, metres, world.
    pub low: [f64; 3],
    /// Its greatest corner at the start.
    pub high: [f64; 3],
    /// m/s, world, from the start on.
    pub velocity: [f64; 3],
}

impl Thing {
    /// A wall across the track, so many metres from the start.
    pub fn wall(distance: f64) -> Thing {
        Thing::still([distance, -REACH_M, 0.0], [distance + DEEP_M, REACH_M, TALL_M])
    }

    /// A square pole whose middle stands at (x, y).
    pub fn pole(x: f64, y: f64, width: f64) -> Thing {
        let half = 0.5 * width;
        Thing::still([x - half, y - half, 0.0], [x + half, y + half, TALL_M])
    }

    /// A wire across the track at x, `height` metres over the ground.
    pub fn wire(x: f64, height: f64, thickness: f64) -> Thing {
        let half = 0.5 * thickness;
        Thing::still([x - half, -REACH_M, height - half], [x + half, REACH_M, height + half])
    }

    /// The same, so many metres wide across the track, with its middle on it.
    pub fn wide(self, metres: f64) -> Thing {
        let Thing { mut low, mut high, .. } = self;
        (low[1], high[1]) = (-0.5 * metres, 0.5 * metres);
        Thing { low, high, ..self }
    }

    /// The same, moving.
    pub fn moving(self, velocity: [f64; 3]) -> Thing {
        Thing { velocity, ..self }
    }

    fn still(low: [f64; 3], high: [f64; 3]) -> Thing {
        Thing { low, high, velocity: [0.0; 3] }
    }
}

/// What is true about a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Truth {
    /// The frame's stamp.
    pub stamp: Stamp,
    /// Metres, world.
    pub position: [f64; 3],
    /// m/s, body (FLU), at the stamp.
    pub velocity: [f64; 3],
    /// rad/s, body (FLU), at the stamp.
    pub rates: [f64; 3],
    /// Seconds to contact with the first thing that nears, by sector ([`bearing`]): the time to the plane through the
    /// thing's nearest point across its velocity relative to the drone. None where nothing nears, or nothing can be seen.
    pub sectors: [Option<f64>; SECTORS],
    /// Horizontal metres to the nearest thing, whether it nears or not.
    pub distances: [Option<f64>; SECTORS],
    /// Whether the whole width of the sector lies in the image.
    pub in_view: [bool; SECTORS],
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

/// From one frame to the next: the acceleration is held.
#[derive(Debug, Clone, Copy)]
struct Leg {
    begin: Stamp,
    /// At the beginning: metres, m/s and m/s², world.
    position: Vector3<f64>,
    velocity: Vector3<f64>,
    acceleration: Vector3<f64>,
}

impl Leg {
    /// Position and velocity; before the leg the velocity is taken as having been the same.
    fn at(&self, stamp: Stamp) -> [Vector3<f64>; 2] {
        let t = stamp.seconds_since(self.begin);
        let change = if t > 0.0 { self.acceleration * t } else { Vector3::zeros() };
        [self.position + (self.velocity + 0.5 * change) * t, self.velocity + change]
    }
}

/// A drone on its course. The camera looks forward with the image's top up, 74° wide.
#[derive(Debug, Clone)]
pub struct Course {
    settings: Settings,
    /// As at the start.
    scene: Scene,
    velocities: Vec<Vector3<f64>>,
    /// Roll, pitch and yaw.
    sway: [Sway; 3],
    eye: Eye,
    instruments: Instruments,
    leg: Leg,
    index: u64,
}

impl Course {
    /// Checks the settings and sets up the things. The start is one frame period before the first frame.
    pub fn new(settings: Settings) -> Result<Course, Error> {
        check(&settings)?;
        let block = |thing: &Thing| Block::new(thing.low.into(), thing.high.into());
        let scene = Scene::with(settings.seed, settings.things.iter().map(block).collect());
        let mut draws = Normals::new(settings.seed, 0xc0a5);
        let mut sway = |amplitude, period| Sway::draw(amplitude, period, &mut draws);
        let sway = [sway(0.04, 1.7), sway(0.04, 2.1), sway(0.06, 4.0)];
        let mount = Matrix3::new(0., 0., 1., -1., 0., 0., 0., -1., 0.);
        let eye = Eye::new(settings.size, mount, settings.noise, settings.seed);
        let leg = Leg {
            begin: stamp(&settings, -1.0),
            position: Vector3::z() * settings.height,
            velocity: Vector3::x() * settings.speed,
            acceleration: Vector3::zeros(),
        };
        let velocities = settings.things.iter().map(|thing| thing.velocity.into()).collect();
        let instruments = Instruments::new(settings.seed, BEGIN);
        let mut course = Course { settings, scene, velocities, sway, eye, instruments, leg, index: 0 };
        let (scene, pose) = (course.scene(BEGIN), course.pose(BEGIN));
        course.eye.settle(&scene, &course.eye.view(&scene, &pose));
        Ok(course)
    }

    /// The calibration of its camera.
    pub fn info(&self, stamp: Stamp) -> CameraInfo {
        self.eye.info(stamp)
    }

    /// Flies on for one frame period under an acceleration (m/s², world; what is not finite counts as 0), and takes the
    /// frame at its end.
    pub fn shot(&mut self, acceleration: [f64; 3]) -> Shot {
        let older = stamp(&self.settings, self.index as f64 - 1.0);
        let newer = stamp(&self.settings, self.index as f64);
        let [position, velocity] = self.leg.at(older);
        let acceleration = Vector3::from(acceleration.map(|a| if a.is_finite() { a } else { 0.0 }));
        self.leg = Leg { begin: older, position, velocity, acceleration };
        let mut samples = Vec::new();
        self.measure(newer, &mut samples);
        samples.push(Sample::Info(Arc::new(self.info(newer))));
        let (scene, pose) = (self.scene(newer), self.pose(newer));
        let view = self.eye.view(&scene, &pose);
        let image = self.eye.image(newer, &scene, &view, self.settings.mean, self.index);
        samples.push(Sample::Frame(Arc::new(Frame { image, received: newer })));
        let flow = (self.index > 0).then(|| {
            let before = self.scene(older);
            let then = self.eye.view(&before, &self.pose(older));
            self.eye.true_flow(older, (&before, &then), (&scene, &view))
        });
        let [position, velocity] = self.leg.at(newer);
        let site = Site {
            eye: &self.eye,
            view: &view,
            scene: &scene,
            velocity,
            velocities: &self.velocities,
            yaw: pose.attitude.euler_angles().2,
        };
        let Around { ttc_s, distance_m, in_view } = site.around();
        self.index += 1;
        let truth = Truth {
            stamp: newer,
            position: position.into(),
            velocity: pose.velocity.into(),
            rates: pose.rates.into(),
            sectors: ttc_s,
            distances: distance_m,
            in_view,
            flow,
        };
        Shot { samples, truth }
    }

    fn measure(&mut self, until: Stamp, samples: &mut Vec<Sample>) {
        let mut instruments = self.instruments.clone();
        let below = |stamp, pose: &Pose| self.scene(stamp).below(&pose.position, &pose.attitude);
        instruments.until(until, |stamp| self.pose(stamp), below, samples);
        self.instruments = instruments;
    }

    fn pose(&self, stamp: Stamp) -> Pose {
        let sway = self.sway.map(|sway| {
            let [angle, rate, _] = sway.at(stamp.seconds_since(BEGIN));
            [angle, rate]
        });
        Pose::new(self.leg.at(stamp), self.leg.acceleration, sway)
    }

    /// Every thing where it is at the moment.
    fn scene(&self, at: Stamp) -> Scene {
        let seconds = at.seconds_since(stamp(&self.settings, -1.0));
        let moved = self.scene.blocks().iter().zip(&self.velocities).map(|(block, v)| block.shifted(v * seconds));
        Scene::with(self.settings.seed, moved.collect())
    }
}

/// Of a frame; −1 is the start.
fn stamp(settings: &Settings, index: f64) -> Stamp {
    Stamp(BEGIN.ns() + (index / settings.fps * 1e9).round() as i64)
}

fn check(settings: &Settings) -> Result<(), Error> {
    let wrong = |what, found: String, expected| Err(Error::Setting { what, found, expected });
    for (what, value) in [("fps", settings.fps), ("height", settings.height)] {
        if !(value.is_finite() && value > 0.0) {
            return wrong(what, value.to_string(), "a positive number");
        }
    }
    if !settings.speed.is_finite() {
        return wrong("speed", settings.speed.to_string(), "a number");
    }
    if !(1e-5..=0.5).contains(&settings.mean) {
        return wrong("mean", settings.mean.to_string(), "a mean from 0.00001 to 0.5 of white");
    }
    if !eye::fits(settings.size) {
        return wrong("size", format!("{:?}", settings.size), "columns and rows that are multiples of 8, at most 8192");
    }
    let finite = |thing: &Thing| [thing.low, thing.high, thing.velocity].iter().flatten().all(|v| v.is_finite());
    let solid = |thing: &Thing| (0..3).all(|axis| thing.low[axis] < thing.high[axis]);
    match settings.things.iter().find(|thing| !(finite(thing) && solid(thing))) {
        Some(thing) => wrong("a thing", format!("{thing:?}"), "finite numbers, and low below high"),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small(things: Vec<Thing>) -> Course {
        Course::new(Settings { size: [64, 48], noise: None, things, ..Settings::default() }).unwrap()
    }

    /// The flow of the cell at (column, row) of the 8×6 raster.
    fn cell(flow: &TrueFlow, column: usize, row: usize) -> [f64; 2] {
        let at = 2 * (row * flow.grid.width + column);
        [f64::from(flow.vectors[at]), f64::from(flow.vectors[at + 1])]
    }

    #[test]
    fn the_flow_is_that_of_points_projected_twice() {
        let drift = [0.0, 1.5, 0.0];
        let mut course = small(vec![Thing::wall(12.0).moving(drift)]);
        for _ in 0..3 {
            course.shot([0.5, -0.5, 0.2]);
        }
        let older = stamp(&course.settings, 2.0);
        let pose = |course: &Course, at| {
            let pose = course.pose(at);
            (pose.position, pose.attitude.to_rotation_matrix())
        };
        let before = pose(&course, older);
        let truth = course.shot([-1.0, 0.5, 0.0]).truth;
        let (after, flow) = (pose(&course, truth.stamp), truth.flow.unwrap());
        let dt = truth.stamp.seconds_since(older);
        let focal = 0.66 * 64.0;
        let (mut walls, mut grounds) = (0, 0);
        for (column, row) in (0..8).flat_map(|c| (0..6).map(move |r| (c, r))) {
            let [x, y] = [(column as f64 + 0.5) * 8.0 - 32.0, (row as f64 + 0.5) * 8.0 - 24.0];
            // Body axes: forward, left, up.
            let ray = before.1 * Vector3::new(1.0, -x / focal, -y / focal);
            let wall = before.0 + ray * ((12.0 - before.0.x) / ray.x);
            let point = if wall.z > 0.0 {
                walls += 1;
                wall + Vector3::from(drift) * dt
            } else {
                grounds += 1;
                before.0 - ray * (before.0.z / ray.z)
            };
            let seen = after.1.inverse() * (point - after.0);
            let there = [-focal * seen.y / seen.x, -focal * seen.z / seen.x];
            let found = cell(&flow, column, row);
            for (there, (from, found)) in there.into_iter().zip([x, y].into_iter().zip(found)) {
                assert!((there - from - found).abs() < 1e-4, "({column}, {row}): {found}, expected {}", there - from);
            }
        }
        assert!(walls > 20 && grounds > 5, "{walls} cells on the wall, {grounds} on the ground");
    }

    #[test]
    fn a_wall_is_reached_after_distance_by_speed() {
        let mut course = small(vec![Thing::wall(15.0)]);
        for _ in 0..20 {
            let truth = course.shot([0.0; 3]).truth;
            let left = 15.0 - truth.position[0];
            assert_eq!(truth.in_view.iter().filter(|seen| **seen).count(), 13, "5° each of 74°");
            for sector in 0..SECTORS {
                assert_eq!(truth.in_view[sector], sector.abs_diff(36) <= 6);
                assert_eq!(truth.in_view[sector], truth.sectors[sector].is_some());
                let Some(ttc) = truth.sectors[sector] else { continue };
                assert!((ttc - left / 3.0).abs() < 1e-9, "sector {sector}: {ttc} s, {left} m");
            }
            // The sway turns the drone, so that straight ahead is not the shortest way.
            assert!((truth.distances[36].unwrap() - left).abs() < 0.01 * left, "{:?}", truth.distances[36]);
        }
    }

    #[test]
    fn thin_far_hidden_crossing_and_high_things_count_as_they_should() {
        let wire = small(vec![Thing::wire(12.0, 4.5, 0.02)]).shot([0.0; 3]).truth;
        assert!((wire.sectors[36].unwrap() - (12.0 - 0.01 - 0.2) / 3.0).abs() < 1e-9, "{:?}", wire.sectors[36]);
        let pole = small(vec![Thing::pole(10.0, 0.0, 0.05), Thing::wall(15.0)]).shot([0.0; 3]).truth;
        let near: Vec<usize> = (0..SECTORS).filter(|s| pole.sectors[*s].is_some_and(|ttc| ttc < 4.0)).collect();
        assert!(near.len() == 1 && near[0].abs_diff(36) <= 1, "{near:?}");
        // Behind the wall, beneath the band, and in flight away: nothing nears sooner for them.
        let hidden = [Thing::wall(10.0), Thing::pole(14.0, 0.0, 1.0).moving([-9.0, 0.0, 0.0])];
        assert!((small(hidden.into()).shot([0.0; 3]).truth.sectors[36].unwrap() - 9.8 / 3.0).abs() < 1e-9);
        let low = Thing { high: [10.0, 5.0, 2.9], ..Thing::wall(9.0) };
        assert_eq!(small(vec![low]).shot([0.0; 3]).truth.sectors, [None; SECTORS]);
        let leaving = small(vec![Thing::wall(9.0).moving([4.0, 0.0, 0.0])]).shot([0.0; 3]).truth;
        assert!(leaving.sectors[36].is_none() && leaving.distances[36].is_some());
        // One that comes from the right at the drone's own speed is nearest half-way.
        let crossing = Thing::pole(8.0, -8.0, 0.4).moving([0.0, 3.0, 0.0]);
        let truth = small(vec![crossing]).shot([0.0; 3]).truth;
        let at = truth.sectors.iter().position(Option::is_some);
        assert_eq!(at, None, "45° to the right is out of view");
        let truth = small(vec![Thing::pole(8.0, -4.0, 0.4).moving([0.0, 3.0, 0.0])]).shot([0.0; 3]).truth;
        let nearest = truth.sectors.iter().flatten().fold(f64::INFINITY, |a, b| a.min(*b));
        // Its corner nearest across the relative velocity (3, −3), after one frame.
        let expected = ((7.8 - 0.2) * 3.0 + (-3.8 + 0.2) * -3.0) / 18.0;
        assert!((nearest - expected).abs() < 0.02, "{nearest} s, expected {expected} s");
        assert_eq!(small(vec![]).shot([0.0; 3]).truth.sectors, [None; SECTORS], "ground and sky are no things");
    }

    #[test]
    fn braking_stops_the_drone_where_it_should() {
        let mut course = small(vec![Thing::wall(15.0)]);
        let braked = (0..15).map(|_| course.shot([-3.0, 0.0, 0.0]).truth).last().unwrap();
        assert!((braked.position[0] - 1.5).abs() < 1e-6, "3 m/s and −3 m/s² stop within 1.5 m: {:?}", braked.position);
        assert!(braked.velocity.iter().all(|v| v.abs() < 1e-6), "{:?}", braked.velocity);
        let mut free = small(vec![Thing::wall(15.0)]);
        let flown = (0..15).map(|_| free.shot([0.0; 3]).truth).last().unwrap();
        assert!((flown.position[0] - 3.0).abs() < 1e-6 && (flown.position[2] - 4.0).abs() < 1e-9);
        let rates = Vector3::from(flown.rates).norm();
        assert!((1e-3..0.3).contains(&rates), "the attitude sways at {rates} rad/s");
    }

    #[test]
    fn the_same_seed_gives_the_same_bytes() {
        let bytes = |seed| {
            let settings = Settings { seed, size: [64, 48], ..Settings::default() };
            let mut course = Course::new(settings).unwrap();
            (0..3).map(|_| format!("{:?}", course.shot([-1.0, 0.0, 0.0]))).collect::<String>()
        };
        assert_eq!(bytes(4), bytes(4));
        assert_ne!(bytes(4), bytes(5));
    }

    #[test]
    fn what_makes_no_sense_is_refused() {
        let wrong = [
            Settings { size: [65, 48], ..Settings::default() },
            Settings { fps: 0.0, ..Settings::default() },
            Settings { speed: f64::NAN, ..Settings::default() },
            Settings { mean: 0.9, ..Settings::default() },
            Settings { things: vec![Thing { low: [f64::NAN; 3], ..Thing::wall(3.0) }], ..Settings::default() },
            Settings { things: vec![Thing { low: [9.0; 3], ..Thing::wall(3.0) }], ..Settings::default() },
        ];
        assert!(wrong.into_iter().all(|settings| Course::new(settings).is_err()));
        let mut course = small(vec![]);
        assert!(course.shot([f64::NAN, f64::INFINITY, 0.0]).truth.position[0].is_finite());
    }
}
