//! From one thread to another without a lock: a bounded row of things, and a bell for whoever has to wait.
//!
//! Giving and taking are wait-free. Only who finds the row full or empty, and wants to wait for the other side, sleeps.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering, fence},
    },
    thread::{self, Thread},
    time::Duration,
};

use arc_swap::ArcSwapOption;
use rtrb::{Consumer, Producer, PushError, RingBuffer};

use crate::clock;

/// What one thread waits at until another rings.
#[derive(Default)]
pub struct Bell {
    waits: AtomicBool,
    /// Who waits, or waited last.
    who: ArcSwapOption<Thread>,
}

impl Bell {
    /// Waits until it is ready, for at most `wait`, or for as long as it takes; whether it is ready. Whoever makes it ready
    /// rings afterwards. Only one thread at a time may wait.
    pub fn wait(&self, wait: Option<Duration>, mut ready: impl FnMut() -> bool) -> bool {
        if ready() {
            return true;
        }
        // A moment that is too far away to be told never comes.
        let until = wait.and_then(|wait| clock::instant().checked_add(wait));
        self.enter();
        let is_ready = loop {
            self.waits.store(true, Ordering::Release);
            // Either this thread sees below what was made ready, or who made it ready sees that this thread waits.
            fence(Ordering::SeqCst);
            if ready() {
                break true;
            }
            // Both may return for no reason, which the loop is for.
            match until.map(|until| until.saturating_duration_since(clock::instant())) {
                None => thread::park(),
                Some(Duration::ZERO) => break false,
                Some(left) => thread::park_timeout(left),
            }
        };
        self.waits.store(false, Ordering::Relaxed);
        is_ready
    }

    /// Wakes who waits, if anybody does.
    pub fn ring(&self) {
        fence(Ordering::SeqCst);
        if self.waits.load(Ordering::Relaxed)
            && self.waits.swap(false, Ordering::Acquire)
            && let Some(thread) = &*self.who.load()
        {
            thread.unpark();
        }
    }

    /// Tells whom to wake. It is mostly the same thread again, and then nothing is allocated.
    fn enter(&self) {
        let here = thread::current();
        if self.who.load().as_ref().is_none_or(|thread| thread.id() != here.id()) {
            self.who.store(Some(Arc::new(here)));
        }
    }
}

/// Why something was not taken over; it comes back.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused<T> {
    /// As many as there is room for wait already.
    #[error("there is no room")]
    Full(T),
    /// The taker is gone.
    #[error("nobody takes anything any more")]
    Gone(T),
}

/// Why there is nothing to take.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Nothing {
    /// Nothing waits.
    #[error("nothing was given yet")]
    Yet,
    /// The giver is gone, and all that it gave was taken.
    #[error("nothing will be given any more")]
    AnyMore,
}

/// A row of at most `room` things from one thread to one other.
pub fn handover<T>(room: usize) -> (Giver<T>, Taker<T>) {
    let (giving, taking) = RingBuffer::new(room.max(1));
    let sides = Arc::new(Sides::default());
    (Giver { row: giving, sides: sides.clone() }, Taker { row: taking, sides })
}

/// The side that gives. Dropping it tells the taker that nothing more comes.
pub struct Giver<T> {
    row: Producer<T>,
    sides: Arc<Sides>,
}

/// The side that takes, in the order of giving. Dropping it tells the giver that nobody takes any more.
pub struct Taker<T> {
    row: Consumer<T>,
    sides: Arc<Sides>,
}

#[derive(Default)]
struct Sides {
    giver_gone: AtomicBool,
    taker_gone: AtomicBool,
    /// The taker waits here.
    came: Bell,
    /// The giver waits here.
    left: Bell,
}

impl<T> Giver<T> {
    /// Gives if there is room.
    pub fn try_give(&mut self, thing: T) -> Result<(), Refused<T>> {
        if self.sides.taker_gone.load(Ordering::Acquire) {
            return Err(Refused::Gone(thing));
        }
        self.row.push(thing).map_err(|PushError::Full(thing)| Refused::Full(thing))?;
        self.sides.came.ring();
        Ok(())
    }

    /// Waits until there is room, then gives; fails only where the taker is gone.
    pub fn give(&mut self, thing: T) -> Result<(), Refused<T>> {
        let Self { row, sides } = self;
        sides.left.wait(None, || !row.is_full() || sides.taker_gone.load(Ordering::Acquire));
        self.try_give(thing)
    }
}

impl<T> Taker<T> {
    /// Takes the oldest, if anything waits.
    pub fn try_take(&mut self) -> Result<T, Nothing> {
        // Asked before the row is looked at: what a giver gave before it went is in it by then.
        let ended = self.sides.giver_gone.load(Ordering::Acquire);
        let thing = self.row.pop().map_err(|_| if ended { Nothing::AnyMore } else { Nothing::Yet })?;
        self.sides.left.ring();
        Ok(thing)
    }

    /// Takes the oldest, waiting for it; none when nothing will be given any more.
    pub fn take(&mut self) -> Option<T> {
        self.wait(None);
        self.try_take().ok()
    }

