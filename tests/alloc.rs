//! The steady state takes no memory: allocations are counted while stages run on frames of a size they have seen.

use std::{
    alloc::{GlobalAlloc, Layout, System},
    cell::Cell,
};

use nightflow::{
    camera::Frame,
    clock::Stamp,
    exposure::{Config, Developer, Exposed, Packing, Pair, Pattern},
    flow::{self, Fake, Matcher, Own, Resolution},
    wire::{Header, Image, Time},
};

/// The system's allocator, counting per thread, so that the test harness and other tests do not disturb the count.
struct Counting;

thread_local! {
    static TAKEN: Cell<u64> = const { Cell::new(0) };
}

fn count() {
    // While a thread ends its counter may be gone already, and nobody asks for it any more.
    let _ = TAKEN.try_with(|taken| taken.set(taken.get() + 1));
}

// SAFETY: every call is passed on unchanged to the system's allocator, which keeps the contract; counting allocates
// nothing, for the counter is a plain cell without a destructor.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are the system allocator's own.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

/// How many times this thread took memory while `work` ran.
fn taken(work: impl FnOnce()) -> u64 {
    let before = TAKEN.get();
    work();
    TAKEN.get() - before
}

#[test]
fn the_count_counts() {
    assert_eq!(taken(|| ()), 0);
    assert!(taken(|| drop(std::hint::black_box(vec![0u8; 100]))) > 0);
}

/// Noise over light, with a hot pixel and a lamp, so that every part of the pass has work.
fn frame(encoding: &str, light: u32, sec: i32) -> Frame {
    let (width, height) = (322u32, 243u32);
    let wide = encoding.ends_with("16");
    let counts = (0..width * height).map(|i| {
        let noise = i.wrapping_mul(0x9e37_79b9).wrapping_add(sec as u32).wrapping_mul(0x85eb_ca6b) >> 28;
        let lamp = (i % width).abs_diff(100) < 5 && (i / width).abs_diff(60) < 5;
        let hot = i == 200 * width + 200;
        if lamp || hot { 255 } else { (light + noise).min(254) as u16 }
    });
    let bytes = counts.flat_map(|count| count.to_le_bytes().into_iter().take(if wide { 2 } else { 1 }));
    let image = Image {
        header: Header { stamp: Time { sec, nanosec: 0 }, frame_id: "camera_optical_frame".into() },
        height,
        width,
        encoding: encoding.into(),
        is_bigendian: 0,
        step: width * if wide { 2 } else { 1 },
        data: bytes.collect(),
    };
    Frame { image, received: Stamp::default() }
}

#[test]
fn developing_takes_no_memory_after_the_first_frames() {
    let raw10 = Config { packing: Some(Packing::Raw10), pattern: Some(Pattern::Rggb), ..Config::default() };
    let eight_of_16 = Config { bit_depth: Some(8), ..Config::default() };
    let cases = [
        ("bayer_rggb8", Config { width_max: 161, ..Config::default() }),
        ("bayer_gbrg16", Config { width_max: 100, ..eight_of_16.clone() }),
        ("mono16", eight_of_16),
        ("8UC1", raw10),
    ];
    for (encoding, config) in cases {
        let mut developer = Developer::new(&config).unwrap();
        // A lamp goes on at frame 20, and dusk falls before and after, so that gains change too.
        let light = |sec: i32| if sec < 20 { 60 - sec as u32 } else { 200 - sec as u32 };
        let frames: Vec<Frame> = (0..40).map(|sec| frame(encoding, light(sec), sec)).collect();
        let (first, rest) = frames.split_at(3);
        first.iter().for_each(|frame| developer.develop(frame).unwrap());
        let mut generations = 0;
        let taken = taken(|| {
            for frame in rest {
                developer.develop(frame).unwrap();
                generations += developer.pair().map_or(0, |pair| pair.older.generation);
            }
            developer.forget();
            developer.develop(&first[0]).unwrap();
        });
        assert_eq!(taken, 0, "{encoding}");
        assert!(generations > 0, "pairs were made");
    }
}

#[test]
fn refining_takes_no_memory_after_the_first_pair() {
    let frames: Vec<Exposed> = (1..=4u64)
        .map(|number| Exposed {
            stamp: Stamp(number as i64),
            width: 96,
            height: 64,
            scale: [2.0; 2],
            rgb: (0..3 * 96 * 64).map(|i| ((i * 7919 + 31 * number as usize) % 1009) as f32 / 1009.0).collect(),
            saturated: vec![0; 96 * 64],
            raw_mean: 0.05,
            generation: number,
            ..Exposed::default()
        })
        .collect();
    for resolution in [Resolution::Quarter, Resolution::Full] {
        let config = flow::Config { refine: true, resolution, ..flow::Config::default() };
        let mut matcher = Matcher::with(&config, Box::new(Fake::shift(1.0, -0.5)));
        let mut own = Own::default();
        let mut step = |at: usize| {
            let pair = Pair { older: &frames[at], newer: &frames[at + 1], gain_step: None };
            matcher.between(&pair, &mut own).map(drop).unwrap();
        };
        step(0);
        let expected = if resolution == Resolution::Quarter { 0 } else { 8 };
        assert_eq!(taken(|| (1..3).for_each(&mut step)), expected, "{resolution:?}");
    }
}
