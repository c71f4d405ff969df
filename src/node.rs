//! The loop: source, step, sinks; with stop, counters and the status once a second.

mod governor;

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use crate::{
    camera::{self, Counts, Next, Sample, Source},
    clock::{self, Laps, Reservoir, Stage, Stopwatch},
    exposure::Noise,
    flow::{Flow, Lender, Own, State},
    motion::{Diagnosis, NoSight, Scale, Sector},
    pipeline::{Outcome, Pipeline},
    publish::{self, Moved, Offer, Sink, iceoryx2::SharedSink},
    wire,
};
pub use governor::{Governor, Narrowed, Taken};

/// How long the loop waits for a sample before it looks at the stop flag again.
const WAIT: Duration = Duration::from_millis(50);
/// How often the status goes out.
const STATUS: Duration = Duration::from_secs(1);
/// The first and the longest pause before a lost source is opened again.
const BACK_OFF: [Duration; 2] = [Duration::from_millis(200), Duration::from_secs(5)];

/// Why the node ends before its time.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The source can't be opened, or can't go on.
    #[error(transparent)]
    Camera(#[from] camera::Error),
    /// A sink could not write out what it kept.
    #[error(transparent)]
    Publish(#[from] publish::Error),
}

/// Where results go: shared memory lends the network its memory, all others look at it.
#[derive(Default)]
pub struct Outputs<'a> {
    /// Shared memory, if it is open.
    pub shared: Option<SharedSink>,
    /// All other sinks.
    pub sinks: Vec<Box<dyn Sink + 'a>>,
    own: Own,
}

impl Outputs<'_> {
    fn lender(&mut self) -> &mut dyn Lender {
        match &mut self.shared {
            Some(shared) => shared,
            None => &mut self.own,
        }
    }

    fn sample(&mut self, sample: &Sample) {
        for sink in &mut self.sinks {
            said(sink.sample(sample));
        }
    }

    /// Every sink looks at the lent memory first, because sending it gives it away.
    fn offer(&mut self, moved: &Moved, pipeline: &Pipeline) {
        let (vectors, confidence) = match &self.shared {
            Some(shared) => shared.lent(),
            None => self.own.lent(),
        };
        let flow = Flow { older: moved.older, newer: moved.newer, grid: moved.grid, vectors, confidence };
        if let Some(image) = pipeline.image() {
            let offer = Offer { moved, flow, image };
            for sink in &mut self.sinks {
                said(sink.offer(&offer));
            }
        }
        if let Some(shared) = &mut self.shared {
            said(shared.send(moved));
        }
    }

    fn status(&mut self, status: &wire::Status) {
        for sink in &mut self.sinks {
            said(sink.status(status));
        }
        if let Some(shared) = &mut self.shared {
            said(shared.status(status));
        }
    }

    /// Writes out everything, and gives the first failure after all have had their turn.
    pub fn finish(&mut self) -> Result<(), publish::Error> {
        self.sinks.iter_mut().map(|sink| sink.finish()).fold(Ok(()), Result::and)
    }

    /// What each sink could not take.
    pub fn lost(&self) -> BTreeMap<&'static str, u64> {
        let shared = self.shared.as_ref().map(|shared| ("iceoryx2", shared.lost()));
        self.sinks.iter().map(|sink| (sink.name(), sink.lost())).chain(shared).collect()
    }
}

/// A loss is counted by its sink and said here, once each.
fn said(result: Result<(), publish::Error>) {
    if let Err(error) = result {
        tracing::warn!(target: "nightflow::publish", "{error}");
    }
}

