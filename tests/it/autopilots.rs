//! What autopilots are told: signs and axes by PX4's own rules, read back by the peers that they speak with.

pub mod moves;
mod streams;
mod surroundings;

use std::{
    ffi::OsStr,
    fs,
    path::PathBuf,
    process::Command,
    thread,
    time::{Duration, Instant},
};

use nightflow::{
    clock::{self, Stamp},
    darkness::noise::Normals,
    exposure::Exposed,
    flow::Flow,
    motion::{BOUND_PART, BOUND_PER_S, Config, Integrated, Mount, NoFlow, Odometer},
    publish::{
        Moved, Offer, Sink,
        autopilot::{
            Autopilot, Link, Mavlink, Px4, Serial, Word, mavlink,
            px4::{self, Topic},
        },
    },
};
use serde_json::Value;

use self::moves::{FOCAL, GRID, HEIGHT, Move, RATE, Row, SIZE, SPEED, STEP_NS, STEP_S};
use self::moves::{exact, expected, flow, fly, moved, odometer, table};
use crate::{
    bags,
    peers::{self, Peer},
    ros2,
};

const LONG: Duration = Duration::from_secs(30);

fn offer(sink: &mut dyn Sink, moved: &Moved) {
    let flow = Flow { older: moved.older, newer: moved.newer, grid: GRID, vectors: &[], confidence: &[] };
    sink.offer(&Offer { moved, flow, image: &Exposed::default() }).unwrap();
}

fn close(found: f64, wanted: f64, allowed: f64, what: &str) {
    assert!((found - wanted).abs() <= allowed, "{what}: {found}, expected {wanted}");
}

#[test]
fn flow_straight_below_has_the_signs_of_px4() {
    let older = Stamp(10_000_000_000);
    for row in table() {
        let found = moved(0, older, &row.1, false).integrated;
        let (flow, gyro) = (found.flow.unwrap(), found.gyro.unwrap());
        for (angle, wanted) in flow.into_iter().zip(expected(&row)) {
            close(angle, wanted, 2e-6, row.0);
        }
        for (angle, sign) in gyro.into_iter().zip(row.3) {
            close(angle, sign * RATE * STEP_S, 1e-9, row.0);
        }
        close(found.distance.unwrap(), HEIGHT, 1e-6, row.0);
        assert_eq!((found.older, found.newer, found.focal_px), (older, Stamp(older.0 + STEP_NS), Some(FOCAL)));
        // All that is uncertain is what the settings say that all vectors err by together.
        assert!(found.quality > 190, "{}: quality {}", row.0, found.quality);
    }
    // All at once: what is left when the gyro is taken off is the flight alone, as an autopilot will have it.
    let action = Move { velocity: [1.5, -1.0, 0.3], rates: [0.6, -0.8, 0.9] };
    let found = moved(0, older, &action, false).integrated;
    let [flow, gyro] = [found.flow.unwrap(), found.gyro.map(|[x, y, _]| [x, y]).unwrap()];
    let part = STEP_S / (HEIGHT + 0.5 * action.velocity[2] * STEP_S);
    close(flow[0] - gyro[0], -(-action.velocity[1]) * part, 3e-4, "flight to the right");
    close(flow[1] - gyro[1], action.velocity[0] * part, 3e-4, "flight forward");
}

#[test]
fn outliers_and_noise_leave_the_flow_straight_below() {
    let action = Move { velocity: [2.0, 0.5, 0.0], rates: [0.1, 0.2, -0.3] };
    let older = Stamp(10_000_000_000);
    let truth = moved(0, older, &action, false).integrated.flow.unwrap();
    let mut worst = 0.0_f64;
    for round in 0..40 {
        let mut draws = Normals::new(5, round);
        let mut vectors = exact(&action);
        for vector in vectors.chunks_exact_mut(2) {
            let wrong = if draws.uniform() < 0.3 { 40.0 } else { 0.0 };
            vector.iter_mut().for_each(|v| *v += (0.5 * draws.draw() + wrong * (draws.uniform() - 0.5)) as f32);
        }
        let found = odometer(&Config::default(), &action, older, true).integrated(&flow(older, &vectors), SIZE, false);
        let off = found.flow.unwrap().into_iter().zip(truth).map(|(angle, truth)| (angle - truth).abs());
        worst = off.fold(worst, f64::max);
        assert!(found.quality > 200, "quality {}", found.quality);
    }
    // Half a pixel is 1.2 mrad, and four hundred vectors that agree know the plane in the middle ten times better.
    println!("worst of 40: {:.3} mrad", worst * 1e3);
    assert!(worst < 0.4e-3, "{worst} rad off");
}

