//! What goes from thread to thread: nothing is allocated for it, and several senders lose nothing that is not counted.

use std::{sync::Arc, thread, time::Duration};

use nightflow::{
    camera::{
        Counts, Frame, Next, Sample,
        latest::{Latest, mailbox},
    },
    clock::Stamp,
    handover::handover,
    wire::{Header, Image, Imu},
};

use crate::allocations::{self, Allocations};

/// Longer than anything here takes, and shorter than anybody waits.
const LONG: Duration = Duration::from_secs(20);

fn header(ns: i64) -> Header {
    Header { stamp: Stamp::from_ns(ns).into(), frame_id: String::new() }
}

fn frame(ns: i64) -> Sample {
    let image = Image { header: header(ns), ..Image::default() };
    Sample::Frame(Arc::new(Frame { image, received: Stamp::from_ns(0) }))
}

fn imu(ns: i64) -> Sample {
    Sample::Imu(Arc::new(Imu { header: header(ns), ..Imu::default() }))
}

/// Takes until the end and shows everything; what was counted by then.
fn take_all(latest: &mut Latest, mut see: impl FnMut(&Sample)) -> Counts {
    loop {
        match latest.next(LONG).unwrap() {
            Next::Sample(sample) => see(&sample),
            Next::Idle => panic!("nothing came in {LONG:?}"),
            Next::End => return latest.counts(),
        }
    }
}

#[test]
fn neither_the_mailbox_nor_a_row_allocates_for_what_goes_through() {
    let (sender, mut latest) = mailbox(64);
    let (mut giver, mut taker) = handover(2);
    let samples: Vec<Sample> = (0..1000).flat_map(|k| [imu(3 * k), frame(3 * k + 1), frame(3 * k + 2)]).collect();
    let mut through = |sample: &Sample| {
        sender.put(sample.clone());
        sender.numbered([1; 16], sample.stamp().ns());
        while let Next::Sample(sample) = latest.next(Duration::ZERO).unwrap() {
            giver.give(sample).unwrap();
            drop(taker.take().unwrap());
        }
    };
    // A thread's first look registers it.
    samples[..30].iter().for_each(&mut through);
    let ((), taken) = allocations::during(|| samples[30..].iter().for_each(&mut through));
    assert_eq!(taken, Allocations::default());
}

#[test]
fn frames_of_several_senders_are_taken_or_displaced_once_each_and_the_newest_is_taken() {
    const SENDERS: i64 = 3;
    const EACH: i64 = 20_000;
    let (sender, mut latest) = mailbox(8);
    let senders: Vec<_> = (0..SENDERS).map(|_| sender.clone()).collect();
    drop(sender);
    let (mut taken, mut newest) = (0, -1);
    let counts = thread::scope(|scope| {
        for (first, sender) in (0..).zip(senders) {
            // Every second one is late, so that it has to give way.
            let stamps = (0..EACH).map(move |k| (k ^ 1) * SENDERS + first);
            scope.spawn(move || stamps.for_each(|stamp| sender.put(frame(stamp))));
        }
        take_all(&mut latest, |sample| {
            taken += 1;
            newest = newest.max(sample.stamp().ns());
        })
    });
    assert_eq!(newest, SENDERS * EACH - 1);
    let frames = (SENDERS * EACH) as u64;
    assert_eq!((counts.arrived, counts.displaced), (frames, frames - taken));
}

#[test]
fn a_small_sample_that_was_put_in_before_a_frame_is_taken_before_it() {
    const FRAMES: i64 = 20_000;
    let (sender, mut latest) = mailbox(64);
    let (mut small, mut frames, mut last_frame, mut last_small) = (0, 0, -1, -1);
    let counts = thread::scope(|scope| {
        scope.spawn(move || {
            for k in 0..FRAMES {
                sender.put(imu(2 * k));
                sender.put(frame(2 * k + 1));
            }
        });
        take_all(&mut latest, |sample| {
            let stamp = sample.stamp().ns();
            assert!(stamp > last_frame.max(last_small), "{stamp} came after {last_frame} and {last_small}");
            if matches!(sample, Sample::Frame(_)) {
                assert_eq!(last_small, stamp - 1, "the newest small sample before a frame never makes room");
                (last_frame, frames) = (stamp, frames + 1);
            } else {
                (last_small, small) = (stamp, small + 1);
            }
        })
    });
    assert_eq!(last_frame, 2 * FRAMES - 1);
    assert_eq!((frames + counts.displaced, small + counts.overrun), (FRAMES as u64, FRAMES as u64));
}
