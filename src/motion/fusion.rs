//! From the fit to the velocity: everything that errs is one column of unit variance, the flow says what it can about
//! each, and what is left is the covariance.
//!
//! The turn that the gyro says is taken off before the fit. Its error, e, leaves (−xy, 1 + x²; −(1 + y²), xy) e in the
//! vectors: mostly a shift, which the fit takes for motion over the ground, but bent by x² and y², which no motion over
//! a plane is. Where the bend is known better than the gyro is, that is in a hover, it tells shift from motion: the
//! vectors' own word on e, `Leftover::angle`, updates what the sensors are believed to err by (a Kalman update over all
//! of their errors together, for a tilted plane bends vectors too). What it says of the gyro's bias is kept for the
//! steps to come.

use nalgebra::{Matrix3, Matrix3x2, Matrix3x5, Matrix6, Matrix6x3, SMatrix, Vector3};

use super::{
    AttitudeUse, Odometer, Scale, Velocity,
    bias::{ALIKE, Bias, Part, STATES, Shown},
    fit::Found,
    gyro::Turn,
    inertia::{LASTING, Step},
    linear::GATE,
    odometer::{Ground, Span},
    quality,
};

/// (rad/s)² of a body rate that nothing observed.
const UNOBSERVED: f64 = 1e6;
/// Turn (3), its clock, two stamps, two tilts, two shifts, a stretch, what stands on the ground, the distance; …
const PASSING: usize = 13;
/// … and the gyro's bias with what passes for it.
const ERRORS: usize = PASSING + STATES;
/// Those that are the same in the next step: the gyro's clock, two tilts, two shifts, the stretch, what stands on the ground, the
/// gyro's bias with what passes for it; ground that is no plane (3) is the rest of what lasts.
const LAST: [usize; LASTING_ERRORS] = [3, 6, 7, 8, 9, 10, 11, 13, 14, 15, 16, 17, 18, 19, 20];
const LASTING_ERRORS: usize = LASTING - 3;
/// What stands on the ground and scatters no more than vectors do moves all of them together by so much of their spread.
const HIDDEN: f64 = 0.05;
/// Of what differs over the image as a turn does, so much as a stretch does (`cargo bench --bench velocity`, hovers' vertical errors).
const STRETCHED: f64 = 0.35;

/// What an error does, …
#[derive(Debug, Clone, Copy, Default)]
struct Effect {
    /// … m/s and rad/s that the estimate has more than the truth, …
    linear: Vector3<f64>,
    angular: Vector3<f64>,
    /// … and radians, optical axes, of turn that it leaves in the vectors.
    seen: Vector3<f64>,
}

/// What errs: a column each for one deviation of it.
#[derive(Default)]
struct Errors {
    /// (linear, angular).
    moved: SMatrix<f64, 6, ERRORS>,
    seen: SMatrix<f64, 3, ERRORS>,
    count: usize,
    /// What the bias that is believed in does.
    expected: Effect,
}

impl Errors {
    fn add(&mut self, deviation: Effect) {
        self.moved.fixed_view_mut::<3, 1>(0, self.count).copy_from(&deviation.linear);
        self.moved.fixed_view_mut::<3, 1>(3, self.count).copy_from(&deviation.angular);
        self.seen.set_column(self.count, &deviation.seen);
        self.count += 1;
    }

    /// The columns of those that last.
    fn lastingly<const D: usize>(&self, of: &SMatrix<f64, D, ERRORS>) -> SMatrix<f64, D, LASTING_ERRORS> {
        SMatrix::from_fn(|row, column| of[(row, LAST[column])])
    }

    /// What lasts of the velocity's error, as far as the vectors have said nothing about it.
    fn lasting(&self) -> SMatrix<f64, 6, LASTING> {
        self.lastingly(&self.moved).fixed_resize(0.0)
    }
}

/// What all vectors may err by together, radians: by one shift, and by what differs over the image as a turn or a stretch does.
#[derive(Debug, Clone, Copy)]
pub(super) struct Alike {
    pub(super) shared: f64,
    pub(super) bent: f64,
}

impl Alike {
    /// Of a shift right and down, and of a stretch.
    pub(super) fn shared_sds(&self) -> [f64; 3] {
        [self.shared, self.shared, STRETCHED * self.bent]
    }
}

