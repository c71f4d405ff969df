//! From step to step by the accelerometer: what the steps before said of the velocity is carried to the newest and weighed with its word.
//!
//! The mean velocities of two adjoining intervals differ by ∫ w a dt, where a is the body's acceleration and w rises from 0 to 1 over
//! the first of them and falls to 0 again over the second. An accelerometer measures a − g; g's direction is the attitude's word, and
//! what is wrong about both, the leak, is fitted beside the velocity. What one step errs by and the next one too (the gyro's bias and
//! clock, the tilt, what all vectors share) is never averaged out: it is carried along as columns of unit variance whose causes are
//! the same in every step, and a step is weighed by what it does *not* have in common with those before (Schmidt's consider filter:
//! S. F. Schmidt, "Application of state-space methods to navigation problems", 1966). What is believed of the gyro's bias by now is
//! taken off in the end, from everything that was kept.
//!
//! Vectors scatter anew in every step, and their sum over a hover wanders. How far the body has moved since a frame that was kept
//! (`Inertia::look_back`) ends that: by how much the steps' scatter added up is fitted too, and what it turns out to be was in part the newest's.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::{
    bias::Believed,
    errors::{Heard, Lasting},
    gyro::Turn,
    linear::{GATE, invert},
    odometer::Span,
};
use crate::clock::Stamp;

/// Standard gravity, m/s².
pub const GRAVITY: f64 = 9.806_65;
/// How many times what it says a step's own noise may be, where that explains it.
const ROUGH: f64 = 2.0;
/// m/s² after a second: an attitude's error moves, with the accelerations that a filter behind it takes for gravity.
const WALK: f64 = 0.03;

/// Velocity, leak, what the scatter of the steps' vectors added up to (metres, negative), and the newest step's (m/s).
const STATES: usize = 12;
const VELOCITY: usize = 0;
const LEAK: usize = 3;
const SUM: usize = 6;
const SCATTER: usize = 9;

type States<const D: usize> = SMatrix<f64, STATES, D>;

/// What accelerometer and attitude say between the steps, body axes at the newest stamp.
#[derive(Debug, Clone, Copy)]
pub(super) struct Push {
    /// Change of the mean velocity, m/s.
    pub(super) change: Vector3<f64>,
    /// (m/s)² an axis.
    pub(super) variance: f64,
    /// By how many seconds a leak changes it.
    pub(super) seconds: f64,
    /// rad, the attitude's own word on its error.
    pub(super) up_sd: f64,
}

/// What one step alone says, the newer frame's body axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step {
    pub(super) older: Stamp,
    pub(super) newer: Stamp,
    /// From the older frame's body axes.
    pub(super) turned: Matrix3<f64>,
    /// m/s; what is believed of the bias is still in it.
    pub(super) linear: Vector3<f64>,
    /// Covariance of what is this step's alone, what of it the vectors' scatter makes, and with the rates.
    pub(super) noise: Matrix3<f64>,
    pub(super) by_vectors: Matrix3<f64>,
    pub(super) with_rates: Matrix3<f64>,
    /// m/s for one deviation of the gyro's noise about each axis, `gyro_sd` (rad).
    pub(super) by_gyro: Matrix3<f64>,
    pub(super) gyro_sd: f64,
    /// What lasts, by column: m/s, and rad/s of the rates.
    pub(super) lasting: Lasting<3>,
    pub(super) rates: Lasting<3>,
}

