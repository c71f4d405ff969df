//! Fused graphs: the same flow as the plain ones give, for every network of the manifest that has one.

use std::path::{Path, PathBuf};

use nightflow::{
    clock::Stamp,
    exposure::{Exposed, Pair},
    flow::{
        Config, Matcher, Operators, Own, Precision,
        convolutions::Unit,
        cost_volume::{CostVolume, Inputs, Outputs, Shape, Unfit},
    },
};

use crate::allocations::{self, Allocations};

/// How far a fused graph's flow and confidence may lie from the plain one's, in pixels.
const APART: f32 = 1e-4;
/// The same where nothing matches anything: there a network makes much of the last digits.
const APART_IN_NOISE: f32 = 5e-4;
/// The same for vectors of more than ten pixels, as a part of them: floats have no more than seven digits.
const APART_PART: f32 = 1e-5;

fn models() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("models")
}

/// Every network with a fused graph.
fn networks() -> Vec<String> {
    let manifest = std::fs::read_to_string(models().join("manifest.toml")).unwrap();
    let table: toml::Table = manifest.parse().unwrap();
    let found: Vec<String> =
        table.into_iter().filter(|(_, entry)| entry.get("fused").is_some()).map(|(name, _)| name).collect();
    assert!(!found.is_empty(), "no network of the manifest has a fused graph");
    found
}

/// Opens a network; its golden check has passed then.
fn open(network: &str, operators: Operators, threads: usize) -> Matcher {
    let config = Config { network: network.into(), models: models(), operators, threads, ..Config::default() };
    let matcher = Matcher::open(&config).expect("the committed network opens and passes its golden check");
    assert_eq!(matcher.model().operators, operators);
    let fused = matcher.model().sha256[1].0.ends_with("_decoder_fused.onnx");
    assert_eq!(fused, operators == Operators::Fused, "{:?}", matcher.model());
    matcher
}

fn exposed(width: usize, height: usize, number: u64, value: impl Fn(usize, usize, usize) -> f32) -> Exposed {
    let cells = (0..3).flat_map(|c| (0..height).flat_map(move |y| (0..width).map(move |x| (c, y, x))));
    Exposed {
        stamp: Stamp::from_ns(number as i64 * 33_000_000),
        width,
        height,
        scale: [1.0, 1.0],
        rgb: cells.map(|(c, y, x)| value(c, y, x)).collect(),
        saturated: vec![0; width * height],
        raw_mean: 0.05,
        gain: 8.0,
        generation: number,
        ..Exposed::default()
    }
}

/// The golden picture, as models/README.md defines it.
fn golden(width: usize, height: usize, number: u64, moved: (f64, f64)) -> Exposed {
    exposed(width, height, number, |c, y, x| {
        let (x, y) = (x as f64 - moved.0, y as f64 - moved.1);
        let wave = (0.20 * x + 0.13 * y + c as f64).sin() * (0.17 * y - 0.05 * x).cos();
        (0.4 + 0.25 * wave) as f32
    })
}

/// Waves of many lengths and directions, which match at one place only.
fn waves(width: usize, height: usize, number: u64, moved: (f64, f64)) -> Exposed {
    exposed(width, height, number, |c, y, x| {
        let (x, y) = (x as f64 - moved.0, y as f64 - moved.1);
        let wave = |k: usize| {
            let (turn, length) = (2.4 * k as f64 + c as f64, 9.0 * 1.23f64.powi(k as i32));
            ((x * turn.cos() + y * turn.sin()) * std::f64::consts::TAU / length).sin()
        };
        (0.4 + 0.06 * (0..10).map(wave).sum::<f64>()) as f32
    })
}

