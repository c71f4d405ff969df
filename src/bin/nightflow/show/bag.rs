//! A recording: its own results where it holds them, or else those of the network, beside its truth.

use std::{
    iter::Peekable,
    path::{Path, PathBuf},
    sync::atomic::Ordering,
    time::Duration,
};

use anyhow::{Context, Result, bail};
use image::{Rgb, RgbImage};
use nightflow::{
    camera::{self, Next, Sample, Source},
    clock::Stamp,
    config::Config,
    exposure::{Developer, Exposed},
    node::Outputs,
    pipeline::Pipeline,
    publish::{self, Offer, Sink, outgoing, paint},
    recording::{self, Output},
    wire::{self, EgoMotion, Image, Step},
};

use super::{Args, Row, Story, error_fact, plates::Plate, summed, truths::Truths};
use crate::launch;

/// Shows the recording's own results, or runs the network where it holds none.
pub fn look(args: &Args, bag: &Path) -> Result<Story> {
    let mut config = launch::settings(args.config.as_deref(), bag)?;
    let known = recording::metadata(bag, "nightflow")?.unwrap_or_default();
    config.camera.source = camera::SourceConfig::Mcap(camera::Mcap { path: bag.into(), realtime: false });
    config.recording.path = None;
    let mut album = Album::new(args, Truths::open(&first_file(bag)?)?);
    let recorded = recorded(bag, &config)?;
    let model = match recorded {
        Some(outputs) => {
            replayed(&config, outputs, &mut album)?;
            let model = known.get("model").cloned().unwrap_or_else(|| "an unnamed network".into());
            format!("{model}, as it was recorded")
        }
        None => run(&config, &mut album)?,
    };
    let mut story = album.story;
    if story.rows.is_empty() {
        bail!("{}: expected frames on {}, found no pair of them", bag.display(), config.camera.image_topic);
    }
    story.title = bag.display().to_string();
    let count = story.rows.len();
    let states = ["OK", "DEGRADED", "BLIND"].map(|state| {
        let of = |row: &&Row| row.state.as_ref().is_some_and(|known| known.split(':').next() == Some(state));
        format!("{} {state}", story.rows.iter().filter(of).count())
    });
    let seconds = story.rows.last().and_then(|row| row.seconds).unwrap_or(0.0);
    story.facts.push(("network".into(), model));
    story.facts.push(("steps".into(), format!("{count} in {seconds:.2} s: {}", states.join(", "))));
    story.facts.extend(known.get("made_by").map(|made| ("made by".into(), made.clone())));
    story.facts.extend(error_fact(&story.rows, "steps"));
    Ok(story)
}

/// The file itself, or the first of a folder.
fn first_file(bag: &Path) -> Result<PathBuf> {
    let files = camera::mcap::files(bag).with_context(|| bag.display().to_string())?;
    files.into_iter().next().with_context(|| format!("{}: expected an .mcap file in it, found none", bag.display()))
}

type Recorded = Peekable<recording::Outputs>;

/// The recorded results, if there are any with flow in them; a folder's files are run through the network.
fn recorded(bag: &Path, config: &Config) -> Result<Option<Recorded>> {
    if bag.is_dir() {
        return Ok(None);
    }
    let flow = |output: Output| output.topic.ends_with("/flow");
    let has_flow = recording::Outputs::open(bag, &config.publish.namespace)?.any(flow);
    Ok(has_flow.then(|| recording::Outputs::open(bag, &config.publish.namespace)).transpose()?.map(Iterator::peekable))
}

