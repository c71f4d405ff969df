//! The kept frame as the odometer knows it: when it is kept and compared, where it is expected, and what it says of the gyro's bias.

use nalgebra::{UnitQuaternion, Vector3};
use nightflow::{
    flow::{Flow, Gradients},
    motion::{GRAVITY, Keeping, Odometer, Velocity},
};

use super::*;

/// A hover that drifts, turns and climbs, whose gyro is off by `bias`.
struct Hover {
    start: Truth,
    odometer: Odometer,
    bias: Vector3<f64>,
    steps: i64,
    sampled: i64,
    /// Deviation of what every vector errs by along either axis, camera pixels.
    scatter: f32,
}

impl Hover {
    fn new(config: Config, velocity: Vector3<f64>, bias: Vector3<f64>) -> Self {
        let mut start = Truth::hovering(6.0);
        start.config = Config { stamp_jitter_sd_s: 0.0, gyro_offset_sd_s: 0.0, ..config };
        start.velocity = velocity;
        start.rates = Vector3::new(0.05, -0.03, 0.1);
        start.attitude = UnitQuaternion::from_euler_angles(0.03, -0.02, 0.4);
        let mut odometer = Odometer::new(&start.config).unwrap();
        odometer.info(&calibration()).unwrap();
        Self { start, odometer, bias, steps: 0, sampled: -4, scatter: 0.0 }
    }

    /// The truth from the `older` frame on, over so many intervals.
    fn truth(&self, older: i64, intervals: i64) -> Truth {
        let start = &self.start;
        let seconds = older as f64 * start.interval_s;
        let turned = UnitQuaternion::from_scaled_axis(start.rates * seconds);
        let climbed = (start.attitude * start.velocity).z * seconds;
        Truth {
            attitude: start.attitude * turned,
            velocity: turned.inverse() * start.velocity,
            height: start.height + climbed,
            interval_s: start.interval_s * intervals as f64,
            ..start.clone()
        }
    }

    fn stamp(&self, frame: i64) -> i64 {
        OLDER_NS + frame * (self.start.newer_ns() - OLDER_NS)
    }

    /// One step by vectors that are exact but for their scatter, and what is to be done then.
    fn step(&mut self) -> (Velocity, Keeping) {
        let (older, newer) = (self.stamp(self.steps), self.stamp(self.steps + 1));
        while self.sampled * 5_000_000 + OLDER_NS < newer + 10_000_000 {
            let ns = OLDER_NS + self.sampled * 5_000_000;
            let turned = UnitQuaternion::from_scaled_axis(self.start.rates * ((ns - OLDER_NS) as f64 * 1e-9));
            let attitude = self.start.attitude * turned;
            let mut sample = imu(ns, self.start.rates + self.bias, Some(attitude));
            let felt = attitude.inverse() * Vector3::z() * GRAVITY;
            sample.linear_acceleration = Wire3 { x: felt.x, y: felt.y, z: felt.z };
            self.odometer.imu(&sample).unwrap();
            self.sampled += 1;
        }
        let truth = self.truth(self.steps, 1);
        let mut seen = truth.exact();
        let mut draws = Normals::new(6, older.cast_unsigned());
        seen.vectors.iter_mut().for_each(|along| *along += self.scatter * draws.draw() as f32);
        self.odometer.range(&reach(older, seen.range as f32)).unwrap();
        self.steps += 1;
        let flow = Flow { older: Stamp(older), newer: Stamp(newer), ..truth.flow(&seen) };
        let velocity = self.odometer.velocity(&flow, SIZE).unwrap();
        (velocity, self.odometer.keep(&velocity))
    }

    /// Compares the newest frame with that of number `kept`, by exact vectors that every cell is as sure of.
    fn look_back(&mut self, kept: i64) {
        let seen = self.truth(kept, self.steps - kept).exact();
        let planes = [vec![25.0; GRID.cells()], vec![0.0; GRID.cells()]];
        let [sure, none] = [&planes[0][..], &planes[1][..]];
        let flow = Flow {
            older: Stamp(self.stamp(kept)),
            newer: Stamp(self.stamp(self.steps)),
            grid: GRID,
            vectors: &seen.vectors,
            confidence: &seen.confidence,
        };
        let gradients = Gradients { information: [sure, none, sure], pull: [none, none] };
        self.odometer.look_back(&flow, &gradients, SIZE);
    }
}

fn drifting() -> Vector3<f64> {
    Vector3::new(0.2, -0.1, 0.15)
}

#[test]
fn the_kept_frame_is_expected_where_it_is() {
    for offset in [[0.0; 3], [0.2, -0.1, 0.05]] {
        let config = Config { camera_offset_m: offset, range_offset_m: offset, ..Config::default() };
        let mut hover = Hover::new(config, drifting(), Vector3::zeros());
        assert_eq!(hover.step().1, Keeping::Keep, "the first of a hover");
        let (mut compared, mut vectors) = (vec![], vec![]);
        for step in 2..60 {
            match hover.step().1 {
                Keeping::Compare => compared.push(step),
                Keeping::Keep => panic!("kept anew after {step} steps"),
                Keeping::Wait => continue,
            }
            hover.odometer.expect(&GRID, SIZE, &mut vectors).unwrap();
            let exact = hover.truth(1, hover.steps - 1).exact().vectors;
            let off = vectors.iter().zip(&exact).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(off < 0.15, "{off} camera pixels off after {step} steps");
        }
        assert!(compared.len() < 12 && compared[0] <= 3 && compared.last() > Some(&30), "{compared:?}");
        // After two seconds another one is kept.
        assert!((60..64).any(|_| hover.step().1 == Keeping::Keep));
    }
}

