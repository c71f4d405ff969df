//! The paper's text: a tone curve a colour, then a real camera's noise at a level drawn to fill table 1.

use std::sync::LazyLock;

use super::{
    super::{
        curves,
        profiles::{self, Profile},
    },
    Dice, Drawn, TABLE,
    plan::{Clean, Grain, Plan, Spread},
};

/// Powers that undo the tone curve: from a linear picture to a little more than sRGB's.
const GAMMA: [f64; 2] = [1.0, 2.4];
/// Upper edges of the table's columns, on the 8-bit scale. The last column is open; its edge is ours.
const EDGES: [f64; 4] = [10.0, 20.0, 30.0, 33.0];
/// What a dark frame's mean is brought to.
const SCALED_MEAN: f64 = 0.4;
/// No raw is darker: at less the strongest cameras of the table are beyond the last level.
const RAW_MEAN_MIN: f64 = 0.001;
const GAIN_MAX: f64 = SCALED_MEAN / RAW_MEAN_MIN;
/// Steps of the secant; four do on ordinary pictures.
const STEPS: usize = 8;

static PROFILES: LazyLock<Vec<Profile>> = LazyLock::new(|| profiles::all().collect());

pub(super) fn plan(dice: &mut Dice, older: &[u8]) -> (Plan, Drawn) {
    let gamma = [0; 3].map(|_| dice.between(GAMMA[0], GAMMA[1]));
    let curve = |gamma| std::array::from_fn(|byte| (255.0 * curves::power(byte as f64 / 255.0, gamma)) as f32);
    let clean = Clean { curves: gamma.map(curve), camera: None };
    let spread = Spread::of(&clean, older);
    let target = level(dice.in_turn()) / 255.0;
    let profile = camera(dice, &spread, target);
    let gain = gain(&spread, &profile, target);
    let (a, b) = scaled(&profile, gain);
    let level = spread.level(|colour, clean| a[colour] * clean + b[colour]) * 255.0;
    let plan =
        Plan { clean, grain: Grain::Root, a: a.map(|a| (a * 255.0) as f32), b: b.map(|b| (b * 255.0 * 255.0) as f32) };
    (plan, Drawn { a, b, gamma, gain: [1.0; 3], level, taken: Some((profile, SCALED_MEAN / gain)) })
}

/// A noise level on the 8-bit scale: a column of the table by its count, evenly within the column.
fn level(part: f64) -> f64 {
    let mut left = part * f64::from(TABLE.iter().sum::<u32>());
    let mut low = 0.0;
    for (high, count) in EDGES.into_iter().zip(TABLE.map(f64::from)) {
        if left < count {
            return low + (high - low) * left / count;
        }
        left -= count;
        low = high;
    }
    low
}

/// The noise of a raw once it is scaled by `gain`.
fn scaled(profile: &Profile, gain: f64) -> ([f64; 3], [f64; 3]) {
    (profile.noise.a.map(|a| gain * a), profile.noise.b.map(|b| gain * gain * b))
}

/// The gain at which a camera shows the level if nothing were clipped: r·A + r²·B = level².
fn unclipped(spread_means: &[f64; 3], profile: &Profile, level: f64) -> f64 {
    let a = (0..3).map(|colour| profile.noise.a[colour] * spread_means[colour]).sum::<f64>() / 3.0;
    let b = profile.noise.b.iter().sum::<f64>() / 3.0;
    let square = level * level;
    // The stable form of the root; a black picture of a camera without b has no noise at any gain.
    2.0 * square / (a + (a * a + 4.0 * b * square).sqrt()).max(1e-12)
}

/// One of the cameras and ISOs that show the level at a raw mean of 0.001…0.4, all alike; else the nearest.
fn camera(dice: &mut Dice, spread: &Spread, level: f64) -> Profile {
    let means = [0, 1, 2].map(|colour| spread.mean(colour));
    let beyond = |profile: &Profile| {
        let gain = unclipped(&means, profile, level);
        (1.0 / gain).max(gain / GAIN_MAX).max(1.0)
    };
    let fit = PROFILES.iter().filter(|profile| beyond(profile) <= 1.0).count();
    let number = dice.between(0.0, fit as f64) as usize;
    if let Some(profile) = PROFILES.iter().filter(|profile| beyond(profile) <= 1.0).nth(number) {
        return *profile;
    }
    PROFILES.iter().fold(PROFILES[0], |kept, next| if beyond(next) < beyond(&kept) { *next } else { kept })
}

/// The gain at which the camera shows the level with clipping; never below 1, where a raw needs none.
fn gain(spread: &Spread, profile: &Profile, level: f64) -> f64 {
    let means = [0, 1, 2].map(|colour| spread.mean(colour));
    let shown = |ln_gain: f64| {
        let (a, b) = scaled(profile, curves::exp(ln_gain));
        curves::ln(spread.level(|colour, clean| a[colour] * clean + b[colour]).max(1e-9))
    };
    // Level against gain is nearly straight on logarithms, so that a secant is there in a few steps.
    let (wanted, limit) = (curves::ln(level.max(1e-9)), curves::ln(GAIN_MAX) + 1.0);
    let mut at = curves::ln(unclipped(&means, profile, level).max(1.0)).min(limit);
    let (mut found, mut slope) = (shown(at), 0.75);
    for _ in 0..STEPS {
        let next = (at + (wanted - found) / slope).clamp(0.0, limit);
        if (next - at).abs() < 1e-4 {
            break;
        }
        let then = shown(next);
        slope = ((then - found) / (next - at)).clamp(0.1, 2.0);
        (at, found) = (next, then);
    }
    curves::exp(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_fill_the_columns_of_the_table() {
        let parts = (0..100_000).map(|i| f64::from(i) / 100_000.0);
        let mut counts = [0_u32; 4];
        for part in parts {
            counts[EDGES.iter().position(|edge| level(part) < *edge).unwrap()] += 1;
        }
        let all = f64::from(TABLE.iter().sum::<u32>());
        for (count, wanted) in counts.into_iter().zip(TABLE) {
            assert!((f64::from(count) / 1e5 - f64::from(wanted) / all).abs() < 1e-4, "{counts:?}");
        }
    }

    #[test]
    fn the_gain_shows_the_level_that_was_asked_for() {
        let clean = Clean { curves: [std::array::from_fn(|byte| byte as f32); 3], camera: None };
        for frame in [vec![0; 300], vec![100; 300], vec![255; 300], (0..=255).cycle().take(3000).collect()] {
            let spread = Spread::of(&clean, &frame);
            for wanted in [2.0, 10.0, 29.0] {
                let mut dice = Dice::new(4, 5);
                let profile = camera(&mut dice, &spread, wanted / 255.0);
                let (a, b) = scaled(&profile, gain(&spread, &profile, wanted / 255.0));
                let shown = 255.0 * spread.level(|colour, clean| a[colour] * clean + b[colour]);
                assert!((shown / wanted - 1.0).abs() < 2e-3, "{wanted}: {shown} by {profile:?}");
            }
        }
    }
}
