//! The authors' released script of 2021, figure for figure.

use super::{
    Dice, Drawn,
    plan::{Clean, Grain, Plan, Spread},
};

const A_DEVIATION: f64 = 19.5 / 255.0;
const B_DEVIATION: f64 = 38.25;
const GAIN_DEVIATION: f64 = 0.05;

pub(super) fn plan(dice: &mut Dice, older: &[u8]) -> (Plan, Drawn) {
    let a = (dice.normal() * A_DEVIATION).abs();
    let b = (dice.normal() * B_DEVIATION).abs() / 255.0;
    let gain = [0; 3].map(|_| 1.0 / (1.0 + GAIN_DEVIATION * dice.normal()));
    let identity: [f32; 256] = std::array::from_fn(|byte| byte as f32);
    let plan = Plan {
        clean: Clean { curves: [identity; 3], camera: None },
        grain: Grain::Line { gains: gain.map(|gain| gain as f32) },
        a: [a as f32; 3],
        b: [(b * 255.0) as f32; 3],
    };
    let spread = Spread::of(&plan.clean, older);
    let level = spread.level(|_, clean| (a * clean + b) * (a * clean + b));
    (plan, Drawn { a: [a; 3], b: [b; 3], gamma: [1.0; 3], gain, level: level * 255.0, taken: None })
}
