//! What waits for the disk: bounded, in order, and waited for only by a source that waits itself.

use std::{
    sync::atomic::{AtomicBool, AtomicU32, AtomicUsize, Ordering},
    time::Duration,
};

use crossbeam_queue::ArrayQueue;

use crate::{
    camera::Sample,
    handover::Bell,
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

/// What is of one size, large or small.
struct Size {
    waiting: AtomicUsize,
    max: usize,
}

/// Large and small items are bounded apart, so that a fast gyro does not push frames out.
///
/// One thread pushes and one other pops. Neither holds a lock that the other could wait for.
pub(super) struct Queue {
    items: ArrayQueue<(Item, u32)>,
    large: Size,
    small: Size,
    /// By kind, since the last item of it that found room; only the thread that pushes is concerned with them.
    lost: [AtomicU32; 8],
    spare: ArrayQueue<Box<StepItem>>,
    closed: AtomicBool,
    came: Bell,
    left: Bell,
}

impl Queue {
    pub(super) fn new(large_max: usize, small_max: usize) -> Self {
        let size = |max| Size { waiting: AtomicUsize::new(0), max };
        Self {
            items: ArrayQueue::new((large_max + small_max).max(1)),
            large: size(large_max),
            small: size(small_max),
            lost: Default::default(),
            // Beside those that wait, one is filled and one is written.
            spare: ArrayQueue::new(large_max + 2),
            closed: AtomicBool::new(false),
            came: Bell::default(),
            left: Bell::default(),
        }
    }

    /// Adds an item, or answers how many of its size wait already; then it is lost.
    pub(super) fn push(&self, item: Item) -> Result<(), usize> {
        let (size, lost) = (self.size(&item), &self.lost[item.kind()]);
        let missing = lost.load(Ordering::Relaxed);
        // It is counted before it can be popped, so that the count never falls below none.
        let waiting = size.waiting.fetch_add(1, Ordering::Acquire);
        let refused = if waiting < size.max { self.items.push((item, missing)).err() } else { Some((item, missing)) };
        if let Some((item, missing)) = refused {
            size.waiting.fetch_sub(1, Ordering::Relaxed);
            lost.store(missing.saturating_add(1), Ordering::Relaxed);
            if let Item::Step(step) = item {
                self.give_back(step);
            }
            return Err(waiting);
        }
        lost.store(0, Ordering::Relaxed);
        self.came.ring();
        Ok(())
    }

    fn size(&self, item: &Item) -> &Size {
        if item.large() { &self.large } else { &self.small }
    }

    /// Waits for at most `wait` until there is room for the item; true when there is.
    pub(super) fn wait_for_room(&self, item: &Item, wait: Duration) -> bool {
        let size = self.size(item);
        self.left.wait(Some(wait), || size.waiting.load(Ordering::Acquire) < size.max)
    }

    /// The oldest item, waiting for at most `wait`.
    pub(super) fn pop(&self, wait: Duration) -> Popped {
        self.came.wait(Some(wait), || !self.items.is_empty() || self.closed.load(Ordering::Acquire));
        // Asked before popping: what was pushed before the end is popped before it.
        let closed = self.closed.load(Ordering::Acquire);
        let item = self.items.pop();
        if let Some((item, _)) = &item {
            self.size(item).waiting.fetch_sub(1, Ordering::Release);
            self.left.ring();
        }
        Popped { item, closed }
    }

    /// A step's box that was written and can be filled again.
    pub(super) fn spare(&self) -> Option<Box<StepItem>> {
        self.spare.pop()
    }

    /// Gives a written step's box back.
    pub(super) fn give_back(&self, item: Box<StepItem>) {
        // There is room for all that there are.
        let _ = self.spare.push(item);
    }

    /// Nothing will be added any more.
    pub(super) fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.came.ring();
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
