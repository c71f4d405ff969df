//! What the stages before the odometer make of a flight, kept in files so that a change of the fit needs no new flow.

use std::{
    fs,
    io::{Read, Write},
    path::Path,
};

use nightflow::{
    clock::Stamp,
    config::Config,
    darkness::{
        flight::{self, TrueFlow},
        ladder::MEANS,
        noise::Noise,
    },
    exposure::Developer,
    flow::{Flow, Gradients, Grid, Keyframe, Matcher, Own, State},
    motion::Keeping,
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::{
    flights::{Flown, Plan, Sensors, fly},
    opencv::{METHODS, OpenCv},
    tables,
};

/// Stamps of one flight at one exposure lie this far from those of the next, so that no features are taken for others'.
const APART_NS: i64 = 100_000_000_000;

/// The flow of one step.
#[derive(Debug, Clone, Default)]
pub struct Step {
    /// Whether the node would say that it sees nothing.
    pub blind: bool,
    /// Deviation of the noise in the developed image at a mean of 0.4, in 1/255; NaN where it is not known.
    pub noise_level: f32,
    /// Where the vectors stand.
    pub grid: Grid,
    /// As in [`Flow`].
    pub vectors: Vec<f32>,
    /// As in [`Flow`].
    pub confidence: Vec<f32>,
    /// The five planes of [`Gradients`], one after the other; empty where there are none.
    pub gradients: Vec<f32>,
    /// What a frame that was kept shows of it.
    pub back: Option<Back>,
}

/// Flow from a frame that was kept to the newer frame of a step, on the step's raster.
#[derive(Debug, Clone, Default)]
pub struct Back {
    /// The kept frame's number.
    pub kept: usize,
    /// Vectors, confidence and the planes of gradients.
    pub planes: Vec<f32>,
}

impl Back {
    /// As the odometer takes it.
    pub fn read(&self, grid: Grid, older: Stamp, newer: Stamp) -> Option<(Flow<'_>, Gradients<'_>)> {
        let (vectors, rest) = self.planes.split_at_checked(2 * grid.cells())?;
        let mut planes = rest.chunks_exact(grid.cells());
        let mut next = || planes.next();
        let flow = Flow { older, newer, grid, vectors, confidence: next()? };
        Some((flow, Gradients { information: [next()?, next()?, next()?], pull: [next()?, next()?] }))
    }
}

impl Step {
    /// The step as the odometer takes it.
    pub fn flow(&self, older: Stamp, newer: Stamp) -> Flow<'_> {
        Flow { older, newer, grid: self.grid, vectors: &self.vectors, confidence: &self.confidence }
    }

    /// What the frames' gradients say of it.
    pub fn gradients(&self) -> Option<Gradients<'_>> {
        let mut planes = self.gradients.chunks_exact(self.grid.cells().max(1));
        let mut next = || planes.next();
        Some(Gradients { information: [next()?, next()?, next()?], pull: [next()?, next()?] })
    }
}

/// The method that knows the truth.
pub const TRUTH: &str = "truth";

impl Step {
    /// The truth, sure wherever it is known.
    fn of(flow: &TrueFlow) -> Step {
        let known = |vector: &[f32; 2]| f32::from(u8::from(vector.iter().all(|along| along.is_finite())));
        Step {
            blind: false,
            noise_level: f32::NAN,
            grid: flow.grid,
            confidence: flow.vectors.as_chunks::<2>().0.iter().map(known).collect(),
            vectors: flow.vectors.clone(),
            gradients: vec![],
            back: None,
        }
    }
}

/// A flight as a network saw it: steps by exposure.
pub type Seen = [Vec<Step>; MEANS.len()];

#[derive(Serialize, Deserialize)]
struct Kept {
    width: usize,
    height: usize,
    scale: [f32; 2],
    /// Whether gradients are kept.
    gradients: bool,
    /// Blindness and noise level, exposure by exposure.
    steps: Vec<Vec<(bool, Option<f32>)>>,
}

/// Behind a network's name: its vectors go through `[flow] refine`, or don't, whatever the default is.
const REFINING: [(&str, bool); 2] = [("+refine", true), ("-refine", false)];