/// Noise, wrong vectors and a shift that all share, as large as the settings say: the flow must be as often within the
/// bound as the quality says, whether vectors err each on their own or as their neighbours do.
#[test]
fn quality_is_the_probability_that_the_flow_is_right() {
    let action = Move { velocity: [1.0, -0.5, 0.0], rates: [0.1, 0.2, -0.3] };
    let older = Stamp(10_000_000_000);
    let exact_row = moved(0, older, &action, false).integrated;
    let [truth, gyro] = [exact_row.flow.unwrap(), exact_row.gyro.map(|[x, y, _]| [x, y]).unwrap()];
    let length = |[x, y]: [f64; 2]| x.hypot(y);
    let bound = BOUND_PER_S + BOUND_PART * length([truth[0] - gyro[0], truth[1] - gyro[1]]) / STEP_S;
    // As for vectors straight from a network, so that what is shared weighs as much as what is not.
    let config = Config { flow_shared_sd_cells: 0.01, flow_shared_sd_part: 0.005, ..Config::default() };
    let mut said = Vec::new();
    for (noise_px, alike) in [(0.5, false), (2.0, false), (1.0, true), (2.0, true)] {
        let (mut quality, mut hits) = (0.0, 0.0);
        let rounds = 300;
        for round in 0..rounds {
            let mut draws = Normals::new(6, round);
            let mut vectors = exact(&action);
            let noise: Vec<f64> = vectors.iter().map(|_| draws.draw()).collect();
            let shared = [0, 1].map(|_| draws.draw() * config.flow_shared_sd_cells * f64::from(GRID.scale[0]));
            for (i, vector) in vectors.iter_mut().enumerate() {
                let wide = 2 * GRID.width;
                let around = [0, 2, 4, wide, wide + 2, wide + 4, 2 * wide, 2 * wide + 2, 2 * wide + 4];
                let noise = match alike {
                    true => around.iter().map(|k| noise[(i + k) % noise.len()]).sum::<f64>() / 3.0,
                    false => noise[i],
                };
                *vector += (noise_px * noise + shared[i % 2]) as f32;
            }
            for vector in vectors.chunks_exact_mut(2) {
                let wrong = if draws.uniform() < 0.2 { 40.0 } else { 0.0 };
                vector.iter_mut().for_each(|v| *v += (wrong * (draws.uniform() - 0.5)) as f32);
            }
            let found = odometer(&config, &action, older, true).integrated(&flow(older, &vectors), SIZE, false);
            let off = found.flow.unwrap();
            quality += f64::from(found.quality) / 255.0;
            hits += f64::from(u8::from(length([off[0] - truth[0], off[1] - truth[1]]) / STEP_S <= bound));
        }
        let [quality, hits] = [quality, hits].map(|sum| sum / rounds as f64);
        println!("{noise_px} px, alike {alike}: quality {quality:.3}, within the bound {hits:.3}");
        said.push((noise_px, alike, quality, hits));
    }
    assert!(said.iter().all(|(_, _, quality, hits)| (quality - hits).abs() < 0.08), "{said:?}");
    assert!(said.iter().any(|(_, _, quality, _)| *quality < 0.65), "it says nothing if all is well: {said:?}");
}

