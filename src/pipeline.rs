//! The road in one screen: a frame is developed, paired, and becomes flow and velocity. Live and replay call this.

use std::sync::Arc;

use crate::{
    camera::{Frame, Sample},
    clock::{Laps, Stage, Stamp},
    config::Config,
    exposure::{self, Exposed, Linear, Linearizer, Pair, Pairing},
    flow::{self, Grid, Keyframe, Lender, Matcher, Resolution, State},
    motion::{self, Diagnosis, Keeping, Lack, Lookout, NoSight, Odometer, Velocity},
    publish::Moved,
};

/// The three stages between camera and sinks, and what they remember from one frame to the next.
///
/// It is cut where nothing is told backwards: [`Front`] reads each frame's bytes, [`Back`] does the rest. One after the other,
/// as in [`Pipeline::step`], or beside each other, as in the node: if both see the same samples in the same order, the results
/// are the same.
pub struct Pipeline {
    front: Front,
    back: Back,
}

/// What can be done for a frame while those before it are still on their way.
pub struct Front {
    linearizer: Linearizer,
    newest: Option<Stamp>,
}

/// Everything from two linear frames to results.
pub struct Back {
    exposure: Pairing,
    flow: Matcher,
    /// Where hovers are looked at over more than a step.
    key: Option<Keyframe>,
    motion: Odometer,
    lookout: Option<Lookout>,
    gap_ms_max: f64,
    steps: u64,
}

/// What the front makes of a frame: one that is linear, or why it can't be made so. Of other samples it makes nothing.
pub type Read = Option<Result<Linear, Error>>;

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
            Resolution::Full | Resolution::Bilinear => 4.0,
        };
        let keeps = config.flow.refine && config.flow.resolution == Resolution::Quarter;
        let back = Back {
            exposure: Pairing::new(&config.exposure)?,
            flow,
            key: keeps.then(Keyframe::default),
            motion: Odometer::new(&motion)?.exposing(config.camera.exposure_s).standing_in(&config.publish.body_frame),
            lookout: motion.obstacles.as_ref().map(Lookout::new).transpose()?,
            gap_ms_max: config.flow.gap_ms_max,
            steps: 0,
        };
        Ok(Self { front: Front { linearizer: Linearizer::new(&config.exposure)?, newest: None }, back })
    }

    /// One sample's way. The flow is written into what `lender` lends and stays there until the next call.
    pub fn step(&mut self, sample: &Sample, lender: &mut dyn Lender, laps: &mut dyn Laps) -> Result<Outcome, Error> {
        let read = self.front.read(sample);
        self.back.step(sample, read, &mut |spare| self.front.reuse(spare), lender, laps)
    }

    /// The two halves, for who lets them run beside each other.
    pub fn halves(&mut self) -> (&mut Front, &mut Back) {
        (&mut self.front, &mut self.back)
    }

    /// The newest developed frame, for previews.
    pub fn image(&self) -> Option<&Exposed> {
        self.back.image()
    }

    /// What looks for obstacles, where it is asked to.
    pub fn lookout(&self) -> Option<&Lookout> {
        self.back.lookout.as_ref()
    }

    /// The network that runs.
    pub fn network(&self) -> &Matcher {
        &self.back.flow
    }
}

impl Front {
    /// Makes a frame linear, and takes note of what concerns the frames after it.
    pub fn read(&mut self, sample: &Sample) -> Read {
        match sample {
            Sample::Frame(frame) => Some(self.frame(frame)),
            Sample::Width(width) => {
                self.linearizer.set_width(width.columns as usize);
                None
            }
            _ => None,
        }
    }

    fn frame(&mut self, frame: &Frame) -> Result<Linear, Error> {
        let came = frame.stamp();
        if let Some(newest) = self.newest.replace(came).filter(|newest| came <= *newest) {
            return Err(Error::ClockBack { newest, came });
        }
        Ok(self.linearizer.read(frame)?)
    }

