//! From a camera's stamp to flow in another's hands, through zenoh, the network and shared memory:
//! `cargo bench --bench latency [-- FRAMES [HZ [PRECISION [PRIORITY]]]]`.
//!
//! The camera is a thread with a zenoh session of its own (TCP, as between two programs), the reader one with an iceoryx2
//! node of its own; the node between them is the one that `nightflow run` runs. What is told is of every step that the
//! reader got, from the frame's stamp, which is taken before it is encoded. PRIORITY is `[flow] priority`; camera and reader,
//! which the node's thread starts here, have it too.

use std::{
    error::Error,
    path::Path,
    process::ExitCode,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::{Duration, Instant},
};

use iceoryx2::{prelude::*, service::ipc_threadsafe};
use nightflow::{
    camera,
    clock::{self, Stamp},
    config::Config,
    flow::convolutions,
    node::{self, Outputs},
    pipeline::Pipeline,
    publish::{iceoryx2::SharedSink, shared::FlowHeader},
    wire::{self, Image},
};
use zenoh::Wait;

#[allow(dead_code)]
mod rivals;

const SIZES: [[u32; 2]; 2] = [[640, 480], [1280, 1024]];
const FRAMES: usize = 10_000;
/// Steps that come before those that count.
const WARM_UP: usize = 30;
/// Frames that follow each other for ever.
const ROUND: u32 = 4;

type Outcome<T> = Result<T, Box<dyn Error + Send + Sync>>;

/// What the reader saw of one run.
struct Run {
    /// Milliseconds from stamp to receipt, sorted.
    ms: Vec<f64>,
    displaced: u64,
    size: [u32; 2],
}

impl Run {
    fn quantile(&self, part: f64) -> f64 {
        self.ms[((self.ms.len() - 1) as f64 * part).round() as usize]
    }
}

/// Sends frames at their rate, whatever becomes of them.
fn shoot(endpoint: &str, topic: &str, size: [u32; 2], frames: usize, hz: f64) -> Outcome<()> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("scouting/multicast/enabled", "false".to_owned()),
        ("connect/endpoints", format!("[{endpoint:?}]")),
        ("transport/shared_memory/enabled", "true".to_owned()),
    ] {
        config.insert_json5(key, &value)?;
    }
    let session = zenoh::open(config).wait()?;
    let publisher = session.declare_publisher(topic.trim_start_matches('/').to_owned()).wait()?;
    // Moves by four pixels a frame, so that there is something to match.
    let mut images: Vec<Image> = (0..ROUND).map(|number| rivals::image(size, 4 * number, 1)).collect();
    thread::sleep(Duration::from_secs(1));
    let begin = Instant::now();
    for i in 0..frames {
        let due = begin + Duration::from_secs_f64(i as f64 / hz);
        thread::sleep(due.saturating_duration_since(Instant::now()));
        let image = &mut images[i % ROUND as usize];
        image.header.stamp = clock::now().into();
        let mut bytes = vec![];
        wire::encode(image, &mut bytes)?;
        publisher.put(bytes).wait()?;
    }
    // The last one is on its way.
    thread::sleep(Duration::from_millis(500));
    session.close().wait()
}

/// Takes flow until it is told to stop.
fn read(prefix: &str, stop: &AtomicBool) -> Outcome<(Vec<f64>, u64)> {
    let node =
        NodeBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled).create::<ipc_threadsafe::Service>()?;
    let name: ServiceName = format!("{prefix}/flow").as_str().try_into()?;
    let service = node.service_builder(&name).publish_subscribe::<[f32]>().user_header::<FlowHeader>().open()?;
    let flow = service.subscriber_builder().create()?;
    let wake = node.service_builder(&name).event().open()?.listener_builder().create()?;
    let (mut ms, mut displaced) = (vec![], 0);
    while !stop.load(Ordering::Acquire) {
        wake.timed_wait(|_| {}, Duration::from_millis(100))?;
        while let Some(sample) = flow.receive()? {
            let header = sample.user_header();
            ms.push(clock::now().seconds_since(Stamp::from_ns(header.newer_ns)) * 1e3);
            displaced = header.displaced;
        }
    }
    Ok((ms, displaced))
}

