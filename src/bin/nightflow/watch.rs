//! `nightflow watch`: looks at a running node from another process, through its shared memory.

use std::{
    collections::VecDeque,
    io::{IsTerminal, Write},
    time::{Duration, Instant},
};

use anyhow::{Context, bail};
use clap::Parser;
use iceoryx2::{
    node::{Node, NodeBuilder},
    port::{listener::Listener, subscriber::Subscriber},
    prelude::{LogLevel, PortFactory, SignalHandlingMode, ZeroCopySend, set_log_level_from_env_or},
    sample::Sample,
    service::ipc::Service,
};
use nightflow::{
    clock::{self, Reservoir},
    publish::{
        iceoryx2::service_name,
        shared::{FlowHeader, ObstaclesSample, StatusSample, VelocitySample, cause_name, lack_name, sight_name},
    },
};

/// A screen that changes more often than this can't be read.
const REFRESH: Duration = Duration::from_millis(100);
/// Velocities that are kept until the flow of their step is looked at.
const VELOCITIES: usize = 16;
/// A node that sends nothing for this long is called silent.
const SILENCE: Duration = Duration::from_secs(2);

/// What to watch.
#[derive(Parser)]
pub struct Args {
    /// The node's `[publish.iceoryx2] prefix`.
    #[arg(long, default_value = "nightflow")]
    prefix: String,
    /// Print one step as a plain line and leave.
    #[arg(long, conflicts_with = "count")]
    once: bool,
    /// Print this many steps as plain lines and leave.
    #[arg(long)]
    count: Option<u64>,
    /// Seconds to wait for a node, and for a step when lines are counted.
    #[arg(long, default_value_t = 3.0)]
    wait_s: f64,
}

/// Attaches and shows steps until it is stopped, or as many as were asked for.
pub fn run(args: Args) -> anyhow::Result<()> {
    let wait = Duration::try_from_secs_f64(args.wait_s).context("--wait-s")?;
    let count = if args.once { Some(1) } else { args.count };
    set_log_level_from_env_or(LogLevel::Fatal);
    // Ctrl-C ends the wait instead of the process, so that nothing of ours stays in shared memory.
    let node = NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::HandleTerminationRequests)
        .create::<Service>()
        .context("shared memory can't be used")?;
    let mut view = View::default();
    let mut out = std::io::stdout().lock();
    let mut attached = attach(&node, &args.prefix, wait)?;
    let mut heard = clock::instant();
    let mut drawn = clock::instant();
    while attached.wake.timed_wait(|_| {}, REFRESH).is_ok() {
        while let Some(sample) = attached.flow.receive()? {
            heard = clock::instant();
            attached.small(&mut view)?;
            view.step(&sample);
            drop(sample);
            if count.is_some() {
                writeln!(out, "{}", view.line())?;
            }
            if count.is_some_and(|count| view.steps >= count) {
                return Ok(());
            }
        }
        attached.small(&mut view)?;
        let silent = heard.elapsed();
        if count.is_some() && silent > wait {
            bail!("the node under {:?} sent no step for {:.1} s; {}", args.prefix, silent.as_secs_f64(), view.status());
        }
        if count.is_none() && drawn.elapsed() >= REFRESH {
            drawn = clock::instant();
            view.draw(&mut out, silent)?;
        }
        if silent > SILENCE && attached.publishers() == 0 {
            drop(attached);
            writeln!(out, "the node under {:?} is gone; waiting for the next", args.prefix)?;
            attached = match reattach(&node, &args.prefix)? {
                Some(attached) => attached,
                None => break,
            };
            (view, heard) = (View::default(), clock::instant());
        }
    }
    Ok(())
}

type FlowSample = Sample<Service, [f32], FlowHeader>;
type Reader<T> = Subscriber<Service, T, ()>;

/// The ports of one node.
struct Attached {
    flow: Subscriber<Service, [f32], FlowHeader>,
    velocity: Reader<VelocitySample>,
    obstacles: Reader<ObstaclesSample>,
    status: Reader<StatusSample>,
    wake: Listener<Service>,
    publishers: Box<dyn Fn() -> usize>,
}

impl Attached {
    fn publishers(&self) -> usize {
        (self.publishers)()
    }

