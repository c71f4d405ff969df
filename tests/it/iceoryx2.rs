//! Shared memory read from outside: by Python, by a second Rust process, and across a kill.

use std::{
    io::{BufRead, BufReader, Lines},
    process::{Child, ChildStdout, Command, Stdio},
    time::{Duration, Instant},
};

use ::iceoryx2::{port::subscriber::Subscriber, prelude::*};
use clap::Parser;
use nightflow::{
    flow::State,
    motion::Lack,
    publish::{
        Config, Iceoryx2, Moved, Sink,
        iceoryx2::{SharedSink, service_name},
        shared::FlowHeader,
    },
    wire::Status,
};

use super::{
    peers,
    recording::{dark, moved},
};

#[path = "../../src/bin/nightflow/watch.rs"]
mod watch;

// Only its `main` is not used here.
#[allow(dead_code)]
#[path = "../../examples/read_flow.rs"]
mod read_flow;

const ROLE: &str = "NIGHTFLOW_TEST_ROLE";
const PATIENCE: Duration = Duration::from_secs(20);

/// Nothing else on this machine uses this name.
fn prefix(name: &str) -> String {
    format!("nightflow_test/{name}/{}", std::process::id())
}

fn open(prefix: &str) -> SharedSink {
    let settings = Iceoryx2 { prefix: prefix.into(), subscribers_max: 4, cells_max: 64 };
    SharedSink::open(&Config::default(), &settings).unwrap()
}

/// Writes into what is lent: cell `i` of step `s` moves by `(s + i, -i)`; sends it.
fn send(sink: &mut SharedSink, moved: &Moved) {
    let canvas = sink.lender().lend(&moved.grid);
    for (i, cell) in canvas.flow.as_chunks_mut::<2>().0.iter_mut().enumerate() {
        *cell = [moved.step as f32 + i as f32, -(i as f32)];
    }
    canvas.confidence.fill(0.25);
    sink.send(moved).unwrap();
}

