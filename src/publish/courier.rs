//! What the network sinks share: results are copied on the frame path, and a thread of the sink's own sends them.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    thread::JoinHandle,
};

use super::{
    Config, Error, Offer, Sink,
    outgoing::{self, Kept},
    pace::Pace,
};
use crate::{
    handover::{Giver, Taker, handover},
    wire::{DiagnosticArray, EgoMotion, Image, LaserScan, Status, Step, TwistWithCovarianceStamped},
};

/// Steps that may wait for the network: a quarter of a second at 30 Hz, for results older than that help nobody.
const STEPS_MAX: usize = 8;
const STATUSES_MAX: usize = 4;

/// One message on its way to its topic.
pub(super) enum Message<'a> {
    Velocity(&'a TwistWithCovarianceStamped),
    EgoMotion(&'a EgoMotion),
    Proximity(&'a LaserScan),
    Step(&'a Step),
    Status(&'a Status),
    Diagnostics(&'a DiagnosticArray),
    Flow(&'a Image),
    Confidence(&'a Image),
    Preview(&'a Image),
}

/// The network itself; it lives on the courier's thread.
pub(super) trait Network: Send + 'static {
    fn send(&mut self, message: Message<'_>) -> Result<(), String>;
}

/// The name of each topic.
pub(super) struct Topics {
    pub(super) velocity: String,
    pub(super) ego_motion: String,
    pub(super) proximity: String,
    pub(super) step: String,
    pub(super) status: String,
    pub(super) diagnostics: String,
    pub(super) flow: String,
    pub(super) confidence: String,
    pub(super) preview: String,
}

impl Topics {
    pub(super) fn of(config: &Config) -> Self {
        let under = |name: &str| format!("{}/{name}", config.namespace.trim_end_matches('/'));
        Self {
            velocity: under("velocity"),
            ego_motion: under("ego_motion"),
            proximity: under("proximity"),
            step: under("step"),
            status: under("status"),
            // ROS 2 gathers the diagnostics of all nodes on this topic.
            diagnostics: "/diagnostics".into(),
            flow: under("flow"),
            confidence: under("flow_confidence"),
            preview: under("flow_preview"),
        }
    }
}

/// Hands results to the thread that sends them, and never waits for it.
pub struct Courier {
    name: &'static str,
    body_frame: String,
    images: Option<Pace>,
    orders: Option<Giver<Order>>,
    /// Parcels come back here, so that a step allocates nothing.
    spare: Taker<Box<Parcel>>,
    lost: u64,
    unsent: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

enum Order {
    Step(Box<Parcel>),
    Status(Box<Status>),
}

/// One step's results.
#[derive(Default)]
struct Parcel {
    step: Step,
    velocity: TwistWithCovarianceStamped,
    has_velocity: bool,
    motion: EgoMotion,
    has_motion: bool,
    proximity: LaserScan,
    has_proximity: bool,
    flow: Kept,
    has_flow: bool,
}

impl Courier {
    pub(super) fn open(name: &'static str, config: &Config, network: impl Network) -> Result<Self, Error> {
        let (orders, ordered) = handover(STEPS_MAX + STATUSES_MAX);
        let (mut emptied, spare) = handover(STEPS_MAX);
        for _ in 0..STEPS_MAX {
            // There is room for as many as there are.
            let _ = emptied.try_give(Box::default());
        }
        let unsent = Arc::new(AtomicU64::new(0));
        let round = Round { network, name, unsent: unsent.clone(), told: false, image: Image::default() };
        let thread = std::thread::Builder::new()
            .name(format!("publish-{name}"))
            .spawn(move || round.run(ordered, emptied))
            .map_err(|e| Error::Open { sink: name, reason: e.to_string() })?;
        Ok(Self {
            name,
            body_frame: config.body_frame.clone(),
            images: (config.image_hz_max > 0.0).then(|| Pace::new(config.image_hz_max)),
            orders: Some(orders),
            spare,
            lost: 0,
            unsent,
            thread: Some(thread),
        })
    }

    fn order(&mut self, order: Order) -> Result<(), ()> {
        self.orders.as_mut().ok_or(())?.try_give(order).map_err(|_| ())
    }

    fn full(&self, what: String) -> Error {
        let reason = match self.orders {
            Some(_) => format!("the network is behind by {STEPS_MAX} steps"),
            None => "the sink is finished".into(),
        };
        Error::Lost { sink: self.name, what, reason }
    }
}

impl Sink for Courier {
    fn name(&self) -> &'static str {
        self.name
    }

    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), Error> {
        let moved = offer.moved;
        let Ok(mut parcel) = self.spare.try_take() else {
            self.lost += 1;
            return Err(self.full(format!("step {}", moved.step)));
        };
        outgoing::fill_step(moved, &mut parcel.step);
        parcel.has_velocity = outgoing::fill_twist(moved, &self.body_frame, &mut parcel.velocity);
        parcel.has_motion = outgoing::fill_ego_motion(moved, &self.body_frame, &mut parcel.motion);
        parcel.has_proximity = outgoing::fill_proximity(moved, &self.body_frame, &mut parcel.proximity);
        parcel.has_flow = self.images.as_mut().is_some_and(|images| images.lets(moved.newer));
        if parcel.has_flow {
            parcel.flow.keep(offer);
        }
        self.order(Order::Step(parcel)).map_err(|()| {
            self.lost += 1;
            self.full(format!("step {}", moved.step))
        })
    }

    fn status(&mut self, status: &Status) -> Result<(), Error> {
        self.order(Order::Status(Box::new(status.clone()))).map_err(|()| self.full("a status".into()))
    }

    /// Sends what waits and ends the thread.
    fn finish(&mut self) -> Result<(), Error> {
        self.orders = None;
        let Some(thread) = self.thread.take() else { return Ok(()) };
        thread.join().map_err(|_| Error::Lost {
            sink: self.name,
            what: "what still waited".into(),
            reason: "its thread panicked".into(),
        })
    }

    /// Steps that found no room, and steps of which something could not be sent.
    fn lost(&self) -> u64 {
        self.lost + self.unsent.load(Ordering::Relaxed)
    }
}

impl Drop for Courier {
    fn drop(&mut self) {
        if let Err(why) = self.finish() {
            tracing::warn!("{why}");
        }
    }
}

/// What runs on the thread.
struct Round<N> {
    network: N,
    name: &'static str,
    unsent: Arc<AtomicU64>,
    told: bool,
    image: Image,
}

impl<N: Network> Round<N> {
    fn run(mut self, mut orders: Taker<Order>, mut emptied: Giver<Box<Parcel>>) {
        while let Some(order) = orders.take() {
            match order {
                Order::Step(parcel) => {
                    let sent = self.step(&parcel);
                    self.unsent.fetch_add(u64::from(sent.is_err()), Ordering::Relaxed);
                    self.tell(sent);
                    let _ = emptied.try_give(parcel);
                }
                Order::Status(status) => {
                    let sent = self.network.send(Message::Status(&status));
                    let diagnosed = self.network.send(Message::Diagnostics(&outgoing::diagnostics(&status)));
                    self.tell(sent.and(diagnosed));
                }
            }
        }
    }

    fn step(&mut self, parcel: &Parcel) -> Result<(), String> {
        let network = &mut self.network;
        // The velocity first: someone steers by it.
        if parcel.has_velocity {
            network.send(Message::Velocity(&parcel.velocity))?;
        }
        if parcel.has_proximity {
            network.send(Message::Proximity(&parcel.proximity))?;
        }
        if parcel.has_motion {
            network.send(Message::EgoMotion(&parcel.motion))?;
        }
        network.send(Message::Step(&parcel.step))?;
        if parcel.has_flow {
            let (frame_id, flow) = (parcel.flow.frame_id.as_str(), parcel.flow.flow());
            outgoing::flow_image(frame_id, &flow, &mut self.image);
            network.send(Message::Flow(&self.image))?;
            outgoing::confidence_image(frame_id, &flow, &mut self.image);
            network.send(Message::Confidence(&self.image))?;
            outgoing::preview(frame_id, &flow, &mut self.image);
            network.send(Message::Preview(&self.image))?;
        }
        Ok(())
    }

    /// The first of a series of failures is told, so that a network that is down for an hour fills no disk.
    fn tell(&mut self, sent: Result<(), String>) {
        if let Err(why) = &sent
            && !self.told
        {
            tracing::warn!("{} can't send: {why}", self.name);
        }
        self.told = sent.is_err();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{self, Receiver};

    use super::*;
    use crate::{
        clock::Stamp,
        exposure::Exposed,
        flow,
        motion::{Integrated, Lack, NoFlow, NoSight},
        publish::Moved,
    };

    /// A network that stands still until it is told to go on.
    struct Stuck {
        go_on: Receiver<()>,
        sent: mpsc::Sender<u64>,
    }

    impl Network for Stuck {
        fn send(&mut self, message: Message<'_>) -> Result<(), String> {
            if let Message::Step(step) = message {
                let _ = self.go_on.recv();
                let _ = self.sent.send(step.step);
                return if step.step == 2 { Err("unplugged".into()) } else { Ok(()) };
            }
            Ok(())
        }
    }

    #[test]
    fn a_network_that_stands_still_costs_steps_and_no_time() {
        let (going, go_on) = mpsc::channel();
        let (sent, arrived) = mpsc::channel();
        let mut courier = Courier::open("test", &Config::default(), Stuck { go_on, sent }).unwrap();
        let exposed = Exposed::default();
        let taken = (0..20).filter(|step| {
            let moved = moved(*step);
            let flow =
                flow::Flow { older: moved.older, newer: moved.newer, grid: moved.grid, vectors: &[], confidence: &[] };
            courier.offer(&Offer { moved: &moved, flow, image: &exposed }).is_ok()
        });
        assert_eq!(taken.count(), STEPS_MAX);
        assert_eq!(courier.lost(), 20 - STEPS_MAX as u64);
        drop(going);
        courier.finish().unwrap();
        assert_eq!(arrived.iter().collect::<Vec<_>>(), (0..STEPS_MAX as u64).collect::<Vec<_>>());
        assert_eq!(courier.lost(), 20 - STEPS_MAX as u64 + 1, "the step that could not be sent counts too");
    }

    fn moved(step: u64) -> Moved {
        Moved {
            step,
            older: Stamp::from_ns(0),
            newer: Stamp::from_ns(1),
            frame_id: "camera".into(),
            camera_size: [0; 2],
            grid: flow::Grid::default(),
            gain: 1.0,
            raw_mean: 0.0,
            noise: None,
            noise_level: None,
            saturated_part: 0.0,
            confidence: 0.0,
            state: flow::State::Ok,
            velocity: Err(Lack::Gyro),
            integrated: Integrated::without(Stamp::from_ns(0), Stamp::from_ns(1), NoFlow::Blind),
            obstacles: Err(NoSight::Off),
        }
    }
}