/// Develops the frames as they were developed then, and takes each step's results beside them.
fn replayed(config: &Config, mut outputs: Recorded, album: &mut Album) -> Result<()> {
    let mut developer = Developer::new(&config.exposure)?;
    let mut source = camera::open(&config.camera)?;
    let bar = launch::progress(true)?;
    while let Some(sample) = following(source.as_mut())? {
        bar.set_position((source.progress().unwrap_or(0.0) * 1000.0) as u64);
        let Sample::Frame(frame) = &sample else { continue };
        let stamp = frame.stamp();
        if developer.develop(frame).is_err() || developer.pair().is_none() {
            continue;
        }
        let mut found = Results::default();
        while let Some(output) = outputs.next_if(|output| output.stamp <= stamp) {
            if output.stamp == stamp {
                found.keep(&output)?;
            }
        }
        if let (Some(step), Some(flow), Some(image)) = (found.step, found.flow, developer.newest()) {
            let confidence = found.confidence.unwrap_or_default();
            album.take(&Shown { step: &step, ego: found.ego.as_ref(), flow: &flow, confidence: &confidence, image })?;
        }
    }
    bar.finish_and_clear();
    Ok(())
}

fn following(source: &mut dyn Source) -> Result<Option<Sample>> {
    loop {
        match source.next(Duration::from_millis(100)) {
            Ok(Next::Sample(sample)) => return Ok(Some(sample)),
            Ok(Next::Idle) => {}
            Ok(Next::End) => return Ok(None),
            Err(camera::Error::Torn { .. } | camera::Error::Wire(_)) => {}
            Err(fatal) => return Err(fatal.into()),
        }
    }
}

/// One step's recorded messages.
#[derive(Default)]
struct Results {
    step: Option<Step>,
    ego: Option<EgoMotion>,
    flow: Option<Vec<f32>>,
    confidence: Option<Vec<f32>>,
}

impl Results {
    fn keep(&mut self, output: &Output) -> Result<()> {
        let floats = |encoding: &str| -> Result<Vec<f32>> {
            let image: Image = wire::decode(&output.cdr)?;
            if image.encoding != encoding {
                bail!("{}: expected {encoding}, found {}", output.topic, image.encoding);
            }
            Ok(image.data.as_chunks::<4>().0.iter().map(|four| f32::from_le_bytes(*four)).collect())
        };
        match output.topic.rsplit('/').next() {
            Some("step") => self.step = Some(wire::decode(&output.cdr)?),
            Some("ego_motion") => self.ego = Some(wire::decode(&output.cdr)?),
            Some("flow") => self.flow = Some(floats("32FC2")?),
            Some("flow_confidence") => self.confidence = Some(floats("32FC1")?),
            _ => {}
        }
        Ok(())
    }
}

/// Runs the network over the recording; what it found goes into the album.
fn run(config: &Config, album: &mut Album) -> Result<String> {
    let mut pipeline = Pipeline::open(config)?;
    let model = pipeline.network().model();
    let model = format!("{} {}, run now (the recording holds no flow)", model.name, model.version);
    let stop = launch::stop()?;
    let mut outputs = Outputs::default();
    outputs.sinks.push(Box::new(&mut *album));
    launch::drive(config, Some(&mut pipeline), &mut outputs, &stop, true)?;
    drop(outputs);
    match album.failed.take() {
        Some(error) => Err(error),
        None if stop.load(Ordering::Relaxed) => bail!("interrupted"),
        None => Ok(model),
    }
}

/// One step, from wherever it came.
struct Shown<'a> {
    step: &'a Step,
    ego: Option<&'a EgoMotion>,
    flow: &'a [f32],
    confidence: &'a [f32],
    image: &'a Exposed,
}

/// Collects figures of all steps and pictures of some; when there are too many, every second one is let go.
struct Album {
    story: Story,
    truths: Truths,
    most: usize,
    every: usize,
    begin: Option<Stamp>,
    failed: Option<anyhow::Error>,
}

impl Album {
    fn new(args: &Args, truths: Truths) -> Album {
        Album { story: Story::default(), truths, most: args.most.max(1), every: 1, begin: None, failed: None }
    }

