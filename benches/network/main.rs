//! What the fused cost volume gains: `cargo bench --bench network`, with `-- models FOLDER` for other models.
//!
//! Everything that is compared runs in turns, so that other work on the machine strikes both alike; figures are medians.
//! Decoders run through ONNX Runtime, as in the node. The cost volume alone, with its warp and soft arg-max, runs on one
//! thread and is compared with the same in ONNX Runtime with a slice, a product and a mean for each displacement, with those
//! products and means written out in Rust (without warp and arg-max, so that it does less), and with a copy of as many bytes
//! as go in and out.

use std::{
    collections::BTreeSet,
    hint::black_box,
    path::{Path, PathBuf},
    process::ExitCode,
    time::Instant,
};

use multiversion::multiversion;
use nightflow::{
    exposure::Pair,
    flow::{
        Config, Error, Matcher, Operators, Own,
        cost_volume::{CostVolume, Inputs, Outputs, Shape, Unfit},
        pattern,
    },
};

#[allow(dead_code)]
#[path = "../../tests/it/onnx_bytes.rs"]
mod onnx_bytes;
mod sliced;

const SIZES: [(usize, usize); 2] = [(320, 256), (640, 512)];
const THREADS: [usize; 2] = [1, 2];

/// How often things run.
#[derive(Clone, Copy)]
struct Rounds {
    decoder: usize,
    volume: usize,
}

/// Milliseconds of each of the things that run in turns: the median of all rounds.
fn medians<const N: usize>(rounds: usize, things: &mut [&mut dyn FnMut(); N]) -> [f64; N] {
    let mut times = [const { Vec::new() }; N];
    for round in 0..=rounds {
        for (thing, times) in things.iter_mut().zip(&mut times) {
            let start = Instant::now();
            thing();
            // The first round takes memory.
            if round > 0 {
                times.push(start.elapsed().as_secs_f64() * 1e3);
            }
        }
    }
    times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    })
}

/// Networks that have a fused graph, by the manifest.
fn networks(models: &Path) -> Result<BTreeSet<String>, String> {
    let path = models.join("manifest.toml");
    let text = std::fs::read_to_string(&path).map_err(|error| format!("{}: {error}", path.display()))?;
    let table: toml::Table = text.parse().map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(table.into_iter().filter(|(_, entry)| entry.get("fused").is_some()).map(|(name, _)| name).collect())
}

/// The decoder with both kinds of operators: a pair's features are kept, so that only the decoder runs.
fn decoders(models: &Path, rounds: Rounds) -> Result<(), String> {
    println!("decoder, ms            plain    fused    plain/fused");
    for network in networks(models)? {
        for (width, height) in SIZES {
            let pair = [pattern(width, height, 1), pattern(width, height, 2)];
            for threads in THREADS {
                let open = |operators| {
                    let config = Config {
                        network: network.clone(),
                        models: models.into(),
                        operators,
                        threads,
                        golden_check: false,
                        ..Config::default()
                    };
                    Matcher::open(&config).map_err(|error| error.to_string())
                };
                let (mut plain, mut fused) = (open(Operators::Plain)?, open(Operators::Fused)?);
                let step = |matcher: &mut Matcher| {
                    let [older, newer] = &pair;
                    let mut own = Own::default();
                    let flow = matcher.between(&Pair { older, newer, gain_step: None }, &mut own);
                    black_box(flow.expect("the pair is right").vectors[0]);
                };
                let [plain, fused] = medians(rounds.decoder, &mut [&mut || step(&mut plain), &mut || step(&mut fused)]);
                let what =
                    format!("{network} {width}x{height}, {threads} thread{}", if threads == 1 { "" } else { "s" });
                println!("{what}\n{:>29.1}{fused:>9.1}{:>13.2}", plain, plain / fused);
            }
        }
    }
    Ok(())
}

/// The products and means of one displacement after the other, each over whole planes, as sliced graphs compute them.
#[multiversion(targets("x86_64+avx512f+avx512bw+avx512dq+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
fn written_out(shape: &Shape, older: &[f32], padded: &[f32], products: &mut [f32], volume: &mut [f32]) {
    let (Shape { channels, height, width, .. }, side) = (*shape, shape.side());
    let wide = width + side - 1;
    for (d, mean) in volume.chunks_exact_mut(height * width).enumerate() {
        let (dy, dx) = (d / side, d % side);
        for (c, products) in products.chunks_exact_mut(height * width).enumerate() {
            let plane = &padded[c * wide * (height + side - 1)..];
            for (y, products) in products.chunks_exact_mut(width).enumerate() {
                let older = &older[(c * height + y) * width..][..width];
                let newer = &plane[(y + dy) * wide + dx..][..width];
                products.iter_mut().zip(older).zip(newer).for_each(|((product, a), b)| *product = a * b);
            }
        }
        mean.fill(0.0);
        for products in products.chunks_exact(height * width) {
            mean.iter_mut().zip(products).for_each(|(mean, product)| *mean += product);
        }
        mean.iter_mut().for_each(|mean| *mean *= 4.0 / channels as f32);
    }
}