/// Settings of the node for the flights' camera.
pub fn settings(method: &str) -> Config {
    let mut config = Config::default();
    config.exposure.bit_depth = Some(12);
    config.exposure.black_level = Some(f32::from(flight::BLACK));
    config.exposure.white_level = Some(f32::from(flight::WHITE));
    let refining = REFINING.into_iter().find_map(|(end, on)| Some((method.strip_suffix(end)?, on)));
    let (network, refine) = refining.unwrap_or((method, config.flow.refine));
    config.flow.network = network.into();
    config.flow.refine = refine && !METHODS.contains(&network);
    config.flow.threads = 1;
    config
}

/// A flight whose frames are drawn or read when they are asked for.
pub struct Taken<'a> {
    /// All but the frames.
    pub sensors: Sensors,
    frames: Option<Flown>,
    cache: Option<&'a Path>,
}

impl<'a> Taken<'a> {
    /// Flies, or reads what was flown before.
    pub fn new(plan: Plan, cache: Option<&'a Path>) -> Result<Self, String> {
        let path = cache.map(|folder| folder.join(format!("sensors_{:05}", plan.number)));
        if let Some((sensors, _)) = path.as_deref().and_then(read::<Sensors>)
            && sensors.plan == plan
        {
            return Ok(Self { sensors, frames: None, cache });
        }
        let flown = fly(plan)?;
        if let Some(folder) = cache {
            let bytes: Vec<u8> = flown.frames.iter().flatten().flat_map(|count| count.to_le_bytes()).collect();
            write(&folder.join(format!("clean_{:05}", plan.number)), &(), &bytes)?;
            write(&folder.join(format!("sensors_{:05}", plan.number)), &flown.sensors, &[])?;
        }
        Ok(Self { sensors: flown.sensors.clone(), frames: Some(flown), cache })
    }

    /// The true flow at every exposure; what velocity then lacks is not the flow's.
    fn truly(&mut self) -> Result<Seen, String> {
        if self.flown()?.flows.is_empty() {
            self.frames = Some(fly(self.sensors.plan)?);
        }
        let steps: Vec<Step> = self.flown()?.flows.iter().map(Step::of).collect();
        Ok(std::array::from_fn(|_| steps.clone()))
    }

    fn flown(&mut self) -> Result<&Flown, String> {
        let Self { sensors, frames, cache } = self;
        if frames.is_none() {
            let path = cache.map(|folder| folder.join(format!("clean_{:05}", sensors.plan.number)));
            *frames = Some(match path.as_deref().and_then(read::<()>) {
                Some(((), bytes)) => {
                    let counts: Vec<u16> =
                        bytes.as_chunks::<2>().0.iter().map(|two| u16::from_le_bytes(*two)).collect();
                    let frames = counts.chunks(sensors.plan.size[0] * sensors.plan.size[1]).map(<[u16]>::to_vec);
                    Flown { sensors: sensors.clone(), frames: frames.collect(), flows: vec![] }
                }
                None => fly(sensors.plan)?,
            });
        }
        frames.as_ref().ok_or_else(|| "no frames".to_owned())
    }

    /// What the method sees of the flight at every exposure; the matcher is opened when it is needed.
    pub fn seen_by(&mut self, name: &str, matcher: &mut Option<Matcher>, camera: &Noise) -> Result<Seen, String> {
        let plan = self.sensors.plan;
        let path = self.cache.map(|folder| folder.join(format!("{name}_{:05}", plan.number)));
        if let Some((kept, bytes)) = path.as_deref().and_then(read::<Kept>)
            && kept.steps.iter().all(|steps| steps.len() == plan.steps)
        {
            return Ok(unpack(&kept, &bytes));
        }
        if name == TRUTH {
            let seen = self.truly()?;
            if let Some(path) = path {
                let (kept, bytes) = pack(&seen);
                write(&path, &kept, &bytes)?;
            }
            return Ok(seen);
        }
        let config = settings(name);
        let matcher = match matcher {
            Some(matcher) => matcher,
            None => matcher.insert(match METHODS.contains(&name) {
                true => Matcher::with(&config.flow, Box::new(OpenCv::open(name)?)),
                false => Matcher::open(&config.flow).map_err(|error| error.to_string())?,
            }),
        };
        let flown = self.flown()?;
        let mut seen = Seen::default();
        for (rung, steps) in seen.iter_mut().enumerate() {
            *steps = look(flown, rung, &config, matcher, camera)?;
        }
        if let Some(path) = path {
            let (kept, bytes) = pack(&seen);
            write(&path, &kept, &bytes)?;
        }
        Ok(seen)
    }
}

