//! From step to step by the accelerometer: what it is told from, what it makes better, and what it must not be told from.

use nightflow::motion::GRAVITY;

use super::*;

const STEPS: i64 = 40;

/// A flight that speeds up along a curve: (velocity, acceleration) in the world.
fn moving(t: f64) -> [Vector3<f64>; 2] {
    let (sine, cosine) = (3.0 * t).sin_cos();
    [Vector3::new(1.0 + 0.5 * sine, 0.4 * cosine, 0.1 * sine), Vector3::new(1.5 * cosine, -1.2 * sine, 0.3 * cosine)]
}

/// The body's yaw and roll at a time.
fn attitude(t: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_euler_angles(0.1 * (2.0 * t).sin(), 0.0, 0.5 * t)
}

/// Root mean square of the error over the last steps of a flight, and its velocities. All vectors of a step are off by one shift, of
/// `noise` pixels; `spoil` may change the IMU's samples.
fn fly(config: &Config, noise: f64, spoil: impl Fn(i64, &mut Imu)) -> (f64, Vec<Velocity>) {
    let mut truth = Truth::hovering(6.0);
    truth.config = Config { stamp_jitter_sd_s: 0.0, gyro_offset_sd_s: 0.0, ..config.clone() };
    let step_ns = truth.newer_ns() - OLDER_NS;
    let mut odometer = Odometer::new(&truth.config).unwrap();
    odometer.info(&calibration()).unwrap();
    let mut draws = Normals::new(3, 1);
    let (mut sample_ns, mut found, mut square) = (OLDER_NS - 20_000_000, vec![], 0.0);
    for step in 0..STEPS {
        let (older_ns, seconds) = (OLDER_NS + step * step_ns, |ns: i64| (ns - OLDER_NS) as f64 * 1e-9);
        while sample_ns <= older_ns + step_ns + 5_000_000 {
            let t = seconds(sample_ns);
            let (before, after) = (attitude(t - 1e-4), attitude(t + 1e-4));
            let rates = (before.inverse() * after).scaled_axis() / 2e-4;
            let mut sample = imu(sample_ns, rates, Some(attitude(t)));
            let force = attitude(t).inverse() * (moving(t)[1] + Vector3::z() * GRAVITY);
            sample.linear_acceleration = Wire3 { x: force.x, y: force.y, z: force.z };
            sample.linear_acceleration_covariance[0] = 1e-4;
            spoil(sample_ns, &mut sample);
            odometer.imu(&sample).unwrap();
            sample_ns += 5_000_000;
        }
        let [begin, end] = [seconds(older_ns), seconds(older_ns + step_ns)];
        let mean =
            (0..100).map(|k| moving(begin + (k as f64 + 0.5) / 100.0 * (end - begin))[0]).sum::<Vector3<f64>>() / 100.0;
        truth.attitude = attitude(begin);
        truth.velocity = truth.attitude.inverse() * mean;
        truth.rates = (attitude(begin).inverse() * attitude(end)).scaled_axis() / truth.interval_s;
        let mut seen = truth.exact();
        odometer.range(&reach(older_ns, seen.range as f32)).unwrap();
        let shift = [draws.draw() * noise, draws.draw() * noise];
        for vector in seen.vectors.as_chunks_mut::<2>().0 {
            for (value, shift) in vector.iter_mut().zip(shift) {
                *value += (shift + 0.05 * draws.draw()) as f32;
            }
        }
        let flow = Flow { older: Stamp(older_ns), newer: Stamp(older_ns + step_ns), ..truth.flow(&seen) };
        let velocity = odometer.velocity(&flow, SIZE).unwrap();
        if step >= STEPS / 2 {
            square += (Vector3::from(velocity.linear) - truth.expected()).norm_squared();
        }
        found.push(velocity);
    }
    ((square / (STEPS - STEPS / 2) as f64).sqrt(), found)
}

fn settings(inertia: bool) -> Config {
    Config { inertia, gyro_bias_sd_rad_s: 0.0, ..Config::default() }
}

