//! A synthetic flight into the dark: raw frames with calibrated noise, gyro, range, and what is true about them.

use std::sync::Arc;

use nalgebra::Matrix3;

use super::{
    eye::{self, Eye, View},
    instruments::Instruments,
    noise::Noise,
    path::{Path, Pose},
    profiles,
    scene::Scene,
};
pub use super::{
    eye::{BLACK, OPTICAL_FRAME, TrueFlow, WHITE},
    instruments::BODY_FRAME,
};
use crate::{
    camera::{Frame, Sample},
    clock::Stamp,
    wire::CameraInfo,
};

/// Frames begin here, gyro and range a little earlier.
pub(super) const BEGIN: Stamp = Stamp(1_700_000_000_000_000_000);

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
    eye: Eye,
    instruments: Instruments,
    index: u64,
}

impl Flight {
    /// Checks the settings and lays out the ground.
    pub fn new(settings: Settings) -> Result<Flight, Error> {
        check(&settings)?;
        let path = Path::new(settings.seed, settings.speed, settings.height);
        let (begin, end) = (-1.5 * settings.height, settings.speed * settings.seconds + 1.5 * settings.height);
        let scene = Scene::new(settings.seed, begin, end, settings.height, path.clear());
        let mount = Matrix3::new(0., -1., 0., -1., 0., 0., 0., 0., -1.);
        let mut eye = Eye::new(settings.size, mount, settings.noise, settings.seed);
        eye.settle(&scene, &eye.view(&scene, &path.at(0.0)));
        let instruments = Instruments::new(settings.seed, BEGIN);
        Ok(Flight { settings, path, scene, eye, instruments, index: 0 })
    }

    /// How many frames the flight has.
    pub fn frames(&self) -> u64 {
        (self.settings.seconds * self.settings.fps).round() as u64 + 1
    }

    /// The calibration of its camera.
    pub fn info(&self, stamp: Stamp) -> CameraInfo {
        self.eye.info(stamp)
    }

    fn stamp(&self, index: u64) -> Stamp {
        Stamp(BEGIN.ns() + (index as f64 / self.settings.fps * 1e9).round() as i64)
    }

    fn pose(&self, stamp: Stamp) -> Pose {
        self.path.at(stamp.seconds_since(BEGIN))
    }

    fn view(&self, stamp: Stamp) -> View {
        self.eye.view(&self.scene, &self.pose(stamp))
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
        let Flight { path, scene, instruments, .. } = self;
        let pose = |stamp: Stamp| path.at(stamp.seconds_since(BEGIN));
        instruments.until(stamp, pose, |_, pose| scene.below(&pose.position, &pose.attitude), &mut samples);
        samples.push(Sample::Info(Arc::new(self.info(stamp))));
        let [from, to] = self.settings.mean;
        let part = self.index as f64 / (self.frames() - 1).max(1) as f64;
        let view = self.view(stamp);
        let image = self.eye.image(stamp, &self.scene, &view, from * (to / from).powf(part), self.index);
        samples.push(Sample::Frame(Arc::new(Frame { image, received: stamp })));
        let pose = self.pose(stamp);
        let flow = self.index.checked_sub(1).map(|before| {
            let older = self.stamp(before);
            self.eye.true_flow(older, (&self.scene, &self.view(older)), (&self.scene, &view))
        });
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
    if !eye::fits(settings.size) {
        return wrong("size", format!("{:?}", settings.size), "columns and rows that are multiples of 8, at most 8192");
    }
    Ok(())
}
