//! Frames are read beside the network: in the same order, with the same results, and not one after the other.

use std::{
    path::Path,
    sync::{
        Arc, Mutex,
        atomic::AtomicBool,
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    time::Duration,
};

use nightflow::{
    camera::{self, Counts, Next, Sample, Source},
    clock::Untimed,
    config::Config,
    flow::{self, Fake, Lender, Matcher, Model, Network, Own, Raster, Slot, padding::Padded},
    node::{self, Outputs, Report},
    pipeline::{Outcome, Pipeline},
    publish::{self, Moved, Offer, Sink},
    wire::{self, Header, Imu, Width},
};

use crate::bags;

/// Longer than anything here takes, and shorter than anybody waits.
const LONG: Duration = Duration::from_secs(20);

fn pipeline(network: Box<dyn Network>) -> Pipeline {
    let config = Config::parse(bags::SETTINGS, Path::new("test")).unwrap();
    Pipeline::with(&config, Matcher::with(&config.flow, network)).unwrap()
}

/// Gives what it was given, tells that it did, then ends.
struct Told {
    left: std::vec::IntoIter<Sample>,
    tell: Sender<usize>,
    given: usize,
    live: bool,
}

impl Source for Told {
    fn next(&mut self, _: Duration) -> Result<Next, camera::Error> {
        let Some(sample) = self.left.next() else { return Ok(Next::End) };
        self.given += usize::from(matches!(sample, Sample::Frame(_)));
        // The test may have ended.
        let _ = self.tell.send(self.given);
        Ok(Next::Sample(sample))
    }

    fn counts(&self) -> Counts {
        Counts { arrived: self.given as u64, ..Counts::default() }
    }

    fn progress(&self) -> Option<f64> {
        (!self.live).then_some(0.5)
    }
}

/// What came out: results and vectors.
type Kept = Arc<Mutex<Vec<(Moved, Vec<f32>)>>>;

struct Keeper(Kept);

impl Sink for Keeper {
    fn name(&self) -> &'static str {
        "test"
    }

    fn offer(&mut self, offer: &Offer<'_>) -> Result<(), publish::Error> {
        assert_eq!(offer.image.stamp, offer.moved.newer, "the preview is of the step's own frame");
        self.0.lock().unwrap().push((offer.moved.clone(), offer.flow.vectors.to_vec()));
        Ok(())
    }
}

fn driven(samples: Vec<Sample>, network: Box<dyn Network>, tell: Sender<usize>, live: bool) -> (Report, Kept) {
    let mut source: Option<Box<dyn Source>> = Some(Box::new(Told { left: samples.into_iter(), tell, given: 0, live }));
    let mut open = || Ok(source.take().expect("it is opened once"));
    let (kept, mut outputs) = (Kept::default(), Outputs::default());
    outputs.sinks.push(Box::new(Keeper(kept.clone())));
    let stop = AtomicBool::new(false);
    let mut pipeline = pipeline(network);
    let report =
        node::drive(&mut open, Some(&mut pipeline), &mut outputs, &stop, (LONG, None), &mut |_, _| {}).unwrap();
    drop(outputs);
    (report, kept)
}

fn imu(ns: i64, rate: f64) -> Sample {
    let stamp = nightflow::clock::Stamp::from_ns(ns);
    let header = Header { stamp: stamp.into(), frame_id: "imu".into() };
    Sample::Imu(Arc::new(Imu { header, angular_velocity: wire::Vector3 { x: rate, y: 0.0, z: 0.0 }, ..Imu::default() }))
}

/// Twenty frames with a gyro between them, three that are bad in different ways, and another width on the way.
fn samples() -> Vec<Sample> {
    let mut samples = vec![];
    for index in 0..20 {
        let mut frame = bags::frame(index);
        match index {
            6 => frame.image.data.truncate(1000),
            11 => frame.image.header.stamp = bags::frame(3).image.header.stamp,
            _ => {}
        }
        // The light changes, so that the older frame of a pair is given another gain.
        if index % 5 == 4 {
            frame.image.data.as_chunks_mut::<2>().0.iter_mut().for_each(|two| {
                let count = (u16::from_le_bytes(*two) - 256) * 3 / 2 + 256;
                *two = count.to_le_bytes();
            });
        }
        let ns = bags::START_NS + index * bags::INTERVAL_NS;
        samples.push(Sample::Frame(Arc::new(frame)));
        samples.extend((1..40).map(|i| imu(ns + i * bags::INTERVAL_NS / 40, 0.01 * index as f64)));
        if index == 14 {
            let header = Header { stamp: nightflow::clock::Stamp::from_ns(ns).into(), frame_id: String::new() };
            samples.push(Sample::Width(Arc::new(Width { header, columns: 96 })));
        }
    }
    samples
}

#[test]
fn beside_the_network_gives_what_one_after_the_other_gives() {
    let network = || Box::new(Fake::matching(3));
    let mut wanted = vec![];
    let (mut own, mut spoiled) = (Own::default(), 0);
    let mut serial = pipeline(network());
    for sample in &samples() {
        match serial.step(sample, &mut own, &mut Untimed) {
            Ok(Outcome::Moved(moved)) => wanted.push((moved, own.lent().0.to_vec())),
            Ok(_) => {}
            Err(_) => spoiled += 1,
        }
    }
    assert!(wanted.len() > 12 && spoiled == 2, "{} steps, {spoiled} spoiled", wanted.len());
    let gains = wanted.windows(2).filter(|two| two[0].0.gain != two[1].0.gain).count();
    let narrow = wanted.iter().filter(|(moved, _)| moved.grid.width < 30).count();
    assert!(gains > 2 && narrow > 1, "gain and width change: {gains}, {narrow}");
    for live in [false, true] {
        let (report, kept) = driven(samples(), network(), channel().0, live);
        assert!(*kept.lock().unwrap() == wanted, "live: {live}");
        assert_eq!((report.frames, report.spoiled_count(), report.source.arrived), (20, 2, 20));
    }
}

/// A network that finds nothing until the source has been asked for the frame after the one that it works on.
struct Waiting {
    fake: Fake,
    given: Receiver<usize>,
    seen: usize,
    pairs: usize,
    last: usize,
}

impl Network for Waiting {
    fn describe(&mut self, slot: Slot, image: &Padded<'_>) -> Result<(), flow::Error> {
        self.fake.describe(slot, image)
    }

    fn between(&mut self, older: Slot, scale: [f32; 2], out: Raster<'_>) -> Result<(), flow::Error> {
        self.pairs += 1;
        // This is frame number pairs + 1; the next one must come while we wait, and no more than that.
        let wanted = (self.pairs + 2).min(self.last);
        while self.seen < wanted {
            self.seen = self.given.recv_timeout(LONG).expect("the next frame was not asked for beside the network");
        }
        if self.pairs + 2 < self.last {
            match self.given.recv_timeout(Duration::from_millis(20)) {
                Err(RecvTimeoutError::Timeout) => {}
                more => panic!("one frame is ahead at most, and then came {more:?}"),
            }
        }
        self.fake.between(older, scale, out)
    }

    fn model(&self) -> &Model {
        self.fake.model()
    }
}

#[test]
fn the_next_frame_is_read_while_the_network_runs_and_no_other() {
    let (tell, given) = channel();
    let last = 8;
    let network = Waiting { fake: Fake::shift(1.0, 0.0), given, seen: 0, pairs: 0, last };
    let frames = (0..last as i64).map(bags::sample).collect();
    let (report, _) = driven(frames, Box::new(network), tell, false);
    assert_eq!((report.frames, report.steps, report.unpaired), (8, 7, 1));
}
