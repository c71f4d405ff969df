//! `nightflow record`: a source's samples into an MCAP file, without the network.

use std::path::PathBuf;

use anyhow::{Result, bail};
use nightflow::{camera, node::Outputs};

use crate::{Exit, launch, summary::Summary};

/// Keep what a source gives until it ends or is interrupted.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow record --config launch_configs/ros2.toml --out night.mcap
  nightflow replay night.mcap --pictures pictures")]
pub struct Args {
    /// The launch file that names the source.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// The file to write; overrides [recording] path.
    #[arg(long, value_name = "OUT.mcap")]
    out: Option<PathBuf>,
}

/// Records frames, calibration, gyro and range as they come.
pub fn run(args: Args) -> Result<Exit> {
    let mut config = launch::read(Some(&args.config))?;
    config.recording.path = args.out.or(config.recording.path);
    let Some(path) = config.recording.path.clone() else {
        bail!(camera::Error::Settings("no file to write: give --out OUT.mcap or [recording] path".into()))
    };
    let stop = launch::stop()?;
    let mut outputs = Outputs::default();
    if let Some(recorder) = launch::recorder(&config, None)? {
        outputs.sinks.push(Box::new(recorder));
    }
    let report = launch::drive(&config, None, &mut outputs, &stop, false)?;
    print!("{}", Summary { report: &report, outputs: vec![path.display().to_string()] });
    Ok(if report.lost_anything() { Exit::DataLost } else { Exit::Done })
}