impl Step {
    /// What a fit says, where `before` was believed of the bias.
    pub(super) fn new(heard: &Heard, before: &Believed, turn: &Turn, span: Span) -> Step {
        let spread = before.spread(&heard.lasting);
        let moved = spread.fixed_rows::<3>(0);
        let covariance = &heard.covariance;
        Step {
            older: span.older,
            newer: span.newer,
            turned: *turn.rotation.inverse().to_rotation_matrix().matrix(),
            linear: heard.linear,
            noise: covariance.fixed_view::<3, 3>(0, 0) - moved * moved.transpose(),
            by_vectors: heard.by_vectors,
            with_rates: covariance.fixed_view::<3, 3>(0, 3) - moved * spread.fixed_rows::<3>(3).transpose(),
            by_gyro: heard.by_gyro,
            gyro_sd: turn.variance.sqrt(),
            lasting: heard.lasting.fixed_rows::<3>(0).into(),
            rates: heard.lasting.fixed_rows::<3>(3).into(),
        }
    }

    fn seconds(&self) -> f64 {
        self.newer.seconds_since(self.older)
    }

    /// Metres for a radian of the gyro's noise.
    fn by_gyro(&self) -> Matrix3<f64> {
        self.by_gyro * if self.gyro_sd > 0.0 { self.seconds() / self.gyro_sd } else { 0.0 }
    }

    /// The same with as much noise as a step may have.
    fn rough(&self) -> Step {
        let [noise, by_vectors, with_rates] =
            [self.noise, self.by_vectors, self.with_rates].map(|covariance| covariance * (ROUGH * ROUGH));
        Step { noise, by_vectors, with_rates, ..*self }
    }
}

/// A velocity with its covariance, and that with the rates.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weighed {
    pub(super) linear: Vector3<f64>,
    pub(super) covariance: Matrix3<f64>,
    pub(super) with_rates: Matrix3<f64>,
}

/// A word on some of the states, or on a sum of them.
struct Word {
    said: Vector3<f64>,
    noise: Matrix3<f64>,
    lasting: Lasting<3>,
}

/// What was believed after the newest step.
#[derive(Debug, Clone, Copy)]
struct Kept {
    older: Stamp,
    newer: Stamp,
    /// The leak, m/s², is measured and not there, body axes; none before there was a push.
    leaks: bool,
    mean: SVector<f64, STATES>,
    /// Without what lasts, …
    covariance: SMatrix<f64, STATES, STATES>,
    /// … and what lasts.
    lasting: Lasting<STATES>,
    /// Whether the newest step contradicted it.
    doubted: bool,
    /// How far the steps lead since then, if a frame was kept.
    led: Option<Led>,
}

/// The sum of the steps' own words since a frame that was kept, the newest body axes.
#[derive(Debug, Clone, Copy)]
struct Led {
    since: Stamp,
    /// Metres.
    moved: Vector3<f64>,
    lasting: Lasting<3>,
    /// Metres for a radian of the gyro's noise, in the newest step.
    by_gyro: Matrix3<f64>,
}

/// The velocity's memory.
#[derive(Debug, Default)]
pub(super) struct Inertia {
    kept: Option<Kept>,
}

impl Inertia {
    /// The older stamp of the step before, if that ended where this one begins.
    pub(super) fn before(&self, older: Stamp) -> Option<Stamp> {
        self.kept.filter(|kept| kept.newer == older).map(|kept| kept.older)
    }

    /// Whatever was known is known no more.
    pub(super) fn forget(&mut self) {
        self.kept = None;
    }

