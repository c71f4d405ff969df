//! The consumer: reads a node's obstacles out of shared memory and says how a drone is to brake.
//!
//! It keeps to three rules. What is occupied ahead and near enough that braking has to begin stops the drone, for good:
//! who stands still sees nothing by parallax, and going on is a pilot's or a planner's decision. What is not seen is not
//! free: where too little ahead is known for a while the drone slows to a walk, and stops if that does not help. And a
//! node that says nothing any more is no sight either.

use std::{error::Error, f64::consts::TAU, time::Duration};

use iceoryx2::{
    node::Node,
    port::{listener::Listener, subscriber::Subscriber},
    prelude::*,
};
use nightflow::{clock::Stamp, motion::SECTORS, publish::shared::ObstaclesSample};

/// [`ObstaclesSample::sector`].
const UNKNOWN: u8 = 0;
const OCCUPIED: u8 = 2;

/// What the drone can do, and how careful it is to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rules {
    /// The drone brakes as hard as this, m/s².
    pub deceleration: f64,
    /// Braking begins so many seconds before it would have to: for what the figures err, and for the room left at the end.
    pub margin_s: f64,
    /// Sectors up to so far from the direction of motion are ahead, radians.
    pub ahead_rad: f64,
    /// The least confidence that a sector is occupied.
    pub confidence: f32,
    /// Sight is enough where at least this part of the sectors ahead is known.
    pub known_part: f64,
    /// Without sight for so many seconds the drone slows to a walk, and for so many it stops. A second is less than the
    /// second and a half by which what was free up to three seconds ahead outlasts the braking.
    pub unseen_s: [f64; 2],
    /// m/s.
    pub walk: f64,
}

impl Default for Rules {
    fn default() -> Self {
        Self {
            deceleration: 3.0,
            margin_s: 1.0,
            ahead_rad: 20_f64.to_radians(),
            confidence: 0.9,
            known_part: 0.3,
            unseen_s: [1.0, 3.0],
            walk: 1.0,
        }
    }
}

/// What the drone is to do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Command {
    /// Fly on.
    Go,
    /// Be no faster than a walk: too little is seen.
    Walk,
    /// Stop, and stay: what is ahead is met in so many seconds (NaN: nothing is seen).
    Stop(f64),
}

/// What was made of the newest sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Judged {
    /// What the drone is to do.
    pub command: Command,
    /// Seconds from the sample's stamp to the first contact ahead.
    pub nearest_s: Option<f64>,
    /// Part of the sectors ahead that is known.
    pub known_part: f64,
}

/// The rules with what they remember.
#[derive(Debug)]
pub struct Brake {
    rules: Rules,
    /// When enough was last seen, or the beginning.
    sighted: Option<Stamp>,
    stopped: Option<f64>,
}

impl Brake {
    /// Remembers nothing yet.
    pub fn new(rules: Rules) -> Brake {
        Brake { rules, sighted: None, stopped: None }
    }

    /// What a drone of this speed (m/s, its autopilot's own estimate) is to do, `now` by the stamps' clock; without a
    /// sample nothing is known.
    pub fn judge(&mut self, sample: Option<&ObstaclesSample>, now: Stamp, speed: f64) -> Judged {
        let ahead: Vec<usize> = sample.map_or(vec![], |sample| self.ahead(sample));
        let sector = |k: &usize| sample.map_or(UNKNOWN, |sample| sample.sector[*k]);
        let known = ahead.iter().filter(|k| sector(k) != UNKNOWN).count();
        let known_part = known as f64 / ahead.len().max(1) as f64;
        let taken = |k: &&usize| {
            sample.is_some_and(|s| s.sector[**k] == OCCUPIED && s.confidence[**k] >= self.rules.confidence)
        };
        let times = ahead.iter().filter(taken).filter_map(|k| sample.map(|sample| f64::from(sample.ttc_s[*k])));
        let nearest_s = times.min_by(f64::total_cmp);

        let sighted = *self.sighted.get_or_insert(now);
        if known_part >= self.rules.known_part {
            self.sighted = sample.map(|sample| Stamp(sample.newer_ns));
        }
        let unseen = now.seconds_since(self.sighted.unwrap_or(sighted));
        // The time that went by since the frame was taken is no longer there to brake in.
        let age = sample.map_or(0.0, |sample| now.seconds_since(Stamp(sample.newer_ns)));
        let needed = speed / (2.0 * self.rules.deceleration) + self.rules.margin_s;
        let [walk, stop] = self.rules.unseen_s;
        match nearest_s.map(|ttc| ttc - age) {
            Some(left) if left < needed => self.stopped = self.stopped.or(Some(left)),
            _ if unseen > stop => self.stopped = self.stopped.or(Some(f64::NAN)),
            _ => {}
        }
        let command = match self.stopped {
            Some(left) => Command::Stop(left),
            None if unseen > walk => Command::Walk,
            None => Command::Go,
        };
        Judged { command, nearest_s, known_part }
    }

    /// The acceleration along the motion that follows a command, m/s², held for `seconds`.
    pub fn acceleration(&self, command: Command, speed: f64, seconds: f64) -> f64 {
        let wanted = match command {
            Command::Go => return 0.0,
            Command::Walk => self.rules.walk,
            Command::Stop(_) => 0.0,
        };
        -((speed - wanted) / seconds).clamp(0.0, self.rules.deceleration)
    }

    /// Sectors around the direction of motion, or around straight ahead where that is not known.
    fn ahead(&self, sample: &ObstaclesSample) -> Vec<usize> {
        let [forward, left, _] = sample.heading;
        let heading = if sample.valid == 1 { left.atan2(forward) } else { 0.0 };
        let off = |k: &usize| {
            let apart = (TAU * *k as f64 / SECTORS as f64 - 0.5 * TAU - heading).rem_euclid(TAU);
            apart.min(TAU - apart)
        };
        (0..SECTORS).filter(|k| off(k) <= self.rules.ahead_rad + 1e-9).collect()
    }
}

/// A running node's obstacles.
pub struct Obstacles {
    // Ports before the node that they live in: they are dropped in this order.
    samples: Subscriber<ipc::Service, ObstaclesSample, ()>,
    wake: Listener<ipc::Service>,
    _node: Node<ipc::Service>,
}

impl Obstacles {
    /// Subscribes to the node with this prefix.
    pub fn open(prefix: &str) -> Result<Obstacles, Box<dyn Error>> {
        set_log_level_from_env_or(LogLevel::Error);
        let node = NodeBuilder::new().create::<ipc::Service>()?;
        let name: ServiceName = format!("{prefix}/obstacles").as_str().try_into()?;
        let samples = node.service_builder(&name).publish_subscribe::<ObstaclesSample>().open();
        let samples = samples.map_err(|error| format!("{name} can't be opened, does a node run there? {error:?}"))?;
        let samples = samples.subscriber_builder().create()?;
        let name: ServiceName = format!("{prefix}/flow").as_str().try_into()?;
        let wake = node.service_builder(&name).event().open()?.listener_builder().create()?;
        Ok(Obstacles { samples, wake, _node: node })
    }

    /// The newest sample, if one came since the last.
    pub fn newest(&self) -> Result<Option<ObstaclesSample>, Box<dyn Error>> {
        let mut newest = None;
        while let Some(sample) = self.samples.receive()? {
            newest = Some(*sample.payload());
        }
        Ok(newest)
    }

    /// Waits until the node has taken a step, or for so long.
    pub fn wait(&self, at_most: Duration) -> Result<(), Box<dyn Error>> {
        Ok(self.wake.timed_wait(|_| {}, at_most).map(|_| ())?)
    }
}
