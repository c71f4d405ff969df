//! The recordings of the repository through the whole road with the trained network, against their own truth.

use std::{collections::BTreeMap, path::Path, time::Duration};

use nightflow::{
    camera::{self, Next, Sample},
    clock::{Stamp, Untimed},
    config::Config,
    darkness::flight::{Flight, Settings},
    flow::{Lender, Own},
    motion::Velocity,
    pipeline::{Outcome, Pipeline},
    publish::Moved,
    recording,
    wire::{self, TwistStamped, Vector3Stamped},
};

fn path(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings").join(name)
}

/// The messages of a truth topic, by stamp.
fn truth<M: wire::Message>(name: &str, topic: &str, stamp: impl Fn(&M) -> wire::Time) -> BTreeMap<Stamp, M> {
    let bytes = std::fs::read(path(name)).unwrap();
    mcap::MessageStream::new(&bytes)
        .unwrap()
        .map(|message| message.unwrap())
        .filter(|message| message.channel.topic == topic)
        .map(|message| wire::decode::<M>(&message.data).unwrap())
        .map(|message| (stamp(&message).into(), message))
        .collect()
}

/// Every step of a recording with its vectors, under the settings that the recording holds.
fn steps(name: &str, mut look: impl FnMut(&Moved, &[f32])) {
    let known = recording::metadata(&path(name), "nightflow").unwrap().expect("the recording holds its settings");
    let mut config = Config::parse(&known["config"], Path::new(name)).unwrap();
    config.camera.source = camera::SourceConfig::Mcap(camera::Mcap { path: path(name), realtime: false });
    let mut pipeline = Pipeline::open(&config).unwrap();
    let mut source = camera::open(&config.camera).unwrap();
    let mut own = Own::default();
    loop {
        let sample: Sample = match source.next(Duration::from_millis(100)).unwrap() {
            Next::Sample(sample) => sample,
            Next::Idle => continue,
            Next::End => return,
        };
        if let Outcome::Moved(moved) = pipeline.step(&sample, &mut own, &mut Untimed).unwrap() {
            look(&moved, own.lent().0);
        }
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn a_real_camera_pans_as_it_truly_did() {
    let pans = truth("real_raw_pan.mcap", "/truth/pan", |pan: &Vector3Stamped| pan.header.stamp);
    let mut errors: [Vec<f64>; 2] = Default::default();
    let mut still: [Vec<f64>; 2] = Default::default();
    steps("real_raw_pan.mcap", |moved, vectors| {
        let pan = pans[&moved.newer].vector;
        let half = usize::from(moved.raw_mean < 0.03);
        let u = median(vectors.iter().step_by(2).map(|u| f64::from(*u)).collect());
        let v = median(vectors.iter().skip(1).step_by(2).map(|v| f64::from(*v)).collect());
        errors[half].push((u - pan.x).hypot(v - pan.y));
        still[half].push(pan.x.hypot(pan.y));
    });
    for (half, name) in ["as shot", "darkened"].into_iter().enumerate() {
        let (count, error, still) = (errors[half].len(), median(errors[half].clone()), median(still[half].clone()));
        println!("{name}: {count} pairs, median error of the median flow {error:.2} px, zero flow {still:.2} px");
        assert!(count >= 10, "{name}: only {count} pairs");
        assert!(error < 0.35 * still, "{name}: {error:.2} px is no better than a third of zero flow, {still:.2} px");
    }
}

#[test]
fn a_flight_into_the_dark_keeps_its_speed() {
    let truths = truth("night_flight.mcap", "/truth/velocity", |twist: &TwistStamped| twist.header.stamp);
    let mut errors = Vec::new();
    let mut blind = 0;
    let mut darkest = f32::INFINITY;
    steps("night_flight.mcap", |moved, _| {
        darkest = darkest.min(moved.raw_mean);
        let Ok(Velocity { linear, .. }) = moved.velocity else {
            blind += 1;
            return;
        };
        let true_linear = truths[&moved.newer].twist.linear;
        let difference = [linear[0] - true_linear.x, linear[1] - true_linear.y, linear[2] - true_linear.z];
        errors.push(difference.iter().map(|d| d * d).sum::<f64>().sqrt());
    });
    let steps = errors.len();
    let typical = median(errors);
    println!(
        "{steps} steps with velocity, {blind} without; median error {typical:.3} m/s; down to a raw mean of {darkest:.4}"
    );
    assert!(steps >= 100, "only {steps} steps have a velocity, {blind} have none");
    assert!(darkest < 0.006, "the flight ends at a raw mean of {darkest}");
    assert!(typical < 0.4, "the median error is {typical:.3} m/s");
}

#[test]
fn the_recorded_flight_is_drawn_again_to_the_byte() {
    let config = camera::Config {
        source: camera::SourceConfig::Mcap(camera::Mcap { path: path("night_flight.mcap"), realtime: false }),
        ..camera::Config::default()
    };
    let mut source = camera::open(&config).unwrap();
    let flight = Flight::new(Settings { mean: [0.06, 0.004], ..Settings::default() }).unwrap();
    let mut drawn: Vec<Sample> = flight.take(2).flat_map(|shot| shot.samples).collect();
    let frames = drawn.iter().filter(|sample| matches!(sample, Sample::Frame(_))).count();
    assert_eq!(frames, 2);
    while !drawn.is_empty() {
        let Next::Sample(sample) = source.next(Duration::from_millis(100)).unwrap() else { panic!("too short") };
        let found = drawn.iter().position(|known| match (known, &sample) {
            (Sample::Frame(known), Sample::Frame(read)) => known.image == read.image,
            (known, read) => known == read,
        });
        drawn.remove(found.unwrap_or_else(|| panic!("the sample at {} was not drawn", sample.stamp())));
    }
}
