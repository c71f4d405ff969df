//! What the autopilot sinks share: a step's few numbers are copied on the frame path, and a thread of the sink's own
//! says them.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use super::{
    super::{Error, Offer, Sink},
    ring::Ring,
};
use crate::{
    flow::State,
    handover::{Giver, Nothing, Taker, handover},
    motion::{Integrated, Scale, Velocity},
};

/// Steps that may wait: a quarter of a second at 30 Hz, for an autopilot has no use for older ones.
const MOMENTS_MAX: usize = 8;
/// How often a voice may look after its line while no step comes.
const TEND: Duration = Duration::from_millis(100);

/// What an autopilot is told of one step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moment {
    pub(super) integrated: Integrated,
    /// Metric and trusted, or none.
    pub(super) velocity: Option<Velocity>,
    /// None where nobody looks for obstacles, or this autopilot is not told of them.
    pub(super) ring: Option<Ring>,
}

/// What speaks to an autopilot; it lives on the feed's thread.
pub(super) trait Voice: Send + 'static {
    /// Centimetres up to which it tells of obstacles; none where it tells of none.
    fn reach_cm(&self) -> Option<u16> {
        None
    }
    /// Says what is due after this step.
    fn say(&mut self, moment: &Moment) -> Result<(), String>;
    /// Called after every step, and while none comes.
    fn tend(&mut self) -> Result<(), String> {
        Ok(())
    }
}

/// Hands steps to the thread that speaks, and never waits for it.
pub struct Feed {
    name: &'static str,
    reach_cm: Option<u16>,
    moments: Option<Giver<Moment>>,
    lost: u64,
    unsaid: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Feed {
    pub(super) fn open(name: &'static str, voice: impl Voice) -> Result<Self, Error> {
        let (moments, heard) = handover(MOMENTS_MAX);
        let reach_cm = voice.reach_cm();
        let unsaid = Arc::new(AtomicU64::new(0));
        let round = Round { voice, name, unsaid: unsaid.clone(), told: false };
        let thread = std::thread::Builder::new()
            .name(format!("publish-{name}"))
            .spawn(move || round.run(heard))
            .map_err(|e| Error::Open { sink: name, reason: e.to_string() })?;
        Ok(Self { name, reach_cm, moments: Some(moments), lost: 0, unsaid, thread: Some(thread) })
    }
}

impl Sink for Feed {
    fn name(&self) -> &'static str {
        self.name
    }

    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), Error> {
        let moved = offer.moved;
        let trusted = |velocity: &&Velocity| {
            matches!(velocity.scale, Scale::Metric { .. }) && !matches!(moved.state, State::Blind(_))
        };
        let velocity = moved.velocity.as_ref().ok().filter(trusted).copied();
        let ring = self.reach_cm.and_then(|max_cm| Ring::of(moved, max_cm));
        let moment = Moment { integrated: moved.integrated, velocity, ring };
        let reason = match self.moments.as_mut().map(|moments| moments.try_give(moment).is_ok()) {
            Some(true) => return Ok(()),
            Some(false) => format!("the line is behind by {MOMENTS_MAX} steps"),
            None => "the sink is finished".into(),
        };
        self.lost += 1;
        Err(Error::Lost { sink: self.name, what: format!("step {}", moved.step), reason })
    }

    /// Says what waits and ends the thread.
    fn finish(&mut self) -> Result<(), Error> {
        self.moments = None;
        let Some(thread) = self.thread.take() else { return Ok(()) };
        thread.join().map_err(|_| Error::Lost {
            sink: self.name,
            what: "what still waited".into(),
            reason: "its thread panicked".into(),
        })
    }

    /// Steps that found no room, and steps of which something could not be said.
    fn lost(&self) -> u64 {
        self.lost + self.unsaid.load(Ordering::Relaxed)
    }
}

impl Drop for Feed {
    fn drop(&mut self) {
        if let Err(why) = self.finish() {
            tracing::warn!("{why}");
        }
    }
}

/// What runs on the thread.
struct Round<V> {
    voice: V,
    name: &'static str,
    unsaid: Arc<AtomicU64>,
    told: bool,
}

impl<V: Voice> Round<V> {
    fn run(mut self, mut moments: Taker<Moment>) {
        loop {
            let said = match moments.take_timeout(TEND) {
                Ok(moment) => {
                    let said = self.voice.say(&moment);
                    self.unsaid.fetch_add(u64::from(said.is_err()), Ordering::Relaxed);
                    said
                }
                Err(Nothing::Yet) => Ok(()),
                Err(Nothing::AnyMore) => return,
            };
            let tended = self.voice.tend();
            self.tell(said.and(tended));
        }
    }

    /// The first of a series of failures is told, so that a line that is down for an hour fills no disk.
    fn tell(&mut self, said: Result<(), String>) {
        if let Err(why) = &said
            && !self.told
        {
            tracing::warn!("{} can't send: {why}", self.name);
        }
        self.told = said.is_err();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{self, Receiver};

    use super::*;
    use crate::{
        clock::Stamp,
        exposure::Exposed,
        flow::{Flow, Grid},
        motion::{Lack, NoFlow, NoSight},
        publish::Moved,
    };

    /// A line that stands still until it is told to go on.
    struct Stuck {
        go_on: Receiver<()>,
        said: mpsc::Sender<i64>,
    }

    impl Voice for Stuck {
        fn say(&mut self, moment: &Moment) -> Result<(), String> {
            let _ = self.go_on.recv();
            let step = moment.integrated.older.ns();
            let _ = self.said.send(step);
            if step == 2 { Err("unplugged".into()) } else { Ok(()) }
        }
    }

    #[test]
    fn a_line_that_stands_still_costs_steps_and_no_time() {
        let (going, go_on) = mpsc::channel();
        let (said, arrived) = mpsc::channel();
        let mut feed = Feed::open("test", Stuck { go_on, said }).unwrap();
        let taken = (0..20).filter(|step| offer(&mut feed, *step)).count();
        // One may be on the thread already.
        assert!((MOMENTS_MAX..=MOMENTS_MAX + 1).contains(&taken), "{taken} steps were taken");
        assert_eq!(feed.lost(), 20 - taken as u64);
        drop(going);
        feed.finish().unwrap();
        assert_eq!(arrived.iter().count(), taken);
        assert_eq!(feed.lost(), 20 - taken as u64 + 1, "the step that could not be said counts too");
        assert!(!offer(&mut feed, 20), "a finished sink takes nothing");
    }

    fn offer(feed: &mut Feed, step: u64) -> bool {
        let (older, newer) = (Stamp::from_ns(step as i64), Stamp::from_ns(step as i64 + 1));
        let grid = Grid::default();
        let moved = Moved {
            step,
            older,
            newer,
            frame_id: "camera".into(),
            camera_size: [0; 2],
            grid,
            gain: 1.0,
            raw_mean: 0.0,
            noise: None,
            noise_level: None,
            saturated_part: 0.0,
            confidence: 0.0,
            state: State::Ok,
            velocity: Err(Lack::Gyro),
            integrated: Integrated::without(older, newer, NoFlow::Blind),
            obstacles: Err(NoSight::Off),
        };
        let flow = Flow { older, newer, grid, vectors: &[], confidence: &[] };
        feed.offer(&Offer { moved: &moved, flow, image: &Exposed::default() }).is_ok()
    }
}
