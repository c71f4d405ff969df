//! What runs before the loop on a thread of its own: samples are taken from the source, and a frame is read while the one
//! before it is in the network.
//!
//! Samples are handed over in the source's order and none is dropped here. One frame at most is ahead of the one that the loop
//! works on: the memory that a frame is written to comes back from the loop, when the loop takes it. A live camera's frames are
//! not taken sooner than needed, for the mailbox may still get a newer one.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use super::{BACK_OFF, WAIT};
use crate::{
    camera::{self, Counts, Next, Sample, Source},
    clock,
    exposure::Linear,
    handover::{Giver, Taker},
    pipeline::{Front, Read},
    wire,
};

/// Samples that may be on their way to the loop: a quarter of a second of a gyro at 1 kHz.
pub(super) const ROOM: usize = 256;
/// Frames' memory that may be on its way back.
pub(super) const SPARES: usize = 2;
/// Part of the time that the loop took for the last frame after which the next one is wanted from a live camera: what is left
/// is more than reading it takes, and little for a frame to age.
const WANTED: f64 = 0.75;

/// How a source is opened, and opened again when it is lost.
pub type Open<'a> = dyn FnMut() -> Result<Box<dyn Source>, camera::Error> + Send + 'a;

/// Something for the loop.
pub(super) struct Passed {
    pub what: What,
    /// What the source has counted.
    pub counts: Counts,
    /// Of a finite source.
    pub progress: Option<f64>,
}

/// What there is for the loop.
// A frame is what mostly comes, and boxing it would allocate on every step.
#[allow(clippy::large_enum_variant)]
pub(super) enum What {
    /// A sample, what the front made of it, and how long that took.
    Sample(Sample, Read, Duration),
    /// Nothing came for a while.
    Idle,
    /// A message that can't be decoded.
    Torn(camera::Error),
    /// The source can't go on; nothing follows.
    Failed(camera::Error),
}

/// What the loop tells back. Each value stands for itself, so that no order among them matters.
#[derive(Default)]
pub(super) struct Told {
    /// Columns that images should have from here on; 0 for no change.
    pub columns: AtomicUsize,
    /// How long the loop took for the last frame, nanoseconds.
    pub step_ns: AtomicU64,
}

/// A source that is opened again when it is lost.
pub(super) struct Reopening<'a> {
    open: &'a mut Open<'a>,
    source: Option<Box<dyn Source>>,
    pause: Duration,
    before: Counts,
}

/// The thread.
pub(super) struct Ahead<'a> {
    pub source: Reopening<'a>,
    /// Without one the samples only pass.
    pub front: Option<&'a mut Front>,
    pub stop: &'a AtomicBool,
    pub told: &'a Told,
    pub to: Giver<Passed>,
    pub spares: Taker<Linear>,
}

impl<'a> Reopening<'a> {
    /// Opens the source for the first time.
    pub fn new(open: &'a mut Open<'a>) -> Result<Self, camera::Error> {
        let source = Some((open)()?);
        Ok(Self { open, source, pause: BACK_OFF[0], before: Counts::default() })
    }

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
                until(clock::instant() + self.pause, stop);
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

    fn progress(&self) -> Option<f64> {
        self.source.as_ref().and_then(|source| source.progress())
    }
}

/// Sleeps, but looks at the stop flag now and then.
fn until(moment: Instant, stop: &AtomicBool) {
    loop {
        let left = moment.saturating_duration_since(clock::instant());
        if left.is_zero() || stop.load(Ordering::Relaxed) {
            return;
        }
        thread::sleep(left.min(WAIT));
    }
}

impl Ahead<'_> {
    /// Goes on until the source ends or fails, `stop` is set, or the loop is gone.
    pub fn run(mut self) {
        while !self.stop.load(Ordering::Relaxed) {
            let goes_on = match self.source.next(self.stop) {
                Ok(Next::Sample(sample)) => self.sample(sample),
                Ok(Next::Idle) => self.pass(What::Idle),
                Ok(Next::End) => return,
                Err(torn @ (camera::Error::Torn { .. } | camera::Error::Wire(_))) => self.pass(What::Torn(torn)),
                Err(fatal) => {
                    self.pass(What::Failed(fatal));
                    false
                }
            };
            if !goes_on {
                return;
            }
        }
    }

    /// Reads and hands over; whether there is a loop to hand over to.
    fn sample(&mut self, sample: Sample) -> bool {
        let columns = self.told.columns.swap(0, Ordering::Relaxed);
        // The width is said with a stamp that no later frame's is before, so that in a recording it comes where it came here.
        if columns > 0
            && let Some(stamp) = self.front.as_ref().and_then(|front| front.newest())
        {
            let header = wire::Header { stamp: stamp.into(), frame_id: String::new() };
            let width = Sample::Width(Arc::new(wire::Width { header, columns: columns as u32 }));
            tracing::info!(target: "nightflow::node", "images are developed {columns} columns wide from here on");
            if !self.read(width) {
                return false;
            }
        }
        self.read(sample)
    }

    fn read(&mut self, sample: Sample) -> bool {
        let begin = clock::instant();
        let read = self.front.as_mut().and_then(|front| front.read(&sample));
        let is_frame = matches!(read, Some(Ok(_)));
        if !self.pass(What::Sample(sample, read, begin.elapsed())) {
            return false;
        }
        if is_frame { self.taken() } else { true }
    }

    fn pass(&mut self, what: What) -> bool {
        let passed = Passed { what, counts: self.source.counts(), progress: self.source.progress() };
        self.to.give(passed).is_ok()
    }

    /// Waits until the loop has taken the frame, and then until it will soon want the next one.
    fn taken(&mut self) -> bool {
        let Some(spare) = self.spares.take() else { return false };
        let begin = clock::instant();
        if let Some(front) = &mut self.front {
            front.reuse(spare);
        }
        let live = self.source.progress().is_none();
        if live {
            let step = Duration::from_nanos(self.told.step_ns.load(Ordering::Relaxed));
            until(begin + step.mul_f64(WANTED), self.stop);
        }
        true
    }
}
