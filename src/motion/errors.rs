//! Everything that a velocity errs by and that is not its vectors' own noise, a column each for one deviation of it, and what is left of that
//! once the vectors' word on the turn is heard.

use nalgebra::{Matrix3, Matrix3x2, Matrix3x5, Matrix6, Matrix6x3, SMatrix, Vector3};

use super::{
    Odometer,
    bias::{Believed, Part, STATES},
    fit::Found,
    fusion::Seen,
    gyro::Turn,
    linear::{GATE, Leftover},
    odometer::Ground,
};

/// Turn (3), its clock, two stamps, two tilts, two shifts, a stretch, what stands on the ground, the distance; …
const PASSING: usize = 13;
/// … and the gyro's bias with what passes for it.
const ERRORS: usize = PASSING + STATES;
/// Those that are the same in the next step: the gyro's clock, two tilts, two shifts, the stretch, what stands on the ground.
const LAST: [usize; 7] = [3, 6, 7, 8, 9, 10, 11];
/// What errs alike in every step: those, the bias with what passes for it, and ground that is no plane (3).
pub(super) const LASTING: usize = LAST.len() + STATES + 3;
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

/// What errs.
#[derive(Default)]
pub(super) struct Errors {
    /// (linear, angular), for one deviation of each.
    moved: SMatrix<f64, 6, ERRORS>,
    seen: SMatrix<f64, 3, ERRORS>,
    count: usize,
    /// What the bias and what passes for it do, for one deviation of each beforehand.
    moved_by: SMatrix<f64, 6, STATES>,
    seen_by: SMatrix<f64, 3, STATES>,
    /// What is believed of them, as it is seen.
    expected: Vector3<f64>,
}

/// Columns of what lasts. Those of the bias and what passes for it are for one deviation of each *beforehand*, whatever is believed of them
/// by now: a velocity says how it changes with the bias, and is right anew when that is known better.
pub(super) type Lasting<const D: usize> = SMatrix<f64, D, LASTING>;

impl Believed {
    /// For one deviation of what is believed, each independent of the others.
    pub(super) fn spread<const D: usize>(&self, lasting: &Lasting<D>) -> Lasting<D> {
        let mut spread = *lasting;
        let by = lasting.fixed_columns::<STATES>(LAST.len()) * self.root();
        spread.fixed_columns_mut::<STATES>(LAST.len()).copy_from(&by);
        spread
    }

    /// What is believed, by how it lasts.
    pub(super) fn shift<const D: usize>(&self, lasting: &Lasting<D>) -> SMatrix<f64, D, 1> {
        lasting.fixed_columns::<STATES>(LAST.len()) * self.states()
    }
}

/// What a fit says of the motion once its vectors' word on the turn is heard.
pub(super) struct Heard {
    /// m/s, newer body axes; what is believed of the bias is still in it.
    pub(super) linear: Vector3<f64>,
    /// Of (linear, angular).
    pub(super) covariance: Matrix6<f64>,
    /// The part of it that the next step errs by too.
    pub(super) lasting: Lasting<6>,
    /// The part of it that the vectors' own scatter makes.
    pub(super) by_vectors: Matrix3<f64>,
    /// What one deviation of the gyro's noise does, about each axis.
    pub(super) by_gyro: Matrix3<f64>,
}

/// The fit in the newer body's axes.
pub(super) struct Fitted {
    /// Change of the linear velocity with τ and the normal's lean.
    pub(super) by_motion: Matrix3x5<f64>,
    /// The camera's velocity, and the body's.
    pub(super) camera: Vector3<f64>,
    pub(super) linear: Vector3<f64>,
    /// From the body to the camera, metres.
    pub(super) arm: Vector3<f64>,
    /// How far on the ground is: see [`Ground::passed`].
    pub(super) passed: f64,
}

impl Fitted {
    /// Change of the linear velocity with an error of the turn, older body axes, in a fit that changes by so much with it (optical axes).
    pub(super) fn by_turn(&self, found: &Found, to_camera: &Matrix3<f64>, interval_s: f64) -> Matrix3<f64> {
        self.by_motion * found.by_turn * to_camera + self.arm.cross_matrix() / interval_s
    }
}

impl Errors {
    fn add(&mut self, deviation: Effect) {
        self.moved.fixed_view_mut::<3, 1>(0, self.count).copy_from(&deviation.linear);
        self.moved.fixed_view_mut::<3, 1>(3, self.count).copy_from(&deviation.angular);
        self.seen.set_column(self.count, &deviation.seen);
        self.count += 1;
    }

    /// What the bias and what passes for it do, one after the other.
    fn believe(&mut self, believed: &Believed, effect: impl Fn(Part) -> Effect) {
        for (state, part) in believed.units().enumerate() {
            let Effect { linear, angular, seen } = effect(part);
            self.moved_by.fixed_view_mut::<3, 1>(0, state).copy_from(&linear);
            self.moved_by.fixed_view_mut::<3, 1>(3, state).copy_from(&angular);
            self.seen_by.set_column(state, &seen);
        }
        self.moved.fixed_columns_mut::<STATES>(PASSING).copy_from(&(self.moved_by * believed.root()));
        self.seen.fixed_columns_mut::<STATES>(PASSING).copy_from(&(self.seen_by * believed.root()));
        self.expected = self.seen_by * believed.states();
    }

