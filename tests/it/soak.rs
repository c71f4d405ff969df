//! Ten thousand steps from mosaic to velocity: nothing is allocated once the first frames are through.

use std::{path::Path, sync::Arc};

use nightflow::{
    camera::{Frame, Sample},
    clock::{Stamp, Untimed},
    config::Config,
    flow::{Fake, Lender, Matcher, Own},
    pipeline::{Outcome, Pipeline},
    publish::{self, Moved, iceoryx2::SharedSink},
    wire::{CameraInfo, Header, Image, Imu, Range, Vector3},
};

use crate::allocations::{self, Allocations};

const SIDE: u32 = 128;
const INTERVAL_NS: i64 = 33_333_333;
const STEPS: i64 = 10_000;
const WARM_UP: i64 = 200;

/// Eight frames that follow each other for ever: a checked pattern that moves by two cells and comes round.
fn frames() -> Vec<Arc<Frame>> {
    let frame = |index: u32| {
        let count = |x: u32, y: u32| 256 + 100 * (1 + ((x + 4 * index) / 8 + y / 8) % 4) as u16;
        let data = (0..SIDE * SIDE).flat_map(|i| count(i % SIDE, i / SIDE).to_le_bytes()).collect();
        let image = Image {
            header: Header { frame_id: "camera_optical".into(), ..Header::default() },
            height: SIDE,
            width: SIDE,
            encoding: "bayer_rggb16".into(),
            is_bigendian: 0,
            step: SIDE * 2,
            data,
        };
        Arc::new(Frame { image, received: Stamp::from_ns(0) })
    };
    (0..8).map(frame).collect()
}

/// Stamps anew what nobody else holds; a frame that is kept longer than its step would be found here.
fn stamped<T>(shared: &mut Arc<T>, stamp: impl FnOnce(&mut T)) -> Arc<T> {
    stamp(Arc::get_mut(shared).expect("a sample of an earlier step is still held"));
    Arc::clone(shared)
}

/// Where a run's flow goes, and what is done with a step.
trait Outlet {
    fn lender(&mut self) -> &mut dyn Lender;
    fn send(&mut self, _: &Moved) {}
}

impl Outlet for Own {
    fn lender(&mut self) -> &mut dyn Lender {
        self
    }
}

impl Outlet for SharedSink {
    fn lender(&mut self) -> &mut dyn Lender {
        SharedSink::lender(self)
    }

    fn send(&mut self, moved: &Moved) {
        SharedSink::send(self, moved).unwrap();
    }
}

/// Runs the steps, and counts what the steps after the first ones allocate.
fn soak(outlet: &mut dyn Outlet) -> Allocations {
    let settings = "[exposure]\nbit_depth = 12\nblack_level = 256\n[motion.obstacles]\n";
    let config = Config::parse(settings, Path::new("soak")).unwrap();
    let fake = Matcher::with(&config.flow, Box::new(Fake::shift(-2.0, 0.0)));
    let mut pipeline = Pipeline::with(&config, fake).unwrap();
    let k = [200.0, 0.0, 63.5, 0.0, 200.0, 63.5, 0.0, 0.0, 1.0];
    let info =
        CameraInfo { width: SIDE, height: SIDE, distortion_model: "plumb_bob".into(), k, ..CameraInfo::default() };
    pipeline.step(&Sample::Info(Arc::new(info)), outlet.lender(), &mut Untimed).unwrap();
    let mut frames = frames();
    let mut imu = Arc::new(Imu { angular_velocity: Vector3 { x: 0.0, y: 0.0, z: 0.01 }, ..Imu::default() });
    let mut range = Arc::new(Range { min_range: 0.1, max_range: 40.0, range: 5.0, ..Range::default() });
    let (mut moved, mut velocities, mut sights) = (0, 0, 0);
    let mut advance = |step: i64| {
        let at = |ns: i64| Stamp::from_ns(1_700_000_000_000_000_000 + step * INTERVAL_NS + ns);
        for part in 0..4 {
            let gyro = stamped(&mut imu, |imu| imu.header.stamp = at(part * INTERVAL_NS / 4).into());
            pipeline.step(&Sample::Imu(gyro), outlet.lender(), &mut Untimed).unwrap();
        }
        let distance = stamped(&mut range, |range| range.header.stamp = at(INTERVAL_NS / 2).into());
        pipeline.step(&Sample::Range(distance), outlet.lender(), &mut Untimed).unwrap();
        let frame = stamped(&mut frames[step as usize % 8], |frame| frame.image.header.stamp = at(0).into());
        let outcome = pipeline.step(&Sample::Frame(frame), outlet.lender(), &mut Untimed).unwrap();
        if let Outcome::Moved(found) = outcome {
            moved += 1;
            velocities += i64::from(found.velocity.is_ok());
            sights += i64::from(found.obstacles.is_ok());
            outlet.send(&found);
        }
    };
    (0..WARM_UP).for_each(&mut advance);
    let ((), taken) = allocations::during(|| (WARM_UP..STEPS).for_each(&mut advance));
    assert_eq!(moved, STEPS - 1);
    assert!(velocities > STEPS * 9 / 10, "only {velocities} of {STEPS} steps have a velocity");
    assert!(sights > STEPS * 9 / 10, "only {sights} of {STEPS} steps looked for obstacles");
    taken
}

#[test]
fn ten_thousand_steps_allocate_nothing() {
    assert_eq!(soak(&mut Own::default()), Allocations { calls: 0, peak: 0 });
}

#[test]
fn ten_thousand_steps_into_shared_memory_do_not_grow() {
    let settings = publish::Iceoryx2 {
        prefix: format!("nightflow_soak_{}", std::process::id()),
        cells_max: 64 * 64,
        ..publish::Iceoryx2::default()
    };
    let mut shared = SharedSink::open(&publish::Config::default(), &settings).unwrap();
    let taken = soak(&mut shared);
    // iceoryx2 keeps each of the four loans of a step in a small block of its own, which sending gives back.
    let steps = (STEPS - WARM_UP) as usize;
    assert!(taken.calls <= 4 * steps, "{} allocations in {steps} steps", taken.calls);
    assert!(taken.peak <= 1024, "{} bytes are held at once after {steps} steps", taken.peak);
}