/// What a run counted.
#[derive(Default)]
pub struct Report {
    /// Frames that reached the pipeline.
    pub frames: u64,
    /// Pairs that gave flow.
    pub steps: u64,
    /// Frames without a partner.
    pub unpaired: u64,
    /// Samples refused, by cause, with the newest message.
    pub spoiled: BTreeMap<&'static str, (u64, String)>,
    /// Steps by state: ok, degraded, blind.
    pub states: [u64; 3],
    /// Steps without velocity, by what they lacked.
    pub lacks: BTreeMap<String, u64>,
    /// What the source counted.
    pub source: Counts,
    /// What sinks could not take.
    pub lost: BTreeMap<&'static str, u64>,
    /// How long each stage took.
    pub watch: Stopwatch,
    /// How long whole steps took, ms.
    pub step_ms: Reservoir,
    /// From a frame's stamp to its flow's leaving, ms.
    pub latency_ms: Reservoir,
    /// Metric speeds, m/s.
    pub speeds: Reservoir,
    /// Steps that looked for obstacles, those that saw one in the way, and steps that could not look.
    pub sights: [u64; 3],
    /// The least time to contact of all steps, s.
    pub nearest_s: Option<f64>,
    /// State of the newest step.
    pub state: State,
    /// What camera and gyro disagree on.
    pub diagnosis: Option<Diagnosis>,
    /// Images are narrower than the settings want, to keep the camera's rate.
    pub narrowed: Option<Narrowed>,
    /// Of the newest step: the camera's noise, the raw mean, and the noise level in the network's image.
    pub noise: Option<(Noise, f32, f32)>,
}

impl Report {
    /// Samples refused.
    pub fn spoiled_count(&self) -> u64 {
        self.spoiled.values().map(|(count, _)| count).sum()
    }

    /// Whether anything that came in or went out was lost: refused, torn, or not taken by a sink.
    pub fn lost_anything(&self) -> bool {
        self.spoiled_count() + self.source.torn + self.source.overrun + self.lost.values().sum::<u64>() > 0
    }

    fn spoil(&mut self, cause: &'static str, error: &dyn std::fmt::Display) {
        let entry = self.spoiled.entry(cause).or_default();
        entry.0 += 1;
        entry.1 = error.to_string();
        tracing::warn!(target: "nightflow::pipeline", "{error}");
    }

    fn moved(&mut self, moved: &Moved) {
        self.steps += 1;
        self.states[match moved.state {
            State::Ok => 0,
            State::Degraded(_) => 1,
            State::Blind(_) => 2,
        }] += 1;
        match &moved.velocity {
            Ok(velocity) if matches!(velocity.scale, Scale::Metric { .. }) => {
                self.speeds.keep(velocity.linear.iter().map(|v| v * v).sum::<f64>().sqrt());
            }
            Ok(_) => *self.lacks.entry("a range: velocity is per distance".into()).or_default() += 1,
            Err(lack) => *self.lacks.entry(lack.kind().into()).or_default() += 1,
        }
        self.looked(moved);
        self.state = moved.state.clone();
        self.noise = moved.noise.map(|noise| (noise, moved.raw_mean, moved.noise_level.unwrap_or(f32::NAN)));
    }

    fn looked(&mut self, moved: &Moved) {
        let found = match &moved.obstacles {
            Err(NoSight::Off) => return,
            Err(_) => return self.sights[2] += 1,
            Ok(found) => found,
        };
        self.sights[0] += 1;
        let times = found.sectors.iter().filter_map(|sector| match sector {
            Sector::Occupied { ttc_s, .. } => Some(*ttc_s),
            _ => None,
        });
        if let Some(nearest) = times.min_by(f64::total_cmp) {
            self.sights[1] += 1;
            self.nearest_s = Some(self.nearest_s.map_or(nearest, |least| least.min(nearest)));
        }
    }

