//! `nightflow doctor`: is this machine ready? One line a check: ok, a warning, or what to do.

use std::{path::PathBuf, time::Duration};

use anyhow::Result;
use nightflow::{
    camera::{self, Next, Sample, SourceConfig},
    clock,
    config::Config,
    exposure::Developer,
    flow::{
        self, Matcher, Precision, Provider,
        convolutions::Unit,
        manifest,
        pages::{self, Moved},
        priority::{self, Policy},
    },
    publish::iceoryx2::{bytes_needed, free_bytes},
};

use crate::{
    Exit,
    bench::ours::{self, Ours},
    launch,
};

/// A receive buffer below this loses most of a camera's fragments (measured: 93 % of VGA frames at 208 KiB).
const RECEIVE_BUFFER_MIN: u64 = 2 << 20;

/// Check runtime, model, memory, sockets, processor and camera; exits with 1 when something must be done.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow doctor
  nightflow doctor --config launch_configs/ros2.toml --wait 5")]
pub struct Args {
    /// The launch file; its camera is looked for too.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// How long to wait for a frame, in seconds.
    #[arg(long, value_name = "SECONDS", default_value_t = 3.0)]
    wait: f64,
}

/// The network's usual size.
const SIZE: [usize; 2] = [320, 256];

/// How a check came out.
enum Finding {
    Ok(String),
    Warning(String),
    Do(String),
}

/// Prints every check, then how many must be acted upon.
pub fn run(args: Args) -> Result<Exit> {
    let config = launch::read(args.config.as_deref())?;
    let mut checks = vec![("processor", processor())];
    checks.extend(network(&config));
    checks.push(("shared memory", shared_memory(&config)));
    checks.push(("socket buffers", sockets(&config)));
    checks.push(match args.config {
        Some(_) => ("camera", camera(&config, args.wait)),
        None => ("camera", Finding::Warning("not looked for: give --config FILE to name a source".into())),
    });
    let mut open = 0;
    for (name, finding) in &checks {
        match finding {
            Finding::Ok(text) => println!("ok       {name:<15} {text}"),
            Finding::Warning(text) => println!("warning  {name:<15} {text}"),
            Finding::Do(text) => {
                open += 1;
                println!("TO DO    {name:<15} {text}");
            }
        }
    }
    Ok(if open == 0 { Exit::Done } else { Exit::Different })
}

fn processor() -> Finding {
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    #[cfg(target_arch = "x86_64")]
    let features = [
        ("AVX2", is_x86_feature_detected!("avx2")),
        ("FMA", is_x86_feature_detected!("fma")),
        ("AVX-512", is_x86_feature_detected!("avx512f")),
        ("VNNI", is_x86_feature_detected!("avx512vnni")),
        ("BF16", is_x86_feature_detected!("avx512bf16")),
        ("AMX", Unit::best().name() == "AMX"),
    ];
    #[cfg(target_arch = "aarch64")]
    let features = [("NEON", std::arch::is_aarch64_feature_detected!("neon"))];
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let features: [(&str, bool); 0] = [];
    let there: Vec<&str> = features.iter().filter(|(_, there)| *there).map(|(name, _)| *name).collect();
    let text = format!("{cores} cores, {}", there.join(" "));
    if there.is_empty() {
        return Finding::Warning(format!("{text}none of the vector units that the network is fast with"));
    }
    Finding::Ok(text)
}

/// On what pages the memory lies that was used so far.
fn memory_pages(flow: &flow::Config) -> Finding {
    if !flow.large_pages {
        return Finding::Ok("small ones: [flow] large_pages is off".into());
    }
    Finding::Ok(match pages::enlarge() {
        Ok(Moved { large, of }) => format!("large ones for {} of {} MiB", large >> 20, of >> 20),
        Err(why) => format!("small ones, steps take a little longer: {why}"),
    })
}

/// How the system shares the cores between the network's threads and others'.
fn scheduling() -> Finding {
    Finding::Ok(match priority::current() {
        Policy::RealTime(priority) => format!("real-time priority {priority}: no ordinary program gets in between"),
        Policy::Ordinary => "ordinary: what else runs on these cores gets in between ([flow] priority)".into(),
    })
}

/// Runtime library, model files and golden output, and how long one step takes here.
fn network(config: &Config) -> Vec<(&'static str, Finding)> {
    let mut matcher = match Matcher::open(&config.flow) {
        Ok(matcher) => matcher,
        Err(error) => return vec![("network", Finding::Do(error.to_string()))],
    };
    let model = matcher.model().clone();
    let files: Vec<String> =
        model.sha256.iter().map(|(file, hash)| format!("{file} {}…", hash.get(..12).unwrap_or(hash))).collect();
    let golden = match matcher.check_golden() {
        Ok(Some(deviation)) => Finding::Ok(format!(
            "{:.1e} px off what the exporter noted, {} allowed",
            deviation.worst, deviation.tolerance
        )),
        Ok(None) => Finding::Warning("the manifest holds no golden output for this network".into()),
        Err(error) => Finding::Do(error.to_string()),
    };
    let mut ours = Ours::with(matcher, ours::frames(SIZE[0], SIZE[1]));
    // The first step takes all memory, which then moves at once: the node moves it bit by bit, beside its steps.
    let (pages, speed) = match ours.step() {
        Ok(_) => (memory_pages(&config.flow), speed(&mut ours, may_be_faster(&config.flow))),
        Err(error) => (Finding::Warning("no step was made".into()), Finding::Do(error.to_string())),
    };
    vec![
        ("runtime", Finding::Ok(format!("{}, {}", model.provider, model.library.display()))),
        (
            "model",
            Finding::Ok(format!(
                "{} {}, {} operators, sha256 as in the manifest: {}",
                model.name,
                model.version,
                model.operators,
                files.join(", ")
            )),
        ),
        ("golden output", golden),
        ("memory pages", pages),
        ("scheduling", scheduling()),
        ("speed", speed),
    ]
}