    /// Takes the oldest, waiting for at most `wait`.
    pub fn take_timeout(&mut self, wait: Duration) -> Result<T, Nothing> {
        self.wait(Some(wait));
        self.try_take()
    }

    fn wait(&self, wait: Option<Duration>) {
        let Self { row, sides } = self;
        sides.came.wait(wait, || !row.is_empty() || sides.giver_gone.load(Ordering::Acquire));
    }
}

impl<T> Drop for Giver<T> {
    fn drop(&mut self) {
        self.sides.giver_gone.store(true, Ordering::Release);
        self.sides.came.ring();
    }
}

impl<T> Drop for Taker<T> {
    fn drop(&mut self) {
        self.sides.taker_gone.store(true, Ordering::Release);
        self.sides.left.ring();
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;

    use proptest::prelude::*;

    use super::*;

    /// Longer than anything here takes, and shorter than anybody waits.
    const LONG: Duration = Duration::from_secs(20);

    #[derive(Debug, Clone, Copy)]
    enum Act {
        Give,
        Take,
        TakeWithin,
    }

    proptest! {
        #[test]
        fn gives_what_a_queue_gives(
            acts in prop::collection::vec(prop_oneof![Just(Act::Give), Just(Act::Take), Just(Act::TakeWithin)], 0..200),
            room in 1usize..6,
        ) {
            let (mut giver, mut taker) = handover(room);
            let mut model = VecDeque::new();
            for (number, act) in acts.into_iter().enumerate() {
                match act {
                    Act::Give if model.len() == room => prop_assert_eq!(giver.try_give(number), Err(Refused::Full(number))),
                    Act::Give => {
                        prop_assert_eq!(giver.try_give(number), Ok(()));
                        model.push_back(number);
                    }
                    Act::Take => prop_assert_eq!(taker.try_take(), model.pop_front().ok_or(Nothing::Yet)),
                    Act::TakeWithin => {
                        prop_assert_eq!(taker.take_timeout(Duration::ZERO), model.pop_front().ok_or(Nothing::Yet));
                    }
                }
            }
            drop(giver);
            prop_assert_eq!(std::iter::from_fn(|| taker.take()).collect::<VecDeque<_>>(), model);
            prop_assert_eq!(taker.try_take(), Err(Nothing::AnyMore));
        }
    }

    /// Gives numbers with pauses now and then, so that each side finds the row full and empty in turn.
    fn pass(room: usize, mut take: impl FnMut(&mut Taker<u32>) -> Option<u32>) {
        const COUNT: u32 = 50_000;
        let (mut giver, mut taker) = handover(room);
        let giving = thread::spawn(move || {
            for number in 0..COUNT {
                giver.give(number).unwrap();
                if number % 1000 == 0 {
                    thread::sleep(Duration::from_micros(50));
                }
            }
        });
        let mut wanted = 0;
        while let Some(number) = take(&mut taker) {
            assert_eq!(number, wanted);
            wanted += 1;
            if number % 1700 == 0 {
                thread::sleep(Duration::from_micros(50));
            }
        }
        assert_eq!(wanted, COUNT);
        giving.join().unwrap();
    }

    #[test]
    fn all_arrive_once_and_in_order_through_a_tiny_row() {
        for room in [1, 2, 3] {
            pass(room, Taker::take);
            pass(room, |taker| taker.take_timeout(LONG).ok());
        }
    }

    #[test]
    fn a_taker_that_waits_in_vain_is_told_so_and_is_woken_by_the_end() {
        let (giver, mut taker) = handover::<u32>(4);
        assert_eq!(taker.take_timeout(Duration::from_millis(2)), Err(Nothing::Yet));
        let ending = thread::spawn(move || {
            thread::sleep(Duration::from_millis(20));
            drop(giver);
        });
        assert_eq!(taker.take(), None);
        ending.join().unwrap();
    }

    #[test]
    fn a_giver_that_waits_gets_its_thing_back_when_the_taker_goes() {
        let (mut giver, taker) = handover(1);
        giver.give(1).unwrap();
        let ending = thread::spawn(move || {
            thread::sleep(Duration::from_millis(20));
            drop(taker);
        });
        assert_eq!(giver.give(2), Err(Refused::Gone(2)));
        ending.join().unwrap();
    }

    #[test]
    fn a_side_may_wait_on_one_thread_and_then_on_another() {
        let (mut giver, mut taker) = handover(1);
        for number in 0..20 {
            let taking = thread::spawn(move || (taker.take(), taker));
            thread::sleep(Duration::from_millis(1));
            giver.give(number).unwrap();
            let taken;
            (taken, taker) = taking.join().unwrap();
            assert_eq!(taken, Some(number));
        }
    }

    #[test]
    fn what_nobody_took_is_dropped_with_the_row() {
        let (mut giver, taker) = handover(4);
        let thing = Arc::new(());
        giver.give(thing.clone()).unwrap();
        drop((giver, taker));
        assert_eq!(Arc::strong_count(&thing), 1);
    }
}