fn look(
    flown: &Flown,
    rung: usize,
    config: &Config,
    matcher: &mut Matcher,
    camera: &Noise,
) -> Result<Vec<Step>, String> {
    let mut developer = Developer::new(&config.exposure).map_err(|error| error.to_string())?;
    let (mut own, mut steps) = (Own::default(), vec![]);
    let shift = (flown.sensors.plan.number as i64 * MEANS.len() as i64 + rung as i64) * APART_NS;
    for (index, moment) in flown.sensors.truth.iter().enumerate() {
        let frame = flown.photograph(index, rung, camera, Stamp(moment.stamp.ns() + shift));
        developer.develop(&frame).map_err(|error| error.to_string())?;
        let Some(pair) = developer.pair() else { continue };
        let flow = matcher.between(&pair, &mut own).map_err(|error| error.to_string())?;
        let (state, _) = matcher.judge(&pair, &flow);
        let gradients =
            matcher.gradients().map_or(vec![], |said| [said.information.concat(), said.pull.concat()].concat());
        steps.push(Step {
            blind: matches!(state, State::Blind(_)),
            noise_level: pair.newer.noise_level.unwrap_or(f32::NAN),
            grid: flow.grid,
            vectors: flow.vectors.to_vec(),
            confidence: flow.confidence.to_vec(),
            gradients,
            back: None,
        });
    }
    Ok(steps)
}

/// Frames that were kept: (exposure, step, kept frame) of each comparison.
type Backs = Vec<[usize; 3]>;

impl Taken<'_> {
    /// What frames that are kept show, as the node with default settings keeps them, beside what was seen between all frames.
    pub fn look_back(&mut self, name: &str, camera: &Noise, seen: &mut Seen) -> Result<(), String> {
        let path = self.cache.map(|folder| folder.join(format!("{name}_back_{:05}", self.sensors.plan.number)));
        let size = 8 * seen[0].first().map_or(1, |step| step.grid.cells());
        if let Some((kept, bytes)) = path.as_deref().and_then(read::<Backs>) {
            let values: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|four| f32::from_le_bytes(*four)).collect();
            for ([rung, step, kept], planes) in kept.into_iter().zip(values.chunks_exact(size)) {
                seen[rung][step].back = Some(Back { kept, planes: planes.to_vec() });
            }
            return Ok(());
        }
        let config = settings(name);
        let sensors = self.sensors.clone();
        let flown = self.flown()?;
        for (rung, steps) in seen.iter_mut().enumerate() {
            let mut developer = Developer::new(&config.exposure).map_err(|error| error.to_string())?;
            let (mut backs, mut key) = (vec![], Keyframe::default());
            let mut develop = |index: usize, stamp: Stamp| {
                let frame = flown.photograph(index, rung, camera, stamp);
                developer.develop(&frame).map_err(|error| error.to_string())?;
                developer.newest().cloned().ok_or_else(|| "no frame".to_owned())
            };
            develop(0, Stamp(0))?;
            let mut kept = 0;
            tables::follow(&sensors, steps, &config.motion, |at, odometer, keeping| {
                let newer = develop(at.step + 1, at.newer)?;
                match keeping {
                    Keeping::Keep => {
                        key.keep(&newer);
                        kept = at.step + 1;
                    }
                    Keeping::Compare => {
                        let expect = &mut |grid: &Grid, vectors: &mut Vec<f32>| odometer.expect(grid, at.size, vectors);
                        if let Some((flow, said)) = key.flow(&newer, expect) {
                            let planes =
                                [flow.vectors, flow.confidence, &said.information.concat(), &said.pull.concat()]
                                    .concat();
                            odometer.look_back(&flow, &said, at.size);
                            backs.push((at.step, Back { kept, planes }));
                        } else {
                            odometer.let_go();
                        }
                    }
                    Keeping::Wait => {}
                }
                Ok(())
            })?;
            for (step, back) in backs {
                steps[step].back = Some(back);
            }
        }
        if let Some(path) = path {
            let all = |(rung, steps): (usize, &Vec<Step>)| -> Vec<([usize; 3], Vec<f32>)> {
                let some =
                    |(step, seen): (usize, &Step)| seen.back.clone().map(|back| ([rung, step, back.kept], back.planes));
                steps.iter().enumerate().filter_map(some).collect()
            };
            let (kept, planes): (Backs, Vec<Vec<f32>>) = seen.iter().enumerate().flat_map(all).unzip();
            write(&path, &kept, &planes.iter().flatten().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>())?;
        }
        Ok(())
    }
}