/// Nothing but noise, which matches anywhere.
fn noise(width: usize, height: usize, number: u64) -> Exposed {
    exposed(width, height, number, |c, y, x| {
        let mut hash = (number << 40 | (c << 32 | y << 16 | x) as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        hash ^= hash >> 29;
        hash = hash.wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (hash >> 40) as f32 / (1u64 << 24) as f32
    })
}

/// Flow and confidence.
fn between(matcher: &mut Matcher, [older, newer]: &[Exposed; 2]) -> (Vec<f32>, Vec<f32>) {
    let mut own = Own::default();
    let flow = matcher.between(&Pair { older, newer, gain_step: None }, &mut own).unwrap();
    (flow.vectors.to_vec(), flow.confidence.to_vec())
}

#[test]
fn a_fused_graph_gives_the_plain_ones_flow() {
    // Far more than the finest levels reach, so that the coarse ones fetch from far and from outside.
    let mut pairs = vec![(APART, [waves(320, 256, 3, (0.0, 0.0)), waves(320, 256, 4, (-23.0, 17.0))])];
    for (number, (width, height)) in [(64, 64), (128, 64), (150, 90), (320, 256), (64, 448)].into_iter().enumerate() {
        let number = 2 * number as u64 + 5;
        pairs.push((APART_IN_NOISE, [noise(width, height, number), noise(width, height, number + 1)]));
    }
    for network in networks() {
        let [mut plain, mut fused] = [Operators::Plain, Operators::Fused].map(|operators| open(&network, operators, 2));
        let first = (APART, [golden(192, 128, 1, (0.0, 0.0)), golden(192, 128, 2, (2.0, 1.0))]);
        for (allowed, pair) in std::iter::once(&first).chain(&pairs) {
            let (wanted, found) = (between(&mut plain, pair), between(&mut fused, pair));
            let apart = |wanted: &[f32], found: &[f32]| {
                assert_eq!(wanted.len(), found.len());
                // In units of what is allowed.
                let apart = |(a, b): (&f32, &f32)| (a - b).abs() / allowed.max(APART_PART * a.abs());
                wanted.iter().zip(found).map(apart).fold(0.0, f32::max)
            };
            let (flow, confidence) = (apart(&wanted.0, &found.0), apart(&wanted.1, &found.1));
            let size = format!("{network}, {} × {}", pair[0].width, pair[0].height);
            println!("{size}: flow {flow:.3} of what is allowed, confidence {confidence:.3}");
            assert!(
                flow <= 1.0 && confidence <= 1.0,
                "{size}: flow {flow} times what is allowed, confidence {confidence}"
            );
        }
    }
}

#[test]
fn a_fused_graph_gives_the_same_bits_again() {
    let pair = [golden(320, 256, 1, (0.0, 0.0)), golden(320, 256, 2, (2.0, 1.0))];
    for network in networks() {
        let bits = |matcher: &mut Matcher| -> Vec<u32> {
            let (flow, confidence) = between(matcher, &pair);
            flow.iter().chain(&confidence).map(|value| value.to_bits()).collect()
        };
        let mut two = open(&network, Operators::Fused, 2);
        let first = bits(&mut two);
        assert!(first == bits(&mut two) && first == bits(&mut open(&network, Operators::Fused, 2)));
    }
}

#[test]
fn a_network_without_a_fused_graph_runs_its_plain_one() {
    let matcher = Matcher::open(&Config { network: "raftsmall_fcdn_4".into(), ..Config::default() }).unwrap();
    assert_eq!(matcher.model().operators, Operators::Plain);
}

#[test]
fn a_cost_volume_takes_memory_at_the_first_call_of_a_size_only() {
    let shape = Shape { channels: 32, height: 24, width: 40, reach: 4 };
    let features: Vec<f32> = (0..32 * 24 * 40).map(|i| (i as f32 * 0.37).sin()).collect();
    let flow = vec![0.4; 2 * 24 * 40];
    let (mut volume, mut argmax) = (vec![0.0; 81 * 24 * 40], vec![0.0; 2 * 24 * 40]);
    let mut work = CostVolume::default();
    let mut run = || {
        let inputs = Inputs { older: &features, newer: &features, flow: &flow, sharpness: 1.0, gain: 4.0 };
        let outputs = Outputs { volume: &mut volume, argmax: &mut argmax };
        let spread = |count: usize, work: &(dyn Fn(usize) + Sync)| -> Result<(), Unfit> {
            (0..count).for_each(work);
            Ok(())
        };
        work.compute(shape, &inputs, outputs, spread).unwrap();
    };
    assert!(allocations::during(&mut run).1.calls > 0);
    assert_eq!(allocations::during(|| (0..10).for_each(|_| run())).1, Allocations { calls: 0, peak: 0 });
}

/// How often a few steps ask for memory, once a network has its own.
fn taken(mut matcher: Matcher) -> usize {
    let [older, newer] = &[golden(192, 128, 1, (0.0, 0.0)), golden(192, 128, 2, (2.0, 1.0))];
    let mut own = Own::default();
    let mut run = || matcher.between(&Pair { older, newer, gain_step: None }, &mut own).map(drop).unwrap();
    (0..3).for_each(|_| run());
    allocations::during(|| (0..5).for_each(|_| run())).1.calls
}

#[test]
fn a_fused_step_takes_no_more_memory_than_a_plain_one() {
    for network in networks() {
        let [plain, fused] = [Operators::Plain, Operators::Fused].map(|operators| taken(open(&network, operators, 2)));
        assert_eq!(plain, fused, "{network}");
    }
}

/// How far apart flow in bf16 and in 32 bits may be where everything matches, in pixels: on average, and anywhere.
const BF16_APART: [f32; 2] = [0.01, 0.5];

/// Every network with graphs in bf16, that was judged in it.
fn networks_in_bf16() -> Vec<String> {
    let entries = nightflow::flow::manifest::entries(&models()).unwrap();
    let found: Vec<String> = entries.into_iter().filter(|(_, entry)| entry.has_tiles()).map(|(name, _)| name).collect();
    assert!(!found.is_empty(), "no network of the manifest has graphs in bf16");
    found
}

/// Opens a network in bf16; where there are no tiles for it, that must be said, and nothing is left to see.
fn open_in_bf16(network: &str, threads: usize) -> Option<Matcher> {
    let network = network.into();
    let config = Config { network, models: models(), precision: Precision::Bf16, threads, ..Config::default() };
    match (Matcher::open(&config), Unit::best().is_fast()) {
        (Ok(matcher), true) => {
            assert!(matcher.model().sha256.iter().all(|(file, _)| file.ends_with("_bf16.onnx")));
            let by = format!("in bf16 by {}", Unit::best().name());
            assert!(matcher.model().provider.ends_with(&by), "{}", matcher.model().provider);
            Some(matcher)
        }
        (Err(error), false) => {
            assert!(
                error
                    .to_string()
                    .contains("it needs Linux and a processor with bf16 in AVX-512 (AMD's since Zen 4) or AMX"),
                "{error}"
            );
            None
        }
        (Ok(_), false) => panic!("opened without tiles"),
        (Err(error), true) => panic!("{error}"),
    }
}

#[test]
fn bf16_gives_the_flow_of_32_bits_or_says_what_it_needs() {
    let pairs = [
        [waves(320, 256, 1, (0.0, 0.0)), waves(320, 256, 2, (2.0, 1.0))],
        [waves(320, 256, 3, (0.0, 0.0)), waves(320, 256, 4, (-6.0, 4.0))],
        [waves(150, 90, 5, (0.0, 0.0)), waves(150, 90, 6, (1.5, 0.5))],
    ];
    for network in networks_in_bf16() {
        let Some(mut tiles) = open_in_bf16(&network, 2) else { continue };
        let mut one_thread = open_in_bf16(&network, 1).unwrap();
        let mut wide = open(&network, Operators::Fused, 2);
        for pair in &pairs {
            let (wanted, found) = (between(&mut wide, pair), between(&mut tiles, pair));
            let apart: Vec<f32> = wanted.0.iter().zip(&found.0).map(|(a, b)| (a - b).abs()).collect();
            let (mean, most) =
                (apart.iter().sum::<f32>() / apart.len() as f32, apart.iter().copied().fold(0.0, f32::max));
            println!("{network}, {} × {}: {mean:.4} px on average, {most:.3} at most", pair[0].width, pair[0].height);
            assert!(mean < BF16_APART[0] && most < BF16_APART[1], "{network}: {mean} px on average, {most} at most");
            assert!(
                found == between(&mut tiles, pair) && found == between(&mut one_thread, pair),
                "the same bits again"
            );
        }
    }
}

#[test]
fn a_step_in_bf16_takes_no_more_memory_than_a_plain_one() {
    for network in networks_in_bf16() {
        let Some(tiles) = open_in_bf16(&network, 2) else { continue };
        assert_eq!(taken(tiles), taken(open(&network, Operators::Plain, 2)), "{network}");
    }
}

/// One test of a process that has opened no network yet, which is when opening at once went wrong.
#[test]
fn networks_open_from_many_threads_at_once() {
    if std::env::var_os("NIGHTFLOW_OPEN_AT_ONCE").is_some() {
        let gate = std::sync::Barrier::new(6);
        std::thread::scope(|scope| {
            for _ in 0..6 {
                scope.spawn(|| {
                    gate.wait();
                    open("pwcnet_fcdn_fast", Operators::Fused, 1);
                });
            }
        });
        return;
    }
    // Without the lock some three of ten such starts fail.
    for _ in 0..8 {
        let child = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "fused::networks_open_from_many_threads_at_once"])
            .env("NIGHTFLOW_OPEN_AT_ONCE", "1")
            .output()
            .unwrap();
        assert!(child.status.success(), "{}", String::from_utf8_lossy(&child.stdout));
    }
}