impl Odometer {
    /// From the fit's camera axes to the newer body axes, with everything that makes the velocity uncertain.
    pub(super) fn conclude(
        &mut self,
        turn: &Turn,
        ground: &Ground,
        found: &Found,
        span: Span,
        alike: Alike,
    ) -> Velocity {
        let forward = turn.rotation.inverse();
        let to_newer = forward.to_rotation_matrix() * self.mount;
        let distance = ground.distance.as_ref();
        // A normal that leans is longer than a unit: what is too long there is too short in τ.
        let unit = (1.0 + found.lean[0].powi(2) + found.lean[1].powi(2)).sqrt();
        let scale = distance.map_or(1.0, |d| d.metres) / span.seconds * unit;
        // The camera's lever arm turns with the body; without a distance there are no metres to take it off in.
        let arm = if distance.is_ok() { Vector3::from(self.config.camera_offset_m) } else { Vector3::zeros() };
        let lever = (arm - forward * arm) / span.seconds;
        let camera = to_newer * found.tau * scale;
        let to_body = to_newer.matrix() * scale;
        let leans = ground.tangents.map(|tangent| match ground.lean_sd {
            Some(_) => camera * ground.longer(&tangent),
            None => Vector3::zeros(),
        });
        let fitted = Fitted {
            by_motion: Matrix3x5::from_fn(|i, j| if j < 3 { to_body[(i, j)] } else { leans[j - 3][i] }),
            camera,
            linear: camera - lever,
            arm,
            passed: ground.passed(&(self.mount * found.tau), turn),
        };
        let errors = self.errors(turn, ground, found, span, &fitted, alike);
        let Learnt { shift, mut covariance, lasting } = self.learn(&errors, ground, found, span, &fitted, alike.bent);
        let mut linear = fitted.linear - shift;
        let angular = turn.mean - errors.expected.angular;
        if turn.swing_variance.is_none() {
            unobserved(&mut covariance);
        }
        let leads = self.config.inertia && self.config.attitude == AttitudeUse::Imu;
        if leads && turn.swing_variance.is_some() && distance.is_ok() {
            self.carry(&mut linear, &mut covariance, &lasting, span, *forward.to_rotation_matrix().matrix());
        } else {
            self.inertia.forget();
        }
        let scale = match &ground.distance {
            Ok(d) => Scale::Metric { distance: d.metres },
            Err(why) => Scale::PerDistance(*why),
        };
        Velocity {
            older: span.older,
            newer: span.newer,
            linear: linear.into(),
            angular: angular.into(),
            // Symmetric to the bit.
            covariance: std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i.min(j), i.max(j))])),
            scale,
            samples: found.samples,
            inliers: found.inliers,
            quality: quality::of(&linear, &covariance.fixed_view::<3, 3>(0, 0).into(), &scale),
        }
    }

    /// Everything that errs and is not the vectors' own noise.
    fn errors(&self, turn: &Turn, ground: &Ground, found: &Found, span: Span, fit: &Fitted, alike: Alike) -> Errors {
        let (config, interval_s) = (&self.config, span.seconds);
        let to_camera = self.mount.inverse();
        let mut errors = Errors::default();
        // An error of the turn, in the older body's axes.
        let by_turn = fit.by_motion * found.by_turn * to_camera.matrix();
        let turned = |error: Vector3<f64>| Effect {
            linear: by_turn * error - (error / interval_s).cross(&fit.arm),
            angular: error / interval_s,
            seen: to_camera * error,
        };
        let [gyro @ .., first, last] = self.turn_errors(turn);
        gyro.into_iter().for_each(|error| errors.add(turned(error)));
        for (error, sign) in [(first, -1.0), (last, 1.0)] {
            let (by_turn, longer) = (turned(error), config.stamp_jitter_sd_s * sign / interval_s);
            errors.add(Effect {
                linear: by_turn.linear - fit.linear * longer,
                angular: by_turn.angular - turn.mean * longer,
                ..by_turn
            });
        }
        let (by_normal, by_shared) =
            found.leftover.as_ref().map_or_else(Default::default, |left| (left.by_normal, left.by_shared));
        for tangent in ground.tangents {
            let tilt = tangent * ground.tilt_sd;
            let moved = fit.by_motion.fixed_columns::<3>(0) * (found.by_normal * (to_camera * tilt));
            let linear = moved - fit.camera * ground.longer(&tilt);
            errors.add(Effect { linear, seen: by_normal * (to_camera * tilt), ..Effect::default() });
        }
        for (axis, sd) in alike.shared_sds().into_iter().enumerate() {
            let linear = fit.by_motion * found.by_shared.column(axis) * sd;
            errors.add(Effect { linear, seen: by_shared.column(axis) * sd, ..Effect::default() });
        }
        // What moves more than the ground by less than vectors scatter is not told from it.
        let relief = self.config.ground_relief_sd.min(HIDDEN * found.spread / found.tau.norm().max(f64::MIN_POSITIVE));
        errors.add(Effect { linear: fit.camera * relief, ..Effect::default() });
        let part = ground.distance.as_ref().map_or(0.0, |d| d.sd / d.metres);
        errors.add(Effect { linear: fit.camera * part, ..Effect::default() });
        if turn.swing_variance.is_some() {
            let believed = self.bias.believed();
            let slopes = self.by_slope(ground, found);
            let effect = |part: Part| {
                let by_bias = turned(part.bias * interval_s);
                Effect { seen: by_bias.seen + slopes * part.slope + to_camera * part.bent * alike.bent, ..by_bias }
            };
            believed.deviations().for_each(|deviation| errors.add(effect(deviation)));
            errors.expected = effect(believed.mean());
        }
        errors
    }

    /// By what the gyro's turn may be off, in the older body axes, rad: its noise (3), its clock, and the stamps of both frames.
    pub(super) fn turn_errors(&self, turn: &Turn) -> [Vector3<f64>; 6] {
        let [x, y, z] = std::array::from_fn(|axis| Vector3::ith(axis, turn.variance.sqrt()));
        let jitter = self.config.stamp_jitter_sd_s;
        let late = (turn.last - turn.first) * self.config.gyro_offset_sd_s;
        [x, y, z, late, turn.first * -jitter, turn.last * jitter]
    }

    /// How the turn that is left changes with the slope of the ground, a deviation of it in either direction: climbing over a slope
    /// bends the vectors as a turn does. Ground that bulges by so much where a ray's slope is 1 slopes by as much.
    pub(super) fn by_slope(&self, ground: &Ground, found: &Found) -> Matrix3x2<f64> {
        let by_normal = found.leftover.as_ref().map_or_else(Matrix3::zeros, |left| left.by_normal);
        let tangents = ground.tangents.map(|tangent| self.mount.inverse() * tangent * self.config.ground_bend_sd);
        by_normal * Matrix3x2::from_columns(&tangents)
    }

    /// What the turn that is left in the vectors says about all errors: what the linear velocity is to be less by, and
    /// the covariance that is left. What it says about the bias is kept. Without a gyro it is left alone: a turn that
    /// nobody measured is too large for the linear terms.
    fn learn(
        &mut self,
        errors: &Errors,
        ground: &Ground,
        found: &Found,
        span: Span,
        fit: &Fitted,
        bent: f64,
    ) -> Learnt {
        let mut covariance = errors.moved * errors.moved.transpose();
        let mut noise = covariance.fixed_view_mut::<3, 3>(0, 0);
        noise += fit.by_motion * found.covariance * fit.by_motion.transpose();
        let mean = errors.expected.linear;
        let unlearnt = |covariance| Learnt { shift: mean, covariance, lasting: errors.lasting() };
        let Some(left) = found.leftover.as_ref().filter(|_| errors.count > PASSING) else {
            return unlearnt(covariance);
        };
        // Ground that is no plane bends the vectors by what it bends times the motion; and what all vectors share need
        // not be the same all over the image.
        let moved = ground.along(&(self.mount * found.tau)).norm();
        let bend = (self.config.ground_bend_sd * moved).powi(2);
        let total = errors.seen * errors.seen.transpose() + left.covariance + Matrix3::identity() * bend;
        let Some(inverse) = total.try_inverse() else { return unlearnt(covariance) };
        let surprise = left.angle - errors.expected.seen;
        let odds = surprise.dot(&(inverse * surprise));
        // A turn that is left by more than that is no error of the sensors.
        if odds.is_nan() || odds > GATE {
            self.bias.doubt();
            return unlearnt(covariance);
        }
        let passing = errors.seen.fixed_columns::<PASSING>(0);
        let (mount, noise) = (self.mount.matrix(), passing * passing.transpose() + left.covariance);
        self.bias.pass(span.seconds, fit.passed);
        // A frame that is kept says it better, and of these very steps.
        if !self.anchor.as_ref().is_some_and(|anchor| anchor.heard) {
            let noise = noise * ALIKE + Matrix3::identity() * (bend * Bias::alike(span.seconds, fit.passed));
            self.bias.take(&Shown {
                angle: mount * left.angle,
                interval_s: span.seconds,
                noise: mount * noise * mount.transpose(),
                by_slope: mount * self.by_slope(ground, found),
                bent,
            });
        }
        let mut both: Matrix6x3<f64> = errors.moved * errors.seen.transpose();
        let mut with_noise = both.fixed_rows_mut::<3>(0);
        with_noise += fit.by_motion * left.with_motion;
        let gain = both * inverse;
        let mut known = gain * both.transpose();
        // The rates stay the gyro's, less the bias: a filter that has the gyro is not told the flow's word twice.
        known.fixed_view_mut::<3, 3>(3, 3).fill(0.0);
        let gain = gain.fixed_rows::<3>(0);
        let mut lasting = errors.lasting();
        let mut columns = lasting.fixed_view_mut::<3, LASTING_ERRORS>(0, 0);
        columns -= gain * errors.lastingly(&errors.seen);
        lasting.fixed_view_mut::<3, 3>(0, LASTING_ERRORS).copy_from(&(gain * bend.sqrt()));
        Learnt { shift: mean + gain * surprise, covariance: covariance - known, lasting }
    }

    /// Weighs the step with what the steps before and the accelerometer say.
    fn carry(
        &mut self,
        linear: &mut Vector3<f64>,
        covariance: &mut Matrix6<f64>,
        lasting: &SMatrix<f64, 6, LASTING>,
        span: Span,
        turned: Matrix3<f64>,
    ) {
        let before = self.inertia.before(span.older);
        let push =
            before.and_then(|before| self.rates.push([before, span.older, span.newer], self.config.gyro_gap_s_max));
        let (moved, rates) = (lasting.fixed_rows::<3>(0).into_owned(), lasting.fixed_rows::<3>(3).into_owned());
        let weighed = self.inertia.take(
            &Step {
                older: span.older,
                newer: span.newer,
                turned,
                linear: *linear,
                noise: covariance.fixed_view::<3, 3>(0, 0) - moved * moved.transpose(),
                with_rates: covariance.fixed_view::<3, 3>(0, 3) - moved * rates.transpose(),
                lasting: moved,
                rates,
            },
            push.as_ref(),
            self.config.accelerometer_bias_sd_m_s2,
        );
        let Some(weighed) = weighed else { return };
        *linear = weighed.linear;
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&weighed.covariance);
        covariance.fixed_view_mut::<3, 3>(0, 3).copy_from(&weighed.with_rates);
        covariance.fixed_view_mut::<3, 3>(3, 0).copy_from(&weighed.with_rates.transpose());
    }
}

