//! The door: parses the command line and hands over to one file a subcommand.
#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used))]

mod bench;
mod config;
mod doctor;
mod eval;
mod launch;
mod noise;
mod record;
mod replay;
mod run;
mod show;
mod summary;
mod synth;
mod synth_fcdn;
mod synth_scenes;
mod watch;

use std::process::ExitCode;

use clap::{ArgAction, Parser, Subcommand};
use nightflow::{
    camera,
    config::Error as ConfigError,
    darkness::{fcdn, flow_files, scenes},
    node,
};

const EXAMPLES: &str = "\
Examples:
  nightflow replay recordings/night_flight.mcap --pictures pictures
  nightflow run --config launch_configs/ros2.toml
  nightflow watch
  nightflow doctor

Exit codes: 0 done; 1 our failure; 2 a mistake in what was asked; 3 done, but data was lost.";

/// Dense optical flow and velocity at night, from raw Bayer frames.
#[derive(Parser)]
#[command(name = "nightflow", version, after_help = EXAMPLES, subcommand_required = true, arg_required_else_help = true)]
struct Door {
    /// Say more: -v what happens, -vv everything. RUST_LOG sets it by target, as in `nightflow::camera=debug`.
    #[arg(short, long, global = true, action = ArgAction::Count)]
    verbose: u8,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Turn a recording into flow and velocity; check a recording's own results to the byte.
    Replay(replay::Args),
    /// Run the live node.
    Run(run::Args),
    /// Keep a source's samples in an MCAP file; no network runs.
    Record(record::Args),
    /// Time the networks on this machine, beside rivals and beside what its processor can do.
    Bench(bench::Args),
    /// Look at a running node from outside, through its shared memory.
    Watch(watch::Args),
    /// Say whether this machine is ready: runtime, model, memory, sockets, camera.
    Doctor(doctor::Args),
    /// Print the effective configuration with the reason of every value.
    Config(config::Args),
    /// Lay frames, flow, confidence and error of a flow file or a recording side by side, on one page.
    Show(show::Args),
    /// Make recordings with known truth, and data sets for the dark.
    /// Judge methods on data sets with true flow, by exposure; climb down the brightness ladder.
    Eval(Box<eval::Args>),
    /// Measure a camera's noise on its raw frames.
    #[command(subcommand)]
    Noise(noise::Command),
    /// Make recordings with known truth.
    #[command(subcommand)]
    Synth(synth::Command),
}

/// How a subcommand ends when it ends well.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exit {
    /// Everything was done.
    Done,
    /// It was done, but something that came in or went out was lost.
    DataLost,
    /// A comparison found a difference.
    Different,
}

fn main() -> ExitCode {
    let door = Door::parse();
    speak(door.verbose);
    let ended = match door.command {
        Command::Replay(args) => replay::run(args),
        Command::Run(args) => run::run(args),
        Command::Record(args) => record::run(args),
        Command::Bench(args) => bench::run(&args),
        Command::Watch(args) => watch::run(args).map(|()| Exit::Done),
        Command::Doctor(args) => doctor::run(args),
        Command::Config(args) => config::run(args),
        Command::Show(args) => show::run(&args).map(|()| Exit::Done),
        Command::Eval(args) => eval::run(*args),
        Command::Noise(command) => noise::run(command).map(|()| Exit::Done),
        Command::Synth(command) => synth::run(command).map(|()| Exit::Done),
    };
    match ended {
        Ok(Exit::Done) => ExitCode::SUCCESS,
        Ok(Exit::Different) => ExitCode::from(1),
        Ok(Exit::DataLost) => ExitCode::from(3),
        Err(error) => {
            eprintln!("nightflow: {error:#}");
            ExitCode::from(if users_mistake(&error) { 2 } else { 1 })
        }
    }
}

/// A file that isn't there or a setting that makes no sense is for the user to mend.
fn users_mistake(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause.is::<ConfigError>()
            || cause.is::<bench::Mistake>()
            || matches!(
                cause.downcast_ref(),
                Some(flow_files::Error::Content { .. } | flow_files::Error::Ending { .. })
            )
            || matches!(cause.downcast_ref(), Some(camera::Error::Settings(_)))
            || cause.is::<scenes::Error>()
            || cause.downcast_ref::<fcdn::Error>().is_some_and(fcdn::Error::mistaken)
            || matches!(cause.downcast_ref(), Some(node::Error::Camera(camera::Error::Settings(_))))
            || cause
                .downcast_ref::<std::io::Error>()
                .is_some_and(|io| matches!(io.kind(), std::io::ErrorKind::NotFound | std::io::ErrorKind::IsADirectory))
    })
}

/// Log lines go to standard error: warnings always, more when asked.
fn speak(verbose: u8) {
    let own = ["warn", "info", "debug"][usize::from(verbose.min(2))];
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(format!("error,nightflow={own}")));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_target(true).init();
}
