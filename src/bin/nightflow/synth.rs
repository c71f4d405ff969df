//! `nightflow synth`: recordings with known truth, flown by a simulation or cut from a real raw photograph.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail};
use indicatif::{ProgressBar, ProgressStyle};
use nightflow::{
    camera::Sample,
    clock::Stamp,
    darkness::{
        flight::{self, Flight, Settings, Truth},
        pan::{self, Pan, Photograph},
        photographs::{self, RawPhotograph},
        profiles,
    },
    recording::{Compression, Config, Writer},
    wire::{Header, Image, Twist, TwistStamped, Vector3, Vector3Stamped},
};

/// Pan frames begin here; a fixed stamp, so that the same command gives the same bytes.
const PAN_BEGIN_NS: i64 = 1_700_000_000_000_000_000;

/// Make a recording whose truth is known, or a data set.
#[derive(clap::Subcommand)]
pub enum Command {
    /// Fly over a textured ground from dusk into the dark.
    Flight(FlightArgs),
    /// Pan over a real raw photograph so that consecutive frames carry independent real noise.
    Pan(PanArgs),
    /// Turn clean pairs (FlyingChairs) into dark ones (FCDN).
    Fcdn(crate::synth_fcdn::Args),
    /// Draw pairs with exact flow: photographs, cut-outs and shapes that fly, as in FlyingChairs or under a drone.
    Scenes(crate::synth_scenes::Args),
}

/// A drone flies over a textured plane with standing obstacles; frames, gyro, range, true flow and true velocity.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow synth flight --out flight.mcap
  nightflow synth flight --out fast.mcap --speed 8 --height 12 --seconds 10
  nightflow synth flight --out darker.mcap --from-mean 0.01 --to-mean 0.001 --camera 'Sony ILCE-6000' --iso 1600
  nightflow replay flight.mcap --pictures pictures")]
pub struct FlightArgs {
    /// The recording to write.
    #[arg(long, value_name = "OUT.mcap")]
    out: PathBuf,
    /// Length of the flight.
    #[arg(long, default_value_t = 4.0)]
    seconds: f64,
    /// The same seed gives the same bytes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Mean speed, m/s.
    #[arg(long, default_value_t = 2.0)]
    speed: f64,
    /// Mean height, metres.
    #[arg(long, default_value_t = 5.0)]
    height: f64,
    /// Raw mean of the first frame, 1 = white.
    #[arg(long, default_value_t = 0.1)]
    from_mean: f64,
    /// Raw mean of the last frame.
    #[arg(long, default_value_t = 0.004)]
    to_mean: f64,
    /// The camera whose measured noise is drawn.
    #[arg(long, default_value = "Canon EOS M6")]
    camera: String,
    /// Its sensitivity.
    #[arg(long, default_value_t = 3200)]
    iso: u32,
    /// Columns and rows, multiples of 8.
    #[arg(long, default_value = "640x480", value_parser = size)]
    size: [usize; 2],
    /// Frames a second.
    #[arg(long, default_value_t = 30.0)]
    fps: f64,
}

