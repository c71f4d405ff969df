//! The range finder: a bounded series of ranges, and the distance at a stamp.

use std::collections::VecDeque;

use super::{Config, Error, NoDistance, gyro::ANEW_S};
use crate::{clock::Stamp, wire::Range};

/// Over a second at 50 Hz.
const ROOM: usize = 64;

#[derive(Debug, Clone, Copy)]
struct Reach {
    stamp: Stamp,
    range: f64,
    min: f64,
    max: f64,
    variance: f64,
}

impl Reach {
    fn checked(&self) -> Result<f64, NoDistance> {
        let bounded = self.max > self.min;
        let inside = self.range.is_finite() && self.range > 0.0;
        if inside && (!bounded || (self.min..=self.max).contains(&self.range)) {
            return Ok(self.range);
        }
        Err(NoDistance::OutOfBounds { range: self.range, min: self.min, max: self.max })
    }
}

/// Ranges in the order of their stamps.
#[derive(Debug)]
pub(super) struct Ranges {
    ring: VecDeque<Reach>,
}

/// A range along the beam, metres.
#[derive(Debug, Clone, Copy)]
pub(super) struct Beam {
    /// Metres.
    pub(super) range: f64,
    /// m².
    pub(super) variance: f64,
}

impl Ranges {
    /// An empty series.
    pub(super) fn new() -> Self {
        Self { ring: VecDeque::with_capacity(ROOM) }
    }

    /// Takes a sample. Infinities are kept: they say that nothing is within the sensor's reach (REP 117).
    pub(super) fn keep(&mut self, range: &Range) -> Result<(), Error> {
        let stamp: Stamp = range.header.stamp.into();
        if range.range.is_nan() {
            return Err(Error::NotFinite { sensor: "range", stamp, what: "range" });
        }
        if let Some(newest) = self.ring.back().map(|reach| reach.stamp)
            && stamp <= newest
        {
            let anew = newest.seconds_since(stamp) > ANEW_S;
            if anew {
                self.ring.clear();
            }
            return Err(Error::Backwards { sensor: "range", stamp, newest, anew });
        }
        if self.ring.len() == ROOM {
            self.ring.pop_front();
        }
        self.ring.push_back(Reach {
            stamp,
            range: range.range.into(),
            min: range.min_range.into(),
            max: range.max_range.into(),
            variance: range.variance.into(),
        });
        Ok(())
    }

    /// The range at the older frame's stamp, interpolated where samples lie on both sides. The newest range must be
    /// young enough at the newer frame.
    pub(super) fn at(&self, older: Stamp, newer: Stamp, config: &Config) -> Result<Beam, NoDistance> {
        // A sample from after the newer frame (a recording read ahead) says nothing about this step's age.
        let known = self.ring.partition_point(|reach| reach.stamp <= newer);
        let newest = known.checked_sub(1).and_then(|i| self.ring.get(i)).ok_or(NoDistance::Missing)?;
        let age_s = newer.seconds_since(newest.stamp);
        if age_s > config.range_age_s_max {
            return Err(NoDistance::Old { age_s, allowed_s: config.range_age_s_max });
        }
        let after = self.ring.partition_point(|reach| reach.stamp <= older);
        let before = after.checked_sub(1).and_then(|i| self.ring.get(i));
        let young = |reach: &&Reach| reach.stamp.seconds_since(older).abs() <= config.range_age_s_max;
        match (before.filter(young), self.ring.get(after).filter(young)) {
            (Some(a), Some(b)) => {
                let part = older.seconds_since(a.stamp) / b.stamp.seconds_since(a.stamp);
                let range = a.checked()? * (1.0 - part) + b.checked()? * part;
                let variance = (1.0 - part).powi(2) * noise(a, config) + part.powi(2) * noise(b, config);
                Ok(Beam { range, variance })
            }
            (Some(only), None) | (None, Some(only)) => {
                let range = only.checked()?;
                let climbed = config.climb_sd_m_s * older.seconds_since(only.stamp);
                Ok(Beam { range, variance: noise(only, config) + climbed * climbed })
            }
            (None, None) => Err(NoDistance::Old { age_s, allowed_s: config.range_age_s_max }),
        }
    }
}

fn noise(reach: &Reach, config: &Config) -> f64 {
    if reach.variance.is_finite() && reach.variance > 0.0 {
        return reach.variance;
    }
    config.range_sd_m.powi(2) + (config.range_sd_part * reach.range).powi(2)
}