#[test]
fn what_there_is_no_flow_for_is_said() {
    let older = Stamp(10_000_000_000);
    let action = fly(1.0, 0.0, 0.0);
    let vectors = exact(&action);
    let blind = moved(0, older, &action, true).integrated;
    assert_eq!((blind.flow, blind.quality), (Err(NoFlow::Blind), 0));
    assert!(blind.gyro.is_some() && blind.distance.is_some(), "gyro and range need no light: {blind:?}");
    let ahead = Config { camera: Mount::Forward, ..Config::default() };
    let found = odometer(&ahead, &action, older, true).integrated(&flow(older, &vectors), SIZE, false);
    assert_eq!((found.flow, found.quality), (Err(NoFlow::OutOfSight), 0));
    let found = Odometer::new(&Config::default()).unwrap().integrated(&flow(older, &vectors), SIZE, false);
    let nothing = Integrated::without(older, Stamp(older.0 + STEP_NS), NoFlow::Calibration { frame: SIZE });
    assert_eq!(found, nothing);
    let found = odometer(&Config::default(), &action, older, false).integrated(&flow(older, &vectors), SIZE, false);
    assert!(found.flow.is_ok() && found.gyro.is_none(), "flow needs no gyro: {found:?}");
    let mut draws = Normals::new(9, 0);
    let scattered: Vec<f32> = vectors.iter().map(|_| 60.0 * draws.draw() as f32).collect();
    let found = odometer(&Config::default(), &action, older, true).integrated(&flow(older, &scattered), SIZE, false);
    assert!(matches!(found.flow, Err(NoFlow::Disagreement { .. } | NoFlow::Degenerate)), "{found:?}");
    assert_eq!(found.quality, 0);
}

/// The autopilot's end of a line, and where it is.
fn autopilot(kind: &str) -> (Peer, String) {
    let mut peer = peers::spawn("mavlink_read.py", [kind]);
    let line = peer.line_starting("at ", LONG);
    let place = line["at ".len()..].to_owned();
    (peer, place)
}

/// The next message of this name.
fn next(peer: &mut Peer, name: &str) -> Value {
    loop {
        let message: Value = serde_json::from_str(&peer.line_starting("{", LONG)).unwrap();
        assert_eq!(message["version"], 2, "{message}");
        if message["name"] == name {
            return message;
        }
    }
}

fn number(message: &Value, field: &str) -> f64 {
    message[field].as_f64().unwrap_or_else(|| panic!("{field} in {message}"))
}

/// Sends the whole table, then a blind step, and gives what arrived under `names`, step by step.
fn told(settings: &Mavlink, peer: &mut Peer, names: &[&str]) -> Vec<Vec<Value>> {
    let mut sink = mavlink::open(settings).unwrap();
    let mut all = Vec::new();
    let steps = table().map(|row| (row.1, false)).into_iter().chain([(fly(1.0, 0.0, 0.0), true)]);
    for (step, (action, blind)) in steps.enumerate() {
        let older = Stamp(1_000_000_000_123 + step as i64 * STEP_NS);
        offer(&mut sink, &moved(step as u64, older, &action, blind));
        let names = if blind { &names[..1] } else { names };
        all.push(names.iter().map(|name| next(peer, name)).collect());
    }
    sink.finish().unwrap();
    assert_eq!(sink.lost(), 0);
    all
}

