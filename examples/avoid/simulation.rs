//! The closed loop: a simulated drone in the dark, the node's own road with its network, and the consumer that brakes.

use std::error::Error;

use image::RgbImage;
use nightflow::{
    clock::{Stamp, Untimed},
    config::Config,
    darkness::course::{self, Course},
    flow::{Flow, Lender},
    motion::{Mount, obstacles},
    pipeline::{Outcome, Pipeline},
    publish::{self, Iceoryx2, Moved, iceoryx2::SharedSink, pictures, shared::ObstaclesSample},
};

use super::brake::{Brake, Command, Obstacles, Rules};

/// Twice of what braking from 3 m/s takes with the margin: the drone need not know of more, and that there is nothing up to
/// a nearer horizon shows in more sectors.
const HORIZON_S: f64 = 3.0;
/// No flight is longer, seconds.
const SECONDS_MAX: f64 = 60.0;
/// What is further ahead than this is drawn as being nowhere, metres.
const FAR_M: f64 = 100.0;

/// What is flown, and how careful.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// The world and the drone.
    pub course: course::Settings,
    /// The consumer's.
    pub rules: Rules,
    /// As in `[flow]`.
    pub network: String,
    /// The flight ends after so long, or once the drone stands.
    pub seconds: f64,
}

/// One step of the loop, at the stamp of its frame.
#[derive(Debug, Clone, Copy)]
pub struct Step {
    /// Since the first frame.
    pub seconds: f64,
    /// To the first thing on the straight way, metres; negative behind it.
    pub left_m: Option<f64>,
    /// m/s.
    pub speed: f64,
    /// The least true time to contact in the sectors ahead.
    pub true_s: Option<f64>,
    /// What the node said of it.
    pub said_s: Option<f64>,
    /// Part of the sectors ahead that the node knows.
    pub known_part: f64,
    /// What the drone was told.
    pub command: Command,
}

/// The step at which something was decided, as a picture.
pub struct Still {
    /// Since the first frame.
    pub seconds: f64,
    /// Raw, developed, flow.
    pub picture: RgbImage,
    /// What the node said.
    pub sample: ObstaclesSample,
}

/// A flight.
pub struct Flown {
    /// Frame by frame, from the first pair on.
    pub steps: Vec<Step>,
    /// Of the first step at which the drone was told to stop.
    pub still: Option<Still>,
}

impl Flown {
    /// The speed and what was left before the thing at the end.
    pub fn end(&self) -> Option<(f64, Option<f64>)> {
        self.steps.last().map(|step| (step.speed, step.left_m))
    }

    /// The least speed of the flight, m/s.
    pub fn slowest(&self) -> f64 {
        self.steps.iter().map(|step| step.speed).fold(f64::INFINITY, f64::min)
    }
}

/// What of a step a picture is drawn from.
struct Kept {
    moved: Moved,
    vectors: Vec<f32>,
    confidence: Vec<f32>,
    sample: ObstaclesSample,
    seconds: f64,
}

impl Kept {
    fn draw(&self, pipeline: &Pipeline) -> Option<Still> {
        let Kept { moved, vectors, confidence, .. } = self;
        let flow = Flow { older: moved.older, newer: moved.newer, grid: moved.grid, vectors, confidence };
        let picture = pictures::draw(moved, &flow, pipeline.image()?);
        Some(Still { seconds: self.seconds, picture, sample: self.sample })
    }
}

/// Flies until the drone stands, has hit something, or the time is up. What the node says of a frame reaches the drone one
/// frame period later.
pub fn fly(settings: &Settings) -> Result<Flown, Box<dyn Error>> {
    let prefix = format!("nightflow_avoid/{}", std::process::id());
    let mut course = Course::new(settings.course.clone())?;
    let mut pipeline = Pipeline::open(&config(settings))?;
    let iceoryx2 = Iceoryx2 { prefix: prefix.clone(), ..Iceoryx2::default() };
    let mut shared = SharedSink::open(&publish::Config::default(), &iceoryx2)?;
    let consumer = Obstacles::open(&prefix)?;
    let mut brake = Brake::new(settings.rules);
    let period = 1.0 / settings.course.fps;
    let mut flown = Flown { steps: vec![], still: None };
    let (mut speed, mut command, mut decided) = (settings.course.speed, Command::Go, Command::Go);
    for frame in 0..(settings.seconds.min(SECONDS_MAX) / period) as usize {
        let shot = course.shot([brake.acceleration(command, speed, period), 0.0, 0.0]);
        let (truth, seconds) = (&shot.truth, frame as f64 * period);
        let mut moves = None;
        for sample in &shot.samples {
            if let Outcome::Moved(moved) = pipeline.step(sample, shared.lender(), &mut Untimed)? {
                let (vectors, confidence) = shared.lent();
                moves = Some((moved.clone(), vectors.to_vec(), confidence.to_vec()));
                shared.send(&moved)?;
            }
        }
        let sample = consumer.newest()?;
        speed = truth.velocity.iter().map(|v| v * v).sum::<f64>().sqrt();
        let arrives = Stamp(truth.stamp.ns() + (period * 1e9) as i64);
        let judged = brake.judge(sample.as_ref(), arrives, speed);
        (command, decided) = (decided, judged.command);
        let left_m = left(&settings.course, truth.position, seconds + period);
        flown.steps.push(Step {
            seconds,
            left_m,
            speed,
            true_s: (32..=40).filter_map(|k| truth.sectors[k]).min_by(f64::total_cmp),
            said_s: judged.nearest_s,
            known_part: judged.known_part,
            command: judged.command,
        });
        let over = speed < 1e-3 || left_m.is_some_and(|left| left <= 0.0);
        let stops = matches!(judged.command, Command::Stop(_));
        if let (Some((moved, vectors, confidence)), Some(sample)) = (moves, sample)
            && (stops || over)
            && flown.still.is_none()
        {
            flown.still = Kept { moved, vectors, confidence, sample, seconds }.draw(&pipeline);
        }
        if over {
            break;
        }
    }
    Ok(flown)
}

/// The node's settings: the camera looks forward, and obstacles are looked for.
fn config(settings: &Settings) -> Config {
    let mut config = Config::default();
    config.exposure.bit_depth = Some(12);
    config.exposure.black_level = Some(f32::from(course::BLACK));
    config.exposure.white_level = Some(f32::from(course::WHITE));
    config.flow.network.clone_from(&settings.network);
    config.motion.camera = Mount::Forward;
    config.motion.obstacles = Some(obstacles::Config { horizon_s: HORIZON_S, ..obstacles::Config::default() });
    config
}

/// From the drone to the first thing on its straight way.
fn left(settings: &course::Settings, position: [f64; 3], since_start: f64) -> Option<f64> {
    let things = settings.things.iter().filter(|thing| {
        (1..3).all(|axis| {
            let moved = thing.velocity[axis] * since_start;
            (thing.low[axis] + moved - 0.5..=thing.high[axis] + moved + 0.5).contains(&position[axis])
        })
    });
    let metres = things.map(|thing| thing.low[0] + thing.velocity[0] * since_start - position[0]);
    metres.filter(|left| *left < FAR_M).min_by(f64::total_cmp)
}
