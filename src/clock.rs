//! Time: the stamp that every sample carries, and the only place that may ask what time it is.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde::{Deserialize, Serialize};

use crate::wire::Time;

/// Nanoseconds since the Unix epoch.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
pub struct Stamp(pub i64);

impl Stamp {
    /// From whole nanoseconds since the epoch.
    pub const fn from_ns(ns: i64) -> Self {
        Self(ns)
    }

    /// Whole nanoseconds since the epoch.
    pub const fn ns(self) -> i64 {
        self.0
    }

    /// Seconds from `earlier` to this stamp; negative when this one is older.
    pub fn seconds_since(self, earlier: Stamp) -> f64 {
        self.0.saturating_sub(earlier.0) as f64 * 1e-9
    }
}

impl From<Time> for Stamp {
    fn from(time: Time) -> Self {
        Self(i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec))
    }
}

impl From<Stamp> for Time {
    fn from(stamp: Stamp) -> Self {
        Time { sec: stamp.0.div_euclid(1_000_000_000) as i32, nanosec: stamp.0.rem_euclid(1_000_000_000) as u32 }
    }
}

impl std::fmt::Display for Stamp {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}.{:09}", self.0.div_euclid(1_000_000_000), self.0.rem_euclid(1_000_000_000))
    }
}

/// The wall clock, for receive times and for the stamps of messages that answer to no frame.
pub fn now() -> Stamp {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
    Stamp(i64::try_from(since.as_nanos()).unwrap_or(i64::MAX))
}

/// A monotonic moment, for waiting and for measuring.
pub fn instant() -> Instant {
    Instant::now()
}

/// What is told that a part of a step has ended; the pure stages measure themselves through it.
pub trait Laps {
    /// The work since the last call belongs to `stage`.
    fn lap(&mut self, stage: Stage);
}

/// The parts of a step that are timed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Raw counts to a linear image.
    Exposure,
    /// Two images to dense flow.
    Flow,
    /// Flow to velocity.
    Motion,
    /// Results to every sink.
    Publish,
}

impl Stage {
    /// All stages in the order of the data.
    pub const ALL: [Stage; 4] = [Stage::Exposure, Stage::Flow, Stage::Motion, Stage::Publish];

    /// The stage's folder, config section and counter prefix.
    pub const fn name(self) -> &'static str {
        match self {
            Stage::Exposure => "exposure",
            Stage::Flow => "flow",
            Stage::Motion => "motion",
            Stage::Publish => "publish",
        }
    }
}

/// Laps that nobody reads.
pub struct Untimed;

impl Laps for Untimed {
    fn lap(&mut self, _: Stage) {}
}

/// Laps kept as a fixed-size sample per stage, so that a node that runs for days does not grow.
pub struct Stopwatch {
    last: Instant,
    durations: [Reservoir; 4],
}

impl Default for Stopwatch {
    fn default() -> Self {
        Self { last: Instant::now(), durations: std::array::from_fn(|_| Reservoir::default()) }
    }
}

impl Stopwatch {
    /// Starts a step: what came before belongs to no stage, but for the work that was done for it already.
    pub fn start(&mut self, ahead: Duration) {
        let now = Instant::now();
        self.last = now.checked_sub(ahead).unwrap_or(now);
    }

    /// The kept durations of a stage in milliseconds.
    pub fn of(&self, stage: Stage) -> &Reservoir {
        &self.durations[stage as usize]
    }
}

impl Laps for Stopwatch {
    fn lap(&mut self, stage: Stage) {
        let now = Instant::now();
        self.durations[stage as usize].keep((now - self.last).as_secs_f64() * 1e3);
        self.last = now;
    }
}

/// The newest 8192 values of a series, for percentiles.
#[derive(Debug, Clone, Default)]
pub struct Reservoir {
    kept: Vec<f64>,
    next: usize,
    seen: u64,
}

impl Reservoir {
    const ROOM: usize = 8192;

    /// Keeps a value, in place of the oldest when there is no room.
    pub fn keep(&mut self, value: f64) {
        if self.kept.capacity() == 0 {
            self.kept.reserve_exact(Self::ROOM);
        }
        if self.kept.len() < Self::ROOM {
            self.kept.push(value);
        } else {
            self.kept[self.next] = value;
        }
        self.next = (self.next + 1) % Self::ROOM;
        self.seen += 1;
    }

    /// How many values were ever kept.
    pub fn seen(&self) -> u64 {
        self.seen
    }

    /// The values at the given quantiles (0…1), or `None` when nothing was kept.
    pub fn quantiles<const N: usize>(&self, at: [f64; N]) -> Option<[f64; N]> {
        if self.kept.is_empty() {
            return None;
        }
        let mut sorted = self.kept.clone();
        sorted.sort_by(f64::total_cmp);
        Some(at.map(|q| sorted[((sorted.len() - 1) as f64 * q).round() as usize]))
    }
}