    fn status(&self, since: &Cadence) -> wire::Status {
        let idle = since.last_frame.elapsed();
        let (state, cause) = match &self.state {
            _ if idle > since.silence => (3, format!("no frame for {:.1} s", idle.as_secs_f64())),
            State::Ok => (0, String::new()),
            State::Degraded(cause) => (1, cause.to_string()),
            State::Blind(cause) => (2, cause.to_string()),
        };
        let said = [self.diagnosis.as_ref().map(ToString::to_string), self.narrowed.as_ref().map(ToString::to_string)];
        let (state, cause) = said.into_iter().flatten().fold((state, cause), |(state, cause), more| {
            if cause.is_empty() { (state.max(1), more) } else { (state, format!("{cause}; {more}")) }
        });
        let [noise_a, noise_b, snr_db, noise_level] = self.noise.map_or([f32::NAN; 4], |(noise, mean, level)| {
            [noise.a as f32, noise.b as f32, noise.snr_db(mean.into()) as f32, level]
        });
        let median = |series: &Reservoir| series.quantiles([0.5]).map_or(f32::NAN, |[ms]| ms as f32);
        wire::Status {
            header: wire::Header { stamp: clock::now().into(), frame_id: String::new() },
            state,
            cause,
            frames: self.frames,
            displaced: self.source.displaced,
            steps: self.steps,
            spoiled: self.spoiled_count() + self.source.torn,
            unpaired: self.unpaired,
            lost: self.lost.values().sum(),
            last_error: self.spoiled.values().map(|(_, text)| text.clone()).next_back().unwrap_or_default(),
            rate: (self.steps - since.steps) as f32 / since.last.elapsed().as_secs_f32().max(1e-3),
            latency_ms: median(&self.latency_ms),
            step_ms: median(&self.step_ms),
            noise_a,
            noise_b,
            snr_db,
            noise_level,
        }
    }
}

/// When the last status went out, and what had been counted then.
struct Cadence {
    last: Instant,
    last_frame: Instant,
    steps: u64,
    silence: Duration,
}

impl Cadence {
    fn saw(&mut self, sample: &Sample, report: &mut Report) {
        if matches!(sample, Sample::Frame(_)) {
            report.frames += 1;
            self.last_frame = clock::instant();
        }
    }
}

/// A source that is opened again when it is lost.
struct Reopening<'a> {
    open: &'a mut dyn FnMut() -> Result<Box<dyn Source>, camera::Error>,
    source: Option<Box<dyn Source>>,
    pause: Duration,
    before: Counts,
}

impl Reopening<'_> {
    /// The next sample; a lost source is one warning and a growing pause, then another try.
    fn next(&mut self, stop: &AtomicBool) -> Result<Next, camera::Error> {
        let source = match &mut self.source {
            Some(source) => source,
            None => self.source.insert((self.open)()?),
        };
        match source.next(WAIT) {
            Err(error @ camera::Error::Lost { .. }) => {
                tracing::warn!(target: "nightflow::camera", "{error}; trying again in {:?}", self.pause);
                self.before = self.counts();
                self.source = None;
                let until = clock::instant() + self.pause;
                while clock::instant() < until && !stop.load(Ordering::Relaxed) {
                    std::thread::sleep(WAIT);
                }
                self.pause = (self.pause * 2).min(BACK_OFF[1]);
                Ok(Next::Idle)
            }
            Ok(Next::Sample(sample)) => {
                self.pause = BACK_OFF[0];
                Ok(Next::Sample(sample))
            }
            other => other,
        }
    }

    fn counts(&self) -> Counts {
        let now = self.source.as_ref().map(|source| source.counts()).unwrap_or_default();
        Counts {
            arrived: self.before.arrived + now.arrived,
            displaced: self.before.displaced + now.displaced,
            missed: self.before.missed + now.missed,
            torn: self.before.torn + now.torn,
            overrun: self.before.overrun + now.overrun,
        }
    }
}

