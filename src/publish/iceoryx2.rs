//! Shared memory on this machine: the network writes flow where its readers read it.

use std::fmt::Debug;

use ::iceoryx2::{
    node::{Node, NodeBuilder},
    port::{LoanError, notifier::Notifier, publisher::Publisher, update_connections::UpdateConnections},
    prelude::{
        AllocationStrategy, EventId, LogLevel, ServiceName, SignalHandlingMode, ZeroCopySend, set_log_level_from_env_or,
    },
    sample_mut::SampleMut,
    service::ipc_threadsafe::Service,
};

use super::{
    Config, Error, Iceoryx2, Moved, Offer, Sink,
    shared::{FlowHeader, ObstaclesSample, StatusSample, VelocitySample},
};
use crate::{
    clock,
    flow::{Canvas, Grid, Lender, Own},
    wire,
};

/// Samples that wait for a reader; the older gives way.
const BUFFER: usize = 2;
/// Samples that one reader may hold.
const BORROWED: usize = 2;
/// What a reader gets at once when it comes.
const HISTORY: usize = 1;
/// Beside the payload, a sample holds iceoryx2's header, ours, and what aligning them costs.
const SAMPLE_EXTRA: usize = 256;
/// Services, connections, queues and the small samples: measured as 0.1 MB with four readers of flow and confidence.
const FIXED_BYTES: u64 = 1 << 20;

/// The event that follows a step; a status follows with [`STATUS_EVENT`].
pub const STEP_EVENT: usize = 0;
/// The event that follows a status.
pub const STATUS_EVENT: usize = 1;

type Loan = SampleMut<Service, [f32], FlowHeader>;
type Floats = Publisher<Service, [f32], FlowHeader>;

/// Names the five services under a prefix: `<prefix>/flow` and so on.
pub fn service_name(prefix: &str, name: &str) -> Result<ServiceName, Error> {
    let full = format!("{}/{name}", prefix.trim_end_matches('/'));
    ServiceName::new(&full).map_err(|e| refused(format!("{full:?} can't be the name of a service: {e:?}")))
}

/// How many samples the flow's memory must hold. All readers wait for the same [`BUFFER`] newest samples, and each may
/// hold [`BORROWED`] older ones; one is being written. iceoryx2 itself counts the waiting ones for each reader anew.
fn samples(subscribers: usize) -> usize {
    subscribers * BORROWED + BUFFER.max(HISTORY) + 1
}

/// Bytes of shared memory that flow and confidence of `cells` cells ask for.
pub fn bytes_needed(cells: usize, subscribers: usize) -> u64 {
    let flow = cells * 2 * size_of::<f32>() + SAMPLE_EXTRA;
    let confidence = cells * size_of::<f32>() + SAMPLE_EXTRA;
    ((flow + confidence) * samples(subscribers)) as u64 + FIXED_BYTES
}

/// The sink, which also lends its memory to the network.
///
/// [`Lender::lend`] loans one sample for the flow and one for the confidence; [`SharedSink::send`] fills in their
/// headers and hands exactly that memory to the readers. When readers hold every sample, or the flow has more cells
/// than there is room for, memory of our own is lent instead: the step goes on, and its sending is lost and counted.
pub struct SharedSink {
    // Ports before the node that they live in: they are dropped in this order.
    lent: Option<(Loan, Loan)>,
    own: Own,
    refusal: Option<String>,
    flow: Floats,
    confidence: Floats,
    velocity: Publisher<Service, VelocitySample, ()>,
    obstacles: Publisher<Service, ObstaclesSample, ()>,
    status: Publisher<Service, StatusSample, ()>,
    wake: Notifier<Service>,
    _node: Node<Service>,
    cells_max: usize,
    displaced: u64,
    lost: u64,
    copied: u64,
}

impl SharedSink {
    /// Opens the services, cleaning up what a killed predecessor left, and checks first that the memory is there: too
    /// little of it would end the program with SIGBUS in the middle of a step.
    pub fn open(_config: &Config, settings: &Iceoryx2) -> Result<Self, Error> {
        set_log_level_from_env_or(LogLevel::Error);
        Self::open_on(NodeBuilder::new(), settings, samples(settings.subscribers_max), free_bytes)
    }

