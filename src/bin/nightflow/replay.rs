//! `nightflow replay`: the main job on a file, and the check that a recording gives the same bytes again.

use std::path::PathBuf;

use anyhow::Result;
use nightflow::{camera, pipeline::Pipeline, publish::pictures::Pictures, recording::check::Check};

use crate::{Exit, launch, summary::Summary};

/// Turn a recording into flow and velocity.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow replay recordings/night_flight.mcap --pictures pictures
  nightflow replay bag/ --config launch_configs/replay.toml --out flow.mcap
  nightflow replay flow.mcap --check

A recording by Nightflow holds the settings it was made with, and they are used again; --config overrides them.")]
pub struct Args {
    /// An MCAP file, or a folder of rosbag2.
    bag: PathBuf,
    /// A launch file. Its [camera] source is replaced by the bag; its sinks are opened.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Write samples and results to this file.
    #[arg(long, value_name = "OUT.mcap", conflicts_with = "check")]
    out: Option<PathBuf>,
    /// Keep the recording's own pace and drop frames as a live camera would make it drop them.
    #[arg(long, conflicts_with = "check")]
    realtime: bool,
    /// Compare with the results that the recording holds, to the byte; exits with 1 at a difference.
    #[arg(long)]
    check: bool,
    /// Write pictures of the flow and a plot of the velocity into this folder.
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    /// A picture of every N-th step.
    #[arg(long, value_name = "N", default_value_t = 10, requires = "pictures")]
    pictures_every: u64,
}

/// Replays, prints the summary, and with --check the verdict.
pub fn run(args: Args) -> Result<Exit> {
    let mut config = launch::settings(args.config.as_deref(), &args.bag)?;
    config.camera.source = camera::SourceConfig::Mcap(camera::Mcap { path: args.bag.clone(), realtime: args.realtime });
    config.recording.path = args.out.clone();
    let stop = launch::stop()?;
    let mut pipeline = Pipeline::open(&config)?;
    let mut pictures = args.pictures.as_deref().map(|dir| Pictures::open(dir, args.pictures_every)).transpose()?;
    let mut check = args
        .check
        .then(|| Check::open(&args.bag, &config.publish.namespace, &config.publish.body_frame))
        .transpose()?;
    let mut outputs = launch::outputs(&config, Some(pipeline.network()))?;
    if let Some(pictures) = &mut pictures {
        outputs.sinks.push(Box::new(pictures));
    }
    if let Some(check) = &mut check {
        outputs.sinks.push(Box::new(check));
    }
    let report = launch::drive(&config, Some(&mut pipeline), &mut outputs, &stop, true)?;
    drop(outputs);
    let mut written: Vec<String> = args.out.iter().map(|path| path.display().to_string()).collect();
    if let (Some(pictures), Some(dir)) = (&pictures, &args.pictures) {
        written.push(format!("{} pictures and velocity.svg in {}", pictures.written(), dir.display()));
    }
    print!("{}", Summary { report: &report, outputs: written });
    match check.map(Check::verdict) {
        Some(Ok(checked)) => {
            println!("check         {:>7} outputs are equal to the byte, {} holes", checked.equal, checked.holes)
        }
        Some(Err(difference)) => {
            println!("check         differs: {difference}");
            return Ok(Exit::Different);
        }
        None => {}
    }
    Ok(if report.lost_anything() { Exit::DataLost } else { Exit::Done })
}
