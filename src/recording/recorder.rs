//! Keeps what the pipeline saw and found, on a thread of its own, so that a slow disk never holds up a step.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use super::{
    Config, Error, Writer,
    pen::{Pen, Topics},
    queue::{Item, Queue},
};
use crate::{
    camera::{self, Sample},
    clock, flow,
    publish::{self, Offer, Sink},
    wire,
};

/// Small samples (gyro, range, calibration) that may wait for each frame or step that may: a gyro of 1 kHz beside a
/// camera of 30 Hz gives 33 of a few hundred bytes each.
const SMALL_PER_LARGE: usize = 64;

/// A disk that fails while its queue is full is noticed after this time.
const ROOM_WAIT: Duration = Duration::from_millis(100);

/// What the recording thread counts for others to see.
#[derive(Debug, Default)]
struct Progress {
    written: AtomicU64,
    synced: AtomicU64,
    lost: AtomicU64,
}

/// A sink that writes samples and results to MCAP.
pub struct Recorder {
    path: PathBuf,
    frames: bool,
    flow: bool,
    /// The source waits, so that nothing need be lost to a slow disk.
    patient: bool,
    body_frame: String,
    queue: Arc<Queue>,
    progress: Arc<Progress>,
    writing: Option<JoinHandle<Result<(), Error>>>,
    failure: Option<String>,
}

impl Recorder {
    /// Opens the recording. A file that is there already is never overwritten: `flight.mcap` becomes
    /// `flight_1.mcap`, so that a node that restarts keeps what it recorded before.
    ///
    /// `cameras` names the topics of the samples; outputs stand under `namespace`, velocities are given in
    /// `body_frame`; `metadata` (settings, hash of the model, version) becomes the record `nightflow`.
    pub fn open(
        config: &Config,
        cameras: &camera::Config,
        namespace: &str,
        body_frame: &str,
        metadata: &BTreeMap<String, String>,
    ) -> Result<Self, Error> {
        let wanted = config.path.as_deref().unwrap_or(Path::new("nightflow.mcap"));
        let path = free(wanted);
        let mut writer = Writer::create(&path, config)?;
        writer.attach_metadata("nightflow", metadata)?;
        writer.sync()?;
        let queue = Arc::new(Queue::new(config.queue_max.max(1), config.queue_max.max(1) * SMALL_PER_LARGE));
        let progress = Arc::new(Progress::default());
        let pen = Pen::new(writer, Topics::new(cameras, namespace), config.flow);
        let every = Duration::from_secs_f64(config.sync_s.clamp(0.01, 3600.0));
        let writing = {
            let (queue, progress) = (Arc::clone(&queue), Arc::clone(&progress));
            std::thread::Builder::new()
                .name("recording".into())
                .spawn(move || write_out(pen, &queue, &progress, every))
                .map_err(|e| Error::Thread(format!("can't be started: {e}")))?
        };
        Ok(Self {
            path,
            frames: config.frames,
            flow: config.flow,
            patient: cameras.waits(),
            body_frame: body_frame.into(),
            queue,
            progress,
            writing: Some(writing),
            failure: None,
        })
    }

    /// The file that is written.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Samples, steps and states that a power cut could no longer take away.
    pub fn synced(&self) -> u64 {
        self.progress.synced.load(Ordering::Acquire)
    }

    /// Samples, steps and states that were handed to the file, synced or not.
    pub fn written(&self) -> u64 {
        self.progress.written.load(Ordering::Acquire)
    }

    fn keep(&mut self, item: Item, what: impl FnOnce() -> String) -> Result<(), publish::Error> {
        while self.patient && self.failed().is_none() && !self.queue.wait_for_room(&item, ROOM_WAIT) {}
        if let Some(reason) = self.failed() {
            self.progress.lost.fetch_add(1, Ordering::Relaxed);
            return Err(publish::Error::Lost { sink: "recording", what: what(), reason });
        }
        match self.queue.push(item) {
            Ok(()) => Ok(()),
            Err(waiting) => {
                self.progress.lost.fetch_add(1, Ordering::Relaxed);
                let reason = format!("the disk is too slow, {waiting} wait for it");
                Err(publish::Error::Lost { sink: "recording", what: what(), reason })
            }
        }
    }

