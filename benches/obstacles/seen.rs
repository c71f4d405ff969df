//! Courses as they are flown, photographed at a rung of the ladder, and what the node's stages make of them.

use std::sync::Arc;

use nightflow::{
    camera::{Frame, Sample},
    config::Config,
    darkness::{
        course::{BLACK, Course, Settings, Thing, Truth, WHITE},
        ladder::MEANS,
        noise::{Noise, Normals},
    },
    exposure::Developer,
    flow::{self, Matcher, Own, State},
    motion::{Lack, Lookout, Mount, Odometer, obstacles},
};

use super::{
    opencv::{METHODS, OpenCv},
    score::Row,
};

/// What the drone flies at.
pub const COURSES: [&str; 5] = ["wall", "poles", "wire", "rods", "moving"];
/// Mean of the clean frames, from which the ladder's are made: no highlight is lost.
const CLEAN: f64 = 0.1;
/// No obstacle for the whole flight.
const BACKDROP_M: f64 = 80.0;
/// The filter, the heading and the camera's noise need some frames.
const WARM_UP: usize = 4;

/// One flight.
#[derive(Debug, Clone)]
pub struct Plan {
    pub seed: u64,
    pub course: String,
    pub frames: usize,
    pub size: [usize; 2],
}

/// A flight with its clean frames.
pub struct Flown {
    plan: Plan,
    shots: Vec<(Vec<Sample>, Arc<Frame>, Truth)>,
}

/// Flies and draws the clean frames.
pub fn fly(plan: &Plan) -> Result<Flown, String> {
    let mut draws = Normals::new(plan.seed, 0x0b57);
    let mut within = |from: f64, to: f64| from + (to - from) * draws.uniform();
    let mut things: Vec<Thing> = match plan.course.as_str() {
        "wall" => vec![Thing::wall(within(13.5, 15.5))],
        "poles" => (0..3)
            .map(|k| Thing::pole(within(12.0, 16.0), (f64::from(k) - 1.0) * 3.0 + within(-1.0, 1.0), within(0.25, 0.6)))
            .collect(),
        "wire" => vec![Thing::wire(within(13.0, 15.0), within(3.8, 4.3), within(0.02, 0.04))],
        "rods" => (0..3)
            .map(|k| {
                Thing::pole(within(12.0, 16.0), (f64::from(k) - 1.0) * 2.5 + within(-1.0, 1.0), within(0.02, 0.04))
            })
            .collect(),
        _ => vec![
            Thing::pole(within(15.0, 17.0), within(-5.0, -4.0), 0.8).moving([0.0, within(0.7, 1.1), 0.0]),
            Thing::pole(within(18.0, 20.0), within(1.5, 2.5), 1.0).moving([within(-1.5, -1.0), 0.0, 0.0]),
        ],
    };
    if plan.course != "wall" {
        // Houses far behind: what is open shows something, or nothing there could ever be called free.
        things.push(Thing::wall(BACKDROP_M));
    }
    let settings =
        Settings { seed: plan.seed, size: plan.size, mean: CLEAN, noise: None, things, ..Settings::default() };
    let mut course = Course::new(settings).map_err(|error| error.to_string())?;
    let mut shots = Vec::with_capacity(plan.frames);
    for _ in 0..plan.frames {
        let mut shot = course.shot([0.0; 3]);
        let Some(Sample::Frame(frame)) = shot.samples.pop() else { return Err("a shot ends with its frame".into()) };
        shots.push((shot.samples, frame, shot.truth));
    }
    Ok(Flown { plan: plan.clone(), shots })
}