    fn open_on(
        node: NodeBuilder,
        settings: &Iceoryx2,
        samples: usize,
        free: impl FnOnce() -> Option<u64>,
    ) -> Result<Self, Error> {
        // Creating a node frees what dead nodes left behind, so the room is asked for after it.
        let node = node
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Service>()
            .map_err(|e| refused(format!("{e:?}")))?;
        let needed = bytes_needed(settings.cells_max, settings.subscribers_max);
        if let Some(free) = free().filter(|free| *free < needed) {
            return Err(Error::SharedMemory { free, needed, cells: settings.cells_max });
        }
        let floats = |name: &str, length: usize| floats(&node, settings, name, length, samples);
        let flow = floats("flow", settings.cells_max * 2)?;
        let confidence = floats("confidence", settings.cells_max)?;
        let velocity = plain::<VelocitySample>(&node, settings, "velocity")?;
        let obstacles = plain::<ObstaclesSample>(&node, settings, "obstacles")?;
        let status = plain::<StatusSample>(&node, settings, "status")?;
        let wake = node
            .service_builder(&service_name(&settings.prefix, "flow")?)
            .event()
            .open_or_create()
            .map_err(|e| unopened(settings, "flow (event)", &e))?
            .notifier_builder()
            .default_event_id(EventId::new(STEP_EVENT))
            .create()
            .map_err(|e| unopened(settings, "flow (event)", &e))?;
        Ok(Self {
            lent: None,
            own: Own::default(),
            refusal: None,
            flow,
            confidence,
            velocity,
            obstacles,
            status,
            wake,
            _node: node,
            cells_max: settings.cells_max,
            displaced: 0,
            lost: 0,
            copied: 0,
        })
    }

    /// This sink as the one who lends memory for a step's flow.
    pub fn lender(&mut self) -> &mut dyn Lender {
        self
    }

    /// Tells how many frames were displaced so far; the header carries it.
    pub fn displaced(&mut self, frames: u64) {
        self.displaced = frames;
    }

    /// Steps whose vectors had to be copied, because they did not lie in lent memory.
    pub fn copied(&self) -> u64 {
        self.copied
    }

    /// Sends what was last lent, with the step's header, and its velocity. The flow goes last, so that a reader who has
    /// it finds all else of the step there; a step whose vectors can't be sent still tells its velocity.
    pub fn send(&mut self, moved: &Moved) -> Result<(), Error> {
        let header = self.header(moved);
        let told = self.send_velocity(moved, header.published_ns).and(self.send_obstacles(moved, header.published_ns));
        let sent = self.send_lent(moved, &header).map_err(|reason| {
            self.lost += 1;
            Error::Lost { sink: "iceoryx2", what: format!("the flow of step {}", moved.step), reason }
        });
        // Who comes late gets the newest status without waiting for the next one.
        let _ = self.status.update_connections();
        self.wake(STEP_EVENT);
        sent.and(told)
    }

    fn send_lent(&mut self, moved: &Moved, header: &FlowHeader) -> Result<(), String> {
        let Some((mut flow, mut confidence)) = self.lent.take() else {
            return Err(self.refusal.take().unwrap_or_else(|| "nothing was lent".into()));
        };
        let (lent, cells) = (flow.payload().len() / 2, moved.grid.cells());
        if lent != cells {
            return Err(format!("{lent} cells were lent, the flow has {cells}"));
        }
        *flow.user_header_mut() = *header;
        *confidence.user_header_mut() = *header;
        confidence.send().and_then(|_| flow.send()).map(|_| ()).map_err(|error| format!("{error:?}"))
    }

    fn header(&self, moved: &Moved) -> FlowHeader {
        FlowHeader {
            published_ns: clock::now().ns(),
            displaced: self.displaced,
            lost: self.lost,
            ..FlowHeader::from(moved)
        }
    }

