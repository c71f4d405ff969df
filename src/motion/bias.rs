//! The gyro's bias, learnt in flight beside what passes for it: the ground's slope and what bends all vectors alike.

use nalgebra::{Matrix3, Matrix3x2, SMatrix, SVector, Vector2, Vector3};

use super::linear::{GATE, invert};

/// Seconds after which a bias is known 1/e as well: a MEMS bias moves with its temperature, over minutes.
const MEMORY_S: f64 = 30.0;
/// Lengths of motion over the distance to the ground after which it is other ground that is seen.
const OTHER_GROUND: f64 = 0.5;
/// Steps that err alike: frames of a hover show the same texture.
pub(super) const ALIKE: f64 = 4.0;
/// What is left of what is known after a step that it does not explain: a bias that jumped is not held for half a minute.
const DOUBTED: f64 = 0.8;
/// The bias (3), the ground's slope (2), what bends all vectors (3), each over its deviation beforehand.
pub(super) const STATES: usize = 8;

/// What is known so far beyond the settings' word.
#[derive(Debug, Clone, Copy)]
pub(super) struct Bias {
    mean: SVector<f64, STATES>,
    covariance: SMatrix<f64, STATES, STATES>,
    /// rad/s, an axis, beforehand.
    sd: f64,
}

/// What is believed, as the turn that it makes two frames show.
#[derive(Debug, Clone, Copy)]
pub(super) struct Believed {
    mean: SVector<f64, STATES>,
    /// The covariance is this times its transpose.
    root: SMatrix<f64, STATES, STATES>,
    sd: f64,
}

/// A part of what is believed.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part {
    /// rad/s, body axes, of the gyro's bias.
    pub(super) bias: Vector3<f64>,
    /// Deviations of the ground's slope, and of what bends all vectors alike, body axes.
    pub(super) slope: Vector2<f64>,
    pub(super) bent: Vector3<f64>,
}

impl Believed {
    fn part(&self, of: impl Fn(usize) -> f64) -> Part {
        Part {
            bias: Vector3::from_fn(|i, _| of(i)) * self.sd,
            slope: Vector2::from_fn(|i, _| of(3 + i)),
            bent: Vector3::from_fn(|i, _| of(5 + i)),
        }
    }

    pub(super) fn mean(&self) -> Part {
        self.part(|i| self.mean[i])
    }

    /// One deviation beforehand of each.
    pub(super) fn units(&self) -> impl Iterator<Item = Part> + '_ {
        (0..STATES).map(|state| self.part(|i| f64::from(u8::from(i == state))))
    }

    /// What is believed of each, over its deviation beforehand.
    pub(super) fn states(&self) -> &SVector<f64, STATES> {
        &self.mean
    }

    /// The covariance of that is this times its transpose.
    pub(super) fn root(&self) -> &SMatrix<f64, STATES, STATES> {
        &self.root
    }
}

/// What the vectors between two frames show.
pub(super) struct Shown {
    /// By how much the gyro turned too far, rad, body axes.
    pub(super) angle: Vector3<f64>,
    pub(super) interval_s: f64,
    /// Covariance of `angle` by what differs from step to step.
    pub(super) noise: Matrix3<f64>,
    /// Change of `angle` with the slope of the ground, for one deviation of it.
    pub(super) by_slope: Matrix3x2<f64>,
    /// rad, an axis, by what stays the same.
    pub(super) bent: f64,
}

impl Bias {
    /// Where a bias of `sd` is expected.
    pub(super) fn new(sd: f64) -> Self {
        Self { mean: SVector::zeros(), covariance: SMatrix::identity(), sd }
    }

    /// The belief.
    pub(super) fn believed(&self) -> Believed {
        let root = self.covariance.cholesky().map_or_else(SMatrix::identity, |root| root.l());
        Believed { mean: self.mean, root, sd: self.sd }
    }

    /// A step shows something that the belief does not explain.
    pub(super) fn doubt(&mut self) {
        self.forget(&[DOUBTED; STATES]);
    }

    /// Back towards what was known beforehand, by what is left of each.
    fn forget(&mut self, left: &[f64; STATES]) {
        for (i, left_i) in left.iter().enumerate() {
            self.mean[i] *= left_i;
            for (j, left_j) in left.iter().enumerate() {
                self.covariance[(i, j)] *= left_i * left_j;
            }
            self.covariance[(i, i)] += 1.0 - left_i * left_i;
        }
    }

    /// Time and ground go by.
    pub(super) fn pass(&mut self, seconds: f64, moved: f64) {
        let (bias, ground) = ((-seconds / MEMORY_S).exp(), (-moved / OTHER_GROUND).exp());
        self.forget(&std::array::from_fn(|i| if i < 3 { bias } else { ground }));
    }

    /// How many steps of `seconds` see the same ground, that moves by `moved` in each.
    pub(super) fn alike(seconds: f64, moved: f64) -> f64 {
        (OTHER_GROUND / moved).min(MEMORY_S / seconds)
    }

