//! Obstacles from exact flow: right times to contact, free told from unknown, and silence where nothing can be known.

mod thin;

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use nightflow::{
    clock::Stamp,
    darkness::noise::Normals,
    exposure::Exposed,
    flow::{Flow, Grid},
    motion::{Config, Lack, Lookout, Mount, NoSight, Obstacles, Odometer, Scale, Sector, Velocity, obstacles},
    wire::{CameraInfo, Header, Imu, Quaternion, Vector3 as Wire3},
};

const SIZE: [u32; 2] = [640, 480];
const FOCAL: f64 = 420.0;
const GRID: Grid = Grid { width: 80, height: 60, scale: [8.0, 8.0] };
const STEP_NS: i64 = 66_666_667;
const STEP_S: f64 = STEP_NS as f64 * 1e-9;
const HEIGHT: f64 = 4.0;
/// Sectors well inside the camera's field: 37° to either side.
const FIELD: std::ops::RangeInclusive<usize> = 30..=42;

/// Where a ray (second) from a point (first) ends in lengths of it, and how fast that point moves by itself; `None` shows
/// the far sky.
type Hit = Option<(f64, Vector3<f64>)>;
type Cast = dyn Fn(&Vector3<f64>, &Vector3<f64>) -> Hit;

/// A flight straight ahead over level ground, step by step, with exact flow.
struct Course {
    /// World (x ahead, y left, z up), m/s.
    velocity: Vector3<f64>,
    /// rad/s, body.
    rates: Vector3<f64>,
    hit: Box<Cast>,
    position: Vector3<f64>,
    attitude: UnitQuaternion<f64>,
    older_ns: i64,
    odometer: Odometer,
    lookout: Lookout,
    metric: bool,
    /// m/s, along each axis.
    speed_sd: f64,
    /// Pixels of noise on every component of the flow.
    noise_px: f64,
    image: Exposed,
    draws: Normals,
}

fn ground(from: &Vector3<f64>, ray: &Vector3<f64>) -> Hit {
    (ray.z < -1e-6).then(|| (-from.z / ray.z, Vector3::zeros()))
}

/// A wall across the track at x, on the ground.
fn wall(x: f64) -> impl Fn(&Vector3<f64>, &Vector3<f64>) -> Hit {
    move |from, ray| {
        let reach = (x - from.x) / ray.x;
        let below = ground(from, ray);
        match below {
            Some((nearer, _)) if ray.x <= 0.0 || nearer < reach => below,
            _ => (ray.x > 0.0).then_some((reach, Vector3::zeros())),
        }
    }
}

/// An upright post of this width at (x, y) that moves, or the ground.
fn post(at: [f64; 2], width: f64, velocity: Vector3<f64>) -> impl Fn(&Vector3<f64>, &Vector3<f64>) -> Hit {
    move |from, ray| {
        let reach = (at[0] - from.x) / ray.x;
        let point = from + ray * reach;
        match ray.x > 0.0 && point.z > 0.0 && (point.y - at[1]).abs() < 0.5 * width {
            true => Some((reach, velocity)),
            false => ground(from, ray),
        }
    }
}

impl Course {
    fn new(hit: impl Fn(&Vector3<f64>, &Vector3<f64>) -> Hit + 'static) -> Self {
        let config = Config { camera: Mount::Forward, ..Config::default() };
        let mut odometer = Odometer::new(&config).unwrap();
        let [width, height] = SIZE;
        let k = [FOCAL, 0.0, 319.5, 0.0, FOCAL, 239.5, 0.0, 0.0, 1.0];
        odometer
            .info(&CameraInfo { width, height, distortion_model: "plumb_bob".into(), k, ..CameraInfo::default() })
            .unwrap();
        Self {
            velocity: Vector3::new(3.0, 0.0, 0.0),
            rates: Vector3::zeros(),
            hit: Box::new(hit),
            position: Vector3::new(0.0, 0.0, HEIGHT),
            attitude: UnitQuaternion::identity(),
            older_ns: 10_000_000_000,
            odometer,
            lookout: Lookout::new(&obstacles::Config::default()).unwrap(),
            metric: true,
            speed_sd: 0.05,
            noise_px: 0.0,
            image: textured(1),
            draws: Normals::new(1, 2),
        }
    }

