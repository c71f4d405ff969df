//! All that a step costs beside the network, from the camera's bytes to published flow: `cargo bench --bench road`.

use std::{
    path::Path,
    process::{Command, ExitCode},
    sync::Arc,
    time::Instant,
};

use nightflow::{
    camera::{Frame, Sample},
    clock::{Stamp, Stopwatch},
    config::Config,
    flow::{Error, Matcher, Model, Network, Raster, Slot, padding::Padded},
    pipeline::{Outcome, Pipeline},
    publish::{Iceoryx2, Moved, iceoryx2::SharedSink},
    wire::{CameraInfo, Header, Imu, Range},
};

mod rivals;

use rivals::{BLACK, hash, image, python};

const WIDTH: u32 = 1280;
const HEIGHT: u32 = 1024;
/// Cells of the flow at a quarter of 320×256.
const CELLS: [usize; 2] = [80, 64];
const STEPS: usize = 400;
/// Between two frames.
const STEP_NS: i64 = 33_333_333;

fn frame(seed: u32) -> Frame {
    Frame { image: image([WIDTH, HEIGHT], 0, seed), received: Stamp::default() }
}

fn header(ns: i64) -> Header {
    Header { stamp: Stamp(ns).into(), frame_id: "camera".into() }
}

/// A network that costs two copies: it hands out vectors as a real one would find them, one in three of them wrong.
struct Given {
    flow: Vec<f32>,
    uncertainty: Vec<f32>,
    model: Model,
}

impl Given {
    fn new() -> Self {
        let draw = |i: usize, k: u32| (hash(i as u32, k, 7) >> 8) as f32 / (1 << 24) as f32 - 0.5;
        let cells = CELLS[0] * CELLS[1];
        let wrong = |i: usize| if draw(i, 4) < -1.0 / 6.0 { 30.0 } else { 1.0 };
        let vector = |i: usize| [6.0 + wrong(i) * draw(i, 1), -3.0 + wrong(i) * draw(i, 2)];
        Self {
            flow: (0..cells).flat_map(vector).collect(),
            uncertainty: (0..cells).map(|i| 0.5 + 0.4 * draw(i, 3)).collect(),
            model: Model::default(),
        }
    }
}

impl Network for Given {
    fn describe(&mut self, _: Slot, _: &Padded<'_>) -> Result<(), Error> {
        Ok(())
    }

    fn between(&mut self, _: Slot, _: [f32; 2], out: Raster<'_>) -> Result<(), Error> {
        out.flow.copy_from_slice(&self.flow);
        out.uncertainty.copy_from_slice(&self.uncertainty);
        Ok(())
    }

    fn model(&self) -> &Model {
        &self.model
    }
}

/// What a node does with each frame, and how long it takes: milliseconds of each step, sorted, and the last step.
fn steps(config: &Config, matcher: Matcher, count: usize) -> (Vec<f64>, Moved) {
    let mut pipeline = Pipeline::with(config, matcher).expect("the settings are right");
    let settings = Iceoryx2 {
        prefix: format!("nightflow_bench/road/{}", std::process::id()),
        subscribers_max: 2,
        cells_max: CELLS[0] * CELLS[1],
    };
    let mut sink = SharedSink::open(&config.publish, &settings).expect("shared memory");
    let mut frames = [1, 2].map(|seed| Arc::new(frame(seed)));
    let k = [900.0, 0.0, 639.5, 0.0, 900.0, 511.5, 0.0, 0.0, 1.0];
    // A mild lens: the given vectors are those of a plane, which a strong one would not show alike everywhere.
    let d = vec![-0.02, 0.005, 0.0, 0.0, 0.0];
    let info =
        CameraInfo { width: WIDTH, height: HEIGHT, k, d, distortion_model: "plumb_bob".into(), ..Default::default() };
    let mut times = Vec::new();
    let mut last = None;
    let mut watch = Stopwatch::default();
    pipeline.step(&Sample::Info(info.into()), sink.lender(), &mut watch).expect("a calibration");
    for i in 0..count {
        let at = 1_000_000_000 + i as i64 * STEP_NS;
        for j in 0..7 {
            let mut imu = Imu { header: header(at + j * 5_000_000), ..Imu::default() };
            imu.angular_velocity.x = 0.02;
            imu.angular_velocity.y = -0.01;
            pipeline.step(&Sample::Imu(imu.into()), sink.lender(), &mut watch).expect("a gyro sample");
        }
        let range = Range { header: header(at), max_range: 60.0, range: 5.0, ..Range::default() };
        pipeline.step(&Sample::Range(range.into()), sink.lender(), &mut watch).expect("a range");
        // Nobody else holds the frame, so that it is written where it stands.
        Arc::get_mut(&mut frames[i % 2]).expect("the frame is ours").image.header = header(at);
        let sample = Sample::Frame(Arc::clone(&frames[i % 2]));
        let start = Instant::now();
        let outcome = pipeline.step(&sample, sink.lender(), &mut watch).expect("the frame is right");
        if let Outcome::Moved(moved) = outcome {
            sink.send(&moved).expect("room in shared memory");
            times.push(start.elapsed().as_secs_f64() * 1e3);
            last = Some(moved);
        }
    }
    times.sort_by(f64::total_cmp);
    (times, last.expect("at least two frames"))
}

