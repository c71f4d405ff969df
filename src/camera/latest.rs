//! The one mailbox: the newest frame wins, every displaced one is counted.
//!
//! A transport's thread puts samples in through a [`Sender`]; the node takes them out of [`Latest`]. Dropping happens
//! here and nowhere else, before the recorder, so that a recording holds what the pipeline used.

use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use super::{Counts, Error, Frame, Next, Sample};
use crate::clock::Stamp;

/// Small samples that may wait: 2 s of a gyro at 1 kHz with range and calibration beside it.
pub const SMALL_ROOM: usize = 2400;

/// A mailbox for one frame and at most `room` small samples.
pub fn mailbox(room: usize) -> (Sender, Latest) {
    let room = room.max(1);
    let inside = Inside { small: VecDeque::with_capacity(room), room, senders: 1, ..Inside::default() };
    let shared = Arc::new(Shared { inside: Mutex::new(inside), came: Condvar::new() });
    (Sender { shared: shared.clone() }, Latest { shared, lead_ns: 0 })
}

/// Where a transport's thread puts what arrives. The source ends when the last sender is dropped.
pub struct Sender {
    shared: Arc<Shared>,
}

/// Where the node takes samples from.
pub struct Latest {
    shared: Arc<Shared>,
    /// How much newer than its frame a small sample may be and come before it.
    lead_ns: i64,
}

struct Shared {
    inside: Mutex<Inside>,
    came: Condvar,
}

#[derive(Default)]
struct Inside {
    frame: Option<Arc<Frame>>,
    /// In the order of their stamps.
    small: VecDeque<Sample>,
    room: usize,
    /// How many small samples go out without waiting for a frame, because none came in time.
    overdue: usize,
    counts: Counts,
    numbers: Numbers,
    senders: usize,
    failure: Option<Error>,
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
        let mut inside = self.shared.lock();
        inside.counts.arrived += 1;
        inside.overdue = 0;
        let displaced = match inside.frame.take() {
            Some(waiting) if waiting.stamp() > frame.stamp() => {
                inside.frame = Some(waiting);
                Some(frame)
            }
            waiting => {
                inside.frame = Some(frame);
                waiting
            }
        };
        inside.counts.displaced += u64::from(displaced.is_some());
        drop(inside);
        self.shared.came.notify_one();
        // Megabytes are given back after the lock, so that the taker doesn't wait for it.
        drop(displaced);
    }

    /// Puts a small sample in the order of its stamp; the oldest makes room when there is none.
    fn small(&self, sample: Sample) {
        let mut inside = self.shared.lock();
        if inside.small.len() == inside.room {
            inside.small.pop_front();
            inside.counts.overrun += 1;
        }
        let stamp = sample.stamp();
        let newer = inside.small.iter().rev().take_while(|waiting| waiting.stamp() > stamp).count();
        let place = inside.small.len() - newer;
        inside.small.insert(place, sample);
        // Nobody is woken: small samples wait for a frame.
    }

    /// Counts a message that could not be decoded.
    pub fn torn(&self) {
        self.shared.lock().counts.torn += 1;
    }

    /// Counts the frames that are missing before this number of a publisher's.
    pub fn numbered(&self, publisher: [u8; 16], number: i64) {
        let mut inside = self.shared.lock();
        inside.counts.missed += inside.numbers.missed(publisher, number);
    }

    /// The transport is gone: once what waits is taken, the taker hears why.
    pub fn fail(&self, why: Error) {
        self.shared.lock().failure.get_or_insert(why);
        self.shared.came.notify_one();
    }
}

/// Finds holes in the numbers that a publisher gives its frames.
#[derive(Default)]
struct Numbers {
    newest: Option<([u8; 16], i64)>,
}

impl Numbers {
    /// How many frames of this publisher are missing before this one; another publisher begins anew.
    fn missed(&mut self, publisher: [u8; 16], number: i64) -> u64 {
        let (newest, missed) = match self.newest {
            Some((known, newest)) if known == publisher => {
                (number.max(newest), number.saturating_sub(newest).saturating_sub(1).max(0))
            }
            _ => (number, 0),
        };
        self.newest = Some((publisher, newest));
        missed.unsigned_abs()
    }
}

impl Clone for Sender {
    fn clone(&self) -> Self {
        self.shared.lock().senders += 1;
        Self { shared: self.shared.clone() }
    }
}

impl Drop for Sender {
    fn drop(&mut self) {
        self.shared.lock().senders -= 1;
        self.shared.came.notify_one();
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
        let inside = self.shared.lock();
        let (mut inside, _) = self
            .shared
            .came
            .wait_timeout_while(inside, wait, |inside| !inside.ready())
            .unwrap_or_else(PoisonError::into_inner);
        if !inside.ready() {
            inside.overdue = inside.small.len();
        }
        if let Some(sample) = inside.take(self.lead_ns) {
            return Ok(Next::Sample(sample));
        }
        match inside.failure.take() {
            Some(why) => Err(why),
            None if inside.senders == 0 => Ok(Next::End),
            None => Ok(Next::Idle),
        }
    }

    /// What was counted so far.
    pub fn counts(&self) -> Counts {
        self.shared.lock().counts
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Inside> {
        // A panic elsewhere can't leave the mailbox half changed: every change above is whole before it can panic.
        self.inside.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inside {
    fn ready(&self) -> bool {
        self.frame.is_some() || self.overdue > 0 || self.ended()
    }

    fn ended(&self) -> bool {
        self.senders == 0 || self.failure.is_some()
    }

    fn take(&mut self, lead_ns: i64) -> Option<Sample> {
        let due = match &self.frame {
            Some(frame) => Stamp(frame.stamp().ns().saturating_add(lead_ns)),
            None if self.overdue > 0 || self.ended() => Stamp::from_ns(i64::MAX),
            None => return None,
        };
        if self.small.front().is_some_and(|sample| sample.stamp() <= due) {
            self.overdue = self.overdue.saturating_sub(1);
            return self.small.pop_front();
        }
        self.frame.take().map(Sample::Frame)
    }
}