    fn mount() -> Matrix3<f64> {
        *Rotation3::from_matrix_unchecked(Matrix3::new(0., 0., 1., -1., 0., 0., 0., -1., 0.)).matrix()
    }

    fn imu(&mut self) {
        for k in -3..17 {
            let ns = self.older_ns + k * 5_000_000;
            let turned = self.attitude * UnitQuaternion::from_scaled_axis(self.rates * (k as f64 * 0.005));
            let mut imu = Imu { header: Header { stamp: Stamp(ns).into(), ..Header::default() }, ..Imu::default() };
            imu.angular_velocity = Wire3 { x: self.rates.x, y: self.rates.y, z: self.rates.z };
            imu.orientation = Quaternion { x: turned.i, y: turned.j, z: turned.k, w: turned.w };
            imu.orientation_covariance[0] = 1e-4;
            // Steps overlap: what is there already is refused.
            let _ = self.odometer.imu(&imu);
        }
    }

    fn step(&mut self) -> Result<Obstacles, NoSight> {
        self.imu();
        let next = self.position + self.velocity * STEP_S;
        let turned = self.attitude * UnitQuaternion::from_scaled_axis(self.rates * STEP_S);
        let mut vectors = Vec::new();
        for cell in 0..GRID.cells() {
            let pixel = [cell % GRID.width, cell / GRID.width].map(|i| (i as f64 + 0.5) * 8.0 - 0.5);
            let optical = Vector3::new((pixel[0] - 319.5) / FOCAL, (pixel[1] - 239.5) / FOCAL, 1.0);
            let ray = self.attitude * (Self::mount() * optical);
            let seen = match (self.hit)(&self.position, &ray) {
                Some((reach, moves)) => self.position + ray * reach + moves * STEP_S - next,
                None => ray,
            };
            let back = Self::mount().transpose() * (turned.inverse() * seen);
            for (axis, centre) in [(0, 319.5), (1, 239.5)] {
                let there = back[axis] / back.z * FOCAL + centre;
                vectors.push((there - pixel[axis] + self.noise_px * self.draws.draw()) as f32);
            }
        }
        let (older, newer) = (Stamp(self.older_ns), Stamp(self.older_ns + STEP_NS));
        let flow = Flow { older, newer, grid: GRID, vectors: &vectors, confidence: &[0.9; 4800] };
        let velocity = Ok(Velocity {
            older,
            newer,
            linear: (turned.inverse() * self.velocity).into(),
            angular: self.rates.into(),
            covariance: std::array::from_fn(|i| {
                std::array::from_fn(|j| if i == j { self.speed_sd.powi(2) } else { 0.0 })
            }),
            scale: match self.metric {
                true => Scale::Metric { distance: HEIGHT },
                false => Scale::PerDistance(nightflow::motion::NoDistance::Missing),
            },
            samples: 1000,
            inliers: 900,
            quality: 200,
        });
        let found = self.lookout.look(&self.odometer, &flow, SIZE, &self.image, &velocity);
        (self.position, self.attitude, self.older_ns) = (next, turned, self.older_ns + STEP_NS);
        found
    }

    fn steps(&mut self, count: usize) -> Obstacles {
        for _ in 1..count {
            let _ = self.step();
        }
        self.step().unwrap()
    }
}

/// A developed frame of half the camera's size, every pixel another grey.
fn textured(seed: u64) -> Exposed {
    let mut draws = Normals::new(seed, 0);
    let plane: Vec<f32> = (0..320 * 240).map(|_| (0.4 + 0.1 * draws.draw()) as f32).collect();
    let rgb = plane.iter().chain(&plane).chain(&plane).copied().collect();
    let saturated = vec![0; 320 * 240];
    Exposed { width: 320, height: 240, scale: [2.0; 2], rgb, saturated, gain: 1.0, raw_mean: 0.4, ..Exposed::default() }
}

fn occupied(sector: Sector) -> Option<(f64, f64)> {
    match sector {
        Sector::Occupied { ttc_s, distance_m, .. } => Some((ttc_s, distance_m)),
        _ => None,
    }
}

fn close(found: f64, expected: f64, part: f64) -> bool {
    (found / expected - 1.0).abs() < part
}