fn measure(settings: &str, size: [u32; 2], frames: usize, hz: f64) -> Outcome<Run> {
    let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let prefix = format!("nightflow_bench/latency/{}/{}", std::process::id(), size[0]);
    let text = format!(
        "{settings}\n[camera]\nimage_topic = \"/bench/{}/image\"\n[camera.source.zenoh]\nlisten = [\"{endpoint}\"]\n\
         rmw = false\n[exposure]\nbit_depth = 12\nblack_level = {}\n[publish.iceoryx2]\nprefix = \"{prefix}\"\n",
        size[0],
        rivals::BLACK,
    );
    let config = Config::parse(&text, Path::new("latency"))?;
    let mut pipeline = Pipeline::open(&config)?;
    let shared = config.publish.iceoryx2.as_ref().ok_or("shared memory is where the flow goes")?;
    let mut outputs = Outputs::default();
    outputs.shared = Some(SharedSink::open(&config.publish, shared)?);
    let stop = AtomicBool::new(false);
    let (ms, displaced) = thread::scope(|scope| -> Outcome<(Vec<f64>, u64)> {
        let reader = scope.spawn(|| read(&prefix, &stop));
        let shooter = scope.spawn(|| {
            // Whatever became of it, nobody waits for more.
            let shot = shoot(&endpoint, &config.camera.image_topic, size, frames, hz);
            stop.store(true, Ordering::Release);
            shot
        });
        let silence = Duration::from_secs(5);
        let mut open = || camera::open(&config.camera);
        node::drive(&mut open, Some(&mut pipeline), &mut outputs, &stop, (silence, None), &mut |_, _| {})?;
        shooter.join().map_err(|_| "the camera panicked")??;
        reader.join().map_err(|_| "the reader panicked")?
    })?;
    let mut ms: Vec<f64> = ms.into_iter().skip(WARM_UP.min(frames / 4)).collect();
    if ms.is_empty() {
        return Err(format!("{frames} frames of {size:?} were sent and no flow came").into());
    }
    ms.sort_by(f64::total_cmp);
    Ok(Run { ms, displaced, size })
}

fn report(frames: usize, hz: Option<f64>, precision: Option<&str>, priority: u8) -> Outcome<()> {
    // A rate that the network keeps with room to spare on two cores.
    let mut ways = vec![("fp32", 15.0)];
    if convolutions::Unit::best().is_fast() {
        ways.push(("bf16", 30.0));
    }
    let able: Vec<&str> = ways.iter().map(|way| way.0).collect();
    if let Some(wanted) = precision.filter(|wanted| !able.contains(wanted)) {
        return Err(format!("precision {wanted:?}: this machine has {}", able.join(" and ")).into());
    }
    ways.retain(|way| precision.is_none_or(|wanted| way.0 == wanted));
    println!("camera's stamp to received flow, {frames} frames each, priority {priority}, milliseconds:\n");
    println!(
        "| precision, camera | steps | displaced | p50 | p99 | p99.9 | most | p99 / p50 |\n|{}",
        " --- |".repeat(8)
    );
    for (precision, own) in ways {
        let settings = format!("[flow]\nprecision = {precision:?}\npriority = {priority}");
        for size in SIZES {
            let hz = hz.unwrap_or(own);
            let run = measure(&settings, size, frames, hz)?;
            let [p50, p99, p999, most] = [0.5, 0.99, 0.999, 1.0].map(|part| run.quantile(part));
            let [width, height] = run.size;
            println!(
                "| {precision}, {width}×{height} at {hz} Hz | {} | {} | {p50:.2} | {p99:.2} | {p999:.2} | {most:.2} | {:.2} |",
                run.ms.len(),
                run.displaced,
                p99 / p50
            );
        }
    }
    Ok(())
}

/// A word as the number that it should be; `None` where none is given.
fn number<T: std::str::FromStr>(word: Option<String>, name: &str) -> Outcome<Option<T>> {
    word.map(|word| word.parse().map_err(|_| format!("{name} {word:?}: expected a number").into())).transpose()
}

fn main() -> ExitCode {
    let bench = std::env::args().any(|word| word == "--bench");
    let mut given = std::env::args().skip(1).filter(|word| !word.starts_with("--"));
    // Under `cargo test --benches` it only shows that it still runs: unoptimised, beside other work, so that a few frames at
    // full rate may all be the warm-up. Slower than seven a second, two frames are no pair.
    let (trial, slow) = (24, 10.0);
    let outcome = (|| {
        let frames = number(given.next(), "FRAMES")?.unwrap_or(if bench { FRAMES } else { trial });
        let hz = number(given.next(), "HZ")?.or((!bench).then_some(slow));
        let precision = given.next();
        report(frames, hz, precision.as_deref(), number(given.next(), "PRIORITY")?.unwrap_or(0))
    })();
    if let Err(reason) = outcome {
        eprintln!("latency was not measured: {reason}");
        return ExitCode::FAILURE;
    }
    ExitCode::SUCCESS
}
