//! How long a frame takes to develop, beside the same steps in numpy and OpenCV: `cargo bench --bench exposure`.

use std::{
    hint::black_box,
    path::Path,
    process::{Command, ExitCode},
    time::{Duration, Instant},
};

use criterion::Criterion;
use nightflow::{
    camera::Frame,
    clock::Stamp,
    exposure::{Config, Developer, Exposed, Packing, Pattern},
    wire::{Header, Image, Time},
};

// The other bench uses the rest.
#[allow(dead_code)]
mod rivals;

use rivals::{BLACK, count, python};

fn counts(width: u32, height: u32, seed: u32) -> Vec<u16> {
    (0..height).flat_map(|y| (0..width).map(move |x| count(x, y, seed))).collect()
}

fn frame(encoding: &str, width: u32, height: u32, step: u32, seed: u32, bytes: Vec<u8>) -> Frame {
    let stamp = Time { sec: seed as i32, nanosec: 0 };
    let header = Header { stamp, frame_id: "camera".into() };
    let image = Image { header, height, width, encoding: encoding.into(), is_bigendian: 0, step, data: bytes };
    Frame { image, received: Stamp::default() }
}

fn wide(width: u32, height: u32, seed: u32) -> Frame {
    let bytes = counts(width, height, seed).into_iter().flat_map(u16::to_le_bytes).collect();
    frame("bayer_rggb16", width, height, 2 * width, seed, bytes)
}

fn packed(width: u32, height: u32, seed: u32) -> Frame {
    let counts = counts(width, height, seed);
    let (pairs, _) = counts.as_chunks::<2>();
    let bytes =
        pairs.iter().flat_map(|[a, b]| [(a >> 4) as u8, (b >> 4) as u8, (a & 15) as u8 | ((b & 15) as u8) << 4]);
    frame("8UC1", width, height, width / 2 * 3, seed, bytes.collect())
}

fn bytes(width: u32, height: u32, seed: u32) -> Frame {
    let bytes = counts(width, height, seed).into_iter().map(|count| (count >> 4) as u8).collect();
    frame("bayer_rggb8", width, height, width, seed, bytes)
}

fn twelve_bits() -> Config {
    Config { bit_depth: Some(12), black_level: Some(BLACK as f32), ..Config::default() }
}

/// What a drone would give: each frame differs from the one before.
fn cases() -> Vec<(&'static str, Config, [Frame; 2])> {
    let big_endian = [1, 2].map(|seed| {
        let mut frame = wide(1280, 1024, seed);
        frame.image.data.chunks_exact_mut(2).for_each(|pair| pair.swap(0, 1));
        frame.image.is_bigendian = 1;
        frame
    });
    let raw12 = Config { packing: Some(Packing::Raw12), pattern: Some(Pattern::Rggb), ..twelve_bits() };
    let mixed = Config { width_max: 300, ..twelve_bits() };
    let eight = Config { black_level: Some(4.0), ..Config::default() };
    vec![
        ("12 of 16 bits, by 4", twelve_bits(), [1, 2].map(|seed| wide(1280, 1024, seed))),
        ("12 of 16 bits, big-endian", twelve_bits(), big_endian),
        ("12 of 16 bits, by 4.27", mixed, [1, 2].map(|seed| wide(1280, 1024, seed))),
        ("8 bits", eight, [1, 2].map(|seed| bytes(1280, 1024, seed))),
        ("packed RAW12", raw12, [1, 2].map(|seed| packed(1280, 1024, seed))),
        ("640x480, 12 of 16 bits, by 2", twelve_bits(), [1, 2].map(|seed| wide(640, 480, seed))),
    ]
}

fn ours(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("develop 1280x1024");
    for (name, config, frames) in cases() {
        let mut developer = Developer::new(&config).expect("the settings are right");
        let mut newest = frames.iter().cycle();
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                developer.develop(newest.next().expect("a cycle has no end")).expect("the frame is right");
                black_box(developer.pair().map(|pair| pair.newer.gain))
            });
        });
    }
    group.finish();
}

/// The shortest and the median time over one case in milliseconds, and the newest image.
fn timed(config: &Config, frames: &[Frame]) -> ([f64; 2], Exposed) {
    let mut developer = Developer::new(config).expect("the settings are right");
    let mut times: Vec<Duration> = Vec::new();
    for frame in frames.iter().cycle().take(400) {
        let start = Instant::now();
        developer.develop(frame).expect("the frame is right");
        black_box(developer.pair().map(|pair| pair.newer.gain));
        times.push(start.elapsed());
    }
    times.sort_unstable();
    let newest = developer.newest().expect("a frame was developed");
    ([times[0], times[times.len() / 2]].map(|time| time.as_secs_f64() * 1e3), newest.clone())
}

/// Runs the rival on the same frames, has it compare images, and prints both times.
fn against_the_rival() -> Result<(), String> {
    let (ours, newest) = timed(&twelve_bits(), &[1, 2].map(|seed| wide(1280, 1024, seed)));
    let image = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/rivals/developed.f32");
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/rivals/develop.py");
    let python = python()?;
    let bytes: Vec<u8> = newest.rgb.iter().flat_map(|value| value.to_le_bytes()).collect();
    std::fs::write(&image, bytes).map_err(|error| format!("{}: {error}", image.display()))?;
    let output = Command::new(python)
        .arg(script)
        .arg(&image)
        .arg(newest.saturated_part.to_string())
        .output()
        .map_err(|error| error.to_string())?;
    let printed = String::from_utf8_lossy(&output.stdout);
    if !output.status.success() {
        return Err(format!("the rival failed:\n{printed}{}", String::from_utf8_lossy(&output.stderr)));
    }
    print!("{printed}");
    println!("develop 1280x1024 12 of 16 bits to 320x256, 400 frames, and the rival's 200 in the same run:");
    for (name, ours) in ["best", "median"].into_iter().zip(ours) {
        let rival: f64 = printed
            .lines()
            .find_map(|line| line.strip_prefix(&format!("{name}_ms ")))
            .and_then(|value| value.trim().parse().ok())
            .ok_or("the rival printed no time")?;
        println!("  {name}: nightflow {ours:.3} ms, numpy + OpenCV {rival:.3} ms: {:.1} times faster", rival / ours);
    }
    Ok(())
}

fn main() -> ExitCode {
    let mut criterion = Criterion::default().configure_from_args();
    ours(&mut criterion);
    criterion.final_summary();
    if let Err(reason) = against_the_rival() {
        eprintln!("no comparison with numpy and OpenCV: {reason}");
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}
