//! What is in the way: dense flow becomes time to contact, cell by cell and in 72 sectors around the body.
//!
//! The gyro's turn is taken off each vector, the focus of expansion is found among what is left, and how far a vector
//! reaches along its line from the focus is the inverse of the time to contact of what it belongs to. No speed and no
//! range is needed for that; where speed is metric, times are distances too. A sector that can't be seen, for the dark,
//! for want of texture, or because it lies outside the camera's field, is unknown and never free. Wires and rods are
//! narrower than a cell: they are found as lines in the frames and followed by their parallax, and what one of them may
//! stand before is not free either.

mod cell;
mod config;
mod heading;
mod mover;
mod ridge;
mod sector;
mod surface;
mod texture;
mod thin;

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

pub use config::{Config, REASONS};

use super::{
    Lack, Odometer, Scale, Velocity,
    quality::below,
    thinned::{Ray, Rays, Thinned, weight},
};
use crate::{clock::Stamp, exposure::Exposed, flow::Flow};
use cell::{Cell, Scene};
use heading::{Memory, Search};
use mover::Movers;
use sector::{Corridor, Sectors};
use texture::Texture;
use thin::{Step, Things};

/// Sectors of five degrees; sector k looks along −π + k · 2π/72, counter-clockwise from above, so that 36 looks forward.
pub const SECTORS: usize = 72;

/// A speed that may be off by more than this part of itself makes no distances: where a wall fills the view there is no
/// ground to measure it by.
const SPEED_SD_PART_MAX: f64 = 0.25;

/// The velocity's direction and that of the flow are of one motion where they are within so many deviations.
const DIRECTION_SDS: f64 = 4.0;

/// The most cells that are looked at; a finer raster is thinned evenly.
const CELLS_MAX: usize = 8000;

/// What is known of a sector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sector {
    /// It is not seen, or not well enough to say.
    Unknown,
    /// Nothing that it shows is met before the horizon.
    Free {
        /// Probability, 0…1.
        confidence: f64,
    },
    /// Something is in the way.
    Occupied {
        /// Seconds until the plane across the motion that holds it is reached.
        ttc_s: f64,
        /// Metres from the camera, for what stands still; NaN where speed is not metric.
        distance_m: f64,
        /// Probability that it is met before the horizon, 0…1.
        confidence: f64,
        /// Enough of the sector was seen to say that nothing nearer hides in the rest of it.
        whole: bool,
    },
}

/// What one step says about the surroundings, at the newer frame's stamp.
///
/// Sectors stand in the body frame with its roll and pitch taken off (FLU: x forward, y left, z up).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Obstacles {
    /// Stamp of the older frame.
    pub older: Stamp,
    /// Stamp of the newer frame.
    pub newer: Stamp,
    /// See [`SECTORS`].
    pub sectors: [Sector; SECTORS],
    /// Unit vector of the motion by the flow, same frame.
    pub heading: [f64; 3],
    /// Its largest standard deviation, radians.
    pub heading_sd_rad: f64,
    /// Speed over ground, m/s, where it is metric.
    pub speed: Option<f64>,
    /// What is met later than this is not in the way, seconds: the shorter of the settings' horizon and reach.
    pub horizon_s: f64,
    /// Time constant of the filter, seconds.
    pub delay_s: f64,
}

/// Why nothing is known about the surroundings.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum NoSight {
    /// Nobody asked.
    #[error("obstacles are not looked for: [motion.obstacles] is absent")]
    Off,
    /// The flow, its calibration or the gyro is missing.
    #[error(transparent)]
    Lack(#[from] Lack),
    /// There is nothing that a displacement could be seen by.
    #[error("{seen} of {cells} cells show texture, at least {needed} are needed")]
    Bare {
        /// Cells that show something.
        seen: u32,
        /// Cells that were looked at.
        cells: u32,
        /// The limit.
        needed: u32,
    },
    /// The camera hardly moves against what it sees.
    #[error("the direction of motion is known to {sd_rad:.2} rad, at most {allowed_rad:.2} are allowed")]
    Parallax {
        /// Standard deviation.
        sd_rad: f64,
        /// The limit.
        allowed_rad: f64,
    },
}