    fn take(&mut self, shown: &Shown<'_>) -> Result<()> {
        let Shown { step, ego, flow, image, .. } = shown;
        let (columns, rows) = (step.width as usize, step.height as usize);
        if flow.len() != 2 * columns * rows || columns * rows == 0 {
            bail!("step {}: expected flow of {columns}×{rows}, found {} values", step.step, flow.len());
        }
        let vectors: Vec<[f32; 2]> = flow.as_chunks::<2>().0.to_vec();
        let stamp: Stamp = step.header.stamp.into();
        let begin = *self.begin.get_or_insert(stamp);
        let truth = self.truths.at(stamp)?;
        let mut plate = Plate {
            name: format!("step_{:06}", step.step),
            grid: [columns, rows],
            flow: vectors,
            flow_title: "optical flow",
            confidence: (shown.confidence.len() == columns * rows).then(|| shown.confidence.to_vec()),
            truth: truth.on([columns, rows], [step.scale_x, step.scale_y]),
            ..Plate::default()
        };
        let state = match step.state {
            outgoing::OK => "OK".to_owned(),
            outgoing::DEGRADED => format!("DEGRADED: {}", step.cause),
            _ => format!("BLIND: {}", step.cause),
        };
        let metric = ego.filter(|ego| ego.scale == 0).map(|ego| ego.twist.twist.linear);
        let row = Row {
            name: plate.name.clone(),
            seconds: Some(stamp.seconds_since(begin)),
            state: Some(state),
            raw_mean: Some(step.raw_mean),
            confidence: Some(step.confidence),
            errors: summed(&plate.errors()),
            velocity: metric.map(|linear| [linear.x, linear.y, linear.z]),
            velocity_words: words(*ego, &step.velocity_lacks),
            true_velocity: truth.velocity,
        };
        let index = self.story.rows.len();
        if index.is_multiple_of(self.every) {
            self.describe(&mut plate, step, &row);
            plate.frames = vec![
                ("raw, as the eye would see it", screen(image, 1.0 / image.gain.max(1e-6))),
                ("scaled linearly", screen(image, 1.0)),
            ];
            self.story.plates.push(plate);
        }
        if self.story.plates.len() > self.most {
            self.every *= 2;
            let mut keep = [true, false].into_iter().cycle();
            self.story.plates.retain(|_| keep.next().unwrap_or(true));
        }
        self.story.rows.push(row);
        Ok(())
    }

    fn describe(&self, plate: &mut Plate, step: &Step, row: &Row) {
        let seconds = row.seconds.unwrap_or(0.0);
        plate.title = format!("step {}, {seconds:.3} s", step.step);
        let mut light = format!("raw mean {:.4} of white, gain {:.1}", step.raw_mean, step.gain);
        if plate.confidence.is_some() {
            light.push_str(&format!(", mean confidence {:.2}", step.confidence));
        }
        plate.lines.push(format!("state {}", row.state.as_deref().unwrap_or("unknown")));
        plate.lines.push(light);
        plate.lines.push(format!("velocity {}", row.velocity_words));
        if let Some([x, y, z]) = row.true_velocity {
            plate.lines.push(format!("true     forward {x:+.2} left {y:+.2} up {z:+.2} m/s"));
        }
        if let Some([mean, ninth]) = row.errors {
            plate.lines.push(format!("EPE {mean:.2} px, 90 % below {ninth:.2} px (camera pixels)"));
        }
    }
}

impl Sink for Album {
    fn name(&self) -> &'static str {
        "show"
    }

    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), publish::Error> {
        if self.failed.is_some() {
            return Ok(());
        }
        let step = outgoing::step(offer);
        let ego = outgoing::ego_motion(offer.moved, "base_link");
        let (flow, confidence) = (offer.flow.vectors, offer.flow.confidence);
        self.failed = self.take(&Shown { step: &step, ego: ego.as_ref(), flow, confidence, image: offer.image }).err();
        Ok(())
    }
}

/// The velocity, or what it lacks.
fn words(ego: Option<&EgoMotion>, lacks: &str) -> String {
    let Some(ego) = ego else { return format!("none: {lacks}") };
    let wire::Vector3 { x, y, z } = ego.twist.twist.linear;
    let unit = if ego.scale == 0 { "m/s" } else { "1/s (per distance)" };
    format!("forward {x:+.2} left {y:+.2} up {z:+.2} {unit}")
}

fn screen(image: &Exposed, times: f32) -> RgbImage {
    RgbImage::from_fn(image.width as u32, image.height as u32, |x, y| {
        Rgb(paint::display(image, x as usize, y as usize, times))
    })
}
