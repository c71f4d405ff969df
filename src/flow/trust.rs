//! Whether a step's flow is to be trusted, said as a state with its cause.

use crate::{
    exposure::Pair,
    flow::{Cause, Flow, Matcher, State},
};

impl Matcher {
    /// The state of a step and the mean confidence of its flow.
    ///
    /// What makes blind is looked at before what degrades, and what was measured in the raw frames before what the
    /// network says of itself: in the dark a network can be sure and wrong.
    pub fn judge(&self, pair: &Pair<'_>, flow: &Flow<'_>) -> (State, f32) {
        let mean = mean(flow.confidence);
        (self.state(pair, mean), mean)
    }

    fn state(&self, pair: &Pair<'_>, mean: f32) -> State {
        let config = &self.config;
        let raw_mean = worse(pair.older.raw_mean, pair.newer.raw_mean, f32::min);
        let part = worse(pair.older.saturated_part, pair.newer.saturated_part, f32::max);
        // How noisy a picture is tells of the dark what its raw mean only hints at, and means the same for every camera.
        let level =
            pair.older.noise_level.zip(pair.newer.noise_level).map(|(older, newer)| worse(older, newer, f32::max));
        let dark = |needed, allowed| match level {
            Some(level) => unless(level <= allowed, Cause::Noisy { level, allowed }),
            None => unless(raw_mean >= needed, Cause::Dark { raw_mean, needed }),
        };
        let saturated = |allowed| unless(part <= allowed, Cause::Saturated { part, allowed });
        let unsure = |needed| unless(mean >= needed, Cause::Unsure { mean, needed });
        let blind = pair
            .newer
            .frozen
            .then_some(Cause::Frozen)
            .or_else(|| dark(config.raw_mean_min, config.noise_level_max))
            .or_else(|| saturated(config.saturated_part_max))
            .or_else(|| unsure(config.confidence_min));
        if let Some(cause) = blind {
            return State::Blind(cause);
        }
        let degraded = pair
            .gain_step
            .map(|factor| Cause::GainStep { factor })
            .or_else(|| dark(config.raw_mean_degraded, config.noise_level_degraded))
            .or_else(|| saturated(config.saturated_part_degraded))
            .or_else(|| unsure(config.confidence_degraded));
        degraded.map_or(State::Ok, State::Degraded)
    }
}

/// Comparisons are written as what must hold, so that a NaN never passes as well.
fn unless(well: bool, cause: Cause) -> Option<Cause> {
    (!well).then_some(cause)
}

/// The worse of both frames' figures; NaN is worst, though `min` and `max` would pass over it.
fn worse(older: f32, newer: f32, choose: fn(f32, f32) -> f32) -> f32 {
    if older.is_nan() || newer.is_nan() { f32::NAN } else { choose(older, newer) }
}

/// In f64 and in order, so that a replay gives the same bits. 0 of nothing.
fn mean(values: &[f32]) -> f32 {
    let sum: f64 = values.iter().map(|&value| f64::from(value)).sum();
    (sum / values.len().max(1) as f64) as f32
}
