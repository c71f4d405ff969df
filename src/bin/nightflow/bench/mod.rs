//! `nightflow bench`: how fast the networks are here, beside themselves, beside rivals and beside what the processor can do.

mod errors;
mod machine;
pub mod ours;
mod picture;
mod report;
mod rival;
mod turns;

use std::{path::PathBuf, rc::Rc, str::FromStr};

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use nightflow::{
    exposure::Exposed,
    flow::{
        Config, Matcher, Operators, Precision, Provider, Resolution, convolutions,
        manifest::{self, Entry},
        pages,
    },
};

use self::{
    errors::Errors,
    ours::{Ours, Product},
    report::Report,
    rival::Rivals,
    turns::{Found, Turn, What},
};
use crate::{Exit, launch};

/// Time a step of each network, with fused and with plain operators, and print ratios of what ran in turns.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow bench
  nightflow bench --models pwcnet_fcdn,pwcnet_fcdn_fast --size 640x512 --threads 1
  nightflow bench --rivals --python rivals/bin/python --out bench
  nightflow eval ladder pairs/ --models pwcnet_fcdn,raftsmall_fcdn,dis=results/dis --out results
  nightflow bench --rivals --epe results/table.csv --out bench

A step is what the node does for each frame: the pyramid once, the decoder once. Refining is left out and told for itself.
Milliseconds are those of a machine and of its other work; ratios are of things that ran in turns. Rivals are the same
networks in OpenVINO, and OpenCV's DIS and Farnebäck; a package that is missing is named, and the rest is printed.")]
pub struct Args {
    /// Networks of the manifest, separated by commas; all of them unless named.
    #[arg(long, value_delimiter = ',', value_name = "NAME,…")]
    models: Vec<String>,
    /// Size of the images.
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "320x256")]
    size: Size,
    /// Threads of everybody.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// How often everybody's turn comes; figures are medians over the rounds.
    #[arg(long, default_value_t = 15, value_parser = clap::value_parser!(u16).range(1..=1000))]
    rounds: u16,
    /// Run the rivals in turns with ours.
    #[arg(long)]
    rivals: bool,
    /// A Python with the rivals' packages; else what the variable PYTHON names, else python3.
    #[arg(long, value_name = "FILE", requires = "rivals")]
    python: Option<PathBuf>,
    /// Write bench.md and bench.svg into this folder.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// End-point errors: table.csv of `nightflow eval ladder --out`. They are drawn against milliseconds, as epe_ms.svg.
    #[arg(long, value_name = "FILE", requires = "out")]
    epe: Option<PathBuf>,
    /// A launch file whose [flow] says with what networks are computed: runtime, provider, precision, models.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Columns and rows.
#[derive(Debug, Clone, Copy)]
struct Size([usize; 2]);

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text.split_once('x').map(|(width, height)| [width.parse().ok(), height.parse().ok()]);
        match sides {
            Some([Some(width @ 16..=4096), Some(height @ 16..=4096)]) => Ok(Self([width, height])),
            _ => Err(format!("{text:?} is no size; expected WIDTHxHEIGHT of 16 to 4096 pixels each, as 320x256")),
        }
    }
}

/// What was asked for makes no sense, and what would.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Mistake(String);

/// Sizes that costs are followed over, in halves of the size that was asked for.
const HALVES: [usize; 4] = [1, 2, 4, 8];

/// Measures, prints the tables and writes them where that is asked for.
pub fn run(args: &Args) -> Result<Exit> {
    // Before anything runs here.
    let load = machine::load();
    let errors = args.epe.as_deref().map(Errors::read).transpose()?;
    let bench = Bench::new(args)?;
    let mut report = Report {
        about: vec![machine::processor(), load],
        networks: bench.networks.clone(),
        followed: bench.followed.clone(),
        size: args.size.0,
        threads: bench.threads,
        rounds: args.rounds.into(),
        ..Report::default()
    };
    bench.steps(&mut report)?;
    bench.growth(&mut report)?;
    let markdown = report.markdown();
    print!("{markdown}");
    let Some(folder) = &args.out else { return Ok(Exit::Done) };
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let mut files = vec![("bench.md", markdown), ("bench.svg", picture::bars(&report.milliseconds())?)];
    if let Some(errors) = &errors {
        let (points, unknown) = report.points(errors);
        if !unknown.is_empty() {
            println!("\nNot in epe_ms.svg, for want of an end-point error in the table: {}", unknown.join(", "));
        }
        files.push(("epe_ms.svg", picture::against(&points)?));
    }
    for (name, text) in files {
        let path = folder.join(name);
        std::fs::write(&path, text).with_context(|| path.display().to_string())?;
    }
    Ok(Exit::Done)
}

