//! Velocity from flow over a plane: exact where the flow is, honest where it is not, and silent where it must be.

mod bias;
mod gradients;
mod inertia;
mod keyframes;
mod lens;
mod watch;

use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use nightflow::{
    clock::Stamp,
    darkness::noise::Normals,
    flow::{Flow, Grid},
    motion::{
        AttitudeUse, BOUND_M_S, BOUND_PART, Config, Diagnosis, Error, GyroUse, Lack, Mount, NoDistance, Odometer,
        REASONS, Scale, Velocity,
    },
    wire::{CameraInfo, Header, Imu, Quaternion, Range, Vector3 as Wire3},
};

const SIZE: [u32; 2] = [640, 480];
pub const FOCAL: f64 = 420.0;
const OLDER_NS: i64 = 10_000_000_000;
pub const GRID: Grid = Grid { width: 80, height: 60, scale: [8.0, 8.0] };

/// One step over the plane z = 0 of the world, with everything that is true about it.
#[derive(Clone)]
pub struct Truth {
    pub config: Config,
    /// Body velocity in the older body's axes; straight in the world.
    pub velocity: Vector3<f64>,
    rates: Vector3<f64>,
    /// Height of the body's origin.
    height: f64,
    /// World from older body.
    pub attitude: UnitQuaternion<f64>,
    interval_s: f64,
}

/// What the sensors make of it.
pub struct Seen {
    pub vectors: Vec<f32>,
    pub confidence: Vec<f32>,
    rates: Vector3<f64>,
    range: f64,
}

impl Truth {
    pub fn hovering(height: f64) -> Self {
        Self {
            config: Config { stamp_jitter_sd_s: 0.0, gyro_offset_sd_s: 0.0, ..Config::default() },
            velocity: Vector3::zeros(),
            rates: Vector3::zeros(),
            height,
            attitude: UnitQuaternion::identity(),
            interval_s: 0.033_333_333,
        }
    }

    fn mount(&self) -> Rotation3<f64> {
        match self.config.camera {
            Mount::Downward => {
                Rotation3::from_matrix_unchecked(nalgebra::Matrix3::new(0., -1., 0., -1., 0., 0., 0., 0., -1.))
            }
            Mount::Forward => {
                Rotation3::from_matrix_unchecked(nalgebra::Matrix3::new(0., 0., 1., -1., 0., 0., 0., -1., 0.))
            }
            Mount::Tf => panic!("no transforms here"),
            Mount::Quaternion([x, y, z, w]) => {
                UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z)).to_rotation_matrix()
            }
        }
    }

    /// Position and attitude of the body at the newer frame.
    fn newer(&self) -> (Vector3<f64>, UnitQuaternion<f64>) {
        let moved = self.attitude * self.velocity * self.interval_s;
        let turned = self.attitude * UnitQuaternion::from_scaled_axis(self.rates * self.interval_s);
        (Vector3::new(0.0, 0.0, self.height) + moved, turned)
    }

    /// The velocity in the newer body's axes, which is what is asked for.
    pub fn expected(&self) -> Vector3<f64> {
        self.newer().1.inverse() * (self.attitude * self.velocity)
    }

    /// Exact flow of a pinhole camera; where the ground is not in sight it is left out by its confidence.
    pub fn exact(&self) -> Seen {
        let offset = Vector3::from(self.config.camera_offset_m);
        let (newer, turned) = self.newer();
        let older = Vector3::new(0.0, 0.0, self.height);
        let mount = self.mount();
        let (from, to) = (older + self.attitude * offset, newer + turned * offset);
        let (mut vectors, mut confidence) = (Vec::new(), Vec::new());
        for cell in 0..GRID.cells() {
            let pixel = [cell % GRID.width, cell / GRID.width].map(|i| (i as f64 + 0.5) * 8.0 - 0.5);
            let ray = Vector3::new((pixel[0] - 319.5) / FOCAL, (pixel[1] - 239.5) / FOCAL, 1.0);
            let beam = self.attitude * (mount * ray);
            let seen = beam.z < -1e-3;
            let point = from + beam * (-from.z / beam.z);
            let back = mount.inverse() * (turned.inverse() * (point - to));
            let seen = seen && back.z > 1e-6;
            let there = [back.x / back.z * FOCAL + 319.5, back.y / back.z * FOCAL + 239.5];
            for axis in 0..2 {
                vectors.push(if seen { (there[axis] - pixel[axis]) as f32 } else { 0.0 });
            }
            confidence.push(if seen { 0.9 } else { 0.0 });
        }
        let beam = self.attitude * Vector3::from(self.config.range_direction).normalize();
        let eye = older + self.attitude * Vector3::from(self.config.range_offset_m);
        Seen { vectors, confidence, rates: self.rates, range: eye.z / -beam.z }
    }

    fn odometer(&self, seen: &Seen, gyro: impl Iterator<Item = i64>, range: bool) -> Odometer {
        let mut odometer = Odometer::new(&self.config).unwrap();
        odometer.info(&calibration()).unwrap();
        for ns in gyro {
            let at = (ns - OLDER_NS) as f64 * 1e-9;
            let attitude = self.attitude * UnitQuaternion::from_scaled_axis(self.rates * at);
            odometer.imu(&imu(ns, seen.rates, Some(attitude))).unwrap();
        }
        if range {
            odometer.range(&reach(OLDER_NS, seen.range as f32)).unwrap();
        }
        odometer
    }

    fn newer_ns(&self) -> i64 {
        OLDER_NS + (self.interval_s * 1e9).round() as i64
    }

    pub fn velocity(&self, seen: &Seen, range: bool) -> Result<Velocity, Lack> {
        let gyro = (-4..12).map(|k| OLDER_NS + 1_234_567 + k * 5_000_000);
        self.odometer(seen, gyro, range).velocity(&self.flow(seen), SIZE)
    }

    fn flow<'a>(&self, seen: &'a Seen) -> Flow<'a> {
        Flow {
            older: Stamp(OLDER_NS),
            newer: Stamp(self.newer_ns()),
            grid: GRID,
            vectors: &seen.vectors,
            confidence: &seen.confidence,
        }
    }
}