    /// Weighs a step with what is known from before; `None` where that is nothing, or where the two contradict each other, and the step
    /// stands alone. `push` is what leads from there to here. An accelerometer is as wrong as `bias_sd` (m/s²) for good, and the gyro as
    /// is `believed` by now.
    ///
    /// Vectors scatter more than they say now and then, by noise that is not that of a bell: a step that twice its noise explains is
    /// weighed with that. One contradiction beyond says that one of the two is wrong, not which: what was known is kept beside. Two in
    /// a row end it.
    pub(super) fn take(
        &mut self,
        step: &Step,
        push: Option<&Push>,
        bias_sd: f64,
        believed: &Believed,
    ) -> Option<Weighed> {
        let carried = push.zip(self.kept).map(|(push, kept)| kept.carried(step, push, bias_sd));
        let met =
            carried.and_then(|carried| carried.met(step, believed).or_else(|| carried.met(&step.rough(), believed)));
        let doubted =
            carried.filter(|carried| !carried.doubted).map(|carried| Kept { doubted: true, led: None, ..carried });
        self.kept = met.map(|(kept, _)| kept.added(step)).or(doubted).or_else(|| Some(Kept::anew(step)));
        let (kept, with_rates) = met?;
        let lasting = kept.lasting.fixed_rows::<3>(VELOCITY).into_owned();
        let spread = believed.spread(&lasting);
        Some(Weighed {
            linear: kept.mean.fixed_rows::<3>(VELOCITY) - believed.shift(&lasting),
            covariance: kept.covariance.fixed_view::<3, 3>(VELOCITY, VELOCITY) + spread * spread.transpose(),
            with_rates: with_rates + spread * believed.spread(&step.rates).transpose(),
        })
    }

    /// The newest frame, of this stamp, is kept.
    pub(super) fn begin(&mut self, stamp: Stamp) {
        self.kept = self.kept.map(|kept| if kept.newer == stamp { kept.begun() } else { kept });
    }

    /// Takes how far the body is from where it was when a frame was kept: `back` leads from there to here, as if no step were between. What
    /// does not fit what the steps led to is left alone.
    pub(super) fn look_back(&mut self, back: &Step, believed: &Believed) {
        let led = self.kept.filter(|kept| kept.newer == back.newer);
        let Some((kept, led)) = led.and_then(|kept| Some((kept, kept.led.filter(|led| led.since == back.older)?)))
        else {
            return;
        };
        // The gyro's noise is the same in both, but for how it is heard.
        let by_gyro = (back.by_gyro() - led.by_gyro) * back.gyro_sd;
        let seconds = back.seconds();
        let word = Word {
            said: back.linear * seconds - led.moved,
            noise: back.by_vectors * (seconds * seconds) + by_gyro * by_gyro.transpose(),
            lasting: back.lasting * seconds - led.lasting,
        };
        self.kept = kept.heard(&[SUM], &word, believed).map(|(kept, _)| kept).or(Some(kept));
    }
}

impl Kept {
    /// The step's word alone.
    fn anew(step: &Step) -> Kept {
        let (mut mean, mut covariance, mut lasting) =
            (SVector::<f64, STATES>::zeros(), SMatrix::<f64, STATES, STATES>::zeros(), Lasting::<STATES>::zeros());
        mean.fixed_rows_mut::<3>(VELOCITY).copy_from(&step.linear);
        covariance.fixed_view_mut::<3, 3>(VELOCITY, VELOCITY).copy_from(&step.noise);
        lasting.fixed_rows_mut::<3>(VELOCITY).copy_from(&step.lasting);
        let Step { older, newer, .. } = *step;
        Kept { older, newer, leaks: false, mean, covariance, lasting, doubted: false, led: None }
    }

    fn led_by(mut self, by: &SMatrix<f64, STATES, STATES>) -> Kept {
        self.mean = by * self.mean;
        self.covariance = by * self.covariance * by.transpose();
        self.lasting = by * self.lasting;
        self
    }

    /// To the end of a step that begins where this ends.
    fn carried(mut self, step: &Step, push: &Push, bias_sd: f64) -> Kept {
        if !self.leaks {
            let variance = (GRAVITY * push.up_sd).powi(2) + bias_sd * bias_sd;
            self.covariance.fixed_view_mut::<3, 3>(LEAK, LEAK).copy_from(&(Matrix3::identity() * variance));
        }
        let mut by = SMatrix::<f64, STATES, STATES>::identity();
        by.fixed_view_mut::<3, 3>(VELOCITY, VELOCITY).copy_from(&step.turned);
        by.fixed_view_mut::<3, 3>(VELOCITY, LEAK).copy_from(&(Matrix3::identity() * -push.seconds));
        by.fixed_view_mut::<3, 3>(SUM, SUM).copy_from(&step.turned);
        let mut carried = self.led_by(&by);
        let mut velocity = carried.mean.fixed_rows_mut::<3>(VELOCITY);
        velocity += push.change;
        for axis in 0..3 {
            carried.covariance[(VELOCITY + axis, VELOCITY + axis)] += push.variance;
            carried.covariance[(LEAK + axis, LEAK + axis)] += WALK * WALK * push.seconds;
        }
        Kept { older: step.older, newer: step.newer, leaks: true, ..carried }
    }

