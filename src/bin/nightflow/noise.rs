//! `nightflow noise`: what a camera's noise is, measured on its raw frames.

mod plot;
mod report;
mod shots;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use nightflow::{
    darkness::{
        foi::{self, Clip},
        level::noise_level_rgb,
        profiles,
    },
    exposure::{Mosaic, Pattern, Plane},
};

use self::{
    report::{Colour, Measured},
    shots::Shots,
};

/// Measure the noise of real frames.
#[derive(clap::Subcommand)]
pub enum Command {
    /// (a, b) of every colour, and one noise level, of raw photographs, recordings or plain dumps.
    Measure(Measure),
}

/// The variance of a raw value y (black off, white 1) is a·y + b. a and b come from each frame by itself (Foi et al. 2008),
/// the noise level by Chen et al. 2015 on the 8-bit scale, once the frame is brightened to a mean of 0.4.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow noise measure recordings/night_flight.mcap
  nightflow noise measure flight.mcap --every-s 0.2 --csv noise.csv --plot noise.svg
  nightflow noise measure dump.raw --size 768x512 --pattern rggb --black 600 --white 15520
  cargo run --release --features raw -- noise measure photo.cr2 photo.dng --json noise.json --plot noise.png

Raw photographs (CR2, DNG, ARW, RAF and more) are read by rawler, which is LGPL-2.1: only a build with `--features raw`
links it. A recording's counts are read as the settings in it declare; --config takes those of a launch file.
A plain dump holds 16-bit counts, little-endian, row by row.

Bounds hold the truth in 19 of 20 frames where the camera's noise is white and the frame has smooth parts; a misfit well
above 1 says that it does not. A negative b whose bounds reach zero is a read noise too small to be told from none.")]
pub struct Measure {
    /// Raw photographs, MCAP files or folders of rosbag2, plain dumps (.raw, .bin, .u16).
    #[arg(required = true, value_name = "RAW")]
    paths: Vec<PathBuf>,
    /// Columns and rows of plain dumps.
    #[arg(long, value_name = "WxH", value_parser = size)]
    size: Option<[usize; 2]>,
    /// Colours of a dump's first two columns and rows: rggb, bggr, gbrg, grbg, or mono.
    #[arg(long, value_parser = pattern)]
    pattern: Option<Colours>,
    /// Counts without light; overrides what a raw file or a recording says.
    #[arg(long, value_name = "COUNTS")]
    black: Option<f32>,
    /// Counts of a full pixel; overrides likewise.
    #[arg(long, value_name = "COUNTS")]
    white: Option<f32>,
    /// A launch file whose [camera] and [exposure] say how a recording's frames are read.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Of a recording, a frame every so many seconds.
    #[arg(long, value_name = "S", default_value_t = 1.0)]
    every_s: f64,
    /// A line for every plane of every frame, into this file.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Everything, the level sets too, into this file.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// a against b with darktable's profiles behind them, as .svg or .png.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
}

/// A mosaic's colours, or none.
#[derive(Debug, Clone, Copy)]
struct Colours(Option<Pattern>);

/// One frame to be measured.
pub struct Shot {
    /// File, and the second within it.
    name: String,
    /// As in the noise profiles.
    camera: Option<String>,
    iso: Option<u32>,
    mosaic: Mosaic,
}

/// Measures.
pub fn run(command: Command) -> Result<()> {
    let Command::Measure(args) = command;
    if let Some(path) = &args.plot
        && !["svg", "png"].contains(&ending(path).as_str())
    {
        bail!("--plot {}: expected a name that ends in .svg or .png", path.display());
    }
    let mut measured = Vec::new();
    let bar = ProgressBar::new_spinner().with_style(ProgressStyle::with_template("{spinner} {pos} frames  {msg}")?);
    for path in &args.paths {
        for shot in Shots::open(path, &args)? {
            let shot = shot?;
            bar.set_message(shot.name.clone());
            measured.push(measure(&shot).with_context(|| shot.name.clone())?);
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    print!("{}", report::table(&measured));
    let write = |path: &Path, text: String| {
        std::fs::write(path, text).with_context(|| format!("{} can't be written", path.display()))
    };
    if let Some(path) = &args.csv {
        write(path, report::csv(&measured))?;
    }
    if let Some(path) = &args.json {
        write(path, serde_json::to_string_pretty(&report::json(&measured))? + "\n")?;
    }
    if let Some(path) = &args.plot {
        plot::draw(path, &measured).map_err(|e| anyhow::anyhow!("{} can't be drawn: {e}", path.display()))?;
    }
    Ok(())
}

/// Mean that frames are brightened to, as the exposure stage does it.
const TARGET: f64 = 0.4;

fn measure(shot: &Shot) -> Result<Measured> {
    let planes = shot.mosaic.planes();
    let colours = planes.iter().map(|plane| {
        let clip = Clip { low: f64::from(plane.lowest), high: 1.0 };
        let fit = foi::estimate(&plane.values, plane.width, plane.height, clip);
        Ok(Colour { name: plane.name, fit: fit.with_context(|| format!("plane {}", plane.name))? })
    });
    let colours = colours.collect::<Result<Vec<_>>>()?;
    let cells = cells(&planes);
    let mean = cells.iter().flatten().map(|value| f64::from(*value)).sum::<f64>() / (3 * cells[0].len()) as f64;
    let (width, height) = (planes[0].width, planes[0].height);
    let level = noise_level_rgb(cells.each_ref().map(Vec::as_slice), width, height)?;
    let profile = match (&shot.camera, shot.iso) {
        (Some(camera), Some(iso)) => profiles::find(camera, iso).ok(),
        _ => None,
    };
    let label = [shot.camera.clone(), shot.iso.map(|iso| format!("ISO {iso}"))].into_iter().flatten();
    Ok(Measured {
        name: shot.name.clone(),
        camera: label.collect::<Vec<_>>().join(", "),
        size: [shot.mosaic.width, shot.mosaic.height],
        black: shot.mosaic.black[0],
        white: shot.mosaic.white,
        mean,
        level: 255.0 * level * TARGET / mean.max(1e-9),
        colours,
        profile,
    })
}

/// Red, the mean of both greens, blue: a cell a pixel, as the network's image begins.
fn cells(planes: &[Plane]) -> [Vec<f32>; 3] {
    match planes {
        [red, one, two, blue] => {
            let green = one.values.iter().zip(&two.values).map(|(one, two)| 0.5 * (one + two)).collect();
            [red.values.clone(), green, blue.values.clone()]
        }
        planes => std::array::from_fn(|_| planes[0].values.clone()),
    }
}

fn ending(path: &Path) -> String {
    path.extension().map(|ending| ending.to_string_lossy().to_lowercase()).unwrap_or_default()
}

fn size(text: &str) -> Result<[usize; 2], String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    sides.ok_or_else(|| format!("{text:?} is no size, expected columns and rows as in 768x512"))
}

fn pattern(text: &str) -> Result<Colours, String> {
    Ok(Colours(match text.to_lowercase().as_str() {
        "rggb" => Some(Pattern::Rggb),
        "bggr" => Some(Pattern::Bggr),
        "gbrg" => Some(Pattern::Gbrg),
        "grbg" => Some(Pattern::Grbg),
        "mono" => None,
        _ => return Err(format!("{text:?} is no pattern, expected rggb, bggr, gbrg, grbg or mono")),
    }))
}
