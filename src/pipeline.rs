//! The road in one screen: a frame is developed, paired, and becomes flow and velocity. Live and replay call this.

use std::sync::Arc;

use crate::{
    camera::{Frame, Sample},
    clock::{Laps, Stage, Stamp},
    config::Config,
    exposure::{self, Developer, Exposed},
    flow::{self, Lender, Matcher, Resolution, State},
    motion::{self, Diagnosis, Lack, Lookout, NoSight, Odometer},
    publish::Moved,
};

/// The three stages between camera and sinks, and what they remember from one frame to the next.
pub struct Pipeline {
    exposure: Developer,
    flow: Matcher,
    motion: Odometer,
    lookout: Option<Lookout>,
    gap_ms_max: f64,
    newest: Option<Stamp>,
    steps: u64,
}

/// What became of a sample.
// Boxing the large variant would allocate on every step.
#[allow(clippy::large_enum_variant)]
#[derive(Debug)]
pub enum Outcome {
    /// A frame met its partner.
    Moved(Moved),
    /// A frame has no partner: it is the first, or the first after a gap.
    Unpaired,
    /// Not a frame; it was noted.
    Noted,
}

/// Why a sample was refused. Each spoils that sample alone, and the next one is tried.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The frame can't be developed.
    #[error(transparent)]
    Exposure(#[from] exposure::Error),
    /// The network failed on this pair.
    #[error(transparent)]
    Flow(#[from] flow::Error),
    /// A gyro, range or calibration sample makes no sense.
    #[error(transparent)]
    Motion(#[from] motion::Error),
    /// The frame's stamp is not after the one before; pairing starts anew.
    #[error("the camera's clock went back: expected a stamp after {newest}, this frame has {came}")]
    ClockBack {
        /// Of the frame before.
        newest: Stamp,
        /// Of this frame.
        came: Stamp,
    },
}

impl Error {
    /// The counter that this refusal belongs to.
    pub fn cause(&self) -> &'static str {
        match self {
            Error::Exposure(_) => "exposure",
            Error::Flow(_) => "flow",
            Error::Motion(_) => "motion",
            Error::ClockBack { .. } => "clock",
        }
    }
}

impl Pipeline {
    /// Opens the network and readies every stage.
    pub fn open(config: &Config) -> Result<Self, Error> {
        Self::with(config, Matcher::open(&config.flow)?)
    }

    /// The same with a network that is already open.
    pub fn with(config: &Config, flow: Matcher) -> Result<Self, Error> {
        let mut motion = config.motion.clone();
        // A cell at full resolution is a quarter of the cell that the setting is about.
        motion.flow_shared_sd_cells *= match config.flow.resolution {
            Resolution::Quarter => 1.0,
            Resolution::Full => 4.0,
        };
        Ok(Self {
            exposure: Developer::new(&config.exposure)?,
            flow,
            motion: Odometer::new(&motion)?.exposing(config.camera.exposure_s).standing_in(&config.publish.body_frame),
            lookout: motion.obstacles.as_ref().map(Lookout::new).transpose()?,
            gap_ms_max: config.flow.gap_ms_max,
            newest: None,
            steps: 0,
        })
    }

    /// One sample's way. The flow is written into what `lender` lends and stays there until the next call.
    pub fn step(&mut self, sample: &Sample, lender: &mut dyn Lender, laps: &mut dyn Laps) -> Result<Outcome, Error> {
        match sample {
            Sample::Frame(frame) => self.frame(frame, lender, laps),
            Sample::Info(info) => Ok(self.motion.info(info).map(|()| Outcome::Noted)?),
            Sample::Imu(imu) => Ok(self.motion.imu(imu).map(|()| Outcome::Noted)?),
            Sample::Range(range) => Ok(self.motion.range(range).map(|()| Outcome::Noted)?),
            Sample::Width(width) => {
                self.exposure.set_width(width.columns as usize);
                Ok(Outcome::Noted)
            }
            Sample::Transforms(message) => Ok(self.motion.transforms(message).map(|()| Outcome::Noted)?),
        }
    }

    fn frame(&mut self, frame: &Frame, lender: &mut dyn Lender, laps: &mut dyn Laps) -> Result<Outcome, Error> {
        self.follow(frame.stamp())?;
        self.exposure.develop(frame)?;
        let Some(pair) = self.exposure.pair() else { return Ok(Outcome::Unpaired) };
        laps.lap(Stage::Exposure);
        let flow = self.flow.between(&pair, lender)?;
        let (state, confidence) = self.flow.judge(&pair, &flow);
        laps.lap(Stage::Flow);
        let camera_size = [frame.image.width, frame.image.height];
        let velocity = match state {
            State::Blind(_) => Err(Lack::Blind),
            _ => self.motion.velocity(&flow, camera_size),
        };
        let integrated = self.motion.integrated(&flow, camera_size, matches!(state, State::Blind(_)));
        let obstacles = match (&mut self.lookout, &state) {
            (None, _) => Err(NoSight::Off),
            (Some(_), State::Blind(_)) => Err(NoSight::Lack(Lack::Blind)),
            (Some(lookout), _) => lookout.look(&self.motion, &flow, camera_size, pair.older, &velocity),
        };
        laps.lap(Stage::Motion);
        let moved = Moved {
            step: self.steps,
            older: pair.older.stamp,
            newer: pair.newer.stamp,
            frame_id: Arc::clone(&pair.newer.frame_id),
            camera_size,
            grid: flow.grid,
            gain: pair.newer.gain,
            raw_mean: pair.newer.raw_mean,
            noise: pair.newer.noise,
            noise_level: pair.newer.noise_level,
            saturated_part: pair.newer.saturated_part,
            confidence,
            state,
            velocity,
            integrated,
            obstacles,
        };
        self.steps += 1;
        Ok(Outcome::Moved(moved))
    }

    /// Pairs only what belongs together: stamps that rise, and by no more than the gap allowed.
    fn follow(&mut self, came: Stamp) -> Result<(), Error> {
        if let Some(newest) = self.newest.replace(came).filter(|newest| came <= *newest) {
            self.exposure.forget();
            return Err(Error::ClockBack { newest, came });
        }
        // The partner is the frame before that could be developed, which a refused frame may have moved further away.
        let partner = self.exposure.newest().map(|older| came.seconds_since(older.stamp));
        if partner.is_some_and(|gap_s| gap_s * 1e3 > self.gap_ms_max) {
            self.exposure.forget();
        }
        Ok(())
    }

    /// The newest developed frame, for previews.
    pub fn image(&self) -> Option<&Exposed> {
        self.exposure.newest()
    }

    /// What looks for obstacles, where it is asked to.
    pub fn lookout(&self) -> Option<&Lookout> {
        self.lookout.as_ref()
    }

    /// What camera and gyro disagree on, if they do beyond doubt.
    pub fn diagnosis(&self) -> Option<Diagnosis> {
        self.motion.diagnosis()
    }

    /// The network that runs.
    pub fn network(&self) -> &Matcher {
        &self.flow
    }
}
