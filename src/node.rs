//! The loop: source, step, sinks; with stop, counters and the status once a second.

mod ahead;
mod governor;

use std::{
    collections::BTreeMap,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use crate::{
    camera::{self, Counts, Sample},
    clock::{self, Laps, Reservoir, Stage, Stopwatch},
    exposure::{Exposed, Linear, Noise},
    flow::{Flow, Lender, Own, State},
    handover::{Giver, Taker, handover},
    motion::{Diagnosis, NoSight, Scale, Sector},
    pipeline::{Back, Outcome, Pipeline, Read},
    publish::{self, Moved, Offer, Sink, iceoryx2::SharedSink},
    wire,
};
pub use ahead::Open;
use ahead::{Ahead, Passed, Reopening, Told, What};
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
    /// There is no thread for the source.
    #[error("can't start a thread for the source: {0}")]
    Thread(std::io::Error),
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
    fn offer(&mut self, moved: &Moved, image: Option<&Exposed>) {
        let (vectors, confidence) = match &self.shared {
            Some(shared) => shared.lent(),
            None => self.own.lent(),
        };
        let flow = Flow { older: moved.older, newer: moved.newer, grid: moved.grid, vectors, confidence };
        if let Some(image) = image {
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

/// Runs until the source ends or `stop` is set, then writes everything out. `look` sees the report after every sample,
/// with the progress through a finite source. Without a pipeline the samples are only kept. A governor, where there is one,
/// may narrow the images; what it decides is a sample like any other, so that it is recorded and replayed.
///
/// The source has a thread of its own, which reads each frame while the one before it is in the network.
pub fn drive(
    open: &mut Open<'_>,
    pipeline: Option<&mut Pipeline>,
    outputs: &mut Outputs<'_>,
    stop: &AtomicBool,
    (silence, governor): (Duration, Option<Governor>),
    look: &mut dyn FnMut(&Report, Option<f64>),
) -> Result<Report, Error> {
    let source = Reopening::new(open)?;
    let told = Told::default();
    let (front, back) = pipeline.map(Pipeline::halves).unzip();
    let (to, passed) = handover(ahead::ROOM);
    let (back_to, spares) = handover(ahead::SPARES);
    let ended = thread::scope(|scope| {
        let ahead = Ahead { source, front, stop, told: &told, to, spares };
        let named = thread::Builder::new().name("camera".into());
        named.spawn_scoped(scope, || ahead.run()).map_err(Error::Thread)?;
        let begin = clock::instant();
        let cadence = Cadence { last: begin, last_frame: begin, steps: 0, silence };
        Loop { back, outputs, governor, told: &told, spares: back_to, cadence, report: Report::default() }
            .run(passed, look)
    });
    let finished = outputs.finish();
    if ended.is_err() {
        said(finished);
        return ended;
    }
    finished?;
    ended.map(|report| Report { lost: outputs.lost(), ..report })
}

/// The loop, with what it works on.
struct Loop<'a, 'b> {
    back: Option<&'a mut Back>,
    outputs: &'a mut Outputs<'b>,
    governor: Option<Governor>,
    told: &'a Told,
    spares: Giver<Linear>,
    cadence: Cadence,
    report: Report,
}

impl Loop<'_, '_> {
    /// Takes what is passed until nothing more comes.
    fn run(mut self, mut passed: Taker<Passed>, look: &mut dyn FnMut(&Report, Option<f64>)) -> Result<Report, Error> {
        while let Some(Passed { what, counts, progress }) = passed.take() {
            self.report.source = counts;
            match what {
                What::Sample(sample, read, took) => {
                    self.outputs.sample(&sample);
                    self.cadence.saw(&sample, &mut self.report);
                    if let Some(taken) = self.advance(&sample, read, took) {
                        self.tell(&taken);
                    }
                }
                What::Idle => {}
                What::Torn(error) => self.report.spoil("camera", &error),
                What::Failed(fatal) => return Err(fatal.into()),
            }
            self.status();
            look(&self.report, progress);
        }
        Ok(self.report)
    }

    /// Says how it goes, once a second.
    fn status(&mut self) {
        if self.cadence.last.elapsed() >= STATUS {
            self.report.lost = self.outputs.lost();
            self.report.diagnosis = self.back.as_deref().and_then(Back::diagnosis);
            self.outputs.status(&self.report.status(&self.cadence));
            (self.cadence.last, self.cadence.steps) = (clock::instant(), self.report.steps);
        }
    }

    /// Tells the thread before how long a step took and, if the governor says so, how wide images should be.
    fn tell(&mut self, taken: &Taken) {
        self.told.step_ns.store((taken.step_s * 1e9) as u64, Ordering::Relaxed);
        if let Some(governor) = &mut self.governor {
            if let Some(columns) = governor.took(taken) {
                self.told.columns.store(columns, Ordering::Relaxed);
            }
            self.report.narrowed = governor.narrowed();
        }
    }

    /// One sample through the pipeline and out of every sink; how a step went, where it was one.
    fn advance(&mut self, sample: &Sample, read: Read, took: Duration) -> Option<Taken> {
        let Self { back, outputs, spares, report, .. } = self;
        let back = back.as_deref_mut()?;
        let start = clock::instant();
        report.watch.start(took);
        let mut spare = |linear| {
            // There is room for all that are out. If the other thread has ended, nobody wants it.
            let _ = spares.try_give(linear);
        };
        match back.step(sample, read, &mut spare, outputs.lender(), &mut report.watch) {
            Ok(Outcome::Moved(moved)) => {
                outputs.offer(&moved, back.image());
                report.watch.lap(Stage::Publish);
                report.moved(&moved);
                let step = start.elapsed();
                report.step_ms.keep((took + step).as_secs_f64() * 1e3);
                report.latency_ms.keep(clock::now().seconds_since(moved.newer) * 1e3);
                let size = back.image().map_or([1, 1], |image| [image.width, image.height]);
                let displaced = report.source.displaced;
                return Some(Taken { stamp: moved.newer, displaced, step_s: step.as_secs_f64(), size });
            }
            Ok(Outcome::Unpaired) => report.unpaired += 1,
            Ok(Outcome::Noted) => {}
            Err(error) => report.spoil(error.cause(), &error),
        }
        None
    }
}