#[test]
fn px4_takes_flow_and_velocity_over_udp() {
    let (mut peer, place) = autopilot("udp");
    let settings = Mavlink {
        words: vec![Word::Flow, Word::Odometry],
        system: 7,
        component: 42,
        sensor: 3,
        time_offset_us: 5_000_000,
        link: Link::Udp(place),
        ..Mavlink::default()
    };
    let told = told(&settings, &mut peer, &["OPTICAL_FLOW_RAD", "ODOMETRY"]);
    for (step, (row, told)) in table().iter().zip(&told).enumerate() {
        let [flow, odometry] = told.as_slice() else { panic!("{told:?}") };
        assert_eq!(flow["from"], serde_json::json!([7, 42]));
        assert_eq!(number(flow, "sensor_id"), 3.0);
        close(number(flow, "integration_time_us"), 33_333.5, 0.6, row.0);
        let newer_us = (1_000_000_000_123 + (step as i64 + 1) * STEP_NS) / 1000 + 5_000_000;
        assert_eq!(flow["time_usec"], newer_us);
        for (axis, field) in ["integrated_x", "integrated_y"].into_iter().enumerate() {
            close(number(flow, field), expected(row)[axis], 3e-6, row.0);
        }
        for (axis, field) in ["integrated_xgyro", "integrated_ygyro", "integrated_zgyro"].into_iter().enumerate() {
            close(number(flow, field), row.3[axis] * RATE * STEP_S, 1e-8, row.0);
        }
        close(number(flow, "distance"), HEIGHT, 1e-5, row.0);
        assert!(number(flow, "quality") > 190.0, "{flow}");
        // MAV_FRAME_LOCAL_FRD and MAV_FRAME_BODY_FRD; nothing is claimed of the pose.
        assert_eq!((number(odometry, "frame_id"), number(odometry, "child_frame_id")), (20.0, 12.0));
        assert!(["x", "y", "z"].iter().all(|field| odometry[field].is_null()), "{odometry}");
        assert!(odometry["q"][0].is_null() && odometry["pose_covariance"][0].is_null(), "{odometry}");
        let [x, y, z] = row.1.velocity;
        for (field, wanted) in [("vx", x), ("vy", -y), ("vz", -z)] {
            close(number(odometry, field), wanted, 1e-4, row.0);
        }
        for (axis, field) in ["rollspeed", "pitchspeed", "yawspeed"].into_iter().enumerate() {
            close(number(odometry, field), row.3[axis] * RATE, 1e-6, row.0);
        }
        let variances = [0, 6, 11, 15, 18, 20].map(|i| odometry["velocity_covariance"][i].as_f64().unwrap());
        assert!(variances.iter().all(|variance| *variance > 0.0), "{variances:?}");
        assert!((1.0..=100.0).contains(&number(odometry, "quality")), "{odometry}");
    }
    let blind = &told[table().len()][0];
    assert_eq!(number(blind, "quality"), 0.0);
    close(number(blind, "integration_time_us"), 33_333.5, 0.6, "blind");
    assert!(blind["integrated_x"].is_null() && blind["integrated_y"].is_null(), "blind is no zero: {blind}");
    peer.finish(LONG);
}

#[test]
fn ardupilot_takes_flow_as_rates() {
    let (mut peer, place) = autopilot("udp");
    let settings = Mavlink { autopilot: Autopilot::Ardupilot, link: Link::Udp(place), ..Mavlink::default() };
    let told = told(&settings, &mut peer, &["OPTICAL_FLOW"]);
    for (step, (row, told)) in table().iter().zip(&told).enumerate() {
        let flow = &told[0];
        for (axis, field) in ["flow_rate_x", "flow_rate_y"].into_iter().enumerate() {
            close(number(flow, field), expected(row)[axis] / STEP_S, 1e-4, row.0);
        }
        for (axis, field) in ["flow_x", "flow_y"].into_iter().enumerate() {
            close(number(flow, field), 10.0 * FOCAL * expected(row)[axis], 0.6, row.0);
        }
        // What is left of the flow without the turn, in metres a second.
        let speed = if row.1.rates == [0.0; 3] { SPEED } else { 0.0 };
        for (axis, field) in ["flow_comp_m_x", "flow_comp_m_y"].into_iter().enumerate() {
            close(number(flow, field), row.2[axis] * speed, 1e-3, row.0);
        }
        close(number(flow, "ground_distance"), HEIGHT, 1e-5, row.0);
        // ArduPilot makes a rate of zero of the first flow after a silence.
        assert_eq!(number(flow, "quality") > 0.0, step > 0, "step {step}: {flow}");
    }
    let blind = &told[table().len()][0];
    assert_eq!((number(blind, "quality"), number(blind, "flow_rate_x"), number(blind, "flow_rate_y")), (0.0, 0.0, 0.0));
    assert!(blind["flow_comp_m_x"].is_null(), "{blind}");
    peer.finish(LONG);
}

