//! `nightflow synth fcdn`: a folder of clean pairs becomes a folder of dark ones.

use std::{
    path::PathBuf,
    sync::{Mutex, PoisonError},
};

use anyhow::{Context, Result};
use indicatif::{ProgressBar, ProgressStyle};
use nightflow::darkness::{
    fcdn::{self, Error, Pair, Rows, Set},
    recipes::{Recipe, TABLE},
};

/// Upper edges of the columns of the paper's table 1; the last is open.
const EDGES: [f64; 3] = [10.0, 20.0, 30.0];

/// Turn clean pairs (FlyingChairs) into dark ones (FCDN): noise in the frames, the flow as it was.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow synth fcdn --from FlyingChairs_release/data --to FCDN
  nightflow synth fcdn --from FlyingChairs_release/data --to FCDN-2021 --recipe authors-2021 --seed 7

In:  NAME_img1.ppm, NAME_img2.ppm (or .png, .jpg) and NAME_flow.flo; NAME is 00001 and so on, or anything else.
Out: the same names, frames as PPM, the flow byte for byte; fcdn.csv says what was drawn for each pair.

Recipes:
  paper         a tone curve a colour (power 1.0 to 2.4), then a real camera's noise of variance a*y + b, at levels that
                fill the paper's table 1
  authors-2021  the authors' later script: deviation a*x + b, whole numbers, a gain a colour
  unprocess     Brooks et al. 2019: tone curve, colours and white balance undone, then shot and read noise

A run that was interrupted goes on where it was, and gives the same bytes as one that was not. A pair with a missing or
torn file is named and skipped. Exit code 0 as long as there is a pair at the end; 2 if there is none, or if the folder
holds a set made otherwise; 1 if the disk refuses.")]
pub struct Args {
    /// Folder of the clean pairs.
    #[arg(long, value_name = "DIR")]
    from: PathBuf,
    /// Folder of the dark pairs.
    #[arg(long, value_name = "DIR")]
    to: PathBuf,
    /// How they become dark: paper, authors-2021 or unprocess.
    #[arg(long, default_value_t = Recipe::Paper)]
    recipe: Recipe,
    /// The same seed gives the same bytes, on any machine and any number of threads.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    seed: u64,
    /// Threads, all cores where it is not given.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
}

/// Makes what isn't there yet and prints what became of it.
pub fn run(args: &Args) -> Result<()> {
    let all = fcdn::pairs(&args.from).with_context(|| format!("{} can't be read", args.from.display()))?;
    if all.is_empty() {
        return Err(Error::Empty { path: args.from.clone() }.into());
    }
    let set = Set::open(&args.to, args.recipe, args.seed)?;
    let rows = set.rows()?;
    let count = all.len();
    let (mut skipped, mut left, mut there) = (Vec::new(), Vec::new(), 0);
    for pair in all {
        match pair {
            Ok(pair) if rows.has(&pair.name) && set.holds(&pair) => there += 1,
            Ok(pair) => left.push(pair),
            Err(error) => skipped.push(error),
        }
    }
    let (made, rows) = make(args, &set, &left, rows, &mut skipped)?;
    skipped.sort_by_key(Error::to_string);
    for error in &skipped {
        eprintln!("skipped: {}", told(error));
    }
    print!("{}: {made} pairs made, {there} were there, {} skipped", args.to.display(), skipped.len());
    println!("; recipe {}, seed {}", args.recipe, args.seed);
    if made + there == 0 {
        return Err(Error::Unusable { path: args.from.clone(), pairs: count }.into());
    }
    print_levels(&rows, args.recipe);
    Ok(rows.finish()?)
}

/// An error with what the system said.
fn told(error: &Error) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(inner) = cause {
        text.push_str(&format!(": {inner}"));
        cause = inner.source();
    }
    text
}

/// Makes the pairs on as many threads as asked for; what is skipped joins `skipped`.
fn make(args: &Args, set: &Set, left: &[Pair], rows: Rows, skipped: &mut Vec<Error>) -> Result<(usize, Rows)> {
    let threads = args.threads.map_or(0, usize::from);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().context("no threads can be started")?;
    let style = ProgressStyle::with_template("{bar:40} {pos} of {len} pairs, {per_sec}, {eta} left")?;
    let bar = ProgressBar::new(left.len() as u64).with_style(style);
    let ledger = Mutex::new((rows, Vec::new()));
    let result = pool.install(|| {
        set.make_all(left, &|pair, made| {
            let mut ledger = ledger.lock().unwrap_or_else(PoisonError::into_inner);
            match made {
                Ok(drawn) => ledger.0.add(&pair.name, &drawn)?,
                Err(error) => ledger.1.push(error),
            }
            bar.inc(1);
            Ok(())
        })
    });
    bar.finish_and_clear();
    let (rows, failed) = ledger.into_inner().unwrap_or_else(PoisonError::into_inner);
    let made = left.len() - failed.len();
    skipped.extend(failed);
    result.with_context(|| format!("{} can't be finished", args.to.display()))?;
    Ok((made, rows))
}

/// The table of noise levels beside the paper's.
fn print_levels(rows: &Rows, recipe: Recipe) {
    let mut counts = [0_u32; 4];
    for level in rows.levels() {
        counts[EDGES.iter().position(|edge| level < *edge).unwrap_or(EDGES.len())] += 1;
    }
    let line = |counts: [u32; 4]| {
        let all = f64::from(counts.iter().sum::<u32>().max(1));
        counts.map(|count| format!("{:>8.1}", 100.0 * f64::from(count) / all)).concat()
    };
    println!("noise level      0-10   10-20   20-30     >30  (% of pairs, 8-bit scale)");
    println!("{:<13}{}", recipe.name(), line(counts));
    println!("{:<13}{}", "paper's FCDN", line(TABLE));
}
