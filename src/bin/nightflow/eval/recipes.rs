//! `nightflow eval recipes`: the paper's table on one's own pairs, from the networks of the manifest.

use std::{
    fmt::Write as _,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail};
use nightflow::darkness::{by_training, enhance::Enhancer, faults::Fault, report::Report};

use super::{How, Night, Work, evaluate, put, undrawn};
use crate::Exit;

/// The table that the paper made: every network by what it was trained on (clean, FCDN by the paper's recipe, by the
/// authors' script of 2021, by unprocess) and by what frames go through first, photographed ever darker.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow synth scenes --photos photos/ --preset mixed --size 256x192 --count 200 --to scenes
  nightflow eval recipes pairs/ scenes/ --threads 1 --workers 2 --out table
  nightflow eval recipes pairs/ --models flownets_clean,flownets_fcdn --draws 1

Of each set --out gets recipes_SET.md (mean end-point error over pairs ± deviation over the draws of the noise), \
recipes_SET.svg and recipes_SET.json, as soon as it is through. The paper's own table is printed below in the same shape. \
What a network was trained on is the last part of its name. All of it takes as long as models × enhancers × draws × 7 \
ladders: with the 200 pairs above, over an hour on two cores; --only takes less.")]
pub struct Args {
    /// Data sets with true flow, or folders of NAME_img1.*, NAME_img2.*, NAME_flow.flo; sRGB pictures.
    #[arg(required = true)]
    sets: Vec<PathBuf>,
    #[command(flatten)]
    night: Night,
    /// How often the noise of each exposure is drawn: the spread is over these.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    draws: u32,
    /// Networks: those of the manifest, or what else eval knows.
    #[arg(long, value_delimiter = ',', default_value = DEFAULT)]
    models: Vec<String>,
    /// What frames go through first.
    #[arg(long, value_delimiter = ',', default_value = "none,nlm,gaussian:2")]
    enhancers: Vec<Enhancer>,
    /// Write the tables, the pictures and every figure into this folder.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    work: Work,
}

/// Networks of the paper by all that they were trained on.
const DEFAULT: &str = "flownetc_clean,flownetc_fcdn,flownetc_authors2021,flownetc_unprocess,flownets_clean,flownets_fcdn,\
    flownets_authors2021,flownets_unprocess,pwcnet_clean,pwcnet_fcdn,pwcnet_start,pwcnet_paper,\
    pwcnet_authors2021,pwcnet_unprocess";

/// What a set is called: its folder's own name.
fn name_of(set: &Path) -> Result<String> {
    let whole = set.canonicalize().with_context(|| set.display().to_string())?;
    Ok(whole.file_name().map_or("pairs".into(), |name| name.to_string_lossy().into_owned()))
}

/// Prints the tables, one set after the other, and writes them where that is asked for.
pub fn run(args: Args) -> Result<Exit> {
    let names = args.sets.iter().map(|set| name_of(set)).collect::<Result<Vec<_>>>()?;
    if let Some(twice) = names.iter().enumerate().find(|(at, name)| names[..*at].contains(name)) {
        bail!("two sets are called {}; expected folders of different names", twice.1);
    }
    let (light, about) = args.night.light(&[Fault::None], None, args.draws)?;
    let how = How {
        models: args.models,
        enhancers: args.enhancers,
        // Few of these networks have an upsampler, and what is compared is what they were trained on.
        bilinear: true,
        layout: None,
        out: None,
        write: None,
        work: args.work,
    };
    let mut ended = Exit::Done;
    for (set, name) in args.sets.iter().zip(&names) {
        let report = evaluate(set, &light, &how, about.clone(), args.draws)?;
        if !report.skipped.is_empty() {
            ended = Exit::DataLost;
        }
        let text = told(name, &report);
        print!("{text}");
        if let Some(folder) = &args.out {
            write(folder, name, &text, &report)?;
        }
    }
    println!("\n### The paper's table 2: end-point error on its own benchmark, px\n\n{}", by_training::published());
    Ok(ended)
}

fn told(name: &str, report: &Report) -> String {
    let mut text =
        format!("\n### {name}: end-point error, px (mean over pairs ± deviation over draws of the noise)\n\n");
    for (what, value) in &report.about {
        let _ = writeln!(text, "- {what}: {value}");
    }
    text.push('\n');
    for (_, shown) in &report.conditions {
        let _ = writeln!(text, "- {shown}");
    }
    text += "\n`lost` is from the first exposure to the last.\n\n";
    text + &by_training::markdown(report) + &nightflow::darkness::datasets::left_out(&report.skipped)
}

fn write(folder: &Path, name: &str, text: &str, report: &Report) -> Result<()> {
    let plot = by_training::plot(report).map_err(undrawn)?;
    let files = [("md", text.trim_start().to_owned()), ("json", report.json()?), ("svg", plot)];
    put(folder, files.map(|(ending, text)| (format!("recipes_{name}.{ending}"), text)))
}