    /// Takes what two frames show; `false` where that contradicts the belief, which stays as it is.
    pub(super) fn take(&mut self, shown: &Shown) -> bool {
        let mut by = SMatrix::<f64, 3, STATES>::zeros();
        by.fixed_view_mut::<3, 3>(0, 0).copy_from(&(Matrix3::identity() * self.sd * shown.interval_s));
        by.fixed_view_mut::<3, 2>(0, 3).copy_from(&shown.by_slope);
        by.fixed_view_mut::<3, 3>(0, 5).copy_from(&(Matrix3::identity() * shown.bent));
        let both = self.covariance * by.transpose();
        let Some(inverse) = invert(&(by * both + shown.noise)) else { return false };
        let surprise = shown.angle - by * self.mean;
        // Asked this way round, a NaN is a contradiction.
        let likely = surprise.dot(&(inverse * surprise)) <= GATE;
        if !likely {
            return false;
        }
        let (gain, noise) = (both * inverse, shown.noise);
        self.mean += gain * surprise;
        let left = SMatrix::<f64, STATES, STATES>::identity() - gain * by;
        self.covariance = left * self.covariance * left.transpose() + gain * noise * gain.transpose();
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SD: f64 = 0.003;
    const STEP_S: f64 = 1.0 / 30.0;

    fn truth() -> Vector3<f64> {
        Vector3::new(0.002, -0.004, 0.001)
    }

    /// What frames so far apart show: each other angle off by the deviation of their noise.
    fn shown(interval_s: f64, noise: f64, bent: f64, slope: f64) -> Shown {
        Shown {
            angle: truth() * interval_s + Vector3::new(slope, 0.0, 0.0),
            interval_s,
            noise: Matrix3::identity() * noise * noise,
            by_slope: Matrix3x2::new(slope, 0.0, 0.0, slope, 0.0, 0.0),
            bent,
        }
    }

    fn learnt(steps: usize, bent: f64, sd: f64) -> Bias {
        let mut bias = Bias::new(sd);
        for _ in 0..steps {
            bias.pass(STEP_S, 0.0);
            assert!(bias.take(&shown(STEP_S, 0.005 * STEP_S, bent * STEP_S, 0.0)) || sd == 0.0);
        }
        bias
    }

    /// The bias that is believed in, and its deviation about the first axis.
    fn of(bias: &Bias) -> (Vector3<f64>, f64) {
        let believed = bias.believed();
        (believed.mean().bias, believed.root().row(0).norm() * bias.sd)
    }

    #[test]
    fn what_is_not_shown_is_as_the_settings_say() {
        let (mean, sd) = of(&Bias::new(SD));
        assert_eq!(mean, Vector3::zeros());
        assert!((sd - SD).abs() < 1e-15);
        // Whoever says that there is none is believed.
        assert_eq!(of(&learnt(100, 0.0, 0.0)), (Vector3::zeros(), 0.0));
        // What was known fades.
        let mut late = learnt(900, 0.0, SD);
        late.pass(10.0 * MEMORY_S, 0.0);
        let (mean, sd) = of(&late);
        assert!(mean.norm() < 1e-3 * truth().norm() && (sd - SD).abs() < 1e-3 * SD, "{mean} {sd}");
    }

    #[test]
    fn a_bias_is_learnt_and_what_lasts_is_never_known_better() {
        let (soon, soon_sd) = of(&learnt(10, 0.0, SD));
        let (late, late_sd) = of(&learnt(900, 0.0, SD));
        assert!((soon - truth()).norm() > (late - truth()).norm());
        assert!((late - truth()).norm() < 0.05 * truth().norm(), "{late}");
        assert!(late_sd < soon_sd && soon_sd < SD);
        let (_, sd) = of(&learnt(20_000, 0.001, SD));
        let least = 0.001 * SD / 0.001_f64.hypot(SD);
        assert!(sd > 0.99 * least && sd < 1.2 * least, "{sd} {least}");
    }

    #[test]
    fn frames_further_apart_show_it_better() {
        let mut bias = Bias::new(SD);
        assert!(bias.take(&shown(1.0, 0.005 * STEP_S, 0.001 * STEP_S, 0.0)));
        let (mean, sd) = of(&bias);
        assert!((mean - truth()).norm() < 0.01 * truth().norm() && sd < 2e-4, "{mean} {sd}");
    }

    #[test]
    fn a_slope_passes_for_a_bias_until_motion_and_time_tell_them_apart() {
        let mut bias = Bias::new(SD);
        assert!(bias.take(&shown(0.5, 1e-5, 0.0, 0.004)));
        let (mean, sd) = of(&bias);
        assert!((mean.x - truth().x).abs() > 5e-4 && sd > 0.5 * SD, "{mean} {sd}");
        assert!(bias.take(&shown(0.5, 1e-5, 0.0, -0.004)));
        let (mean, sd) = of(&bias);
        assert!((mean.x - truth().x).abs() < 5e-5 && sd < 5e-5, "{mean} {sd}");
    }

    #[test]
    fn what_can_not_be_is_not_believed() {
        let mut bias = learnt(100, 0.0, SD);
        let before = of(&bias);
        let jumped = |angle| Shown { angle, ..shown(1.0, 1e-5, 0.0, 0.0) };
        assert!(!bias.take(&jumped(Vector3::new(0.1, 0.0, 0.0))));
        assert!(!bias.take(&jumped(Vector3::new(f64::NAN, 0.0, 0.0))));
        assert_eq!(of(&bias), before);
        bias.doubt();
        assert!(of(&bias).1 > before.1);
    }
}
