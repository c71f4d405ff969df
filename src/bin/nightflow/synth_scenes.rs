//! `nightflow synth scenes`: pairs with exact flow, into a folder in FlyingChairs' layout or as a stream for a trainer.

use std::{
    io::{self, Write},
    num::NonZero,
    path::{Path, PathBuf},
    sync::{
        atomic::{AtomicU64, Ordering},
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use nightflow::darkness::{
    flow_files::flo_bytes,
    recipes::Recipe,
    scenes::{
        Library, Pair, Part, Preset, Scenes, Settings,
        stream::{self, Precision},
    },
};

/// Says how a folder was made, so that a second run goes on with the same scenes or not at all.
const RECORD: &str = "scenes.txt";
/// Pairs that wait for a slow reader, for each thread.
const WAITING: usize = 2;

/// Draw pairs with exact flow and what stays in sight.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow synth scenes --photos photos --to scenes --count 1000
  nightflow synth scenes --photos photos --cutouts /usr/share/tuxpaint/stamps --preset drone --to scenes --count 1000
  nightflow synth scenes --to scenes --count 10                        (textures by formula, no photographs needed)
  nightflow synth scenes --photos photos --preset mixed --recipe paper --stream | python train.py
  nightflow show scenes --most 40                                      (look at them)

A folder gets NAME_img1.ppm, NAME_img2.ppm, NAME_flow.flo and NAME_valid.png (white: still seen in the newer frame); the
same command goes on where it was interrupted. A stream is described in the documentation of darkness::scenes::stream: a
header, then records in the order of their numbers; it waits for a slow reader and ends when the reader does.
Photographs are kept decoded, about 2 MB each. Pairs depend on the pictures, the settings and the seed alone.")]
pub struct Args {
    /// Photographs (PNG, JPEG, PPM) for backgrounds and shapes; without it, textures made by formula.
    #[arg(long, value_name = "DIR")]
    photos: Option<PathBuf>,
    /// PNG files with transparency that fly as they are.
    #[arg(long, value_name = "DIR", requires = "photos")]
    cutouts: Option<PathBuf>,
    /// Which photographs: all, training (nine of ten, by a hash of the name) or held-out (the tenth).
    #[arg(long, value_name = "PART", default_value = "all", value_parser = |name: &str| name.parse::<Part>())]
    part: Part,
    /// The folder to write.
    #[arg(long, value_name = "DIR", required_unless_present = "stream", conflicts_with = "stream")]
    to: Option<PathBuf>,
    /// Write a stream to standard output.
    #[arg(long)]
    stream: bool,
    /// How many pairs; a stream without it has no end.
    #[arg(long, value_name = "N", required_unless_present = "stream")]
    count: Option<u64>,
    /// Number of the first pair, from 0.
    #[arg(long, value_name = "N", default_value_t = 0)]
    first: u64,
    /// chairs (FlyingChairs' displacements), drone (ground and parallax, at most 32 px) or mixed (in turn).
    #[arg(long, default_value = "chairs", value_parser = |name: &str| name.parse::<Preset>())]
    preset: Preset,
    /// Columns and rows.
    #[arg(long, default_value = "448x320", value_parser = crate::synth::size)]
    size: [usize; 2],
    /// The same seed gives the same pairs.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Noise: paper, authors-2021, unprocess or none. The scenes are the same with any.
    #[arg(long, value_name = "RECIPE", default_value = "none", value_parser = noise)]
    recipe: Noise,
    /// Flow components in a stream: f16 (right to 1/2048) or f32.
    #[arg(long, value_name = "KIND", default_value = "f16", value_parser = precision)]
    flow: Precision,
    /// Threads; all cores by default.
    #[arg(long, value_name = "N")]
    threads: Option<NonZero<usize>>,
}

/// A recipe, or none.
#[derive(Debug, Clone, Copy)]
struct Noise(Option<Recipe>);

fn noise(name: &str) -> Result<Noise, String> {
    match name {
        "none" => Ok(Noise(None)),
        name => name.parse().map(|recipe| Noise(Some(recipe))).map_err(|error| format!("{error}; or none")),
    }
}

/// Reads the pictures and draws.
pub fn run(args: &Args) -> Result<()> {
    let library = match &args.photos {
        Some(photos) => Library::read(photos, args.cutouts.as_deref(), args.part)?,
        None => Library::by_formula(args.seed),
    };
    for name in &library.left_out {
        eprintln!("left out: {name}");
    }
    let [pictures, cutouts] = library.counts();
    let settings = Settings { preset: args.preset, size: args.size, seed: args.seed, recipe: args.recipe.0 };
    let scenes = Scenes::new(settings, library)?;
    eprintln!("{pictures} pictures, {cutouts} cut-outs");
    match &args.to {
        Some(folder) => into_folder(args, &scenes, folder),
        None => onto_stream(args, &scenes),
    }
}

fn threads(args: &Args) -> usize {
    args.threads.or_else(|| thread::available_parallelism().ok()).map_or(1, NonZero::get)
}

fn into_folder(args: &Args, scenes: &Scenes, folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("{} can't be made", folder.display()))?;
    settle(args, folder)?;
    let count = args.count.unwrap_or(0);
    let style = ProgressStyle::with_template("{bar:40} {pos} of {len} pairs, {per_sec}, {eta} left")?;
    let bar = ProgressBar::new(count).with_style(style);
    let next = AtomicU64::new(0);
    let (done, kept) = (AtomicU64::new(0), AtomicU64::new(0));
    let work = || -> Result<()> {
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= count {
                return Ok(());
            }
            let index = args.first + number;
            if whole(args, folder, index) {
                kept.fetch_add(1, Ordering::Relaxed);
            } else {
                write(folder, &scenes.pair(index))?;
                done.fetch_add(1, Ordering::Relaxed);
            }
            bar.inc(1);
        }
    };
    thread::scope(|scope| {
        let workers: Vec<_> = (0..threads(args)).map(|_| scope.spawn(work)).collect();
        workers.into_iter().try_for_each(|worker| match worker.join() {
            Ok(ended) => ended,
            Err(_) => bail!("a thread broke down"),
        })
    })?;
    bar.finish_and_clear();
    let (done, kept) = (done.into_inner(), kept.into_inner());
    println!("{}: {done} pairs drawn, {kept} were there", folder.display());
    Ok(())
}