/// The cost volume of one level: fused, sliced both ways, and a copy of as much memory as it reads and writes.
fn volume(shape: Shape, rounds: Rounds) -> Result<(), Error> {
    let (Shape { channels, height, width, .. }, side) = (shape, shape.side());
    let cells = height * width;
    let noise = |k: usize, count: usize| -> Vec<f32> {
        (0..count).map(|i| ((i * 7919 + k * 104_729) % 1009) as f32 / 504.0 - 1.0).collect()
    };
    let (older, newer) = (noise(1, channels * cells), noise(2, channels * cells));
    let flow: Vec<f32> = noise(3, 2 * cells).iter().map(|value| 2.0 * value).collect();
    let padded = noise(4, channels * (height + side - 1) * (width + side - 1));
    let (mut volumes, mut argmax) = ([(); 2].map(|()| vec![0.0; shape.displacements() * cells]), vec![0.0; 2 * cells]);
    let [fused_volume, sliced_volume] = &mut volumes;
    let mut products = vec![0.0; channels * cells];
    let mut work = CostVolume::default();
    let moved = (2 * channels + 2 + 2 + shape.displacements()) * cells;
    // A copy reads and writes: half of the values that move.
    let (from, mut to) = (noise(5, moved / 2), vec![0.0; moved / 2]);
    let mut fused = || {
        let inputs = Inputs { older: &older, newer: &newer, flow: &flow, sharpness: 3.0, gain: 4.0 };
        let outputs = Outputs { volume: fused_volume, argmax: &mut argmax };
        let done: Result<(), Unfit> = work.compute(shape, &inputs, outputs, |count, work| {
            (0..count).for_each(work);
            Ok(())
        });
        done.expect("everything fits");
    };
    let mut graph = sliced::graph(shape)?;
    let (grid, offsets) = (sliced::grid(&shape, &flow), noise(6, 2 * shape.displacements()));
    let mut in_runtime = || {
        let features = &[1, channels, height, width][..];
        let (places, each) = ([1, height, width, 2], [2, shape.displacements(), 1, 1]);
        graph
            .run_on(&[(&older, features), (&newer, features), (&grid, &places), (&offsets, &each)])
            .expect("the graph fits")
            .1
    };
    let mut runtime = || drop(black_box(in_runtime()));
    let mut slices = || written_out(&shape, &older, &padded, &mut products, sliced_volume);
    let mut copy = || black_box(&mut to).copy_from_slice(black_box(&from));
    let [fused, runtime, slices, copy] =
        medians(rounds.volume, &mut [&mut fused, &mut runtime, &mut slices, &mut copy]);
    let apart = in_runtime().iter().zip(&*fused_volume).map(|(a, b)| (4.0 * a - b).abs()).fold(0.0, f32::max);
    assert!(apart < 1e-3, "the runtime's volume is off by {apart}");
    let gigabytes = |ms: f64| 4.0 * moved as f64 / ms / 1e6;
    let operations = 2.0 * (channels * shape.displacements() * cells) as f64 / fused / 1e6;
    println!(
        "{:<22}{fused:>7.2}{runtime:>11.2}{:>8.1}{slices:>9.2}{:>8.1}{operations:>10.1}{:>7.2}{:>10.1}{:>12.2}",
        format!("{channels}x{height}x{width}, +-{}", shape.reach),
        runtime / fused,
        slices / fused,
        gigabytes(fused),
        gigabytes(copy),
        copy / fused,
    );
    Ok(())
}

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().collect();
    // Under `cargo test --benches` it only shows that it still runs.
    let measured = words.iter().any(|word| word == "--bench");
    let rounds = if measured { Rounds { decoder: 15, volume: 60 } } else { Rounds { decoder: 1, volume: 1 } };
    let named = words.iter().position(|word| word == "models").and_then(|at| words.get(at + 1));
    let models = named.map_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/models")), PathBuf::from);
    println!(
        "cost volume, 1 thread   fused, ms  sliced: runtime, /fused, Rust, /fused   GFLOP/s   GB/s  a copy's  of a copy's"
    );
    for (channels, width, reach) in [(128, 40, 4), (32, 80, 2), (128, 80, 4), (32, 160, 2)] {
        if let Err(error) = volume(Shape { channels, height: width * 4 / 5, width, reach }, rounds) {
            eprintln!("the cost volumes were not measured: {error}");
            return ExitCode::FAILURE;
        }
    }
    if let Err(reason) = decoders(&models, rounds) {
        eprintln!("the decoders were not measured: {reason}");
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}