#[test]
fn a_wall_is_met_when_it_stands_there_whatever_the_camera_turns() {
    for rates in [Vector3::zeros(), Vector3::new(0.3, -0.4, 0.25)] {
        let mut course = Course::new(wall(9.0));
        course.rates = rates;
        let found = course.steps(5);
        let ttc = (9.0 - course.position.x) / 3.0;
        for k in 32..=40 {
            let (ttc_s, distance_m) = occupied(found.sectors[k]).unwrap_or_else(|| panic!("{k}: {:?}", found.sectors));
            assert!(close(ttc_s, ttc, 0.03), "sector {k}: {ttc_s} for {ttc} s");
            let aside = (k as f64 - 36.0) * 5f64.to_radians() + course.attitude.euler_angles().2;
            assert!(close(distance_m, ttc * 3.0 / aside.cos(), 0.06), "sector {k}: {distance_m} m");
        }
        let outside = found.sectors.iter().enumerate().filter(|(k, _)| !(27..=45).contains(k));
        assert!(outside.clone().all(|(_, sector)| *sector == Sector::Unknown), "{:?}", found.sectors);
        let yaw = course.attitude.euler_angles().2;
        let heading = Vector3::from(found.heading).dot(&Vector3::new(yaw.cos(), -yaw.sin(), 0.0));
        assert!(heading > 0.9995 && found.heading_sd_rad < 0.02, "{found:?}");
    }
}

#[test]
fn open_land_is_free_up_to_the_field_of_view() {
    let mut course = Course::new(ground);
    let found = course.steps(6);
    for k in FIELD.filter(|k| !(34..=38).contains(k)) {
        assert!(matches!(found.sectors[k], Sector::Free { .. }), "sector {k}: {:?}", found.sectors[k]);
    }
    // Straight ahead nothing moves in the image: what is there can't be told from what is not, but it isn't occupied.
    assert!(found.sectors.iter().all(|sector| occupied(*sector).is_none()), "{:?}", found.sectors);
    assert_eq!((found.sectors[0], found.speed), (Sector::Unknown, Some(3.0)));
}

#[test]
fn a_post_stands_in_its_own_sector() {
    let mut course = Course::new(post([9.0, 1.6], 0.6, Vector3::zeros()));
    let found = course.steps(4);
    let (along, aside) = (9.0 - course.position.x, 1.6);
    let k = 36 + (f64::atan2(aside, along).to_degrees() / 5.0).round() as usize;
    let (ttc_s, _) = occupied(found.sectors[k]).unwrap_or_else(|| panic!("{k}: {:?}", found.sectors));
    assert!(close(ttc_s, along / 3.0, 0.05), "{ttc_s}");
    let others = (0..found.sectors.len()).filter(|other| other.abs_diff(k) > 1);
    assert!(others.clone().all(|other| occupied(found.sectors[other]).is_none()), "{:?}", found.sectors);
    for free in [30, 31, 32, 42] {
        assert!(matches!(found.sectors[free], Sector::Free { .. }), "{free}: {:?}", found.sectors);
    }
}

#[test]
fn what_moves_by_itself_is_timed_by_how_it_grows() {
    // It comes from the right at 1.5 m/s and towards the camera at 1 m/s.
    let mut course = Course::new(post([9.0, -3.0], 1.2, Vector3::new(-1.0, 1.5, 0.0)));
    course.step().unwrap();
    let found = course.step().unwrap();
    let seen = |found: &Obstacles| found.sectors.iter().filter_map(|sector| occupied(*sector)).collect::<Vec<_>>();
    // The scene's own step moves the post by nothing: its place is the same each time, only its flow says that it moves.
    let along = 9.0 - course.position.x;
    let times = seen(&found);
    assert!(!times.is_empty() && times.iter().all(|(ttc_s, _)| close(*ttc_s, along / 4.0, 0.1)), "{times:?} {along}");
}

