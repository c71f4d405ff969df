//! Body rates and attitude: a bounded series of IMU samples, integrated over exactly the interval asked for.

use std::collections::VecDeque;

use nalgebra::{UnitQuaternion, Vector3};

use super::{
    Config, Error, Lack,
    inertia::{GRAVITY, Push},
};
use crate::{clock::Stamp, wire::Imu};

/// Four seconds at 1 kHz; what is older is of no use.
const ROOM: usize = 4096;

/// Going back by more than this is a clock that was set or a recording that was started again.
pub(super) const ANEW_S: f64 = 1.0;

/// What a flying body's accelerometer shows on the average, over gravity: less is one whose driver takes gravity off.
const GRAVITY_PARTS: [f64; 2] = [0.3, 2.0];
/// Seconds over which that is averaged: a body that lets itself down feels little of it for a moment.
const GRAVITY_S: f64 = 1.0;

#[derive(Debug, Clone, Copy)]
struct Rate {
    stamp: Stamp,
    /// rad/s, body axes.
    omega: Vector3<f64>,
    /// rad²/s² a sample.
    variance: f64,
    /// The world's up in body axes, and how far it may be off in radians.
    up: Option<(Vector3<f64>, f64)>,
    /// Specific force, m/s², body axes, and (m/s²)² a sample.
    force: Option<(Vector3<f64>, f64)>,
}

/// IMU samples in the order of their stamps.
#[derive(Debug)]
pub(super) struct Rates {
    ring: VecDeque<Rate>,
    body: UnitQuaternion<f64>,
    /// Of gravity, what the accelerometer showed of late.
    felt: Option<f64>,
}

/// How the body turned between two stamps.
#[derive(Debug, Clone, Copy)]
pub(super) struct Turn {
    /// Brings newer body axes to older ones.
    pub(super) rotation: UnitQuaternion<f64>,
    /// Mean rate, rad/s, body axes.
    pub(super) mean: Vector3<f64>,
    /// Rate at the older stamp.
    pub(super) first: Vector3<f64>,
    /// Rate at the newer stamp.
    pub(super) last: Vector3<f64>,
    /// rad² of the integrated angle, an axis; the gyro's bias comes to that.
    pub(super) variance: f64,
    /// (rad/s)² of `last` − `first`, an axis; none where no gyro was there.
    pub(super) swing_variance: Option<f64>,
}

impl Rates {
    /// An empty series; `body` brings IMU axes to body axes.
    pub(super) fn new(body: UnitQuaternion<f64>) -> Self {
        Self { ring: VecDeque::with_capacity(ROOM), body, felt: None }
    }

    /// Takes a sample.
    pub(super) fn keep(&mut self, imu: &Imu, config: &Config) -> Result<(), Error> {
        let stamp: Stamp = imu.header.stamp.into();
        let omega = Vector3::new(imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z);
        if !omega.iter().all(|w| w.is_finite()) {
            return Err(Error::NotFinite { sensor: "gyro", stamp, what: "angular_velocity" });
        }
        if let Some(newest) = self.ring.back().map(|rate| rate.stamp)
            && stamp <= newest
        {
            let anew = newest.seconds_since(stamp) > ANEW_S;
            if anew {
                self.ring.clear();
                self.felt = None;
            }
            return Err(Error::Backwards { sensor: "gyro", stamp, newest, anew });
        }
        let stated = imu.angular_velocity_covariance[0];
        let variance = if stated.is_finite() && stated > 0.0 { stated } else { config.gyro_sd_rad_s.powi(2) };
        if self.ring.len() == ROOM {
            self.ring.pop_front();
        }
        let (up, force) = (self.up(imu, config), self.force(imu, config));
        if let Some(((up, _), (force, _))) = up.zip(force) {
            let now = force.dot(&up) / GRAVITY;
            let since = self.ring.back().map_or(0.0, |newest| stamp.seconds_since(newest.stamp));
            self.felt = Some(self.felt.map_or(now, |felt| felt + (now - felt) * (since / GRAVITY_S).min(1.0)));
        }
        self.ring.push_back(Rate { stamp, omega: self.body * omega, variance, up, force });
        Ok(())
    }

