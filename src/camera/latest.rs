//! The one mailbox: the newest frame wins, every displaced one is counted.
//!
//! A transport's thread puts samples in through a [`Sender`]; the node takes them out of [`Latest`]. Neither waits for a lock
//! of the other's. Dropping happens here and nowhere else, before the recorder, so that a recording holds what the pipeline
//! used.

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicI64, AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};

use arc_swap::{ArcSwapOption, Guard};
use crossbeam_queue::ArrayQueue;

use super::{Counts, Error, Frame, Next, Sample};
use crate::{clock::Stamp, handover::Bell};

/// Small samples that may wait: 2 s of a gyro at 1 kHz with range and calibration beside it.
pub const SMALL_ROOM: usize = 2400;

/// Small samples that may arrive beyond the mailbox's room before the taker looks. It is the taker that makes room, because
/// only it knows their order; of what arrives beyond this too, the first to arrive makes room.
const BEYOND: usize = 256;

/// A mailbox for one frame and at most `room` small samples.
pub fn mailbox(room: usize) -> (Sender, Latest) {
    let room = room.max(1);
    let shared = Arc::new(Shared {
        frame: ArcSwapOption::empty(),
        arriving: ArrayQueue::new(room + BEYOND),
        counted: Counted::default(),
        numbered: ArcSwapOption::empty(),
        senders: AtomicUsize::new(1),
        failure: ArrayQueue::new(1),
        came: Bell::default(),
    });
    let latest = Latest {
        shared: shared.clone(),
        small: VecDeque::with_capacity(room),
        room,
        overdue: 0,
        overrun: 0,
        lead_ns: 0,
    };
    (Sender { shared }, latest)
}

/// Where a transport's thread puts what arrives. The source ends when the last sender is dropped.
pub struct Sender {
    shared: Arc<Shared>,
}

/// Where the node takes samples from.
pub struct Latest {
    shared: Arc<Shared>,
    /// In the order of their stamps.
    small: VecDeque<Sample>,
    room: usize,
    /// How many small samples go out without waiting for a frame, because none came in time.
    overdue: usize,
    /// Small samples that made room here.
    overrun: u64,
    /// How much newer than its frame a small sample may be and come before it.
    lead_ns: i64,
}

struct Shared {
    frame: ArcSwapOption<Frame>,
    /// Small samples in the order of their arrival, until the taker looks.
    arriving: ArrayQueue<Sample>,
    counted: Counted,
    numbered: ArcSwapOption<Numbered>,
    senders: AtomicUsize,
    /// Room for one, so that the first stays.
    failure: ArrayQueue<Error>,
    came: Bell,
}

/// What is counted on the senders' side; each number stands for itself.
#[derive(Default)]
struct Counted {
    arrived: AtomicU64,
    displaced: AtomicU64,
    torn: AtomicU64,
    overrun: AtomicU64,
    missed: AtomicU64,
}

/// The newest number that a publisher gave a frame.
struct Numbered {
    publisher: [u8; 16],
    newest: AtomicI64,
}

impl Sender {
    /// Puts any sample where it belongs.
    pub fn put(&self, sample: Sample) {
        match sample {
            Sample::Frame(frame) => self.frame(frame),
            small => self.small(small),
        }
    }

    /// Puts a frame in place of the one that waits, unless that one is newer: datagrams overtake each other.
    pub fn frame(&self, frame: Arc<Frame>) {
        let Shared { frame: place, counted, came, .. } = &*self.shared;
        count(&counted.arrived, 1);
        loop {
            let waiting = place.load();
            if waiting.as_ref().is_some_and(|waiting| waiting.stamp() > frame.stamp()) {
                return count(&counted.displaced, 1);
            }
            // If this frame went straight in, an older one could stand in for a newer one for a moment.
            let found = place.compare_and_swap(&waiting, Some(Arc::clone(&frame)));
            if same(&found, &waiting) {
                count(&counted.displaced, u64::from(found.is_some()));
                came.ring();
                // Megabytes are given back after that, so that the taker doesn't wait for it.
                return;
            }
        }
    }

    /// Puts a small sample beside the others; the oldest makes room when there is none.
    fn small(&self, sample: Sample) {
        let Shared { arriving, counted, .. } = &*self.shared;
        count(&counted.overrun, u64::from(arriving.force_push(sample).is_some()));
        // Nobody is woken: small samples wait for a frame.
    }

    /// Counts a message that could not be decoded.
    pub fn torn(&self) {
        count(&self.shared.counted.torn, 1);
    }

    /// Counts the frames that are missing before this number of a publisher's; another publisher begins anew.
    pub fn numbered(&self, publisher: [u8; 16], number: i64) {
        let Shared { numbered, counted, .. } = &*self.shared;
        match &*numbered.load() {
            Some(known) if known.publisher == publisher => {
                let newest = known.newest.fetch_max(number, Ordering::Relaxed);
                let missed = number.saturating_sub(newest).saturating_sub(1).max(0);
                count(&counted.missed, missed.unsigned_abs());
            }
            _ => numbered.store(Some(Arc::new(Numbered { publisher, newest: AtomicI64::new(number) }))),
        }
    }