fn header(ns: i64) -> Header {
    Header { stamp: Stamp(ns).into(), frame_id: "camera".into() }
}

fn calibration() -> CameraInfo {
    CameraInfo {
        header: header(0),
        height: SIZE[1],
        width: SIZE[0],
        distortion_model: "plumb_bob".into(),
        d: vec![0.0; 5],
        k: [FOCAL, 0.0, 319.5, 0.0, FOCAL, 239.5, 0.0, 0.0, 1.0],
        ..CameraInfo::default()
    }
}

fn imu(ns: i64, rates: Vector3<f64>, attitude: Option<UnitQuaternion<f64>>) -> Imu {
    let mut imu = Imu { header: header(ns), ..Imu::default() };
    imu.angular_velocity = Wire3 { x: rates.x, y: rates.y, z: rates.z };
    match attitude {
        Some(q) => {
            imu.orientation = Quaternion { x: q.i, y: q.j, z: q.k, w: q.w };
            imu.orientation_covariance[0] = 1e-12;
        }
        None => imu.orientation_covariance[0] = -1.0,
    }
    imu
}

fn reach(ns: i64, range: f32) -> Range {
    Range { header: header(ns), min_range: 0.1, max_range: 60.0, range, ..Range::default() }
}

#[test]
fn exact_flow_gives_the_exact_velocity() {
    let mounts = [Mount::Downward, Mount::Forward, Mount::Quaternion([0.654, 0.654, -0.27, 0.27])];
    let mut draws = Normals::new(11, 0);
    let mut three = |size: f64| Vector3::from_fn(|_, _| size * draws.draw());
    for height in [1.0, 5.0, 20.0] {
        for camera in mounts {
            for _ in 0..6 {
                let mut truth = Truth::hovering(height);
                truth.config.camera = camera;
                truth.config.camera_offset_m = [0.1, -0.05, -0.08];
                truth.config.range_offset_m = [-0.1, 0.02, -0.02];
                truth.velocity = three(0.4 * height);
                truth.rates = three(0.4);
                truth.attitude = UnitQuaternion::from_scaled_axis(three(0.1));
                let found = truth.velocity(&truth.exact(), true).unwrap();
                let error = (Vector3::from(found.linear) - truth.expected()).norm();
                // Flow and range travel as f32; a camera that looks along the ground sees vectors of hundreds of pixels.
                let allowed = if camera == Mount::Downward { 1e-6 } else { 3e-6 * height };
                assert!(error < allowed, "height {height}, {camera:?}: off by {error:e} m/s");
                assert!((Vector3::from(found.angular) - truth.rates).norm() < 1e-9);
                assert!(matches!(found.scale, Scale::Metric { .. }));
            }
        }
    }
}