    /// Takes velocities and the newest status.
    fn small(&self, view: &mut View) -> anyhow::Result<()> {
        while let Some(sample) = self.velocity.receive()? {
            view.velocities.truncate(VELOCITIES - 1);
            view.velocities.push_front(*sample.payload());
        }
        while let Some(sample) = self.obstacles.receive()? {
            view.obstacles = Some(*sample.payload());
        }
        while let Some(sample) = self.status.receive()? {
            view.status = Some(*sample.payload());
        }
        Ok(())
    }
}

/// Attaches once a node is there, or says that none came.
fn attach(node: &Node<Service>, prefix: &str, wait: Duration) -> anyhow::Result<Attached> {
    let until = clock::instant() + wait;
    loop {
        match try_attach(node, prefix) {
            Ok(attached) => return Ok(attached),
            Err(_) if clock::instant() < until && node.wait(REFRESH).is_ok() => {}
            Err(error) => {
                return Err(error.context(format!(
                    "no node publishes under {prefix:?} on this machine; start one (`nightflow run`), or name its \
                     [publish.iceoryx2] prefix with --prefix"
                )));
            }
        }
    }
}

/// Waits for the next node for as long as nobody stops us.
fn reattach(node: &Node<Service>, prefix: &str) -> anyhow::Result<Option<Attached>> {
    while node.wait(REFRESH).is_ok() {
        if let Ok(attached) = try_attach(node, prefix)
            && attached.publishers() > 0
        {
            return Ok(Some(attached));
        }
    }
    Ok(None)
}

fn try_attach(node: &Node<Service>, prefix: &str) -> anyhow::Result<Attached> {
    let name = service_name(prefix, "flow")?;
    let service = node.service_builder(&name).publish_subscribe::<[f32]>().user_header::<FlowHeader>().open()?;
    // The flow is sent last, so it is attached to last: who gets it gets all else of its step.
    let (velocity, status) = (reader(node, prefix, "velocity")?, reader(node, prefix, "status")?);
    let obstacles = reader(node, prefix, "obstacles")?;
    let wake = node.service_builder(&name).event().open()?.listener_builder().create()?;
    let flow = service.subscriber_builder().create()?;
    Ok(Attached {
        flow,
        velocity,
        obstacles,
        status,
        wake,
        publishers: Box::new(move || service.dynamic_config().number_of_publishers()),
    })
}

fn reader<T: std::fmt::Debug + ZeroCopySend>(
    node: &Node<Service>,
    prefix: &str,
    name: &str,
) -> anyhow::Result<Reader<T>> {
    let service = node.service_builder(&service_name(prefix, name)?).publish_subscribe::<T>().open()?;
    Ok(service.subscriber_builder().create()?)
}

/// What is shown.
#[derive(Default)]
struct View {
    steps: u64,
    missed: u64,
    header: FlowHeader,
    mean: [f32; 2],
    hop_us: f64,
    age_ms: f64,
    hops: Reservoir,
    arrivals: VecDeque<Instant>,
    /// The newest first.
    velocities: VecDeque<VelocitySample>,
    obstacles: Option<ObstaclesSample>,
    status: Option<StatusSample>,
    drawn: usize,
}

impl View {
    fn step(&mut self, sample: &FlowSample) {
        let now = clock::now().ns();
        let header = *sample.user_header();
        if self.steps > 0 {
            self.missed += header.step.saturating_sub(self.header.step + 1);
        }
        self.hop_us = (now - header.published_ns) as f64 * 1e-3;
        self.age_ms = (now - header.newer_ns) as f64 * 1e-6;
        self.hops.keep(self.hop_us);
        let cells = sample.payload().as_chunks::<2>().0;
        let sum = cells.iter().fold([0.0_f64; 2], |[u, v], cell| [u + f64::from(cell[0]), v + f64::from(cell[1])]);
        self.mean = sum.map(|sum| (sum / cells.len().max(1) as f64) as f32);
        self.arrivals.push_back(clock::instant());
        while self.arrivals.len() > 1 && self.arrivals.front().is_some_and(|at| at.elapsed() > Duration::from_secs(2)) {
            self.arrivals.pop_front();
        }
        self.header = header;
        self.steps += 1;
    }

    /// Steps a second over the last two seconds.
    fn rate(&self) -> f64 {
        match (self.arrivals.front(), self.arrivals.back()) {
            (Some(first), Some(last)) if last > first => {
                (self.arrivals.len() - 1) as f64 / (*last - *first).as_secs_f64()
            }
            _ => 0.0,
        }
    }