    fn send_velocity(&mut self, moved: &Moved, published_ns: i64) -> Result<(), Error> {
        let sample = VelocitySample { published_ns, ..VelocitySample::from(moved) };
        self.velocity.send_copy(sample).map(|_| ()).map_err(|e| Error::Lost {
            sink: "iceoryx2",
            what: format!("the velocity of step {}", moved.step),
            reason: format!("{e:?}"),
        })
    }

    /// Sent with every step, so that a reader knows at once that nothing is known any more.
    fn send_obstacles(&mut self, moved: &Moved, published_ns: i64) -> Result<(), Error> {
        let sample = ObstaclesSample { published_ns, ..ObstaclesSample::from(moved) };
        self.obstacles.send_copy(sample).map(|_| ()).map_err(|e| Error::Lost {
            sink: "iceoryx2",
            what: format!("the obstacles of step {}", moved.step),
            reason: format!("{e:?}"),
        })
    }

    /// Wakes whoever waits. A reader that can't be woken finds the sample when it looks.
    fn wake(&self, event: usize) {
        let _ = self.wake.notify_with_custom_event_id(EventId::new(event));
    }

    fn loan(&mut self, grid: &Grid) -> Result<(Loan, Loan), String> {
        let cells = grid.cells();
        if cells > self.cells_max {
            return Err(format!(
                "flow of {}×{} has {cells} cells, [publish.iceoryx2] cells_max allows {}",
                grid.width, grid.height, self.cells_max
            ));
        }
        let loan = |publisher: &Floats, length: usize| {
            let sample = publisher.loan_slice_uninit(length).map_err(|error| match error {
                LoanError::OutOfMemory | LoanError::ExceedsMaxLoans => "readers hold every sample".to_owned(),
                other => format!("{other:?}"),
            })?;
            // SAFETY: the memory came zeroed from the kernel and has held nothing but f32 since, and every pattern of
            // bits is an f32; it is lent to be written in full, and a part that is not shows an older step's values.
            Ok::<Loan, String>(unsafe { sample.assume_init() })
        };
        Ok((loan(&self.flow, cells * 2)?, loan(&self.confidence, cells)?))
    }

    /// Whether the offered vectors lie in the memory that was lent.
    fn holds(&self, offer: &Offer<'_>) -> bool {
        let (flow, confidence) = self.lent();
        std::ptr::eq(flow, offer.flow.vectors) && std::ptr::eq(confidence, offer.flow.confidence)
    }
}

impl Lender for SharedSink {
    fn lend(&mut self, grid: &Grid) -> Canvas<'_> {
        let fits = self.lent.as_ref().is_some_and(|(flow, _)| flow.payload().len() == grid.cells() * 2);
        if !fits {
            // What was lent and not sent goes back first, or there would be no room for the next.
            self.lent = None;
            self.refusal = None;
            match self.loan(grid) {
                Ok(loans) => self.lent = Some(loans),
                Err(reason) => self.refusal = Some(reason),
            }
        }
        match &mut self.lent {
            Some((flow, confidence)) => Canvas { flow: flow.payload_mut(), confidence: confidence.payload_mut() },
            None => self.own.lend(grid),
        }
    }

    fn lent(&self) -> (&[f32], &[f32]) {
        match &self.lent {
            Some((flow, confidence)) => (flow.payload(), confidence.payload()),
            None => self.own.lent(),
        }
    }
}