    /// The transport is gone: once what waits is taken, the taker hears why.
    pub fn fail(&self, why: Error) {
        // Where one waits already, that is the reason to be told.
        let _ = self.shared.failure.push(why);
        self.shared.came.ring();
    }
}

fn count(counter: &AtomicU64, more: u64) {
    if more > 0 {
        counter.fetch_add(more, Ordering::Relaxed);
    }
}

/// Whether this is the very same frame, or none both times.
fn same(one: &Option<Arc<Frame>>, other: &Option<Arc<Frame>>) -> bool {
    one.as_ref().map(Arc::as_ptr) == other.as_ref().map(Arc::as_ptr)
}

impl Clone for Sender {
    fn clone(&self) -> Self {
        self.shared.senders.fetch_add(1, Ordering::Relaxed);
        Self { shared: self.shared.clone() }
    }
}

impl Drop for Sender {
    fn drop(&mut self) {
        // What this one put in is there for whoever sees that the last one is gone.
        self.shared.senders.fetch_sub(1, Ordering::Release);
        self.shared.came.ring();
    }
}

impl Latest {
    /// For frames whose stamps are the beginnings of exposures of this length: small samples up to the middle of the
    /// exposure come before the frame, which cannot have arrived before them.
    pub fn exposing(mut self, exposure_s: f64) -> Latest {
        self.lead_ns = (0.5e9 * exposure_s).round() as i64;
        self
    }

    /// The next sample: small ones as old as the waiting frame or older in the order of their stamps, then the frame.
    /// Small samples newer than that wait for the next frame, but for no longer than `wait`.
    pub fn next(&mut self, wait: Duration) -> Result<Next, Error> {
        let Self { shared, overdue, .. } = self;
        let ready = || *overdue > 0 || shared.frame.load().is_some() || shared.ended();
        let late = !shared.came.wait(Some(wait), ready);
        // Asked before looking, so that what came before the end is taken before it.
        let ended = self.shared.ended();
        if let Some(sample) = self.take(late, ended) {
            return Ok(Next::Sample(sample));
        }
        if !ended {
            return Ok(Next::Idle);
        }
        match self.shared.failure.pop() {
            Some(why) => Err(why),
            None if self.shared.deserted() => Ok(Next::End),
            None => Ok(Next::Idle),
        }
    }

    /// What was counted so far.
    pub fn counts(&self) -> Counts {
        let Counted { arrived, displaced, torn, overrun, missed } = &self.shared.counted;
        let [arrived, displaced, torn, overrun, missed] =
            [arrived, displaced, torn, overrun, missed].map(|counter| counter.load(Ordering::Relaxed));
        // So many will make room as soon as this side looks.
        let too_many = (self.small.len() + self.shared.arriving.len()).saturating_sub(self.room);
        Counts { arrived, displaced, torn, overrun: overrun + self.overrun + too_many as u64, missed }
    }

    fn take(&mut self, late: bool, ended: bool) -> Option<Sample> {
        loop {
            let frame = self.shared.frame.load();
            // After the frame, so that the small samples that were put in before it are here before it.
            self.gather();
            let due = match &*frame {
                Some(frame) => {
                    self.overdue = 0;
                    Stamp(frame.stamp().ns().saturating_add(self.lead_ns))
                }
                None => {
                    if late {
                        self.overdue = self.small.len();
                    }
                    if self.overdue == 0 && !ended {
                        return None;
                    }
                    Stamp::from_ns(i64::MAX)
                }
            };
            if self.small.front().is_some_and(|sample| sample.stamp() <= due) {
                self.overdue = self.overdue.saturating_sub(1);
                return self.small.pop_front();
            }
            if frame.is_none() {
                return None;
            }
            // If another frame came meanwhile, small samples may have come before it.
            let found = self.shared.frame.compare_and_swap(&frame, None);
            if same(&found, &frame) {
                return Guard::into_inner(found).map(Sample::Frame);
            }
        }
    }

    /// Puts the small samples that arrived in the order of their stamps; the oldest makes room when there is none.
    fn gather(&mut self) {
        while let Some(sample) = self.shared.arriving.pop() {
            if self.small.len() == self.room {
                self.small.pop_front();
                self.overrun += 1;
            }
            let stamp = sample.stamp();
            let newer = self.small.iter().rev().take_while(|waiting| waiting.stamp() > stamp).count();
            self.small.insert(self.small.len() - newer, sample);
        }
    }
}

impl Shared {
    fn ended(&self) -> bool {
        self.deserted() || !self.failure.is_empty()
    }

    /// Whether nobody is left who could put anything in.
    fn deserted(&self) -> bool {
        self.senders.load(Ordering::Acquire) == 0
    }
}
