//! What an autopilot hears of a whole run: every step of the program, and a stream without a hole.

use super::*;

#[test]
fn the_program_tells_an_autopilot_of_every_step() {
    let folder = tempfile::tempdir().unwrap();
    let [bag, launch] = ["in.mcap", "launch.toml"].map(|name| folder.path().join(name));
    bags::write(&bag, 0..6);
    let (mut peer, place) = autopilot("udp");
    let words = "[publish.mavlink]\nautopilot = \"px4\"\nwords = [\"flow\", \"obstacles\"]\nobstacles_hz = 0.0\n";
    let link = format!("{words}[publish.mavlink.link]\nudp = {place:?}\n");
    let prefix = format!("nightflow_autopilots_{}", std::process::id());
    let settings = format!("{}[publish.iceoryx2]\nprefix = {prefix:?}\n{link}", bags::SETTINGS);
    let args = [OsStr::new("replay"), bag.as_os_str(), OsStr::new("--config"), launch.as_os_str()];
    let replay = |settings: &str| {
        fs::write(&launch, settings).unwrap();
        let replay = Command::new(env!("CARGO_BIN_EXE_nightflow")).args(args).output().unwrap();
        let said = format!("{}{}", String::from_utf8_lossy(&replay.stdout), String::from_utf8_lossy(&replay.stderr));
        (replay.status.code(), said)
    };
    let (code, said) = replay(&settings);
    assert!(code == Some(2) && said.contains("add a table [motion.obstacles]"), "{code:?}: {said}");
    let (code, said) = replay(&format!("{settings}[motion.obstacles]\n"));
    assert_eq!(code, Some(0), "{said}");
    for _ in 0..5 {
        // The bag holds frames alone: without a calibration there is no angle, and that is told as no flow.
        let flow = next(&mut peer, "OPTICAL_FLOW_RAD");
        assert_eq!((number(&flow, "quality"), number(&flow, "distance")), (0.0, -1.0));
        assert!(flow["integrated_x"].is_null() && flow["integrated_xgyro"].is_null(), "{flow}");
        close(number(&flow, "integration_time_us"), 33_333.5, 0.6, "interval");
        let around = next(&mut peer, "OBSTACLE_DISTANCE");
        assert!(around["distances"].as_array().unwrap().iter().all(|cm| *cm == 65_535), "{around}");
    }
    peer.finish(LONG);
}

/// A stream of 30 steps a second: the integration times sum to the time that passed, and none is missing.
/// `STREAM_S=60` makes it a soak, which also judges when messages arrive.
#[test]
fn a_stream_has_no_hole() {
    let asked: Option<u64> = std::env::var("STREAM_S").ok().map(|seconds| seconds.parse().unwrap());
    let steps = asked.unwrap_or(3) * 30;
    let (mut peer, place) = autopilot("udp");
    let mut sink = mavlink::open(&Mavlink { link: Link::Udp(place), ..Mavlink::default() }).unwrap();
    let start = Stamp(clock::now().ns());
    let begun = Instant::now();
    let sending = thread::spawn(move || {
        for step in 0..steps {
            let due = Duration::from_nanos((step + 1) * STEP_NS as u64);
            let older = Stamp(start.0 + step as i64 * STEP_NS);
            let step = moved(step, older, &fly(1.0, 0.0, 0.0), step % 50 == 49);
            thread::sleep(due.saturating_sub(begun.elapsed()));
            offer(&mut sink, &step);
        }
        sink.finish().unwrap();
        (begun.elapsed(), sink.lost())
    });
    let messages: Vec<Value> = (0..steps).map(|_| next(&mut peer, "OPTICAL_FLOW_RAD")).collect();
    let (took, lost) = sending.join().unwrap();
    assert_eq!(lost, 0);
    let total_us: f64 = messages.iter().map(|message| number(message, "integration_time_us")).sum();
    let stamps: Vec<u64> = messages.iter().map(|message| message["time_usec"].as_u64().unwrap()).collect();
    assert!(stamps.windows(2).all(|pair| (33_333..=33_334).contains(&(pair[1] - pair[0]))), "{stamps:?}");
    assert_eq!(total_us as u64, stamps[stamps.len() - 1] - start.0 as u64 / 1000, "to the microsecond");
    close(total_us * 1e-6, took.as_secs_f64(), 0.1, "wall time");
    let blind = messages.iter().filter(|message| number(message, "quality") == 0.0).count() as u64;
    assert_eq!(blind, steps / 50);
    let arrived: Vec<f64> = messages.iter().map(|message| number(message, "arrived")).collect();
    let gap_s = arrived.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
    let share = total_us * 1e-6 / took.as_secs_f64();
    eprintln!("{steps} messages in {took:?}: longest gap {:.1} ms, integrated / wall {share:.6}", gap_s * 1e3);
    // A machine that is busy with other tests may hold any process up; the soak runs alone.
    assert!(asked.is_none() || gap_s <= 2.0 * STEP_S, "{gap_s} s without a message");
    peer.finish(LONG);
}
