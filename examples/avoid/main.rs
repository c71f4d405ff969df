//! Stops before what is in the way: a consumer of a node's obstacles, and a simulated flight in the dark that it saves.
//!
//! `cargo run --release --example avoid -- fly --out avoid.svg` closes the loop with the simulated course of
//! `nightflow::darkness::course`; `cargo run --example avoid -- watch nightflow` listens to a node that runs.

use std::{error::Error, path::PathBuf, time::Duration};

use clap::{Parser, Subcommand};
use nightflow::{
    clock,
    darkness::course::{self, Thing},
};

pub mod brake;
pub mod drawing;
pub mod simulation;

use brake::{Brake, Command, Obstacles, Rules};

/// Brake before obstacles that a node sees in the dark.
#[derive(Parser)]
struct Args {
    #[command(subcommand)]
    role: Role,
}

#[derive(Subcommand)]
enum Role {
    /// Listen to a running node, and say what the drone is to do whenever that changes.
    Watch {
        /// The node's `[publish.iceoryx2] prefix`.
        #[arg(default_value = "nightflow")]
        prefix: String,
        /// The drone's speed by its autopilot, m/s.
        #[arg(long, default_value_t = 3.0)]
        speed: f64,
    },
    /// Fly a simulated drone through the node's own stages towards a wall, and brake.
    Fly(Flight),
}

#[derive(clap::Args)]
struct Flight {
    /// Where the drawing goes (SVG).
    #[arg(long)]
    out: Option<PathBuf>,
    /// Mean of the raw frames, 1 = white: 0.004 is Exp-4 of the paper's ladder.
    #[arg(long, default_value_t = 0.004)]
    mean: f64,
    /// Metres to the wall.
    #[arg(long, default_value_t = 15.0)]
    wall: f64,
    /// How wide the wall is, metres.
    #[arg(long, default_value_t = 4.0)]
    width: f64,
    /// Fly without the wall.
    #[arg(long)]
    open: bool,
    /// Metres to the row of houses at the end: behind open land a bare night sky would show nothing to see by.
    #[arg(long, default_value_t = 80.0)]
    houses: f64,
    /// m/s.
    #[arg(long, default_value_t = 3.0)]
    speed: f64,
    /// Columns of the camera; its rows are three quarters of that.
    #[arg(long, default_value_t = 640)]
    columns: usize,
    /// Frames a second.
    #[arg(long, default_value_t = 15.0)]
    fps: f64,
    /// As in `[flow]`.
    #[arg(long, default_value = "pwcnet_fcdn")]
    network: String,
    /// Longest duration.
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
    /// Draws surfaces, sway and noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print every step.
    #[arg(long)]
    steps: bool,
}

fn main() -> Result<(), Box<dyn Error>> {
    match Args::parse().role {
        Role::Watch { prefix, speed } => watch(&prefix, speed),
        Role::Fly(flight) => fly(&flight),
    }
}

/// Says what the drone is to do; here an autopilot would be told.
fn watch(prefix: &str, speed: f64) -> Result<(), Box<dyn Error>> {
    let (obstacles, mut brake) = (Obstacles::open(prefix)?, Brake::new(Rules::default()));
    let (mut newest, mut said) = (None, String::new());
    loop {
        // A node that says nothing must not keep the drone going: the timeout is a step too.
        obstacles.wait(Duration::from_millis(100))?;
        newest = obstacles.newest()?.or(newest);
        // The speed should come from the autopilot with every step: the node's own counts on level ground before it.
        let judged = brake.judge(newest.as_ref(), clock::now(), speed);
        let now = match judged.command {
            Command::Go => "go".to_owned(),
            Command::Walk => "walk: too little is seen".to_owned(),
            Command::Stop(left) if left.is_nan() => "stop: nothing is seen".to_owned(),
            Command::Stop(left) => format!("stop: contact in {left:.1} s"),
        };
        if now != said {
            println!("{now}");
            said = now;
        }
    }
}

fn fly(flight: &Flight) -> Result<(), Box<dyn Error>> {
    let houses = Thing::wall(flight.houses);
    let wall = Thing::wall(flight.wall).wide(flight.width);
    let course = course::Settings {
        seed: flight.seed,
        size: [flight.columns, flight.columns * 3 / 4],
        fps: flight.fps,
        speed: flight.speed,
        mean: flight.mean,
        things: if flight.open { vec![houses] } else { vec![houses, wall] },
        ..course::Settings::default()
    };
    let settings = simulation::Settings {
        course,
        rules: Rules::default(),
        network: flight.network.clone(),
        seconds: flight.seconds,
    };
    let flown = simulation::fly(&settings)?;
    if flight.steps {
        println!("     s   left m  m/s   true s  said s  known  command");
        for step in &flown.steps {
            let or = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.2}"));
            let (left, truth, said) = (or(step.left_m), or(step.true_s), or(step.said_s));
            println!(
                "{:6.2} {left:>8} {:5.2} {truth:>7} {said:>7} {:6.2}  {:?}",
                step.seconds, step.speed, step.known_part, step.command
            );
        }
    }
    match flown.end() {
        Some((speed, Some(left))) => {
            println!("at the end {speed:.2} m/s, {left:.2} m before what is ahead, slowest {:.2} m/s", flown.slowest())
        }
        Some((speed, None)) => println!("at the end {speed:.2} m/s, slowest {:.2} m/s", flown.slowest()),
        None => println!("nothing was flown"),
    }
    if let Some(out) = &flight.out {
        drawing::draw(out, &settings, &flown)?;
        println!("{}", out.display());
    }
    Ok(())
}
