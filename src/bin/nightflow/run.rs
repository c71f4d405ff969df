//! `nightflow run`: the live node, any source with any sinks.

use std::path::PathBuf;

use anyhow::Result;
use nightflow::pipeline::Pipeline;

use crate::{Exit, launch, summary::Summary};

/// Run the live node until it is interrupted or its source ends.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow run --config launch_configs/ros2.toml
  nightflow run --config launch_configs/zenoh.toml -v

`nightflow config --config FILE` shows what a launch file amounts to; `nightflow watch` looks at the running node.")]
pub struct Args {
    /// The launch file; it holds only what differs from the default.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
}

/// Opens the network first, so that nothing is announced before flow can follow.
pub fn run(args: Args) -> Result<Exit> {
    let config = launch::read(Some(&args.config))?;
    let stop = launch::stop()?;
    let mut pipeline = Pipeline::open(&config)?;
    let mut outputs = launch::outputs(&config, Some(pipeline.network()))?;
    let report = launch::drive(&config, Some(&mut pipeline), &mut outputs, &stop, false)?;
    let kept = config.recording.path.map(|path| path.display().to_string());
    print!("{}", Summary { report: &report, outputs: kept.into_iter().collect() });
    Ok(if report.lost_anything() { Exit::DataLost } else { Exit::Done })
}