/// Runs until the source ends or `stop` is set, then writes everything out. `look` sees the report after every sample,
/// with the progress through a finite source. Without a pipeline the samples are only kept. A governor, where there is one,
/// may narrow the images; what it decides is a sample like any other, so that it is recorded and replayed.
pub fn drive(
    open: &mut dyn FnMut() -> Result<Box<dyn Source>, camera::Error>,
    mut pipeline: Option<&mut Pipeline>,
    outputs: &mut Outputs<'_>,
    stop: &AtomicBool,
    (silence, mut governor): (Duration, Option<Governor>),
    look: &mut dyn FnMut(&Report, Option<f64>),
) -> Result<Report, Error> {
    let mut report = Report::default();
    let first = (open)()?;
    let mut source = Reopening { open, source: Some(first), pause: BACK_OFF[0], before: Counts::default() };
    let now = clock::instant();
    let mut cadence = Cadence { last: now, last_frame: now, steps: 0, silence };
    while !stop.load(Ordering::Relaxed) {
        match source.next(stop) {
            Ok(Next::Sample(sample)) => {
                outputs.sample(&sample);
                cadence.saw(&sample, &mut report);
                if let Some(pipeline) = pipeline.as_deref_mut() {
                    let taken = advance(&sample, pipeline, outputs, &mut report);
                    if let (Some(governor), Some(taken)) = (&mut governor, taken) {
                        govern(governor, taken, source.counts().displaced, pipeline, outputs, &mut report);
                    }
                }
            }
            Ok(Next::Idle) => {}
            Ok(Next::End) => break,
            Err(error @ (camera::Error::Torn { .. } | camera::Error::Wire(_))) => report.spoil("camera", &error),
            Err(fatal) => {
                outputs.finish()?;
                return Err(fatal.into());
            }
        }
        report.source = source.counts();
        if cadence.last.elapsed() >= STATUS {
            report.lost = outputs.lost();
            report.diagnosis = pipeline.as_deref().and_then(Pipeline::diagnosis);
            outputs.status(&report.status(&cadence));
            cadence = Cadence { last: clock::instant(), steps: report.steps, ..cadence };
        }
        look(&report, source.source.as_ref().and_then(|source| source.progress()));
    }
    let finished = outputs.finish();
    report.lost = outputs.lost();
    finished?;
    Ok(report)
}

/// Lets the governor look at a step, and does what it says.
fn govern(
    governor: &mut Governor,
    taken: Taken,
    displaced: u64,
    pipeline: &mut Pipeline,
    outputs: &mut Outputs<'_>,
    report: &mut Report,
) {
    if let Some(columns) = governor.took(&Taken { displaced, ..taken }) {
        let header = wire::Header { stamp: taken.stamp.into(), frame_id: String::new() };
        let sample = Sample::Width(Arc::new(wire::Width { header, columns: columns as u32 }));
        outputs.sample(&sample);
        advance(&sample, pipeline, outputs, report);
        tracing::info!(target: "nightflow::node", "images are developed {columns} columns wide from here on");
    }
    report.narrowed = governor.narrowed();
}

/// One sample through the pipeline and out of every sink; how a step went, where it was one.
fn advance(sample: &Sample, pipeline: &mut Pipeline, outputs: &mut Outputs<'_>, report: &mut Report) -> Option<Taken> {
    let start = clock::instant();
    report.watch.start();
    match pipeline.step(sample, outputs.lender(), &mut report.watch) {
        Ok(Outcome::Moved(moved)) => {
            outputs.offer(&moved, pipeline);
            report.watch.lap(Stage::Publish);
            report.moved(&moved);
            let step_s = start.elapsed().as_secs_f64();
            report.step_ms.keep(step_s * 1e3);
            report.latency_ms.keep(clock::now().seconds_since(moved.newer) * 1e3);
            let size = pipeline.image().map_or([1, 1], |image| [image.width, image.height]);
            return Some(Taken { stamp: moved.newer, displaced: 0, step_s, size });
        }
        Ok(Outcome::Unpaired) => report.unpaired += 1,
        Ok(Outcome::Noted) => {}
        Err(error) => report.spoil(error.cause(), &error),
    }
    None
}