impl Sink for SharedSink {
    fn name(&self) -> &'static str {
        "iceoryx2"
    }

    /// Sends the offer. Vectors that lie elsewhere than in lent memory are copied, once.
    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), Error> {
        if self.lent.is_none() || !self.holds(offer) {
            let canvas = self.lend(&offer.moved.grid);
            if canvas.flow.len() == offer.flow.vectors.len() && canvas.confidence.len() == offer.flow.confidence.len() {
                canvas.flow.copy_from_slice(offer.flow.vectors);
                canvas.confidence.copy_from_slice(offer.flow.confidence);
            }
            self.copied += u64::from(self.lent.is_some());
        }
        self.send(offer.moved)
    }

    fn status(&mut self, status: &wire::Status) -> Result<(), Error> {
        self.displaced = status.displaced;
        let sent = self.status.send_copy(StatusSample::from(status));
        self.wake(STATUS_EVENT);
        sent.map(|_| ()).map_err(|e| Error::Lost {
            sink: "iceoryx2",
            what: "a status".into(),
            reason: format!("{e:?}"),
        })
    }

    fn lost(&self) -> u64 {
        self.lost
    }
}

fn floats(
    node: &Node<Service>,
    settings: &Iceoryx2,
    name: &str,
    length: usize,
    samples: usize,
) -> Result<Floats, Error> {
    node.service_builder(&service_name(&settings.prefix, name)?)
        .publish_subscribe::<[f32]>()
        .user_header::<FlowHeader>()
        // No payload_alignment here: iceoryx2 0.10 gives every element of a slice that alignment, 16 times the memory.
        .enable_safe_overflow(true)
        .subscriber_max_buffer_size(BUFFER)
        .subscriber_max_borrowed_samples(BORROWED)
        .history_size(HISTORY)
        .max_publishers(1)
        .max_subscribers(settings.subscribers_max)
        .open_or_create()
        .map_err(|e| unopened(settings, name, &e))?
        .publisher_builder()
        .allocation_strategy(AllocationStrategy::Static)
        .initial_max_slice_len(length.max(1))
        .max_loaned_samples(1)
        .override_sample_preallocation(move |_| samples)
        .create()
        .map_err(|e| unopened(settings, name, &e))
}

fn plain<T: Debug + ZeroCopySend + Copy + 'static>(
    node: &Node<Service>,
    settings: &Iceoryx2,
    name: &str,
) -> Result<Publisher<Service, T, ()>, Error> {
    node.service_builder(&service_name(&settings.prefix, name)?)
        .publish_subscribe::<T>()
        .enable_safe_overflow(true)
        .subscriber_max_buffer_size(16)
        .subscriber_max_borrowed_samples(BORROWED)
        .history_size(HISTORY)
        .max_publishers(1)
        .max_subscribers(settings.subscribers_max)
        .open_or_create()
        .map_err(|e| unopened(settings, name, &e))?
        .publisher_builder()
        .create()
        .map_err(|e| unopened(settings, name, &e))
}

fn refused(reason: String) -> Error {
    Error::Open { sink: "iceoryx2", reason }
}

/// Says what usually stands behind an error of iceoryx2.
fn unopened(settings: &Iceoryx2, name: &str, error: &dyn Debug) -> Error {
    let (error, prefix) = (format!("{error:?}"), &settings.prefix);
    let remedy = if error.contains("ExceedsMaxSupportedPublishers") {
        "another node publishes there; stop it or give this one another prefix"
    } else if error.contains("Incompatible") || error.contains("DoesNotSupport") || error.contains("VersionMismatch") {
        "it exists with other settings, from another version or another subscribers_max; stop its readers and try again"
    } else if error.contains("Permission") {
        "it belongs to another user"
    } else if error.contains("UnableToCreateDataSegment") {
        "its memory could not be made; look at the room in /dev/shm"
    } else {
        "see the log of iceoryx2"
    };
    refused(format!("service {prefix}/{name}: {error}: {remedy}"))
}

/// Bytes free in /dev/shm; `None` where there is none to ask.
pub fn free_bytes() -> Option<u64> {
    // SAFETY: a statvfs is plain numbers, for which zeros are valid.
    let mut room: libc::statvfs = unsafe { std::mem::zeroed() };
    // SAFETY: the path ends in NUL and the struct outlives the call.
    let answer = unsafe { libc::statvfs(c"/dev/shm".as_ptr(), &raw mut room) };
    (answer == 0).then(|| room.f_bavail as u64 * room.f_frsize as u64)
}

#[cfg(test)]
mod tests;
