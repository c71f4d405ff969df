//! What autopilots are told of obstacles: each direction at its own place, and never free where nothing was seen.

use std::time::{Duration, Instant};

use nightflow::{
    clock::Stamp,
    flow::{Cause, State},
    motion::{Lack, NoSight, Obstacles, SECTORS, Sector},
    publish::{
        Moved, Sink,
        autopilot::{
            Autopilot, Link, Mavlink, Px4, Word, mavlink,
            px4::{self, Topic},
        },
    },
};
use serde_json::Value;

use super::{
    LONG, autopilot,
    moves::{STEP_NS, fly, moved},
    next, number, offer,
};
use crate::{peers, ros2};

const UNKNOWN: u64 = 65_535;
/// m/s, at which 8 s reach as far as anything is told.
const SPEED: f64 = 3.0;
const OFFSET_US: i64 = 5_000_000;

fn at(distance_m: f64) -> Sector {
    Sector::Occupied { ttc_s: 2.0, distance_m, confidence: 0.95, whole: true }
}

/// A step that sees this at these degrees to the left, and nothing beside it.
fn seen(step: u64, sights: &[(i64, Sector)]) -> Moved {
    let older = Stamp(1_000_000_000_123 + step as i64 * STEP_NS);
    let mut moved = moved(step, older, &fly(1.0, 0.0, 0.0), false);
    let mut sectors = [Sector::Unknown; SECTORS];
    for (left_deg, sector) in sights {
        sectors[((left_deg + 180) / 5) as usize] = *sector;
    }
    moved.obstacles = Ok(Obstacles {
        older: moved.older,
        newer: moved.newer,
        sectors,
        heading: [1.0, 0.0, 0.0],
        heading_sd_rad: 0.01,
        speed: Some(SPEED),
        horizon_s: 8.0,
        delay_s: 0.15,
    });
    moved
}