#[test]
fn axes_are_forward_left_up_for_either_camera() {
    for camera in [Mount::Downward, Mount::Forward] {
        for (axis, sign) in [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)] {
            let mut truth = Truth::hovering(4.0);
            truth.config.camera = camera;
            truth.velocity[axis] = sign * 1.5;
            let found = truth.velocity(&truth.exact(), true).unwrap();
            for other in 0..3 {
                assert!(
                    (found.linear[other] - truth.velocity[other]).abs() < 1e-5,
                    "{camera:?} {axis} {sign}: {found:?}"
                );
            }
        }
    }
    // Said in pixels too: over ground that flows down a downward image (from its top to its bottom) one flies forward.
    let mut truth = Truth::hovering(4.0);
    let seen = Seen {
        vectors: [0.0, 3.0].repeat(GRID.cells()),
        confidence: vec![0.9; GRID.cells()],
        rates: Vector3::zeros(),
        range: 4.0,
    };
    let found = truth.velocity(&seen, true).unwrap();
    assert!((found.linear[0] - 4.0 * 3.0 / FOCAL * 30.0).abs() < 1e-3, "{found:?}");
    // And turning alone is no motion.
    truth.rates = Vector3::new(0.3, -0.5, 0.4);
    let found = truth.velocity(&truth.exact(), true).unwrap();
    assert!(Vector3::from(found.linear).norm() < 1e-5, "{found:?}");
}

#[test]
fn the_imu_may_be_mounted_askew() {
    let mut truth = Truth::hovering(4.0);
    let body_from_imu = UnitQuaternion::from_euler_angles(0.4, -0.2, 2.0);
    truth.config.imu_quaternion = [body_from_imu.i, body_from_imu.j, body_from_imu.k, body_from_imu.w];
    truth.velocity = Vector3::new(1.0, 0.5, -0.2);
    truth.rates = Vector3::new(0.2, 0.1, -0.3);
    truth.attitude = UnitQuaternion::from_euler_angles(0.05, 0.1, 0.7);
    let mut odometer = Odometer::new(&truth.config).unwrap();
    odometer.info(&calibration()).unwrap();
    let seen = truth.exact();
    odometer.range(&reach(OLDER_NS, seen.range as f32)).unwrap();
    for k in -2..10 {
        let turned = truth.attitude * UnitQuaternion::from_scaled_axis(truth.rates * (k as f64 * 0.005));
        let rates = body_from_imu.inverse() * truth.rates;
        odometer.imu(&imu(OLDER_NS + k * 5_000_000, rates, Some(turned * body_from_imu))).unwrap();
    }
    let found = odometer.velocity(&truth.flow(&seen), SIZE).unwrap();
    assert!((Vector3::from(found.linear) - truth.expected()).norm() < 1e-5, "{found:?}");
}