/// Whether this processor has tiles for bf16, the network graphs for them, and the settings neither. Dot products of AVX-512 are no
/// faster than 32 bits are by fewer products.
fn may_be_faster(flow: &flow::Config) -> bool {
    let folder = manifest::folder(&flow.models, std::env::current_exe().ok().as_deref());
    let able = manifest::entry(&folder, &flow.network).is_ok_and(|entry| entry.has_tiles());
    let asked = flow.provider == Provider::Cpu && flow.precision == Precision::Fp32;
    able && asked && Unit::best().name() == "AMX"
}

/// The median of five steps at the network's usual size, each with one new frame, as in a running node.
fn speed(ours: &mut Ours, may_be_faster: bool) -> Finding {
    let mut took = Vec::new();
    for _ in 0..5 {
        match ours.step() {
            Ok(ms) => took.push(ms),
            Err(error) => return Finding::Do(error.to_string()),
        }
    }
    took.sort_by(f64::total_cmp);
    let median = took[took.len() / 2];
    let [width, height] = SIZE;
    let way = if may_be_faster { "; [flow] precision = \"bf16\" is faster on this processor" } else { "" };
    Finding::Ok(format!("{median:.0} ms a step at {width}×{height}, up to {:.0} Hz{way}", 1e3 / median))
}

fn shared_memory(config: &Config) -> Finding {
    let Some(shared) = &config.publish.iceoryx2 else {
        return Finding::Ok("not used: [publish.iceoryx2] is closed".into());
    };
    let needed = bytes_needed(shared.cells_max, shared.subscribers_max);
    match free_bytes() {
        Some(free) if free < needed => Finding::Do(format!(
            "/dev/shm has {free} bytes free, {needed} are needed: enlarge it (mount -o remount,size=…) or lower [publish.iceoryx2] cells_max"
        )),
        Some(free) => Finding::Ok(format!("/dev/shm has {free} bytes free, {needed} are needed")),
        None => Finding::Warning("/dev/shm can't be asked how much is free".into()),
    }
}

fn sockets(config: &Config) -> Finding {
    let dds = matches!(config.camera.source, SourceConfig::Ros2(_));
    let path = "/proc/sys/net/core/rmem_max";
    let limit = std::fs::read_to_string(path).ok().and_then(|text| text.trim().parse::<u64>().ok());
    match limit {
        None => Finding::Warning(format!("{path} can't be read")),
        Some(bytes) if bytes < RECEIVE_BUFFER_MIN && dds => Finding::Do(format!(
            "receive buffers may have {bytes} bytes at most, and large frames over DDS need {RECEIVE_BUFFER_MIN}: sudo sysctl -w net.core.rmem_max=8388608"
        )),
        Some(bytes) => Finding::Ok(format!("receive buffers may have {bytes} bytes")),
    }
}

/// Waits for a frame and develops it, so that a wrong black level or bit depth shows up here and not in flight.
fn camera(config: &Config, wait_s: f64) -> Finding {
    let mut source = match camera::open(&config.camera) {
        Ok(source) => source,
        Err(error) => return Finding::Do(error.to_string()),
    };
    let mut beside = std::collections::BTreeSet::new();
    let end = clock::instant() + Duration::from_secs_f64(wait_s.max(0.0));
    while clock::instant() < end {
        match source.next(Duration::from_millis(50)) {
            Ok(Next::Sample(Sample::Frame(frame))) => return developed(config, &frame, &beside),
            Ok(Next::Sample(Sample::Info(_))) => _ = beside.insert("calibration"),
            Ok(Next::Sample(Sample::Imu(_))) => _ = beside.insert("gyro"),
            Ok(Next::Sample(Sample::Range(_))) => _ = beside.insert("range"),
            Ok(Next::Sample(Sample::Transforms(_))) => _ = beside.insert("transforms"),
            Ok(Next::Sample(Sample::Width(_)) | Next::Idle) => {}
            Ok(Next::End) => break,
            Err(error) => return Finding::Do(error.to_string()),
        }
    }
    Finding::Do(format!(
        "no frame on {} within {wait_s} s: is the camera's driver up, the domain or router right?",
        config.camera.image_topic
    ))
}

fn developed(config: &Config, frame: &camera::Frame, beside: &std::collections::BTreeSet<&str>) -> Finding {
    let image = &frame.image;
    let seen = format!("{}×{} {} on {}", image.width, image.height, image.encoding, config.camera.image_topic);
    let mut developer = match Developer::new(&config.exposure) {
        Ok(developer) => developer,
        Err(error) => return Finding::Do(error.to_string()),
    };
    if let Err(error) = developer.develop(frame) {
        return Finding::Do(format!("{seen}, but: {error}"));
    }
    let mean = developer.newest().map_or(f32::NAN, |exposed| exposed.raw_mean);
    let beside: Vec<&str> = beside.iter().copied().collect();
    let beside = if beside.is_empty() { "nothing beside it yet".into() } else { beside.join(", ") };
    Finding::Ok(format!("{seen}, raw mean {mean:.4} of white; {beside}"))
}
