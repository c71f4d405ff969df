//! Counts what a piece of code allocates, on the thread that runs it.
// Each test uses a part of this.
#![allow(dead_code)]

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
};

/// What was allocated while something ran.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Allocations {
    /// Times that memory was asked for, growing a block included.
    pub calls: usize,
    /// The most bytes that were held at once, beyond those at the start.
    pub peak: usize,
}

/// Runs something and counts what this thread allocates meanwhile; other threads do not count.
pub fn during<R>(run: impl FnOnce() -> R) -> (R, Allocations) {
    CALLS.set(0);
    HELD.set(0);
    PEAK.set(0);
    let result = run();
    (result, Allocations { calls: CALLS.get(), peak: usize::try_from(PEAK.get()).unwrap() })
}

thread_local! {
    static CALLS: Cell<usize> = const { Cell::new(0) };
    // Below zero when something is freed that was there before.
    static HELD: Cell<isize> = const { Cell::new(0) };
    static PEAK: Cell<isize> = const { Cell::new(0) };
}

fn count(more: usize, less: usize) {
    // The cells need no destructor, so that they can be had even while a thread ends.
    CALLS.set(CALLS.get() + usize::from(more > 0));
    HELD.set(HELD.get() + more as isize - less as isize);
    PEAK.set(PEAK.get().max(HELD.get()));
}

struct Counting;

#[global_allocator]
static COUNTING: Counting = Counting;

// SAFETY: every call goes to the system's allocator unchanged; the counting allocates nothing.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: the caller's promises are the system allocator's conditions.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        count(0, layout.size());
        // SAFETY: as above.
        unsafe { System.dealloc(at, layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size, layout.size());
        // SAFETY: as above.
        unsafe { System.realloc(at, layout, size) }
    }
}

#[test]
fn what_is_allocated_is_counted() {
    let kept = vec![1u8; 100];
    let ((), counted) = during(|| {
        drop(kept);
        drop(std::hint::black_box(Vec::<u8>::with_capacity(1000)));
    });
    assert_eq!(counted, Allocations { calls: 1, peak: 900 });
    assert_eq!(during(|| std::hint::black_box(3) + 4), (7, Allocations::default()));
}