/// Writes down how the scenes are made, or refuses to mix them with others.
fn settle(args: &Args, folder: &Path) -> Result<()> {
    let [width, height] = args.size;
    let source = |path: &Option<PathBuf>| path.as_ref().map_or("by formula".into(), |path| path.display().to_string());
    let asked = format!(
        "nightflow synth scenes, preset {}, {width}x{height}, seed {}, recipe {}, photographs {} ({:?}), cut-outs {}\n",
        args.preset,
        args.seed,
        args.recipe.0.map_or("none", Recipe::name),
        source(&args.photos),
        args.part,
        args.cutouts.as_ref().map_or("none".into(), |path| path.display().to_string()),
    );
    let path = folder.join(RECORD);
    match std::fs::read_to_string(&path) {
        Ok(found) if found != asked => bail!(
            "{} holds other scenes: expected\n  {}found\n  {}write into another folder, or remove that file to mix them",
            folder.display(),
            asked,
            found
        ),
        Ok(_) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {
            std::fs::write(&path, asked).with_context(|| format!("{} can't be written", path.display()))
        }
        Err(error) => Err(error).with_context(|| path.display().to_string()),
    }
}

/// The flow is written last, and under another name until it is whole.
fn flow_path(folder: &Path, index: u64) -> PathBuf {
    folder.join(format!("{:05}_flow.flo", index + 1))
}

fn whole(args: &Args, folder: &Path, index: u64) -> bool {
    let expected = 12 + 8 * args.size[0] as u64 * args.size[1] as u64;
    std::fs::metadata(flow_path(folder, index)).is_ok_and(|found| found.len() == expected)
}

fn write(folder: &Path, pair: &Pair) -> Result<()> {
    let [width, height] = pair.size;
    let at = |ending: &str| folder.join(format!("{:05}_{ending}", pair.index + 1));
    for (ending, frame) in [("img1.ppm", &pair.older), ("img2.ppm", &pair.newer)] {
        let path = at(ending);
        let bytes = [format!("P6\n{width} {height}\n255\n").as_bytes(), frame].concat();
        std::fs::write(&path, bytes).with_context(|| format!("{} can't be written", path.display()))?;
    }
    let mask: Vec<u8> = pair.valid.iter().map(|valid| if *valid { 255 } else { 0 }).collect();
    let path = at("valid.png");
    image::save_buffer(&path, &mask, width as u32, height as u32, image::ExtendedColorType::L8)
        .with_context(|| format!("{} can't be written", path.display()))?;
    let (path, unfinished) = (flow_path(folder, pair.index), at("flow.flo.part"));
    std::fs::write(&unfinished, flo_bytes(&pair.field())?)
        .and_then(|()| std::fs::rename(&unfinished, &path))
        .with_context(|| format!("{} can't be written", path.display()))
}

/// Thread k of n draws the pairs k, k + n, …; the writer takes them in turn, so that the order is that of the numbers and
/// no more than a few pairs wait.
fn onto_stream(args: &Args, scenes: &Scenes) -> Result<()> {
    let mut out = io::stdout().lock();
    let header = stream::header(scenes.settings(), args.flow, args.first, args.count.unwrap_or(0));
    let threads = threads(args) as u64;
    let end = args.count.map_or(u64::MAX, |count| args.first.saturating_add(count));
    thread::scope(|scope| {
        let mut queues: Vec<Receiver<Vec<u8>>> = Vec::new();
        for begin in 0..threads {
            let (sender, queue) = sync_channel(WAITING);
            queues.push(queue);
            scope.spawn(move || records(args, scenes, args.first + begin, threads, end, &sender));
        }
        let written = out.write_all(&header).and_then(|()| {
            for index in args.first..end {
                let Ok(record) = queues[((index - args.first) % threads) as usize].recv() else {
                    return Err(io::Error::other("a thread broke down"));
                };
                out.write_all(&record)?;
            }
            out.flush()
        });
        match written {
            // The reader has had enough.
            Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
            other => other.context("standard output can't be written"),
        }
    })
}

fn records(args: &Args, scenes: &Scenes, begin: u64, step: u64, end: u64, sender: &SyncSender<Vec<u8>>) {
    let mut index = begin;
    while index < end {
        let mut record = Vec::new();
        stream::append(&scenes.pair(index), args.flow, &mut record);
        if sender.send(record).is_err() {
            return;
        }
        index = index.saturating_add(step);
    }
}

fn precision(name: &str) -> Result<Precision, String> {
    match name {
        "f16" => Ok(Precision::Half),
        "f32" => Ok(Precision::Single),
        found => Err(format!("there is no kind {found:?}; there are f16 and f32")),
    }
}
