//! What it brings to read each frame while the one before it is in the network: `cargo bench --bench ahead [-- ROUNDS]`.
//!
//! The same frames through the same network, one stage after the other in one thread and as the node does it, in turns. Frames
//! come as fast as they are taken; they are copied out of memory, as a transport's are.

use std::{
    error::Error,
    path::Path,
    process::ExitCode,
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use nightflow::{
    camera::{self, Counts, Frame, Next, Sample, Source},
    clock::{Stamp, Untimed},
    config::Config,
    flow::{Own, convolutions},
    node::{self, Outputs},
    pipeline::{Outcome, Pipeline},
    wire::Image,
};

#[allow(dead_code)]
mod rivals;

const SIZES: [[u32; 2]; 2] = [[640, 480], [1280, 1024]];
const FRAMES: usize = 60;
const ROUNDS: usize = 9;
const STEP_NS: i64 = 33_333_333;

/// Gives copies of four frames in turn, each with its stamp.
struct Memory {
    images: Arc<Vec<Image>>,
    next: usize,
    frames: usize,
}

impl Source for Memory {
    fn next(&mut self, _: Duration) -> Result<Next, camera::Error> {
        if self.next == self.frames {
            return Ok(Next::End);
        }
        let mut image = self.images[self.next % self.images.len()].clone();
        image.header.stamp = Stamp(1_000_000_000 + self.next as i64 * STEP_NS).into();
        self.next += 1;
        Ok(Next::Sample(Sample::Frame(Arc::new(Frame { image, received: Stamp::default() }))))
    }

    fn counts(&self) -> Counts {
        Counts::default()
    }

    fn progress(&self) -> Option<f64> {
        Some(self.next as f64 / self.frames as f64)
    }
}

/// Milliseconds a frame, one stage after the other.
fn in_turn(pipeline: &mut Pipeline, mut source: Memory) -> Result<f64, Box<dyn Error>> {
    let (begin, mut own, frames) = (Instant::now(), Own::default(), source.frames);
    let mut steps = 0;
    while let Next::Sample(sample) = source.next(Duration::ZERO)? {
        steps += usize::from(matches!(pipeline.step(&sample, &mut own, &mut Untimed)?, Outcome::Moved(_)));
    }
    enough(steps, frames)?;
    Ok(begin.elapsed().as_secs_f64() * 1e3 / frames as f64)
}

/// Milliseconds a frame, as the node does it.
fn beside(pipeline: &mut Pipeline, source: Memory) -> Result<f64, Box<dyn Error>> {
    let (begin, frames) = (Instant::now(), source.frames);
    let mut source: Option<Box<dyn Source>> = Some(Box::new(source));
    let gone = || camera::Error::Lost { source_name: "memory".into(), reason: "it is read once".into() };
    let mut open = || source.take().ok_or_else(gone);
    let stop = AtomicBool::new(false);
    let settings = (Duration::from_secs(5), None);
    let report = node::drive(&mut open, Some(pipeline), &mut Outputs::default(), &stop, settings, &mut |_, _| {})?;
    enough(report.steps as usize, frames)?;
    Ok(begin.elapsed().as_secs_f64() * 1e3 / frames as f64)
}

/// Only the first frame has no partner.
fn enough(steps: usize, frames: usize) -> Result<(), String> {
    if steps + 1 == frames {
        Ok(())
    } else {
        Err(format!("{frames} frames should give one step less, they gave {steps}"))
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn report(frames: usize, rounds: usize) -> Result<(), Box<dyn Error>> {
    let mut ways = vec![("fp32", "")];
    if convolutions::Unit::best().is_fast() {
        ways.push(("bf16", "precision = \"bf16\"\n"));
    }
    println!("{frames} frames, {rounds} rounds in turns; milliseconds a frame, medians:\n");
    println!(
        "| precision, network's threads, camera | one after the other | beside the network | ratio |\n|{}",
        " --- |".repeat(4)
    );
    for ((precision, settings), threads) in ways.into_iter().flat_map(|way| [1, 2].map(|threads| (way, threads))) {
        let text = format!(
            "[flow]\nthreads = {threads}\n{settings}[exposure]\nbit_depth = 12\nblack_level = {}\n",
            rivals::BLACK
        );
        let config = Config::parse(&text, Path::new("ahead"))?;
        for size in SIZES {
            // Moves by four pixels a frame, so that there is something to match.
            let images = Arc::new((0..4).map(|number| rivals::image(size, 4 * number, 1)).collect::<Vec<_>>());
            let source = || Memory { images: Arc::clone(&images), next: 0, frames };
            let (mut serial, mut node, mut ratios) = (vec![], vec![], vec![]);
            for round in 0..=rounds {
                // New ones, for stamps go back at the beginning of a round.
                let (mut one, mut other) = (Pipeline::open(&config)?, Pipeline::open(&config)?);
                let both = if round % 2 == 0 {
                    let first = in_turn(&mut one, source())?;
                    [first, beside(&mut other, source())?]
                } else {
                    let first = beside(&mut other, source())?;
                    [in_turn(&mut one, source())?, first]
                };
                // The first round is to warm up.
                if round > 0 {
                    serial.push(both[0]);
                    node.push(both[1]);
                    ratios.push(both[1] / both[0]);
                }
            }
            let [width, height] = size;
            println!(
                "| {precision}, {threads}, {width}×{height} | {:.2} | {:.2} | {:.3} |",
                median(serial),
                median(node),
                median(ratios)
            );
        }
    }
    Ok(())
}

fn main() -> ExitCode {
    let bench = std::env::args().any(|word| word == "--bench");
    let given = std::env::args().skip(1).find(|word| !word.starts_with("--")).and_then(|word| word.parse().ok());
    // Under `cargo test --benches` it only shows that it still runs.
    let (frames, rounds) = if bench { (FRAMES, ROUNDS) } else { (4, 1) };
    if let Err(reason) = report(frames, given.unwrap_or(rounds)) {
        eprintln!("reading ahead was not measured: {reason}");
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}