/// Noise as the settings state it, 30 % of the vectors wrong by tens of pixels: the error must be as large as the
/// covariance says, and as often within the bound as the quality says.
fn honesty(camera: Mount, correlated: bool, attitude: AttitudeUse) -> (f64, f64, f64) {
    let (mut linear, mut all, mut worst) = (0.0, 0.0, 0.0_f64);
    let (mut quality, mut hits) = (0.0, 0.0);
    let rounds = 400;
    for round in 0..rounds {
        let mut draws = Normals::new(77, round);
        let mut truth = Truth::hovering(5.0);
        truth.config.camera = camera;
        truth.config.attitude = attitude;
        truth.config.seed = round as u32;
        let mut three = |size: f64| Vector3::from_fn(|_, _| size * draws.draw());
        (truth.velocity, truth.rates) = (three(1.5), three(0.2));
        truth.attitude = UnitQuaternion::from_scaled_axis(three(0.05));
        let mut seen = truth.exact();
        let noise: Vec<f64> = (0..2 * GRID.cells()).map(|_| draws.draw()).collect();
        let shared =
            [draws.draw(), draws.draw()].map(|n| n * truth.config.flow_shared_sd_cells * f64::from(GRID.scale[0]));
        for cell in 0..GRID.cells() {
            let wrong = draws.uniform() < 0.3;
            for (axis, shared) in shared.iter().enumerate() {
                let i = 2 * cell + axis;
                let noise = match correlated {
                    true => (0..4).map(|k| noise[(i + 2 * k) % noise.len()]).sum::<f64>() * 0.5,
                    false => noise[i],
                };
                seen.vectors[i] += (0.5 * noise + shared) as f32;
                seen.vectors[i] += if wrong { (40.0 * (draws.uniform() - 0.5)) as f32 } else { 0.0 };
            }
        }
        seen.rates += Vector3::from_fn(|_, _| truth.config.gyro_bias_sd_rad_s * draws.draw());
        let sd = (truth.config.range_sd_m.powi(2) + (truth.config.range_sd_part * seen.range).powi(2)).sqrt();
        seen.range += sd * draws.draw();
        let found = truth.velocity(&seen, true).unwrap();
        let error = Vector3::from(found.linear) - truth.expected();
        let turn = Vector3::from(found.angular) - truth.rates;
        let covariance = nalgebra::Matrix6::from_fn(|i, j| found.covariance[i][j]);
        let block: nalgebra::Matrix3<f64> = covariance.fixed_view::<3, 3>(0, 0).into();
        linear += (error.transpose() * block.try_inverse().unwrap() * error)[0] / 3.0;
        let both = nalgebra::Vector6::new(error.x, error.y, error.z, turn.x, turn.y, turn.z);
        all += (both.transpose() * covariance.try_inverse().unwrap() * both)[0] / 6.0;
        worst = worst.max(error.norm());
        quality += f64::from(found.quality) / 255.0;
        hits += f64::from(u8::from(error.norm() <= BOUND_M_S + BOUND_PART * truth.velocity.norm()));
        assert!(found.inliers > found.samples / 2, "{found:?}");
    }
    let [quality, hits] = [quality, hits].map(|sum| sum / rounds as f64);
    assert!((quality - hits).abs() < 0.06, "a quality of {quality:.3} beside {hits:.3} within the bound");
    (linear / rounds as f64, all / rounds as f64, worst)
}

#[test]
fn the_covariance_is_honest_among_outliers() {
    for (camera, correlated, attitude) in [
        (Mount::Downward, false, AttitudeUse::Imu),
        (Mount::Forward, false, AttitudeUse::Imu),
        (Mount::Downward, true, AttitudeUse::Imu),
        (Mount::Downward, true, AttitudeUse::Fit),
    ] {
        let (linear, all, worst) = honesty(camera, correlated, attitude);
        println!(
            "{camera:?}, correlated {correlated}, {attitude:?}: NEES {linear:.3} linear, {all:.3} all, worst {worst:.3} m/s"
        );
        assert!((0.6..1.6).contains(&linear), "{camera:?} correlated {correlated}: mean NEES {linear}");
        assert!((0.5..1.6).contains(&all), "{camera:?} correlated {correlated}: mean NEES of all six {all}");
        assert!(worst < 0.6, "{camera:?}: {worst} m/s off");
    }
}

#[test]
fn without_a_range_the_velocity_is_over_the_distance() {
    let mut truth = Truth::hovering(8.0);
    truth.velocity = Vector3::new(2.0, -1.0, 0.4);
    let seen = truth.exact();
    let found = truth.velocity(&seen, false).unwrap();
    assert_eq!(found.scale, Scale::PerDistance(NoDistance::Missing));
    assert!((Vector3::from(found.linear) * 8.0 - truth.velocity).norm() < 1e-5, "{found:?}");
    let gyro = |_| (0..10).map(|k| OLDER_NS - 5_000_000 + k * 5_000_000);
    let mut old = truth.odometer(&seen, gyro(()), false);
    old.range(&reach(OLDER_NS - 400_000_000, 8.0)).unwrap();
    let scale = old.velocity(&truth.flow(&seen), SIZE).unwrap().scale;
    assert!(matches!(scale, Scale::PerDistance(NoDistance::Old { .. })), "{scale:?}");
    for range in [f32::INFINITY, f32::NEG_INFINITY, 70.0, 0.01] {
        let mut far = truth.odometer(&seen, gyro(()), false);
        far.range(&reach(OLDER_NS, range)).unwrap();
        let scale = far.velocity(&truth.flow(&seen), SIZE).unwrap().scale;
        assert!(matches!(scale, Scale::PerDistance(NoDistance::OutOfBounds { .. })), "{scale:?}");
    }
}

