//! `nightflow config`: the effective configuration, every value with its reason.

use std::path::PathBuf;

use anyhow::Result;

use crate::{Exit, launch};

/// Print the whole configuration; what it prints is itself a valid launch file.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow config
  nightflow config --config launch_configs/ros2.toml > whole.toml")]
pub struct Args {
    /// The launch file; without one the default is shown.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Prints to standard output.
pub fn run(args: Args) -> Result<Exit> {
    print!("{}", launch::read(args.config.as_deref())?.explained()?);
    Ok(Exit::Done)
}
