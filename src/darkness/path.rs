//! The path of a synthetic flight: smooth, with its velocity, acceleration and body rates known at every moment.

use nalgebra::{UnitQuaternion, Vector3};

use super::noise::Normals;
use crate::motion::GRAVITY;

/// A sum of two sines with its derivatives.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sway {
    waves: [[f64; 3]; 2],
}

impl Sway {
    /// Amplitude of the whole, and a period in seconds around which the two waves lie.
    pub(super) fn draw(amplitude: f64, period: f64, draws: &mut Normals) -> Self {
        let mut wave = |part: f64, period: f64| {
            let omega = std::f64::consts::TAU / (period * (0.8 + 0.4 * draws.uniform()));
            [amplitude * part, omega, std::f64::consts::TAU * draws.uniform()]
        };
        Self { waves: [wave(0.7, period), wave(0.3, period * 0.45)] }
    }

    /// Value, first and second derivative.
    pub(super) fn at(&self, t: f64) -> [f64; 3] {
        self.waves.iter().fold([0.0; 3], |[v, d, dd], [amplitude, omega, phase]| {
            let (sine, cosine) = (omega * t + phase).sin_cos();
            [v + amplitude * sine, d + amplitude * omega * cosine, dd - amplitude * omega * omega * sine]
        })
    }
}

/// A flight along the x axis that sways a little in every direction.
#[derive(Debug, Clone)]
pub(super) struct Path {
    speed: f64,
    height: f64,
    along: Sway,
    across: Sway,
    up: Sway,
    roll: Sway,
    pitch: Sway,
    yaw: Sway,
}

/// Where the body is, and how it moves.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pose {
    /// Metres, world (z up).
    pub(super) position: Vector3<f64>,
    /// World from body (FLU).
    pub(super) attitude: UnitQuaternion<f64>,
    /// m/s, body.
    pub(super) velocity: Vector3<f64>,
    /// rad/s, body.
    pub(super) rates: Vector3<f64>,
    /// m/s², body, gravity's reaction included: what an accelerometer shows.
    pub(super) force: Vector3<f64>,
}

impl Path {
    pub(super) fn new(seed: u64, speed: f64, height: f64) -> Self {
        let mut draws = Normals::new(seed, 0x9a74);
        Self {
            speed,
            height,
            along: Sway::draw(0.06 * speed, 2.5, &mut draws),
            across: Sway::draw((0.1 * speed).min(0.08 * height), 3.0, &mut draws),
            up: Sway::draw(0.04 * height, 3.5, &mut draws),
            roll: Sway::draw(0.04, 1.7, &mut draws),
            pitch: Sway::draw(0.04, 2.1, &mut draws),
            yaw: Sway::draw(0.12, 4.0, &mut draws),
        }
    }

    /// The most that the path leaves the x axis by.
    pub(super) fn clear(&self) -> f64 {
        (0.1 * self.speed).min(0.08 * self.height) + 0.12 * self.height
    }

    pub(super) fn at(&self, t: f64) -> Pose {
        let ([x, dx, ddx], [y, dy, ddy], [z, dz, ddz]) = (self.along.at(t), self.across.at(t), self.up.at(t));
        let ([roll, droll, _], [pitch, dpitch, _], [yaw, dyaw, _]) =
            (self.roll.at(t), self.pitch.at(t), self.yaw.at(t));
        Pose::new(
            [Vector3::new(self.speed * t + x, y, self.height + z), Vector3::new(self.speed + dx, dy, dz)],
            Vector3::new(ddx, ddy, ddz),
            [[roll, droll], [pitch, dpitch], [yaw, dyaw]],
        )
    }
}

impl Pose {
    /// From position and velocity, acceleration (m, m/s and m/s², world), and roll, pitch and yaw with their derivatives.
    pub(super) fn new(motion: [Vector3<f64>; 2], acceleration: Vector3<f64>, angles: [[f64; 2]; 3]) -> Pose {
        let ([position, velocity], [[roll, droll], [pitch, dpitch], [yaw, dyaw]]) = (motion, angles);
        let attitude = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        let (sr, cr) = roll.sin_cos();
        let (sp, cp) = pitch.sin_cos();
        Pose {
            position,
            attitude,
            velocity: attitude.inverse() * velocity,
            rates: Vector3::new(droll - dyaw * sp, dpitch * cr + dyaw * sr * cp, dyaw * cr * cp - dpitch * sr),
            force: attitude.inverse() * (acceleration + Vector3::z() * GRAVITY),
        }
    }
}