/// What is to be measured.
struct Bench<'a> {
    args: &'a Args,
    config: Config,
    models: PathBuf,
    networks: Vec<(String, Entry)>,
    /// The network that refining and growth are told of.
    followed: String,
    threads: usize,
}

impl<'a> Bench<'a> {
    fn new(args: &'a Args) -> Result<Self> {
        let config = launch::read(args.config.as_deref())?.flow;
        let models = manifest::folder(&config.models, std::env::current_exe().ok().as_deref());
        let mut known = manifest::entries(&models)?;
        let names = known.keys().cloned().collect::<Vec<_>>().join(", ");
        let mut networks: Vec<(String, Entry)> = vec![];
        for name in &args.models {
            match known.remove_entry(name) {
                Some(network) => networks.push(network),
                None if networks.iter().any(|(named, _)| named == name) => {}
                None => return Err(Mistake(format!("--models: {name} is no network, expected one of {names}")).into()),
            }
        }
        if args.models.is_empty() {
            networks.extend(known);
        }
        let first = networks.iter().find(|(name, _)| *name == config.network).or(networks.first());
        let followed = first.ok_or_else(|| Mistake(format!("{} names no network", models.display())))?.0.clone();
        Ok(Self { args, config, models, networks, followed, threads: args.threads.into() })
    }

    fn config(&self, network: &str, operators: Operators, threads: usize) -> Config {
        Config {
            network: network.into(),
            models: self.models.clone(),
            operators,
            threads,
            resolution: Resolution::Quarter,
            refine: false,
            golden_check: false,
            ..self.config.clone()
        }
    }

    /// The operators that the node runs a network with.
    fn operators(&self, network: &str) -> Operators {
        let fused = self.networks.iter().any(|(name, entry)| name == network && entry.fused.is_some());
        if fused { Operators::Fused } else { Operators::Plain }
    }

    /// Whether a network runs in bf16 here, besides what the settings say.
    fn has_tiles(&self, entry: &Entry) -> bool {
        let Config { provider, precision, .. } = self.config;
        let asked = provider == Provider::Cpu && precision == Precision::Fp32;
        asked && entry.has_tiles() && convolutions::Unit::best().is_fast()
    }

    /// Where in a round somebody's turn is: by network, refined before unrefined, fused, plain, then who is no network.
    fn place(&self, what: &What) -> (usize, usize) {
        let of = |network: &str| self.networks.iter().position(|(name, _)| name == network).unwrap_or(usize::MAX);
        match what {
            What::Refined(network) => (of(network), 0),
            What::Step(network, Operators::Fused) => (of(network), 1),
            What::Step(network, Operators::Plain) => (of(network), 2),
            What::Tiles(network) => (of(network), 3),
            What::OpenVino(network, _) => (of(network), 4),
            What::Sized(..) | What::Product | What::OpenCv(_) => (usize::MAX, 0),
        }
    }

    /// Once the memory of all was measured, by giving back what was free: that cuts large pages up.
    fn settle(&self) {
        if self.config.large_pages {
            // What can't be moved stays where it is, for everybody alike.
            pages::enlarge().ok();
        }
    }

