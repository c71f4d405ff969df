//! From the fit to the velocity: everything that errs is one column of unit variance (`errors`), the flow says what it can about
//! each, and what is left is the covariance.
//!
//! The turn that the gyro says is taken off before the fit. Its error, e, leaves (−xy, 1 + x²; −(1 + y²), xy) e in the
//! vectors: mostly a shift, which the fit takes for motion over the ground, but bent by x² and y², which no motion over
//! a plane is. Where the bend is known better than the gyro is, that is in a hover, it tells shift from motion: the
//! vectors' own word on e, `Leftover::angle`, updates what the sensors are believed to err by (a Kalman update over all
//! of their errors together, for a tilted plane bends vectors too). What it says of the gyro's bias is kept for the
//! steps to come.

use nalgebra::{Matrix3, Matrix3x5, Matrix6, Vector3};

use super::{
    AttitudeUse, Odometer, Scale, Velocity,
    bias::{ALIKE, Believed, Bias, Shown},
    errors::{Alike, Errors, Fitted, Heard},
    fit::Found,
    gyro::Turn,
    inertia::Step,
    odometer::{Ground, Span},
    quality,
};

/// (rad/s)² of a body rate that nothing observed.
const UNOBSERVED: f64 = 1e6;

/// What two frames show, and what is known of the turn and the ground between them.
#[derive(Clone, Copy)]
pub(super) struct Seen<'a> {
    pub(super) turn: &'a Turn,
    pub(super) ground: &'a Ground,
    pub(super) found: &'a Found,
    pub(super) span: Span,
    pub(super) alike: Alike,
}

impl Odometer {
    /// From the fit's camera axes to the newer body axes, with everything that makes the velocity uncertain.
    pub(super) fn conclude(&mut self, seen: &Seen<'_>) -> Velocity {
        let Seen { turn, ground, found, span, .. } = *seen;
        let (fitted, believed) = (self.fitted(seen), self.bias.believed());
        let errors = self.errors(&believed, seen, &fitted);
        let heard = self.learn(&errors, seen, &fitted);
        let expected = believed.shift(&heard.lasting);
        let mut linear = heard.linear - expected.fixed_rows::<3>(0);
        let angular = turn.mean - expected.fixed_rows::<3>(3);
        let mut covariance = heard.covariance;
        if turn.swing_variance.is_none() {
            unobserved(&mut covariance);
        }
        if self.leads() && turn.swing_variance.is_some() && ground.distance.is_ok() {
            self.carry(&mut linear, &mut covariance, &heard, &believed, seen);
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

    /// Whether accelerometer and attitude lead from step to step.
    pub(super) fn leads(&self) -> bool {
        self.config.inertia && self.config.attitude == AttitudeUse::Imu
    }

    /// The fit in the newer body's axes.
    pub(super) fn fitted(&self, seen: &Seen<'_>) -> Fitted {
        let Seen { turn, ground, found, span, .. } = *seen;
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
        Fitted {
            by_motion: Matrix3x5::from_fn(|i, j| if j < 3 { to_body[(i, j)] } else { leans[j - 3][i] }),
            camera,
            linear: camera - lever,
            arm,
            passed: ground.passed(&(self.mount * found.tau), turn),
        }
    }

    /// By how much ground that is no plane bends the vectors, rad: what it bends times the motion.
    pub(super) fn bulge(&self, seen: &Seen<'_>) -> f64 {
        self.config.ground_bend_sd * seen.ground.along(&(self.mount * seen.found.tau)).norm()
    }

    /// What the turn that is left in the vectors says about all errors. What it says about the bias is kept. Without a gyro it is left
    /// alone: a turn that nobody measured is too large for the linear terms.
    fn learn(&mut self, errors: &Errors, seen: &Seen<'_>, fit: &Fitted) -> Heard {
        let Seen { turn, ground, found, span, alike } = *seen;
        let Some(left) = found.leftover.as_ref().filter(|_| turn.swing_variance.is_some()) else {
            return errors.unheard(found, fit);
        };
        let bend = self.bulge(seen);
        // A turn that is left by more than that is no error of the sensors.
        let Some(heard) = errors.heard(found, left, fit, bend, &left.angle) else {
            self.bias.doubt();
            return errors.unheard(found, fit);
        };
        let mount = self.mount.matrix();
        self.bias.pass(span.seconds, fit.passed);
        // A frame that is kept says it better, and of these very steps.
        if !self.anchor.as_ref().is_some_and(|anchor| anchor.heard) {
            let noise = (errors.passing() + left.covariance) * ALIKE
                + Matrix3::identity() * (bend * bend * Bias::alike(span.seconds, fit.passed));
            self.bias.take(&Shown {
                angle: mount * left.angle,
                interval_s: span.seconds,
                noise: mount * noise * mount.transpose(),
                by_slope: mount * self.by_slope(ground, found),
                bent: alike.bent,
            });
        }
        heard
    }

    /// Weighs the step with what the steps before and the accelerometer say. `before` was believed before it.
    fn carry(
        &mut self,
        linear: &mut Vector3<f64>,
        covariance: &mut Matrix6<f64>,
        heard: &Heard,
        before: &Believed,
        seen: &Seen<'_>,
    ) {
        let Seen { turn, span, .. } = *seen;
        let push = self
            .inertia
            .before(span.older)
            .and_then(|before| self.rates.push([before, span.older, span.newer], self.config.gyro_gap_s_max));
        let step = Step::new(heard, before, turn, span);
        let now = self.bias.believed();
        let weighed = self.inertia.take(&step, push.as_ref(), self.config.accelerometer_bias_sd_m_s2, &now);
        let Some(weighed) = weighed else { return };
        *linear = weighed.linear;
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&weighed.covariance);
        covariance.fixed_view_mut::<3, 3>(0, 3).copy_from(&weighed.with_rates);
        covariance.fixed_view_mut::<3, 3>(3, 0).copy_from(&weighed.with_rates.transpose());
    }
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
    pub(super) fn longer(&self, tilt: &Vector3<f64>) -> f64 {
        self.distance.as_ref().map_or(0.0, |d| tilt.dot(&d.hit) / d.metres)
    }
}

/// Nothing is known of the rates: they are not correlated with anything, and anything they may be.
fn unobserved(covariance: &mut Matrix6<f64>) {
    covariance.fixed_view_mut::<3, 3>(0, 3).fill(0.0);
    covariance.fixed_view_mut::<3, 3>(3, 0).fill(0.0);
    covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * UNOBSERVED));
}