fn pack(seen: &Seen) -> (Kept, Vec<u8>) {
    let grid = seen[0].first().map_or(Grid::default(), |step| step.grid);
    let known = |level: f32| level.is_finite().then_some(level);
    let of = |steps: &Vec<Step>| steps.iter().map(|step| (step.blind, known(step.noise_level))).collect();
    let gradients = seen[0].first().is_some_and(|step| !step.gradients.is_empty());
    let (width, height, scale) = (grid.width, grid.height, grid.scale);
    let kept = Kept { width, height, scale, gradients, steps: seen.iter().map(of).collect() };
    let values =
        seen.iter().flatten().flat_map(|step| step.vectors.iter().chain(&step.confidence).chain(&step.gradients));
    (kept, values.flat_map(|value| value.to_le_bytes()).collect())
}

fn unpack(kept: &Kept, bytes: &[u8]) -> Seen {
    let grid = Grid { width: kept.width, height: kept.height, scale: kept.scale };
    let values: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|four| f32::from_le_bytes(*four)).collect();
    let mut rest = values.chunks_exact(if kept.gradients { 8 } else { 3 } * grid.cells());
    std::array::from_fn(|rung| {
        let step = |(blind, level): &(bool, Option<f32>)| {
            let step = rest.next().unwrap_or_default();
            let (vectors, others) = step.split_at((2 * grid.cells()).min(step.len()));
            let (confidence, gradients) = others.split_at(grid.cells().min(others.len()));
            Step {
                blind: *blind,
                noise_level: level.unwrap_or(f32::NAN),
                grid,
                vectors: vectors.to_vec(),
                confidence: confidence.to_vec(),
                gradients: gradients.to_vec(),
                back: None,
            }
        };
        kept.steps[rung].iter().map(step).collect()
    })
}

/// A head in JSON with its length before it, then bytes; `None` where there is no such file.
fn read<H: DeserializeOwned>(path: &Path) -> Option<(H, Vec<u8>)> {
    let mut file = fs::File::open(path).ok()?;
    let mut length = [0; 8];
    file.read_exact(&mut length).ok()?;
    let mut head = vec![0; u64::from_le_bytes(length) as usize];
    file.read_exact(&mut head).ok()?;
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).ok()?;
    Some((serde_json::from_slice(&head).ok()?, bytes))
}

/// Written beside its place and moved there whole, so that a run that is cut off leaves nothing torn.
fn write<H: Serialize>(path: &Path, head: &H, bytes: &[u8]) -> Result<(), String> {
    let head = serde_json::to_vec(head).map_err(|error| error.to_string())?;
    let beside = path.with_extension("part");
    let whole = || -> std::io::Result<()> {
        let mut file = fs::File::create(&beside)?;
        file.write_all(&(head.len() as u64).to_le_bytes())?;
        file.write_all(&head)?;
        file.write_all(bytes)?;
        fs::rename(&beside, path)
    };
    whole().map_err(|error| format!("{}: {error}", path.display()))
}