#[test]
fn what_moves_fast_or_has_lost_its_way_keeps_nothing() {
    let mut fast = Hover::new(Config::default(), Vector3::new(3.0, 0.0, 0.0), Vector3::zeros());
    assert!((0..10).all(|_| fast.step().1 == Keeping::Wait));
    for config in [Config { keyframes: false, ..Config::default() }, Config { gradients: false, ..Config::default() }] {
        let mut hover = Hover::new(config, drifting(), Vector3::zeros());
        assert!((0..10).all(|_| hover.step().1 == Keeping::Wait));
    }
    let mut hover = Hover::new(Config::default(), drifting(), Vector3::zeros());
    assert_eq!([(); 3].map(|()| hover.step().1), [Keeping::Keep, Keeping::Wait, Keeping::Compare]);
    // A step without a velocity, …
    hover.odometer.let_go();
    assert_eq!(hover.odometer.expect(&GRID, SIZE, &mut vec![]), None);
    assert_eq!(hover.step().1, Keeping::Keep);
    // … a gap, and another camera.
    hover.step();
    hover.steps += 1;
    assert_eq!(hover.step().1, Keeping::Keep);
    hover.step();
    hover
        .odometer
        .info(&CameraInfo { k: [400.0, 0.0, 319.5, 0.0, 400.0, 239.5, 0.0, 0.0, 1.0], ..calibration() })
        .unwrap();
    assert_eq!(hover.odometer.expect(&GRID, SIZE, &mut vec![]), None);
}

#[test]
fn a_bias_shows_in_what_is_kept_and_is_taken_off() {
    let bias = Vector3::new(0.004, -0.005, 0.002);
    let off = |compares: bool| {
        // Over ground that bends no drift would tell a turn from it.
        let mut hover =
            Hover::new(Config { ground_bend_sd: 0.005, ground_slope_sd: 0.005, ..Config::default() }, drifting(), bias);
        hover.step();
        let mut last = Vector3::zeros();
        for _ in 2..40 {
            let (velocity, keeping) = hover.step();
            last = Vector3::from(velocity.angular) - hover.start.rates;
            if compares && keeping == Keeping::Compare {
                hover.look_back(1);
            }
        }
        last.norm()
    };
    let [compared, alone] = [true, false].map(off);
    assert!(compared < 0.1 * bias.norm(), "{compared} of {} rad/s are left", bias.norm());
    assert!(compared < 0.5 * alone, "{compared} {alone}");
}

#[test]
fn where_a_hover_has_gone_takes_the_scatter_off_its_velocity() {
    let errors = |compares: bool| {
        let mut hover = Hover::new(Config::default(), drifting(), Vector3::zeros());
        hover.scatter = 3.0;
        hover.step();
        let mut squares = vec![];
        for _ in 2..60 {
            let (velocity, keeping) = hover.step();
            let truth = hover.truth(hover.steps, 1).velocity;
            squares.push((Vector3::from(velocity.linear) - truth).norm_squared());
            if compares && keeping == Keeping::Compare {
                hover.look_back(1);
            }
        }
        let half = squares.split_off(squares.len() / 2);
        (half.iter().sum::<f64>() / half.len() as f64).sqrt()
    };
    let [compared, alone] = [true, false].map(errors);
    println!("{compared:.4} m/s with a frame that is kept, {alone:.4} without");
    assert!(compared < 0.5 * alone, "{compared} {alone}");
}

#[test]
fn flow_that_contradicts_everything_is_not_believed() {
    let mut hover = Hover::new(Config::default(), drifting(), Vector3::zeros());
    hover.step();
    while hover.step().1 != Keeping::Compare {}
    // A turn of a twentieth of a radian that the gyro knows nothing of.
    hover.start.rates += Vector3::new(0.5, 0.0, 0.0);
    hover.look_back(1);
    hover.start.rates -= Vector3::new(0.5, 0.0, 0.0);
    let (velocity, keeping) = hover.step();
    assert_eq!(keeping, Keeping::Keep, "what was kept is of no use");
    assert!((Vector3::from(velocity.angular) - hover.start.rates).norm() < 5e-4, "{velocity:?}");
}

#[test]
fn keeping_and_looking_back_allocate_nothing_after_the_first() {
    let mut hover = Hover::new(Config::default(), drifting(), Vector3::zeros());
    let mut vectors = vec![];
    hover.step();
    let mut taken = vec![];
    while taken.len() < 3 {
        if hover.step().1 == Keeping::Compare {
            let seen = hover.truth(1, hover.steps - 1).exact();
            let planes = [vec![25.0; GRID.cells()], vec![0.0; GRID.cells()]];
            let (older, newer) = (Stamp(hover.stamp(1)), Stamp(hover.stamp(hover.steps)));
            let flow = Flow { older, newer, grid: GRID, vectors: &seen.vectors, confidence: &seen.confidence };
            let gradients =
                Gradients { information: [&planes[0], &planes[1], &planes[0]], pull: [&planes[1], &planes[1]] };
            let look = || {
                hover.odometer.expect(&GRID, SIZE, &mut vectors);
                hover.odometer.look_back(&flow, &gradients, SIZE);
            };
            taken.push(crate::allocations::during(look).1.calls);
        }
    }
    assert_eq!(taken[1..], [0, 0], "{taken:?}");
}
