//! The gyro's bias, learnt in flight: the steps' own word on the turns, each by its noise, older ones fading.

use nalgebra::{Matrix3, Vector3};

use super::linear::invert;

/// Seconds after which an observation counts for 1/e: a MEMS bias moves with its temperature, over minutes.
const MEMORY_S: f64 = 30.0;
/// Steps that err alike: frames of a hover show the same texture.
const ALIKE: f64 = 4.0;
/// What is left of what is known after a step that it does not explain: a bias that jumped is not held for half a minute.
const DOUBTED: f64 = 0.8;

/// What is known so far beyond the settings' word.
#[derive(Debug, Default)]
pub(super) struct Bias {
    /// s²/rad², body axes.
    information: Matrix3<f64>,
    /// The same times the bias.
    right: Vector3<f64>,
}

/// The bias as it is believed, rad/s, body axes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Believed {
    pub(super) mean: Vector3<f64>,
    /// The covariance is this times its transpose.
    pub(super) root: Matrix3<f64>,
}

/// What one step's vectors show.
pub(super) struct Shown {
    /// By how much the gyro turned too far, rad, body axes.
    pub(super) angle: Vector3<f64>,
    pub(super) interval_s: f64,
    /// Covariance of `angle` by what differs from step to step.
    pub(super) noise: Matrix3<f64>,
    /// rad², an axis, by what may stay the same for good: no number of steps takes it out.
    pub(super) lasting: f64,
}

impl Bias {
    /// The belief, where a bias of `sd` is expected before the first step.
    pub(super) fn believed(&self, sd: f64) -> Believed {
        let expected = Believed { mean: Vector3::zeros(), root: Matrix3::identity() * sd };
        let prior = Matrix3::identity() / (sd * sd);
        let Some(covariance) = invert(&(self.information + prior)).filter(|_| sd > 0.0) else { return expected };
        let Some(root) = covariance.cholesky() else { return expected };
        Believed { mean: covariance * self.right, root: root.l() }
    }

    /// A step shows something that the belief does not explain.
    pub(super) fn doubt(&mut self) {
        self.information *= DOUBTED;
        self.right *= DOUBTED;
    }

    /// Takes a step.
    pub(super) fn take(&mut self, step: &Shown) {
        let fade = 1.0 - (step.interval_s / MEMORY_S).min(1.0);
        // After so many steps the sum of their information is that of one step's lasting error.
        let lasting = step.lasting * MEMORY_S / step.interval_s;
        let Some(information) = invert(&(step.noise * ALIKE + Matrix3::identity() * lasting)) else { return };
        self.information = self.information * fade + information * step.interval_s.powi(2);
        self.right = self.right * fade + information * step.angle * step.interval_s;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SD: f64 = 0.003;

    fn learnt(steps: usize, lasting: f64, sd: f64) -> Believed {
        let mut bias = Bias::default();
        for _ in 0..steps {
            bias.take(&Shown {
                angle: Vector3::new(0.002, -0.004, 0.001) / 30.0,
                interval_s: 1.0 / 30.0,
                noise: Matrix3::identity() * (0.005_f64 / 30.0).powi(2),
                lasting: (lasting / 30.0).powi(2),
            });
        }
        bias.believed(sd)
    }

    #[test]
    fn what_is_not_shown_is_as_the_settings_say() {
        let Believed { mean, root } = learnt(0, 0.0, SD);
        assert_eq!(mean, Vector3::zeros());
        assert!((root * root.transpose() - Matrix3::identity() * SD * SD).norm() < 1e-15);
        // Whoever says that there is none is believed.
        assert_eq!(learnt(100, 0.0, 0.0).mean, Vector3::zeros());
        assert_eq!(learnt(100, 0.0, 0.0).root, Matrix3::zeros());
    }

    #[test]
    fn a_bias_is_learnt_and_what_lasts_is_never_known_better() {
        let truth = Vector3::new(0.002, -0.004, 0.001);
        let soon = learnt(10, 0.0, SD);
        let late = learnt(900, 0.0, SD);
        assert!((soon.mean - truth).norm() > (late.mean - truth).norm());
        assert!((late.mean - truth).norm() < 0.03 * truth.norm(), "{}", late.mean);
        let sd = |believed: &Believed| (believed.root * believed.root.transpose())[(0, 0)].sqrt();
        assert!(sd(&late) < sd(&soon) && sd(&soon) < SD);
        assert!(sd(&late) > 0.005 / 900_f64.sqrt(), "a step like its neighbours is no new one: {}", sd(&late));
        let bent = learnt(20_000, 0.001, SD);
        assert!(sd(&bent) > 0.9 * 0.001_f64, "{}", sd(&bent));
    }
}