/// What the odometer knows of a step beside the flow.
pub(super) struct Sighting {
    /// Optical axes to body axes.
    pub(super) mount: Matrix3<f64>,
    /// Newer body axes to older ones.
    pub(super) turn: UnitQuaternion<f64>,
    /// The world's up in the newer body's axes.
    pub(super) up: Vector3<f64>,
    pub(super) interval_s: f64,
}

/// Looks for what is in the way. It allocates nothing after its first steps.
#[derive(Debug)]
pub struct Lookout {
    config: Config,
    cells: Vec<Cell>,
    columns: usize,
    rays: Rays,
    texture: Texture,
    movers: Movers,
    sectors: Sectors,
    things: Things,
    memory: Option<(Stamp, Memory)>,
    /// When speed was last known well, and how fast it was then.
    speed: Option<(Stamp, f64)>,
    newest: Option<Stamp>,
    order: Vec<u32>,
    lengths: Vec<f64>,
    closing: Vec<f32>,
}

impl Lookout {
    /// Checks the settings.
    pub fn new(config: &Config) -> Result<Self, super::Error> {
        let wrong = |what: String| Err(super::Error::Settings(what));
        let positive = [
            ("horizon_s", config.horizon_s),
            ("delay_s", config.delay_s),
            ("below_m", config.below_m),
            ("above_m", config.above_m),
            ("reach_m_max", config.reach_m_max),
            ("likeness_cells", config.likeness_cells),
            ("texture_sd_px_max", config.texture_sd_px_max),
        ];
        for (key, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return wrong(format!("obstacles.{key} is {value}, a positive number is needed"));
            }
        }
        if !(config.confidence_min >= 0.5 && config.confidence_min < 1.0) {
            return wrong(format!(
                "obstacles.confidence_min is {}, a probability from 0.5 to below 1 is needed",
                config.confidence_min
            ));
        }
        Ok(Self {
            config: config.clone(),
            cells: Vec::new(),
            columns: 0,
            rays: Rays::default(),
            texture: Texture::default(),
            movers: Movers::default(),
            sectors: Sectors::new(),
            things: Things::default(),
            memory: None,
            speed: None,
            newest: None,
            order: Vec::new(),
            lengths: Vec::new(),
            closing: Vec::new(),
        })
    }

    /// What is in the way after a step. `older` is the developed older frame, on whose pixels the vectors stand;
    /// `velocity` is what the odometer made of the same step.
    pub fn look(
        &mut self,
        odometer: &Odometer,
        flow: &Flow<'_>,
        camera_size: [u32; 2],
        older: &Exposed,
        velocity: &Result<Velocity, Lack>,
    ) -> Result<Obstacles, NoSight> {
        self.closing.clear();
        if self.newest.is_some_and(|newest| newest != flow.older) {
            // Steps are missing between: how the body turned there is not known.
            (self.memory, self.newest, self.speed) = (None, None, None);
            self.sectors.forget();
        }
        let sighting = odometer.sighting(flow, camera_size)?;
        self.newest = Some(flow.newer);
        let pixel = f64::from(older.scale[0]) / odometer.lens(camera_size)?.focal();
        self.fill(odometer, flow, camera_size, older, &sighting)?;
        let body = sighting.turn.inverse().to_rotation_matrix().matrix() * sighting.mount;
        let level = levelled(&sighting.up);
        self.sectors.predict(sighting.interval_s, yaw(&level, &sighting.turn), &self.config);
        let seen = self.cells.iter().filter(|cell| cell.seen).count() as u32;
        let needed = self.config.cells_min.max(2) as u32;
        let bare = NoSight::Bare { seen, cells: self.cells.len() as u32, needed };
        if seen < needed {
            return Err(bare);
        }
        let heading = self.heading(odometer, flow, &sighting, &body, velocity, pixel).ok_or(bare)?;
        let (sd_rad, allowed_rad) = (heading.sd(), self.config.heading_sd_rad_max);
        if !sd_rad.is_finite() || sd_rad > allowed_rad {
            return Err(NoSight::Parallax { sd_rad, allowed_rad });
        }
        self.memory = heading.remember(&body).map(|memory| (flow.newer, memory));
        let speed = self.hold_speed(flow.newer, velocity);
        let scene = Scene {
            config: &self.config,
            heading: &heading,
            level: level * body,
            interval_s: sighting.interval_s,
            pixel,
        };
        for cell in self.cells.iter_mut().filter(|cell| cell.shown) {
            cell.place(&scene);
            cell.measure(&scene);
        }
        self.movers.find(&mut self.cells, self.columns, &scene);
        let corridor = Corridor::new(&self.config, speed);
        let step = step(odometer, flow, &sighting, &heading, velocity, speed, pixel);
        if self.config.thin {
            self.things.look(older, odometer.lens(camera_size)?, &step);
            self.things.cover(&mut self.cells, pixel, &self.config, &corridor);
        }
        self.sectors.update(&self.cells, &scene, &corridor);
        self.closing.extend(self.cells.iter().map(|cell| if cell.known { cell.closing as f32 } else { f32::NAN }));
        let (mut sectors, path) = (self.sectors.conclude(&self.config, &corridor), scene.level * heading.direction);
        if self.config.thin {
            self.things.go_on(&step);
            self.things.tell(&mut sectors, &(level * sighting.mount), &path, &self.config, &corridor);
        }
        Ok(Obstacles {
            older: flow.older,
            newer: flow.newer,
            sectors,
            heading: path.into(),
            heading_sd_rad: sd_rad,
            speed,
            horizon_s: 1.0 / corridor.clear,
            delay_s: self.config.delay_s,
        })
    }

    /// The speed of the newest step at which it was known well, unless that is too long ago.
    fn hold_speed(&mut self, newer: Stamp, velocity: &Result<Velocity, Lack>) -> Option<f64> {
        if let Some(speed) = metric(velocity) {
            self.speed = Some((newer, speed));
        }
        let recent = |(stamp, _): &(Stamp, f64)| newer.seconds_since(*stamp) <= self.config.speed_hold_s;
        self.speed.filter(recent).map(|(_, speed)| speed)
    }

    /// Inverse time to contact of the newest step's cells, 1/s, row by row, and how many columns there are; NaN where it
    /// is unknown, negative for what stays behind or leaves. Empty where the step gave none.
    pub fn inverse_ttc(&self) -> (&[f32], usize) {
        (&self.closing, self.columns)
    }

    /// Fills the raster: rays of both ends of each vector, the turn taken off, and what the texture is worth.
    fn fill(
        &mut self,
        odometer: &Odometer,
        flow: &Flow<'_>,
        camera_size: [u32; 2],
        older: &Exposed,
        sighting: &Sighting,
    ) -> Result<(), Lack> {
        let lens = odometer.lens(camera_size)?;
        let raster = Thinned::to(flow.grid, CELLS_MAX);
        self.rays.see(lens, raster);
        self.columns = raster.columns();
        self.texture.look(older);
        let back = (sighting.mount.transpose() * sighting.turn.to_rotation_matrix().matrix()) * sighting.mount;
        let turned = |[x, y]: [f64; 2]| {
            let ray = back * Vector3::new(x, y, 1.0);
            (ray.z > 0.1).then(|| [ray.x / ray.z, ray.y / ray.z])
        };
        let size = flow.grid.scale.map(|scale| scale * raster.step as f32);
        let (texture, limit) = (&self.texture, self.config.texture_sd_px_max);
        let least = odometer.config.confidence_min.max(1e-3);
        let cell = |place: (usize, usize), ray: &Option<Ray>| -> Option<Cell> {
            let older = ray.as_ref()?.at;
            let shown = Cell { shown: true, older, newer: turned(older)?, ..Cell::default() };
            let Some(([u, v], confidence)) = raster.seen(flow, place) else { return Some(shown) };
            let centre = raster.pixel(place);
            let newer = lens.ray([centre[0] + u, centre[1] + v]).and_then(turned);
            let (Some(newer), true) = (newer, confidence >= least) else { return Some(shown) };
            let texture = texture.at(centre.map(|c| c as f32), size);
            let seen = texture::best_sd(texture) <= limit;
            Some(Cell { seen, newer, weight: weight(confidence), texture, ..shown })
        };
        self.cells.clear();
        self.cells.extend(raster.cells().zip(&self.rays.rays).map(|(place, ray)| cell(place, ray).unwrap_or_default()));
        Ok(())
    }

    fn heading(
        &mut self,
        odometer: &Odometer,
        flow: &Flow<'_>,
        sighting: &Sighting,
        body: &Matrix3<f64>,
        velocity: &Result<Velocity, Lack>,
        pixel: f64,
    ) -> Option<heading::Heading> {
        let fading = (-sighting.interval_s / self.config.delay_s).exp();
        // Memory stands in the older body's axes, which were the newer ones of the step before.
        let memory = self.memory.filter(|(stamp, _)| *stamp == flow.older);
        let memory = memory.map(|(_, memory)| memory.turned(&sighting.mount.transpose(), fading));
        let fitted = velocity.as_ref().ok().map(|velocity| body.transpose() * Vector3::from(velocity.linear));
        let search = Search {
            candidates: [memory.map(|memory| memory.direction), fitted.and_then(|v| v.try_normalize(1e-6))],
            memory,
            seed_rad: odometer.config.seed_rad,
            likeness: self.config.likeness_cells,
            shared_rad: self.config.shared_px * pixel,
            draws: u64::from(odometer.config.seed) ^ flow.older.ns().cast_unsigned(),
            cells: &self.cells,
        };
        search.run(&mut self.order, &mut self.lengths)
    }
}