    /// Weighed with a step's own word, and the covariance of that with the rates; `None` where the two contradict each other.
    fn met(mut self, step: &Step, believed: &Believed) -> Option<(Kept, Matrix3<f64>)> {
        self.covariance.fixed_view_mut::<3, 3>(SCATTER, SCATTER).copy_from(&step.by_vectors);
        let word = Word { said: step.linear, noise: step.noise - step.by_vectors, lasting: step.lasting };
        let (kept, gain) = self.heard(&[VELOCITY, SCATTER], &word, believed)?;
        Some((Kept { doubted: false, ..kept }, gain.fixed_rows::<3>(VELOCITY) * step.with_rates))
    }

    /// Weighed with a word on the sum of the states that begin there, and by how much that changed all of them; `None` where the two
    /// contradict each other.
    fn heard(mut self, of: &[usize], word: &Word, believed: &Believed) -> Option<(Kept, States<3>)> {
        let (mut apart, mut off, mut both) = (word.lasting, word.said, States::<3>::zeros());
        for at in of {
            apart -= self.lasting.fixed_rows::<3>(*at);
            off -= self.mean.fixed_rows::<3>(*at);
            both += self.covariance.fixed_columns::<3>(*at);
        }
        let spread = believed.spread(&apart);
        let mut total = word.noise + spread * spread.transpose();
        for at in of {
            total += both.fixed_rows::<3>(*at);
        }
        let inverse = invert(&total)?;
        let surprise = off - believed.shift(&apart);
        // Asked this way round, a NaN is a contradiction.
        let likely = surprise.dot(&(inverse * surprise)) <= GATE;
        if !likely {
            return None;
        }
        let gain = (both - believed.spread(&self.lasting) * spread.transpose()) * inverse;
        let mut left = SMatrix::<f64, STATES, STATES>::identity();
        for at in of {
            let mut columns = left.fixed_columns_mut::<3>(*at);
            columns -= gain;
        }
        self.mean += gain * off;
        self.covariance = left * self.covariance * left.transpose() + gain * word.noise * gain.transpose();
        self.lasting += gain * apart;
        Some((self, gain))
    }

    /// The step's scatter is added to what it was before.
    fn added(self, step: &Step) -> Kept {
        let seconds = step.seconds();
        let mut by = SMatrix::<f64, STATES, STATES>::identity();
        by.fixed_view_mut::<3, 3>(SUM, SCATTER).copy_from(&(Matrix3::identity() * -seconds));
        by.fixed_view_mut::<3, 3>(SCATTER, SCATTER).fill(0.0);
        let led = self.led.map(|led| Led {
            moved: step.turned * led.moved + step.linear * seconds,
            lasting: step.turned * led.lasting + step.lasting * seconds,
            by_gyro: step.by_gyro(),
            ..led
        });
        Kept { led, ..self.led_by(&by) }
    }

    /// From now on it is added up.
    fn begun(self) -> Kept {
        let mut by = SMatrix::<f64, STATES, STATES>::identity();
        by.fixed_view_mut::<3, 3>(SUM, SUM).fill(0.0);
        let zeros = Matrix3::zeros();
        let led = Led { since: self.newer, moved: Vector3::zeros(), lasting: Lasting::zeros(), by_gyro: zeros };
        Kept { led: Some(led), ..self.led_by(&by) }
    }
}

#[cfg(test)]
mod tests;