    /// The world's up in body axes, where the sample states an orientation. Drivers without one leave the identity and
    /// zeros behind, or a covariance of −1.
    fn up(&self, imu: &Imu, config: &Config) -> Option<(Vector3<f64>, f64)> {
        let q = imu.orientation;
        let covariance = &imu.orientation_covariance;
        let untouched = [q.x, q.y, q.z, q.w] == [0.0, 0.0, 0.0, 1.0] && covariance.iter().all(|c| *c == 0.0);
        let norm = (q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w).sqrt();
        let stated = covariance[0] >= 0.0 && (0.9..1.1).contains(&norm);
        if untouched || !stated {
            return None;
        }
        let world = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(q.w, q.x, q.y, q.z));
        let variance = covariance[0].max(covariance[4]);
        let sd = if variance.is_finite() && variance > 0.0 { variance.sqrt() } else { config.attitude_sd_rad };
        Some((self.body * world.inverse_transform_vector(&Vector3::z()), sd))
    }

    /// The specific force in body axes, where the sample has one. Drivers without leave zeros behind, which nothing but a fall shows,
    /// NaN, or a covariance of −1.
    fn force(&self, imu: &Imu, config: &Config) -> Option<(Vector3<f64>, f64)> {
        let a = imu.linear_acceleration;
        let force = Vector3::new(a.x, a.y, a.z);
        let stated = imu.linear_acceleration_covariance[0];
        let there = stated >= 0.0 && force.iter().all(|value| value.is_finite()) && force != Vector3::zeros();
        let sd = if stated.is_finite() && stated > 0.0 { stated.sqrt() } else { config.accelerometer_sd_m_s2 };
        there.then(|| (self.body * force, sd * sd))
    }

    /// Whether there was any sample.
    pub(super) fn is_empty(&self) -> bool {
        self.ring.is_empty()
    }

    /// The world's up in body axes at `stamp`, with its standard deviation.
    pub(super) fn up_at(&self, stamp: Stamp, gap_s: f64) -> Option<(Vector3<f64>, f64)> {
        let after = self.ring.partition_point(|rate| rate.stamp <= stamp);
        let near = |rate: &&Rate| rate.stamp.seconds_since(stamp).abs() <= gap_s;
        let before = after.checked_sub(1).and_then(|i| self.ring.get(i)).filter(near);
        let behind = self.ring.get(after).filter(near);
        match (before.and_then(|rate| Some((rate, rate.up?))), behind.and_then(|rate| Some((rate, rate.up?)))) {
            (Some((a, (up_a, sd))), Some((b, (up_b, _)))) => {
                let part = stamp.seconds_since(a.stamp) / b.stamp.seconds_since(a.stamp);
                Some(((up_a * (1.0 - part) + up_b * part).normalize(), sd))
            }
            (Some((_, up)), None) | (None, Some((_, up))) => Some(up),
            (None, None) => None,
        }
    }

    /// The rate at `stamp`, and for how many seconds it had to be held.
    fn at(&self, stamp: Stamp, gap_s: f64) -> Option<(Vector3<f64>, f64)> {
        let after = self.ring.partition_point(|rate| rate.stamp <= stamp);
        let before = after.checked_sub(1).and_then(|i| self.ring.get(i));
        match (before, self.ring.get(after)) {
            (Some(a), Some(b)) if b.stamp.seconds_since(a.stamp) <= gap_s => {
                let part = stamp.seconds_since(a.stamp) / b.stamp.seconds_since(a.stamp);
                Some((a.omega * (1.0 - part) + b.omega * part, 0.0))
            }
            (a, b) => [a, b]
                .into_iter()
                .flatten()
                .map(|rate| (rate.omega, rate.stamp.seconds_since(stamp).abs()))
                .filter(|(_, held)| *held <= gap_s)
                .min_by(|x, y| x.1.total_cmp(&y.1)),
        }
    }

    /// Integrates the rates from `older` to `newer`, interpolated at both ends.
    pub(super) fn turn(&self, older: Stamp, newer: Stamp, config: &Config) -> Result<Turn, Lack> {
        let gap_s = config.gyro_gap_s_max;
        let interval_s = newer.seconds_since(older);
        let gap = || Lack::GyroGap { covered_s: self.covered(older, newer, gap_s), interval_s };
        let (first, held_first) = self.at(older, gap_s).ok_or_else(gap)?;
        let (last, held_last) = self.at(newer, gap_s).ok_or_else(gap)?;
        let begin = self.ring.partition_point(|rate| rate.stamp <= older);
        let end = self.ring.partition_point(|rate| rate.stamp < newer);
        let (mut rotation, mut angle, mut noise) = (UnitQuaternion::identity(), Vector3::zeros(), 0.0);
        let (mut then, mut rate, mut longest) = (older, first, 0.0_f64);
        let inner = self.ring.range(begin..end.max(begin)).map(|kept| (kept.stamp, kept.omega, kept.variance));
        let variance_last = self.ring.back().map_or(0.0, |kept| kept.variance);
        for (stamp, omega, variance) in inner.chain([(newer, last, variance_last)]) {
            let h = stamp.seconds_since(then);
            longest = longest.max(h);
            // The second term is what a rate that changes its axis within the step adds (Magnus).
            let step = (rate + omega) * (0.5 * h) + rate.cross(&omega) * (h * h / 12.0);
            rotation *= UnitQuaternion::from_scaled_axis(step);
            angle += (rate + omega) * (0.5 * h);
            noise += variance * h * h;
            (then, rate) = (stamp, omega);
        }
        if longest > gap_s {
            return Err(gap());
        }
        let held = 0.5 * config.spin_sd_rad_s2 * (held_first.powi(2) + held_last.powi(2));
        let variance = noise + held * held;
        // Interpolating between two samples takes a third off the variance, on the average.
        let swing_variance = Some(4.0 / 3.0 * variance_last);
        Ok(Turn { rotation, mean: angle / interval_s, first, last, variance, swing_variance })
    }

    /// By how much the mean velocity of the interval between the last two of three stamps differs from that between the first two
    /// by accelerometer and attitude; `None` where they do not cover both, or where what is measured is not gravity and a little more.
    pub(super) fn push(&self, [before, older, newer]: [Stamp; 3], gap_s: f64) -> Option<Push> {
        let first = self.ring.partition_point(|rate| rate.stamp < before).saturating_sub(1);
        let (mut to_begin, mut change, mut weight, mut noise) =
            (UnitQuaternion::identity(), Vector3::zeros(), 0.0, 0.0);
        let (mut last, mut up_sd): (Option<&Rate>, f64) = (None, 0.0);
        for rate in self.ring.range(first..) {
            let since = rate.stamp.seconds_since(last.map_or(before, |last| last.stamp));
            if since > gap_s {
                return None;
            }
            if let Some(last) = last {
                to_begin *= UnitQuaternion::from_scaled_axis((last.omega + rate.omega) * (0.5 * since));
            }
            last = Some(rate);
            if rate.stamp <= before {
                continue;
            }
            let part = match rate.stamp < older {
                true => rate.stamp.seconds_since(before) / older.seconds_since(before),
                false => newer.seconds_since(rate.stamp) / newer.seconds_since(older),
            };
            if part <= 0.0 {
                break;
            }
            let ((up, sd), (measured, variance)) = rate.up.zip(rate.force)?;
            let by = part * since;
            change += to_begin * (measured - up * GRAVITY) * by;
            (weight, noise) = (weight + by, noise + by * by * variance);
            up_sd = up_sd.max(sd);
        }
        let covered = newer.seconds_since(last?.stamp) <= gap_s;
        let gravity = self.felt.is_some_and(|felt| (GRAVITY_PARTS[0]..GRAVITY_PARTS[1]).contains(&felt));
        if !(covered && gravity && weight > 0.0) {
            return None;
        }
        let seconds = 0.5 * newer.seconds_since(before);
        let scale = seconds / weight;
        Some(Push { change: to_begin.inverse() * change * scale, variance: noise * scale * scale, seconds, up_sd })
    }

    /// Seconds of the interval that lie between samples near enough to each other.
    fn covered(&self, older: Stamp, newer: Stamp, gap_s: f64) -> f64 {
        let mut covered = 0.0;
        for (a, b) in self.ring.iter().zip(self.ring.iter().skip(1)) {
            if b.stamp.seconds_since(a.stamp) <= gap_s {
                covered += b.stamp.min(newer).seconds_since(a.stamp.max(older)).max(0.0);
            }
        }
        covered
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::{self, Header};

    const STAMPS: [Stamp; 3] = [Stamp(1_000_000_000), Stamp(1_033_000_000), Stamp(1_067_000_000)];
    const GAP_S: f64 = 0.02;

    /// An IMU at rest but for what `force` adds to gravity (m/s², its own axes), tilted by `body` in a level body, at these times.
    fn rates(
        body: UnitQuaternion<f64>,
        times_ms: impl Iterator<Item = i64>,
        force: impl Fn(f64) -> Vector3<f64>,
    ) -> Rates {
        let config = Config::default();
        let mut rates = Rates::new(body);
        for ms in times_ms {
            let felt = body.inverse() * (Vector3::z() * GRAVITY + force(ms as f64 * 1e-3));
            let mut imu =
                Imu { header: Header { stamp: Stamp(ms * 1_000_000).into(), ..Header::default() }, ..Imu::default() };
            imu.linear_acceleration = wire::Vector3 { x: felt.x, y: felt.y, z: felt.z };
            let q = body;
            imu.orientation = wire::Quaternion { x: q.i, y: q.j, z: q.k, w: q.w };
            imu.orientation_covariance[0] = 4e-6;
            rates.keep(&imu, &config).unwrap();
        }
        rates
    }

    #[test]
    fn a_push_is_the_acceleration_between_the_intervals_middles() {
        for body in [UnitQuaternion::identity(), UnitQuaternion::from_euler_angles(0.4, -0.2, 2.0)] {
            let steady = rates(body, (900..1100).step_by(4), |_| Vector3::new(1.0, -2.0, 0.5));
            let push = steady.push(STAMPS, GAP_S).unwrap();
            // From the middle of 33 ms to that of 34.
            assert!((push.seconds - 0.0335).abs() < 1e-12);
            assert!((push.change - Vector3::new(1.0, -2.0, 0.5) * 0.0335).norm() < 1e-9, "{}", push.change);
            assert_eq!(push.up_sd, 0.002);
            // One that grows: at the middle of both it is what it is on the average.
            let growing = rates(body, (900..1100).step_by(4), |t| Vector3::x() * 10.0 * (t - 1.0));
            let middle = (0.033 + 0.067 + 0.0) / 3.0;
            let push = growing.push(STAMPS, GAP_S).unwrap();
            assert!((push.change.x - 10.0 * middle * 0.0335).abs() < 2e-4, "{}", push.change);
        }
    }

    #[test]
    fn a_body_that_lets_itself_down_has_an_accelerometer_all_the_same() {
        let level = UnitQuaternion::identity();
        let falls = Vector3::z() * (-0.8 * GRAVITY);
        let of = |from: f64| rates(level, (0..1100).step_by(4), |t| if t < from { Vector3::zeros() } else { falls });
        let push = of(0.9).push(STAMPS, GAP_S).unwrap();
        assert!((push.change - falls * push.seconds).norm() < 1e-9, "{}", push.change);
        // What feels none for good measures none.
        let taken_off = rates(level, (0..1100).step_by(4), |_| Vector3::z() * -GRAVITY + Vector3::x());
        assert!(taken_off.push(STAMPS, GAP_S).is_none());
        let in_g = rates(level, (0..1100).step_by(4), |_| Vector3::z() * (1.0 - GRAVITY));
        assert!(in_g.push(STAMPS, GAP_S).is_none());
    }

    #[test]
    fn a_push_has_no_gap_and_covers_both_intervals() {
        let level = UnitQuaternion::identity();
        let of = |times: Vec<i64>| rates(level, times.into_iter(), |_| Vector3::zeros()).push(STAMPS, GAP_S);
        assert!(of((900..1100).step_by(4).collect()).is_some());
        // A lost sample is bridged, a lost sensor isn't: at the beginning, within, or at the end.
        assert!(of((900..1100).step_by(4).filter(|ms| *ms != 1032).collect()).is_some());
        assert!(of((1024..1100).step_by(4).collect()).is_none());
        assert!(of((900..1100).step_by(4).filter(|ms| !(1010..1036).contains(ms)).collect()).is_none());
        assert!(of((900..1044).step_by(4).collect()).is_none());
        assert!(of(vec![]).is_none());
    }
}