    /// Every network, what refining adds, the product of matrices and the rivals, all in turns.
    fn steps(&self, report: &mut Report) -> Result<()> {
        let (Size(size @ [width, height]), threads) = (self.args.size, self.threads);
        let frames = ours::frames(width, height);
        let mut product = Product::open(&self.config(&self.followed, Operators::Plain, threads))?;
        product.step()?;
        // With the runtime's library and the frames, and without a network.
        report.base = machine::settled();
        let mut turns = vec![];
        for (network, entry) in &self.networks {
            let fused = entry.fused.as_ref().map(|_| Operators::Fused);
            for operators in fused.into_iter().chain([Operators::Plain]) {
                let what = What::Step(network.clone(), operators);
                turns.push(enter(what, &self.config(network, operators, threads), &frames, report)?);
            }
            if self.has_tiles(entry) {
                let fused = self.config(network, Operators::Fused, threads);
                let config = Config { precision: Precision::Bf16, ..fused };
                turns.push(enter(What::Tiles(network.clone()), &config, &frames, report)?);
            }
        }
        let refined = Config { refine: true, ..self.config(&self.followed, self.operators(&self.followed), threads) };
        turns.push(enter(What::Refined(self.followed.clone()), &refined, &frames, report)?);
        turns.push(Turn { what: What::Product, step: Box::new(move || product.step()) });
        let python = self.args.python.clone().or_else(|| std::env::var_os("PYTHON").map(Into::into));
        let mut rivals = match (self.args.rivals, python.unwrap_or_else(|| "python3".into())) {
            (true, python) => Rivals::open(&python, size, threads, &self.models, &self.networks),
            (false, _) => Rivals::default(),
        };
        turns.append(&mut rivals.turns);
        // What is compared most goes side by side.
        turns.sort_by_key(|turn| self.place(&turn.what));
        self.settle();
        let bar = progress(turns.len(), self.args.rounds.into(), "the step")?;
        report.steps = mended(turns::take(&mut turns, self.args.rounds.into(), &bar), &mut rivals.left_out)?;
        bar.finish_and_clear();
        report.whole = machine::resident(std::process::id());
        self.alone(&frames, report)?;
        report.rivals = self.args.rivals.then(|| {
            let process = rivals.process.as_ref().map(|process| process.borrow().id());
            report::Beside {
                about: rivals.about,
                left_out: rivals.left_out,
                resident: process.and_then(machine::resident),
            }
        });
        Ok(())
    }

    /// The convolutions of every network by themselves, as the node runs it and in bf16.
    fn alone(&self, frames: &Rc<[Exposed]>, report: &mut Report) -> Result<()> {
        for (network, entry) in &self.networks {
            let config = self.config(network, self.operators(network), self.threads);
            let mut ways = vec![(What::Step(network.clone(), config.operators), config.clone())];
            if self.has_tiles(entry) {
                ways.push((What::Tiles(network.clone()), Config { precision: Precision::Bf16, ..config }));
            }
            for (what, config) in ways {
                let ms = ours::convolutions(&config, frames, self.args.rounds.into());
                report.alone.push((what.clone(), ms.with_context(|| what.to_string())?));
            }
        }
        Ok(())
    }

    /// One network from half the size to four times it, with one thread and with as many as were asked for.
    fn growth(&self, report: &mut Report) -> Result<()> {
        // The largest takes sixteen times as long.
        let rounds = usize::from(self.args.rounds).div_ceil(3);
        let mut threads = vec![1, self.threads];
        threads.dedup();
        let mut turns = vec![];
        for halves in HALVES {
            let size = self.args.size.0.map(|side| side * halves / 2);
            let frames = ours::frames(size[0], size[1]);
            for &threads in &threads {
                let config = self.config(&self.followed, self.operators(&self.followed), threads);
                turns.push(enter(What::Sized(size, threads), &config, &frames, report)?);
                report.sizes.push((size, threads));
            }
        }
        self.settle();
        let bar = progress(turns.len(), rounds, "how its cost grows")?;
        report.growth = mended(turns::take(&mut turns, rounds, &bar), &mut vec![])?;
        bar.finish_and_clear();
        Ok(())
    }
}

/// Opens a network and lets it make two steps, so that it has all of its memory.
fn enter(what: What, config: &Config, frames: &Rc<[Exposed]>, report: &mut Report) -> Result<Turn> {
    let before = machine::settled();
    let mut ours = Ours::with(Matcher::open(config).with_context(|| what.to_string())?, frames.clone());
    for _ in 0..2 {
        ours.step().with_context(|| what.to_string())?;
    }
    let grown = machine::settled().zip(before).map(|(after, before)| after - before);
    report.memory.push((what.clone(), grown));
    report.provider = ours.provider().into();
    Ok(Turn { what, step: Box::new(move || ours.step()) })
}

/// A rival that failed on the way is left out; a step of ours that failed is an error.
fn mended(found: Found, left_out: &mut Vec<String>) -> Result<Found> {
    for (what, error) in found.failed() {
        match what {
            What::OpenVino(..) | What::OpenCv(_) => left_out.push(format!("{what}: {error:#}")),
            _ => anyhow::bail!("{what}: {error:#}"),
        }
    }
    Ok(found)
}

fn progress(turns: usize, rounds: usize, doing: &'static str) -> Result<ProgressBar> {
    let style = ProgressStyle::with_template("{bar:40} {pos} of {len} {msg}, {eta} left")?;
    let steps = (turns * (rounds + 1)) as u64;
    let bar = ProgressBar::with_draw_target(Some(steps), ProgressDrawTarget::stderr_with_hz(5)).with_style(style);
    Ok(bar.with_message(doing))
}
