//! The developer: makes raw frames linear and keeps the newest two under one gain, in two halves that may run beside each other.

use super::{
    Config, Error, Exposed, Pair,
    gain::Law,
    linear::{Linear, Linearizer},
    sums,
};
use crate::{camera::Frame, clock::Stamp};

/// Develops frames one after the other. After the first frame of a size, it takes no memory.
#[derive(Debug)]
pub struct Developer {
    linearizer: Linearizer,
    pairing: Pairing,
}

/// The second half of developing: keeps the newest two linear frames, both under one gain.
#[derive(Debug)]
pub struct Pairing {
    law: Law,
    /// Which of the next two hold a frame: none, the newer, or both.
    kept: usize,
    newer: Linear,
    older: Linear,
    step: Option<f32>,
    generation: u64,
}

impl Developer {
    /// A developer that has seen nothing.
    pub fn new(config: &Config) -> Result<Self, Error> {
        Ok(Self { linearizer: Linearizer::new(config)?, pairing: Pairing::new(config)? })
    }

    /// Develops a frame; the newest before it becomes its partner.
    ///
    /// An error spoils this frame only: what was kept stays as it was.
    pub fn develop(&mut self, frame: &Frame) -> Result<(), Error> {
        let linear = self.linearizer.read(frame)?;
        self.linearizer.reuse(self.pairing.take(linear));
        Ok(())
    }

    /// The newest two frames under one gain; `None` while there is only one.
    pub fn pair(&self) -> Option<Pair<'_>> {
        self.pairing.pair()
    }

    /// Lets go of all frames, so that the next one finds no partner: the gap was too long, or the clock went back.
    pub fn forget(&mut self) {
        self.pairing.forget();
    }

    /// Develops what comes to at most so many columns, within the settings' bounds. Where that changes the size, the next
    /// frame finds no partner, for unlike images are no pair.
    pub fn set_width(&mut self, columns: usize) {
        self.linearizer.set_width(columns);
    }

    /// The newest developed frame, if it was not forgotten.
    pub fn newest(&self) -> Option<&Exposed> {
        self.pairing.newest()
    }
}

impl Pairing {
    /// One that has seen nothing.
    pub fn new(config: &Config) -> Result<Self, Error> {
        config.check()?;
        Ok(Self {
            law: Law::new(config),
            kept: 0,
            newer: Linear::default(),
            older: Linear::default(),
            step: None,
            generation: 0,
        })
    }

    /// Takes a frame, the newest before it becomes its partner; gives the memory of the one that is needed no longer.
    pub fn take(&mut self, linear: Linear) -> Linear {
        std::mem::swap(&mut self.older, &mut self.newer);
        let spare = std::mem::replace(&mut self.newer, linear);
        // A camera that changed its format in flight starts anew: unlike images are no pair.
        let alike = self.kept > 0 && self.older.exposed.like(&self.newer.exposed);
        self.kept = if alike { 2 } else { 1 };
        self.newer.exposed.frozen = alike
            && self.older.fingerprint == self.newer.fingerprint
            && self.older.exposed.stamp != self.newer.exposed.stamp;
        self.expose();
        spare
    }

    /// The newest two frames under one gain; `None` while there is only one.
    pub fn pair(&self) -> Option<Pair<'_>> {
        (self.kept == 2).then_some(Pair {
            older: &self.older.exposed,
            newer: &self.newer.exposed,
            gain_step: self.step,
        })
    }

    /// Lets go of all frames, so that the next one finds no partner: the gap was too long, or the clock went back.
    pub fn forget(&mut self) {
        self.kept = 0;
        self.step = None;
    }

    /// Lets go of all frames if a frame of this stamp comes too long after the newest.
    pub fn forget_before(&mut self, came: Stamp, gap_ms_max: f64) {
        let gap_s = self.newest().map(|newest| came.seconds_since(newest.stamp));
        if gap_s.is_some_and(|gap_s| gap_s * 1e3 > gap_ms_max) {
            self.forget();
        }
    }

    /// The newest developed frame, if it was not forgotten.
    pub fn newest(&self) -> Option<&Exposed> {
        (self.kept > 0).then_some(&self.newer.exposed)
    }

    /// Gives the newer frame its gain, and the older one the same.
    fn expose(&mut self) {
        let newer = self.newer.exposed.raw_mean;
        let gain = if self.kept == 2 {
            let (gain, step) = self.law.pair(self.older.exposed.raw_mean, newer);
            self.step = step;
            gain
        } else {
            self.step = None;
            self.law.alone(newer)
        };
        if self.kept == 2 && self.older.exposed.gain != gain {
            self.older.brighten(gain, &mut self.generation);
        }
        self.newer.brighten(gain, &mut self.generation);
    }
}

impl Linear {
    fn brighten(&mut self, gain: f32, generation: &mut u64) {
        sums::brighten(&self.exposed.linear, gain, &mut self.exposed.rgb);
        *generation += 1;
        self.exposed.gain = gain;
        self.exposed.generation = *generation;
    }
}

impl Exposed {
    /// Whether two frames are of the same camera in the same mode.
    pub(crate) fn like(&self, other: &Exposed) -> bool {
        (self.width, self.height, self.scale) == (other.width, other.height, other.scale)
            && self.frame_id == other.frame_id
    }
}