/// What was sent, and what is to be told of it by index, clockwise from the front; everything else is unknown.
type Case = (&'static str, Moved, Vec<(usize, u64)>);

/// `paired`: every second distance speaks for its neighbours too, as PX4 needs it.
fn cases(paired: bool) -> Vec<Case> {
    let free = Sector::Free { confidence: 0.95 };
    let told = |ours: &[(usize, u64)], px4s: &[(usize, u64)]| if paired { px4s.to_vec() } else { ours.to_vec() };
    let stepless = |sights: &[(i64, Sector)]| seen(0, sights);
    let mut cases = vec![
        ("ahead", stepless(&[(0, at(6.0))]), told(&[(0, 600)], &[(0, 600)])),
        ("left of ahead", stepless(&[(5, at(6.0))]), told(&[(71, 600)], &[(70, 600), (71, 600), (0, 600)])),
        ("right of ahead", stepless(&[(-5, at(6.0))]), told(&[(1, 600)], &[(0, 600), (1, 600), (2, 600)])),
        ("left", stepless(&[(90, at(2.5))]), told(&[(54, 250)], &[(54, 250)])),
        ("right", stepless(&[(-90, at(2.5))]), told(&[(18, 250)], &[(18, 250)])),
        ("back", stepless(&[(-180, at(14.99))]), told(&[(36, 1499)], &[(36, 1499)])),
        ("nearer than can be told", stepless(&[(0, at(0.05))]), told(&[(0, 21)], &[(0, 21)])),
        ("no distance", stepless(&[(0, at(f64::NAN))]), vec![]),
        // Alone it is not free for PX4, for what it speaks for is unknown.
        ("beyond what is told", stepless(&[(0, at(20.0))]), told(&[(0, 1501)], &[])),
        ("free alone", stepless(&[(0, free)]), told(&[(0, 1501)], &[])),
        (
            "free on both sides too",
            stepless(&[(5, free), (0, free), (-5, free)]),
            told(&[(71, 1501), (0, 1501), (1, 1501)], &[(71, 1501), (0, 1501), (1, 1501)]),
        ),
        ("nothing is seen", stepless(&[]), vec![]),
    ];
    let all = || stepless(&(0..SECTORS as i64).map(|k| (5 * k - 180, free)).collect::<Vec<_>>());
    cases.push(("free all around", all(), (0..SECTORS).map(|j| (j, 1501)).collect()));
    let mut slow = all();
    slow.obstacles = slow.obstacles.map(|found| Obstacles { speed: Some(1.0), ..found });
    cases.push(("free, but only up to 8 m", slow, vec![]));
    let mut unscaled = all();
    unscaled.obstacles = unscaled.obstacles.map(|found| Obstacles { speed: None, ..found });
    cases.push(("times without a speed", unscaled, vec![]));
    cases.push(("no gyro", Moved { obstacles: Err(NoSight::Lack(Lack::Gyro)), ..all() }, vec![]));
    cases.push(("blind", Moved { state: State::Blind(Cause::Frozen), ..all() }, vec![]));
    for (step, case) in cases.iter_mut().enumerate() {
        let stamps = seen(step as u64, &[]);
        (case.1.step, case.1.older, case.1.newer) = (stamps.step, stamps.older, stamps.newer);
    }
    cases
}

fn judge(name: &str, message: &Value, wanted: &[(usize, u64)]) {
    let found: Vec<u64> = message["distances"].as_array().unwrap().iter().map(|cm| cm.as_u64().unwrap()).collect();
    let mut all = vec![UNKNOWN; SECTORS];
    wanted.iter().for_each(|(j, cm)| all[*j] = *cm);
    assert_eq!(found, all, "{name}");
    // MAV_FRAME_BODY_FRD, MAV_DISTANCE_SENSOR_UNKNOWN.
    assert_eq!((number(message, "frame"), number(message, "sensor_type")), (12.0, 4.0), "{name}");
    assert_eq!((number(message, "min_distance"), number(message, "max_distance")), (20.0, 1500.0), "{name}");
    assert_eq!((number(message, "increment"), number(message, "angle_offset")), (5.0, 0.0), "{name}");
}

#[test]
fn obstacles_reach_both_autopilots_over_mavlink() {
    for kind in [Autopilot::Px4, Autopilot::Ardupilot] {
        let (mut peer, place) = autopilot("udp");
        let settings = Mavlink {
            autopilot: kind,
            words: vec![Word::Obstacles],
            obstacles_hz: 0.0,
            time_offset_us: OFFSET_US,
            link: Link::Udp(place),
            ..Mavlink::default()
        };
        let mut sink = mavlink::open(&settings).unwrap();
        for (name, moved, wanted) in cases(kind == Autopilot::Px4) {
            offer(&mut sink, &moved);
            let message = next(&mut peer, "OBSTACLE_DISTANCE");
            judge(name, &message, &wanted);
            assert_eq!(message["time_usec"].as_i64().unwrap(), moved.newer.0 / 1000 + OFFSET_US, "{name}");
            assert_eq!(number(&message, "increment_f"), 5.0, "{name}");
            assert!(number(&message, "bytes") <= 179.0, "{message}");
        }
        sink.finish().unwrap();
        assert_eq!(sink.lost(), 0);
        peer.finish(LONG);
    }
}

#[test]
fn obstacles_come_at_their_own_pace_and_not_at_all_where_nobody_looks() {
    let (mut peer, place) = autopilot("udp");
    let settings = Mavlink { words: vec![Word::Flow, Word::Obstacles], link: Link::Udp(place), ..Mavlink::default() };
    let mut sink = mavlink::open(&settings).unwrap();
    let mut heard = Vec::new();
    for step in 0..36 {
        let mut moved = seen(step, &[(0, at(6.0))]);
        if step < 6 {
            moved.obstacles = Err(NoSight::Off);
        }
        offer(&mut sink, &moved);
        // The flow of a step goes before its obstacles: what came since belongs to earlier steps.
        loop {
            let message: Value = serde_json::from_str(&peer.line_starting("{", LONG)).unwrap();
            match message["name"].as_str() {
                Some("OBSTACLE_DISTANCE") => heard.push(message["time_usec"].as_i64().unwrap()),
                Some("OPTICAL_FLOW_RAD") => break,
                _ => {}
            }
        }
    }
    sink.finish().unwrap();
    let rest = peer.finish(LONG);
    let late = rest.iter().filter(|line| line.contains("OBSTACLE_DISTANCE")).count();
    // One step after six without a lookout, and then one of three.
    let wanted: Vec<i64> = (6..36).step_by(3).map(|step| seen(step, &[]).newer.0 / 1000).collect();
    assert_eq!((heard.len() + late, &heard[..]), (10, &wanted[..heard.len()]));
}

#[test]
fn cyclonedds_reads_obstacles_as_px4_takes_them() {
    let (domain, namespace) = ros2::place();
    let args = [domain.to_string(), namespace.clone(), "obstacle_distance".into()];
    let mut peer = peers::spawn("px4_read.py", args);
    peer.line_starting("listening", LONG);
    let topics = vec![Topic::ObstacleDistance];
    let settings = Px4 { domain, namespace, topics, time_offset_us: OFFSET_US, ..Px4::default() };
    let mut sink = px4::open(&settings).unwrap();
    peer.line_starting("matched", LONG);
    for (name, moved, wanted) in cases(true) {
        // A best-effort reader hears nothing of what is sent before it is known, so a step goes out until it is heard.
        let message: Value = loop {
            offer(&mut sink, &moved);
            let until = Instant::now() + Duration::from_millis(500);
            let stamp_us = moved.newer.0 / 1000 + OFFSET_US;
            let mut lines = std::iter::from_fn(|| peer.line_within(until.saturating_duration_since(Instant::now())))
                .map(|line| serde_json::from_str::<Value>(&line).unwrap());
            if let Some(message) = lines.find(|message| message["timestamp"] == stamp_us) {
                break message;
            }
        };
        assert_eq!(message["name"], "obstacle_distance");
        judge(name, &message, &wanted);
    }
    sink.finish().unwrap();
    assert_eq!(sink.lost(), 0);
    peer.finish(LONG);
}