/// What another process does for the tests below; with no role given it is none of them.
#[test]
fn in_another_process() {
    let Ok(role) = std::env::var(ROLE) else { return };
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["watch", ..] => {
            if let Err(error) = watch::run(watch::Args::parse_from(&words)) {
                println!("error: {error:#}");
            }
        }
        ["read", prefix, steps] => read_flow::read(prefix, steps.parse().unwrap()).unwrap(),
        ["publish", prefix] => {
            let mut sink = open(prefix);
            for step in 0.. {
                send(&mut sink, &moved(step, State::Ok));
                println!("sent {step}");
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        _ => panic!("no such role: {role}"),
    }
}

/// This test binary again, as another process in a role.
struct Other {
    child: Child,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Other {
    fn start(role: &str) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "iceoryx2::in_another_process", "--nocapture"])
            .env(ROLE, role)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines }
    }

    /// The next line with this beginning; ends with the process.
    fn line(&mut self, start: &str) -> Option<String> {
        self.lines.by_ref().map(Result::unwrap).find(|line| line.starts_with(start))
    }

    /// SIGKILL: nothing is cleaned up.
    fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Other {
    fn drop(&mut self) {
        // Both fail only when it has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn python_reads_flow_confidence_and_velocity() {
    let prefix = prefix("python");
    let mut sink = open(&prefix);
    let mut peer = peers::spawn("iox_read.py", [prefix.as_str(), "3"]);
    peer.line_starting("reading", PATIENCE);
    for (step, state) in [(0, State::Ok), (1, dark()), (2, State::Ok)] {
        let blind = matches!(state, State::Blind(_));
        let moved = moved(step, state);
        send(&mut sink, &moved);
        let flow = peer.line_starting("flow", PATIENCE);
        let (sum, code) = (8 * step, if blind { 2 } else { 0 });
        let (mean, corner) = (step as f64 + 3.5, step as f64 + 7.0);
        let expected = format!(
            "flow {step} 4x2 state {code} mean {mean:.4} -3.5000 corner {corner:.4} -7.0000 sum {:.4}",
            sum as f64
        );
        assert_eq!(flow, expected);
        assert_eq!(peer.line_starting("confidence", PATIENCE), format!("confidence {step} 8 cells mean 0.2500"));
        let velocity = peer.line_starting("velocity", PATIENCE);
        let expected = if blind {
            format!("velocity {step} none covariance nan quality 0")
        } else {
            format!("velocity {step} 1.5000 -0.2500 {:.4} covariance 0.0100 quality 200", step as f64)
        };
        assert_eq!(velocity, expected);
        let obstacles = peer.line_starting("obstacles", PATIENCE);
        let expected = if blind { "unknown" } else { "nearest sector 38 in 2.0000 s at 6.0000 m, 1 free, 70 unknown" };
        assert_eq!(obstacles, format!("obstacles {step} {expected}"));
    }
    peer.finish(PATIENCE);
    assert_eq!((sink.copied(), sink.lost()), (0, 0));
}

#[test]
fn the_rust_example_reads_in_another_process() {
    let prefix = prefix("example");
    let mut sink = open(&prefix);
    let mut other = Other::start(&format!("read {prefix} 3"));
    assert!(other.line("reading").is_some());
    for step in 0..3 {
        let state = if step == 1 { dark() } else { State::Ok };
        send(&mut sink, &moved(step, state));
        // The middle of 4×2 cells is the seventh: (step + 6, −6).
        let flow = format!("step {step}: 4×2, {:.3} -6.000 px in the middle", step as f64 + 6.0);
        assert_eq!(other.line("step").as_deref(), Some(flow.as_str()));
        let velocity = match step {
            1 => "step 1: no velocity".to_owned(),
            _ => format!("step {step}: velocity [1.5, -0.25, {:.1}]", step as f64),
        };
        assert_eq!(other.line("step"), Some(velocity));
    }
    assert!(other.child.wait().unwrap().success());
}

#[test]
fn a_second_process_watches() {
    let prefix = prefix("watch");
    let mut sink = open(&prefix);
    let mut other = Other::start(&format!("watch --prefix {prefix} --count 3 --wait-s 20"));
    // Sent until the watcher has seen enough: it may come late, and then gets the newest.
    let until = Instant::now() + PATIENCE;
    let mut step = 0;
    while other.child.try_wait().unwrap().is_none() && Instant::now() < until {
        let mut moved = moved(step, if step % 2 == 1 { dark() } else { State::Ok });
        if step % 3 == 2 {
            moved.velocity = Err(Lack::Gyro);
        }
        send(&mut sink, &moved);
        step += 1;
        std::thread::sleep(Duration::from_millis(20));
    }
    for _ in 0..3 {
        let line = other.line("step ").expect("three steps are printed");
        let words: Vec<&str> = line.split(' ').collect();
        let step: u64 = words[1].parse().unwrap();
        let state = if step % 2 == 1 { "state blind (dark)" } else { "state ok" };
        assert!(line.contains(state), "{line}");
        assert!(
            line.contains(&format!("flow 4x2 mean {:.4} -3.5000 px confidence 0.7500", step as f64 + 3.5)),
            "{line}"
        );
        let velocity = match (step % 2, step % 3) {
            (1, _) => "velocity none (blind)".into(),
            (_, 2) => "velocity none (gyro)".into(),
            _ => format!("velocity 1.500 -0.250 {:.3} m/s, quality 200", step as f64),
        };
        assert!(line.ends_with(&velocity), "{line}");
    }
    assert_eq!(other.line("error"), None);
}

#[test]
fn a_watcher_says_when_there_is_no_node_and_when_it_is_silent() {
    let none = prefix("nobody");
    let said = Other::start(&format!("watch --prefix {none} --once --wait-s 0.2")).line("error").unwrap();
    assert!(said.contains("no node publishes under") && said.contains("nightflow run"), "{said}");

    let silent = prefix("silent");
    let mut sink = open(&silent);
    let mut other = Other::start(&format!("watch --prefix {silent} --once --wait-s 1"));
    while other.child.try_wait().unwrap().is_none() {
        sink.status(&Status { state: 3, cause: "no frame for 2.0 s".into(), ..Status::default() }).unwrap();
        std::thread::sleep(Duration::from_millis(50));
    }
    let said = other.line("error").unwrap();
    assert!(said.contains("sent no step for") && said.contains("no frames come no frame for 2.0 s"), "{said}");
}

fn newest(reader: &Subscriber<ipc::Service, [f32], FlowHeader>, within: Duration) -> (FlowHeader, Vec<f32>) {
    let until = Instant::now() + within;
    loop {
        let newest = std::iter::from_fn(|| reader.receive().unwrap()).last();
        match newest {
            Some(sample) => return (*sample.user_header(), sample.payload().to_vec()),
            None => assert!(Instant::now() < until, "no sample within {within:?}"),
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_killed_publisher_comes_back_to_readers_that_stayed() {
    let prefix = prefix("killed");
    let start = || {
        let mut other = Other::start(&format!("publish {prefix}"));
        assert_eq!(other.line("sent 3").as_deref(), Some("sent 3"), "it publishes again, with nothing removed by hand");
        other
    };
    let first = start();
    let node = NodeBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled).create::<ipc::Service>().unwrap();
    let service = node.service_builder(&service_name(&prefix, "flow").unwrap());
    let service = service.publish_subscribe::<[f32]>().user_header::<FlowHeader>().open().unwrap();
    let reader = service.subscriber_builder().create().unwrap();
    let mut publisher = first;
    for _ in 0..4 {
        let (header, vectors) = newest(&reader, PATIENCE);
        let expected: Vec<f32> = (0..8).flat_map(|i| [header.step as f32 + i as f32, -(i as f32)]).collect();
        assert_eq!(vectors, expected, "step {}", header.step);
        publisher.kill();
        // What was sent before the kill may still lie there.
        while reader.receive().unwrap().is_some() {}
        publisher = start();
    }
    publisher.kill();
    drop((reader, service, node));
    // With no reader left the service itself is what the dead left behind.
    start().kill();
}