    fn state(&self) -> String {
        let word = ["ok", "degraded", "blind"].get(self.header.state as usize).unwrap_or(&"unknown");
        match cause_name(self.header.cause) {
            "" => (*word).to_owned(),
            cause => format!("{word} ({cause})"),
        }
    }

    fn speed(&self) -> String {
        match self.velocities.iter().find(|sample| sample.step == self.header.step) {
            None => "none yet".into(),
            Some(VelocitySample { valid: 0, lack, .. }) => format!("none ({})", lack_name(*lack)),
            Some(sample) => {
                let ([x, y, z], unit) = (sample.linear, if sample.scale == 0 { "m/s" } else { "1/s" });
                format!("{x:.3} {y:.3} {z:.3} {unit}, quality {}", sample.quality)
            }
        }
    }

    /// The nearest thing in the way; none where nobody looks for any.
    fn ahead(&self) -> Option<String> {
        let found = self.obstacles.as_ref().filter(|found| found.sight != 64)?;
        if found.valid == 0 {
            return Some(format!("unknown ({})", sight_name(found.sight)));
        }
        let count = |kind: u8| found.sector.iter().filter(|sector| **sector == kind).count();
        let near = (0..found.sector.len()).filter(|k| found.sector[*k] == 2);
        let near = near.min_by(|a, b| found.ttc_s[*a].total_cmp(&found.ttc_s[*b]));
        let near = near.map_or("nothing near".into(), |k| {
            let (ttc, distance) = (found.ttc_s[k], found.distance_m[k]);
            let metres = if distance.is_nan() { String::new() } else { format!(" at {distance:.1} m") };
            format!("in {ttc:.2} s{metres}, {:+.0}° to the left", 360.0 * k as f64 / found.sector.len() as f64 - 180.0)
        });
        Some(format!("{near}; {} sectors occupied, {} free, {} unknown", count(2), count(1), count(0)))
    }

    fn status(&self) -> String {
        match &self.status {
            None => "it sent no status".into(),
            Some(status) => {
                let word = ["ok", "degraded", "blind", "no frames come"].get(status.state as usize);
                let error = status.last_error();
                let error = if error.is_empty() { error } else { format!(", last error: {error}") };
                format!("its last status: {} {}{error}", word.unwrap_or(&"unknown"), status.cause())
            }
        }
    }

    /// One step for a script.
    fn line(&self) -> String {
        let (header, [u, v]) = (&self.header, self.mean);
        format!(
            "step {} state {} flow {}x{} mean {u:.4} {v:.4} px confidence {:.4} latency {:.1} us age {:.2} ms velocity {}",
            header.step,
            self.state(),
            header.width,
            header.height,
            header.confidence,
            self.hop_us,
            self.age_ms,
            self.speed(),
        )
    }

    /// Draws over what was drawn before, or below it where the output is no terminal.
    fn draw(&mut self, out: &mut impl Write, silent: Duration) -> std::io::Result<()> {
        let (header, [u, v]) = (&self.header, self.mean);
        let [p50, p99] = self.hops.quantiles([0.5, 0.99]).unwrap_or([f64::NAN; 2]);
        let mut lines = vec![
            format!("step      {} ({:.1} a second, {} missed here)", header.step, self.rate(), self.missed),
            format!("state     {}", self.state()),
            format!("velocity  {}", self.speed()),
            format!(
                "flow      {}×{}, mean {u:.3} {v:.3} px, confidence {:.2}, raw mean {:.4}, gain {:.1}",
                header.width, header.height, header.confidence, header.raw_mean, header.gain
            ),
            format!("latency   {p50:.0} µs from sending, p99 {p99:.0}; {:.1} ms from the frame's stamp", self.age_ms),
            format!("lost      {} displaced frames, {} steps not sent", header.displaced, header.lost),
        ];
        lines.extend(self.ahead().map(|ahead| format!("obstacles {ahead}")));
        if self.steps == 0 || silent > SILENCE {
            lines.push(format!("silent    for {:.0} s; {}", silent.as_secs_f64(), self.status()));
        }
        if std::io::stdout().is_terminal() {
            if self.drawn > 0 {
                write!(out, "\x1b[{}A\x1b[J", self.drawn)?;
            }
        } else if self.steps == 0 {
            return Ok(());
        }
        self.drawn = lines.len();
        writeln!(out, "{}", lines.join("\n"))?;
        out.flush()
    }
}