/// What a step comes to once its vectors' word on the turn is heard.
struct Learnt {
    /// What the linear velocity is to be less by.
    shift: Vector3<f64>,
    /// Of (linear, angular).
    covariance: Matrix6<f64>,
    /// The part of it that the next step errs by too, a column of unit variance each.
    lasting: SMatrix<f64, 6, LASTING>,
}

/// The fit in the newer body's axes.
struct Fitted {
    /// Change of the linear velocity with τ and the normal's lean.
    by_motion: Matrix3x5<f64>,
    /// The camera's velocity, and the body's.
    camera: Vector3<f64>,
    linear: Vector3<f64>,
    /// From the body to the camera, metres.
    arm: Vector3<f64>,
    /// How far on the ground is: see [`Ground::passed`].
    passed: f64,
}

impl Ground {
    /// By how much it is other ground that is seen, or the same from another side: motion along it over the distance to it, body axes,
    /// and the turn about its normal.
    pub(super) fn passed(&self, tau: &Vector3<f64>, turn: &Turn) -> f64 {
        self.along(tau).norm() + turn.rotation.scaled_axis().dot(&self.normal).abs()
    }

    /// What of a vector in body axes lies along the ground.
    pub(super) fn along(&self, vector: &Vector3<f64>) -> Vector3<f64> {
        vector - self.normal * self.normal.dot(vector)
    }

    /// By what part the distance grows with a tilt of the normal: what is wrong about the one is wrong about the other.
    fn longer(&self, tilt: &Vector3<f64>) -> f64 {
        self.distance.as_ref().map_or(0.0, |d| tilt.dot(&d.hit) / d.metres)
    }
}

/// Nothing is known of the rates: they are not correlated with anything, and anything they may be.
fn unobserved(covariance: &mut Matrix6<f64>) {
    covariance.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
    covariance.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
    covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * UNOBSERVED));
}