#[test]
fn a_gyro_that_does_not_cover_the_interval_is_said() {
    let mut truth = Truth::hovering(5.0);
    truth.velocity.x = 1.0;
    let seen = truth.exact();
    let none = truth.odometer(&seen, std::iter::empty(), true).velocity(&truth.flow(&seen), SIZE);
    assert_eq!(none, Err(Lack::Gyro));
    let hole = (-4..12).filter(|k| !(1..6).contains(k)).map(|k| OLDER_NS + k * 5_000_000);
    let lack = truth.odometer(&seen, hole, true).velocity(&truth.flow(&seen), SIZE).unwrap_err();
    let Lack::GyroGap { covered_s, interval_s } = lack else { panic!("{lack:?}") };
    assert!((interval_s - 1.0 / 30.0).abs() < 1e-6 && covered_s < 0.01, "{lack}");
    let late = (8..20).map(|k| OLDER_NS + k * 5_000_000);
    assert!(matches!(truth.odometer(&seen, late, true).velocity(&truth.flow(&seen), SIZE), Err(Lack::GyroGap { .. })));
    // The last sample before the frame is as far as a live gyro reaches: its rate is held for the rest.
    let live = (-4..7).map(|k| OLDER_NS + k * 5_000_000);
    assert!(truth.odometer(&seen, live, true).velocity(&truth.flow(&seen), SIZE).is_ok());
    let mut free = truth.clone();
    free.config.gyro = GyroUse::IfPresent;
    let found = free.odometer(&seen, std::iter::empty(), true).velocity(&free.flow(&seen), SIZE).unwrap();
    let known = truth.velocity(&seen, true).unwrap();
    assert!((found.linear[0] - 1.0).abs() < 1e-4);
    assert!(found.covariance[0][0] > 100.0 * known.covariance[0][0], "a turn that nobody measured must cost certainty");
    assert!(found.covariance[3][3] >= 1e6);
}

#[test]
fn bad_samples_are_refused_and_said() {
    let mut odometer = Odometer::new(&Config::default()).unwrap();
    odometer.imu(&imu(2_000_000_000, Vector3::zeros(), None)).unwrap();
    let back = odometer.imu(&imu(1_999_000_000, Vector3::zeros(), None)).unwrap_err();
    assert_eq!(back.to_string(), "gyro: its clock went back from 2.000000000 to 1.999000000, the sample is refused");
    let nan = odometer.imu(&imu(2_100_000_000, Vector3::new(f64::NAN, 0.0, 0.0), None)).unwrap_err();
    assert!(matches!(nan, Error::NotFinite { sensor: "gyro", .. }), "{nan}");
    odometer.range(&reach(2_000_000_000, 3.0)).unwrap();
    assert!(matches!(odometer.range(&reach(2_000_000_000, 3.0)), Err(Error::Backwards { anew: false, .. })));
    assert!(matches!(odometer.range(&reach(3_000_000_000, f32::NAN)), Err(Error::NotFinite { .. })));
    // A recording that starts over: refused once, then followed.
    assert!(matches!(odometer.imu(&imu(0, Vector3::zeros(), None)), Err(Error::Backwards { anew: true, .. })));
    odometer.imu(&imu(5_000_000, Vector3::zeros(), None)).unwrap();
    let mut info = calibration();
    info.distortion_model = "thin_prism".into();
    info.d[0] = 0.1;
    assert!(matches!(odometer.info(&info), Err(Error::Distortion { .. })));
}

#[test]
fn no_calibration_or_the_wrong_one_gives_no_velocity() {
    let truth = Truth::hovering(5.0);
    let seen = truth.exact();
    let mut odometer = truth.odometer(&seen, (-4..12).map(|k| OLDER_NS + k * 5_000_000), true);
    let lack = odometer.velocity(&truth.flow(&seen), [320, 240]).unwrap_err();
    assert_eq!(lack, Lack::CameraSize { calibrated: SIZE, frame: [320, 240] });
    odometer.info(&CameraInfo { k: [0.0; 9], ..calibration() }).unwrap();
    assert_eq!(odometer.velocity(&truth.flow(&seen), SIZE), Err(Lack::Calibration));
}