#[test]
fn exact_sensors_give_the_exact_velocity_along_a_curve() {
    let (alone, _) = fly(&settings(false), 0.0, |_, _| ());
    let (carried, _) = fly(&settings(true), 0.0, |_, _| ());
    println!("{alone:.5} m/s alone, {carried:.5} carried");
    // Vectors are noisy by 0.05 px, of which 4800 leave a thousandth of a m/s.
    assert!(alone < 3e-3 && carried < 3e-3, "{alone} {carried}");
}

#[test]
fn noise_that_is_each_steps_own_is_averaged_out() {
    // A gyro's noise is a shift of all vectors, another one in every step.
    let noisy = |ns: i64, sample: &mut Imu| {
        let mut draws = Normals::new(8, ns.cast_unsigned());
        let rates = &mut sample.angular_velocity;
        for rate in [&mut rates.x, &mut rates.y, &mut rates.z] {
            *rate += 0.02 * draws.draw();
        }
        sample.angular_velocity_covariance[0] = 4e-4;
    };
    let config = |inertia| Config { ground_bend_sd: 10.0, ..settings(inertia) };
    let (alone, own) = fly(&config(false), 0.0, noisy);
    let (carried, all) = fly(&config(true), 0.0, noisy);
    println!("{alone:.4} m/s alone, {carried:.4} carried");
    assert!(alone > 0.05, "there is something to make better: {alone}");
    assert!(carried < 0.6 * alone, "{carried} beside {alone}");
    assert_eq!(own[0], all[0], "the first step has nothing before it");
    let sd = |velocity: &Velocity| (velocity.covariance[0][0] + velocity.covariance[1][1]).sqrt();
    assert!(sd(&all[39]) < 0.6 * sd(&own[39]), "and it says so: {} {}", sd(&all[39]), sd(&own[39]));
    assert!(all[39].quality >= own[39].quality);
    // The rates stay the gyro's.
    assert!(own.iter().zip(&all).all(|(own, all)| own.angular == all.angular));
}

#[test]
fn without_a_sound_accelerometer_every_step_stands_alone() {
    let (_, alone) = fly(&settings(false), 0.3, |_, _| ());
    type Spoil = fn(i64, &mut Imu);
    let spoilt: [(&str, Spoil); 6] = [
        ("none, zeros", |_, sample| sample.linear_acceleration = Wire3 { x: 0.0, y: 0.0, z: 0.0 }),
        ("none, a covariance of -1", |_, sample| sample.linear_acceleration_covariance[0] = -1.0),
        ("no number", |_, sample| sample.linear_acceleration.x = f64::NAN),
        ("infinite", |_, sample| sample.linear_acceleration.z = f64::INFINITY),
        ("gravity taken off by the driver", |_, sample| sample.linear_acceleration.z -= GRAVITY),
        ("in g instead of m/s²", |_, sample| {
            let force = &mut sample.linear_acceleration;
            (force.x, force.y, force.z) = (force.x / GRAVITY, force.y / GRAVITY, force.z / GRAVITY);
        }),
    ];
    for (name, spoil) in spoilt {
        assert!(fly(&settings(true), 0.3, spoil).1 == alone, "{name}");
    }
    // An attitude that nobody states is no direction of gravity.
    let blank = |_: i64, sample: &mut Imu| sample.orientation_covariance[0] = -1.0;
    assert!(fly(&settings(true), 0.3, blank).1 == fly(&settings(false), 0.3, blank).1);
    // Nor is one that the settings don't believe.
    let level = |inertia| Config { attitude: AttitudeUse::Level, ..settings(inertia) };
    assert!(fly(&level(true), 0.3, |_, _| ()).1 == fly(&level(false), 0.3, |_, _| ()).1);
    // But where it is sound it makes a difference.
    assert!(fly(&settings(true), 0.3, |_, _| ()).1 != alone);
}

/// An accelerometer that is off by far more than the settings say may spoil a step, but is contradicted before it does harm.
#[test]
fn an_accelerometer_that_is_wrong_is_contradicted() {
    let tilted = |_: i64, sample: &mut Imu| sample.linear_acceleration.x += 4.0;
    let (error, _) = fly(&settings(true), 0.0, tilted);
    assert!(error < 0.1, "4 m/s² for a second would be 4 m/s: {error}");
}