#[test]
fn without_texture_or_light_nothing_is_free() {
    let mut course = Course::new(wall(9.0));
    let bare = Exposed { rgb: vec![0.4; 3 * 320 * 240], ..textured(1) };
    course.image = bare;
    let said = course.step().unwrap_err();
    assert!(matches!(said, NoSight::Bare { seen: 0, cells: 4800, .. }), "{said:?}");
    // The left half of the image is one grey: what lies there is unknown, and the right half is as it was.
    let mut course = Course::new(ground);
    for (i, value) in course.image.rgb.iter_mut().enumerate() {
        *value = if i % 320 < 160 { 0.4 } else { *value };
    }
    let found = course.steps(6);
    for k in 38..=44 {
        assert_eq!(found.sectors[k], Sector::Unknown, "sector {k}");
    }
    for k in 29..=33 {
        assert!(matches!(found.sectors[k], Sector::Free { .. }), "sector {k}: {:?}", found.sectors[k]);
    }
}

#[test]
fn standing_still_is_no_knowledge() {
    let mut course = Course::new(wall(9.0));
    course.velocity = Vector3::zeros();
    course.noise_px = 0.1;
    for _ in 0..5 {
        let said = course.step().unwrap_err();
        assert!(matches!(said, NoSight::Parallax { .. }), "{said:?}");
    }
}

#[test]
fn noise_widens_and_does_not_bias() {
    let mut course = Course::new(wall(9.0));
    course.noise_px = 0.3;
    let found = course.steps(8);
    let ttc = (9.0 - course.position.x) / 3.0;
    for k in 32..=40 {
        let (ttc_s, _) = occupied(found.sectors[k]).unwrap_or_else(|| panic!("{k}: {:?}", found.sectors));
        // Ahead little moves, and what is told there is the nearest that it may be.
        let allowed = if (35..=37).contains(&k) { 0.15 } else { 0.1 };
        assert!(close(ttc_s, ttc, allowed), "sector {k}: {ttc_s} for {ttc} s");
    }
}

#[test]
fn without_metres_there_are_times_and_no_distances() {
    let mut course = Course::new(wall(9.0));
    course.metric = false;
    let found = course.steps(4);
    let (ttc_s, distance_m) = occupied(found.sectors[36]).unwrap();
    assert!(close(ttc_s, (9.0 - course.position.x) / 3.0, 0.05) && distance_m.is_nan() && found.speed.is_none());
}

#[test]
fn a_speed_that_is_hardly_known_makes_no_distances_for_long() {
    let mut course = Course::new(wall(12.0));
    let known = course.steps(4);
    assert!(known.speed.is_some() && occupied(known.sectors[36]).unwrap().1.is_finite());
    // The wall hides the ground: what the fit makes of it is worth nothing, and its covariance says so.
    course.speed_sd = 2.0;
    let held = course.steps(8);
    assert!(held.speed == known.speed && occupied(held.sectors[36]).unwrap().1.is_finite(), "{held:?}");
    let lost = course.steps(12);
    let (ttc_s, distance_m) = occupied(lost.sectors[36]).unwrap();
    assert!(lost.speed.is_none() && distance_m.is_nan(), "{lost:?}");
    assert!(close(ttc_s, (12.0 - course.position.x) / 3.0, 0.05), "{ttc_s}");
}

#[test]
fn a_gyro_that_is_missing_is_said_and_what_was_known_fades() {
    let mut course = Course::new(wall(9.0));
    course.odometer = Odometer::new(&Config { camera: Mount::Forward, ..Config::default() }).unwrap();
    assert_eq!(course.step().unwrap_err(), NoSight::Lack(Lack::Calibration));
    // Steps that are missing leave nothing behind.
    let mut course = Course::new(wall(9.0));
    course.steps(3);
    course.older_ns += 10 * STEP_NS;
    course.image = Exposed { rgb: vec![0.4; 3 * 320 * 240], ..textured(1) };
    assert!(course.step().is_err());
}

#[test]
fn settings_that_make_no_sense_are_refused() {
    let config = obstacles::Config { horizon_s: 0.0, ..obstacles::Config::default() };
    let said = Lookout::new(&config).unwrap_err().to_string();
    assert!(said.contains("obstacles.horizon_s is 0") && said.contains("positive"), "{said}");
    let config = obstacles::Config { confidence_min: 1.0, ..obstacles::Config::default() };
    assert!(Lookout::new(&config).unwrap_err().to_string().contains("0.5 to below 1"));
}