#[test]
fn flow_that_agrees_on_nothing_gives_no_velocity() {
    let truth = Truth::hovering(5.0);
    let mut seen = truth.exact();
    let mut draws = Normals::new(5, 0);
    seen.vectors.iter_mut().for_each(|v| *v = (60.0 * (draws.uniform() - 0.5)) as f32);
    let lack = truth.velocity(&seen, true).unwrap_err();
    assert!(matches!(lack, Lack::Disagreement { .. }), "{lack}");
    seen.confidence.fill(0.0);
    assert!(matches!(truth.velocity(&seen, true), Err(Lack::Disagreement { samples: 0, .. })));
}

#[test]
fn an_unknown_normal_is_seen_in_the_flow() {
    for (roll, pitch) in [(0.0, 0.0), (0.15, -0.1), (-0.25, 0.2)] {
        let mut truth = Truth::hovering(3.0);
        truth.config.attitude = AttitudeUse::Fit;
        truth.attitude = UnitQuaternion::from_euler_angles(roll, pitch, 0.4);
        truth.velocity = Vector3::new(3.0, -1.5, 0.5);
        truth.rates = Vector3::new(0.2, -0.1, 0.3);
        let seen = truth.exact();
        let found = truth.velocity(&seen, true).unwrap();
        let error = (Vector3::from(found.linear) - truth.expected()).norm();
        assert!(error < 2e-3, "roll {roll}, pitch {pitch}: {error} m/s off, {found:?}");
        truth.config.attitude = AttitudeUse::Level;
        let level = truth.velocity(&seen, true).unwrap();
        let off = (Vector3::from(level.linear) - truth.expected()).norm();
        assert!(roll == 0.0 || off > 20.0 * error, "level is {off} m/s off, fitted {error}");
    }
}

#[test]
fn the_gyro_is_looked_at_in_the_middle_of_the_exposure() {
    // The rate grows by 20 rad/s², so that ten milliseconds of difference are 0.2 rad/s.
    let mut truth = Truth::hovering(5.0);
    let rate = |ns: i64| Vector3::new(20.0 * (ns - OLDER_NS) as f64 * 1e-9, 0.0, 0.0);
    truth.rates = rate((OLDER_NS + truth.newer_ns()) / 2 + 10_000_000);
    let seen = truth.exact();
    let velocity = |exposure_s: f64| {
        let mut odometer = Odometer::new(&truth.config).unwrap().exposing(exposure_s);
        odometer.info(&calibration()).unwrap();
        for ns in (-4..12).map(|k| OLDER_NS + k * 5_000_000) {
            odometer.imu(&imu(ns, rate(ns), None)).unwrap();
        }
        odometer.range(&reach(OLDER_NS, 5.0)).unwrap();
        odometer.velocity(&truth.flow(&seen), SIZE).unwrap()
    };
    let (known, unknown) = (velocity(0.02), velocity(0.0));
    assert!(Vector3::from(known.linear).norm() < 1e-4, "{known:?}");
    assert!(Vector3::from(unknown.linear).norm() > 0.5, "{unknown:?}");
    assert_eq!(
        (known.older, known.newer),
        (Stamp(OLDER_NS), Stamp(truth.newer_ns())),
        "stamps stay those of the frames"
    );
}

#[test]
fn every_setting_has_its_reason() {
    let toml::Value::Table(table) = toml::Value::try_from(Config::default()).unwrap() else { panic!("a table") };
    for key in table.keys() {
        assert!(REASONS.iter().any(|(name, why)| name == key && why.len() > 10), "{key} has no reason");
    }
    assert_eq!(table.len(), REASONS.len(), "a reason without its setting");
    assert_eq!(Config::default(), table.try_into().unwrap());
}

#[test]
fn a_velocity_allocates_nothing_after_the_first() {
    let mut truth = Truth::hovering(5.0);
    truth.velocity.x = 2.0;
    let seen = truth.exact();
    let mut odometer = truth.odometer(&seen, (-4..12).map(|k| OLDER_NS + k * 5_000_000), true);
    let flow = truth.flow(&seen);
    odometer.velocity(&flow, SIZE).unwrap();
    let next = imu(OLDER_NS + 100_000_000, Vector3::zeros(), None);
    let (found, taken) = crate::allocations::during(|| {
        odometer.imu(&next).unwrap();
        odometer.velocity(&flow, SIZE)
    });
    assert!(found.is_ok() && taken.calls == 0, "{taken:?}");
}