    fn lastingly<const D: usize>(of: &SMatrix<f64, D, ERRORS>, by: &SMatrix<f64, D, STATES>) -> Lasting<D> {
        Lasting::from_fn(|row, column| match column.checked_sub(LAST.len()) {
            None => of[(row, LAST[column])],
            Some(state) if state < STATES => by[(row, state)],
            Some(_) => 0.0,
        })
    }

    /// How all errors but the bias and what passes for it are seen: covariance of the turn.
    pub(super) fn passing(&self) -> Matrix3<f64> {
        let passing = self.seen.fixed_columns::<PASSING>(0);
        passing * passing.transpose()
    }

    /// The fit alone.
    pub(super) fn unheard(&self, found: &Found, fit: &Fitted) -> Heard {
        let by_vectors = fit.by_motion * found.covariance * fit.by_motion.transpose();
        let mut covariance = self.moved * self.moved.transpose();
        let mut noise = covariance.fixed_view_mut::<3, 3>(0, 0);
        noise += by_vectors;
        Heard {
            linear: fit.linear,
            covariance,
            lasting: Self::lastingly(&self.moved, &self.moved_by),
            by_vectors,
            by_gyro: self.moved.fixed_view::<3, 3>(0, 0).into(),
        }
    }

    /// With the turn that is left in the vectors, `angle`, which updates everything that errs; `None` where it is by more than that.
    /// Ground that is no plane bends the vectors by `bend`, rad.
    pub(super) fn heard(
        &self,
        found: &Found,
        left: &Leftover,
        fit: &Fitted,
        bend: f64,
        angle: &Vector3<f64>,
    ) -> Option<Heard> {
        let mut heard = self.unheard(found, fit);
        let total = self.seen * self.seen.transpose() + left.covariance + Matrix3::identity() * (bend * bend);
        let inverse = total.try_inverse()?;
        let surprise = angle - self.expected;
        // Asked this way round, a NaN is a contradiction.
        let likely = surprise.dot(&(inverse * surprise)) <= GATE;
        if !likely {
            return None;
        }
        let scatter = fit.by_motion * left.with_motion;
        let mut both: Matrix6x3<f64> = self.moved * self.seen.transpose();
        let mut with_noise = both.fixed_rows_mut::<3>(0);
        with_noise += scatter;
        let gain = both * inverse;
        let mut known = gain * both.transpose();
        // The rates stay the gyro's, less the bias: a filter that has the gyro is not told the flow's word twice.
        known.fixed_view_mut::<3, 3>(3, 3).fill(0.0);
        heard.covariance -= known;
        let gain = gain.fixed_rows::<3>(0).into_owned();
        let mut columns = heard.lasting.fixed_rows_mut::<3>(0);
        columns -= gain * Self::lastingly(&self.seen, &self.seen_by);
        columns.fixed_columns_mut::<3>(LASTING - 3).copy_from(&(gain * bend));
        heard.linear -= gain * angle;
        let shared = scatter * gain.transpose();
        heard.by_vectors += gain * left.covariance * gain.transpose() - shared - shared.transpose();
        heard.by_gyro -= gain * self.seen.fixed_columns::<3>(0);
        Some(heard)
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
    fn shared_sds(&self) -> [f64; 3] {
        [self.shared, self.shared, STRETCHED * self.bent]
    }
}

impl Odometer {
    /// Everything that errs and is not the vectors' own noise.
    pub(super) fn errors(&self, believed: &Believed, seen: &Seen<'_>, fit: &Fitted) -> Errors {
        let Seen { turn, ground, found, span, alike } = *seen;
        let (config, interval_s) = (&self.config, span.seconds);
        let to_camera = self.mount.inverse();
        let mut errors = Errors::default();
        // An error of the turn, in the older body's axes.
        let by_turn = fit.by_turn(found, to_camera.matrix(), interval_s);
        let turned = |error: Vector3<f64>| Effect {
            linear: by_turn * error,
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
            let slopes = self.by_slope(ground, found);
            errors.believe(believed, |part| {
                let by_bias = turned(part.bias * interval_s);
                Effect { seen: by_bias.seen + slopes * part.slope + to_camera * part.bent * alike.bent, ..by_bias }
            });
        }
        errors
    }

    /// By what the gyro's turn may be off, in the older body axes, rad: its noise (3), its clock, and the stamps of both frames.
    fn turn_errors(&self, turn: &Turn) -> [Vector3<f64>; 6] {
        let [x, y, z] = std::array::from_fn(|axis| Vector3::ith(axis, turn.variance.sqrt()));
        let jitter = self.config.stamp_jitter_sd_s;
        let late = (turn.last - turn.first) * self.config.gyro_offset_sd_s;
        [x, y, z, late, turn.first * -jitter, turn.last * jitter]
    }

    /// How the turn that is left changes with the slope of the ground, a deviation of it in either direction: climbing over a slope
    /// bends the vectors as a turn does.
    pub(super) fn by_slope(&self, ground: &Ground, found: &Found) -> Matrix3x2<f64> {
        let by_normal = found.leftover.as_ref().map_or_else(Matrix3::zeros, |left| left.by_normal);
        let tangents = ground.tangents.map(|tangent| self.mount.inverse() * tangent * self.config.ground_slope_sd);
        by_normal * Matrix3x2::from_columns(&tangents)
    }
}