/// Runs the rival on the same frames and vectors; it prints its times and the velocity that it finds.
fn rival(given: &Given) -> Result<([f64; 2], [f64; 3]), String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = python()?;
    let vectors = root.join("target/rivals/vectors.f32");
    let bytes: Vec<u8> = given.flow.iter().chain(&given.uncertainty).flat_map(|value| value.to_le_bytes()).collect();
    std::fs::write(&vectors, bytes).map_err(|error| format!("{}: {error}", vectors.display()))?;
    let script = root.join("benches/rivals/road.py");
    let output = Command::new(python).arg(script).arg(&vectors).output().map_err(|error| error.to_string())?;
    let printed = String::from_utf8_lossy(&output.stdout);
    if !output.status.success() {
        return Err(format!("the rival failed:\n{printed}{}", String::from_utf8_lossy(&output.stderr)));
    }
    let numbers = |name: &str| -> Result<Vec<f64>, String> {
        let line = printed.lines().find_map(|line| line.strip_prefix(name)).ok_or(format!("no line {name:?}"))?;
        line.split_whitespace().map(|word| word.parse().map_err(|error| format!("{word:?}: {error}"))).collect()
    };
    for line in printed.lines().filter(|line| line.starts_with("numpy") || line.starts_with("stages")) {
        println!("{line}");
    }
    let times = numbers("best_and_median_ms ")?.try_into().map_err(|_| "two times are expected".to_owned())?;
    let velocity = numbers("velocity ")?.try_into().map_err(|_| "three numbers are expected".to_owned())?;
    Ok((times, velocity))
}

fn report(count: usize) -> Result<(), String> {
    let mut config = Config::default();
    config.exposure.bit_depth = Some(12);
    config.exposure.black_level = Some(BLACK as f32);
    // Downward over the ground, seen at an angle of the level: the defaults of the odometer.
    let given = Given::new();
    // The rival takes the vectors as they are given, so that both do the same work; refining is told for itself.
    let plain = |config: &Config| steps(config, Matcher::with(&config.flow, Box::new(Given::new())), count);
    let (refined, _) = plain(&config);
    config.flow.refine = false;
    // It takes the gyro at its word, so ours does not follow what the vectors show of the turn, though it looks.
    (config.motion.ground_bend_sd, config.motion.ground_slope_sd) = (1e6, 1e6);
    let (times, last) = plain(&config);
    let [best, median] = [times[0], times[times.len() / 2]];
    let real = Matcher::open(&config.flow).map_err(|error| error.to_string())?;
    let (with_network, _) = steps(&config, real, (count / 8).max(3));
    let network = with_network[with_network.len() / 2] - median;
    let ours = last.velocity.map_err(|lack| format!("no velocity: {lack:?}"))?;
    println!("1280x1024, 12 of 16 bits, to 320x256, camera bytes to published flow, {} steps:", times.len());
    println!(
        "  all but the network: best {best:.3} ms, median {median:.3} ms; the network {network:.1} ms: {:.2} %",
        100.0 * median / network
    );
    println!("  refining the vectors: median {:.3} ms more", refined[refined.len() / 2] - median);
    let ([their_best, their_median], velocity) = rival(&given)?;
    println!(
        "  the same in numpy + OpenCV: best {their_best:.3} ms, median {their_median:.3} ms: {:.1} and {:.1} times ours",
        their_best / best,
        their_median / median
    );
    println!("  velocity {:?} m/s, theirs {velocity:?}", ours.linear);
    let apart = (0..3).map(|i| (ours.linear[i] - velocity[i]).powi(2)).sum::<f64>().sqrt();
    if apart > 1e-3 {
        return Err(format!("the velocities are {apart} m/s apart: not the same work"));
    }
    Ok(())
}

fn main() -> ExitCode {
    // Under `cargo test --benches` it only shows that it still runs.
    let count = if std::env::args().any(|word| word == "--bench") { STEPS } else { 8 };
    if let Err(reason) = report(count) {
        eprintln!("the road was not measured: {reason}");
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}
