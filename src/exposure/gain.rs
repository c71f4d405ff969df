//! The gain: one for both frames of a pair, held while it is about right.

use super::Config;

/// Chooses gains from means. It uses the four operations and square roots only, which are exact to the bit everywhere.
#[derive(Debug, Clone)]
pub(super) struct Law {
    target: f32,
    band: f32,
    smoothing: f32,
    step_factor: f32,
    gain_max: f32,
    /// A mean below this would ask for more than the largest gain.
    floor: f32,
    /// Smoothed mean and the gain that is held; none before the first frame.
    held: Option<[f32; 2]>,
    /// The last pair was a gain step: the next one returns to the target whatever the band says.
    stepped: bool,
}

impl Law {
    pub fn new(config: &Config) -> Self {
        Self {
            target: config.mean_target,
            band: config.gain_band,
            smoothing: config.gain_smoothing,
            step_factor: config.gain_step_factor,
            gain_max: config.gain_max,
            floor: config.mean_target / config.gain_max,
            held: None,
            stepped: false,
        }
    }

    /// The gain of a frame without a partner: nothing is at stake but the frame itself, so nothing is smoothed.
    pub fn alone(&mut self, mean: f32) -> f32 {
        let mean = mean.max(self.floor);
        match self.held {
            Some([_, gain]) if !self.stepped && !self.off(mean, gain) => {
                self.held = Some([mean, gain]);
                gain
            }
            _ => self.aim(mean),
        }
    }

    /// The gain of a pair, and by what factor the light changed if that was a step.
    ///
    /// A step's gain brings the pair's geometric mean to the target, so that the frames stand equally far above and
    /// below it; but the brighter one to no more than twice the target. What is clipped is lost, whereas a dark linear
    /// image only has less contrast.
    pub fn pair(&mut self, older: f32, newer: f32) -> (f32, Option<f32>) {
        let (older, newer) = (older.max(self.floor), newer.max(self.floor));
        let factor = newer / older;
        if factor > self.step_factor || factor * self.step_factor < 1.0 {
            let gain =
                (self.target / (older * newer).sqrt()).min(2.0 * self.target / older.max(newer)).min(self.gain_max);
            self.held = Some([newer, gain]);
            self.stepped = true;
            return (gain, Some(factor));
        }
        let both = (older * newer).sqrt();
        let gain = match self.held {
            Some(held) if !self.stepped => self.follow(held, newer, both),
            _ => self.aim(both),
        };
        (gain, None)
    }

    /// Holds the gain while the smoothed mean allows, else aims at `both`.
    fn follow(&mut self, [smoothed, gain]: [f32; 2], mean: f32, both: f32) -> f32 {
        let smoothed = smoothed + self.smoothing * (mean - smoothed);
        if self.off(smoothed, gain) {
            return self.aim(both);
        }
        self.held = Some([smoothed, gain]);
        gain
    }

    /// Whether the gain is outside the band around what the mean asks for.
    fn off(&self, mean: f32, gain: f32) -> bool {
        let off = self.target / mean / gain;
        off > 1.0 + self.band || off * (1.0 + self.band) < 1.0
    }

    fn aim(&mut self, mean: f32) -> f32 {
        let gain = (self.target / mean).min(self.gain_max);
        self.held = Some([mean, gain]);
        self.stepped = false;
        gain
    }
}