#[test]
fn a_serial_line_carries_flow_heartbeats_and_the_clock() {
    let (mut peer, place) = autopilot("serial");
    let serial = Serial { path: PathBuf::from(place), baud: 921_600 };
    let offset_us = 3_600_000_000;
    let settings = Mavlink { link: Link::Serial(serial), time_offset_us: offset_us, ..Mavlink::default() };
    let told = told(&settings, &mut peer, &["OPTICAL_FLOW_RAD"]);
    for (row, told) in table().iter().zip(&told) {
        close(number(&told[0], "integrated_x"), expected(row)[0], 3e-6, row.0);
        close(number(&told[0], "integrated_y"), expected(row)[1], 3e-6, row.0);
    }
    // The line is ours alone while it is open, and a process that another test is just starting may hold it a moment more.
    let begun = Instant::now();
    let sink = loop {
        match mavlink::open(&settings) {
            Ok(sink) => break sink,
            Err(why) => assert!(begun.elapsed() < LONG, "{why}"),
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    for _ in 0..2 {
        let heartbeat = next(&mut peer, "HEARTBEAT");
        // MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID.
        assert_eq!((number(&heartbeat, "type"), number(&heartbeat, "autopilot")), (18.0, 8.0));
    }
    let before = clock::now().ns();
    peer.say("timesync");
    let answer = next(&mut peer, "TIMESYNC");
    let theirs = answer["tc1"].as_i64().unwrap() - offset_us * 1000;
    assert!((before..=clock::now().ns()).contains(&theirs), "{answer}");
    assert!(answer["ts1"].as_i64().unwrap() > 0, "what was asked is said again: {answer}");
    drop(sink);
    peer.finish(LONG);
}

#[test]
fn a_line_that_was_lost_is_opened_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("line");
    let (peer, place) = autopilot("serial");
    std::os::unix::fs::symlink(place, &path).unwrap();
    let serial = Serial { path: path.clone(), baud: 57_600 };
    let mut sink = mavlink::open(&Mavlink { link: Link::Serial(serial), ..Mavlink::default() }).unwrap();
    peer.kill();
    let (mut peer, place) = autopilot("serial");
    fs::remove_file(&path).unwrap();
    std::os::unix::fs::symlink(place, &path).unwrap();
    let begun = Instant::now();
    let mut step = 0;
    let line = loop {
        offer(&mut sink, &moved(step, Stamp(1_000_000_000_000 + step as i64 * STEP_NS), &fly(1.0, 0.0, 0.0), false));
        step += 1;
        match peer.line_within(Duration::from_millis(50)) {
            Some(line) if line.contains("OPTICAL_FLOW_RAD") => break line,
            _ => assert!(begun.elapsed() < LONG, "the line was not opened again"),
        }
    };
    let flow: Value = serde_json::from_str(&line).unwrap();
    close(number(&flow, "integrated_y"), expected(&table()[0])[1], 3e-6, "forward");
    sink.finish().unwrap();
    assert!((1..step).contains(&sink.lost()), "{} of {step} steps are counted as lost", sink.lost());
    peer.finish(LONG);
}

#[test]
fn cyclonedds_reads_what_px4_takes() {
    let (domain, namespace) = ros2::place();
    let names = ["sensor_optical_flow", "vehicle_optical_flow"].map(str::to_owned);
    let mut peer = peers::spawn("px4_read.py", [domain.to_string(), namespace.clone()].into_iter().chain(names));
    peer.line_starting("listening", LONG);
    let topics = vec![Topic::SensorOpticalFlow, Topic::VehicleOpticalFlow];
    let settings = Px4 { domain, namespace, topics, time_offset_us: 5_000_000, ..Px4::default() };
    let mut sink = px4::open(&settings).unwrap();
    peer.line_starting("matched", LONG);
    let mut rows: Vec<(Row, bool)> = table().map(|row| (row, false)).into();
    rows.push((("blind", fly(1.0, 0.0, 0.0), [0.0, 1.0], [0.0; 3]), true));
    let (mut newer_us, mut blinds) = (0, 0);
    for (index, (row, blind)) in rows.iter().enumerate() {
        // A best-effort reader hears nothing of what is sent before it is known, so a step goes out until it is heard.
        let mut heard = None;
        while heard.is_none() {
            let older = Stamp(1_000_000_000_123 + newer_us as i64 * 1000);
            let step = moved(index as u64, older, &row.1, *blind);
            newer_us += STEP_NS as u64 / 1000;
            blinds += u64::from(*blind);
            offer(&mut sink, &step);
            let stamp_us = step.newer.0 / 1000 + 5_000_000;
            let mut both = ["sensor_optical_flow", "vehicle_optical_flow"].map(|_| None);
            let until = Instant::now() + Duration::from_millis(500);
            while both.iter().any(Option::is_none) && Instant::now() < until {
                let Some(line) = peer.line_within(until.saturating_duration_since(Instant::now())) else { break };
                let message: Value = serde_json::from_str(&line).unwrap();
                if message["timestamp_sample"] == stamp_us {
                    let place = usize::from(message["name"] == "vehicle_optical_flow");
                    both[place] = Some(message);
                }
            }
            heard = both[0].take().zip(both[1].take());
        }
        let (sensor, vehicle) = heard.unwrap();
        for flow in [&sensor, &vehicle] {
            assert_eq!((&flow["device_id"], &flow["integration_timespan_us"]), (&20038.into(), &33_333.into()));
            assert!(["max_flow_rate", "min_ground_distance"].iter().all(|field| flow[field].is_null()), "{flow}");
            assert_eq!(number(flow, "quality") > 0.0, !blind, "{flow}");
            for axis in 0..2 {
                match blind {
                    true => assert!(flow["pixel_flow"][axis].is_null(), "blind is no zero: {flow}"),
                    false => close(flow["pixel_flow"][axis].as_f64().unwrap(), expected(row)[axis], 3e-6, row.0),
                }
            }
            for axis in 0..3 {
                close(flow["delta_angle"][axis].as_f64().unwrap(), row.3[axis] * RATE * STEP_S, 1e-8, row.0);
            }
            close(number(flow, "distance_m"), HEIGHT, 1e-5, row.0);
        }
        assert_eq!((&sensor["delta_angle_available"], &sensor["distance_available"]), (&true.into(), &true.into()));
        assert!(number(&sensor, "timestamp") > 1e15, "{sensor}");
        assert_eq!(number(&sensor, "error_count") as u64, blinds);
    }
    sink.finish().unwrap();
    assert_eq!(sink.lost(), 0);
    peer.finish(LONG);
}

#[test]
fn settings_that_no_autopilot_understands_are_refused() {
    let refused = |settings: Mavlink| mavlink::open(&settings).err().expect("it was opened").to_string();
    let default = Mavlink::default;
    let both = vec![Word::Flow, Word::Odometry];
    let said = refused(Mavlink { autopilot: Autopilot::Ardupilot, words: both, ..default() });
    assert!(said.contains("leave odometry out of words"), "{said}");
    assert!(refused(Mavlink { words: vec![], ..default() }).contains("words is empty"));
    assert!(refused(Mavlink { hz: -1.0, ..default() }).contains("hz is -1"));
    assert!(refused(Mavlink { obstacles_hz: 1.0, ..default() }).contains("forget obstacles within half a second"));
    assert!(refused(Mavlink { obstacles_m_max: 655.35, ..default() }).contains("obstacles_m_max is 655.35"));
    let serial = Serial { path: "/dev/there_is_none".into(), baud: 57_600 };
    assert!(refused(Mavlink { link: Link::Serial(serial), ..default() }).contains("/dev/there_is_none"));
    let refused = |settings: Px4| px4::open(&settings).err().expect("it was opened").to_string();
    assert!(refused(Px4 { topics: vec![], ..Px4::default() }).contains("topics is empty"));
    assert!(refused(Px4 { device_id: 0, ..Px4::default() }).contains("device_id is 0"));
    assert!(refused(Px4 { hz: f64::NAN, ..Px4::default() }).contains("hz is NaN"));
    assert!(refused(Px4 { obstacles_m_max: 0.5, ..Px4::default() }).contains("obstacles_m_max is 0.5"));
}
