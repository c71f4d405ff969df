//! Known results for the sinks; `tests/peers/results.py` knows them too and checks what arrives.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use nightflow::{
    clock::Stamp,
    exposure::Exposed,
    flow::{Cause, Flow, Grid, State},
    motion::{Integrated, NoDistance, NoFlow, Obstacles, SECTORS, Scale, Sector, Velocity},
    publish::{Config, Moved, Offer, Sink},
    wire::{Header, Status},
};

use crate::peers::Peer;

/// Images go out for every 25th step.
pub fn config(namespace: &str) -> Config {
    Config { iceoryx2: None, namespace: namespace.into(), image_hz_max: 2.0, ..Config::default() }
}

/// Offers step after step until the reader has enough of every topic, then finishes the sink.
pub fn send_until_read(sink: &mut dyn Sink, reader: &mut Peer) {
    let until = Instant::now() + Duration::from_secs(60);
    let (vectors, confidence) = vectors();
    let mut step = 0;
    std::thread::scope(|scope| {
        let done = scope.spawn(|| reader.line_starting("done", Duration::from_secs(60)));
        while !done.is_finished() {
            assert!(Instant::now() < until, "the reader neither fails nor comes to an end");
            offer(sink, step, &vectors, &confidence);
            if step % 10 == 0 {
                sink.status(&status()).unwrap();
            }
            step += 1;
            std::thread::sleep(Duration::from_millis(20));
        }
        done.join().unwrap();
    });
    sink.finish().unwrap();
    eprintln!("{}: {step} steps offered, {} lost", sink.name(), sink.lost());
    assert!(sink.lost() * 10 <= step, "{} of {step} steps were lost", sink.lost());
}

const GRID: Grid = Grid { width: 320, height: 256, scale: [2.0, 4.0] };

fn vectors() -> (Vec<f32>, Vec<f32>) {
    let (cells, width) = (GRID.cells(), GRID.width);
    let vectors = (0..cells).flat_map(|cell| [(cell % width) as f32, -0.5 * (cell / width) as f32]);
    (vectors.collect(), (0..cells).map(|cell| (cell % 64) as f32 / 64.0).collect())
}

fn offer(sink: &mut dyn Sink, step: u64, vectors: &[f32], confidence: &[f32]) {
    let moved = moved(step);
    let flow = Flow { older: moved.older, newer: moved.newer, grid: GRID, vectors, confidence };
    // A step that finds no room is counted by the sink, which is looked at in the end.
    let _ = sink.offer(&Offer { moved: &moved, flow, image: &Exposed::default() });
}

fn moved(step: u64) -> Moved {
    let stamp = |count: u64| Stamp::from_ns(1_000_000_000 + count as i64 * 20_000_000);
    let (older, newer) = (stamp(step), stamp(step + 1));
    let (state, scale) = match step % 3 {
        0 => (State::Ok, Scale::Metric { distance: 12.5 }),
        1 => (State::Degraded(Cause::GainStep { factor: 2.5 }), Scale::PerDistance(NoDistance::Missing)),
        // A sink must hold the velocity back even where a step that says to be blind brings one.
        _ => (State::Blind(Cause::Dark { raw_mean: 0.0001, needed: 0.001 }), Scale::Metric { distance: 12.5 }),
    };
    let velocity = Velocity {
        older,
        newer,
        linear: [1.5, -0.25, 0.125],
        angular: [0.01, 0.02, -0.03],
        covariance: std::array::from_fn(|row| std::array::from_fn(|column| (row * 6 + column) as f64)),
        scale,
        samples: 500,
        inliers: 400,
        quality: 200,
    };
    Moved {
        step,
        older,
        newer,
        frame_id: Arc::from("camera_optical"),
        camera_size: [640, 1024],
        grid: GRID,
        gain: 20.0,
        raw_mean: 0.02,
        noise: None,
        noise_level: None,
        saturated_part: 0.01,
        confidence: 0.75,
        state,
        velocity: Ok(velocity),
        integrated: Integrated::without(older, newer, NoFlow::Blind),
        obstacles: Ok(obstacles(older, newer, matches!(scale, Scale::Metric { .. }))),
    }
}

/// Free a sector to the right of ahead, occupied ahead, unknown elsewhere.
fn obstacles(older: Stamp, newer: Stamp, metric: bool) -> Obstacles {
    let mut sectors = [Sector::Unknown; SECTORS];
    sectors[35] = Sector::Free { confidence: 0.75 };
    let distance_m = if metric { 6.0 } else { f64::NAN };
    sectors[36] = Sector::Occupied { ttc_s: 2.0, distance_m, confidence: 0.875, whole: true };
    Obstacles {
        older,
        newer,
        sectors,
        heading: [1.0, 0.0, 0.0],
        heading_sd_rad: 0.015625,
        speed: metric.then_some(3.0),
        horizon_s: 8.0,
        delay_s: 0.15,
    }
}

fn status() -> Status {
    Status {
        header: Header { stamp: Stamp::from_ns(1_000_000_000).into(), frame_id: String::new() },
        state: 1,
        cause: "the lamp flickers".into(),
        frames: 1 << 40,
        displaced: 2,
        steps: 3,
        spoiled: 4,
        unpaired: 5,
        lost: 6,
        last_error: "short by 3 bytes".into(),
        rate: 30.5,
        latency_ms: 12.25,
        step_ms: 8.0,
        noise_a: 0.25,
        noise_b: -0.125,
        snr_db: 6.5,
        noise_level: 12.0,
    }
}