/// Body axes to the level frame with the same yaw.
fn levelled(up: &Vector3<f64>) -> Matrix3<f64> {
    let forward = (Vector3::x() - up * up.x).try_normalize(1e-3).unwrap_or_else(|| up.cross(&Vector3::y()));
    Matrix3::from_rows(&[forward.transpose(), up.cross(&forward).transpose(), up.transpose()])
}

/// How far the body turned about the world's up from the older frame to the newer one, radians.
fn yaw(level: &Matrix3<f64>, turn: &UnitQuaternion<f64>) -> f64 {
    let up = level.row(2).transpose();
    turn.scaled_axis().dot(&up)
}

/// How the camera itself moved. Where the ground shows the velocity, its direction is better known than that of the flow.
fn step(
    odometer: &Odometer,
    flow: &Flow<'_>,
    sighting: &Sighting,
    heading: &heading::Heading,
    velocity: &Result<Velocity, Lack>,
    speed: Option<f64>,
    pixel: f64,
) -> Step {
    // Older optical axes to those of the newer body.
    let body = sighting.turn.inverse().to_rotation_matrix().matrix() * sighting.mount;
    let fitted = metric(velocity).and(velocity.as_ref().ok()).map(|velocity| Vector3::from(velocity.linear));
    let fitted = fitted.and_then(|linear| (body.transpose() * linear).try_normalize(1e-6));
    let near = |fitted: &Vector3<f64>| fitted.dot(&heading.direction) > (DIRECTION_SDS * heading.sd()).cos();
    let direction = fitted.filter(near).unwrap_or(heading.direction);
    Step {
        older: flow.older,
        newer: flow.newer,
        path: direction * (speed.unwrap_or(1.0) * sighting.interval_s),
        metric: speed.is_some(),
        interval_s: sighting.interval_s,
        turn: sighting.mount.transpose() * body,
        heading_sd_rad: heading.sd(),
        drift_sd_rad_s: odometer.config.gyro_bias_sd_rad_s,
        pixel,
    }
}

/// The speed where it is metric and known well.
fn metric(velocity: &Result<Velocity, Lack>) -> Option<f64> {
    let Ok(Velocity { scale: Scale::Metric { .. }, linear, covariance, .. }) = velocity else { return None };
    let linear = Vector3::from(*linear);
    let (speed, spread) = (linear.norm(), Matrix3::from_fn(|i, j| covariance[i][j]));
    let sd = (linear.dot(&(spread * linear)) / (speed * speed).max(1e-12)).max(0.0).sqrt();
    (sd <= SPEED_SD_PART_MAX * speed).then_some(speed.max(1e-3))
}

/// The nearest sector of an azimuth, radians.
fn sector_of(azimuth: f64) -> usize {
    let width = std::f64::consts::TAU / SECTORS as f64;
    ((azimuth + std::f64::consts::PI) / width).round() as usize % SECTORS
}