impl Flown {
    /// The frame as the camera takes it at a rung of the ladder: photons counted, read, 12 bits.
    fn photograph(&self, index: usize, rung: usize, camera: &Noise) -> Frame {
        let clean = &self.shots[index].1;
        let (columns, span) = (self.plan.size[0], f64::from(WHITE - BLACK));
        let factor = MEANS[rung] / CLEAN;
        let mut frame = Frame { image: clean.image.clone(), received: clean.received };
        for (row, bytes) in frame.image.data.chunks_exact_mut(2 * columns).enumerate() {
            let mut draws = Normals::new(self.plan.seed ^ 0x0b57, ((index * 7 + rung) << 16 | row) as u64);
            for (column, two) in bytes.as_chunks_mut::<2>().0.iter_mut().enumerate() {
                let light = (f64::from(u16::from_le_bytes(*two)) - f64::from(BLACK)) / span * factor;
                let value = camera.counted(row % 2 + column % 2, light.clamp(0.0, 1.0), &mut draws);
                let count = (f64::from(BLACK) + value * span).round().clamp(0.0, f64::from(WHITE));
                *two = (count as u16).to_le_bytes();
            }
        }
        frame
    }
}

/// Settings of the node for the course's camera; `flow` holds those of `[flow]` that differ.
fn settings(network: &str, flow: &flow::Config) -> Config {
    let mut config = Config { flow: flow.clone(), ..Config::default() };
    // Rivals are judged as they are.
    config.flow.refine &= !METHODS.contains(&network);
    config.exposure.bit_depth = Some(12);
    config.exposure.black_level = Some(f32::from(BLACK));
    config.exposure.white_level = Some(f32::from(WHITE));
    config.flow.network = network.into();
    config.flow.threads = 1;
    config.motion.camera = Mount::Forward;
    config
}

/// A network of ours, or OpenCV's flow.
pub fn matcher(name: &str, flow: &flow::Config) -> Result<Matcher, String> {
    let config = settings(name, flow);
    match METHODS.contains(&name) {
        true => Ok(Matcher::with(&config.flow, Box::new(OpenCv::open(name)?))),
        false => Matcher::open(&config.flow).map_err(|error| error.to_string()),
    }
}

/// One flight at one exposure: each variant of the settings on the same flow.
pub fn look(
    flown: &Flown,
    rung: usize,
    method: usize,
    name: &str,
    matcher: &mut Matcher,
    camera: &Noise,
    variants: &[obstacles::Config],
) -> Result<Vec<Row>, String> {
    let say = |error: &dyn std::fmt::Display| error.to_string();
    let config = settings(name, &flow::Config::default());
    let mut developer = Developer::new(&config.exposure).map_err(|error| say(&error))?;
    let mut odometer = Odometer::new(&config.motion).map_err(|error| say(&error))?;
    let lookouts = variants.iter().map(Lookout::new).collect::<Result<Vec<_>, _>>();
    let mut lookouts = lookouts.map_err(|error| say(&error))?;
    let (mut own, mut rows) = (Own::default(), vec![]);
    for (index, (samples, _, truth)) in flown.shots.iter().enumerate() {
        for sample in samples {
            match sample {
                Sample::Imu(imu) => odometer.imu(imu).map_err(|error| say(&error))?,
                Sample::Range(range) => odometer.range(range).map_err(|error| say(&error))?,
                Sample::Info(info) => odometer.info(info).map_err(|error| say(&error))?,
                Sample::Frame(_) | Sample::Transforms(_) | Sample::Width(_) => {}
            }
        }
        developer.develop(&flown.photograph(index, rung, camera)).map_err(|error| say(&error))?;
        let Some(pair) = developer.pair() else { continue };
        let flow = matcher.between(&pair, &mut own).map_err(|error| say(&error))?;
        let (state, _) = matcher.judge(&pair, &flow);
        let blind = matches!(state, State::Blind(_));
        let size = flown.plan.size.map(|side| side as u32);
        let velocity = if blind { Err(Lack::Blind) } else { odometer.velocity_with(&flow, matcher.gradients(), size) };
        for (variant, lookout) in lookouts.iter_mut().enumerate() {
            let found = if blind { None } else { lookout.look(&odometer, &flow, size, pair.older, &velocity).ok() };
            if index >= WARM_UP || flown.plan.frames <= WARM_UP {
                let by = (flown.plan.seed, method, variant);
                rows.extend(Row::of(&flown.plan.course, by, rung, index, truth, found.as_ref()));
            }
        }
    }
    Ok(rows)
}
