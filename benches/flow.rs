//! The flow stage at 320 × 256: the network with two threads, and everything that is done around it.
//!
//! `cargo bench --bench flow`. A step is one pyramid (the newer frame) and one decoder, as in a running node.

use std::{hint::black_box, path::PathBuf, time::Duration};

use criterion::{Criterion, criterion_group, criterion_main};
use nightflow::{
    exposure::{Exposed, Pair},
    flow::{self, Config, Fake, Matcher, Own, Resolution},
};

fn frames(width: usize, height: usize) -> Vec<Exposed> {
    (1..=3).map(|number| flow::pattern(width, height, number)).collect()
}

/// Steps through the frames for ever. Three of them, so that every step has one new frame.
fn step(bench: &mut criterion::Bencher, matcher: &mut Matcher, frames: &[Exposed]) {
    let mut own = Own::default();
    let mut at = 0;
    bench.iter(|| {
        let (older, newer) = (&frames[at % 3], &frames[(at + 1) % 3]);
        at += 1;
        let pair = Pair { older, newer, gain_step: None };
        let flow = matcher.between(&pair, &mut own).expect("a step");
        black_box(matcher.judge(&pair, &flow));
    });
}

fn stage(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("flow");
    group.sample_size(20).measurement_time(Duration::from_secs(6)).warm_up_time(Duration::from_secs(1));
    let quarter = Config::default();
    let full = Config { resolution: Resolution::Full, ..Config::default() };
    let size = frames(320, 256);
    let mut real = Matcher::open(&quarter).expect("the committed model");
    group.bench_function("network and all, 320x256, 2 threads", |bench| step(bench, &mut real, &size));
    let single = Config { threads: 1, ..Config::default() };
    let mut real = Matcher::open(&single).expect("the committed model");
    group.bench_function("network and all, 320x256, 1 thread", |bench| step(bench, &mut real, &size));
    // A network that does nothing: what is left is the padding, the confidence, the masks and the state.
    for (name, config, size) in [
        ("all but the network, 320x256, quarter", &quarter, &size),
        ("all but the network, 320x256, full", &full, &size),
        ("all but the network, 330x250, quarter", &quarter, &frames(330, 250)),
    ] {
        let mut fake = Matcher::with(config, Box::new(Fake::shift(1.0, -0.5)));
        group.bench_function(name, |bench| step(bench, &mut fake, size));
    }
    let config = Config { models: PathBuf::new(), ..Config::default() };
    group.sample_size(10);
    group.bench_function("open, with hashes and golden check", |bench| {
        bench.iter(|| Matcher::open(&config).expect("the committed model"));
    });
    group.finish();
}

criterion_group!(benches, stage);
criterion_main!(benches);
