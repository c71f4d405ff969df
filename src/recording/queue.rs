//! What waits for the disk: bounded, in order, and waited for only by a source that waits itself.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use crate::{
    camera::Sample,
    publish::{
        Offer,
        outgoing::{self, Kept},
    },
    wire::{EgoMotion, LaserScan, Status, Step, TwistWithCovarianceStamped},
};

/// The outputs of one step.
#[derive(Debug, Default)]
pub(super) struct StepItem {
    pub(super) step: Step,
    pub(super) motion: EgoMotion,
    pub(super) has_motion: bool,
    pub(super) twist: TwistWithCovarianceStamped,
    pub(super) has_twist: bool,
    pub(super) proximity: LaserScan,
    pub(super) has_proximity: bool,
    pub(super) flow: Kept,
}

impl StepItem {
    /// Fills in what a step found; `flow` asks for its vectors too.
    pub(super) fn keep(&mut self, offer: &Offer<'_>, body_frame: &str, flow: bool) {
        let moved = offer.moved;
        outgoing::fill_step(moved, &mut self.step);
        self.has_motion = outgoing::fill_ego_motion(moved, body_frame, &mut self.motion);
        self.has_twist = outgoing::fill_twist(moved, body_frame, &mut self.twist);
        self.has_proximity = outgoing::fill_proximity(moved, body_frame, &mut self.proximity);
        if flow {
            self.flow.keep(offer);
        }
    }
}

/// One thing to be written.
pub(super) enum Item {
    /// Shared with the pipeline, not copied.
    Sample(Sample),
    /// Copied out of lent memory; its box comes back for the next step.
    Step(Box<StepItem>),
    /// How the node fares.
    Status(Box<Status>),
}

impl Item {
    /// Whether it is large: a frame or a step's vectors.
    fn large(&self) -> bool {
        matches!(self, Item::Sample(Sample::Frame(_)) | Item::Step(_))
    }

    /// Losses are counted by kind, so that each topic's sequence numbers show its own.
    pub(super) fn kind(&self) -> usize {
        match self {
            Item::Sample(Sample::Frame(_)) => 0,
            Item::Sample(Sample::Info(_)) => 1,
            Item::Sample(Sample::Imu(_)) => 2,
            Item::Sample(Sample::Range(_)) => 3,
            Item::Step(_) => 4,
            Item::Status(_) => 5,
            Item::Sample(Sample::Transforms(_)) => 6,
            Item::Sample(Sample::Width(_)) => 7,
        }
    }
}

/// What [`Queue::pop`] found.
pub(super) struct Popped {
    /// The oldest item, and how many of its kind were lost just before it.
    pub(super) item: Option<(Item, u32)>,
    /// Nothing will be added any more.
    pub(super) closed: bool,
}

#[derive(Default)]
struct Waiting {
    items: VecDeque<(Item, u32)>,
    large: usize,
    lost: [u32; 8],
    // They travel in items as boxes; unboxing them here would only copy them.
    #[allow(clippy::vec_box)]
    spare: Vec<Box<StepItem>>,
    closed: bool,
}

/// Large and small items are bounded apart, so that a fast gyro does not push frames out.
pub(super) struct Queue {
    large_max: usize,
    small_max: usize,
    waiting: Mutex<Waiting>,
    came: Condvar,
    left: Condvar,
}

impl Queue {
    pub(super) fn new(large_max: usize, small_max: usize) -> Self {
        Self { large_max, small_max, waiting: Mutex::default(), came: Condvar::new(), left: Condvar::new() }
    }

    /// Adds an item, or answers how many of its size wait already; then it is lost.
    pub(super) fn push(&self, item: Item) -> Result<(), usize> {
        let mut waiting = self.lock();
        let (large, kind) = (item.large(), item.kind());
        let (now, max) = self.room(&waiting, large);
        if now >= max {
            waiting.lost[kind] = waiting.lost[kind].saturating_add(1);
            if let Item::Step(step) = item {
                waiting.spare.push(step);
            }
            return Err(now);
        }
        let lost = std::mem::take(&mut waiting.lost[kind]);
        waiting.large += usize::from(large);
        waiting.items.push_back((item, lost));
        drop(waiting);
        self.came.notify_one();
        Ok(())
    }

    /// How many of this size wait, and how many may.
    fn room(&self, waiting: &Waiting, large: bool) -> (usize, usize) {
        if large { (waiting.large, self.large_max) } else { (waiting.items.len() - waiting.large, self.small_max) }
    }

    /// Waits for at most `wait` until there is room for the item; true when there is.
    pub(super) fn wait_for_room(&self, item: &Item, wait: Duration) -> bool {
        let full = |waiting: &mut Waiting| {
            let (now, max) = self.room(waiting, item.large());
            now >= max
        };
        let waited = self.left.wait_timeout_while(self.lock(), wait, full).unwrap_or_else(PoisonError::into_inner);
        !waited.1.timed_out()
    }

    /// The oldest item, waiting for at most `wait`.
    pub(super) fn pop(&self, wait: Duration) -> Popped {
        let (mut waiting, _) = self
            .came
            .wait_timeout_while(self.lock(), wait, |waiting| waiting.items.is_empty() && !waiting.closed)
            .unwrap_or_else(PoisonError::into_inner);
        let item = waiting.items.pop_front();
        if item.as_ref().is_some_and(|(item, _)| item.large()) {
            waiting.large -= 1;
        }
        let closed = waiting.closed;
        drop(waiting);
        self.left.notify_all();
        Popped { item, closed }
    }

    /// A step's box that was written and can be filled again.
    pub(super) fn spare(&self) -> Option<Box<StepItem>> {
        self.lock().spare.pop()
    }

    /// Gives a written step's box back.
    pub(super) fn give_back(&self, item: Box<StepItem>) {
        self.lock().spare.push(item);
    }

    /// Nothing will be added any more.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.came.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        // A panic elsewhere leaves the queue whole: every change to it is one statement.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status() -> Item {
        Item::Status(Box::default())
    }

    #[test]
    fn what_finds_no_room_is_counted_before_the_next_of_its_kind() {
        let queue = Queue::new(1, 2);
        assert_eq!(queue.push(Item::Step(Box::default())), Ok(()));
        assert_eq!(queue.push(Item::Step(Box::default())), Err(1));
        assert_eq!(queue.push(Item::Step(Box::default())), Err(1));
        assert_eq!((queue.push(status()), queue.push(status()), queue.push(status())), (Ok(()), Ok(()), Err(2)));
        let first = queue.pop(Duration::ZERO).item.map(|(item, lost)| (item.kind(), lost));
        assert_eq!(first, Some((4, 0)));
        assert_eq!(queue.push(Item::Step(Box::default())), Ok(()), "room again");
        let rest: Vec<_> =
            std::iter::from_fn(|| queue.pop(Duration::ZERO).item).map(|(item, lost)| (item.kind(), lost)).collect();
        assert_eq!(rest, [(5, 0), (5, 0), (4, 2)]);
    }

    #[test]
    fn a_closed_queue_gives_what_it_holds_first() {
        let queue = Queue::new(4, 4);
        assert_eq!(queue.push(status()), Ok(()));
        queue.close();
        let (first, second) = (queue.pop(Duration::ZERO), queue.pop(Duration::from_secs(60)));
        assert!(first.item.is_some() && first.closed);
        assert!(second.item.is_none() && second.closed);
    }
}
