//! The avoidance example: its rules on made samples, and its closed loop with the real network in the dark.

use nightflow::{
    clock::Stamp,
    darkness::{
        course::{self, Thing},
        ladder::MEANS,
    },
    motion::SECTORS,
    publish::{Moved, shared::ObstaclesSample},
};

use super::recording::moved;

// Its `main` and its drawing are not used here.
#[allow(dead_code)]
#[path = "../../examples/avoid/main.rs"]
mod example;

use example::{
    brake::{Brake, Command, Rules},
    simulation::{self, Flown},
};

const SECOND_NS: i64 = 1_000_000_000;

/// A sample at so many seconds in which every sector is what `sector` says: kind, seconds to contact, confidence.
fn sample(at: f64, sector: impl Fn(usize) -> (u8, f32, f32)) -> ObstaclesSample {
    let moved: Moved = moved(0, nightflow::flow::State::Ok);
    let mut sample = ObstaclesSample::from(&moved);
    (sample.newer_ns, sample.valid, sample.heading) = ((at * SECOND_NS as f64) as i64, 1, [1.0, 0.0, 0.0]);
    for k in 0..SECTORS {
        (sample.sector[k], sample.ttc_s[k], sample.confidence[k]) = sector(k);
    }
    sample
}

fn at(seconds: f64) -> Stamp {
    Stamp((seconds * SECOND_NS as f64) as i64)
}

#[test]
fn it_stops_for_what_is_near_ahead_and_sure() {
    // At 3 m/s and 3 m/s² braking takes half a second of flight, and a second is the margin.
    let judge = |sector: &dyn Fn(usize) -> (u8, f32, f32), late: f64| {
        let mut brake = Brake::new(Rules::default());
        brake.judge(Some(&sample(10.0, sector)), at(10.0 + late), 3.0).command
    };
    let ahead =
        |ttc: f32, confidence: f32| move |k: usize| if k == 38 { (2, ttc, confidence) } else { (1, f32::NAN, 0.95) };
    assert!(matches!(judge(&ahead(1.4, 0.95), 0.0), Command::Stop(left) if (left - 1.4).abs() < 1e-6));
    assert_eq!(judge(&ahead(1.6, 0.95), 0.0), Command::Go, "there is time left");
    assert!(matches!(judge(&ahead(1.6, 0.95), 0.2), Command::Stop(_)), "the frame is 0.2 s old");
    assert_eq!(judge(&ahead(1.4, 0.8), 0.0), Command::Go, "not sure");
    let beside = |k: usize| if k == 41 { (2, 0.5, 0.95) } else { (1, f32::NAN, 0.95) };
    assert_eq!(judge(&beside, 0.0), Command::Go, "25° to the left is not ahead");
    let mut brake = Brake::new(Rules::default());
    let mut turned = sample(10.0, beside);
    turned.heading = [0.9, 0.43, 0.0];
    assert!(matches!(brake.judge(Some(&turned), at(10.0), 3.0).command, Command::Stop(_)), "it flies to the left");
    let free = sample(10.1, |_| (1, f32::NAN, 0.95));
    assert!(
        matches!(brake.judge(Some(&free), at(10.1), 0.1).command, Command::Stop(_)),
        "going on is not its decision"
    );
}

#[test]
fn what_is_not_seen_is_not_free() {
    let mut brake = Brake::new(Rules::default());
    let mut judge = |t: f64, unknown: usize| {
        let kind = |k: usize| if k < unknown { (0, f32::NAN, 0.0) } else { (1, f32::NAN, 0.95) };
        brake.judge(Some(&sample(t, kind)), at(t), 3.0).command
    };
    assert_eq!(judge(1.0, 0), Command::Go);
    assert_eq!(judge(1.6, SECTORS), Command::Go, "a moment without sight is none");
    assert_eq!(judge(2.2, SECTORS), Command::Walk);
    assert_eq!(judge(2.3, 38), Command::Go, "three of nine are free again");
    assert_eq!(judge(3.4, 39), Command::Walk, "two of nine are too few");
    assert!(matches!(judge(5.4, SECTORS), Command::Stop(left) if left.is_nan()));
    // A node that fell silent, and one that never spoke.
    let mut brake = Brake::new(Rules::default());
    let last = sample(1.0, |_| (1, f32::NAN, 0.95));
    let commands = [1.1, 2.2, 4.2].map(|t| brake.judge(Some(&last), at(t), 3.0).command);
    assert!(matches!(commands, [Command::Go, Command::Walk, Command::Stop(_)]), "{commands:?}");
    let mut brake = Brake::new(Rules::default());
    let commands = [1.0, 2.2, 4.2].map(|t| brake.judge(None, at(t), 3.0).command);
    assert!(matches!(commands, [Command::Go, Command::Walk, Command::Stop(_)]), "{commands:?}");
}

#[test]
fn braking_ends_at_the_speed_that_was_asked_for() {
    let brake = Brake::new(Rules::default());
    assert_eq!(brake.acceleration(Command::Go, 3.0, 0.1), 0.0);
    assert_eq!(brake.acceleration(Command::Stop(1.0), 3.0, 0.1), -3.0);
    assert!((brake.acceleration(Command::Stop(1.0), 0.1, 0.1) + 1.0).abs() < 1e-9);
    assert!((brake.acceleration(Command::Walk, 1.1, 0.1) + 1.0).abs() < 1e-9);
    assert_eq!(brake.acceleration(Command::Walk, 0.5, 0.1), 0.0);
}

/// At 3 m/s, at Exp-4, with houses 80 m ahead and perhaps more.
fn fly(things: &[Thing], seconds: f64) -> Flown {
    let course = course::Settings {
        size: [480, 360],
        mean: MEANS[4],
        things: [&[Thing::wall(80.0)], things].concat(),
        ..course::Settings::default()
    };
    let settings = simulation::Settings { course, rules: Rules::default(), network: "pwcnet_fcdn".into(), seconds };
    simulation::fly(&settings).unwrap()
}

#[test]
fn a_drone_stops_before_a_wall_in_the_dark_and_for_nothing_else() {
    let flown = fly(&[Thing::wall(9.0).wide(6.0)], 5.0);
    let (speed, left) = flown.end().unwrap();
    let told = flown.steps.iter().find(|step| matches!(step.command, Command::Stop(_))).unwrap();
    println!("{speed:.2} m/s at the end, {left:?} m before the wall; {told:?}");
    assert!(speed < 0.01, "{speed} m/s at the end");
    // Half a second of flight is for braking, one is margin, of which 0.13 s go by until the drone obeys.
    let left = left.unwrap();
    assert!((2.0..4.5).contains(&left), "it stopped {left:.2} m before the wall");
    assert!(matches!(told.command, Command::Stop(left) if left < 1.5), "it stopped for what it saw: {told:?}");
    assert!(flown.still.is_some());

    let open = fly(&[], 1.5);
    assert!(open.steps.len() >= 22 && open.steps.iter().all(|step| step.command == Command::Go), "{:?}", open.steps);
    assert!(open.slowest() > 2.99, "it slowed down to {} m/s for nothing", open.slowest());
}
