//! `nightflow show`: flow files, data sets and recordings as pictures and one page that lays them side by side.

mod bag;
mod charts;
mod files;
mod page;
mod plates;
mod truths;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use self::{page::Page, plates::Plate};

/// Lay frames, flow, confidence and error side by side, as PNG files and one HTML page.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow show recordings/night_flight.mcap --out pictures
  nightflow show flow.mcap                                  (made by `replay --out`: its own results are shown)
  nightflow show night.flo --image1 a.png --image2 b.png --truth true.flo
  nightflow show flow_000045_10.png                         (16-bit PNG as KITTI has it)
  nightflow show FlyingChairs/data --most 50                (…_img1.ppm, …_img2.ppm, …_flow.flo)

A recording that holds flow is shown as it is; one that holds frames alone is run through the network first. Where it
holds /truth/flow (32FC2), /truth/pan or /truth/velocity, the error against them is shown too.
Open index.html of the folder with any browser; it needs nothing but the files beside it.")]
pub struct Args {
    /// Flow files (.flo, KITTI .png), a folder of pairs as in FlyingChairs, an MCAP file or a folder of rosbag2.
    #[arg(required = true, value_name = "FLOW|DIR|BAG")]
    paths: Vec<PathBuf>,
    /// Where the pictures and index.html go; `show_NAME` where it is not given.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// The older frame of a flow file (PNG, JPEG, PPM); found by itself beside NAME_flow.flo as NAME_img1.
    #[arg(long, value_name = "IMAGE")]
    image1: Option<PathBuf>,
    /// The newer frame of a flow file.
    #[arg(long, value_name = "IMAGE")]
    image2: Option<PathBuf>,
    /// What the flow file is to be compared with.
    #[arg(long, value_name = "FLOW")]
    truth: Option<PathBuf>,
    /// At most so many steps or pairs become pictures; of more, every so-many-th is taken. Figures are of all.
    #[arg(long, value_name = "N", default_value_t = 24)]
    most: usize,
    /// Length in pixels that is shown in full colour; drawn from the flow where it is not given.
    #[arg(long, value_name = "PX")]
    longest: Option<f32>,
    /// Error in pixels at the end of the error's scale; drawn from the errors where it is not given.
    #[arg(long, value_name = "PX")]
    error_max: Option<f32>,
    /// A launch file for a recording that has to be run through the network.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Everything that a page shows.
#[derive(Default)]
struct Story {
    title: String,
    /// What was looked at, by name.
    facts: Vec<(String, String)>,
    /// Every step or pair, with its figures.
    rows: Vec<Row>,
    /// Those that become pictures.
    plates: Vec<Plate>,
}

/// The figures of one step or pair.
#[derive(Debug, Clone, Default)]
struct Row {
    name: String,
    seconds: Option<f64>,
    state: Option<String>,
    raw_mean: Option<f32>,
    confidence: Option<f32>,
    /// Mean and 90th percentile of the end-point error, pixels.
    errors: Option<[f32; 2]>,
    velocity: Option<[f64; 3]>,
    velocity_words: String,
    true_velocity: Option<[f64; 3]>,
}

/// Draws everything, and says where it is.
pub fn run(args: &Args) -> Result<()> {
    let first = &args.paths[0];
    for path in &args.paths {
        if !path.exists() {
            let missing = std::io::Error::new(std::io::ErrorKind::NotFound, "there is no such file or folder");
            return Err(missing).with_context(|| path.display().to_string());
        }
    }
    let story = if is_bag(first)? {
        if args.paths.len() > 1 || args.truth.is_some() || args.image1.is_some() || args.image2.is_some() {
            bail!("a recording is shown alone: it brings its own frames and truth");
        }
        bag::look(args, first)?
    } else {
        files::look(args)?
    };
    let stem = first.file_stem().unwrap_or_default().to_string_lossy();
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from(format!("show_{stem}")));
    std::fs::create_dir_all(&out).with_context(|| format!("{} can't be made", out.display()))?;
    let pictures = Page::draw(&story, &out, args.longest, args.error_max)?;
    for (name, value) in &story.facts {
        println!("{name:<14}{value}");
    }
    println!("{:<14}{} and {pictures} pictures", "written", out.join("index.html").display());
    Ok(())
}

/// Whether a path is a recording: an MCAP file, or a folder that holds one.
fn is_bag(path: &Path) -> Result<bool> {
    let mcap = |path: &Path| path.extension().is_some_and(|ending| ending == "mcap");
    if !path.is_dir() {
        return Ok(mcap(path));
    }
    let mut entries = std::fs::read_dir(path).with_context(|| path.display().to_string())?;
    Ok(entries.any(|entry| entry.is_ok_and(|entry| mcap(&entry.path()))))
}

/// Mean and 90th percentile of the errors that are there.
fn summed(errors: &[f32]) -> Option<[f32; 2]> {
    let mut finite: Vec<f32> = errors.iter().copied().filter(|error| error.is_finite()).collect();
    if finite.is_empty() {
        return None;
    }
    let mean = finite.iter().map(|error| f64::from(*error)).sum::<f64>() / finite.len() as f64;
    let at = (finite.len() - 1) * 9 / 10;
    let (_, ninth, _) = finite.select_nth_unstable_by(at, f32::total_cmp);
    Some([mean as f32, *ninth])
}

/// The line that sums up the errors of all steps or pairs.
fn error_fact(rows: &[Row], what: &str) -> Option<(String, String)> {
    let mut means: Vec<f32> = rows.iter().filter_map(|row| row.errors.map(|[mean, _]| mean)).collect();
    if means.is_empty() {
        return None;
    }
    means.sort_by(f32::total_cmp);
    let mean = means.iter().map(|mean| f64::from(*mean)).sum::<f64>() / means.len() as f64;
    let (median, worst) = (means[means.len() / 2], means[means.len() - 1]);
    let words = format!("EPE {mean:.2} px over {} {what} (median {median:.2}, worst {worst:.2})", means.len());
    Some(("error".into(), words))
}