/// A window moves over a raw photograph; the second half is attenuated and noised further.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  cargo run --release --features raw -- synth pan canon30d_iso640.cr2 --out pan.mcap")]
pub struct PanArgs {
    /// The photograph: CR2, DNG, ARW or whatever else rawler reads, with a Bayer mosaic.
    raw: PathBuf,
    /// The recording to write.
    #[arg(long, value_name = "OUT.mcap")]
    out: PathBuf,
    /// How many frames; the second half is dark.
    #[arg(long, default_value_t = 60)]
    frames: usize,
    /// Columns and rows, even.
    #[arg(long, default_value = "640x480", value_parser = size)]
    size: [usize; 2],
    /// Frames a second.
    #[arg(long, default_value_t = 30.0)]
    fps: f64,
    /// Middle of the path, as parts of the photograph's width and height.
    #[arg(long, num_args = 2, default_values_t = [0.5, 0.6])]
    centre: Vec<f64>,
    /// Half the way across, in frame pixels.
    #[arg(long, num_args = 2, default_values_t = [60.0, 30.0])]
    sweep: Vec<f64>,
    /// Raw mean that the second half falls to, 1 = white.
    #[arg(long, default_value_t = 0.004)]
    dark_mean: f64,
    /// The camera that took it, as in the noise profiles.
    #[arg(long, default_value = "Canon EOS 30D")]
    camera: String,
    /// The sensitivity that it was taken at.
    #[arg(long, default_value_t = 640)]
    iso: u32,
    /// The same seed gives the same bytes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Makes the recording or the set.
pub fn run(command: Command) -> Result<()> {
    match command {
        Command::Flight(args) => fly(&args),
        Command::Pan(args) => sweep(&args),
        Command::Fcdn(args) => crate::synth_fcdn::run(&args),
        Command::Scenes(args) => crate::synth_scenes::run(&args),
    }
}

fn fly(args: &FlightArgs) -> Result<()> {
    let flight = Flight::new(Settings {
        seed: args.seed,
        seconds: args.seconds,
        speed: args.speed,
        height: args.height,
        mean: [args.from_mean, args.to_mean],
        size: args.size,
        fps: args.fps,
        noise: Some(profiles::find(&args.camera, args.iso)?),
    })?;
    let bar = progress(flight.frames())?;
    let mut out = create(&args.out)?;
    let made = format!("nightflow synth flight, noise of {} at ISO {}, seed {}", args.camera, args.iso, args.seed);
    provenance(&mut out, made, f64::from(flight::BLACK), f64::from(flight::WHITE))?;
    for shot in flight {
        for sample in &shot.samples {
            keep(&mut out, sample)?;
        }
        keep_truth(&mut out, &shot.truth)?;
        bar.inc(1);
    }
    finish(out, &bar)
}

fn keep(out: &mut Writer, sample: &Sample) -> Result<()> {
    let stamp = sample.stamp();
    match sample {
        Sample::Frame(frame) => out.write("/camera/image_raw", stamp, stamp, &frame.image)?,
        Sample::Info(info) => out.write("/camera/camera_info", stamp, stamp, info.as_ref())?,
        Sample::Imu(imu) => out.write("/imu/data_raw", stamp, stamp, imu.as_ref())?,
        Sample::Range(range) => out.write("/range", stamp, stamp, range.as_ref())?,
        Sample::Width(width) => out.write("/nightflow/width", stamp, stamp, width.as_ref())?,
        Sample::Transforms(message) => out.write("/tf_static", stamp, stamp, message.as_ref())?,
    }
    Ok(())
}

fn keep_truth(out: &mut Writer, truth: &Truth) -> Result<()> {
    let vector = |[x, y, z]: [f64; 3]| Vector3 { x, y, z };
    let stamp = truth.stamp;
    let velocity = TwistStamped {
        header: header(stamp, flight::BODY_FRAME),
        twist: Twist { linear: vector(truth.velocity), angular: vector(truth.rates) },
    };
    out.write("/truth/velocity", stamp, stamp, &velocity)?;
    if let Some(flow) = &truth.flow {
        let image = Image {
            header: header(stamp, flight::OPTICAL_FRAME),
            height: flow.grid.height as u32,
            width: flow.grid.width as u32,
            encoding: "32FC2".into(),
            is_bigendian: 0,
            step: flow.grid.width as u32 * 8,
            data: flow.vectors.iter().flat_map(|value| value.to_le_bytes()).collect(),
        };
        out.write("/truth/flow", stamp, stamp, &image)?;
    }
    Ok(())
}

fn sweep(args: &PanArgs) -> Result<()> {
    let photograph = read(&args.raw)?;
    let (black, white) = (photograph.black, photograph.white);
    let pair = |values: &[f64]| [values[0], values[1]];
    let settings = pan::Settings {
        seed: args.seed,
        size: args.size,
        frames: args.frames,
        centre: pair(&args.centre),
        sweep: pair(&args.sweep),
        dark_mean: args.dark_mean,
        noise: profiles::find(&args.camera, args.iso)?,
    };
    let views = Pan::new(photograph, settings)?;
    let bar = progress(args.frames as u64)?;
    let mut out = create(&args.out)?;
    let made = format!(
        "nightflow synth pan of a {} raw at ISO {}, mean {:.4} as shot and {} in the second half, seed {}",
        args.camera,
        args.iso,
        views.mean(),
        args.dark_mean,
        args.seed
    );
    provenance(&mut out, made, black, white)?;
    for (index, view) in views.enumerate() {
        let stamp = Stamp(PAN_BEGIN_NS + (index as f64 / args.fps * 1e9).round() as i64);
        let image = Image {
            header: header(stamp, flight::OPTICAL_FRAME),
            height: args.size[1] as u32,
            width: args.size[0] as u32,
            encoding: "bayer_rggb16".into(),
            is_bigendian: 0,
            step: args.size[0] as u32 * 2,
            data: view.counts.iter().flat_map(|count| count.to_le_bytes()).collect(),
        };
        out.write("/camera/image_raw", stamp, stamp, &image)?;
        if let Some([x, y]) = view.pan {
            let header = header(stamp, flight::OPTICAL_FRAME);
            out.write("/truth/pan", stamp, stamp, &Vector3Stamped { header, vector: Vector3 { x, y, z: 0.0 } })?;
        }
        bar.inc(1);
    }
    finish(out, &bar)
}

/// The photograph's active area, from its first red pixel on.
fn read(path: &Path) -> Result<Photograph> {
    let RawPhotograph { width: wide, height: high, counts: all, black, white, colours, camera, .. } =
        photographs::read(path)?;
    // Where the cell of the first pixel has its red; a larger pattern is no Bayer mosaic.
    let Some(red) = (0..4).find(|red| colours.len() == 4 && colours[*red] == 0 && colours[3 - red] == 2) else {
        bail!("{}: expected a Bayer mosaic of red, green, green, blue", path.display())
    };
    let (dx, dy) = (red % 2, red / 2);
    let (width, height) = ((wide - dx) / 2 * 2, (high - dy) / 2 * 2);
    let counts: Vec<u16> = (dy..dy + height).flat_map(|row| all[row * wide + dx..][..width].iter().copied()).collect();
    let (black, white) = (black.iter().map(|level| f64::from(*level)).sum::<f64>() / 4.0, f64::from(white));
    eprintln!("{camera}: {width}×{height}, black {black}, white {white}");
    Ok(Photograph { width, height, counts, black: black.round(), white })
}

fn header(stamp: Stamp, frame_id: &str) -> Header {
    Header { stamp: stamp.into(), frame_id: frame_id.into() }
}

fn create(path: &Path) -> Result<Writer> {
    let config = Config { compression: Compression::Zstd, ..Config::default() };
    Writer::create(path, &config).with_context(|| format!("{} can't be written", path.display()))
}

/// What a replay needs to know to read the counts, and how they came to be.
fn provenance(out: &mut Writer, made: String, black: f64, white: f64) -> Result<()> {
    let config = format!("[exposure]\nbit_depth = 12\nblack_level = {black:.1}\nwhite_level = {white:.1}\n");
    let known = BTreeMap::from([
        ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("config".to_owned(), config),
        ("made_by".to_owned(), made),
    ]);
    Ok(out.attach_metadata("nightflow", &known)?)
}

fn progress(frames: u64) -> Result<ProgressBar> {
    let style = ProgressStyle::with_template("{bar:40} {pos} of {len} frames, {eta} left")?;
    Ok(ProgressBar::new(frames).with_style(style))
}

fn finish(out: Writer, bar: &ProgressBar) -> Result<()> {
    let path = out.path().to_owned();
    out.finish()?;
    bar.finish_and_clear();
    let bytes = std::fs::metadata(&path)?.len();
    println!("{}: {:.1} MB", path.display(), bytes as f64 / 1e6);
    Ok(())
}

pub fn size(text: &str) -> Result<[usize; 2], String> {
    let wrong = || format!("{text:?} is no size; expected columns x rows, as in 640x480");
    let (columns, rows) = text.split_once('x').ok_or_else(wrong)?;
    Ok([columns.parse().map_err(|_| wrong())?, rows.parse().map_err(|_| wrong())?])
}