    /// Takes back the memory of a frame: see [`Back::step`].
    pub fn reuse(&mut self, spare: Linear) {
        self.linearizer.reuse(spare);
    }

    /// The stamp of the newest frame that came.
    pub fn newest(&self) -> Option<Stamp> {
        self.newest
    }
}

impl Back {
    /// What the front has read goes on. `spare` is given the memory of a frame that is needed no longer, for every frame that
    /// was read, before the network runs. The flow is written into what `lender` lends and stays there until the next call.
    pub fn step(
        &mut self,
        sample: &Sample,
        read: Read,
        spare: &mut dyn FnMut(Linear),
        lender: &mut dyn Lender,
        laps: &mut dyn Laps,
    ) -> Result<Outcome, Error> {
        match (sample, read) {
            (Sample::Frame(frame), Some(read)) => {
                self.follow(frame.stamp(), &read);
                spare(self.exposure.take(read?));
                self.frame([frame.image.width, frame.image.height], lender, laps)
            }
            (Sample::Info(info), _) => Ok(self.motion.info(info).map(|()| Outcome::Noted)?),
            (Sample::Imu(imu), _) => Ok(self.motion.imu(imu).map(|()| Outcome::Noted)?),
            (Sample::Range(range), _) => Ok(self.motion.range(range).map(|()| Outcome::Noted)?),
            (Sample::Transforms(message), _) => Ok(self.motion.transforms(message).map(|()| Outcome::Noted)?),
            (Sample::Width(_), _) | (Sample::Frame(_), None) => Ok(Outcome::Noted),
        }
    }

    /// Pairs only what belongs together: stamps that rise, and by no more than the gap allowed.
    fn follow(&mut self, came: Stamp, read: &Result<Linear, Error>) {
        match read {
            Err(Error::ClockBack { .. }) => self.exposure.forget(),
            // The partner is the frame before that could be developed, which a refused frame may have moved further away.
            _ => self.exposure.forget_before(came, self.gap_ms_max),
        }
    }

    /// The newest developed frame, for previews.
    pub fn image(&self) -> Option<&Exposed> {
        self.exposure.newest()
    }

    /// What camera and gyro disagree on, if they do beyond doubt.
    pub fn diagnosis(&self) -> Option<Diagnosis> {
        self.motion.diagnosis()
    }

    fn frame(&mut self, camera_size: [u32; 2], lender: &mut dyn Lender, laps: &mut dyn Laps) -> Result<Outcome, Error> {
        let Some(pair) = self.exposure.pair() else { return Ok(Outcome::Unpaired) };
        laps.lap(Stage::Exposure);
        let flow = self.flow.between(&pair, lender)?;
        let (state, confidence) = self.flow.judge(&pair, &flow);
        laps.lap(Stage::Flow);
        let velocity = match state {
            State::Blind(_) => Err(Lack::Blind),
            _ => self.motion.velocity_with(&flow, self.flow.gradients(), camera_size),
        };
        look_back(&mut self.motion, self.key.as_mut(), &pair, velocity.as_ref().ok(), camera_size);
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
}

/// Keeps a frame of a hover, and compares the newest with it, as the newest velocity asks for.
fn look_back(
    motion: &mut Odometer,
    key: Option<&mut Keyframe>,
    pair: &Pair<'_>,
    velocity: Option<&Velocity>,
    camera_size: [u32; 2],
) {
    let (Some(key), Some(velocity)) = (key, velocity) else { return motion.let_go() };
    match motion.keep(velocity) {
        Keeping::Keep => key.keep(pair.newer),
        Keeping::Compare => {
            let expect = &mut |grid: &Grid, vectors: &mut Vec<f32>| motion.expect(grid, camera_size, vectors);
            match key.flow(pair.newer, expect) {
                Some((flow, gradients)) => motion.look_back(&flow, &gradients, camera_size),
                None => motion.let_go(),
            }
        }
        Keeping::Wait => {}
    }
}
