//! Whether gyro and camera still agree while the body turns: the flow's scale and the gyro's clock, watched in flight.
//!
//! A fit that takes the gyro's turn off leaves a rest where the gyro says ρ more than the flow shows: at all times about
//! the optical axis, and about the other two where the body turns and does not move over the ground. With θ
//! the turn that the gyro says and Δω the change of its rate over the interval, a flow that turns 1 + ε times as far, a
//! gyro clock that is δ ahead and a bias β give −ρ = εθ + δΔω − βΔt. The steps of about half a minute are fitted by
//! weighted least squares; that Δω is noisy too, by as much as the gyro's samples are, is taken out of its square.
//! β is there so that it is not taken for the others; what is taken off the gyro is learnt from all steps (`bias`), each
//! by what it can show.

use std::fmt;

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::{Config, linear::invert};

/// Steps after which an observation counts for 1/e.
const MEMORY: f64 = 1000.0;
/// Steps before anything is said.
const STEPS_MIN: f64 = 100.0;
/// What is found is said where it is larger than its limit by this many of its deviations.
const SURE: f64 = 3.0;
/// What is known before the first step: scale 1, clock (s), bias (rad/s).
const PRIOR_SD: [f64; 3] = [1.0, 0.1, 0.1];

/// How the camera's turn compares with the gyro's, each with its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Turn by the flow over turn by the gyro, about the body's x, y and z (FLU). A hover that sways slowly at a small
    /// height moves with its turns, and shows that as a scale about x and y.
    pub scale: [f64; 3],
    /// Of each.
    pub scale_sd: [f64; 3],
    /// By how much the gyro's clock is ahead of the camera's, seconds.
    pub offset_s: f64,
    /// Of it.
    pub offset_sd_s: f64,
}

impl Drift {
    /// What is wrong beyond doubt, and by how much.
    pub fn diagnosis(&self, config: &Config) -> Option<Diagnosis> {
        let beyond = |off: f64, sd: f64, limit: f64| off.abs() - SURE * sd > limit;
        if beyond(self.offset_s, self.offset_sd_s, config.clock_offset_s_max) {
            return Some(Diagnosis::Clock { offset_s: self.offset_s, sd_s: self.offset_sd_s });
        }
        (0..3).find(|i| beyond(self.scale[*i] - 1.0, self.scale_sd[*i], config.turn_scale_off_max)).map(|axis| {
            Diagnosis::Scale { axis: ["x", "y", "z"][axis], scale: self.scale[axis], sd: self.scale_sd[axis] }
        })
    }
}

/// What camera and gyro disagree on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Diagnosis {
    /// Their clocks.
    Clock {
        /// By how much the gyro's is ahead.
        offset_s: f64,
        /// Standard deviation.
        sd_s: f64,
    },
    /// How far the body turns.
    Scale {
        /// Of the body.
        axis: &'static str,
        /// Turn by the flow over turn by the gyro.
        scale: f64,
        /// Standard deviation.
        sd: f64,
    },
}

impl fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Diagnosis::Clock { offset_s, sd_s } => {
                let side = if *offset_s < 0.0 { "behind" } else { "ahead of" };
                write!(f, "the gyro's clock is {:.1} ± {:.1} ms {side} the camera's", 1e3 * offset_s.abs(), 1e3 * sd_s)
            }
            Diagnosis::Scale { axis, scale, sd } => {
                write!(f, "the flow turns {scale:.3} ± {sd:.3} times as far as the gyro about the body's {axis}")
            }
        }
    }
}

/// One step's turn, body axes.
pub(super) struct Turned {
    /// By how much the gyro says more than the flow, rad.
    pub(super) leftover: Vector3<f64>,
    /// Its inverse covariance.
    pub(super) information: Matrix3<f64>,
    /// By the gyro, rad.
    pub(super) angle: Vector3<f64>,
    /// Change of the rate over the interval, rad/s.
    pub(super) swing: Vector3<f64>,
    /// (rad/s)² of `swing`, an axis.
    pub(super) swing_variance: f64,
    /// Seconds.
    pub(super) interval_s: f64,
}

/// The steps so far, fading.
#[derive(Debug, Default)]
pub(super) struct Watch {
    information: SMatrix<f64, 7, 7>,
    right: SVector<f64, 7>,
    squares: f64,
    steps: f64,
}

impl Watch {
    /// Takes a step.
    pub(super) fn take(&mut self, step: &Turned) {
        let fade = 1.0 - 1.0 / MEMORY;
        let by = SMatrix::<f64, 3, 7>::from_fn(|row, column| match column {
            0..3 if row == column => step.angle[row],
            3 => step.swing[row],
            4.. if row == column - 4 => -step.interval_s,
            _ => 0.0,
        });
        let pull = by.transpose() * step.information;
        self.information = self.information * fade + pull * by;
        self.information[(3, 3)] -= step.information.trace() * step.swing_variance;
        self.right = self.right * fade - pull * step.leftover;
        self.squares = self.squares * fade + (step.leftover.transpose() * step.information * step.leftover)[0];
        self.steps = self.steps * fade + 1.0;
    }

    /// What the steps say; none before they are enough.
    pub(super) fn found(&self) -> Option<Drift> {
        if self.steps < STEPS_MIN {
            return None;
        }
        let sd = |i: usize| PRIOR_SD[[0, 0, 0, 1, 2, 2, 2][i]];
        let prior = SMatrix::<f64, 7, 7>::from_fn(|i, j| if i == j { sd(i).powi(-2) } else { 0.0 });
        let inverse = invert(&(self.information + prior))?;
        let found = inverse * self.right;
        // Successive steps err alike and the residuals' covariance is an estimate: what is left decides.
        let misfit = (self.squares - found.dot(&self.right)) / (3.0 * self.steps - 7.0);
        let variance = |i: usize| inverse[(i, i)] * misfit.max(1.0);
        if (0..4).any(|i| variance(i) <= 0.0) {
            return None;
        }
        Some(Drift {
            scale: std::array::from_fn(|i| 1.0 + found[i]),
            scale_sd: std::array::from_fn(|i| variance(i).sqrt()),
            offset_s: found[3],
            offset_sd_s: variance(3).sqrt(),
        })
    }
}