    /// The thread ends by itself only when the file can't be written any more.
    fn failed(&mut self) -> Option<String> {
        if self.writing.as_ref().is_some_and(JoinHandle::is_finished) {
            self.failure = Some(match self.join() {
                Ok(()) => "the recording is finished".into(),
                Err(error) => error.to_string(),
            });
        }
        self.failure.clone()
    }

    fn join(&mut self) -> Result<(), Error> {
        self.queue.close();
        match self.writing.take().map(JoinHandle::join) {
            None => Ok(()),
            Some(Ok(ended)) => ended,
            Some(Err(_)) => Err(Error::Thread("it panicked".into())),
        }
    }
}

impl Sink for Recorder {
    fn name(&self) -> &'static str {
        "recording"
    }

    fn sample(&mut self, sample: &Sample) -> Result<(), publish::Error> {
        if matches!(sample, Sample::Frame(_)) && !self.frames {
            return Ok(());
        }
        self.keep(Item::Sample(sample.clone()), || match sample {
            Sample::Frame(frame) => format!("the frame of {}", frame.stamp()),
            other => format!("a small sample of {}", other.stamp()),
        })
    }

    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), publish::Error> {
        let step = offer.moved.step;
        let mut item = self.queue.spare().unwrap_or_default();
        item.keep(offer, &self.body_frame, self.flow);
        self.keep(Item::Step(item), || format!("step {step}"))
    }

    fn status(&mut self, status: &wire::Status) -> Result<(), publish::Error> {
        self.keep(Item::Status(Box::new(status.clone())), || "a status".into())
    }

    fn finish(&mut self) -> Result<(), publish::Error> {
        self.join().map_err(|error| publish::Error::Lost {
            sink: "recording",
            what: "the end of the recording".into(),
            reason: error.to_string(),
        })
    }

    fn lost(&self) -> u64 {
        self.progress.lost.load(Ordering::Relaxed)
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        if let Err(error) = self.join() {
            tracing::error!(target: "nightflow::recording", "{error}");
        }
    }
}

/// The thread: writes what waits, syncs every so often, finishes the file when the queue is closed and empty.
fn write_out(mut pen: Pen, queue: &Queue, progress: &Progress, every: Duration) -> Result<(), Error> {
    // What is to be kept has a queue to wait in; the next frame has none.
    flow::priority::leave();
    let mut synced_at = clock::instant();
    let mut unsynced = 0;
    loop {
        let wait = if unsynced == 0 { every } else { every.saturating_sub(synced_at.elapsed()) };
        let popped = queue.pop(wait);
        let closed = popped.closed;
        if let Some((item, lost)) = popped.item {
            pen.write(&item, lost)?;
            if let Item::Step(item) = item {
                queue.give_back(item);
            }
            if unsynced == 0 {
                // The interval runs from the first message that is at risk.
                synced_at = clock::instant();
            }
            unsynced += 1;
            progress.written.fetch_add(1, Ordering::Release);
        } else if closed {
            pen.finish()?;
            progress.synced.fetch_add(unsynced, Ordering::Release);
            return Ok(());
        }
        if unsynced > 0 && synced_at.elapsed() >= every {
            pen.sync()?;
            progress.synced.fetch_add(unsynced, Ordering::Release);
            unsynced = 0;
        }
    }
}

fn free(wanted: &Path) -> PathBuf {
    let stem = wanted.file_stem().map_or_else(String::new, |stem| stem.to_string_lossy().into_owned());
    let numbered = (1_u32..).map(|n| wanted.with_file_name(format!("{stem}_{n}.mcap")));
    std::iter::once(wanted.to_owned()).chain(numbered).find(|path| !path.exists()).unwrap_or_else(|| wanted.to_owned())
}
