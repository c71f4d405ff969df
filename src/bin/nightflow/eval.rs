//! `nightflow eval`: methods judged on data sets with true flow, as they are or photographed ever darker.

mod recipes;
mod reference;

use std::{
    path::{Path, PathBuf},
    sync::atomic::{AtomicUsize, Ordering},
};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use nightflow::{
    darkness::{
        bound,
        datasets::{self, Found, Item, KINDS, Kind, Skipped},
        enhance::Enhancer,
        faults::Fault,
        flow_files::Field,
        ladder::{Linear, MEANS, Sensor},
        methods::{Enhancing, Method, Shown},
        picture::Picture,
        report::{DRAW, Record, Report},
        score::score,
    },
    flow,
};

use crate::{Exit, launch};

/// Judge methods on a data set with true flow: end-point error, outliers and angular error, by exposure.
#[derive(clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
#[command(after_help = "\
Examples:
  nightflow eval VBOF/ --models pwcnet_fcdn,zero --out results
  nightflow eval Sintel/training --models pwcnet_fcdn,raft=raft_small.onnx --linear
  nightflow eval ladder pairs/ --camera 'Canon EOS M6' --iso 3200 --models pwcnet_fcdn,zero --enhancers none,nlm
  nightflow eval pairs/ --models dis=results/dis --enhancers none
  nightflow eval recipes pairs/ scenes/ --out table       (the paper's table: see its --help)
  nightflow eval reference mine/ --out judged             (pairs without a truth: see its --help)

A data set is known by its layout: VBOF (CCPPQQEE_img1.*), FlyingChairs and FCDN (NAME_img1.*, NAME_img2.*,
NAME_flow.flo), Middlebury (other-data, other-gt-flow), Sintel (clean, final, flow), KITTI (image_2, flow_occ).
A missing or torn file is named and left out, every cell says how many pairs it holds, and the program ends with 3.")]
pub struct Args {
    #[command(subcommand)]
    sub: Option<Sub>,
    /// The data set's folder.
    #[arg(required = true)]
    dataset: Option<PathBuf>,
    /// The files are sRGB pictures: undo the curve and bring the mean to 0.4, as the node sees the world.
    #[arg(long)]
    linear: bool,
    #[command(flatten)]
    how: How,
}

#[derive(clap::Subcommand)]
enum Sub {
    /// Photograph bright pairs at seven ever darker exposures with a camera's noise, and judge methods on each.
    Ladder(LadderArgs),
    /// The paper's table: networks by what they were trained on and what frames went through, by exposure.
    Recipes(recipes::Args),
    /// Make reference flow for bright pairs of your own, so that darker exposures of the same scenes can be judged.
    Reference(reference::Args),
}

/// The brightness ladder: linearise, expose to raw means of 0.4 … 0.001, count photons, read, quantise, scale to 0.4.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow eval ladder pairs/ --models pwcnet_fcdn,zero --out results
  nightflow eval ladder pairs/ --models zero --enhancers none,nlm --write dark
  nightflow eval ladder pairs/ --models raft=raft_small.onnx,dis=results/dis --enhancers none,nlm,gaussian:2
  nightflow eval ladder pairs/ --models pwcnet_fcdn --faults none,rows,banding,fixed,tukey,10bit,jpeg8

The limit is the Cramér–Rao bound of a square of 15 pixels (--patch) around each pixel.")]
struct LadderArgs {
    /// A data set with true flow, or any folder of NAME_img1.*, NAME_img2.*, NAME_flow.flo; sRGB pictures.
    pairs: PathBuf,
    #[command(flatten)]
    night: Night,
    /// How often each exposure is drawn; a pair's draws are averaged before the pairs are.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=100))]
    draws: u32,
    /// Noise besides the camera's, each on the whole ladder: none, rows, banding (drifts between frames), fixed (pattern,
    /// the same in both frames), tukey (long-tailed read noise), 10bit, jpeg8 (what is shown is a JPEG). Several are
    /// compared with none, a table a method; limits are of the first. Their pictures and flows are in folders as Exp-3_rows.
    #[arg(long, value_delimiter = ',', default_value = "none")]
    faults: Vec<Fault>,
    /// Side of the square that the limit is for, pixels, odd.
    #[arg(long, default_value_t = bound::PATCH)]
    patch: usize,
    #[command(flatten)]
    how: How,
}

#[derive(clap::Args)]
struct How {
    /// Methods, separated by commas: zero, a network of the manifest, NAME=FOLDER/NETWORK, NAME=FILE.onnx of two images
    /// (0…255; @1 behind it: 0…1), NAME=FOLDER of other programs' ENHANCER/CONDITION/PAIR_flow.flo.
    #[arg(long, value_delimiter = ',', default_value = "pwcnet_fcdn,zero")]
    models: Vec<String>,
    /// What frames go through first: none, nlm, gaussian[:SIGMA], median[:SIDE], onnx:FILE (NCHW, 0…1, such as SID).
    #[arg(long, value_delimiter = ',', default_value = "none")]
    enhancers: Vec<Enhancer>,
    /// Judge our networks by what their cells know, bilinear between them, without their upsamplers.
    #[arg(long)]
    bilinear: bool,
    /// The layout, where it can't be told from the folder: vbof, pairs, middlebury, sintel, kitti.
    #[arg(long, value_parser = kind)]
    layout: Option<Kind>,
    /// Write table.md, table.csv, table.json and epe.svg into this folder.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Write the very pixels that methods see: ENHANCER/CONDITION/PAIR_img1.png and _img2.png.
    #[arg(long, value_name = "DIR")]
    write: Option<PathBuf>,
    #[command(flatten)]
    work: Work,
}

/// The camera of a ladder.
#[derive(clap::Args)]
struct Night {
    /// The camera whose measured noise is drawn.
    #[arg(long, default_value = "Canon EOS M6")]
    camera: String,
    /// Its sensitivity.
    #[arg(long, default_value_t = 3200)]
    iso: u32,
    /// The same seed gives the same bits.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// On what, and how, it is computed.
#[derive(clap::Args, Clone)]
struct Work {
    /// Only pairs whose name contains this.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// Threads of the networks.
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Pairs judged at a time, each on --threads of its own: two of one thread are faster than one of two.
    #[arg(long, default_value_t = 1, value_parser = workers)]
    workers: usize,
    /// A launch file whose [flow] says with what networks are computed: runtime, provider, precision, operators, models.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

fn kind(text: &str) -> Result<Kind, String> {
    let names: Vec<&str> = KINDS.iter().map(|(name, _)| *name).collect();
    let found = KINDS.iter().find(|(name, _)| *name == text).map(|(_, kind)| *kind);
    found.ok_or_else(|| format!("{text:?} is no layout; expected {}", names.join(", ")))
}

fn workers(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|count| (1..=64).contains(count)).ok_or_else(|| "expected 1 … 64".into())
}

/// Evaluates and prints the tables.
pub fn run(args: Args) -> Result<Exit> {
    match (args.sub, args.dataset) {
        (Some(Sub::Recipes(args)), _) => recipes::run(args),
        (Some(Sub::Reference(args)), _) => reference::run(&args),
        (Some(Sub::Ladder(ladder)), _) => {
            let (light, about) = ladder.night.light(&ladder.faults, Some(ladder.patch), ladder.draws)?;
            publish(&evaluate(&ladder.pairs, &light, &ladder.how, about, ladder.draws)?, &ladder.how)
        }
        (None, Some(dataset)) => {
            let light = if args.linear { Light::Linear } else { Light::AsItIs };
            publish(&evaluate(&dataset, &light, &args.how, vec![], 1)?, &args.how)
        }
        (None, None) => bail!("a data set's folder is needed"),
    }
}

impl Night {
    /// The ladder of this camera, with the limit for a square of so many pixels if that is asked for; and what to say of it.
    fn light(&self, given: &[Fault], patch: Option<usize>, draws: u32) -> Result<(Light, Vec<(String, String)>)> {
        if let Some(patch) = patch.filter(|patch| patch.is_multiple_of(2)) {
            bail!("--patch is {patch}; expected an odd number of pixels, as 15");
        }
        let Self { camera, iso, seed } = self;
        let sensor = Sensor::find(camera, *iso)?;
        let said = format!("{camera} at ISO {iso}, seed {seed}, draws a pair: {draws}");
        let mut about = vec![("camera".to_owned(), said)];
        about.extend(patch.map(|side| ("limit".into(), format!("Cramér–Rao, a square of {side} × {side} pixels"))));
        let mut faults: Vec<Fault> = vec![];
        for fault in given {
            if !faults.contains(fault) {
                faults.push(*fault);
            }
        }
        if faults != [Fault::None] {
            about.extend(faults.iter().map(|fault| (format!("noise {fault}"), fault.about().to_owned())));
        }
        Ok((Light::Ladder { sensor, seed: *seed, patch, faults }, about))
    }
}

/// In what light the pairs are shown.
enum Light {
    AsItIs,
    Linear,
    Ladder { sensor: Sensor, seed: u64, patch: Option<usize>, faults: Vec<Fault> },
}

impl Light {
    /// How many exposures a pair is shown at, and with what noise each.
    fn views(&self) -> (usize, &[Fault]) {
        match self {
            Self::Ladder { faults, .. } => (MEANS.len(), faults),
            _ => (1, &[Fault::None]),
        }
    }
}

/// A pair in one light.
struct View {
    condition: String,
    shown: String,
    fault: Fault,
    frames: [Picture; 2],
    truths: Vec<(String, Field)>,
    limit: Option<bound::Limit>,
}

fn evaluate(folder: &Path, light: &Light, how: &How, mut about: Vec<(String, String)>, draws: u32) -> Result<Report> {
    let Found { kind, mut items, mut skipped } = datasets::find(folder, how.layout)?;
    if kind == Kind::Vbof && matches!(light, Light::Ladder { .. }) {
        bail!("{} has been photographed in the dark already; a ladder wants bright sRGB pairs", folder.display());
    }
    if let Some(text) = &how.work.only {
        items.retain(|item| item.name.contains(text));
        skipped.retain(|left| left.what.contains(text));
    }
    if items.is_empty() && skipped.is_empty() {
        bail!(
            "{} has no pair{}",
            folder.display(),
            how.work.only.as_ref().map_or(String::new(), |t| format!(" named {t}"))
        );
    }
    let config = how.settings()?;
    let first = Judges::open(how, &config)?;
    let layout = KINDS.iter().find(|(_, known)| *known == kind).map_or("", |(name, _)| name);
    about.insert(0, ("data".into(), format!("{} ({layout}), {} pairs", folder.display(), items.len())));
    about.extend(first.methods.iter().map(|method| (method.name.clone(), method.about())));
    let (rungs, faults) = light.views();
    // With the camera's own noise alone nothing is compared.
    let faults = if faults == [Fault::None] { vec![] } else { faults.to_vec() };
    // The name seeds the noise, so that another draw is the same pair by another name.
    let again = |item: &Item, draw: u32| match draw {
        0 => item.clone(),
        _ => Item { name: format!("{}{DRAW}{draw}", item.name), ..item.clone() },
    };
    let items: Vec<Item> = items.iter().flat_map(|item| (0..draws).map(move |draw| again(item, draw))).collect();
    let steps = rungs * light.views().1.len() * how.enhancers.len();
    let bar = progress(items.len() * steps)?;
    let empty = Report { faults: faults.clone(), ..Report::default() };
    let next = AtomicUsize::new(0);
    // Each worker takes the next pair, and what is found is put together in the order of the pairs.
    let work = |mut judges: Judges| -> Result<Vec<(usize, Report)>> {
        let mut found = vec![];
        loop {
            let at = next.fetch_add(1, Ordering::Relaxed);
            let Some(item) = items.get(at) else { return Ok(found) };
            bar.set_message(item.name.clone());
            let mut report = empty.clone();
            match datasets::load(item) {
                Ok(loaded) => {
                    for view in views(item, loaded, light) {
                        judge(item, view?, &mut judges, how, &mut report, &bar)?;
                    }
                }
                Err(left) => {
                    bar.inc(steps as u64);
                    report.skipped.push(left);
                }
            }
            found.push((at, report));
        }
    };
    let more = (1..how.work.workers).map(|_| Judges::open(how, &config)).collect::<Result<Vec<_>>>()?;
    let mut found = std::thread::scope(|scope| -> Result<Vec<(usize, Report)>> {
        let others: Vec<_> = more.into_iter().map(|judges| scope.spawn(|| work(judges))).collect();
        let mut found = work(first)?;
        for other in others {
            found.extend(other.join().map_err(|_| anyhow::anyhow!("a worker of the evaluation panicked"))??);
        }
        Ok(found)
    })?;
    bar.finish_and_clear();
    found.sort_by_key(|(at, _)| *at);
    Ok(gathered(Report { about, skipped, faults, ..Report::default() }, found.into_iter().map(|(_, part)| part)))
}

/// All parts in one report, in their order.
fn gathered(mut whole: Report, parts: impl Iterator<Item = Report>) -> Report {
    for part in parts {
        part.conditions.into_iter().for_each(|known| whole.knows(known));
        whole.records.extend(part.records);
        whole.limits.extend(part.limits);
        whole.skipped.extend(part.skipped);
    }
    whole
}

impl How {
    /// With what networks are computed.
    fn settings(&self) -> Result<flow::Config> {
        let read = launch::read(self.work.config.as_deref())?.flow;
        let resolution = if self.bilinear { flow::Resolution::Bilinear } else { read.resolution };
        Ok(flow::Config { threads: self.work.threads, resolution, ..read })
    }
}

/// What a worker judges and what it puts before it.
struct Judges {
    methods: Vec<Method>,
    enhancers: Vec<Enhancing>,
}

impl Judges {
    fn open(how: &How, config: &flow::Config) -> Result<Self> {
        let methods = how.models.iter().map(|given| Method::open(given, config)).collect::<Result<Vec<_>, _>>()?;
        let enhancers = how.enhancers.iter().cloned().map(|by| Enhancing::open(by, config));
        Ok(Self { methods, enhancers: enhancers.collect::<Result<Vec<_>, _>>()? })
    }
}

/// The pair in every light, made when its turn comes.
fn views(item: &Item, loaded: datasets::Loaded, light: &Light) -> impl Iterator<Item = Result<View>> {
    let linear = (!matches!(light, Light::AsItIs)).then(|| Linear::of([&loaded.frames[0], &loaded.frames[1]]));
    let (rungs, faults) = light.views();
    let turns = (0..rungs).flat_map(move |at| faults.iter().map(move |fault| (at, *fault)));
    turns.map(move |(at, fault)| {
        let truths = loaded.truths.clone();
        let whole = (item.condition.clone(), item.condition.clone());
        let (condition, shown, frames, limit) = match (light, &linear) {
            (Light::Ladder { sensor, seed, patch, .. }, Some(linear)) => {
                let rung = linear.expose(&Sensor { fault, ..*sensor }, MEANS[at], *seed, &item.name);
                // It is of white noise, the same for every kind.
                let truth = truths.first().filter(|_| faults.first() == Some(&fault));
                let limit = truth.zip(*patch).and_then(|((_, truth), side)| bound::limit(&rung, truth, side));
                let noise = 255.0 * rung.noise.variance(1, 0.4).sqrt();
                let shown = format!("Exp-{at} (mean {}, noise {noise:.1}/255)", MEANS[at]);
                let [older, newer] = rung.pictures();
                (format!("Exp-{at}"), shown, [fault.shown(older)?, fault.shown(newer)?], limit)
            }
            (Light::Linear, Some(linear)) => (whole.0, whole.1, linear.scaled(), None),
            _ => (whole.0, whole.1, loaded.frames.clone(), None),
        };
        Ok(View { condition, shown, fault, frames, truths, limit })
    })
}

/// Every enhancer and method on one view of a pair.
fn judge(
    item: &Item,
    view: View,
    judges: &mut Judges,
    how: &How,
    report: &mut Report,
    bar: &ProgressBar,
) -> Result<()> {
    let ladder = view.condition != item.condition;
    // Where the truth comes in several kinds, they are what the table is sorted by.
    let sorted = |truth: &str| match (ladder, view.truths.len()) {
        (true, 1) => (view.condition.clone(), view.shown.clone()),
        (true, _) => (format!("{} {truth}", view.condition), format!("{} {truth}", view.shown)),
        (false, _) => (truth.to_owned(), truth.to_owned()),
    };
    for (truth, _) in &view.truths {
        let (condition, shown) = sorted(truth);
        report.knows((condition.clone(), shown));
        report.limits.extend(view.limit.map(|limit| (item.name.clone(), condition, limit)));
    }
    let light = match view.fault {
        Fault::None => view.condition.clone(),
        fault => format!("{} {fault}", view.condition),
    };
    let folder = light.replace([' ', '/'], "_");
    for enhancing in &mut judges.enhancers {
        let by = enhancing.by.to_string();
        let frames = [enhancing.enhance(&view.frames[0])?, enhancing.enhance(&view.frames[1])?];
        let place = Path::new(&by).join(&folder).join(format!("{}_flow.flo", item.name));
        if let Some(root) = &how.write {
            write(&root.join(&by).join(&folder), &item.name, &frames)?;
        }
        for method in judges.methods.iter_mut().filter(|method| method.covers(&enhancing.by)) {
            let shown = Shown { frames: [&frames[0], &frames[1]], place: &place };
            let what = format!("{} by {} ({by}, {light})", item.name, method.name);
            let found = match method.flow(&shown) {
                Ok(found) => found,
                // Others' results may be torn; a network that fails is no matter of one pair.
                Err(nightflow::darkness::methods::Error::File(error)) => {
                    report.skipped.push(Skipped { what, why: datasets::said(&error) });
                    continue;
                }
                Err(error) => return Err(error).context(what),
            };
            for (truth, field) in &view.truths {
                match score(&found, field) {
                    Some(score) => {
                        let condition = sorted(truth).0;
                        let record = Record::new(&item.name, &condition, &by, &method.name, score);
                        let fault = (!report.faults.is_empty()).then_some(view.fault);
                        report.records.push(Record { fault, ..record });
                    }
                    None => report.skipped.push(Skipped { what: what.clone(), why: mismatch(&found, field) }),
                }
            }
        }
        bar.inc(1);
    }
    Ok(())
}

fn mismatch(found: &Field, truth: &Field) -> String {
    if (found.width, found.height) == (truth.width, truth.height) {
        return "no pixel's truth is known".into();
    }
    format!("the flow is {}×{}, its truth {}×{}", found.width, found.height, truth.width, truth.height)
}

fn write(folder: &Path, name: &str, frames: &[Picture; 2]) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    for (frame, role) in frames.iter().zip(["img1", "img2"]) {
        frame.write(&folder.join(format!("{name}_{role}.png")))?;
    }
    Ok(())
}

/// Prints the tables and writes them where that is asked for.
fn publish(report: &Report, how: &How) -> Result<Exit> {
    let markdown = report.markdown();
    print!("{markdown}");
    if let Some(folder) = &how.out {
        let plot = report.plot().map_err(undrawn)?;
        let files =
            [("table.md", markdown), ("table.csv", report.csv()), ("table.json", report.json()?), ("epe.svg", plot)];
        put(folder, files.map(|(name, text)| (name.to_owned(), text)))?;
    }
    Ok(if report.skipped.is_empty() { Exit::Done } else { Exit::DataLost })
}

/// The drawing library's errors have no common type.
fn undrawn(error: Box<dyn std::error::Error>) -> anyhow::Error {
    anyhow::anyhow!("the plot can't be drawn: {error}")
}

/// Writes files of text into a folder, which is made if there is none.
fn put<const COUNT: usize>(folder: &Path, files: [(String, String); COUNT]) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    for (name, text) in files {
        let path = folder.join(name);
        std::fs::write(&path, text).with_context(|| path.display().to_string())?;
    }
    Ok(())
}

fn progress(steps: usize) -> Result<ProgressBar> {
    let style = ProgressStyle::with_template("{bar:40} {pos} of {len} {msg}, {eta} left")?;
    Ok(ProgressBar::with_draw_target(Some(steps as u64), ProgressDrawTarget::stderr_with_hz(5)).with_style(style))
}
