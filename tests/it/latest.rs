//! The mailbox against a model that is simple enough to be seen right, and under several threads.

use std::{sync::Arc, thread, time::Duration};

use nightflow::{
    camera::{
        Counts, Error, Frame, Next, Sample,
        latest::{Latest, Sender, mailbox},
    },
    clock::Stamp,
    handover::handover,
    wire::{Header, Image, Imu, Range},
};
use proptest::prelude::*;

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

/// What a mailbox should do, with lists that are searched from end to end.
#[derive(Default)]
struct Model {
    room: usize,
    frame: Option<i64>,
    /// (stamp, order of arrival)
    small: Vec<(i64, usize)>,
    arrivals: usize,
    overdue: usize,
    counts: Counts,
}

#[derive(Debug, PartialEq)]
enum Given {
    Frame(i64),
    Small(i64),
    Nothing,
}

impl Model {
    fn frame(&mut self, stamp: i64) {
        self.counts.arrived += 1;
        self.counts.displaced += u64::from(self.frame.is_some());
        self.overdue = 0;
        self.frame = Some(self.frame.map_or(stamp, |waiting| waiting.max(stamp)));
    }

    fn small(&mut self, stamp: i64) {
        if self.small.len() == self.room {
            let oldest = *self.small.iter().min().unwrap();
            self.small.retain(|waiting| *waiting != oldest);
            self.counts.overrun += 1;
        }
        self.small.push((stamp, self.arrivals));
        self.arrivals += 1;
    }

    fn take(&mut self) -> Given {
        if self.frame.is_none() && self.overdue == 0 {
            self.overdue = self.small.len();
        }
        let oldest = self.small.iter().min().copied();
        match (oldest, self.frame) {
            (Some(small), Some(frame)) if small.0 <= frame => self.give(small),
            (_, Some(frame)) => {
                self.frame = None;
                Given::Frame(frame)
            }
            (Some(small), None) => self.give(small),
            (None, None) => Given::Nothing,
        }
    }

    fn give(&mut self, small: (i64, usize)) -> Given {
        self.overdue = self.overdue.saturating_sub(1);
        self.small.retain(|waiting| *waiting != small);
        Given::Small(small.0)
    }
}

fn take(latest: &mut Latest) -> Given {
    match latest.next(Duration::ZERO).unwrap() {
        Next::Sample(sample @ Sample::Frame(_)) => Given::Frame(sample.stamp().ns()),
        Next::Sample(sample) => Given::Small(sample.stamp().ns()),
        Next::Idle => Given::Nothing,
        Next::End => panic!("the sender is still there"),
    }
}

#[derive(Debug, Clone)]
enum Act {
    Frame(i64),
    Small(i64),
    Take,
}

fn acts() -> impl Strategy<Value = Vec<Act>> {
    let act =
        prop_oneof![2 => (0i64..60).prop_map(Act::Frame), 4 => (0i64..60).prop_map(Act::Small), 5 => Just(Act::Take)];
    prop::collection::vec(act, 0..120)
}

proptest! {
    #[test]
    fn gives_what_the_model_gives_and_counts_every_loss(acts in acts(), room in 1usize..9) {
        let (sender, mut latest) = mailbox(room);
        let mut model = Model { room, ..Model::default() };
        let (mut frames, mut smalls, mut taken_frames, mut taken_smalls) = (0, 0, 0, 0);
        for act in acts {
            match act {
                Act::Frame(stamp) => {
                    sender.put(frame(stamp));
                    model.frame(stamp);
                    frames += 1;
                }
                Act::Small(stamp) => {
                    sender.put(imu(stamp));
                    model.small(stamp);
                    smalls += 1;
                }
                Act::Take => {
                    let given = take(&mut latest);
                    prop_assert_eq!(&given, &model.take());
                    taken_frames += u64::from(matches!(given, Given::Frame(_)));
                    taken_smalls += u64::from(matches!(given, Given::Small(_)));
                }
            }
        }
        prop_assert_eq!(latest.counts(), model.counts);
        // Whatever still waits comes before the end, and nothing is gone that was not counted.
        drop(sender);
        loop {
            match latest.next(Duration::ZERO).unwrap() {
                Next::Sample(Sample::Frame(_)) => taken_frames += 1,
                Next::Sample(_) => taken_smalls += 1,
                Next::Idle => prop_assert!(false, "idle after the last sender went"),
                Next::End => break,
            }
        }
        prop_assert_eq!(frames, taken_frames + latest.counts().displaced);
        prop_assert_eq!(smalls, taken_smalls + latest.counts().overrun);
    }
}

#[test]
fn a_slow_taker_sees_rising_frames_and_the_very_last_one() {
    const FRAMES: u64 = 20_000;
    let (sender, mut latest) = mailbox(8);
    let filling = thread::spawn(move || fill(&sender, FRAMES as i64));
    let (mut last, mut taken) = (-1, 0);
    loop {
        match latest.next(LONG).unwrap() {
            Next::Sample(sample @ Sample::Frame(_)) => {
                let stamp = sample.stamp().ns();
                assert!(stamp > last, "{stamp} came after {last}");
                (last, taken) = (stamp, taken + 1);
                if taken % 64 == 0 {
                    thread::sleep(Duration::from_micros(200));
                }
            }
            Next::Sample(_) => {}
            Next::Idle => panic!("nothing came in 20 s"),
            Next::End => break,
        }
    }
    filling.join().unwrap();
    let counts = latest.counts();
    assert_eq!(last, FRAMES as i64 - 1, "the newest frame is never the one that is displaced");
    assert_eq!((counts.arrived, counts.displaced), (FRAMES, FRAMES - taken));
}

fn fill(sender: &Sender, frames: i64) {
    for stamp in 0..frames {
        sender.put(frame(stamp));
        if stamp % 1000 == 0 {
            thread::yield_now();
        }
    }
}

#[test]
fn without_frames_small_samples_still_go_out_in_order() {
    let (sender, mut latest) = mailbox(8);
    sender.put(imu(5));
    sender.put(Sample::Range(Arc::new(Range { header: header(3), ..Range::default() })));
    assert_eq!(take(&mut latest), Given::Small(3));
    assert_eq!(take(&mut latest), Given::Small(5));
    assert_eq!(take(&mut latest), Given::Nothing);
}

#[test]
fn a_failure_is_told_once_after_what_waits() {
    let (sender, mut latest) = mailbox(8);
    sender.put(frame(1));
    sender.fail(Error::Lost { source_name: "ros2".into(), reason: "unplugged".into() });
    assert_eq!(take(&mut latest), Given::Frame(1));
    let said = latest.next(LONG).unwrap_err().to_string();
    assert_eq!(said, "camera source ros2: unplugged");
    assert_eq!(latest.next(Duration::ZERO).unwrap(), Next::Idle);
    drop(sender);
    assert_eq!(latest.next(LONG).unwrap(), Next::End);
}

#[test]
fn the_gyro_of_half_the_exposure_comes_before_its_frame() {
    let (sender, latest) = mailbox(8);
    let mut latest = latest.exposing(10e-9);
    sender.put(frame(20));
    [18, 25, 26].into_iter().for_each(|stamp| sender.put(imu(stamp)));
    assert_eq!(take(&mut latest), Given::Small(18));
    assert_eq!(take(&mut latest), Given::Small(25));
    assert_eq!(take(&mut latest), Given::Frame(20));
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
